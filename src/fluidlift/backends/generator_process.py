"""A generator in a process of its own, in this or another Python: pictures in, bodies out, and nothing else.

`generator_runner` says what goes over. Here: the process is started with a group of its own, watched, ended as a group
when it takes too long, and nothing that it hands over is believed before it was looked at.
"""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from fluidlift.backends.generator_card import GeneratorCard
from fluidlift.errors import FluidliftError, InputRejected, MissingPackage
from fluidlift.seams import Generator
from fluidlift.types import Gaussians, PinholeCamera

RUNNER = Path(__file__).with_name("generator_runner.py")
PACKAGE = Path(__file__).resolve().parent.parent
PROTOCOL = 1
POLL = 0.05
"""s between looks at what the process has made"""
GRACE = 5.0
"""s between asking a group to end and ending it"""
PASSING = 1.0
"""s in which the children of a process that has ended are waited for"""
LAST_LINES, LAST_BYTES = 12, 2**15
"""of the log of a process that broke down, which are shown"""
LARGEST_PLY, LARGEST_JSON, LARGEST_LOG = 4 * 2**30, 2**20, 2**28
"""bytes that are accepted"""
_MEMORY = ("out of memory", "outofmemory", "cannot allocate memory", "can't allocate memory", "bad_alloc", "memoryerr")
_OURS = ("PYTHONHOME", "VIRTUAL_ENV", "PYTHONSTARTUP", "LD_PRELOAD")


class GeneratorFailed(FluidliftError):
    """A generator broke down, took too long, or handed over something that is no body."""


@dataclass(frozen=True)
class Picture:
    """One frame for a generator."""

    frame: int
    image: np.ndarray
    """u8 [H,W,3], sRGB"""
    mask: np.ndarray
    """bool [H,W], the fluid"""


@dataclass(frozen=True)
class ProcessChoice:
    """Which Python, which runner, and how long they may take."""

    python: Path = field(default_factory=lambda: Path(sys.executable))
    """of the environment in which the generator is installed"""
    runner: Path = RUNNER
    """a script that speaks the protocol"""
    code: Path | None = None
    """folder of the generator's own code, where it is not installed but a checkout"""
    device: str = "cuda"
    seed: int = 0
    weights: str | None = None
    allow_download: bool = False
    field_of_view: float | None = None
    """degrees across the longer side of the picture, where known"""
    frame_seconds: float = 1800.0
    """s that one frame may take, the loading of the weights with the first"""
    temporary: Path | None = None
    """folder in which job folders are made; None: the system's"""


