"""Splats in another light: nothing shines more than what lights it, and what lights it is seen to."""

import numpy as np
import pytest

from fluidlift.look.environment import Environment, built_in
from fluidlift.look.fluid_normals import (
    add_solid_kernel,
    add_solid_plain,
    depths_kernel,
    depths_plain,
    fluid_depths,
    fluid_normals,
    fluid_surface,
    gather_kernel,
    gather_plain,
    normals_kernel,
    normals_plain,
)
from fluidlift.look.materials import PRESETS, Material
from fluidlift.look.optics import fresnel
from fluidlift.look.relight import (
    body_color,
    environment_brdf,
    glow,
    heat,
    own_albedo,
    reflectance,
    relit,
    relit_plain,
    splat_roughness,
)
from fluidlift.types.camera import PinholeCamera
from fluidlift.types.gaussians import Gaussians, concatenate
from fluidlift.types.grid import Grid
from fluidlift.types.terrain import Terrain, TriangleMesh

SPACING = 0.02
CAMERA = PinholeCamera.looking(np.array([0.1, -2.0, 1.2]), np.zeros(3), 50, (96, 64))
DULL = Material("dull", refractive_index=1.0, scattering=1e6, albedo=(0.8, 0.5, 0.2))
PAINT = Material("paint", refractive_index=1.0, carried=1.0)


def ball(count: int = 12_000, seed: int = 0, radius: float = 0.25) -> Gaussians:
    """A ball of splats on a shaken lattice, as a simulation leaves them."""
    rng = np.random.default_rng(seed)
    n = int(np.ceil(radius / SPACING)) + 1
    p = np.stack(np.meshgrid(*[np.arange(-n, n + 1)] * 3, indexing="ij"), axis=-1).reshape(-1, 3) * SPACING
    p = p[np.linalg.norm(p, axis=1) < radius][:count]
    p = p + rng.uniform(-0.3, 0.3, p.shape) * SPACING
    return Gaussians.isotropic(p.astype(np.float32), SPACING / 2, rng.random((len(p), 3)))


def single(normal, rgb=(0.5, 0.5, 0.5)) -> tuple[Gaussians, np.ndarray, np.ndarray]:
    """One splat at the origin that is all surface."""
    n = np.asarray(normal, np.float32)[None] / np.linalg.norm(normal)
    return Gaussians.isotropic(np.zeros((1, 3), np.float32), 0.01, np.array([rgb])), n, np.ones(1, np.float32)


def gradient(direction) -> Environment:
    from fluidlift.look.environment_lookup import grid_directions

    values = 1 + 0.9 * grid_directions(32) @ (np.asarray(direction, float) / np.linalg.norm(direction))
    return Environment(np.repeat(values[..., None], 3, axis=2))


# ---- normals


def test_normals_of_a_ball_point_away_from_its_centre_and_its_inside_is_no_surface():
    g = ball()
    normals, share = fluid_normals(g, SPACING)
    distance = np.linalg.norm(g.means, axis=1)
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1, atol=1e-5)
    outer, inner = distance > 0.23, distance < 0.12
    cosine = (normals * g.means).sum(axis=1) / np.maximum(distance, 1e-9)
    # a shaken lattice is uneven by a third of its spacing over a blur of two spacings: some ten degrees
    assert np.degrees(np.arccos(np.clip(np.median(cosine[outer]), -1, 1))) < 6
    assert np.quantile(cosine[outer], 0.01) > np.cos(np.radians(20))
    assert share[outer].min() > 0.9 and share[inner].max() < 0.05


def test_finer_rows_are_no_surface():
    """Where splats lie twice as close in each direction, as at an inlet, the body is not denser than full."""
    x, y, z = np.meshgrid(np.arange(40), np.arange(16), np.arange(16), indexing="ij")
    coarse = np.stack([x, y, z], axis=-1).reshape(-1, 3) * SPACING
    fine = np.stack(np.meshgrid(*[np.arange(s) for s in (16, 32, 32)], indexing="ij"), -1).reshape(-1, 3) * SPACING / 2
    p = np.concatenate([coarse[coarse[:, 0] > 8 * SPACING], fine])
    _, share = fluid_normals(Gaussians.isotropic(p.astype(np.float32), 0.01, np.full((len(p), 3), 0.5)), SPACING)
    seam = (abs(p[:, 0] - 8 * SPACING) < 2 * SPACING) & (abs(p[:, 1:] - 8 * SPACING).max(axis=1) < 2 * SPACING)
    assert seam.sum() > 20 and share[seam].max() < 0.05


