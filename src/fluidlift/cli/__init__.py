"""The command line: parse, call, show.

Exit codes: 0 done, 1 failed, 2 usage, 3 input rejected, 4 done with warnings, 143 told to end by SIGTERM.
"""

from __future__ import annotations

import contextlib
import dataclasses
import difflib
import json
import os
import shlex
import signal
import sys
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import tyro

from fluidlift import __version__
from fluidlift.cli.batch import Batch
from fluidlift.cli.edit import Edit
from fluidlift.cli.failure import failure_line
from fluidlift.cli.models import Models
from fluidlift.cli.optional import REGISTRY
from fluidlift.cli.options import (
    MOVED,
    Demo,
    Doctor,
    Evaluate,
    Export,
    Fit,
    Generators,
    Hints,
    Inspect,
    Make,
    Mask,
    Motion,
    Render,
    Sim,
    Validate,
)
from fluidlift.cli.studio import Studio
from fluidlift.cli.view import View
from fluidlift.errors import FluidliftError, InputRejected
from fluidlift.farm.guard import end_with_parent
from fluidlift.kernels import compiling_beside
from fluidlift.messages import VisibleOutput, as_plain, visible
from fluidlift.progress import Interrupted, interrupted, shown_progress

__all__ = ["main"]

Command = (
    Make
    | Batch
    | Edit
    | Sim
    | Studio
    | View
    | Render
    | Export
    | Fit
    | Inspect
    | Hints
    | Mask
    | Motion
    | Evaluate
    | Validate
    | Demo
    | Generators
    | Models
    | Doctor
)
DONE, FAILED, USAGE, REJECTED, WITH_WARNINGS = 0, 1, 2, 3, 4
TERMINATED = 128 + signal.SIGTERM
"""what a process that SIGTERM ended is expected to exit with"""


def main(argv: list[str] | None = None) -> int:
    """Run one command; the exit code."""
    end_with_parent()
    try:
        with _interruptible() as terminated:
            code = _run(list(sys.argv[1:] if argv is None else argv))
            code = TERMINATED if terminated.is_set() else code
        sys.stdout.flush()
        return code
    except BrokenPipeError:  # who reads along, such as head, has seen enough; what is buffered goes nowhere
        with contextlib.suppress(OSError, ValueError):
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return FAILED


@contextlib.contextmanager
def _interruptible() -> Iterator[threading.Event]:
    """SIGTERM, which schedulers and containers send, ends a run as Ctrl-C does: what is finished is kept, and said.
    Gives what is set once it came. Both are remembered until the run has ended (`progress.interrupted`)."""
    terminated = threading.Event()
    usual = {signal.SIGINT: signal.default_int_handler, signal.SIGTERM: signal.SIG_DFL}
    if threading.current_thread() is not threading.main_thread():
        usual = {}
    ours = {number: handler for number, handler in usual.items() if signal.getsignal(number) == handler}

    def interrupt(number: int, frame: Any) -> None:
        interrupted.set()
        if number == signal.SIGTERM:
            terminated.set()
        raise Interrupted

    for number in ours:
        signal.signal(number, interrupt)
    try:
        yield terminated
    finally:
        interrupted.clear()
        for number, handler in ours.items():
            signal.signal(number, handler)


def _run(args: list[str]) -> int:
    if args in (["--version"], ["-V"]):
        print(f"fluidlift {__version__}")
        return DONE
    if args and (meant := _meant(args[0])):
        print(f"fluidlift: there is no command '{args[0][:40]}'. Do: {' or '.join(meant)}", file=sys.stderr)
        return USAGE
    if args[:1] == ["make"]:
        args = _as_settings(args)
    with REGISTRY:
        command = tyro.cli(
            Command,  # type: ignore[arg-type]
            args=args,
            prog="fluidlift",
            description="Lift a fluid out of a single-view video: an editable, simulation-ready 3D asset.",
            config=(tyro.conf.FlagCreatePairsOff, tyro.conf.OmitSubcommandPrefixes),
        )
    try:
        with contextlib.redirect_stdout(VisibleOutput(sys.stdout)):
            return _COMMANDS[type(command)](command)
    except InputRejected as error:
        print(f"fluidlift: {visible(str(error))}", file=sys.stderr)
        return REJECTED
    except FluidliftError as error:
        print(f"fluidlift: {visible(str(error))}", file=sys.stderr)
        return FAILED
    except KeyboardInterrupt:
        print(
            "\nfluidlift: stopped. Finished stages and frames are kept: the same command goes on from there.",
            file=sys.stderr,
        )
        return FAILED
    except BrokenPipeError:
        raise
    except Exception as error:
        print(visible(failure_line(error, args)), file=sys.stderr)
        return FAILED


