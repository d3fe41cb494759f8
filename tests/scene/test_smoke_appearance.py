"""Smoke is as thin as its film, fills what the simulation lacks, and keeps its amount where it was edited."""

from dataclasses import replace

import numpy as np
import pytest

from fluidlift.io.footage_file import write_smoke
from fluidlift.look.rasterize import render
from fluidlift.look.smoke_film import SmokeFilm
from fluidlift.physics.inlet import beside_inlet
from fluidlift.scene.simulator import SOURCE
from fluidlift.scene.smoke_appearance import ASTRAY, FAINT, HANDED_OVER, SmokeAppearance
from fluidlift.scene.surface_appearance import SurfaceAppearance
from fluidlift.types import CellType, Gaussians, Particles

FRAMES, INTERVAL = 10, 0.04
COLOR = np.array([0.8, 0.5, 0.3])


def puff(opacity: float = 0.4, count: int = FRAMES) -> SmokeFilm:
    """A round one that grows a little, in the middle of what `from_above` sees of the channel."""
    v, u = np.mgrid[:48, :64] + 0.5
    away = np.hypot(u - 32, v - 24)
    grown = [opacity * np.exp(-np.square(away / (7 + 0.2 * t)) / 2) for t in range(count)]
    colors = np.broadcast_to(np.rint(255 * COLOR), (count, 48, 64, 3)).astype(np.uint8)
    return SmokeFilm(colors, np.rint(255 * np.stack(grown)).astype(np.uint8), INTERVAL)


def smoke(channel, **more):
    """The scene of a channel whose body is smoke: eight particles to each cell, the film's whole picture wide, and none
    of its ends open."""
    cells = channel(FRAMES).cell_types
    closed = np.where(cells == CellType.OUTFLOW, CellType.FLUID, cells)
    return channel(FRAMES, kind="plume", **{"cell_types": closed} | more)


def flowed_in(scene):
    """The body's particles as if they had come through the inlet: each as heavy as eight to a cell are."""
    each = scene.parameters.density * (0.5 * scene.terrain.grid.spacing) ** 3
    body = scene.body
    return replace(body, ids=body.ids + len(body), masses=np.full(len(body), each, np.float32))


def shown(scene, film, number=0, particles=None):
    particles = scene.body if particles is None else particles
    bare = replace(scene.rest.select(particles.source), means=particles.positions)
    painted = scene.rest.means if scene.painted is None else scene.painted
    own = ~np.isfinite(painted[particles.source]).all(axis=1)
    return SmokeAppearance(scene, film).dressed(bare, particles, number, own)


def alpha(gaussians: Gaussians, scene) -> np.ndarray:
    return render(gaussians, scene.camera).alpha


@pytest.mark.parametrize("number", [0, 6])
@pytest.mark.parametrize("opacity", [0.1, 0.4, 0.9])
def test_it_is_as_thin_as_its_film(channel, number, opacity):
    scene, film = smoke(channel), puff(opacity)
    gaussians, ids, velocities = shown(scene, film, number)
    wanted = film.opacities[number] / 255.0
    # thin smoke takes few splats
    assert np.abs(alpha(gaussians, scene) - wanted).mean() < (0.1 if opacity > 0.1 else 0.2) * wanted.mean()
    there = gaussians.opacities > FAINT
    assert np.abs(gaussians.rgb[there] - COLOR).max() < 0.02
    assert len(ids) == len(np.unique(ids)) == len(velocities) == len(gaussians)


def test_what_the_simulation_lacks_is_filled_as_far_off_as_the_smoke_beside_it(channel):
    scene, film = smoke(channel), puff(0.5)
    gone = np.abs(scene.body.positions[:, 0] - 0.6) < 0.1  # a gap of two cells through the middle
    left = scene.body.select(~gone)
    gaussians, ids, velocities = shown(scene, film, 3, left)
    more = ids % 2 == 1
    assert more.any() and not (ids[~more] % 2).any()
    wanted = film.opacities[3] / 255.0
    bare = alpha(gaussians.select(~more), scene)
    assert np.abs(alpha(gaussians, scene) - wanted).mean() < 0.15 * wanted.mean() < np.abs(bare - wanted).mean()
    z = scene.body.positions[:, 2]
    assert z.min() - 0.05 < gaussians.means[more, 2].min() and gaussians.means[more, 2].max() < z.max() + 0.05
    assert np.abs(velocities[more] - [0.6, 0, 0]).max() < 1e-4
    assert not set(ids[more]) & set(shown(scene, film, 4, left)[1])  # of another frame: they were not carried there
    again = shown(scene, film, 3, left)
    assert (again[1] == ids).all() and (again[0].means == gaussians.means).all()