def test_a_bed_is_no_surface_of_the_fluid():
    grid = Grid((16, 16, 12), 0.05, (-0.4, -0.4, -0.2))
    height = np.broadcast_to(-0.2 + 0.05 * np.arange(13.0), (17, 17, 13))
    mesh = TriangleMesh(np.zeros((3, 3)), np.array([[0, 1, 2]]))
    terrain = Terrain(grid, height.astype(np.float32), np.array([1.0, 0, 0]), mesh)
    n = (np.arange(-12, 13), np.arange(-12, 13), np.arange(8))
    p = (np.stack(np.meshgrid(*n, indexing="ij"), -1).reshape(-1, 3) + [0, 0, 0.5]) * SPACING
    g = Gaussians.isotropic(p.astype(np.float32), 0.01, np.full((len(p), 3), 0.5))
    middle, bottom, top = np.abs(p[:, :2]).max(axis=1) < 0.1, p[:, 2] < 1.5 * SPACING, p[:, 2] > 6.5 * SPACING
    alone, on_bed = fluid_normals(g, SPACING)[1], fluid_normals(g, SPACING, terrain)[1]
    assert alone[middle & bottom].min() > 0.9
    assert on_bed[middle & bottom].max() < 0.1 and on_bed[middle & top].min() > 0.9


def test_kernels_of_the_normals_are_their_twins():
    g = ball(800)
    low, h, shape = np.full(3, -0.5), 0.05, (20, 20, 20)
    compiled, plain = np.zeros(shape, np.float32), np.zeros(shape, np.float32)
    gather_kernel(g.means, low, h, compiled)
    gather_plain(g.means, low, h, plain)
    np.testing.assert_allclose(compiled, plain, atol=1e-4)  # float32 sums of up to some tens
    assert np.isclose(compiled.sum(), len(g), rtol=1e-5)  # B-splines are a partition of one
    normals, share = np.empty((len(g), 3), np.float32), np.empty(len(g), np.float32)
    normals_kernel(g.means, low, h, plain, normals, share)
    expected = normals_plain(g.means, low, h, plain)
    np.testing.assert_allclose(normals, expected[0], atol=1e-4)
    np.testing.assert_allclose(share, expected[1], atol=1e-4)


def test_the_kernel_that_adds_the_bed_is_its_twin():
    grid = Grid((5, 4, 3), 0.1, (0.0, 0.1, -0.1))
    distance = np.random.default_rng(0).normal(scale=0.05, size=(6, 5, 4)).astype(np.float32)
    mesh = TriangleMesh(np.zeros((3, 3)), np.array([[0, 1, 2]]))
    terrain = Terrain(grid, distance, np.array([1.0, 0, 0]), mesh)
    low, h = np.array([-0.5, -0.4, -0.6]), 0.07
    compiled, plain = np.full((20, 18, 16), 0.2, np.float32), np.full((20, 18, 16), 0.2, np.float32)
    add_solid_kernel(distance, grid.low, grid.spacing, low, h, compiled)
    add_solid_plain(terrain, low, h, plain)
    np.testing.assert_allclose(compiled, plain, atol=1e-5)
    assert plain.max() > 0.5 and plain.min() == np.float32(0.2)


def layer(thick, wide=0.4):
    """Splats of a level layer, m, on a shaken lattice."""
    n = (int(wide / SPACING), int(wide / SPACING), int(round(thick / SPACING)))
    p = (np.stack(np.meshgrid(*map(np.arange, n), indexing="ij"), -1).reshape(-1, 3) + 0.5) * SPACING
    p = p - (wide / 2, wide / 2, thick) + np.random.default_rng(0).uniform(-0.2, 0.2, p.shape) * SPACING
    return Gaussians.isotropic(p.astype(np.float32), SPACING / 2, np.full((len(p), 3), 0.5))


