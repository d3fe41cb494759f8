"""Fits the parameters of cases with a known truth, first from exact velocities, then as the whole pipeline found them.

    python benchmarks/fit_cases.py --shared CASES
    python benchmarks/fit_cases.py --only honey --coarsen 1 --json fit_cases.json
    python benchmarks/fit_cases.py --assets runs/honey.draft.fluid runs/river.draft.fluid

Cases are folders with truth.npz (see `fluidlift.evaluate.case`), looked for in `cases` below --shared, FLUIDLIFT_SHARED
or a folder `shared` beside the repository. The first table separates the fit from the estimate of motion: its targets
are the true velocities on the case's own grid (coarsened by two --coarsen times), the layout comes
from the level set, the solids from their meshes. Half way between (`--velocities surface`), only the true velocity of
the free surface is given, and what is below it comes from `motion.volume` as it does in the pipeline. The second table
reads parameters.json of assets made from the clips.

With a wide prior of gravity the fit starts at two thirds of it, 12 degrees off the vertical, so that its recovery means
something; a known gravity starts right and may change by 2 %. Viscosity starts at that of water. What the cases call
viscosity 0 is an inviscid solver, whose effective viscosity is numerical, of the order of speed times cell; a truth
of 0 is shown, but no error.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass, field
from pathlib import Path

import numpy as np
from scipy import ndimage

from fluidlift.evaluate.case import Case, read_case
from fluidlift.fit.coarsen import coarse_grid, coarsen_cells, coarsen_terrain, coarsen_velocity
from fluidlift.fit.loss import surface_cells
from fluidlift.fit.optimize import fit_parameters
from fluidlift.motion.volume import volume_velocity
from fluidlift.numerics.mesh_distance import mesh_distance
from fluidlift.types import (
    CellType,
    Estimate,
    FaceVelocity,
    FluidParameters,
    Grid,
    SurfaceMotion,
    Terrain,
    TriangleMesh,
)

ROOT = Path(__file__).resolve().parent.parent
KIND = {"river": "stream", "honey": "stream", "smoke": "plume"}
WRONG_GRAVITY = tuple(6.5 * np.array([math.sin(math.radians(12)), 0.0, -math.cos(math.radians(12))]))
GRAVITY_PRIOR = {"wide": 1.0, "known": 0.02}
"""raw prior width of gravity, in units of its size; known is what the pipeline assumes"""
WATER = 1e-6
"""m^2/s"""
FILLED_SHARE = 0.05
"""of the largest smoke density, above which a cell is smoke"""
TWO_SIDED_95 = 1.96


@dataclass(frozen=True)
class Exact:
    """A case as a fit sees it."""

    grid: Grid
    terrain: Terrain
    targets: list[FaceVelocity]
    cell_types: list[np.ndarray]
    mainstream: np.ndarray
    inflow: np.ndarray
    """[3] m/s, true mean velocity of the faces that the inlet prescribes"""


@dataclass
class Row:
    """One fit of one case."""

    case: str
    source: str
    """where the velocities come from"""
    cells: tuple[int, ...]
    spacing: float
    seconds: float
    converged: bool
    loss: float
    """over that of a fluid at rest"""
    truth: dict[str, float]
    found: dict[str, dict[str, float | bool | None]]
    notes: list[str] = field(default_factory=list)


def solid_distance(case: Case, spacing: float) -> np.ndarray:
    """Signed distance (m) at the nodes of the case's grid to all its solids."""
    nodes = case.grid.nodes()
    out = np.full(nodes.shape[:-1], 1e3)
    for mesh in case.solids.values():
        around = mesh_distance(mesh, spacing)
        at = np.moveaxis((nodes - around.grid.low) / spacing, -1, 0)
        # beyond the mesh's own grid: its nearest value, three cells or more from the surface
        out = np.minimum(out, ndimage.map_coordinates(around.distance, at, order=1, mode="nearest"))
    return out


def inlet_cells(case: Case, centers: np.ndarray) -> np.ndarray:
    """Cells inside the box or the upright cylinder that feeds the case; a cell's width of it at least."""
    source = case.scene["inflow"]
    if "box_min" in source:
        low, high = np.asarray(source["box_min"]), np.asarray(source["box_max"])
        return np.asarray(((centers >= low) & (centers <= high)).all(axis=-1))
    middle = np.asarray(source["centre"], float)
    flat = np.hypot(*(np.moveaxis(centers[..., :2] - middle[:2], -1, 0)))
    tall = max(0.5 * float(source["height"]), 0.51 * case.grid.spacing)
    return (flat <= source["radius"]) & (np.abs(centers[..., 2] - middle[2]) <= tall)


