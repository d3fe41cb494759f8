"""Liquid surfaces in pictures, of particles and of meshes: where they lie, how thick they are, which way they face."""

import numba
import numpy as np
import pytest
import trimesh

from fluidlift.look.liquid import Behind, film_shown
from fluidlift.look.screen_space import GRAIN, mesh_surface, particle_surface
from fluidlift.look.screen_space_kernels import narrow_range, plane_normals
from fluidlift.numerics.srgb import linear_from_srgb
from fluidlift.types import PinholeCamera, TriangleMesh

RADIUS = 0.032
"""m, the usual share of the spacing of 0.04 m"""
CAMERA = PinholeCamera.looking((0.3, -3.0, 1.0), (0.0, 0.0, 0.0), 45.0, (160, 120))


def box(size=(1.6, 0.48, 0.8), spacing=0.04, jitter=0.0):
    """Particles that fill a box about the origin."""
    axes = [np.arange(-0.5 * s + 0.5 * spacing, 0.5 * s, spacing) for s in size]
    points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    return points + jitter * spacing * np.random.default_rng(0).uniform(-1, 1, points.shape)


def ball_depths(camera, centre, radius):
    """Camera z of a ball's front (m) and length of the ray in it; nan beside it."""
    rays = camera.rays(camera.pixel_grid())
    away = camera.position - centre
    a, b, c = (rays**2).sum(-1), rays @ away, away @ away - radius**2
    with np.errstate(invalid="ignore"):
        root = np.sqrt(b * b - a * c)
    return (-b - root) / a, 2 * root / np.sqrt(a)


def test_one_sphere_lies_where_the_formula_says_before_it_is_smoothed():
    from fluidlift.look.screen_space import _sphere_depth

    centre, radius = np.array([0.2, 0.1, -0.1]), 0.4
    depth, _ = _sphere_depth(centre[None].astype(np.float32), radius, CAMERA)
    expected, _ = ball_depths(CAMERA, centre, radius)
    inner = ball_depths(CAMERA, centre, 0.999 * radius)[0]
    sure = np.isfinite(inner)  # on the outline itself rounding decides
    np.testing.assert_allclose(depth[sure], expected[sure], rtol=2e-5)  # root of a small float32 at the outline
    outer = np.isfinite(ball_depths(CAMERA, centre, 1.001 * radius)[0])
    assert not np.isfinite(depth[~outer]).any()


def sphere_depth_plain(points, radius, camera):
    """Camera z of the nearest of all spheres in every pixel, one after the other; infinite: none."""
    depth = np.full((camera.size[1], camera.size[0]), np.inf)
    for centre in points:
        found = ball_depths(camera, centre, radius)[0]
        depth = np.fmin(depth, np.where(np.isfinite(found), found, np.inf))
    return depth


def test_spheres_left_out_because_others_hide_them_are_missed_nowhere():
    from fluidlift.look.screen_space import _sphere_depth

    # deep enough for most to be hidden, and more of them in a band than are drawn before that is looked for
    points = box((0.9, 0.9, 0.5), spacing=0.06, jitter=0.5).astype(np.float32)
    camera = CAMERA.resized((80, 60))
    depth, _ = _sphere_depth(points, 0.05, camera)
    expected = sphere_depth_plain(points, 0.05, camera)
    both = np.isfinite(depth) & np.isfinite(expected)
    assert (np.isfinite(depth) != np.isfinite(expected)).mean() < 1e-3  # rounding on an outline itself
    # float32; within 1e-4 of a radius of an outline the root of a small number is good to 1 % of it: 1e-3 m at most
    error = np.abs(depth[both] - expected[both])
    assert np.percentile(error, 99) < 1e-5 and error.max() < 1e-3


