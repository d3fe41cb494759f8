"""Splats of white water, and the foam that a film shows."""

import numpy as np
import pytest

from fluidlift.export.splats import kind_column
from fluidlift.export.whitewater import with_kinds
from fluidlift.io.frames import FluidFrame
from fluidlift.io.ply import read_splats, write_gaussians
from fluidlift.look.surface_skin import of_skin, without_skin
from fluidlift.look.whitewater_splats import WHITE, FilmedFoam, kinds_of, whitewater_splats
from fluidlift.types import Gaussians, concatenate

CELL = 0.03


def splats(n=60, cell=CELL):
    rng = np.random.default_rng(0)
    kinds = (np.arange(n) % 3).astype(np.uint8)
    return whitewater_splats(rng.normal(size=(n, 3)), kinds, rng.uniform(0, 2, n), (0.9, 0.92, 0.95), cell), kinds


def told(gaussians):
    """A frame of them, at rest."""
    return FluidFrame(gaussians, np.arange(len(gaussians)), np.zeros((len(gaussians), 3), np.float32))


def test_kinds_are_told_by_size_also_from_a_file(tmp_path):
    white, kinds = splats()
    body = Gaussians.isotropic(np.random.default_rng(1).normal(size=(50, 3)), 0.16 * CELL, np.full((50, 3), 0.4), 0.9)
    both = concatenate([body, white])
    write_gaussians(tmp_path / "frame.ply", both, extras=kind_column(with_kinds(told(both), CELL)))
    read = read_splats(tmp_path / "frame.ply")
    wanted = np.concatenate([np.full(50, -1), kinds])
    np.testing.assert_array_equal(kinds_of(read.gaussians, CELL), wanted)
    np.testing.assert_array_equal(read.extras["kind"], wanted)
    np.testing.assert_array_equal(of_skin(read.gaussians, CELL), wanted >= 0)
    assert len(without_skin(both, CELL)) == 50 and (kinds_of(both, 1.1 * CELL) < 0).all()
    assert kind_column(told(body)) == {} and len(kinds_of(Gaussians.empty(), CELL)) == 0


def test_foam_is_denser_than_bubbles_and_fades_before_its_end():
    white, kinds = splats(3000)
    assert white.opacities[kinds == 1].mean() > 2 * white.opacities[kinds == 2].mean()
    places, foam = np.zeros((3, 3)), np.ones(3, np.uint8)
    faded = whitewater_splats(places, foam, np.array([9.0, 0.5, 0.01]), WHITE, CELL).opacities
    assert faded[0] > 1.5 * faded[1] > 3 * faded[2] > 0


def film(share, foam=(230, 235, 240), water=(40, 90, 110)):
    frames = np.full((10, 40, 50, 3), water, np.uint8)
    frames[:, :, : round(50 * share)] = foam
    return frames, np.ones(frames.shape[:3], bool)


def test_bright_grey_pixels_are_foam():
    found = FilmedFoam.of(*film(0.2))
    assert found.share == pytest.approx(0.2)
    np.testing.assert_allclose(found.color, np.array([230, 235, 240]) / 255, atol=1e-6)
    assert (found.places[:, :10] == 1).all() and (found.places[:, 10:] == 0).all()


@pytest.mark.parametrize(
    "given",
    [
        film(0.2, foam=(240, 200, 60)), film(0.2, foam=(120, 122, 125)), film(1.0), film(0.0),
        film(0.3, water=(225,) * 3),
    ],
    ids=["yellow", "dim", "milk", "none", "pale water"],
)  # fmt: skip
def test_what_is_coloured_dim_or_white_throughout_is_no_foam(given):
    found = FilmedFoam.of(*given)
    assert found.share == 0.0 and found.color == WHITE


def test_only_pixels_of_the_fluid_count():
    frames, fluid = film(0.2)
    fluid[:, :, :10] = False
    assert FilmedFoam.of(frames, fluid).share == 0.0 and FilmedFoam.of(frames, np.zeros_like(fluid)).share == 0.0