def outlet_cells(case: Case, centers: np.ndarray) -> np.ndarray:
    """Cells of the sink; none where the box itself is open."""
    sink = case.scene["outflow"]
    if not isinstance(sink, dict) or "box_min" not in sink:
        return np.zeros(centers.shape[:-1], bool)
    low, high = np.asarray(sink["box_min"]), np.asarray(sink["box_max"])
    return np.asarray(((centers >= low) & (centers <= high)).all(axis=-1))


def to_faces(velocity: np.ndarray, known: np.ndarray) -> FaceVelocity:
    """Cell-centred velocity to faces: the mean of the known cells on both sides, 0 where none is."""
    out = []
    for axis in range(3):
        pad = [(0, 0)] * 3
        pad[axis] = (1, 1)
        value, weight = np.pad(velocity[..., axis] * known, pad), np.pad(known.astype(float), pad)
        n = value.shape[axis]
        total = np.take(value, range(n - 1), axis) + np.take(value, range(1, n), axis)
        count = np.take(weight, range(n - 1), axis) + np.take(weight, range(1, n), axis)
        out.append((total / np.maximum(count, 1.0)).astype(np.float32))
    return FaceVelocity(*out)


def exact_case(case: Case, keys: list[int], coarsen: int) -> Exact:
    """Layouts and velocities of some key frames."""
    grid, centers = case.grid, case.grid.centers()
    phi = solid_distance(case, grid.spacing)
    nx, ny, nz = grid.shape
    corners = [phi[a : a + nx, b : b + ny, c : c + nz] for a in (0, 1) for b in (0, 1) for c in (0, 1)]
    solid = np.mean(corners, axis=0) < 0
    inlet, outlet = inlet_cells(case, centers), outlet_cells(case, centers)
    empty_mesh = TriangleMesh(np.zeros((0, 3), np.float32), np.zeros((0, 3), np.int64))
    targets, layouts = [], []
    for key in keys:
        velocity = case.velocity[key].astype(float)
        occupied = case.occupied(key)
        types = np.where(occupied, CellType.FLUID, CellType.EMPTY)
        types = np.where(occupied & inlet, CellType.INFLOW, types)
        types = np.where(outlet, CellType.OUTFLOW, types)
        types = np.where(solid, CellType.SOLID, types).astype(np.uint8)
        known = (velocity != 0).any(axis=-1) if case.level_set is not None else np.ones(grid.shape, bool)
        targets.append(to_faces(velocity, known))
        layouts.append(types)
    mean = np.mean([case.velocity[k].astype(float)[case.occupied(k)].mean(axis=0) for k in keys], axis=0)
    mainstream = mean / np.linalg.norm(mean)
    terrain = Terrain(grid, phi.astype(np.float32), mainstream, empty_mesh)
    for _ in range(coarsen):
        targets, layouts = [coarsen_velocity(t) for t in targets], [coarsen_cells(c) for c in layouts]
        terrain, grid = coarsen_terrain(terrain), coarse_grid(grid)
    inflow = inlet_velocity(targets[0], layouts[0])
    return Exact(grid, terrain, targets, layouts, mainstream, inflow)


def inlet_velocity(target: FaceVelocity, types: np.ndarray) -> np.ndarray:
    """Mean of each component over the faces of INFLOW cells beside FLUID: what the rollout's inlet prescribes."""
    out = np.zeros(3)
    for axis, component in enumerate(target.components):
        pad = [(0, 0)] * 3
        pad[axis] = (1, 1)
        wide = np.pad(types, pad, constant_values=CellType.SOLID)
        n = wide.shape[axis]
        low, high = np.take(wide, range(n - 1), axis), np.take(wide, range(1, n), axis)
        between = ((low == CellType.INFLOW) | (high == CellType.INFLOW)) & (low != CellType.SOLID)
        between &= high != CellType.SOLID
        if between.any():
            out[axis] = float(component[between].mean())
    return out


def from_surface(exact: Exact, kind: str) -> list[FaceVelocity]:
    """What the pipeline makes of the true velocities of the surface's cells alone."""
    out = []
    for target, types in zip(exact.targets, exact.cell_types):
        at = surface_cells(types)
        motion = SurfaceMotion(exact.grid.centers()[at], target.at_centers()[at], np.ones(int(at.sum()), bool))
        velocity, _ = volume_velocity(motion, exact.terrain, types, exact.grid, kind=kind, mainstream=exact.mainstream)
        out.append(velocity)
    return out