def _meant(word: str) -> list[str]:
    """The commands that a word which is none looks like; none for a command or an option."""
    names = [command.__name__.lower() for command in _COMMANDS]
    if word in names or word.startswith("-"):
        return []
    alike = difflib.get_close_matches(word.lower(), names, n=2)
    return [f"fluidlift {name}" for name in sorted(alike, key=lambda name: not name.startswith(word))]


def _make(c: Make) -> int:
    if c.part.shots is None or c.settings.print_config:
        return _make_one(c)
    from fluidlift.cli.shots import make_each

    return make_each(c, c.out or default_folder(c.clip), _config_of(c)[0].read, _make_one)


def _config_of(c: Make) -> tuple[Any, Any]:
    """The settings of a make, and its hints."""
    from fluidlift.config import build_config

    s, p, q, b = c.scene, c.part, c.quality, c.body
    flat = {
        "seed": q.seed, "shape.kind": s.kind, "shape.size": s.size, "shape.fov": s.fov, "shape.pitch": s.pitch,
        "shape.roll": s.roll, "read.start": p.start, "read.duration": p.duration, "read.fps": p.fps,
        "read.max_size": q.max_size, "depth.model": b.depth_model, "depth.weights": text_of(b.depth_weights),
        "generate.name": b.generator, "generate.python": text_of(b.generator_python),
        "generate.code": text_of(b.generator_code), "generate.accept_licence": b.accept_licence or None,
        "generate.use": b.use,
    }  # fmt: skip
    hints = _read_hints(c.input.hints, c.clip)
    return build_config(q.preset, c.settings.config, c.settings.set, flat, base=dict(hints.settings)), hints


def _make_one(c: Make) -> int:
    config, hints = _config_of(c)
    b = c.body
    files = {"mask": c.input.mask, "depth": c.input.depth, "geometry": b.geometry_from, "flow": c.input.flow}
    config = _with_models(config, c.clip, b.models, files | {"camera": c.input.camera})
    if c.settings.print_config:
        import yaml

        print(yaml.safe_dump(config.to_dict(), sort_keys=False), end="")
        return DONE
    if config.generate.name is not None:
        from fluidlift.cli.generators import accepted_by_asking

        config = accepted_by_asking(config)
    code = _run_job(
        c.clip, c.out or default_folder(c.clip), config, camera=c.input.camera, hints=hints, force=c.settings.force,
        as_json=c.json, **files,
    )  # fmt: skip
    return DONE if c.warnings_ok and code == WITH_WARNINGS else code


def _with_models(
    config: Any, clip: Path, asked: str | None, files: dict[str, Path | None], places: tuple[str, ...] | None = None
) -> Any:
    """The settings of a job on these files with the models of `--models`, which are told; as they are without it."""
    if asked is None:
        return config
    from fluidlift.pipeline import Inputs
    from fluidlift.pipeline.models import PLACES, with_models

    chosen = with_models(config, Inputs(clip, **files), asked, places=places or PLACES)
    for line in chosen.told:
        print(f"models: {line}", file=sys.stderr)
    return chosen.config


def _read_hints(file: Path | None, clip: Path) -> Any:
    """The hints of a file, which must be of this clip; none where there is no file."""
    from fluidlift.types.hints import NOTHING_SAID

    if file is None:
        return NOTHING_SAID
    from fluidlift.io.hints_file import read_hints, require_same_clip
    from fluidlift.io.sequences import is_sequence

    hints = read_hints(file)
    if clip.exists() or is_sequence(clip):  # that it is not there is said where the clip is read
        require_same_clip(hints, clip, file.name)
    return hints