def test_a_box_of_particles_is_as_thick_as_the_box():
    # seen from straight before it, 0.48 m deep; parallel enough at 20 m
    camera = PinholeCamera.looking((0.0, -20.0, 0.0), (0.0, 0.0, 0.0), 5.0, (120, 90))
    for jitter in (0.0, 0.3):
        surface = particle_surface(box(jitter=jitter), RADIUS, camera)
        middle = slice(35, 55), slice(40, 80)
        # spheres stand for their volume, so that the mean is the box's; what is seen of the lattice or of the jitter is
        # evened out to 5 % by the smoothing over 0.8 radii
        thickness = surface.thickness[middle]
        assert thickness.mean() == pytest.approx(0.48, rel=0.02)
        assert thickness.std() < 0.05 * 0.48
        # the outermost particles lie half a spacing (0.6 radii) within the box and the spheres reach a radius out
        front = surface.depth[middle] - (20.0 - 0.24)
        assert -0.5 * RADIUS - jitter * 0.04 < front.min() and front.max() < 0.3 * RADIUS + jitter * 0.04
        assert np.ptp(front) < (0.1 if jitter == 0 else 0.6) * RADIUS  # spheres next to each other: 0.22 radii
        assert (surface.covered[middle] == 1).all()
        assert (surface.normal[middle] @ np.array([0.0, -1.0, 0.0])).min() > (0.999 if jitter == 0 else 0.9)


def test_thickness_is_the_same_at_any_resolution():
    # at the larger size it is summed at half the resolution
    small = particle_surface(box(jitter=0.2), RADIUS, CAMERA)
    large = particle_surface(box(jitter=0.2), RADIUS, CAMERA.resized((640, 480)))
    coarse = large.thickness.reshape(120, 4, 160, 4).mean(axis=(1, 3))
    both = (small.covered == 1) & (coarse > 0.2)
    assert both.sum() > 2000
    assert np.median(np.abs(coarse - small.thickness)[both] / coarse[both]) < 0.03


def test_a_mesh_is_as_thick_and_as_far_as_the_ball_it_is_of():
    ball = trimesh.creation.icosphere(subdivisions=5, radius=0.7)
    colors = np.tile([0.5, 0.25, 1.0], (len(ball.vertices), 1))
    surface = mesh_surface(TriangleMesh(np.array(ball.vertices), np.array(ball.faces), colors), CAMERA)
    expected, chord = ball_depths(CAMERA, np.zeros(3), 0.7)
    sure = chord > 0.3  # near the outline the chord of a polyhedron differs without bound
    np.testing.assert_allclose(surface.depth[sure], expected[sure], atol=2e-3)  # the sagitta of its faces, slanted
    np.testing.assert_allclose(surface.thickness[sure], chord[sure], atol=4e-3)
    points = CAMERA.unproject(CAMERA.pixel_grid(), surface.depth)
    np.testing.assert_allclose(surface.normal[sure], (points / 0.7)[sure], atol=5e-3)
    np.testing.assert_allclose(
        surface.albedo[sure], np.broadcast_to(linear_from_srgb(colors[0]), (sure.sum(), 3)), rtol=1e-5
    )
    assert surface.back_normal is not None
    ends = points + surface.thickness[..., None] * _unit(CAMERA.rays(CAMERA.pixel_grid()))
    np.testing.assert_allclose(surface.back_normal[sure], (ends / 0.7)[sure], atol=1e-2)


def _unit(v):
    return v / np.linalg.norm(v, axis=-1, keepdims=True)


def test_the_outline_of_a_mesh_is_soft_and_what_it_covers_in_part_looks_like_it():
    ball = trimesh.creation.icosphere(subdivisions=4, radius=0.7)
    surface = mesh_surface(TriangleMesh(np.array(ball.vertices), np.array(ball.faces)), CAMERA)
    part = (surface.covered > 0) & (surface.covered < 1)
    assert part.any() and (surface.depth[part] > 0).all()
    np.testing.assert_allclose(np.linalg.norm(surface.normal[part], axis=-1), 1.0, atol=1e-5)
    # what is covered in all is what the ball covers
    rays = CAMERA.rays(CAMERA.pixel_grid())
    inside = np.isfinite(ball_depths(CAMERA, np.zeros(3), 0.7)[0]).sum()
    assert rays.size and surface.covered.sum() == pytest.approx(inside, rel=0.01)