class GeneratorProcess(Generator):
    """A generator behind the protocol.

    Args:
        card: of the generator.
        choice: how it runs.
    """

    def __init__(self, card: GeneratorCard, choice: ProcessChoice) -> None:
        self.card, self.choice = card, choice

    def generate(self, image: np.ndarray, mask: np.ndarray, frame: int) -> tuple[Gaussians, PinholeCamera]:
        """One body; raises as `bodies`."""
        return next(iter(self.bodies([Picture(frame, image, mask)])))[1:]

    def bodies(self, pictures: Iterable[Picture]) -> Iterator[tuple[int, Gaussians, PinholeCamera]]:
        """Frame, body and camera, each as soon as it is there: what came before a breakdown is not lost.

        Raises:
            MissingPackage: no such Python, or packages that it lacks.
            GeneratorFailed: a crash (with the last lines of its log), too little memory, too long, or a result that is
                no body.
        """
        pictures = list(pictures)
        folder = Path(tempfile.mkdtemp(prefix="fluidlift-generator-", dir=self.choice.temporary))
        process = None
        try:
            self._write_job(folder, pictures)
            process = self._started(folder)
            for picture in pictures:
                self._wait_for(picture.frame, folder, process)
                gaussians, camera = self._taken(picture, folder)
                yield picture.frame, gaussians, camera
        finally:  # also when the caller stops asking, or is stopped itself
            if process is not None:
                end_group(process)
            shutil.rmtree(folder, ignore_errors=True)

    def _write_job(self, folder: Path, pictures: list[Picture]) -> None:
        from fluidlift.io.images import write_png

        names = []
        for p in pictures:
            image, mask = f"{p.frame:04d}.image.png", f"{p.frame:04d}.mask.png"
            write_png(folder / image, p.image)
            write_png(folder / mask, np.repeat(np.where(p.mask, 255, 0).astype(np.uint8)[..., None], 3, axis=2))
            names.append({"frame": p.frame, "image": image, "mask": mask})
        c = self.choice
        job = {
            "protocol": PROTOCOL, "generator": self.card.name, "device": c.device, "seed": c.seed,
            "weights": str(Path(c.weights).absolute()) if c.weights and Path(c.weights).exists() else c.weights,
            "allow_download": c.allow_download, "field_of_view": c.field_of_view, "frames": names,
        }  # fmt: skip
        (folder / "job.json").write_text(json.dumps(job), encoding="utf-8")

    def _started(self, folder: Path) -> subprocess.Popen:
        c = self.choice
        # a symbolic link to the base Python is what makes a virtual environment: the path stays as it is
        command = [str(c.python), str(c.runner.absolute()), str(folder), str(PACKAGE)]
        with (folder / "log.txt").open("wb") as log:
            try:
                return subprocess.Popen(
                    command, cwd=folder, env=environment(self.card, c), stdin=subprocess.DEVNULL, stdout=log,
                    stderr=subprocess.STDOUT, start_new_session=True,
                )  # fmt: skip
            except OSError as error:
                raise no_python(c.python, error) from None

    def _wait_for(self, frame: int, folder: Path, process: subprocess.Popen) -> None:
        """Until the camera of a frame is there, which is written last."""
        done, log, began = folder / f"{frame:04d}.json", folder / "log.txt", time.monotonic()
        while not done.exists():
            if process.poll() is not None:
                if done.exists():
                    return
                raise self._broken(frame, folder, process.returncode)
            if time.monotonic() - began > self.choice.frame_seconds:
                end_group(process)
                raise GeneratorFailed(
                    f"{self.card.title} took longer than {self.choice.frame_seconds:g} s for frame {frame} and was "
                    f"stopped. Needed: {self.card.hardware}. Do: allow more with --set generate.frame_seconds=..., or "
                    f"take a faster device. {_said(log)}"
                )
            if log.stat().st_size > LARGEST_LOG:
                end_group(process)
                raise GeneratorFailed(f"{self.card.title} wrote more than {LARGEST_LOG} bytes of log and was stopped")
            time.sleep(POLL)

    def _broken(self, frame: int, folder: Path, code: int) -> FluidliftError:
        """Why the process ended without the body of a frame."""
        status, log, card = read_status(folder), folder / "log.txt", self.card
        kind, message = status.get("kind", ""), str(status.get("message", ""))[:600]
        # a process that could not say more: the system kills what takes too much memory
        if kind == "memory" or (not kind and (code == -signal.SIGKILL or out_of_memory(_tail(log)))):
            said = message or ("the system stopped it, most often for lack of memory" if code < 0 else "")
            return GeneratorFailed(
                f"{card.title} ran out of memory at frame {frame}{': ' + said if said else ''}. Needed: "
                f"{card.hardware}. Do: close other programs on the device, name another with --set "
                "generate.device=..., or take a smaller generator (fluidlift generators)."
            )
        if kind == "missing":
            return MissingPackage(
                f"{card.title} is not installed in {self.choice.python} ({message}). Needed: "
                f"{', '.join(card.packages)}. Do: fluidlift generators {card.name} shows the commands."
            )
        if kind == "rejected":
            return GeneratorFailed(f"{card.title} refused frame {frame}: {message}")
        if status.get("state") == "done":
            return GeneratorFailed(
                f"{card.title} ended without a body of frame {frame}. Needed: {frame:04d}.ply and {frame:04d}.json. "
                f"Do: check the runner '{self.choice.runner.name}'. {_said(log)}"
            )
        how = f"signal {-code}" if code < 0 else f"exit code {code}"
        return GeneratorFailed(
            f"{card.title} broke down at frame {frame} ({how}{', ' + message if message else ''}). Do: "
            f"fluidlift generators {card.name} --python {self.choice.python} checks its environment; the same command "
            f"then goes on from the last finished frame. {_said(log)}"
        )

    def _taken(self, picture: Picture, folder: Path) -> tuple[Gaussians, PinholeCamera]:
        """The body and camera of a frame, looked at."""
        return read_body(folder, picture, self.card.title)