@pytest.mark.parametrize("thick", [0.06, 0.16, 0.32])
def test_a_layer_is_as_deep_as_it_is(thick):
    g = layer(thick)
    middle = np.abs(g.means[:, :2]).max(axis=1) < 0.08
    found = fluid_depths(g, np.broadcast_to([0.0, 0.0, 1.0], g.means.shape), SPACING)[middle]
    # the density is held at 0.92 inside, and its blur adds at both ends
    assert np.median(found) == pytest.approx(thick, rel=0.06, abs=0.5 * SPACING)
    aslant = fluid_depths(g, np.broadcast_to([0.0, np.sqrt(0.5), np.sqrt(0.5)], g.means.shape), SPACING)[middle]
    if thick < 0.1:  # else it leaves through the sides
        assert np.median(aslant) == pytest.approx(thick * np.sqrt(2), abs=SPACING)


def test_the_kernel_of_depths_is_its_twin():
    rng = np.random.default_rng(0)
    density = rng.random((14, 13, 12)).astype(np.float32) ** 0.3
    points = rng.uniform(0.3, 1.0, (200, 3)).astype(np.float32)
    normals = rng.normal(size=(200, 3)).astype(np.float32)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    out = np.zeros(200, np.float32)
    depths_kernel(points, normals, np.zeros(3), 0.1, density, out)
    plain = depths_plain(points, normals, np.zeros(3), 0.1, density)
    # a place at which the density is that of the end within float32 may count or not: one of them, if any
    assert np.mean(np.abs(out - plain) < 1e-4) > 0.99 and plain.max() > 0.2
    broken = np.full((1, 3), np.nan, np.float32)
    assert fluid_depths(Gaussians.isotropic(broken, 0.1, np.ones((1, 3))), np.ones((1, 3)), SPACING)[0] == 0.0


def test_the_surface_for_shadows_is_closed_and_as_large_as_the_body():
    mesh = fluid_surface(ball(), SPACING)
    a, b, c = (mesh.vertices[mesh.faces[:, k]].astype(float) for k in range(3))
    volume = (a * np.cross(b, c)).sum() / 6  # positive: outward
    assert np.abs((np.cross(b - a, c - a)).sum(axis=0)).max() < 1e-4  # no hole: the areas cancel
    # it stands off by up to a node's distance, two spacings
    assert 4 / 3 * np.pi * 0.25**3 < volume < 4 / 3 * np.pi * (0.25 + 2 * SPACING) ** 3
    assert len(fluid_surface(layer(SPACING), SPACING).faces) > 0  # one layer of splats throws a shadow
    assert len(fluid_surface(Gaussians.empty(), SPACING).faces) == 0


def test_a_small_move_changes_normals_little():
    """A tenth of a spacing may not turn a normal by more than that, as seen from the blur's width (two spacings)."""
    g = ball()
    moved = np.random.default_rng(3).normal(scale=0.1 * SPACING, size=g.means.shape).astype(np.float32)
    a, share = fluid_normals(g, SPACING)
    b, other = fluid_normals(Gaussians(g.means + moved, g.quats, g.scales, g.opacities, g.sh), SPACING)
    surface = share > 0.9
    turn = np.degrees(np.arccos(np.clip((a * b)[surface].sum(axis=1), -1, 1)))
    assert np.median(turn) < 2 and turn.max() < 12
    # the share falls from 1 to 0 within some 1.5 spacings of depth, and a few splats move by 0.3
    assert np.abs(share - other).max() < 0.35 and np.abs(share - other).mean() < 0.02


