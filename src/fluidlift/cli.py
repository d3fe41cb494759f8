"""The command line: parse, call, show.

Exit codes: 0 done, 1 failed, 2 usage, 3 input rejected, 4 done with warnings.
"""

from __future__ import annotations

import contextlib
import dataclasses
import json
import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from fluidlift import __version__
from fluidlift.errors import FluidliftError, InputRejected

DONE, FAILED, USAGE, REJECTED, WITH_WARNINGS = 0, 1, 2, 3, 4

Clip = Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="CLIP")]
Asset = Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="ASSET")]


@dataclass(frozen=True)
class Make:
    """Turn a clip into a fluid asset."""

    clip: Clip
    """a video, a folder of pictures or a pattern such as frames/%04d.png"""
    out: Annotated[Path | None, tyro.conf.arg(aliases=["-o"])] = None
    """asset folder to write; by default the clip's name with .fluid, in the current folder"""
    preset: Literal["draft", "standard", "hero"] | None = None
    """draft (the default): minutes on a laptop; standard: finer; hero: as fine as the machine allows"""
    kind: Literal["auto", "stream", "fall", "pour", "plume"] | None = None
    """what the fluid does; auto decides from evidence that the report shows"""
    mask: Path | None = None
    """where the fluid is: one picture, a folder of pictures or a video; white is fluid"""
    camera: Path | None = None
    """camera JSON: width, height, K, and R, t where the pose is known"""
    depth: Path | None = None
    """depth map of the first used frame (EXR, 16-bit PNG, npz): replaces the estimated front depth"""
    geometry_from: Path | None = None
    """folder of Gaussian PLY files and camera.json: replaces the embedded generator"""
    size: float | None = None
    """metres across the fluid (its longest side); sets the scale"""
    fov: float | None = None
    """field of view across the longer side, degrees; else the file's lens metadata, else 50"""
    pitch: float | None = None
    """degrees that the camera looks below the horizon"""
    roll: float | None = None
    """degrees that the picture is turned clockwise"""
    start: float | None = None
    """seconds into the clip"""
    duration: float | None = None
    """seconds to use"""
    fps: float | None = None
    """frames per second of an image sequence"""
    max_size: int | None = None
    """longer side of the working pictures, px"""
    max_pixels: int | None = None
    """largest source picture accepted, px"""
    max_frames: int | None = None
    """most frames accepted"""
    seed: int | None = None
    """same clip, settings and seed: same asset"""
    config: Path | None = None
    """YAML file with settings"""
    set: tyro.conf.UseAppendAction[tuple[str, ...]] = field(default_factory=tuple)
    """one setting, such as --set fit.max_seconds=60; may be repeated"""
    force: tyro.conf.UseAppendAction[tuple[str, ...]] = field(default_factory=tuple)
    """run this stage and all after it again; may be repeated"""
    print_config: bool = False
    """show the settings and stop"""
    json: bool = False
    """print the outcome as JSON"""


@dataclass(frozen=True)
class Sim:
    """Simulate a finished asset again, with its scene.yaml: longer, other frames, another liquid, obstacles."""

    asset: Asset
    """asset folder"""
    duration: float | None = None
    """seconds; by default what scene.yaml says, else as long as the clip; a longer one continues what is there"""
    fps: float | None = None
    """frames per second; by default those of the clip"""
    extend_downstream: float | None = None
    """metres by which the channel of a stream or a fall goes on behind its outlet"""
    meshes: Path | None = None
    """folder of the mesh files that scene.yaml names; by default the asset"""
    resume: bool = False
    """insist on going on from the checkpoint: without one that fits, stop instead of starting again"""
    restart: bool = False
    """start at the first frame, although a checkpoint fits"""
    checkpoint_every: int | None = None
    """frames between checkpoints (10)"""
    seed: int | None = None
    """of the inflow's variation; by default that of the asset"""
    set: tyro.conf.UseAppendAction[tuple[str, ...]] = field(default_factory=tuple)
    """one setting of simulate or show, such as --set simulate.max_particles=300000; may be repeated"""
    json: bool = False
    """print the outcome as JSON"""


@dataclass(frozen=True)
class Fit:
    """Fit the physical parameters of a finished asset again; fluidlift sim then plays the new values."""

    asset: Asset
    """asset folder, with the work/ folder that make left"""
    method: Literal["lm", "adam"] | None = None
    """lm: Levenberg-Marquardt (the default); adam: as in the paper, slower"""
    free: str | None = None
    """parameters to fit, with commas between them, such as gravity,viscosity; by default all that the clip can tell"""
    hold: tyro.conf.UseAppendAction[tuple[str, ...]] = field(default_factory=tuple)
    """a value that is known, such as --hold viscosity=1e-6; it is not fitted; may be repeated"""
    restarts: int | None = None
    """further fits from other initial values, 4 at most, whose spread is reported"""
    max_seconds: float | None = None
    """s that the fit may take; by default as in make"""
    set: tyro.conf.UseAppendAction[tuple[str, ...]] = field(default_factory=tuple)
    """one setting of fit, such as --set fit.method=adam; may be repeated"""
    json: bool = False
    """print the outcome as JSON"""