def test_smoothing_keeps_planes_and_steps_and_evens_bumps_out():
    u, v = np.meshgrid(np.arange(80.0), np.arange(60.0))
    plane = (0.5 + 0.001 * u + 0.002 * v).astype(np.float32)  # inverse depths of a plane
    focal, width, apart, limit, fall = 100.0, np.float32(0.08), np.float32(1.7), np.float32(0.3), np.float32(0.1)

    def passes(q):
        a, b = np.empty_like(q), np.empty_like(q)
        narrow_range(q, a, True, focal, width, apart, limit, fall)
        narrow_range(a, b, False, focal, width, apart, limit, fall)
        return b

    np.testing.assert_allclose(passes(plane), plane, rtol=1e-6)  # up to the picture's rim
    rough = plane + np.float32(0.01) * np.random.default_rng(0).standard_normal(plane.shape).astype(np.float32)
    assert (passes(rough) - plane)[10:-10, 10:-10].std() < 0.2 * 0.01
    step = np.where(u < 40, plane, plane + 0.5).astype(np.float32)  # another surface, much nearer
    after = passes(step)
    np.testing.assert_allclose(after[:, 60:], step[:, 60:], rtol=1e-6)
    np.testing.assert_allclose(after[:, :40], step[:, :40], rtol=1e-6)  # the farther one is a plane up to its edge
    # there it is smoothed like elsewhere, from one side: a line through half of the window has four times the variance
    # at its end, twice the deviation
    bumpy = passes(np.where(u < 40, rough, rough + 0.5).astype(np.float32)) - step
    assert bumpy[10:-10, 36:40].std() < 2.0 * 0.2 * 0.01
    # nothing lies between the two: the nearer one falls off at its rim by half of `fall` at most, 0.05 m at 1 / 1.2 m
    assert (np.abs(after - step) < 0.5 * fall * 1.2**2).all()
    gone = np.where(u < 40, plane, 0).astype(np.float32)
    np.testing.assert_array_equal(passes(gone) > 0, gone > 0)


def test_normals_of_a_plane_are_exact_at_any_slant():
    normal = np.array([0.3, -0.7, 0.6]) / np.linalg.norm([0.3, -0.7, 0.6])
    rays = CAMERA.rays(CAMERA.pixel_grid())
    z = -(CAMERA.position @ normal) / (rays @ normal)
    lens = np.array([*CAMERA.focal, *CAMERA.center])
    out = np.zeros((120, 160, 3), np.float32)
    rotation = np.asarray(CAMERA.camera_from_world.rotation, np.float64)
    plane_normals((1 / z).astype(np.float32), lens, rotation, np.float32(10.0), out)
    # differences of float32 over a pixel of 1/190 rad
    np.testing.assert_allclose(out, np.broadcast_to(normal, out.shape), atol=1e-4)


def test_particles_carry_the_colours_of_those_that_are_seen():
    points = box()
    colors = np.where(points[:, 1:2] < 0, [1.0, 0.0, 0.0], [0.0, 0.0, 1.0])  # red in front, blue behind
    camera = PinholeCamera.looking((0.0, -20.0, 0.0), (0.0, 0.0, 0.0), 5.0, (120, 90))
    albedo = particle_surface(points, RADIUS, camera, colors).albedo[35:55, 40:80]
    np.testing.assert_allclose(albedo, np.broadcast_to([1.0, 0.0, 0.0], albedo.shape), atol=1e-5)