def test_a_far_splat_costs_nothing_and_keeps_the_normals_of_the_others():
    g = ball(4000)
    stray = Gaussians.isotropic(np.array([[1e6, 0, 0], [np.nan, 0, 0]], np.float32), 0.01, np.full((2, 3), 0.5))
    normals, share = fluid_normals(concatenate([g, stray]), SPACING)
    np.testing.assert_allclose(normals[:-2], fluid_normals(g, SPACING)[0], atol=1e-5)
    assert (share[-2:] == 0).all() and (normals[-2:] == (0, 0, 1)).all()


def test_no_splats_have_no_normals():
    normals, share = fluid_normals(Gaussians.empty(), SPACING)
    assert normals.shape == (0, 3) and share.shape == (0,)
    assert relit(Gaussians.empty(), normals, share, CAMERA, PRESETS["lava"], Environment.white()).shape == (0, 3)
    with pytest.raises(ValueError, match="spacing"):
        fluid_normals(ball(10), 0.0)


# ---- light


@pytest.mark.parametrize("material", [m for m in PRESETS.values() if max(m.emission) == 0], ids=lambda m: m.name)
def test_no_material_shines_more_than_the_white_light_around_it(material):
    g = ball()
    out = relit(g, *fluid_normals(g, SPACING), CAMERA, material, Environment.white())
    assert out.min() >= 0 and out.max() <= 1 + 1e-5  # float32


@pytest.mark.parametrize("index", [1.0, 1.1, 1.333, 1.5, 4.0])
def test_a_white_body_in_white_light_is_white_under_any_surface(index):
    """White furnace: what the surface does not reflect, the body returns."""
    g = ball()
    white = Material("white", refractive_index=index, scattering=1e9, albedo=(1.0, 1.0, 1.0), roughness=0.3)
    out = relit(g, *fluid_normals(g, SPACING), CAMERA, white, Environment.white())
    np.testing.assert_allclose(out, 1, atol=1e-5)  # float32


def test_a_dull_body_in_white_light_shows_exactly_its_albedo():
    g = ball()
    out = relit(g, *fluid_normals(g, SPACING), CAMERA, DULL, Environment.white())
    np.testing.assert_allclose(out, np.broadcast_to(DULL.albedo, out.shape), atol=1e-5)  # float32


def test_the_diffuse_term_follows_the_light():
    """A dull face towards the light is (1 + 2/3 0.9) bright, and as much darker when the light has gone round."""
    g, n, s = single((0, -1, 0))
    front = relit(g, n, s, CAMERA, DULL, gradient((0, -1, 0)))
    side = relit(g, n, s, CAMERA, DULL, gradient((0, -1, 0)).turned(90))
    back = relit(g, n, s, CAMERA, DULL, gradient((0, -1, 0)).turned(180))
    for out, expected in ((front, 1.6), (side, 1.0), (back, 0.4)):
        np.testing.assert_allclose(out[0], expected * np.array(DULL.albedo), rtol=5e-3)  # 32 rows


def test_a_clip_s_own_colours_follow_the_light_too():
    g = ball()
    normals, share = fluid_normals(g, SPACING)
    left = relit(g, normals, share, CAMERA, PAINT, gradient((-1, 0, 0)))
    right = relit(g, normals, share, CAMERA, PAINT, gradient((1, 0, 0)))
    facing = (normals[:, 0] < -0.9) & (share > 0.9)
    assert facing.sum() > 50 and (left[facing] > 2.5 * right[facing]).all()


def test_a_mirror_shows_what_lies_in_the_direction_of_reflection():
    """Camera in -y, normal halfway between -y and +z: straight above is reflected."""
    camera = PinholeCamera.looking(np.array([0.0, -2.0, 0.0]), np.zeros(3), 50, (32, 32))
    g, n, s = single((0, -1, 1))
    black = Material("black", refractive_index=1.5, scattering=1e9, albedo=(0.0, 0.0, 0.0))
    lamp = np.zeros((64, 128, 3), np.float32)
    lamp[:6] = (2.0, 1.0, 0.5)  # 17 degrees around +z
    seen = relit(g, n, s, camera, black, Environment(lamp))[0]
    elsewhere = relit(g, *single((0, -1, 0.2))[1:], camera, black, Environment(lamp))[0]
    roughness = splat_roughness(0.0)
    share = reflectance(np.cos(np.pi / 4), roughness, 1.5)
    np.testing.assert_allclose(seen, share * Environment(lamp).blurred(np.array([0, 0, 1.0]), roughness), rtol=1e-4)
    assert seen[0] > 0.8 * share * 2.0 and elsewhere[0] < 0.1 * seen[0]
    np.testing.assert_allclose(seen / seen[0], [1, 0.5, 0.25], rtol=1e-4)