@dataclass(frozen=True)
class Inspect:
    """Tell what a clip is, and what would be warned about."""

    clip: Clip
    """a video, a folder of pictures or a pattern"""
    fps: float | None = None
    """frames per second of an image sequence"""
    json: bool = False
    """print as JSON"""


@dataclass(frozen=True)
class Mask:
    """Find the fluid only: write an overlay and the mask, to be corrected and given to make --mask."""

    clip: Clip
    """a video, a folder of pictures or a pattern"""
    out: Annotated[Path, tyro.conf.arg(aliases=["-o"])]
    """folder for mask/####.png and overlay/####.png"""
    fps: float | None = None
    """frames per second of an image sequence"""
    max_size: int = 512
    """longer side of the working pictures, px"""


@dataclass(frozen=True)
class Evaluate:
    """Measure an asset against a case with known truth."""

    asset: Asset
    """asset folder"""
    truth: Path
    """case folder: video, camera.json, truth.npz, scene.json"""
    json: bool = False
    """print as JSON"""


@dataclass(frozen=True)
class Validate:
    """Check an asset: manifest, schema, arrays, USD."""

    asset: Asset
    """asset folder"""
    json: bool = False
    """print as JSON"""


@dataclass(frozen=True)
class Demo:
    """Make an asset from the clip that comes with the package."""

    out: Annotated[Path, tyro.conf.arg(aliases=["-o"])] = Path("demo.fluid")
    """asset folder to write"""


@dataclass(frozen=True)
class Doctor:
    """Tell what is installed and what this machine can do."""

    json: bool = False
    """print as JSON"""


Command = Make | Fit | Sim | Inspect | Mask | Evaluate | Validate | Demo | Doctor


def main(argv: list[str] | None = None) -> int:
    """Run one command; the exit code."""
    args = list(sys.argv[1:] if argv is None else argv)
    if args in (["--version"], ["-V"]):
        print(f"fluidlift {__version__}")
        return DONE
    command = tyro.cli(
        Command,  # type: ignore[arg-type]
        args=args,
        prog="fluidlift",
        description="Lift a fluid out of a single-view video: an editable, simulation-ready 3D asset.",
        config=(tyro.conf.FlagCreatePairsOff, tyro.conf.OmitSubcommandPrefixes),
    )
    try:
        return _COMMANDS[type(command)](command)
    except InputRejected as error:
        print(f"fluidlift: {error}", file=sys.stderr)
        return REJECTED
    except FluidliftError as error:
        print(f"fluidlift: {error}", file=sys.stderr)
        return FAILED
    except KeyboardInterrupt:
        print(
            "\nfluidlift: stopped. Finished stages and frames are kept: the same command goes on from there.",
            file=sys.stderr,
        )
        return FAILED


@contextlib.contextmanager
def _progress():
    from fluidlift.progress import BarProgress, PlainProgress

    if sys.stderr.isatty():
        with BarProgress() as bar:
            yield bar
    else:
        yield PlainProgress()


def _make(c: Make) -> int:
    from fluidlift.config import build_config

    flat = {
        "seed": c.seed, "shape.kind": c.kind, "shape.size": c.size, "shape.fov": c.fov, "shape.pitch": c.pitch,
        "shape.roll": c.roll, "read.start": c.start, "read.duration": c.duration, "read.fps": c.fps,
        "read.max_size": c.max_size, "read.max_pixels": c.max_pixels, "read.max_frames": c.max_frames,
    }  # fmt: skip
    config = build_config(c.preset, c.config, c.set, flat)
    if c.print_config:
        import yaml

        print(yaml.safe_dump(config.to_dict(), sort_keys=False), end="")
        return DONE
    return _run_job(
        c.clip, c.out or default_folder(c.clip), config, mask=c.mask, camera=c.camera, depth=c.depth,
        geometry=c.geometry_from, force=c.force, as_json=c.json,
    )  # fmt: skip


def default_folder(clip: Path) -> Path:
    """The clip's name with .fluid, in the current folder; a pattern takes the name of the folder it is in."""
    pattern = "%" in clip.name or "#" in clip.name
    name = clip.absolute().parent.name if pattern else clip.stem
    return Path((name or "clip") + ".fluid")


def _run_job(clip: Path, out: Path, config: Any, *, force=(), as_json=False, **files: Path | None) -> int:
    from fluidlift.pipeline import Inputs, make

    with _progress() as progress:
        made = make(Inputs(clip, **files), out, config, force=force, progress=progress)
    return _tell(made, as_json)