def test_colours_lie_on_the_surface_also_where_it_is_seen_at_a_slant():
    points, e = box((1.2, 1.6, 0.2)), np.radians(25.0)
    camera = PinholeCamera.looking((0.0, -3.0 * np.cos(e), 3.0 * np.sin(e)), (0.0, 0.0, 0.1), 26.0, (160, 120))
    colors = np.where(np.abs(points[:, 1:2]) < 0.1, [1.0, 0.0, 0.0], [0.0, 0.0, 1.0])  # all the way down
    surface, middle = particle_surface(points, RADIUS, camera, colors), (slice(None), slice(76, 84))
    there = (surface.covered > 0.9)[middle]
    y = camera.unproject(camera.pixel_grid()[middle], surface.depth[middle])[..., 1]
    red = surface.albedo[middle][..., 0] * there
    # the next layer, 1.25 radii down, is seen 2.7 radii nearer to the viewer: spheres that weigh as much as they are
    # long in the line of sight draw the stripe there
    off = (red * y).sum() / red.sum() - y[there & (np.abs(y) < 0.1)].mean()
    assert abs(off) < 1.5 * RADIUS


def test_nothing_far_and_broken_particles_draw_nothing():
    points = np.array([[np.nan, 0, 0], [0.0, -4.0, 1.5], [0.3, -3.0, 1.02]])  # no number, behind, around the camera
    for some in (points, np.zeros((0, 3))):
        surface = particle_surface(some, RADIUS, CAMERA)
        assert not surface.covered.any() and not surface.depth.any()
    empty = mesh_surface(TriangleMesh(np.zeros((0, 3)), np.zeros((0, 3), int)), CAMERA)
    assert not empty.covered.any()
    with pytest.raises(ValueError, match="radius"):
        particle_surface(points, 0.0, CAMERA)
    with pytest.raises(ValueError, match="colours"):
        particle_surface(points, 0.1, CAMERA, np.zeros((2, 3)))


def test_pictures_are_the_same_bits_with_any_number_of_threads():
    points, colors = box(jitter=0.3), np.random.default_rng(0).uniform(0, 1, (len(box()), 3))
    many = particle_surface(points, RADIUS, CAMERA, colors)
    threads = numba.get_num_threads()
    numba.set_num_threads(1)
    try:
        one = particle_surface(points, RADIUS, CAMERA, colors)
    finally:
        numba.set_num_threads(threads)
    for name in ("depth", "normal", "thickness", "albedo", "covered"):
        np.testing.assert_array_equal(getattr(one, name), getattr(many, name))


def narrow_range_plain(q, across, focal, width, apart, limit, fall, lanes=32):
    """What `narrow_range` does, pixel by pixel; the distance of the pairs is that of the smallest bell of its lanes."""
    out, (h, w) = q.astype(np.float64), q.shape
    wide = np.where(q > 0, focal * width * q, 0.0)
    wide[wide <= 0.3] = 0.0
    for row in range(h):
        for first in range(0, w, lanes):
            some = wide[row, first : first + lanes]
            if not some.any():
                continue
            stride = max(int(some[some > 0].min() / apart), 1)
            steps = min(max(int(2.0 * some.max() / stride), 1), 40)
            for col in np.flatnonzero(some) + first:
                own = float(q[row, col])
                low, high = own - limit * own**2, own + limit * own**2
                found, going = [(0.0, 1.0, own)], {-1, 1}  # where, weight, inverse depth
                for k in range(1, steps + 1):
                    met = {}
                    for side in sorted(going):
                        r, c = row + side * k * stride * (not across), col + side * k * stride * across
                        value = abs(float(q[r, c])) if 0 <= r < h and 0 <= c < w else np.inf
                        if value > high:
                            going.remove(side)
                        else:
                            met[side] = value
                    weight = np.exp(-0.5 * (k * stride / wide[row, col]) ** 2)
                    far = any(value <= low for value in met.values())
                    found += [(s * k, weight, v if v > low else own - fall * own**2) for s, v in met.items()]
                    if met and not far:
                        low = min(low, min(met.values()) - limit * own**2)
                        high = max(high, max(met.values()) + limit * own**2)
                place, weight, value = np.array(found).T
                if len(found) > 1:  # the line of least squares, at the pixel
                    out[row, col] = np.polyfit(place, value, 1, w=np.sqrt(weight))[1]
    return out


