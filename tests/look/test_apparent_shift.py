"""A look taken where splats appear comes out where it was taken; at their centres, it comes out displaced."""

from dataclasses import replace

import numpy as np
import pytest

from fluidlift.look.apparent_shift import FARTHEST, apparent_shift
from fluidlift.look.rasterize import render
from fluidlift.look.surface_map import sampled
from fluidlift.types import Gaussians, PinholeCamera, RigidTransform, sh_from_rgb

SIZE = (96, 64)
COUNT = 150


def plane(tilt, spacing_px, seed=0):
    """Splats of a skin on z = 0, a metre apart, and a camera far off that looks down by `tilt` degrees."""
    rng = np.random.default_rng(seed)
    places = np.indices((COUNT, COUNT)).reshape(2, -1).T - COUNT / 2 + rng.uniform(-0.25, 0.25, (COUNT**2, 2))
    n, angle, away = len(places), np.radians(tilt), 400.0
    eye = np.array([0.0, -away * np.cos(angle), away * np.sin(angle)])
    forward, right = -eye / away, np.array([1.0, 0.0, 0.0])
    turn = np.stack([right, np.cross(forward, right), forward])
    camera = PinholeCamera((spacing_px * away,) * 2, (48.0, 32.0), SIZE, RigidTransform(turn, -turn @ eye))
    means = np.column_stack([places, np.zeros(n)]).astype(np.float32)
    scales = np.tile(np.float32([0.55, 0.55, 0.16]), (n, 1))
    quats = np.tile(np.float32([1, 0, 0, 0]), (n, 1))
    return Gaussians(means, quats, scales, np.full(n, 0.9, np.float32), sh_from_rgb(np.full((n, 3), 0.5))), camera


def waves(index):
    """Grey [n,3] by row and column: lines across the picture, 9 px apart."""
    return np.repeat(0.5 + 0.4 * np.sin(2 * np.pi * index[:, :1] / 9.0), 3, axis=1)


@pytest.mark.parametrize("tilt, spacing", [(12, 1.7), (25, 1.7), (25, 3.0), (50, 1.7)])
def test_a_pattern_looked_up_where_splats_appear_is_in_its_place(tilt, spacing):
    splats, camera = plane(tilt, spacing)
    index = camera.project(splats.means)[0][:, ::-1] - 0.5
    shift = apparent_shift(splats, camera)
    rows, columns = np.indices(SIZE[::-1])
    truth = waves(np.stack([rows.ravel(), columns.ravel()], -1)).reshape(*SIZE[::-1], 3)
    inner = np.s_[14:-14, 14:-14]
    off = []
    for places in (index, index + sampled(shift, index)):
        drawn = render(replace(splats, sh=sh_from_rgb(waves(places))), camera)
        a, b = (x[inner][..., 0] - x[inner][..., 0].mean() for x in (drawn.image, truth))
        # phase of the lines, px
        phases = [np.angle((x * np.exp(-2j * np.pi * rows[inner] / 9.0)).sum()) for x in (a, b)]
        off.append(abs(9.0 * np.angle(np.exp(1j * (phases[0] - phases[1]))) / (2 * np.pi)))
    assert off[0] > 0.5, "the scene must be one in which it matters"
    assert off[1] < 0.15


def test_where_nothing_is_drawn_nothing_is_displaced():
    splats, camera = plane(25, 1.7)
    few = splats.select(np.flatnonzero(splats.means[:, 0] < -20))
    shift = apparent_shift(few, camera)
    assert np.isfinite(shift).all() and np.abs(shift).max() <= FARTHEST
    assert (shift[:, -20:] == 0).all() and (shift[30, 5] != 0).any()
