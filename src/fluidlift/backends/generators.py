"""Third-party generators by name: which there are, whether they can run here, and how they are made."""

from __future__ import annotations

import importlib
import importlib.util
import os
import platform
import sys
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from fluidlift.backends.generator_card import GeneratorCard
from fluidlift.backends.registry import class_of, module_name, names
from fluidlift.errors import FluidliftError, InputRejected

if TYPE_CHECKING:
    from fluidlift.backends.generator_process import Picture
    from fluidlift.seams import Generator
    from fluidlift.types import Gaussians, PinholeCamera

GENERATORS = names("generator")


@dataclass(frozen=True)
class GeneratorChoice:
    """Which generator, where it runs, and what the user has agreed to."""

    name: str
    python: Path | None = None
    """of the environment in which it is installed; None: this one"""
    code: Path | None = None
    """folder of its own code, where it is a checkout"""
    runner: Path | None = None
    """a script of the user's own that speaks the protocol of `generator_runner`; None: ours"""
    weights: str | None = None
    """file or folder; None: what it takes from the hub's cache"""
    device: str = "auto"
    """cpu, cuda, cuda:1; auto: the first GPU, where there is one"""
    seed: int = 0
    allow_download: bool = False
    field_of_view: float | None = None
    """degrees across the longer side of the picture, where known"""
    frame_seconds: float = 1800.0
    """s that one frame may take in a process of its own"""

    @property
    def apart(self) -> bool:
        """Whether it runs in a process of its own."""
        return self.python is not None or self.runner is not None


@dataclass(frozen=True)
class Readiness:
    """What a generator finds on this machine."""

    name: str
    where: str
    """"this environment", or the Python that was looked at"""
    python: str = ""
    """version"""
    missing: tuple[str, ...] = ()
    """packages"""
    gpu: str | None = None
    """its name; None: none is seen"""
    no_gpu: str = ""
    """why none is seen"""
    needs_gpu: bool = True
    weights_found: tuple[str, ...] = ()
    weights_missing: tuple[str, ...] = ()
    """of the caches on this machine; they can be fetched where that is allowed"""
    problem: str = ""
    """why nothing could be looked at"""

    @property
    def installed(self) -> bool:
        """Whether all packages are there."""
        return not self.missing and not self.problem

    @property
    def ready(self) -> bool:
        """Whether it can be expected to run without anything else being fetched."""
        return self.installed and (self.gpu is not None or not self.needs_gpu) and not self.weights_missing

    def sentence(self) -> str:
        """In a few words."""
        if self.problem:
            return self.problem
        if self.missing:
            return "not installed (missing: " + ", ".join(self.missing) + ")"
        if self.needs_gpu and self.gpu is None:
            return f"installed, but it needs a GPU ({self.no_gpu})"
        if self.weights_missing:
            return "installed; weights not on this machine: " + ", ".join(self.weights_missing)
        return "ready"

    def to_dict(self) -> dict[str, Any]:
        """Plain data for --json."""
        return asdict(self) | {"installed": self.installed, "ready": self.ready}


def require_known(name: str) -> str:
    """The name, if there is such a generator.

    Raises:
        InputRejected: there is none.
    """
    if name not in GENERATORS:
        raise InputRejected(
            f"unknown generator '{name}'", "one of " + ", ".join(GENERATORS), "see fluidlift generators"
        )
    return name


def _adapter(name: str) -> Any:
    return importlib.import_module(module_name("generator", require_known(name)))


def card_of(name: str) -> GeneratorCard:
    """Facts about a generator; needs none of its packages.

    Raises:
        InputRejected: there is none of that name.
    """
    return _adapter(name).CARD


def generator_class(name: str) -> Any:
    """The class of a generator that runs in this process: `InProcessGenerator` with its card and `knows_up`.

    Raises:
        InputRejected: there is none of that name.
    """
    return class_of("generator", require_known(name))


def make_generator(choice: GeneratorChoice) -> Generator:
    """A generator that is ready to be asked; the weights are loaded with the first picture.

    Raises:
        InputRejected: there is none of that name, or a script or folder is not there.
    """
    card = card_of(choice.name)
    for what, path in (("--generator-python", choice.python), ("--generator-code", choice.code),
                       ("generate.runner", choice.runner)):  # fmt: skip
        if path is not None and not path.exists():
            raise InputRejected(f"{what} '{path}' is not there", "an existing path", "check it")
    if choice.apart:
        from fluidlift.backends.generator_process import RUNNER, GeneratorProcess, ProcessChoice

        device = "cuda" if choice.device == "auto" and card.needs_gpu else choice.device
        if device == "auto":
            device = "cuda" if check(choice.name, choice).gpu is not None else "cpu"
        return GeneratorProcess(
            card,
            ProcessChoice(
                choice.python or Path(sys.executable), choice.runner or RUNNER, choice.code, device, choice.seed,
                choice.weights, choice.allow_download, choice.field_of_view, choice.frame_seconds,
            ),
        )  # fmt: skip
    from fluidlift.backends.generator_loading import RunChoice

    run = RunChoice(
        weights=choice.weights, device=_device(choice), seed=choice.seed, allow_download=choice.allow_download,
        field_of_view=choice.field_of_view, announce=lambda line: None,
    )  # fmt: skip
    return generator_class(choice.name)(run)