@pytest.mark.parametrize(("across", "apart"), [(True, 1.7), (False, 2.6)])
def test_the_compiled_smoothing_is_that_of_the_formula(across, apart):
    rng = np.random.default_rng(0)
    u, v = np.meshgrid(np.arange(75.0), np.arange(50.0))
    q = 0.5 + 0.002 * u + 0.001 * v + 0.01 * rng.standard_normal(u.shape)
    q[10:20, 30:50] += 0.6  # something nearer
    q[30:, 20:40] = 0.0  # nothing
    q[40:, 50:] *= -1.0  # ground
    q = q.astype(np.float32)
    settings = across, 100.0, np.float32(0.08), np.float32(apart), np.float32(0.3), np.float32(0.1)
    out = np.empty_like(q)
    narrow_range(q, out, *settings)
    # float32, and a bell that is a power of 64 of a short series: 1e-5
    np.testing.assert_allclose(out, narrow_range_plain(q, *settings), rtol=3e-5)


def test_through_a_gap_between_spheres_nothing_far_behind_is_seen():
    # a sheet one particle thick, a diameter and a half before another: between four spheres of the first one a gap
    camera = PinholeCamera.looking((0.0, 0.0, 3.0), (0.0, 0.0, 0.0), 30.0, (200, 200), up=(0.0, 1.0, 0.0))
    x, y = (v.ravel() for v in np.meshgrid(*2 * (np.arange(-8, 9) * 1.6 * RADIUS,)))
    sheets = [np.stack([x, y, np.full(x.shape, z)], -1) for z in (0.0, -6.0 * RADIUS)]
    surface = particle_surface(np.concatenate(sheets), RADIUS, camera)
    middle = slice(80, 120), slice(80, 120)
    assert np.ptp(surface.depth[middle]) < 0.5 * RADIUS
    assert surface.normal[middle][..., 2].min() > 0.97  # 14 degrees: the bumps of spheres so far apart


def test_beside_a_rock_before_it_water_faces_up_like_elsewhere():
    # a box hides half of a level pond: there the pond goes on behind it
    ground = np.full((120, 160), 10.0, np.float32)
    ground[:, 60:100] = 1.5
    pond = box((2.4, 2.4, 0.2), jitter=0.2) - [0.0, 0.0, 0.2]
    camera = PinholeCamera.looking((0.0, -2.0, 1.5), (0.0, 0.0, -0.1), 30.0, (160, 120))
    surface = particle_surface(pond, RADIUS, camera, ground=ground)
    assert not surface.depth[:, 60:100].any() and not surface.covered[:, 60:100].any()
    beside, open_water = (surface.normal[30:90, c, 2] for c in ([58, 59, 100, 101], slice(20, 50)))
    # without the pond behind the box the pixels at its rim keep the bumps of their spheres
    assert np.percentile(beside, 2) > np.percentile(open_water, 2) - 0.05


def test_pixels_between_those_that_are_averaged_do_not_come_apart_where_water_meets_a_bank():
    # rough water before a bank, 23 px to a radius: the smoothing takes every 13th pixel, in the end every sixth
    rng, camera = np.random.default_rng(0), PinholeCamera.looking((0, -1.0, 0.7), (0, 0, 0), 17.0, (240, 180))
    points = box((1.0, 1.0, 0.08), jitter=0.4)
    points[:, 2] += 0.02 * rng.standard_normal(len(points))
    surface = particle_surface(points, RADIUS, camera, ground=beach(camera, np.radians(12.0)).astype(np.float32))
    whole = surface.covered > 0.9
    whole[1:-1, 1:-1] &= whole[1:-1, :-2] & whole[1:-1, 2:] & whole[:-2, 1:-1] & whole[2:, 1:-1]
    for axis in (0, 1):
        n = surface.normal
        apart = np.linalg.norm(n - np.roll(n, 1, axis), axis=-1)[whole]
        # a slope that changes by 1 over a radius changes by 0.04 in a pixel; a weave has 0.16
        assert np.percentile(apart, 90) < 0.04, axis


SLOPE = np.radians(15.0)
"""of a beach, rising towards +x, whose shoreline is x = 0"""


