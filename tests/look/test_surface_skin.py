"""Tracers float with the surface and cover it evenly."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial import cKDTree

from fluidlift.look.fluid_normals import fluid_depths, fluid_normals, fluid_surface
from fluidlift.look.rasterize import render
from fluidlift.look.surface_map import SurfaceMap
from fluidlift.look.surface_skin import (
    BARE,
    CROWDED,
    HIDING,
    PITCH,
    SEEN,
    SurfaceSkin,
    dyed,
    of_skin,
    painted_liquid,
    without_skin,
)
from fluidlift.types import Gaussians, PinholeCamera, RigidTransform, concatenate

CELL = 0.1
SPACING = PITCH * CELL


def surface(flow=lambda x, y: (0 * x, 0 * y), tilt: float = 0.0, reach: float = 2.0) -> SurfaceMap:
    x, y = (a.ravel() for a in np.meshgrid(*[np.arange(0.025, reach, 0.05)] * 2, indexing="ij"))
    points = np.stack([x, y, 0.5 + tilt * x], axis=-1)
    return SurfaceMap.of(points, np.stack([*flow(x, y), 0 * x], axis=-1), CELL)


def spread(skin: SurfaceSkin) -> tuple[float, float]:
    """Smallest distance between tracers, and largest from any wet place to one, in spacings."""
    closest = cKDTree(skin.places).query(skin.places, k=2)[0][:, 1].min()
    x, y = (a.ravel() for a in np.meshgrid(*[np.arange(0.2, 1.8, 0.005)] * 2))
    return closest / SPACING, cKDTree(skin.places).query(np.stack([x, y], axis=-1))[0].max() / SPACING


def advanced(where: SurfaceMap, frames: int, interval: float = 0.04) -> SurfaceSkin:
    skin = SurfaceSkin(CELL)
    for k in range(frames + 1):
        skin.advance(where, interval if k else 0.0, np.random.default_rng(k))
    return skin


@pytest.mark.parametrize("gain", [0.0, 1.0, -1.0])
def test_they_cover_a_surface_evenly_whether_it_spreads_or_gathers(gain):
    skin = advanced(surface(lambda x, y: (gain * (x - 1), gain * (y - 1))), 30)
    closest, gap = spread(skin)
    # new ones come where none is within 0.75, a quarter off either way along both axes
    assert closest >= min(CROWDED, BARE - 0.25 * np.sqrt(2)) and gap < 1.6


def test_each_moves_with_the_flow_under_its_id_and_ids_are_never_used_twice():
    where = surface(lambda x, y: (0.3 + 0 * x, -0.2 + 0 * y))
    skin = advanced(where, 3)
    before = dict(zip(skin.ids.tolist(), skin.places.copy()))
    known = skin.next_id
    skin.advance(where, 0.04, np.random.default_rng(9))
    same = [i for i in skin.ids.tolist() if i in before]
    assert len(same) > 0.9 * len(before) and len(set(skin.ids.tolist())) == len(skin)
    moved = dict(zip(skin.ids.tolist(), skin.places))
    steps = np.array([moved[i] - before[i] for i in same])
    np.testing.assert_allclose(steps, [[0.012, -0.008]] * len(same), atol=1e-9)
    assert min(set(skin.ids.tolist()) - set(before)) >= known


def test_splats_lie_flat_on_a_slope_in_the_colours_given():
    where = surface(tilt=0.5)
    skin = advanced(where, 0)
    colors = np.random.default_rng(0).uniform(0, 1, (len(skin), 3))
    g = skin.splats(where, colors)
    np.testing.assert_allclose(g.rgb, colors, atol=1e-6)
    inner = (np.abs(skin.places - 1) < 0.7).all(axis=1)
    thin = np.linalg.eigh(g.covariances()[inner].astype(np.float64))[1][:, :, 0]
    normal = np.array([-0.5, 0, 1]) / np.sqrt(1.25)
    assert np.abs(thin @ normal).min() > np.cos(np.radians(3))
    np.testing.assert_allclose(g.means[inner, 2], 0.5 + 0.5 * g.means[inner, 0], atol=0.1 * CELL)


@pytest.mark.parametrize("tilt", [0.0, 0.7, 3.0])
def test_a_skin_has_no_cracks_on_a_slope_and_is_known_there(tilt):
    """Looked at from above, where its tracers are as far apart as on a level surface."""
    where = surface(tilt=tilt)
    skin = advanced(where, 2)
    splats = skin.splats(where, np.full((len(skin), 3), 0.5))
    down = RigidTransform(np.diag([1.0, -1.0, -1.0]), np.array([-1.0, 1.0, 50.0]))
    camera = PinholeCamera((6000.0, 6000.0), (20.0, 20.0), (40, 40), down)
    alpha = render(splats, camera).alpha[5:-5, 5:-5]
    assert alpha.mean() > 0.93  # 0.95 where it is level
    assert of_skin(splats, CELL).all()
    assert not of_skin(replace(splats, scales=splats.scales * np.float32([1.0, 1.0, 1.01])), CELL).any()


def test_what_has_run_dry_has_no_skin():
    skin = advanced(surface(), 2)
    skin.advance(surface(reach=1.0), 0.04, np.random.default_rng(0))
    assert len(skin) and skin.places.max() < 1.0 + 0.5 * CELL


def test_cells_without_width_are_refused():
    with pytest.raises(ValueError, match="cell"):
        SurfaceSkin(0.0)


def painted() -> tuple[Gaussians, Gaussians]:
    """A body of particles half a cell apart, and the skin that floats on it."""
    x, y, z = (
        a.ravel() for a in np.meshgrid(*(np.arange(0.025, s, 0.5 * CELL) for s in (1.6, 1.6, 0.5)), indexing="ij")
    )
    rng = np.random.default_rng(1)
    sizes = rng.uniform(0.1, 0.4, (len(x), 3)) * CELL
    body = Gaussians.isotropic(np.stack([x, y, z], -1), 1.0, np.full((len(x), 3), 0.5), 0.9)
    body = Gaussians(body.means, body.quats, sizes.astype(np.float32), body.opacities, body.sh)
    where = surface(tilt=0.1, reach=1.6)
    skin = advanced(where, 2)
    return body, skin.splats(where, np.full((len(skin), 3), 0.5))


def test_splats_of_a_skin_are_known_by_their_size_in_a_file_as_well():
    body, skin = painted()
    logarithms = np.log(skin.scales).astype(np.float32)  # as files hold them
    skin = Gaussians(skin.means, skin.quats, np.exp(logarithms), skin.opacities, skin.sh)
    assert of_skin(skin, CELL).all() and not of_skin(body, CELL).any()
    assert not of_skin(skin, 1.05 * CELL).any()
    kept = without_skin(concatenate([body, skin]), CELL)
    np.testing.assert_array_equal(kept.means, body.means)
    assert without_skin(body, CELL) is body and len(of_skin(Gaussians.empty(), CELL)) == 0


def test_liquid_under_a_skin_has_its_colours_and_what_is_deep_its_own():
    body, skin = painted()
    skin = Gaussians(skin.means, skin.quats, skin.scales, skin.opacities, np.full_like(skin.sh, 1.0))
    liquid = painted_liquid(concatenate([body, skin]), CELL)
    np.testing.assert_array_equal(liquid.means, body.means)
    away = np.linalg.norm(liquid.means[:, None] - skin.means[None], axis=-1).min(axis=1)
    near, deep = away < 1.4 * CELL, away > 1.6 * CELL
    assert near.sum() > 100 and deep.sum() > 100
    np.testing.assert_array_equal(liquid.sh[near], 1.0)
    np.testing.assert_array_equal(liquid.sh[deep], body.sh[deep])
    assert painted_liquid(body, CELL) is body


@pytest.mark.parametrize("layer", [(0.0, 0.0), (0.0, 1.0), (2.0, 4.0), (0.0, 5.0)])
def test_dye_is_seen_through_the_skin_and_less_the_deeper_it_is(layer):
    at = np.arange(0.025, 1.0, 0.05)  # eight to a cell
    points = np.stack(np.meshgrid(at, at, at[at < 0.5], indexing="ij"), -1).reshape(-1, 3)  # 0.5 m, 5 cells deep
    skin_map = SurfaceMap.of(points, 0 * points, CELL)
    skin = advanced(skin_map, 0)
    depth = (0.5 - points[:, 2]) / CELL
    own = (depth > layer[0]) & (depth < layer[1])
    rgb = np.where(own[:, None], (0.1, 0.2, 0.9), (0.9, 0.9, 0.8))
    liquid = Gaussians.isotropic(points, 0.01, rgb, 0.9)
    white = np.full((len(skin), 3), 0.9)
    found = dyed(white, skin.points(skin_map), skin_map, liquid, own, CELL)
    seen = SEEN * (np.exp(-layer[0] / SEEN) - np.exp(-layer[1] / SEEN))  # cells of pure dye at the surface
    share = 1.0 - np.exp(-seen / HIDING)
    expected = (1.0 - share) * white + share * np.array([0.1, 0.2, 0.9])
    middle = (np.abs(skin.places - 0.5) < 0.3).all(axis=1)
    # its surface is found to a tenth of a cell, and layers begin between two rows of particles
    np.testing.assert_allclose(found[middle], expected[middle], atol=0.03)
    if not own.any():
        assert found is white


def test_a_skin_adds_nothing_to_the_body_that_it_floats_on():
    body, skin = painted()
    both, n = concatenate([body, skin]), len(body)
    normals, share = fluid_normals(body, 0.5 * CELL)
    found, belongs = fluid_normals(both, 0.5 * CELL)
    np.testing.assert_array_equal(found[:n], normals)
    np.testing.assert_array_equal(belongs[:n], share)
    np.testing.assert_array_equal(fluid_depths(both, found, 0.5 * CELL)[:n], fluid_depths(body, normals, 0.5 * CELL))
    np.testing.assert_array_equal(fluid_surface(both, 0.5 * CELL).vertices, fluid_surface(body, 0.5 * CELL).vertices)


def test_a_tracer_whose_sheet_is_gone_does_not_fly_to_the_one_behind_it():
    def level(height: float) -> SurfaceMap:
        x, y = np.meshgrid(*[np.arange(0.025, 2.0, 0.05)] * 2, indexing="ij")
        points = np.stack([x.ravel(), y.ravel(), np.where(x < 1.0, height, 1.0).ravel()], axis=-1)
        return SurfaceMap.of(points, np.zeros_like(points), 0.1)

    rng, skin = np.random.default_rng(0), SurfaceSkin(0.1)
    skin.advance(level(1.0), 0.0, rng)
    before = set(skin.ids.tolist())
    skin.advance(level(0.95), 0.04, rng)  # it sinks
    assert len(before) > 1000 and len(before & set(skin.ids.tolist())) > 0.97 * len(before)
    skin.advance(level(0.2), 0.04, rng)
    stayed = skin.places[np.isin(skin.ids, list(before))]
    assert len(stayed) > 50 and stayed[:, 0].min() > 0.8
    assert len(skin) > 0.9 * len(before), "others are there in their place"