def foreign_environment() -> dict[str, str]:
    """Ours for another Python: without what is about our own."""
    return {k: v for k, v in os.environ.items() if k not in _OURS}


def environment(card: GeneratorCard, choice: ProcessChoice) -> dict[str, str]:
    """Ours without what is about our own Python, with what the generator needs; PYTHONPATH is the user's doing."""
    found = foreign_environment() | dict(card.environment) | {"PYTHONUNBUFFERED": "1"}
    found |= _code_first(choice.code)
    if not choice.allow_download:
        found |= {"HF_HUB_OFFLINE": "1", "TRANSFORMERS_OFFLINE": "1"}
    return found


def _code_first(code: Path | None) -> dict[str, str]:
    """PYTHONPATH with a checkout before what the user has there."""
    if code is None:
        return {}
    rest = os.environ.get("PYTHONPATH")
    return {"PYTHONPATH": os.pathsep.join([str(code.absolute()), *([rest] if rest else [])])}


def no_python(python: Path, error: OSError) -> MissingPackage:
    """The error for an interpreter that does not start."""
    return MissingPackage(
        f"'{python}' does not start ({error.strerror or error}). Needed: the Python of the environment in which the "
        "generator is installed. Do: name it with --generator-python, such as ~/envs/trellis/bin/python."
    )


def end_group(process: subprocess.Popen) -> None:
    """End a process and all that it started."""
    for sign, wait in ((signal.SIGTERM, GRACE), (signal.SIGKILL, GRACE)):
        with suppress(ProcessLookupError, PermissionError):
            os.killpg(process.pid, sign)  # its session is its own: the group has its number, even after its end
        if process.poll() is None:
            with suppress(subprocess.TimeoutExpired):
                process.wait(wait)
        until = time.monotonic() + PASSING
        while _group_alive(process.pid) and time.monotonic() < until:  # its children end a little after the sign
            time.sleep(0.02)
        if not _group_alive(process.pid):
            return


def _group_alive(group: int) -> bool:
    try:
        os.killpg(group, 0)
    except (ProcessLookupError, PermissionError):
        return False
    return True


def read_body(folder: Path, picture: Picture, title: str) -> tuple[Gaussians, PinholeCamera]:
    """`####.ply` and `####.json` of a picture, believed only where they are a body that the camera sees at the fluid.

    Raises:
        GeneratorFailed: they are not.
    """
    from fluidlift.io.images import read_camera
    from fluidlift.io.limits import require_size
    from fluidlift.io.ply import read_gaussians

    height, width = picture.mask.shape
    name = f"{picture.frame:04d}"
    try:
        for file, most in ((folder / f"{name}.ply", LARGEST_PLY), (folder / f"{name}.json", LARGEST_JSON)):
            if file.is_symlink() or not file.is_file():
                raise InputRejected(f"no file '{file.name}'", "a plain file")
            require_size(file, most, file.name)
        gaussians = read_gaussians(folder / f"{name}.ply")
        camera = read_camera(folder / f"{name}.json", (width, height))
    except (InputRejected, ValueError, TypeError, OSError) as error:
        raise GeneratorFailed(
            f"{title} handed over something that is no body of frame {picture.frame}: {error}"
        ) from None
    require_visible(gaussians, camera, picture, title)
    return gaussians, camera