def noisy(targets: list[FaceVelocity], share: float, seed: int) -> list[FaceVelocity]:
    """White noise of a share of the root mean square velocity on every moving face."""
    rng = np.random.default_rng(seed)
    out = []
    for t in targets:
        moving = np.concatenate([c[c != 0] for c in t.components])
        size = share * math.sqrt(3.0 * float(np.square(moving).mean()))
        noise = [np.float32(size) * rng.standard_normal(c.shape, np.float32) * (c != 0) for c in t.components]
        out.append(FaceVelocity(*(c + e for c, e in zip(t.components, noise))))
    return out


def truths(case: Case, inflow: np.ndarray) -> dict[str, float]:
    """True values by the labels of the estimates; buoyancy of the smoke is in its solver's units, so it is left out."""
    known = {"kinematic_viscosity": float(case.scene.get("viscosity_m2_s", 0.0))}
    known |= {f"inflow_velocity_{c}": float(v) for c, v in zip("xyz", inflow)}
    if case.level_set is not None:
        known |= {f"gravity_{c}": float(v) for c, v in zip("xyz", case.scene["gravity"])}
    return known


def summary(estimates: dict[str, Estimate]) -> dict[str, dict[str, float | bool | None]]:
    """Plain numbers; no infinities in JSON."""
    out = {}
    for label, e in estimates.items():
        sigma = e.sigma if math.isfinite(e.sigma) else None
        out[label] = {"value": e.value, "sigma": sigma, "identifiable": e.identifiable, "prior": e.prior}
    return out


def fit_exact(case: Case, args: argparse.Namespace, key: int, noise: float, prior: str) -> Row:
    """Fit one key frame, taken as a steady flow."""
    exact = exact_case(case, [key], args.coarsen)
    kind = KIND.get(case.name, "plume" if case.level_set is None else "stream")
    targets = from_surface(exact, kind) if args.velocities == "surface" else exact.targets
    targets = noisy(targets, noise, args.seed) if noise else targets
    x, y, z = case.scene["gravity"] if prior == "known" else WRONG_GRAVITY
    initial = FluidParameters(kinematic_viscosity=WATER, gravity=(x, y, z), wall_damping=0.3, restitution=0.05)
    began = time.perf_counter()
    result = fit_parameters(
        targets, exact.cell_types, exact.terrain, exact.grid, case.interval, initial, kind=kind,
        mainstream=exact.mainstream, prior_sigmas={"gravity": GRAVITY_PRIOR[prior]}, max_seconds=args.seconds,
        frames_per_window=args.frames,
    )  # fmt: skip
    given = "surface of " if args.velocities == "surface" else ""
    error = f", {100 * noise:.0f} % noise" if noise else ""
    source = f"{given}key frame {int(case.key_frames[key])}{error}, {prior} gravity"
    return Row(
        case.name, source, exact.grid.shape, exact.grid.spacing, time.perf_counter() - began, result.converged,
        result.extra["loss"] / result.extra["loss_at_rest"], truths(case, exact.inflow), summary(result.estimates),
        list(result.notes),
    )  # fmt: skip


def read_asset(folder: Path, cases: dict[str, Case]) -> Row | None:
    """The fit of an asset whose clip is one of the cases.

    Its world has axes of its own (z is up in both), and its inlet is where its own geometry begins: of the inflow only
    the size is shown. Lengths are those that the asset assumed.
    """
    path = folder / "parameters.json"
    if not path.is_file():
        return None
    data = json.loads(path.read_text(encoding="utf-8"))
    name = next((n for n in cases if folder.name.startswith(n)), None)
    if name is None:
        return None
    found = {
        k: {f: e.get(f) for f in ("value", "sigma", "identifiable", "prior")} for k, e in data["estimates"].items()
    }
    return Row(
        name, folder.name, (), float("nan"), float("nan"), bool(data.get("converged", True)), float("nan"),
        {k: v for k, v in truths(cases[name], np.zeros(3)).items() if not k.startswith("inflow")}, found,
        list(data.get("notes", [])),
    )  # fmt: skip


def _moved(estimate: dict[str, float | bool | None]) -> bool:
    """The data said something: the value is no longer the prior's."""
    return bool(estimate["identifiable"]) or estimate["value"] != estimate.get("prior")


def vector(row: Row, name: str) -> np.ndarray | None:
    """Three components of the estimates."""
    parts = [row.found.get(f"{name}_{c}", {}).get("value") for c in "xyz"]
    return None if any(p is None for p in parts) else np.asarray(parts, float)