def test_the_compiled_shading_is_its_twin():
    g = ball()
    normals, share = fluid_normals(g, SPACING)
    material, environment = PRESETS["honey"], built_in("studio")
    body = body_color(g, own_albedo(g.rgb, normals, share), material)
    plain = relit_plain(g.means, normals, share, body, CAMERA.position, material, environment)
    from fluidlift.look.relight import _prepared, shade_kernel

    out = np.empty_like(plain, np.float32)
    shade_kernel(g.means, normals, share, body, *_prepared(material, environment, CAMERA.position), out)
    np.testing.assert_allclose(out, plain, atol=2e-3)  # float32 angles at the hard edges of soft boxes


@pytest.mark.parametrize("roughness", [0.25, 0.5, 0.8, 1.0])
@pytest.mark.parametrize("cosine", [0.15, 0.4, 0.7, 1.0])
def test_the_reflectance_of_a_rough_surface_is_the_integral_over_its_facets(roughness, cosine):
    """A and B of F0 A + B by half vectors drawn at random from GGX, with Smith's shadowing, as in Karis 2013."""
    u, v = np.random.default_rng(0).random((2, 200_000))
    alpha = roughness**2
    z = np.sqrt((1 - u) / (1 + (alpha**2 - 1) * u))
    x = np.sqrt(1 - z**2) * np.cos(2 * np.pi * v)
    view = np.array([np.sqrt(1 - cosine**2), 0.0, cosine])
    toward_half = view[0] * x + view[2] * z
    light = 2 * toward_half * z - view[2]
    ok = (light > 0) & (toward_half > 0)

    def unshadowed(c):
        return 2 * c / (c + np.sqrt(alpha**2 + (1 - alpha**2) * c**2))

    shadow = unshadowed(np.maximum(light, 1e-9)) * unshadowed(cosine)
    weight = np.where(ok, shadow * toward_half / np.maximum(z * cosine, 1e-9), 0.0)
    schlick = (1 - np.clip(toward_half, 0, 1)) ** 5
    scale, offset = environment_brdf(np.float64(cosine), roughness)
    assert scale == pytest.approx(float((weight * (1 - schlick)).mean()), abs=0.01)  # 200 000 draws leave 0.002,
    assert offset == pytest.approx(float((weight * schlick).mean()), abs=0.01)  # the table of 64 cosines less


def test_reflectance_is_that_of_fresnel_where_the_surface_is_smooth():
    cosine = np.linspace(0.3, 1, 20)
    # Schlick's form and the fit are a few hundredths off for water
    np.testing.assert_allclose(reflectance(cosine, 0.1, 1.333), fresnel(cosine, 1.333), atol=0.04)
    assert (reflectance(cosine, 0.3, 1.0) == 0).all()
    assert reflectance(np.float64(0.05), 0.2, 1.333) > 5 * reflectance(np.float64(1.0), 0.2, 1.333)


# ---- the body


def test_the_clip_s_light_is_divided_out_and_its_exposure_kept():
    """A grey body under an overcast sky: colours as 1 above and 0.65 at the sides, albedo the same all over."""
    normals = np.array([(0, 0, 1), (1, 0, 0), (0, -1, 0), (0, 0, 1)], np.float32)
    light = 0.65 + 0.35 * normals[:, 2]
    colors = (0.4 * light[:, None] * np.ones(3)).astype(np.float32)
    albedo = own_albedo(colors, normals, np.ones(4, np.float32))
    np.testing.assert_allclose(albedo, albedo[0, 0], rtol=1e-5)
    np.testing.assert_allclose(albedo[0], colors[0], rtol=1e-5)  # what faces the sky keeps its brightness
    assert own_albedo(np.ones((4, 3)), normals, np.ones(4)).max() <= 0.95


