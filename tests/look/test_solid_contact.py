"""A liquid's surface next to solids: no dry ring around rocks, no film where no ground is near."""

import numpy as np
import pytest

from fluidlift.look.liquid import SurfaceBuffer
from fluidlift.look.outlet_section import OpenEnd
from fluidlift.look.solid_contact import carried_on, settled
from fluidlift.types import Grid, PinholeCamera, Terrain, TriangleMesh

CAMERA = PinholeCamera.looking(np.array([0.0, -2.0, 2.0]), np.array([0.0, 0.2, 0.0]), 45.0, (160, 120))
NOTHING = TriangleMesh(np.zeros((0, 3)), np.zeros((0, 3), int))
REACH, DEEP, BANK, STEEP = 0.1, 0.3, 0.5, np.tan(np.radians(60))
"""m; m; y of the foot of a bank, m; its slope"""
SHORE = BANK + DEEP / STEEP


def scene(gap: float) -> tuple[SurfaceBuffer, np.ndarray, np.ndarray]:
    """Water at z = 0 that ends `gap` (m) before its bank and at x = 0.4; the ground; where its plane is met."""
    rays, eye = CAMERA.rays(CAMERA.pixel_grid()), CAMERA.position
    z = -eye[2] / rays[..., 2]
    place = eye + z[..., None] * rays
    bed = (-DEEP - eye[2]) / rays[..., 2]
    bank = (STEEP * (eye[1] - BANK) - DEEP - eye[2]) / (rays[..., 2] - STEEP * rays[..., 1])
    ground = np.where(bank > 0, np.minimum(bed, bank), bed)
    wet = (place[..., 1] < SHORE - gap) & (place[..., 0] < 0.4)
    flat, up = wet.astype(np.float32), np.zeros((*wet.shape, 3), np.float32)
    up[wet] = 0, 0, 1
    thick = flat * (ground - z) * np.linalg.norm(rays, axis=-1)
    return SurfaceBuffer(flat * z, up, thick, 0.2 * np.ones_like(up), flat), ground, place


@pytest.mark.parametrize("gap", [0.3, 0.8])
def test_a_level_surface_goes_on_to_the_bank_that_comes_out_of_it(gap):
    surface, ground, place = scene(gap * REACH)
    found = carried_on(surface, ground, CAMERA, REACH)
    x, y = place[..., 0], place[..., 1]
    ring = (y > SHORE - gap * REACH) & (y < SHORE - 0.01) & (np.abs(x) < 0.25)
    assert ring.any() and not surface.covered[ring].any()
    assert (found.covered[ring] > 0.9).all()
    exact = -CAMERA.position[2] / CAMERA.rays(CAMERA.pixel_grid())[..., 2]
    np.testing.assert_allclose(found.depth[ring], exact[ring], rtol=1e-4)  # the mean of planes is a plane; float32
    room = (ground - exact) * np.linalg.norm(CAMERA.rays(CAMERA.pixel_grid()), axis=-1)
    np.testing.assert_allclose(found.thickness[ring], room[ring], atol=1e-3)
    np.testing.assert_allclose(found.normal[ring], np.broadcast_to((0, 0, 1), (ring.sum(), 3)), atol=1e-5)
    ashore = y > SHORE + 0.01
    assert not found.covered[ashore].any()


def test_what_there_was_stays_and_nothing_comes_where_no_ground_is_near():
    surface, ground, place = scene(0.5 * REACH)
    found = carried_on(surface, ground, CAMERA, REACH)
    wet = surface.covered > 0
    for name in ("depth", "normal", "thickness", "albedo", "covered"):
        np.testing.assert_array_equal(getattr(found, name)[wet], getattr(surface, name)[wet])
    open_end = (place[..., 0] > 0.4) & (place[..., 1] < SHORE - 2 * REACH)
    assert open_end.any() and not found.covered[open_end].any()
    air = carried_on(surface, np.zeros_like(ground), CAMERA, REACH)
    np.testing.assert_array_equal(air.covered, surface.covered)


def test_the_rim_of_a_surface_lies_on_its_shore_and_its_section_keeps_its_edge():
    grid = Grid((20, 20, 8), 0.1)
    terrain = Terrain(grid, (grid.nodes()[..., 0] - 0.5).astype(np.float32), np.array([0.0, 1.0, 0.0]), NOTHING)
    # a surface at z = 0.4 from the shore at x = 0.5 on, rounded over a cell there as particles round it
    x, y = (a.ravel() for a in np.meshgrid(np.arange(0.5, 1.5, 0.02), np.arange(0.5, 1.5, 0.02)))
    bent = np.clip(1.0 - (x - 0.5) / 0.1, 0.0, 0.95)
    normals = np.stack([-bent, np.zeros_like(x), np.sqrt(1.0 - bent**2)], -1)
    points = np.stack([x, y, np.full_like(x, 0.4)], -1)
    found = settled(points, normals, terrain)
    rim = x < 0.56
    assert normals[rim, 2].mean() < 0.8 and found[rim, 2].min() > 0.99
    np.testing.assert_array_equal(found[x > 0.75], normals[x > 0.75].astype(np.float32))
    end = OpenEnd(np.array([0.0, 1.0, 0.0]), 1.48, 0.1)
    kept = settled(points, normals, terrain, (end,))
    np.testing.assert_array_equal(kept[y > 1.45], normals[y > 1.45].astype(np.float32))
    assert kept[rim & (y < 1.3), 2].min() > 0.99