def viscosity_text(row: Row) -> tuple[str, str]:
    """Value with its 95 % interval, and what the truth makes of it."""
    e = row.found["kinematic_viscosity"]
    value, sigma, truth = float(e["value"] or 0.0), e["sigma"], row.truth["kinematic_viscosity"]
    factor = None if sigma is None or value <= 0 else math.exp(min(TWO_SIDED_95 * float(sigma) / value, 20.0))
    text = f"{value:.2g}" + ("" if factor is None else f" (x/: {factor:.2g})")
    if not _moved(e):
        return text + " = prior", "not determined"
    if truth <= 0:
        return text, "numerical"
    inside = factor is not None and 1 / factor <= value / truth <= factor
    return text, f"{value / truth:.2g} x truth, {'inside' if inside else 'outside'}"


def vector_text(row: Row, name: str) -> str:
    """Size and direction against the truth, and how many components lie within their 95 % interval."""
    found = vector(row, name)
    true = [row.truth.get(f"{name}_{c}") for c in "xyz"]
    if found is None:
        return "-"
    size = float(np.linalg.norm(found))
    if any(t is None for t in true):
        return f"{size:.3g}"
    t = np.asarray(true, float)
    angle = math.degrees(math.acos(np.clip(found @ t / max(size * float(np.linalg.norm(t)), 1e-12), -1, 1)))
    inside = free = 0
    for c, value in zip("xyz", t):
        e = row.found[f"{name}_{c}"]
        if _moved(e) and e["sigma"] is not None:
            free += 1
            inside += abs(float(e["value"] or 0.0) - value) <= TWO_SIDED_95 * float(e["sigma"])
    return f"{size:.3g} of {np.linalg.norm(t):.3g}, {angle:.0f} deg, {inside}/{free} inside"


def table(rows: list[Row]) -> str:
    """Markdown."""
    lines = [
        "| case | velocities | cells | loss / at rest | viscosity m2/s | truth says | inflow m/s | gravity m/s2 | s |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    for r in rows:
        value, verdict = viscosity_text(r)
        cells = "x".join(map(str, r.cells)) or "-"
        loss, seconds = ("-" if math.isnan(x) else f"{x:.3g}" for x in (r.loss, r.seconds))
        lines.append(
            f"| {r.case} | {r.source} | {cells} | {loss} | {value} | {verdict} | {vector_text(r, 'inflow_velocity')} | "
            f"{vector_text(r, 'gravity')} | {seconds}{'' if r.converged else ' (cut)'} |"
        )
    return "\n".join(lines)


def case_folders(shared: Path | None, only: list[str] | None) -> Iterator[Path]:
    """Folders with truth.npz."""
    base = shared or Path(os.environ.get("FLUIDLIFT_SHARED") or ROOT.parent / "shared")
    for path in sorted(base.glob("cases/*/truth.npz")) or sorted(base.glob("*/truth.npz")):
        if only is None or path.parent.name in only:
            yield path.parent


def main() -> None:
    """Parse, fit, print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--shared", type=Path, help="folder that holds `cases`")
    parser.add_argument("--only", nargs="*", help="names of cases")
    parser.add_argument("--coarsen", type=int, default=1, help="halvings of the case's grid")
    parser.add_argument("--keys", type=int, nargs="*", default=[1], help="indices of key frames")
    parser.add_argument("--noise", type=float, nargs="*", default=[0.0, 0.2], help="shares of the speed")
    parser.add_argument("--gravity", nargs="*", choices=tuple(GRAVITY_PRIOR), default=list(GRAVITY_PRIOR))
    parser.add_argument("--velocities", choices=("volume", "surface"), default="volume", help="which are given")
    parser.add_argument("--frames", type=int, help="length of the window; default: as the fit chooses")
    parser.add_argument("--seconds", type=float, default=60.0, help="per fit")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--assets", type=Path, nargs="*", default=[], help="asset folders made from the cases' clips")
    parser.add_argument("--json", type=Path, help="write the rows here, too")
    args = parser.parse_args()
    cases = {c.name: c for c in map(read_case, case_folders(args.shared, args.only))}
    rows = [
        fit_exact(case, args, key, noise, prior)
        for case in cases.values()
        for key in args.keys
        for noise in args.noise
        # buoyancy is in units of the smoke's solver: nobody knows it
        for prior in (args.gravity if case.level_set is not None else ["wide"])
        if key < len(case.key_frames)
    ]
    if rows:
        print("## From exact velocities\n\n" + table(rows) + "\n")
    assets = [r for r in (read_asset(a, cases) for a in args.assets) if r is not None]
    if assets:
        print("## From the clips, through the whole pipeline\n\n" + table(assets) + "\n")
    if args.json:
        args.json.write_text(json.dumps([asdict(r) for r in rows + assets], indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
