"""Checks of an asset folder, in words."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from fluidlift.errors import InputRejected
from fluidlift.types import FluidAsset


@dataclass(frozen=True)
class Finding:
    """One check."""

    check: str
    passed: bool
    detail: str = ""


def validate_asset(folder: Path) -> list[Finding]:
    """Everything that can be checked without the clip.

    Raises:
        InputRejected: the folder is no asset at all.
    """
    from fluidlift.io.asset_folder import load_asset, read_manifest

    manifest = read_manifest(folder)
    findings = [Finding("manifest and its schema", True)]
    try:
        asset = load_asset(folder)
    except InputRejected as error:
        return [*findings, Finding("parts can be read", False, str(error))]
    findings.append(Finding("parts can be read", True))
    for check, test in _ASSET_CHECKS:
        problem = test(asset)
        findings.append(Finding(check, not problem, problem))
    findings += _frame_findings(folder)
    if "usd" in manifest.get("files", {}):
        findings.append(_usd_finding(folder))
    return findings


def _finite(asset: FluidAsset) -> str:
    g = asset.rest
    arrays = {"means": g.means, "scales": g.scales, "opacities": g.opacities, "velocity": asset.velocity.at_centers(),
              "signed distance": asset.terrain.signed_distance}  # fmt: skip
    bad = [name for name, a in arrays.items() if not np.isfinite(a).all()]
    return f"not finite: {', '.join(bad)}" if bad else ""


def _positive(asset: FluidAsset) -> str:
    values = np.linalg.eigvalsh(asset.rest.covariances().astype(np.float64))
    bad = int((values[:, 0] <= 0).sum())
    return f"{bad} covariances are not positive definite" if bad else ""


def _opacities(asset: FluidAsset) -> str:
    o = asset.rest.opacities
    return "" if len(o) and o.min() >= 0 and o.max() <= 1 else "opacities outside 0 to 1, or no Gaussians"


def _inside(asset: FluidAsset) -> str:
    share = float(asset.grid.contains(asset.rest.means).mean()) if len(asset.rest) else 0.0
    return "" if share > 0.99 else f"{100 * (1 - share):.1f} % of the Gaussians lie outside the grid"


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
    return "" if mean < 0.05 else f"mean |div v| dx / speed is {mean:.3f}"


_ASSET_CHECKS: tuple[tuple[str, Callable[[FluidAsset], str]], ...] = (
    ("all numbers are finite", _finite),
    ("covariances are positive definite", _positive),
    ("opacities lie in 0 to 1", _opacities),
    ("Gaussians lie in the grid", _inside),
    ("velocity is divergence-free", _divergence),
)


def _frame_findings(folder: Path) -> Iterator[Finding]:
    from fluidlift.io.ply import read_splats

    files = sorted((folder / "frames" / "splats").glob("*.ply"))
    if not files:
        return
    numbers = [int(f.stem) for f in files if f.stem.isdigit()]
    whole = numbers == list(range(1001, 1001 + len(files)))
    yield Finding("splat frames are complete", whole, "" if whole else "numbers with gaps")
    try:
        splats = read_splats(files[-1])
        unique = len(np.unique(splats.extras["id"])) == len(splats.gaussians)
        yield Finding("ids of the last frame are unique", unique)
    except (InputRejected, KeyError) as error:
        yield Finding("the last frame can be read", False, str(error))


def _usd_finding(folder: Path) -> Finding:
    from fluidlift.io.validate_usd import validate_usd

    errors = validate_usd(folder / "asset.usda")
    return Finding("USD", not errors, "; ".join(errors[:5]))