def _hints(c: Hints) -> int:
    from fluidlift.cli.hints import run

    return run(c)


def _as_settings(args: list[str]) -> list[str]:
    """The arguments of `make`, with options that became settings (`MOVED`) as `--set`."""
    found, rest = [], iter(args)
    for arg in rest:
        name, sign, value = arg.partition("=")
        setting = MOVED.get(name.removeprefix("--").replace("-", "_")) if name.startswith("--") else None
        if setting is None:
            found.append(arg)
            continue
        value = value if sign else next(rest, None)
        found += ["--set", f"{setting}={value}"] if value is not None else [arg]
    return found


def text_of(path: Path | None) -> str | None:
    """For a setting."""
    return None if path is None else str(path)


def default_folder(clip: Path) -> Path:
    """The clip's name with .fluid, in the current folder; a pattern takes the name of the folder it is in."""
    pattern = "%" in clip.name or "#" in clip.name
    name = clip.absolute().parent.name if pattern else clip.stem
    return Path((name or "clip") + ".fluid")


def _run_job(
    clip: Path, out: Path, config: Any, *, hints: Any = None, force=(), as_json=False, **files: Path | None
) -> int:
    with shown_progress() as progress, compiling_beside(progress.say):
        from fluidlift.pipeline import Inputs, make
        from fluidlift.types.hints import NOTHING_SAID

        said = hints or NOTHING_SAID
        made = make(Inputs(clip, **files), out, config, hints=said, force=force, progress=progress)
    return _tell(made, as_json)


def _tell(made: Any, as_json: bool) -> int:
    from fluidlift.io.asset_folder import read_manifest
    from fluidlift.pipeline import card_of

    card = card_of(read_manifest(made.folder))
    if as_json:
        found = {"none": card} if isinstance(card, str) else card.to_dict()
        print(json.dumps({"asset": str(made.folder), "seconds": made.seconds, "frames": made.frames,
                          "as_filmed": found, "stages": made.timings} | as_plain(made.warnings),
                         indent=1))  # fmt: skip
    else:
        print(f"done in {made.seconds:.0f} s")
        for text, name in (("asset", ""), ("preview", "preview.mp4"), ("report", "report.html")):
            if (made.folder / name).exists():
                print(f"  {text:8} {made.folder / name}")
        print(f"  look at  fluidlift view {shlex.quote(str(made.folder))}")
        print(f"as filmed: not measured, {card}" if isinstance(card, str) else card.sentence())
    return WITH_WARNINGS if made.warnings else DONE


def _fit(c: Fit) -> int:
    from fluidlift.pipeline import refit

    flat = {
        "fit.method": c.method, "fit.free": c.free, "fit.hold": c.hold or None,
        "fit.restarts": c.restarts, "fit.max_seconds": c.max_seconds,
    }  # fmt: skip
    with shown_progress() as progress:
        found = refit(c.asset, overrides=c.set, flat=flat, progress=progress)
    if c.json:
        print(json.dumps({"asset": str(found.folder), "seconds": found.seconds, "status": found.status,
                          "reason": found.reason, "parameters": found.rows, "notes": found.notes}
                         | as_plain(found.warnings), indent=1))  # fmt: skip
    else:
        print("\n".join(found.lines()))
    return WITH_WARNINGS if found.warnings else DONE


def _sim(c: Sim) -> int:
    from fluidlift.scene import SimulationRequest

    request = SimulationRequest(c.duration, c.fps, c.extend_downstream, c.meshes, c.resume, c.restart)
    flat = {"seed": c.seed, "simulate.checkpoint_every": c.checkpoint_every}
    with shown_progress() as progress, compiling_beside(progress.say):
        from fluidlift.pipeline import resimulate

        made = resimulate(c.asset, request=request, overrides=c.set, flat=flat, progress=progress)
    return _tell(made, c.json)


def _batch(c: Batch) -> int:
    from fluidlift.cli.batch import run

    return run(c)


def _edit(c: Edit) -> int:
    from fluidlift.cli.edit import run

    return run(c)


def _studio(c: Studio) -> int:
    from fluidlift.cli.studio import run

    return run(c)


