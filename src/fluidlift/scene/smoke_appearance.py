"""What the splats of simulated smoke look like in each frame: as thin as its film shows it, or as it was carried.

A particle carries an amount of smoke, which is the area that its splat would darken (m^2). Unedited, the film says how
opaque each line of sight is, and the particles on it share that out. Where a person changed the flow, beside the
picture, and after the end of a film in which the smoke still spread, each keeps the amount that it had at rest: smoke
that spreads gets thinner. What flows in then has as much as the film shows about the inlet in the mean. Towards the
open sides of the box smoke fades out, where the simulation ends.
"""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from scipy import ndimage

from fluidlift.errors import InputRejected
from fluidlift.look.smoothstep import smoothstep
from fluidlift.look.surface_map import sampled
from fluidlift.scene.surface_appearance import FAINT
from fluidlift.types import CellType, Gaussians, Particles, PinholeCamera, concatenate, sh_from_rgb

if TYPE_CHECKING:
    from fluidlift.look.smoke_film import SmokeFilm
    from fluidlift.scene.build import Scene

WIDEST = 1.0
"""standard deviation of a splat at most, cells: the simulator knows nothing finer"""

HANDED_OVER = 0.5
"""s after the end of the film over which smoke that still spread there goes on as it is simulated"""

CARRIED = 0.5
"""standard deviation of the smoke that a particle carries, cells: the spacing of particles"""

ASTRAY = 6.0
"""cells from the simulated smoke within which smoke that the film shows is shown as well: a plume of ten cells that the
simulator turns another way, its eddies above all. Over as many again it fades out: what is further off shows that the
simulation is another one"""

LACKING = 0.5
"""share of the film's optical depth under which simulated smoke leaves a place to be filled"""

SPOT = 0.1
"""opacity by which a place of thick smoke that lacks less is seen as a spot"""

SEEN = 0.03
"""optical depth from which a place is filled"""

FINER = 4.0
"""places for splats that fill, to a cell's width"""

ANEW = 4
"""frames after which the ids of splats that fill come again"""

LEAVING = 8.0
"""cells before the open sides of the box over which smoke fades out that no film shows there: most of the free space
that a draft's box has around what was filmed"""

STRONGER = 4.0
"""times, by which smoke at the inlet may differ from that of the first instant, either way: more is another scene"""

LOOKED_AT = 12
"""frames, spread over the film, that the mean at the inlet is taken of"""

FAR = 1e6
"""px beside the picture at most"""

AS_BODY = "its smoke looks as dense as the body at rest"
"""what follows where there is no film to play"""


def smoke_film(path: Path, size: tuple[int, int]) -> SmokeFilm | str:
    """The film of an asset's smoke; or what is wrong with it, in words.

    Args:
        path: its file.
        size: of the clip, px.
    """
    if not path.is_file():
        return f"is missing: {AS_BODY}; make the asset again"
    written = path.stat()
    return _read(path, size, (written.st_mtime_ns, written.st_size))


@lru_cache(maxsize=1)
def _read(path: Path, size: tuple[int, int], written: tuple[int, int]) -> SmokeFilm | str:
    """As `smoke_film`, of a file as it was `written`. The last one is kept: a live preview begins anew with every
    edit."""
    from fluidlift.io.footage_file import read_smoke
    from fluidlift.look.smoke_film import SmokeFilm

    try:
        return SmokeFilm(*read_smoke(path, size))
    except InputRejected as error:
        return f"is damaged ({error.got}): {AS_BODY}; make the asset again"