def _device(choice: GeneratorChoice) -> str:
    return choice.device if choice.device != "auto" else ("cuda" if _gpu()[0] is not None else "cpu")


def bodies(
    generator: Generator, choice: GeneratorChoice, pictures: Sequence[Picture]
) -> Iterator[tuple[int, Gaussians, PinholeCamera]]:
    """Frame, body and camera, one after the other, each looked at.

    Raises:
        FluidliftError: the generator failed: crash, time, memory, or a body that is none.
        MissingPackage: it is not installed.
    """
    from fluidlift.backends.generator_process import GeneratorFailed, GeneratorProcess, require_visible

    if isinstance(generator, GeneratorProcess):
        yield from generator.bodies(pictures)
        return
    card = card_of(choice.name)
    for picture in pictures:
        try:
            with with_code(choice.code), _with_environment(card):
                gaussians, camera = generator.generate(picture.image, picture.mask, picture.frame)
        except FluidliftError:
            raise
        except Exception as error:  # whatever a third party raises: the work done so far is kept
            reason = " ".join(f"{type(error).__name__}: {error}".split())[:600]
            raise GeneratorFailed(
                f"{card.title} broke down at frame {picture.frame} ({reason}). Do: fluidlift generators {card.name} "
                "checks what it needs; the same command then goes on from the last finished frame."
            ) from error
        require_visible(gaussians, camera, picture, card.title)
        yield picture.frame, gaussians, camera


@contextmanager
def with_code(folder: Path | None) -> Iterator[None]:
    """Within, modules are also looked for in a checkout."""
    entry = None if folder is None else str(folder.absolute())
    if entry is not None:
        sys.path.append(entry)
    try:
        yield
    finally:
        if entry is not None and entry in sys.path:
            sys.path.remove(entry)


@contextmanager
def _with_environment(card: GeneratorCard) -> Iterator[None]:
    before = {name: os.environ.get(name) for name, _ in card.environment}
    os.environ.update(dict(card.environment))
    try:
        yield
    finally:
        for name, value in before.items():
            os.environ.pop(name, None)
            if value is not None:
                os.environ[name] = value


def check(name: str, choice: GeneratorChoice | None = None) -> Readiness:
    """What is there of a generator: packages, GPU, weights in the caches of this machine. Nothing is fetched.

    Raises:
        InputRejected: there is none of that name.
    """
    from fluidlift.errors import MissingPackage

    card, choice = card_of(name), choice or GeneratorChoice(name)
    found, lacking = _weights(card, choice.weights)
    facts: dict[str, Any] = {"needs_gpu": card.needs_gpu, "weights_found": found, "weights_missing": lacking}
    if choice.python is not None:
        from fluidlift.backends.generator_process import checked_elsewhere

        try:
            there = checked_elsewhere(choice.python, choice.code, card.packages)
        except MissingPackage as error:
            return Readiness(name, str(choice.python), problem=str(error), **facts)
        missing = tuple(map(str, there["missing"]))
        version, gpu, why = str(there["python"]), there["gpu"], str(there["no_gpu"])
        return Readiness(name, str(choice.python), version, missing, gpu, why, **facts)
    with with_code(choice.code):
        missing = _missing(card.packages)
    gpu, why = _gpu()
    return Readiness(name, "this environment", platform.python_version(), missing, gpu, why, **facts)


def _missing(packages: Iterable[str]) -> tuple[str, ...]:
    lacking = []
    for package in packages:
        try:
            known = importlib.util.find_spec(package) is not None
        except (ImportError, ValueError):
            known = False
        if not known:
            lacking.append(package)
    return tuple(lacking)


def _gpu() -> tuple[str | None, str]:
    """Name and memory of the first GPU, or why there is none."""
    try:
        import torch
    except ImportError:
        return None, "torch is not installed"
    if not torch.cuda.is_available():
        return None, "torch sees none"
    total = torch.cuda.get_device_properties(0).total_memory
    return f"{torch.cuda.get_device_name(0)}, {total / 2**30:.0f} GB", ""


def _weights(card: GeneratorCard, given: str | None) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Weights that lie on this machine, and those that do not."""
    if given is not None:
        return ((given,), ()) if Path(given).exists() else ((), (given,))
    found = [name for name in card.weights if weights_cached(name)]
    return tuple(found), tuple(name for name in card.weights if name not in found)


def weights_cached(name: str) -> bool:
    """Whether weights lie in the cache of the hub ("owner/name" or "owner/name/file"), or of torch (an address)."""
    parts = name.split("/")
    if "." in parts[0] or len(parts) < 2:
        torch_home = os.environ.get("TORCH_HOME", Path(_cache(), "torch"))
        return Path(torch_home, "hub", "checkpoints", parts[-1]).is_file()
    home = Path(os.environ.get("HF_HOME", Path(_cache(), "huggingface")))
    hub = Path(os.environ.get("HF_HUB_CACHE", home / "hub"))
    snapshots = hub / f"models--{parts[0]}--{parts[1]}" / "snapshots"
    if not snapshots.is_dir():
        return False
    rest = Path(*parts[2:]) if len(parts) > 2 else None
    return any((s / rest).is_file() if rest else any(s.iterdir()) for s in snapshots.iterdir() if s.is_dir())


def _cache() -> Path:
    return Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache"))