def test_far_from_all_simulated_smoke_what_fills_fades_out(channel):
    even = SmokeFilm(puff().colors, np.full((FRAMES, 48, 64), 100, np.uint8), INTERVAL)
    scene = smoke(channel)
    left = scene.body.select(scene.body.positions[:, 0] < 0.15)
    gaussians, ids, _ = shown(scene, even, 3, left)
    end = 0.15 + (2 * ASTRAY + 1) * 0.1
    assert (ids % 2 == 1).any() and not (gaussians.means[ids % 2 == 1, 0] > end).any()
    columns = scene.camera.project(np.array([[0.15 + 0.1 * k, 0.4, 0.2] for k in (2, ASTRAY + 2, ASTRAY + 4)]))[0][:, 0]
    near, fading, gone = (alpha(gaussians, scene)[20:28, int(c)].mean() for c in columns)
    assert near == pytest.approx(100 / 255, rel=0.15) and 0.9 * near > fading > gone
    assert not shown(scene, puff(0.5), 3, scene.body.select(slice(0, 0)))[1].size


def test_where_the_film_shows_none_there_is_none(channel):
    scene, film = smoke(channel), puff()
    empty = SmokeFilm(film.colors, np.zeros_like(film.opacities), INTERVAL)
    gaussians, ids, _ = shown(scene, empty)
    assert (gaussians.opacities <= FAINT).all() and not (ids % 2).any() and alpha(gaussians, scene).max() < 1e-3


def test_edited_smoke_keeps_its_amount_and_thins_as_it_spreads(channel):
    scene, film = smoke(channel, changes=("gravity",)), puff(0.4)
    middle = np.array([0.6, 0.4, 0.2])
    depth = []
    for factor in (1.0, 1.5):
        spread = replace(scene.body, positions=(middle + factor * (scene.body.positions - middle)).astype(np.float32))
        gaussians, ids, _ = shown(scene, film, 5, spread)
        assert not (ids % 2).any()
        depth.append(-np.log1p(-np.minimum(alpha(gaussians, scene), 0.99)))
    assert depth[1][24, 32] == pytest.approx(depth[0][24, 32] / 1.5**2, rel=0.2)
    assert depth[0].sum() == pytest.approx(-np.log1p(-(film.opacities[0] / 255.0)).sum(), rel=0.1)


def test_what_flows_in_has_as_much_smoke_as_the_film_shows_about_the_inlet_in_the_mean(channel):
    scene, film = smoke(channel, changes=("gravity",)), puff(0.4)
    weak = film.opacities.astype(float)
    weak[0] *= 0.5  # the source is weak at first
    film = SmokeFilm(film.colors, np.rint(weak).astype(np.uint8), INTERVAL)
    near = beside_inlet(scene.rest.means, scene.cell_types, scene.terrain.grid, SOURCE)
    columns = np.unique(np.floor(scene.camera.project(scene.rest.means[near])[0][:, 0]).astype(int))
    shares = [film.layer(t)[1][:, columns.min() : columns.max() + 1].sum() for t in range(FRAMES)]
    came = flowed_in(scene)
    depths = [-np.log1p(-alpha(shown(scene, film, 5, body)[0], scene)).sum() for body in (scene.body, came)]
    assert 1.5 < np.mean(shares) / shares[0] == pytest.approx(depths[1] / depths[0], rel=0.1)


def test_it_fades_out_where_it_leaves_the_box_unless_the_film_shows_it_there(channel):
    cells = np.array(channel(2).cell_types)
    cells[cells == CellType.INFLOW] = CellType.FLUID
    edited = smoke(channel, cell_types=cells, changes=("gravity",))
    even = SmokeFilm(puff().colors, np.full((FRAMES, 48, 64), 100, np.uint8), INTERVAL)
    column = alpha(shown(edited, even, 5)[0], edited)[20:28].mean(axis=0)
    assert column[50] < 0.15 * column[14] and (np.diff(column[14:50:6]) < 0).all()
    filmed = alpha(shown(smoke(channel, cell_types=cells), even, 5)[0], edited)[20:28].mean(axis=0)
    assert filmed[50] == pytest.approx(100 / 255, rel=0.15)


def test_a_color_of_its_own_stays(channel):
    painted = np.full((len(channel(2).rest), 3), np.nan)
    scene = smoke(channel, painted=painted)
    painted[::2] = scene.rest.means[::2]
    gaussians, ids, _ = shown(scene, puff())
    dyed = np.zeros(len(ids), bool)
    dyed[: len(scene.body)] = np.isnan(painted[scene.body.source]).any(axis=1)
    np.testing.assert_allclose(gaussians.rgb[dyed], scene.rest.rgb[scene.body.source][dyed[: len(scene.body)]])
    assert np.abs(gaussians.rgb[: len(scene.body)][~dyed[: len(scene.body)]] - COLOR).max() < 0.02


