"""Waves of a scene: what its film says of them, and how they are played on its simulated surface."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path

import numpy as np
from scipy import ndimage

from fluidlift.errors import InputRejected
from fluidlift.io.footage_file import read_footage
from fluidlift.look.surface_map import SurfaceMap
from fluidlift.look.surface_skin import of_skin
from fluidlift.look.surface_windows import windows_of
from fluidlift.look.wave_relief import WaveRelief, grown_with
from fluidlift.look.wave_spectrum import WHY_NOT, FilmedWaves, waves_in
from fluidlift.messages import Notice
from fluidlift.numerics.sampling import sample_nodes
from fluidlift.physics.wave_dispersion import WaveMedium
from fluidlift.scene.build import Scene
from fluidlift.scene.splat_files import frames_of
from fluidlift.types import kind_of

SMOOTH = 2.0
"""columns over which a current is smoothed: what carries waves is wider than they are"""

SAMPLED = 8
"""frames whose mean current carries the waves"""
Moving = tuple[np.ndarray, np.ndarray]
"""positions (m) and velocities (m/s) [n,3] of a liquid's particles in one frame"""


def filmed_waves(scene: Scene) -> FilmedWaves | Notice:
    """The waves that a scene's film shows, or why there are none.

    Args:
        scene: without edits, as its clip shows it.
    """
    if not kind_of(scene.kind).is_level_throughout:
        return _none(f"a {scene.kind} has no surface that lies")
    if scene.film is None or not scene.film.is_file():
        return _none("there is no film of the surface")
    try:
        frames, fluid, interval = read_footage(scene.film, scene.camera.size)
    except InputRejected:
        return _none("the film of the surface cannot be read")
    surface = surface_of_body(scene)
    windows = windows_of(frames, fluid, interval, scene.camera, surface, depths(surface, scene), medium_of(scene))
    found = waves_in(windows) if windows else "small"
    return _none(f"the clip shows none that can be told: {WHY_NOT[found]}") if isinstance(found, str) else found


def medium_of(scene: Scene, depth: float = WaveMedium.depth) -> WaveMedium:
    """What waves run on, over a depth (m). Simulated without tension, filmed water has its own all the same."""
    gravity, tension = float(np.linalg.norm(scene.parameters.gravity)), scene.parameters.surface_tension
    return WaveMedium(depth, gravity, tension / scene.parameters.density if tension else WaveMedium.tension)


def _none(why: str) -> Notice:
    return Notice("waves-not-filmed", f"no waves are shown: {why}")


def surface_of_body(scene: Scene) -> SurfaceMap:
    """Of the body at rest, with the velocity that it was lifted with."""
    return SurfaceMap.of(scene.body.positions, scene.body.velocities, scene.terrain.grid.spacing)


def depths(surface: SurfaceMap, scene: Scene) -> np.ndarray:
    """[nx,ny] m from the surface to the ground, in any direction."""
    points = np.concatenate([surface.middles(), surface.height[..., None]], axis=-1).reshape(-1, 3)
    found = sample_nodes(scene.terrain.signed_distance, scene.terrain.grid, points.astype(np.float32))
    return np.maximum(np.asarray(found, np.float64).reshape(surface.height.shape), 0.0)


def played_waves(scene: Scene, lifted: Scene, frames: Iterable[Moving], amount: float) -> WaveRelief | Notice:
    """Waves for the frames of a scene, or why there are none.

    Args:
        scene: that was simulated.
        lifted: the same without edits, as its clip shows it.
        frames: some of its frames, whose mean current carries the waves.
        amount: times as high as filmed.
    """
    found = filmed_waves(lifted)
    if isinstance(found, Notice):
        return found
    surface, filmed = surface_of_body(scene), surface_of_body(lifted)
    middles = surface.middles().reshape(-1, 2)
    shape = (*surface.wet.shape, 2)
    now = _mean_current(frames, middles, scene.terrain.grid.spacing)
    current = (surface.velocity[..., :2] if now is None else now.reshape(shape)).astype(float)
    current = ndimage.gaussian_filter(current, (SMOOTH, SMOOTH, 0.0))
    if not found.carried:
        current = 0.0 * current
    growth = np.ones(surface.wet.shape)
    if scene.edited and found.carried:
        growth = grown_with(current, filmed.at(filmed.velocity[..., :2], middles).reshape(shape))
    depth = float(np.median(depths(surface, scene)[surface.wet])) if surface.wet.any() else 1.0
    medium = medium_of(scene, max(depth, surface.pitch))
    place = surface.low, surface.pitch
    return WaveRelief.of(found, medium, place, current, growth, amount=amount, seed=scene.seed)


def some_frames(folder: Path, numbers: range, cell: float) -> Iterator[Moving]:
    """Of some simulated frames of an asset, `SAMPLED` at most, the liquid.

    Raises:
        InputRejected: a frame is missing or damaged.
    """
    for gaussians, _, velocities in frames_of(folder, numbers[:: max(1, -(-len(numbers) // SAMPLED))]):
        liquid = ~of_skin(gaussians, cell)
        yield gaussians.means[liquid], velocities[liquid]


def _mean_current(frames: Iterable[Moving], middles: np.ndarray, cell: float) -> np.ndarray | None:
    """m/s [n,2] at places over the plan; None where there are no frames."""
    total, count = np.zeros((len(middles), 2)), 0
    for positions, velocities in frames:
        if len(positions):
            surface = SurfaceMap.of(positions, velocities, cell)
            total += surface.at(surface.velocity[..., :2], middles)
            count += 1
    return total / count if count else None