def beach(camera, slope=SLOPE):
    """Camera z of the beach z = x tan(slope)."""
    normal = np.array([-np.sin(slope), 0.0, np.cos(slope)])
    rays = camera.rays(camera.pixel_grid())
    return -(camera.position @ normal) / (rays @ normal)


def pond(spacing=0.04):
    """Particles of a pond with its level at z = 0 on the beach: half a spacing below the level and above the bed."""
    points = box((2.4, 1.6, 0.6), spacing) - [1.2, 0.0, 0.3]
    over = points[:, 2] - points[:, 0] * np.tan(SLOPE)
    return points[over > 0.5 * spacing]


SHORE = PinholeCamera.looking((-0.4, -1.2, 1.6), (-0.3, 0.0, 0.0), 40.0, (320, 240))


def test_a_pond_ends_on_its_beach_without_a_rim_and_thins_out_to_nothing():
    ground = beach(SHORE).astype(np.float32)
    surface = particle_surface(pond(), RADIUS, SHORE, ground=ground)
    shown = surface.covered * film_shown(surface, Behind(np.zeros((240, 320, 3)), ground), SHORE)
    place = SHORE.unproject(SHORE.pixel_grid(), ground)
    inside = (np.abs(place[..., 1]) < 0.4) & (place[..., 0] > -0.9)
    wet = inside & (shown > 0.5)
    # it ends within a diameter of the outermost particles, which lie up to a spacing short of where the level meets
    # the bed, and their spheres stand a radius out of both
    ends = place[..., 0][wet].max()
    assert -2 * RADIUS / np.tan(SLOPE) < ends < 2 * RADIUS / np.tan(SLOPE)
    # where it ends, it is thin: nothing of more than two grains over the bed stops short
    rim = wet & ~(np.roll(wet, 1, 1) & np.roll(wet, -1, 1))
    over = SHORE.unproject(SHORE.pixel_grid(), surface.depth) @ np.array([-np.sin(SLOPE), 0, np.cos(SLOPE)])
    assert np.median(over[rim & (place[..., 0] > -0.2)]) < 2 * GRAIN * RADIUS
    # and it faces upwards up to there: the outermost layer ends in steps of half a sphere, 30 degrees when evened out,
    # on top of the beach's own slope
    up = np.percentile(surface.normal[wet][:, 2], 1)
    assert up > np.cos(SLOPE + np.radians(30.0))


def test_what_lies_in_the_ground_is_not_seen_and_ground_in_front_hides():
    ground = np.full((120, 160), 2.0, np.float32)
    surface = particle_surface(box(), RADIUS, CAMERA, ground=ground)
    assert not surface.depth.any() and not surface.covered.any()
    with pytest.raises(ValueError, match="ground of shape"):
        particle_surface(box(), RADIUS, CAMERA, ground=ground[:50])


def test_a_ball_of_particles_has_a_far_side_that_bends_light_as_a_ball_does():
    points = box((0.8, 0.8, 0.8))
    points = points[np.linalg.norm(points, axis=1) < 0.4]
    near = particle_surface(points, RADIUS, CAMERA)
    seen = particle_surface(points, RADIUS, CAMERA, far_side=True)
    assert near.back_normal is None and seen.back_normal is not None
    rays = CAMERA.rays(CAMERA.pixel_grid())
    exact, chord = ball_depths(CAMERA, np.zeros(3), 0.4 + 0.5 * RADIUS)
    far = exact + chord / np.linalg.norm(rays, axis=-1)
    outward = (CAMERA.position + far[..., None] * rays) / (0.4 + 0.5 * RADIUS)
    inner = chord > 0.5  # of 0.83: the smoothing rounds a rim of some radii
    cosine = np.einsum("hwk,hwk->hw", seen.back_normal, np.nan_to_num(outward))[inner]
    # a ball of steps of a spacing, evened out over 3 radii: 7 degrees in the mean; a parallel far side would be 68 off
    assert np.degrees(np.arccos(np.clip(cosine, -1, 1))).mean() < 10
    np.testing.assert_array_equal(seen.normal, near.normal)
    assert not seen.back_normal[~(seen.covered > 0)].any()
