"""Checks of an asset folder, in words: each says what was looked at, what is wrong, and what to do about it."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from fluidlift.errors import InputRejected
from fluidlift.io.asset_paths import asset_file
from fluidlift.types import FluidAsset

SHOWN = 5
"""faults of a kind that are told; the others are counted"""
DIVERGENCE = 0.05
"""mean |div v| dx / speed from which on a velocity is not divergence-free"""
INSIDE = 0.99
"""share of the Gaussians that must lie in the grid"""

_MAKE = "make the asset again with 'fluidlift make'"
_SIM = "write the frames again with 'fluidlift sim --restart'"


@dataclass(frozen=True)
class Finding:
    """One check."""

    check: str
    passed: bool
    detail: str = ""
    """what is wrong, or what was looked at"""
    do: str = ""
    """what helps, where the check did not pass"""

    def line(self) -> str:
        """For people."""
        said = f"{'ok     ' if self.passed else 'FAILED '} {self.check}{': ' + self.detail if self.detail else ''}"
        return f"{said}. Do: {self.do}" if self.do else said


def _found(check: str, faults: list[str] | str, do: str, fine: str = "") -> Finding:
    """Passed if there are no faults."""
    faults = [faults] if isinstance(faults, str) and faults else list(faults)
    if not faults:
        return Finding(check, True, fine)
    more = f"; and {len(faults) - SHOWN} more" if len(faults) > SHOWN else ""
    return Finding(check, False, "; ".join(faults[:SHOWN]) + more, do)


def validate_asset(folder: Path) -> list[Finding]:
    """Everything that can be checked without the clip. Frames are read one by one: memory does not grow with them.

    Raises:
        InputRejected: the folder is no asset at all, or one of a newer version.
    """
    from fluidlift.io.asset_folder import load_asset, read_manifest

    folder = Path(folder)
    manifest = read_manifest(folder)
    findings = [Finding("manifest and its schema", True, f"format version {manifest['format_version']}")]
    findings += _files(folder, manifest)
    try:
        asset = load_asset(folder)
    except InputRejected as error:
        # parts that are gone or broken: what does not depend on them is still looked at
        findings.append(Finding("parts can be read", False, error.got, error.do or _MAKE))
    else:
        findings.append(Finding("parts can be read", True))
        findings += [_found(check, test(asset), do) for check, test, do in _ASSET_CHECKS]
    findings.append(_scene(folder))
    findings += _frames(folder, manifest)
    if "usd" in manifest["files"]:
        findings += _usd(folder, manifest)
    if "preview" in manifest["files"]:
        findings.append(_preview(folder, manifest))
    return findings


def _files(folder: Path, manifest: dict[str, Any]) -> Iterator[Finding]:
    """Missing files, and those that are not as they were written."""
    from fluidlift.io.hashes import altered

    names = manifest["files"].values()
    gone = [name for name in names if not asset_file(folder, name).is_file()]
    faults = [f"'{name}' is missing" for name in gone]
    yield _found("files of the manifest are there", faults, f"restore them, or {_MAKE}")
    recorded = {name: value for name, value in manifest.get("hashes", {}).items() if name in names}
    changed = altered(folder, recorded)[1]
    fine = f"SHA-256 of {len(recorded)} files" if recorded else "none recorded: written by an earlier version"
    do = "put the originals back, or go on if the change is meant; 'fluidlift make' or 'sim' write them anew"
    yield _found("files are as they were written", [f"'{name}' was changed" for name in changed], do, fine)


def _finite(asset: FluidAsset) -> str:
    g = asset.rest
    arrays = {"means": g.means, "scales": g.scales, "opacities": g.opacities, "harmonics": g.sh,
              "velocity": asset.velocity.at_centers(), "signed distance": asset.terrain.signed_distance,
              "terrain": asset.terrain.mesh.vertices}  # fmt: skip
    bad = [name for name, a in arrays.items() if not np.isfinite(a).all()]
    return f"not finite: {', '.join(bad)}" if bad else ""


def _positive(asset: FluidAsset) -> str:
    from fluidlift.io.frame_checks import gaussian_faults

    values = np.linalg.eigvalsh(asset.rest.covariances().astype(np.float64))
    bad = int((values[:, 0] <= 0).sum())
    if bad:
        return f"{bad} covariances are not positive definite"
    return "; ".join(f for f in gaussian_faults(asset.rest) if "covariances" in f)


def _opacities(asset: FluidAsset) -> str:
    o = asset.rest.opacities
    return "" if len(o) and o.min() >= 0 and o.max() <= 1 else "opacities outside 0 to 1, or no Gaussians"


def _inside(asset: FluidAsset) -> str:
    share = float(asset.grid.contains(asset.rest.means).mean()) if len(asset.rest) else 0.0
    return "" if share > INSIDE else f"{100 * (1 - share):.1f} % of the Gaussians lie outside the grid"


def _divergence(asset: FluidAsset) -> str:
    from fluidlift.physics.pressure import build_system, divergence

    # through the open parts of the faces: in a cell that the bed cuts, the plain difference of its faces is no flux
    system = build_system(asset.cell_types, asset.terrain, asset.grid)
    inner = system.unknown
    speed = float(np.linalg.norm(asset.velocity.at_centers()[inner], axis=-1).mean()) if inner.any() else 0.0
    if speed <= 0:
        return ""
    rate = divergence(asset.velocity, asset.grid, system)
    mean = float(np.abs(rate[inner]).mean()) * asset.grid.spacing / speed
    return "" if mean < DIVERGENCE else f"mean |div v| dx / speed is {mean:.3f}, not below {DIVERGENCE}"


def _estimates(asset: FluidAsset) -> list[str]:
    """The parameters themselves are checked when they are read; here, whether what is said of them can be."""
    faults = []
    for name, e in asset.estimates.items():
        if not np.isfinite(e.value):
            faults.append(f"{name} is {e.value}")
        if not e.sigma >= 0:
            faults.append(f"{name} has a standard deviation of {e.sigma}")
        if e.interval is not None and not e.interval[0] <= e.value <= e.interval[1]:
            faults.append(f"{name} = {e.value:g} lies outside its own interval {e.interval[0]:g} to {e.interval[1]:g}")
    return faults


_ASSET_CHECKS: tuple[tuple[str, Callable[[FluidAsset], str | list[str]], str], ...] = (
    ("all numbers are finite", _finite, _MAKE),
    ("covariances are positive definite", _positive, _MAKE),
    ("opacities lie in 0 to 1", _opacities, _MAKE),
    ("Gaussians lie in the grid", _inside, _MAKE),
    ("velocity is divergence-free", _divergence, "fit and simulate from another frame, or " + _MAKE),
    ("parameters and their uncertainties fit", _estimates, "fit them again with 'fluidlift fit'"),
)


def _scene(folder: Path) -> Finding:
    """Whether the file that people edit would be understood, and simulated."""
    from fluidlift.io.scene import read_edits
    from fluidlift.scene.edits import EditSession

    try:
        read_edits(folder)
        EditSession(folder).warnings()  # refuses what lies outside, and what this kind of fluid cannot do
    except InputRejected as error:
        needed = f"; needed: {error.needed}" if error.needed else ""
        return Finding("scene.yaml can be used", False, error.got + needed, error.do or "correct the line")
    return Finding("scene.yaml can be used", True)


@dataclass
class _Faults:
    """What is wrong with the frames, by check."""

    read: list[str] = field(default_factory=list)
    numbers: list[str] = field(default_factory=list)
    covariances: list[str] = field(default_factory=list)
    ids: list[str] = field(default_factory=list)
    same: list[str] = field(default_factory=list)


def _frames(folder: Path, manifest: dict[str, Any]) -> Iterator[Finding]:
    """The simulated frames: their number, and each of them."""
    from fluidlift.io.frames import FIRST_FRAME
    from fluidlift.scene.splat_files import frame_files

    simulation = manifest.get("simulation", {})
    files = frame_files(folder)
    told = simulation.get("frames")
    if not files and told is None:
        yield Finding("splat frames are complete", True, "none: nothing was simulated yet")
        return
    numbers = sorted(int(f.stem) for f in files if f.stem.isdigit())
    wanted = range(FIRST_FRAME, FIRST_FRAME + (told if told is not None else len(files)))
    faults = [f"frame {n} is missing" for n in wanted if n not in set(numbers)]
    extra = [n for n in numbers if n not in wanted]
    faults += [f"frame {n} is not one of the {told} of the manifest" for n in extra]
    faults += [f"frame {n} is there twice" for n, after in zip(numbers, numbers[1:]) if n == after]
    yield _found("splat frames are complete", faults, _SIM, f"{len(numbers)}, as the manifest says")
    interval = float(simulation.get("frame_interval", manifest["frame_interval"]))
    found = _look_at([f for f in files if f.stem.isdigit()], interval)
    count = f"{len(files)} frames"
    yield _found("every frame can be read", found.read, _SIM, count)
    yield _found("numbers of every frame are finite", found.numbers, _SIM, "positions, velocities, colours")
    yield _found("covariances of every frame are positive definite", found.covariances, _SIM, count)
    yield _found("ids of every frame are unique", found.ids, _SIM, count)
    yield _found("ids stay with their particles", found.same, _SIM, "nothing moves faster than its velocity says")


def _look_at(files: list[Path], interval: float) -> _Faults:
    """All frames, one after the other; of the one before only ids, positions and velocities are kept."""
    from fluidlift.io.frame_checks import ParticleFrame, gaussian_faults, identity_faults, particle_faults
    from fluidlift.scene.splat_files import read_frame

    found, before, last = _Faults(), None, -1
    for file in files:
        try:
            splats = read_frame(file)
            now = ParticleFrame(splats.ids, splats.gaussians.means, splats.velocities)
        except InputRejected as error:
            found.read.append(f"{file.name}: {error.got}")
            before = None
            continue
        own, number = particle_faults(now), int(file.stem)
        for fault in [*own, *gaussian_faults(splats.gaussians)]:
            kind = found.ids if "ids" in fault else found.covariances if "covariances" in fault else found.numbers
            kind.append(f"{file.name}: {fault}")
        if before is not None and not own:
            found.same += [f"{file.name}: {f}" for f in identity_faults(before, now, (number - last) * interval)]
        before, last = (None if own else now), number
    return found


def _usd(folder: Path, manifest: dict[str, Any]) -> Iterator[Finding]:
    """The file for other tools, by the rules that are installed, and against the manifest."""
    from fluidlift.io.validate_usd import frame_range, has_splat_rule, splat_rule_faults, validate_usd

    path = asset_file(folder, manifest["files"]["usd"])
    if not path.is_file():
        yield Finding("USD", False, f"'{path.name}' is missing", _SIM)
        return
    faults = validate_usd(path)
    yield _found("USD", faults, _SIM, "OpenUSD's validators, and every array at every frame")
    if faults and faults[0].startswith("cannot be opened"):
        return
    if has_splat_rule():
        yield _found("USD by NVIDIA's splat rule", splat_rule_faults(path), _SIM)
    told = manifest.get("simulation", {}).get("frames")
    if told is not None:
        first, last = frame_range(path)
        count, told = last - first + 1, manifest["simulation"].get("usd_frames", told)
        wrong = "" if count == told else f"{count} frames in the file, {told} in the manifest"
        yield _found("USD shows its frames", wrong, _SIM, f"{first} to {last}")


def _preview(folder: Path, manifest: dict[str, Any]) -> Finding:
    """Whether every frame of the preview decodes."""
    from fluidlift.io.decode import Notes, decode_frames, open_video
    from fluidlift.io.limits import ReadLimits

    check, limits, notes = "preview opens", ReadLimits(), Notes()
    try:
        with open_video(asset_file(folder, manifest["files"]["preview"]), limits) as (container, stream):
            count = sum(1 for _ in decode_frames(container, stream, limits, notes))
    except InputRejected as error:
        return Finding(check, False, error.got, _SIM)
    told = manifest.get("simulation", {}).get("frames")
    faults: list[str] = [*notes.lines]
    if told is not None and count != told:
        faults.append(f"{count} pictures for {told} frames")
    return _found(check, faults, _SIM, f"{count} pictures")