def test_beside_the_picture_smoke_keeps_its_amount(channel):
    scene = smoke(channel)
    aside = replace(scene.body, positions=(scene.body.positions + [2.0, 0.0, 0.0]).astype(np.float32))
    gaussians, ids, _ = shown(scene, puff(), 4, aside)
    assert not (ids % 2).any() and (gaussians.opacities > FAINT).any() and alpha(gaussians, scene).max() == 0
    back = replace(gaussians, means=(gaussians.means - [2.0, 0.0, 0.0]).astype(np.float32))
    taken = -np.log1p(-alpha(back, scene)).sum()
    assert taken == pytest.approx(-np.log1p(-(puff().opacities[0] / 255.0)).sum(), rel=0.15)


def test_after_the_end_of_its_film_smoke_that_still_spread_goes_on_as_simulated(channel):
    scene, film = replace(smoke(channel), frames=100), puff(0.4)
    steady = np.repeat(film.opacities[:1], FRAMES, axis=0)
    late = steady.copy()
    late[:7, :, 34:] = 0  # comes to the right half at the end
    for opacities, wanted in ((steady, False), (late, True)):
        one = SmokeFilm(film.colors, opacities, INTERVAL)
        assert one.spreads == wanted
        away = replace(scene.body, positions=(scene.body.positions + [0.0, 0.25, 0.0]).astype(np.float32))
        number = FRAMES + round(HANDED_OVER / INTERVAL) + 1
        seen = alpha(shown(scene, one, number, away)[0], scene)
        row = float((seen.sum(axis=1) * np.arange(48)).sum() / seen.sum())
        assert (abs(row - 23.5) > 6) == wanted  # where the simulation has it, or where the film did


@pytest.mark.parametrize("fault", ["missing", "damaged"])
def test_a_film_that_is_gone_or_damaged_is_said_and_the_smoke_looks_as_at_rest(channel, tmp_path, fault):
    film, path = puff(), tmp_path / "film.mp4"
    write_smoke(path, zip(film.colors, film.opacities, strict=True), INTERVAL)
    whole = SurfaceAppearance(smoke(channel, film=path))
    path.unlink() if fault == "missing" else path.write_bytes(path.read_bytes()[:700])
    scene = smoke(channel, film=path)
    broken = SurfaceAppearance(scene)
    assert whole.warnings == () and [w.code for w in broken.warnings] == ["film-not-played"]
    assert fault in broken.warnings[0] and "make the asset again" in broken.warnings[0]
    first = broken.dressed(scene.body, 0)
    assert (first.gaussians.opacities == scene.rest.opacities).all()


def test_no_particles_are_no_splats(channel):
    none = Particles.at_rest(np.zeros((0, 3)), 1.0)
    gaussians, ids, velocities = shown(smoke(channel), puff(), 2, none)
    assert len(gaussians) == len(ids) == len(velocities) == 0


def test_it_is_round_however_far_its_particles_are_drawn_out(channel, tmp_path):
    film = puff()
    write_smoke(tmp_path / "film.mp4", zip(film.colors, film.opacities, strict=True), INTERVAL)
    scene = smoke(channel, film=tmp_path / "film.mp4")
    appearance, body = SurfaceAppearance(scene), scene.body
    assert not appearance.draws_out and SurfaceAppearance(channel(2)).draws_out
    long = replace(body, deformation=body.deformation * np.array([3.0, 0.5, 0.6], np.float32))
    rest, stretched = (appearance.dressed(p, 3, None).gaussians for p in (body, long))
    for name in ("means", "quats", "scales", "opacities", "sh"):
        np.testing.assert_array_equal(getattr(rest, name), getattr(stretched, name))
    assert np.ptp(stretched.scales, axis=1).max() == 0.0


def test_a_particle_that_came_in_for_others_as_well_is_as_much_smoke_as_they_are(channel):
    scene, film = smoke(channel, changes=("gravity",)), puff(0.4)
    came = flowed_in(scene)
    few = came.select(slice(0, None, 2))
    depths = []
    for particles in (came, few, replace(few, masses=2.0 * few.masses)):
        there = alpha(shown(scene, film, 5, particles)[0], scene)
        depths.append(-np.log1p(-np.minimum(there, 0.99)).sum())
    assert depths[1] < 0.6 * depths[0]
    assert depths[2] == pytest.approx(depths[0], rel=0.1)
