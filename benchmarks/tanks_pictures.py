"""Pictures of the standard scenes, to look at: does the liquid move and look like a liquid?

    python benchmarks/tanks_pictures.py --out pictures dam river slope thread pool drop --scale 1.0

For each scene a few instants, from the side and from above. The box is cut open like an aquarium; single drops that the
smoothed surface does not hold are drawn as dots.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numba
import numpy as np
from numba import njit, prange

from fluidlift.numerics.mesh_distance import mesh_distance
from fluidlift.numerics.sampling import sample_nodes
from fluidlift.physics.apic import LiquidSimulator
from fluidlift.physics.rigid import RigidBody
from fluidlift.synthetic import tanks
from fluidlift.synthetic.gauges import Gauge
from fluidlift.synthetic.paint import SUN, LiquidPaint, lit, to_picture
from fluidlift.synthetic.surface import LiquidDensity, body_of, finer
from fluidlift.types import Grid, Particles, PinholeCamera

WATER = LiquidPaint(body=(0.02, 0.12, 0.15), absorption=(9.0, 3.5, 2.5))
AMBER = LiquidPaint(body=(0.45, 0.17, 0.015), absorption=(10.0, 40.0, 150.0))
ROCK, TABLE, WOOD = np.array([0.25, 0.23, 0.20]), np.array([0.55, 0.55, 0.57]), np.array([0.55, 0.25, 0.10])


@njit(cache=True)
def _at(field, first, inverse, x, y, z):
    """Trilinear value; beyond the samples the nearest is continued."""
    nx, ny, nz = field.shape
    u = min(max((x - first[0]) * inverse, 0.0), nx - 1.0)
    v = min(max((y - first[1]) * inverse, 0.0), ny - 1.0)
    w = min(max((z - first[2]) * inverse, 0.0), nz - 1.0)
    i, j, k = min(int(u), nx - 2), min(int(v), ny - 2), min(int(w), nz - 2)
    u, v, w = u - i, v - j, w - k
    low = (field[i, j, k] * (1 - u) + field[i + 1, j, k] * u) * (1 - v)
    low += (field[i, j + 1, k] * (1 - u) + field[i + 1, j + 1, k] * u) * v
    high = (field[i, j, k + 1] * (1 - u) + field[i + 1, j, k + 1] * u) * (1 - v)
    high += (field[i, j + 1, k + 1] * (1 - u) + field[i + 1, j + 1, k + 1] * u) * v
    return low * (1 - w) + high * w


@njit(cache=True, parallel=True)
def _march(eyes, rays, start, stop, step, level, level_first, level_inverse, solid, solid_first, solid_inverse, out):
    """Per ray: where it meets the liquid, where a solid (inf: nowhere), and the way through liquid until then."""
    for r in prange(len(rays)):
        out[r, 0] = out[r, 1] = np.inf
        out[r, 2] = 0.0
        t = start[r]
        before_liquid = before_solid = 1.0
        first = True
        while t < stop[r]:
            x, y, z = eyes[r, 0] + t * rays[r, 0], eyes[r, 1] + t * rays[r, 1], eyes[r, 2] + t * rays[r, 2]
            ground = _at(solid, solid_first, solid_inverse, x, y, z)
            liquid = _at(level, level_first, level_inverse, x, y, z)
            if ground < 0.0:
                back = 0.0 if first else step * ground / (ground - before_solid)
                out[r, 1] = t - back
                break
            if liquid < 0.0:
                if out[r, 0] == np.inf:
                    out[r, 0] = t if first else t - step * liquid / (liquid - before_liquid)
                out[r, 2] += step
            before_liquid, before_solid, first = liquid, ground, False
            t += step


@dataclass(frozen=True)
class Stage:
    """What a ray can meet."""

    body: LiquidDensity
    solid_grid: Grid
    solid: np.ndarray
    """signed distance at the nodes of that grid, bodies included"""
    body_share: np.ndarray
    """signed distance to the bodies alone"""
    tank: tanks.Tank

    def cast(self, eyes: np.ndarray, rays: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """`_march` inside the box, and the depth at which each ray enters it (inf: it misses)."""
        grid = self.tank.grid
        with np.errstate(divide="ignore", invalid="ignore"):
            a, b = (grid.low - eyes) / rays, (grid.high - eyes) / rays
        enter = np.maximum(np.nanmax(np.minimum(a, b), axis=-1), 0.0)
        leave = np.nanmin(np.maximum(a, b), axis=-1)
        out = np.empty((len(rays), 3))
        fine = self.body.grid
        step = 0.35 * fine.spacing / float(np.linalg.norm(rays, axis=-1).max())
        _march(
            np.ascontiguousarray(eyes), np.ascontiguousarray(rays), enter + 1e-9, leave, step, self.body.level,
            fine.low + 0.5 * fine.spacing, 1 / fine.spacing, self.solid, grid.low, 1 / self.solid_grid.spacing, out,
        )  # fmt: skip
        return out, np.where(enter < leave, enter, np.inf)


def slope(values: Callable[[np.ndarray], np.ndarray], points: np.ndarray, step: float) -> np.ndarray:
    """Unit gradient by central differences."""
    g = np.stack([values(points + e) - values(points - e) for e in step * np.eye(3)], -1)
    return g / np.maximum(np.linalg.norm(g, axis=-1, keepdims=True), 1e-9)


def sample(field: np.ndarray, first: np.ndarray, spacing: float, points: np.ndarray) -> np.ndarray:
    """Trilinear values at points."""
    from scipy.ndimage import map_coordinates

    return map_coordinates(field, ((points - first) / spacing).T, order=1, mode="nearest")


def face_normals(stage: Stage, points: np.ndarray) -> np.ndarray:
    """Outward normal of the nearest side of the box."""
    grid = stage.tank.grid
    away = np.concatenate([points - grid.low, grid.high - points], axis=1)
    side = away.argmin(axis=1)
    normals = np.zeros_like(points)
    normals[np.arange(len(points)), side % 3] = np.where(side < 3, -1.0, 1.0)
    return normals


def picture(stage: Stage, particles: Particles, camera: PinholeCamera, paint: LiquidPaint) -> np.ndarray:
    """u8 [h,w,3]."""
    w, h = camera.size
    grid, fine, node = stage.tank.grid, stage.body.grid, stage.solid_grid.spacing
    rays = camera.rays(camera.pixel_grid()).reshape(-1, 3)
    eyes = np.broadcast_to(camera.position, rays.shape)
    out, enter = stage.cast(eyes, rays)
    length = np.linalg.norm(rays, axis=-1)
    color = np.tile([0.80, 0.83, 0.86], (len(rays), 1))
    # the table on which the box stands
    table = (grid.low[2] - camera.position[2]) / np.where(rays[:, 2] < -1e-9, rays[:, 2], np.nan)
    wall = np.where(np.isfinite(out[:, 1]), out[:, 1], np.where(table > 0, table, np.inf))
    seen = np.flatnonzero(np.isfinite(wall) & (wall < 1e3 * np.linalg.norm(grid.high - grid.low)))
    points = eyes[seen] + wall[seen, None] * rays[seen]
    ground = np.isfinite(out[seen, 1])
    normals = slope(lambda p: sample(stage.solid, grid.low, node, p), points, 0.4 * node)
    cut = ground & (np.abs(wall[seen] - enter[seen]) < 1e-6)
    normals[cut] = face_normals(stage, points[cut])
    normals[~ground] = (0.0, 0.0, 1.0)
    body = sample(stage.body_share, grid.low, node, points) < 0.6 * node
    base = np.where(ground[:, None], np.where(body[:, None], WOOD, ROCK), TABLE)
    shade, _ = stage.cast(points + 0.6 * grid.spacing * normals, np.broadcast_to(SUN, points.shape))
    shadow = np.where(np.isfinite(shade[:, 1]), 0.35, np.exp(-3.0 * shade[:, 2] / (grid.spacing * 12)) * 0.6 + 0.4)
    color[seen] = lit(base, normals, shadow)
    hit = np.flatnonzero(np.isfinite(out[:, 0]) & (out[:, 0] < wall))
    points = eyes[hit] + out[hit, :1] * rays[hit]
    normals = slope(
        lambda p: sample(stage.body.level, fine.low + 0.5 * fine.spacing, fine.spacing, p), points, fine.spacing
    )
    cut = np.abs(out[hit, 0] - enter[hit]) < 1e-6
    normals[cut] = face_normals(stage, points[cut])
    thickness = out[hit, 2] * length[hit] / stage.tank.size  # colour does not depend on the size of the scene
    tracer = np.full((len(hit), 2), 0.3)
    color[hit] = paint.color(normals, rays[hit] / length[hit, None], thickness, color[hit], tracer)
    image = color.reshape(h, w, 3)
    drops(image, stage, particles, camera, np.minimum(wall, out[:, 0]).reshape(h, w), paint)
    return to_picture(cv2.resize(image, (w // 2, h // 2), interpolation=cv2.INTER_AREA))


def drops(
    image: np.ndarray, stage: Stage, particles: Particles, camera: PinholeCamera, depth: np.ndarray, paint: LiquidPaint
) -> None:
    """Draw the particles that lie outside the smoothed surface, in place."""
    fine = stage.body.grid
    level = sample(stage.body.level, fine.low + 0.5 * fine.spacing, fine.spacing, particles.positions)
    free = particles.positions[level > 0.3].astype(float)
    uv, z = camera.project(free)
    tone = np.clip(np.asarray(paint.body) * 2.2 + 0.16, 0, 1)
    for (u, v), d in sorted(zip(uv, z), key=lambda item: -item[1]):
        if not (0 <= u < image.shape[1] and 0 <= v < image.shape[0]) or d > depth[int(v), int(u)]:
            continue
        radius = max(1, round(0.16 * stage.tank.grid.spacing * camera.focal[0] / d))
        cv2.circle(image, (int(u), int(v)), radius, tone.tolist(), -1, cv2.LINE_AA)
        cv2.circle(image, (int(u - 0.3 * radius), int(v - 0.3 * radius)), max(radius // 3, 1), [0.9, 0.95, 1.0], -1)


def cameras(tank: tanks.Tank, size: tuple[int, int]) -> list[PinholeCamera]:
    """From the side (a river, from its lower end), and from above at an angle; both see the whole box."""
    from fluidlift.look.scenery import orbit_camera

    low, high = tank.grid.low, tank.grid.high
    middle = 0.5 * (low + high)
    front = PinholeCamera.looking(middle - [0.0, np.ptp(high - low) + 1.0, 0.0], middle, 35.0, size)
    box = np.array([low, high])
    return [
        orbit_camera(
            front,
            box,
            azimuth=80.0 if tank.name == "river" else 0.0,
            elevation=14.0 if tank.name == "river" else 6.0,
            size=size,
            fov=30.0,
        ),
        orbit_camera(front, box, azimuth=32.0, elevation=28.0, size=size, fov=35.0),
    ]


def solids(tank: tanks.Tank, simulator: LiquidSimulator) -> tuple[Grid, np.ndarray, np.ndarray]:
    """A grid twice as fine, and at its nodes the signed distance (m) of terrain and bodies, and of the bodies alone."""
    fine = finer(tank.grid)
    nodes = fine.nodes().reshape(-1, 3)
    terrain = sample_nodes(tank.terrain.signed_distance, tank.grid, nodes).astype(np.float64)
    alone = np.full(len(nodes), 1e3)
    moving = getattr(simulator, "bodies", None)
    for number, body in enumerate(tank.bodies):
        shape = mesh_distance(body.mesh, fine.spacing)
        local = np.einsum("ij,ni->nj", moving.rotation[number], nodes - moving.position[number])
        near = np.clip(local, shape.grid.low, shape.grid.high)
        beyond = np.linalg.norm(local - near, axis=1)
        alone = np.minimum(alone, sample_nodes(shape.distance, shape.grid, near) + beyond)
    size = tuple(n + 1 for n in fine.shape)
    return fine, np.minimum(terrain, alone).reshape(size), alone.reshape(size)


def show(name: str, tank: tanks.Tank, instants: list[float], paint: LiquidPaint, out: Path, **options) -> None:
    """Run a scene and write a picture with two views for each instant (s)."""
    simulator, gauge = tank.simulator(**options), Gauge.of(tank)
    views = cameras(tank, (1280, 800))
    steps, began = 0, time.perf_counter()
    for number, instant in enumerate(instants):
        if instant > simulator.time:
            steps += simulator.advance(instant - simulator.time).substeps
        particles = simulator.particles
        volumes = particles.masses.astype(np.float64) / tank.parameters.density
        body = body_of(particles.positions, volumes, tank.grid, gauge.opening)
        stage = Stage(replace(body, level=body.level.astype(np.float64)), *solids(tank, simulator), tank)
        frame = np.concatenate([picture(stage, particles, camera, paint) for camera in views], axis=1)
        text = f"{name}  t = {simulator.time:.3g} s  {len(particles)} particles, {steps} steps"
        cv2.putText(frame, text, (10, 20), cv2.FONT_HERSHEY_SIMPLEX, 0.5, (40, 40, 40), 1, cv2.LINE_AA)
        path = out / f"{name}_{number}.png"
        cv2.imwrite(str(path), frame[..., ::-1])
        print(f"{path}  {time.perf_counter() - began:.1f} s", flush=True)


def floats(cells: int) -> tanks.Tank:
    """A pool into which a box, a log and a stone fall."""
    tank = tanks.pool(cells=cells, width=0.8, depth=0.4, headroom=0.6)
    tilt = np.array([0.93, 0.25, 0.2, 0.15])
    return tank.with_bodies(
        RigidBody.box("box", np.array([0.2, 0.2, 0.16]), density=450.0, position=(-0.18, 0.1, 0.55), orientation=tilt),
        RigidBody.cylinder(
            "log", 0.06, 0.34, density=600.0, position=(0.15, -0.15, 0.45), orientation=(0.7, 0.7, 0.1, 0)
        ),
        RigidBody.sphere("stone", 0.07, density=2600.0, position=(0.2, 0.2, 0.6)),
    )


def scenes(scale: float) -> dict[str, tuple[Callable[[], tanks.Tank], list[float], LiquidPaint]]:
    """Name: builder, instants (s), paint. Cells scale with `scale`."""

    def n(cells: int) -> int:
        return max(8, round(cells * scale))

    return {
        "dam": (
            lambda: tanks.dam_break(cells=n(20), base=0.3, length=4.0, width_cells=n(20)),
            [0.0, 0.25, 0.45, 0.7, 1.1], WATER,
        ),
        "river": (lambda: tanks.river(cells=n(96)), [0.0, 1.0, 3.0, 6.0], WATER),
        "slope": (lambda: tanks.honey_slope(cells=n(64)), [0.0, 0.2, 0.6, 1.2], AMBER),
        "thread": (lambda: tanks.thread(cells=n(40)), [0.15, 0.4, 0.8, 1.2], AMBER),
        "float": (lambda: floats(n(48)), [0.0, 0.2, 0.4, 0.8, 2.5], WATER),
        "drop": (lambda: tanks.drop(cells=n(56)), [0.0, 0.01, 0.03, 0.06], WATER),
    }  # fmt: skip


def main() -> None:
    """Parse, run, write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    known = list(scenes(1.0))
    parser.add_argument("names", nargs="*", default=known, help="of " + ", ".join(known))
    parser.add_argument("--out", type=Path, default=Path("tanks"))
    parser.add_argument("--scale", type=float, default=1.0, help="share of the usual number of cells along each axis")
    parser.add_argument("--threads", type=int, default=numba.get_num_threads())
    given = parser.parse_args()
    numba.set_num_threads(given.threads)
    given.out.mkdir(parents=True, exist_ok=True)
    for name in given.names:
        build, instants, paint = scenes(given.scale)[name]
        show(name, build(), instants, paint, given.out)


if __name__ == "__main__":
    main()