def _tell(made: Any, as_json: bool) -> int:
    if as_json:
        print(json.dumps({"asset": str(made.folder), "seconds": made.seconds, "frames": made.frames,
                          "warnings": made.warnings, "stages": made.timings}, indent=1))  # fmt: skip
    else:
        print(f"done in {made.seconds:.0f} s")
        for text, name in (("asset", ""), ("preview", "preview.mp4"), ("report", "report.html")):
            print(f"  {text:8} {made.folder / name}")
    return WITH_WARNINGS if made.warnings else DONE


def _fit(c: Fit) -> int:
    from fluidlift.pipeline import refit

    flat = {
        "fit.method": c.method, "fit.free": c.free, "fit.hold": c.hold or None,
        "fit.restarts": c.restarts, "fit.max_seconds": c.max_seconds,
    }  # fmt: skip
    with _progress() as progress:
        found = refit(c.asset, overrides=c.set, flat=flat, progress=progress)
    if c.json:
        print(json.dumps({"asset": str(found.folder), "seconds": found.seconds, "status": found.status,
                          "reason": found.reason, "parameters": found.rows, "notes": found.notes,
                          "warnings": found.warnings}, indent=1))  # fmt: skip
    else:
        print("\n".join(found.lines()))
    return WITH_WARNINGS if found.warnings else DONE


def _sim(c: Sim) -> int:
    from fluidlift.pipeline import SimulationRequest, resimulate

    request = SimulationRequest(c.duration, c.fps, c.extend_downstream, c.meshes, c.resume, c.restart)
    flat = {"seed": c.seed, "simulate.checkpoint_every": c.checkpoint_every}
    with _progress() as progress:
        made = resimulate(c.asset, request=request, overrides=c.set, flat=flat, progress=progress)
    return _tell(made, c.json)


def _inspect(c: Inspect) -> int:
    from fluidlift.io.video import probe

    info = probe(c.clip, fps=c.fps).to_dict()
    if c.json:
        print(json.dumps(info, indent=1, default=str))
        return DONE
    for name, value in info.items():
        if name != "warnings":
            print(f"{name.replace('_', ' '):16} {value}")
    for text in info.get("warnings", ()):
        print(f"warning: {text}")
    return WITH_WARNINGS if info.get("warnings") else DONE


def _mask(c: Mask) -> int:
    import numpy as np

    from fluidlift.io.images import write_png
    from fluidlift.io.video import read_clip
    from fluidlift.motion.optical_flow import estimate_flow
    from fluidlift.shape.segment import overlay, segment

    clip = read_clip(c.clip, max_size=c.max_size, fps=c.fps)
    labels = segment(clip, estimate_flow(clip.frames))
    for t, frame in enumerate(clip.frames):
        write_png(c.out / "mask" / f"{t:04d}.png", np.where(labels.fluid[t], 255, 0).astype(np.uint8))
        write_png(c.out / "overlay" / f"{t:04d}.png", overlay(frame, labels.labels[t]))
    for text in labels.warnings:
        print(f"warning: {text}", file=sys.stderr)
    print(f"{len(clip)} masks in {c.out / 'mask'}; correct them and use: fluidlift make ... --mask {c.out / 'mask'}")
    return WITH_WARNINGS if labels.warnings else DONE


def _evaluate(c: Evaluate) -> int:
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


def _validate(c: Validate) -> int:
    from fluidlift.validate import validate_asset

    findings = validate_asset(c.asset)
    if c.json:
        print(json.dumps([dataclasses.asdict(f) for f in findings], indent=1))
    else:
        for f in findings:
            print(f"{'ok     ' if f.passed else 'FAILED '} {f.check}{': ' + f.detail if f.detail else ''}")
    return DONE if all(f.passed for f in findings) else FAILED


def _demo(c: Demo) -> int:
    from importlib import resources

    from fluidlift.config import build_config

    data = resources.files("fluidlift.synthetic") / "data"
    with resources.as_file(data / "demo.mp4") as clip, resources.as_file(data / "demo_camera.json") as camera:
        return _run_job(clip, c.out, build_config("draft"), camera=camera)


def _doctor(c: Doctor) -> int:
    from fluidlift.doctor import examine

    found = examine()
    if c.json:
        print(json.dumps(found, indent=1))
    else:
        for name, value in found.items():
            print(f"{name:24} {value}")
    return DONE


_COMMANDS = {
    Make: _make, Fit: _fit, Sim: _sim, Inspect: _inspect, Mask: _mask, Evaluate: _evaluate, Validate: _validate,
    Demo: _demo, Doctor: _doctor,
}  # fmt: skip

if __name__ == "__main__":
    sys.exit(main())
