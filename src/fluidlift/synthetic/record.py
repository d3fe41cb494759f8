"""Runs a synthetic scene and writes its case folder: the clip, the camera, and the exact truth."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, UInt8

from fluidlift.io.video import write_video
from fluidlift.physics.apic import LiquidSimulator
from fluidlift.synthetic import film
from fluidlift.synthetic.paint import Noise
from fluidlift.synthetic.scenes import SyntheticScene, scene_of
from fluidlift.synthetic.surface import LiquidDensity, body_of, deposit
from fluidlift.types import Particles

Progress = Callable[[int, int], None]
"""called with frames done and frames in all"""


@dataclass(frozen=True)
class Recording:
    """The truth of T frames. Units and meaning as in the case format."""

    frames: UInt8[np.ndarray, "t h w 3"]
    flow: Float[np.ndarray, "t h w 2"]
    depth: Float[np.ndarray, "t h w"]
    dz: Float[np.ndarray, "t h w"]
    mask: Bool[np.ndarray, "t h w"]
    visible: Bool[np.ndarray, "t h w"]
    static_depth: Float[np.ndarray, "h w"]
    key_frames: np.ndarray
    grid_velocity: Float[np.ndarray, "k nx ny nz 3"]
    grid_phi: Float[np.ndarray, "k nx ny nz"]
    particle_count: np.ndarray
    """of each frame"""


class Births:
    """Where and when each particle first appeared, by id: what its tracers are made of."""

    def __init__(self, velocity: tuple[float, float, float]) -> None:
        self._velocity = np.asarray(velocity)
        self._known = np.zeros(0, bool)
        self._origin = np.zeros((0, 3))

    def update(self, particles: Particles, time: float) -> None:
        """Note those that are new at `time` (s)."""
        top = int(particles.ids.max(initial=-1)) + 1
        if top > len(self._known):
            self._known = np.pad(self._known, (0, top - len(self._known)))
            self._origin = np.pad(self._origin, ((0, top - len(self._origin)), (0, 0)))
        fresh = ~self._known[particles.ids]
        ids = particles.ids[fresh]
        self._origin[ids] = particles.positions[fresh] - time * self._velocity
        self._known[ids] = True

    def origins(self, ids: np.ndarray) -> Float[np.ndarray, "n 3"]:
        """Positions (m) in the frame that drifts with the inflow, so that a pattern there goes on without a seam."""
        return self._origin[ids]


def tracers(scene: SyntheticScene, origins: np.ndarray, noises: tuple[Noise, Noise]) -> Float[np.ndarray, "n 2"]:
    """Streaks and grain in [0, 1] of particles that came from `origins` (m)."""
    return np.stack([noises[0].at(origins * scene.stretch), noises[1].at(origins)], axis=-1)


def cell_velocity(particles: Particles, scene: SyntheticScene) -> Float[np.ndarray, "nx ny nz 3"]:
    """Mean velocity (m/s) of the particles around each cell centre (trilinear weights); 0 where there is none."""
    weight = deposit(particles.positions, np.ones(len(particles)), scene.grid)
    sums = [deposit(particles.positions, particles.velocities[:, a], scene.grid) for a in range(3)]
    return np.where(weight[..., None] > 1e-3, np.stack(sums, -1) / np.maximum(weight, 1e-3)[..., None], 0.0)


def _states(scene: SyntheticScene, frames: int, seed: int) -> Iterator[tuple[Particles, np.ndarray]]:
    """Particles of each frame, one frame more than asked, with the origins of their tracers."""
    simulator = LiquidSimulator(
        scene.grid, scene.terrain, scene.parameters, scene.particles, cell_types=scene.cell_types, seed=seed
    )
    births = Births(scene.parameters.inflow_velocity)
    births.update(simulator.particles, 0.0)
    before = max(0, round(scene.settle * scene.fps))
    for k in range(before + frames + 1):
        if k >= before:
            particles = simulator.particles
            yield particles, births.origins(particles.ids)
        if k < before + frames:
            simulator.advance(1.0 / scene.fps)
            births.update(simulator.particles, (k + 1) / scene.fps)


def record(scene: SyntheticScene, frames: int, *, seed: int = 0, progress: Progress | None = None) -> Recording:
    """Simulate and film a scene.

    Args:
        scene: what to run.
        frames: number of frames, 2 or more.
        seed: of the simulation and of the looks.
        progress: called after each frame.
    """
    rng = np.random.default_rng(seed)
    camera = scene.camera
    w, h = camera.size
    fine = film.backdrop(scene, camera.resized((film.SUPERSAMPLING * w, film.SUPERSAMPLING * h)), rng)
    wall = film.backdrop(scene, camera, rng, colored=False).depth
    opening = film.fine_opening(scene)
    noises = Noise.make(rng, 40 * scene.grain[0] / 6), Noise.make(rng, 40 * scene.grain[1] / 6)
    keys = np.unique([0, frames // 2, frames - 1])
    radius = 0.45 * scene.grid.spacing
    out: dict[str, list[Any]] = {k: [] for k in ("frames", "flow", "depth", "dz", "mask", "visible", "velocity", "phi")}
    counts = []
    last: tuple[Particles, np.ndarray, np.ndarray] | None = None
    for k, (particles, origins) in enumerate(_states(scene, frames, seed)):
        body = body_of(particles.positions, scene.particle_volume, scene.grid, opening)
        depth, mask = film.surface_depth(body, camera, wall)
        if last is not None:
            _add_motion(out, camera, last, particles, depth, radius)
        if k < frames:
            tracer = tracers(scene, origins, noises)
            out["frames"].append(film.paint_liquid(scene, body, fine, particles.positions, tracer))
            out["depth"].append(depth.astype(np.float16))
            out["mask"].append(mask)
            counts.append(len(particles))
            if k in keys:
                _add_volume(out, scene, particles, body)
            if progress is not None:
                progress(k + 1, frames)
        last = particles, depth, mask
    stacked = {name: np.stack(values) for name, values in out.items()}
    static = np.where(np.isfinite(wall), wall, 0.0).reshape(h, w).astype(np.float16)
    return Recording(
        stacked["frames"], stacked["flow"], stacked["depth"], stacked["dz"], stacked["mask"], stacked["visible"],
        static, keys.astype(np.int32), stacked["velocity"], stacked["phi"], np.array(counts),
    )  # fmt: skip


def _add_motion(out, camera, last, particles: Particles, depth: np.ndarray, radius: float) -> None:
    """The motion from the last frame to this one, by the particles that are in both."""
    before, last_depth, last_mask = last
    _, a, b = np.intersect1d(before.ids, particles.ids, assume_unique=True, return_indices=True)
    flow, change = film.screen_motion(
        camera, last_depth, last_mask, before.positions[a], particles.positions[b], radius
    )
    out["visible"].append(film.still_seen(last_depth, last_mask, flow, change, depth, 2 * radius))
    out["flow"].append((np.round(flow * 16) / 16).astype(np.float16))
    out["dz"].append(change.astype(np.float16))


def _add_volume(out, scene: SyntheticScene, particles: Particles, body: LiquidDensity) -> None:
    grid = scene.grid
    below = -scene.solid(grid.centers().reshape(-1, 3)).reshape(grid.shape) / grid.spacing
    phi = np.maximum(body.signed_cells(grid), np.clip(below, -3, 3))  # the smoothed body reaches into the ground
    near = (phi < 1.0)[..., None]
    out["velocity"].append((cell_velocity(particles, scene) * near).astype(np.float16))
    out["phi"].append(phi.astype(np.float16))


def scene_record(scene: SyntheticScene, frames: int) -> dict[str, Any]:
    """The true parameters, as scene.json has them."""
    p = scene.parameters
    return {
        "case": scene.name,
        "kind": scene.kind,
        "simulator": "fluidlift",
        "fps": scene.fps,
        "dt": 1.0 / scene.fps,
        "gravity": list(p.gravity),
        "units": "metres, seconds; world right-handed, +z up",
        "domain_min": list(scene.grid.origin),
        "domain_max": scene.grid.high.tolist(),
        "dx": scene.grid.spacing,
        "grid": list(scene.grid.shape),
        "viscosity_m2_s": p.kinematic_viscosity,
        "density_kg_m3": p.density,
        "inflow": {"velocity_m_s": list(p.inflow_velocity), "fluctuation_m_s": p.inflow_fluctuation},
        "wall_damping": p.wall_damping,
        "restitution": p.restitution,
        "video_frames": frames,
    }


def write_case(scene: SyntheticScene, recording: Recording, folder: Path, *, quality: float = 16.0) -> Path:
    """Write video.mp4, camera.json, scene.json, truth.npz and solids.npz into a folder, which is made.

    Args:
        scene: what was recorded.
        recording: from `record`.
        folder: the case.
        quality: of the video, constant rate factor.
    """
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    write_video(folder / "video.mp4", list(recording.frames), scene.fps, quality=quality, repeatable=True)
    (folder / "camera.json").write_text(json.dumps(scene.camera.to_dict(), indent=1))
    (folder / "scene.json").write_text(json.dumps(scene_record(scene, len(recording.frames)), indent=1))
    np.savez_compressed(
        folder / "truth.npz",
        shape=np.array(recording.mask.shape, np.int64),
        flow=recording.flow,
        depth=recording.depth,
        dz=recording.dz,
        mask=np.packbits(recording.mask, axis=-1),
        visible=np.packbits(recording.visible, axis=-1),
        static_depth=recording.static_depth,
        key_frames=recording.key_frames,
        grid_velocity=recording.grid_velocity,
        grid_phi=recording.grid_phi,
    )
    mesh = scene.terrain.mesh
    np.savez_compressed(
        folder / "solids.npz",
        terrain_v=mesh.vertices.astype(np.float32),
        terrain_f=mesh.faces.astype(np.int32),
        terrain_rgb=np.array([0.35, 0.28, 0.20], np.float32),
    )
    return folder


def make_scene(
    name: str,
    folder: Path,
    *,
    size: tuple[int, int] = (320, 208),
    frames: int = 40,
    seed: int = 0,
    cells: int = 72,
    progress: Progress | None = None,
) -> Path:
    """Simulate a scene, film it, and write its case folder, which `fluidlift.evaluate.read_case` reads.

    Args:
        name: stream, pour, honey or dam.
        folder: the case; made if absent.
        size: width and height of the picture, px.
        frames: number of frames, 2 or more.
        seed: of all random numbers: the same seed gives the same case.
        cells: of the grid along x.
        progress: called with frames done and frames in all.

    Raises:
        InputRejected: an unknown name or an impossible size.
    """
    scene = scene_of(name, size=size, seed=seed, cells=cells)
    return write_case(scene, record(scene, frames, seed=seed, progress=progress), folder)