class SmokeAppearance:
    """Splats for the particles of smoke.

    Args:
        scene: that is simulated.
        film: of the smoke.
    """

    def __init__(self, scene: Scene, film: SmokeFilm) -> None:
        from fluidlift.look.smoke_splats import shared_depth

        self._film, self._scene = film, scene
        height, width = film.opacities.shape[1:]
        self._camera: PinholeCamera = scene.camera.resized((width, height))
        self._start = scene.film_start * film.interval
        self._whole = self._start + (scene.frames - 1) * scene.interval
        color, depth = film.layer(min(scene.film_start, len(film) - 1))
        uv, pixel = self._seen(scene.rest.means)
        wide = self._widest(pixel)
        self._amounts = shared_depth(uv, CARRIED * wide, depth, np.zeros(len(uv))) * _area(CARRIED * wide, pixel)
        self._colors = sampled(color, uv[:, ::-1] - 0.5)
        self._mass = scene.parameters.density * (CARRIED * scene.terrain.grid.spacing) ** 3
        self._first = int(scene.body.ids.max()) + 1 if len(scene.body.ids) else 0
        self._inflow = self._inflow_over_first(uv, depth)
        leaves = scene.cell_types == CellType.OUTFLOW
        self._away = ndimage.distance_transform_edt(~leaves) if leaves.any() else np.full(leaves.shape, np.inf)

    def _inflow_over_first(self, uv: np.ndarray, depth: np.ndarray) -> float:
        """Smoke at the inlet in the mean of the film, over that of the first instant.

        Args:
            uv: where the body at rest is seen, px.
            depth: optical depth of the film's first instant.
        """
        from fluidlift.physics.inlet import beside_inlet
        from fluidlift.scene.simulator import SOURCE

        scene = self._scene
        near = beside_inlet(scene.rest.means, scene.cell_types, scene.terrain.grid, SOURCE)
        cells = np.floor(uv[near]).astype(np.int64)
        cells = cells[((cells >= 0) & (cells < np.array(depth.shape[::-1]))).all(axis=1)]
        if not len(cells):
            return 1.0
        there = np.zeros(depth.shape, bool)
        there[cells[:, 1], cells[:, 0]] = True
        looked = np.unique(np.linspace(0, len(self._film) - 1, LOOKED_AT).round().astype(int))
        mean = np.mean([self._film.layer(t)[1][there].sum() for t in looked])
        return float(np.clip(mean / max(depth[there].sum(), 1e-9), 1.0 / STRONGER, STRONGER))

    def _carried(self, particles: Particles, about: np.ndarray, pixel: np.ndarray) -> np.ndarray:
        """Optical depth that particles bring, each over a width (px): what they had at rest or came in with, and none
        where they leave."""
        grid = self._scene.terrain.grid
        cells = np.clip(grid.cell_of(particles.positions), 0, np.asarray(grid.shape) - 1)
        amounts = self._amounts[particles.source] / _area(about, pixel)
        # where a particle stands for others as well (`GasSimulator.most`), for as much smoke as its mass says
        stands_for = np.maximum(particles.masses / self._mass, 1.0)
        came_in = np.where(particles.ids >= self._first, self._inflow * stands_for, 1.0)
        return amounts * came_in * smoothstep(self._away[tuple(cells.T)], 0.0, LEAVING)

    def _seen(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Where points (m) are seen, px, and m of a pixel there."""
        uv, depth = self._camera.project(points)
        behind = depth <= 0
        uv = np.clip(np.where(behind[:, None], -FAR, uv), -FAR, FAR)
        return uv, np.maximum(depth, 1e-6) / self._camera.focal[0]

    def _widest(self, pixel: np.ndarray) -> np.ndarray:
        return WIDEST * self._scene.terrain.grid.spacing / pixel

    def dressed(
        self, shown: Gaussians, particles: Particles, number: int, own: np.ndarray
    ) -> tuple[Gaussians, np.ndarray, np.ndarray]:
        """The splats of a frame, round, as dense and of the color that the smoke has there; ids, even of particles and
        odd of splats where the film shows smoke that the simulation lacks; and velocities, m/s.

        Args:
            shown: one splat for each particle.
            particles: of the frame.
            number: of the frame, from 0.
            own: bool, which particles bring a color of their own.
        """
        from fluidlift.look.smoke_splats import depth_of, drawn_splats, opacity_of, shared_depth

        uv, pixel = self._seen(particles.positions)
        wide = self._widest(pixel)
        about = CARRIED * wide
        carried = self._carried(particles, about, pixel)
        colors = self._colors[particles.source]
        inside = np.all((uv >= 0) & (uv <= np.array(self._camera.size)), axis=1)
        time, film, filmed = self._start + number * self._scene.interval, None, np.zeros(0)
        share = self._filmed(time)
        simulated = depth_of(uv, about, carried, self._camera.size) if share < 1.0 else 0.0
        if share > 0.0:
            film, filmed = self._film.at(time, self._whole)
            at = share * inside[:, None]
            colors = (1.0 - at) * colors + at * sampled(film, uv[:, ::-1] - 0.5)
            filmed = share * filmed
        depth = np.asarray(simulated if film is None else filmed + (1.0 - share) * simulated)
        drawn, widths = drawn_splats(uv, wide, depth, _chance(particles.ids))
        widths, weight = np.where(inside, widths, about), np.zeros(len(uv))
        first = carried * np.square(about / widths)
        weight[drawn] = shared_depth(uv[drawn], widths[drawn], depth, first[drawn])
        sh = shown.sh.copy()
        sh[:, 1:] = 0.0
        sh[:, :1] = np.where(own[:, None, None], shown.sh[:, :1], sh_from_rgb(colors))
        scales = np.repeat((widths * pixel)[:, None], 3, axis=1).astype(np.float32)
        opacities = np.maximum(opacity_of(weight), FAINT).astype(np.float32)
        found = replace(shown, scales=scales, opacities=opacities, sh=sh), 2 * particles.ids, particles.velocities
        if film is None or not drawn.any():
            return found
        there = depth_of(uv[drawn], widths[drawn], weight[drawn], self._camera.size)
        gaussians, places, moving = self._filled(particles, uv, pixel, filmed, there, film)
        # they are there for one frame: none of the next ones is the same
        more = gaussians, 2 * (ANEW * places + number % ANEW) + 1, moving
        return (
            concatenate([found[0], more[0]]),
            np.concatenate([found[1], more[1]]),
            np.concatenate([found[2], more[2]]),
        )

    def _filled(
        self, particles: Particles, uv: np.ndarray, pixel: np.ndarray, depth: np.ndarray, there: np.ndarray,
        film: np.ndarray,
    ) -> tuple[Gaussians, np.ndarray, np.ndarray]:  # fmt: skip
        """Splats where a film shows smoke and the simulation has little of it, as far from the camera as the simulated
        smoke next to them; a number of the place of each; velocities (m/s).

        Args:
            particles: of the frame.
            uv: where they are seen, px.
            pixel: m of a pixel there.
            depth: optical depth in the film.
            there: optical depth of the simulated smoke.
            film: its colors.
        """
        from fluidlift.look.smoke_splats import FINEST, TOGETHER, opacity_of, shared_depth

        cell = self._scene.terrain.grid.spacing / float(np.median(pixel))
        near = _NearestSmoke.of(uv, pixel * self._camera.focal[0], particles.velocities, depth.shape)
        depth = depth * (1.0 - smoothstep(near.away, ASTRAY * cell, 2.0 * ASTRAY * cell))
        holes = (there < LACKING * depth) | (np.exp(-there) - np.exp(-depth) > SPOT)
        lacking = (depth > SEEN) & holes
        step = max(round(cell / FINER), 1)
        lattice = np.zeros(depth.shape, bool)
        lattice[::step, ::step] = True
        rows, columns = np.nonzero(lacking & lattice)
        each = round(TOGETHER / (2.0 * np.pi * FINEST**2))
        index = np.repeat((rows * depth.shape[1] + columns) * each, each) + np.tile(np.arange(each), len(rows))
        at = np.repeat(np.stack([columns, rows], axis=1), each, axis=0) + step * np.stack(
            [_chance(3 * index), _chance(3 * index + 1)], axis=1
        )
        far = near.distances(rows, columns, each) + (_chance(3 * index + 2) - 0.5) * near.thickness(rows, columns, each)
        widths = np.full(len(index), FINEST * step)
        weight = shared_depth(at, widths, np.maximum(depth - there, 0.0), np.zeros(len(index)))
        gaussians = Gaussians.isotropic(
            self._camera.unproject(at, far), widths * far / self._camera.focal[0], sampled(film, at[:, ::-1] - 0.5)
        )
        opacities = np.maximum(opacity_of(weight), FAINT).astype(np.float32)
        moving = near.velocities(rows, columns, each)
        return replace(gaussians, opacities=opacities), index, moving.astype(particles.velocities.dtype)

    def _filmed(self, time: float) -> float:
        """How far the film says at a time of it how thin the smoke is, 0 to 1."""
        if self._scene.edited:
            return 0.0
        if not self._film.spreads:
            return 1.0
        return float(np.clip(1.0 - (time - self._film.end) / HANDED_OVER, 0.0, 1.0))


class _NearestSmoke(NamedTuple):
    """The simulated smoke that is seen next to each pixel."""

    away: np.ndarray
    """px to it, [h,w]"""
    index: np.ndarray
    """row and column of it, [2,h,w]"""
    means: np.ndarray
    """[h,w,5]: distance from the camera and its square (m, m^2), velocity (m/s)"""

    @classmethod
    def of(cls, uv: np.ndarray, distance: np.ndarray, velocities: np.ndarray, shape: tuple[int, int]) -> _NearestSmoke:
        """Of particles seen at places (px) of a picture, at distances from the camera (m)."""
        cells = np.floor(uv).astype(np.int64)
        inside = ((cells >= 0) & (cells < np.array(shape[::-1]))).all(axis=1)
        flat = cells[inside, 1] * shape[1] + cells[inside, 0]
        values = np.concatenate([distance[:, None], distance[:, None] ** 2, velocities], axis=1)[inside]
        size = shape[0] * shape[1]
        count = np.bincount(flat, minlength=size)
        means = [np.bincount(flat, weights=v, minlength=size) / np.maximum(count, 1) for v in values.T]
        empty = count.reshape(shape) == 0
        if empty.all():
            return cls(np.full(shape, np.inf), np.zeros((2, *shape), int), np.zeros((*shape, 5)))
        away, index = ndimage.distance_transform_edt(empty, return_indices=True)
        return cls(away, index, np.stack(means, axis=-1).reshape(*shape, 5))

    def _at(self, rows: np.ndarray, columns: np.ndarray, each: int) -> np.ndarray:
        return np.repeat(self.means[tuple(self.index[:, rows, columns])], each, axis=0)

    def distances(self, rows: np.ndarray, columns: np.ndarray, each: int) -> np.ndarray:
        """m, of the smoke next to pixels, so many times each."""
        return self._at(rows, columns, each)[:, 0]

    def thickness(self, rows: np.ndarray, columns: np.ndarray, each: int) -> np.ndarray:
        """m, of that smoke along the view: of a body that is as thick everywhere, from its spread."""
        found = self._at(rows, columns, each)
        return np.sqrt(12.0 * np.maximum(found[:, 1] - found[:, 0] ** 2, 0.0))

    def velocities(self, rows: np.ndarray, columns: np.ndarray, each: int) -> np.ndarray:
        """m/s, of that smoke."""
        return self._at(rows, columns, each)[:, 2:]


def _area(widths: np.ndarray, pixel: np.ndarray) -> np.ndarray:
    """Area (m^2) that splats of a standard deviation (px) darken by an optical depth of 1."""
    return 2.0 * np.pi * np.square(widths * pixel)


def _chance(ids: np.ndarray) -> np.ndarray:
    """A number from 0 to 1 for each id, the same in each frame (the mixing steps of Steele et al. 2014, SplitMix64)."""
    x = np.asarray(ids).astype(np.uint64) * np.uint64(0x9E3779B97F4A7C15)
    x = (x ^ (x >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    x = (x ^ (x >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return (x ^ (x >> np.uint64(31))).astype(np.float64) / 2.0**64