def _view(c: View) -> int:
    from fluidlift.cli.view import run

    return run(c)


def _render(c: Render) -> int:
    from fluidlift.pipeline import RenderRequest, render_asset

    request = RenderRequest(
        c.view, _pair(c.size, "x", "--size", "1920x1080"), _pair(c.frames, "-", "--frames", "1001-1024"),
        c.background, c.format, c.look, c.material, c.environment, c.exposure, c.engine, c.samples,
        draft=c.draft,
    )  # fmt: skip
    with shown_progress() as progress:
        return _print_result(render_asset(c.asset, c.out, request, progress=progress), c.json)


def _export(c: Export) -> int:
    from fluidlift.export import ExportRequest, export_asset

    frames = _pair(c.frames, "-", "--frames", "1001-1024")
    request = ExportRequest(c.to, c.up_axis, c.meters_per_unit, frames, c.fps)
    with shown_progress() as progress:
        return _print_result(export_asset(c.asset, c.out, request, progress=progress), c.json)


def _pair(text: str | None, mark: str, option: str, example: str) -> tuple[int, int] | None:
    """Two whole numbers with a mark between them."""
    if text is None:
        return None
    parts = text.lower().split(mark)
    if len(parts) != 2 or not all(p.strip().isdecimal() for p in parts):
        raise InputRejected(f"{option} '{text}'", f"two numbers, such as {example}")
    return int(parts[0]), int(parts[1])


def _inspect(c: Inspect) -> int:
    from fluidlift.cli.inspect import run

    return WITH_WARNINGS if run(c) else DONE


LONGEST = {"read.max_frames": 20_000}
"""of commands whose memory does not grow with the clip"""


def _require_sections(overrides: tuple[str, ...], sections: tuple[str, ...]) -> None:
    """Raise `InputRejected` for a setting that would change nothing here."""
    from fluidlift.config import JobConfig

    for text in overrides:
        section = text.partition("=")[0].strip().partition(".")[0]
        if section in vars(JobConfig()) and section not in sections:
            raise InputRejected(
                f"--set {text}, which changes nothing here", f"a setting of {', '.join(sections)}", "leave it out"
            )


def _mask(c: Mask) -> int:
    from fluidlift.config import build_config
    from fluidlift.pipeline import Inputs, MaskHints, find_masks

    p = c.part
    flat = {
        "read.start": p.start, "read.duration": p.duration, "read.fps": p.fps, "read.max_size": c.max_size,
        "generate.use": c.learned.use,
    }  # fmt: skip
    _require_sections(c.set, ("read", "segment", "motion"))
    config = build_config(None, None, c.set, flat, base=LONGEST)
    config = _with_models(config, c.clip, c.learned.models, {}, ("masks", "flow"))
    hints = MaskHints.of(c.roi, c.click, c.not_here)
    with shown_progress() as progress:
        found = find_masks(
            Inputs(c.clip, camera=c.camera), c.out, config, hints=hints, force=c.force, progress=progress
        )
    return _print_result(found, c.json)


def _motion(c: Motion) -> int:
    from fluidlift.config import build_config
    from fluidlift.pipeline import Inputs, MotionFiles, measure_motion

    s, p = c.scene, c.part
    flat = {
        "shape.kind": s.kind, "shape.size": s.size, "shape.fov": s.fov, "shape.pitch": s.pitch, "shape.roll": s.roll,
        "read.start": p.start, "read.duration": p.duration, "read.fps": p.fps, "read.max_size": c.max_size,
        "generate.use": c.learned.use,
    }  # fmt: skip
    _require_sections(c.set, ("read", "segment", "shape", "depth", "view", "motion"))
    config = build_config(None, c.config, c.set, flat, base=LONGEST)
    files = {"mask": c.input.mask, "depth": c.input.depth, "flow": c.input.flow}
    config = _with_models(config, c.clip, c.learned.models, files | {"camera": c.input.camera})
    inputs = Inputs(c.clip, camera=c.input.camera, **files)
    with shown_progress() as progress:
        found = measure_motion(
            inputs, c.out, config, files=MotionFiles(c.format, c.raw), force=c.force, progress=progress
        )
    return _print_result(found, c.json)