FEWEST = 100
"""Gaussians that can be seen: fewer are no body"""
FAINT = 0.02
"""opacity: what is fainter cannot be seen"""
COVERED = 0.3
"""share of the fluid's pixels that a body must cover at least"""


def require_visible(gaussians: Gaussians, camera: PinholeCamera, picture: Picture, title: str) -> None:
    """Raise `GeneratorFailed` for a body that is empty, not finite, or not where the fluid is in the picture."""
    from fluidlift.shape.external_body import near_and_far

    g, where = gaussians, f"of frame {picture.frame}"
    fields = (g.means, g.quats, g.scales, g.opacities, g.sh)
    if not all(np.isfinite(a).all() for a in fields) or not np.isfinite(camera.camera_from_world.translation).all():
        raise GeneratorFailed(f"{title} made a body {where} with numbers that are not finite. Do: try another seed.")
    seen = int((g.opacities > FAINT).sum())
    if seen < FEWEST or float(np.ptp(g.means, axis=0).max()) <= 0:
        raise GeneratorFailed(
            f"{title} made an empty body {where} ({seen} of {len(g)} Gaussians can be seen). Needed: at least "
            f"{FEWEST}. Do: check the mask, start at a frame where the fluid is larger (--start), try another --seed, "
            "or leave out --generator."
        )
    try:
        near_and_far(g, camera, picture.mask)
    except InputRejected as error:
        raise GeneratorFailed(
            f"{title} made a body {where} that its camera does not show where the fluid is ({error.got}). Do: check "
            "the mask, try another --seed, or leave out --generator."
        ) from None


def read_status(folder: Path) -> dict[str, Any]:
    """What a runner says of itself; empty where it says nothing that can be understood."""
    path = folder / "status.json"
    try:
        if path.is_symlink() or path.stat().st_size > LARGEST_JSON:
            return {}
        found = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError):
        return {}
    return found if isinstance(found, dict) and found.get("protocol") == PROTOCOL else {}


def out_of_memory(text: str) -> bool:
    """Whether a log ends with too little memory."""
    low = text.lower()
    return any(words in low for words in _MEMORY)


def _tail(log: Path) -> str:
    try:
        with log.open("rb") as file:
            file.seek(max(log.stat().st_size - LAST_BYTES, 0))
            text = file.read().decode("utf-8", "replace")
    except OSError:
        return ""
    lines = [line.rstrip()[:300] for line in text.splitlines() if line.strip()]
    return "\n".join("".join(c for c in line if c.isprintable()) for line in lines[-LAST_LINES:])


def _said(log: Path) -> str:
    text = _tail(log)
    return "Its last lines:\n  " + text.replace("\n", "\n  ") if text else "It said nothing."


def checked_elsewhere(python: Path, code: Path | None, packages: Iterable[str]) -> dict:
    """What `generator_runner --check` finds in another Python: python, missing, gpu, no_gpu.

    Raises:
        MissingPackage: that Python does not start or does not answer.
    """
    card_env = foreign_environment() | _code_first(code)
    command = [str(python), str(RUNNER), "--check", str(PACKAGE), *packages]
    try:
        done = subprocess.run(
            command, env=card_env, stdin=subprocess.DEVNULL, capture_output=True, timeout=120.0, check=False
        )
        found = json.loads(done.stdout.decode("utf-8", "replace").strip().splitlines()[-1])
        return {k: found[k] for k in ("python", "missing", "gpu", "no_gpu")}
    except OSError as error:
        raise no_python(python, error) from None
    except (subprocess.TimeoutExpired, ValueError, IndexError, KeyError, TypeError):
        raise MissingPackage(
            f"'{python}' gives no answer. Needed: a Python of version 3.10 or newer. Do: check --generator-python."
        ) from None