def test_clear_liquids_show_the_clip_and_cloudy_ones_themselves():
    g = ball()
    own = np.full((len(g), 3), 0.5, np.float32)
    np.testing.assert_allclose(body_color(g, own, PRESETS["water"]), 0.5, rtol=0.2)  # half a metre of water
    np.testing.assert_allclose(body_color(g, own, PRESETS["milk"])[0], PRESETS["milk"].albedo, rtol=1e-3)
    np.testing.assert_allclose(body_color(g, own, PRESETS["source"]), own)
    red, _, blue = body_color(g, own, PRESETS["honey"])[0]
    assert red > 3 * blue


def test_honey_is_light_where_it_is_thin_and_dark_and_red_where_it_is_deep():
    g = layer(0.2)
    own = np.full((len(g), 3), 0.6, np.float32)
    normals, share = np.tile(np.float32([0, 0, 1]), (len(g), 1)), np.ones(len(g), np.float32)
    depths = np.linspace(0.0, 1.0, len(g))
    body = body_color(g, own, PRESETS["honey"], depths)
    np.testing.assert_allclose(body[0], own[0], rtol=1e-5)  # what is behind no honey is as it was
    assert (np.diff(body[:, 0]) <= 1e-6).all()  # darker and darker; float32
    np.testing.assert_allclose(body[-1], PRESETS["honey"].albedo, rtol=0.02)  # and in the end its own brown
    middle = body[3 * len(g) // 100]  # 3 cm
    assert body[0, 1] > 1.4 * middle[1] and middle[0] / middle[2] > 4 * body[0, 0] / body[0, 2]
    args = (normals, share, CAMERA, PRESETS["honey"], Environment.white())
    thin, thick = (relit(g, *args, depths=np.full(len(g), d)).mean(axis=0) for d in (0.003, 0.05))
    assert thin @ (1, 1, 1) > 1.5 * thick @ (1, 1, 1)


def test_hot_parts_glow_yellow_and_cool_ones_red_or_not_at_all():
    colors = np.linspace(0, 1, 200)[:, None] * np.ones(3)
    hot = heat(colors)
    assert hot[0] == 0 and hot[-1] == 1 and (np.diff(hot) >= 0).all()
    light = glow(colors, PRESETS["lava"])
    np.testing.assert_allclose(light[-1], PRESETS["lava"].emission, rtol=1e-5)
    assert light[0].max() < 1e-3 and (np.diff(light, axis=0) >= -1e-7).all()
    warm = np.argmin(np.abs(hot - 0.7))
    assert light[warm, 0] / light[warm, 1] > 1.2 * light[-1, 0] / light[-1, 1]
    g = ball()
    dark = Environment.white(0.0)
    assert relit(g, *fluid_normals(g, SPACING), CAMERA, PRESETS["lava"], dark).max() > 1


def test_a_small_move_changes_the_light_little():
    """As splats move by a tenth of their spacing, the relit colours change by less than neighbours differ."""
    g = ball()
    uniform = Gaussians.isotropic(g.means, SPACING / 2, np.full((len(g), 3), 0.5))
    moved = Gaussians.isotropic(
        g.means + np.random.default_rng(5).normal(scale=0.1 * SPACING, size=g.means.shape).astype(np.float32),
        SPACING / 2, np.full((len(g), 3), 0.5),
    )  # fmt: skip
    before, after = (
        relit(x, *fluid_normals(x, SPACING), CAMERA, PRESETS["source"], built_in("sky")) for x in (uniform, moved)
    )
    change = np.abs(after - before).mean(axis=1)
    assert np.median(change) < 0.01 and np.quantile(change, 0.99) < 0.1


def test_normals_of_another_number_are_refused():
    g = ball(10)
    with pytest.raises(ValueError, match="normals"):
        relit(g, np.zeros((9, 3)), np.zeros(10), CAMERA, PAINT, Environment.white())