def _print_result(found: Any, as_json: bool) -> int:
    """What a command that writes files for other tools has found."""
    print(json.dumps(found.to_dict(), indent=1) if as_json else "\n".join(found.lines()))
    return WITH_WARNINGS if found.warnings else DONE


def _evaluate(c: Evaluate) -> int:
    if c.truth is not None and (c.clip is not None or c.start is not None):
        raise InputRejected("--truth with --clip or --start", "one of them: a case, or other footage")
    if c.start is not None and c.clip is None:
        raise InputRejected(f"--start {c.start:g} without --clip", "the footage that it is a time of")
    if c.truth is None:
        return _evaluate_as_filmed(c)
    from fluidlift.evaluate import evaluate_asset

    found = evaluate_asset(c.asset, c.truth)
    if c.json:
        print(found.to_json())
        return DONE
    rows = found.table()
    width = max(len(row[0]) for row in rows)
    for name, value, unit, note in rows:
        print(f"{name:{width}}  {value:>10} {unit:9} {note}".rstrip())
    return DONE


def _evaluate_as_filmed(c: Evaluate) -> int:
    """The asset's own card, or one against other footage."""
    from fluidlift.io.asset_folder import read_manifest

    manifest = read_manifest(c.asset)  # before the heavy packages: a wrong name is told at once
    from fluidlift.evaluate.as_filmed import HEADER
    from fluidlift.pipeline import card_against, card_of

    if c.clip is None:
        card = card_of(manifest)
        if isinstance(card, str):
            why, _, do = card.rpartition(": ")  # such as "the scene is edited (loop): run ..."
            what = f"'{c.asset.name}' was not held against its clip" + f": {why}" * bool(why)
            raise InputRejected(what, "frames as they were filmed", do)
    else:
        with shown_progress() as progress:
            card = card_against(c.asset, c.clip, start=c.start or 0.0, progress=progress)
    if c.json:
        print(json.dumps(card.to_dict(), indent=1))
    else:
        rows = [HEADER, *card.rows()]
        width = [max(len(row[k]) for row in rows) for k in range(len(HEADER))]
        for row in rows:
            print("  ".join(cell.ljust(w) for cell, w in zip(row, width)).rstrip())
        print("\n".join([card.sentence(), *card.notes, *card.advice]))
    return WITH_WARNINGS if card.warning() else DONE


def _validate(c: Validate) -> int:
    from fluidlift.validate import validate_asset

    findings = validate_asset(c.asset)
    if c.json:
        print(json.dumps([dataclasses.asdict(f) for f in findings], indent=1))
    else:
        for f in findings:
            print(f.line())
    return DONE if all(f.passed for f in findings) else FAILED


def _demo(c: Demo) -> int:
    from importlib import resources

    from fluidlift.config import build_config

    data = resources.files("fluidlift.synthetic") / "data"
    with resources.as_file(data / "demo.mp4") as clip, resources.as_file(data / "demo_camera.json") as camera:
        return _run_job(clip, c.out, build_config("draft"), camera=camera)


def _generators(c: Generators) -> int:
    from fluidlift.cli.generators import show

    return show(c)


def _models(c: Models) -> int:
    from fluidlift.cli.models import run

    return run(c)


def _doctor(c: Doctor) -> int:
    from fluidlift.doctor import examine

    if c.compile:
        from fluidlift.kernels import compile_all, compiled

        with shown_progress() as progress:
            if not compiled():
                progress.stage("compile", 1, 1)
                compile_all(told=progress.update)
        return DONE

    found = examine()
    if c.json:
        print(json.dumps(found, indent=1))
    else:
        for name, value in found.items():
            print(f"{name:24} {value}")
    return DONE


_COMMANDS = {
    Make: _make, Batch: _batch, Fit: _fit, Sim: _sim, Edit: _edit, Studio: _studio, View: _view, Render: _render,
    Export: _export, Inspect: _inspect, Hints: _hints, Mask: _mask, Motion: _motion, Evaluate: _evaluate,
    Validate: _validate, Demo: _demo, Generators: _generators, Models: _models, Doctor: _doctor,
}  # fmt: skip
