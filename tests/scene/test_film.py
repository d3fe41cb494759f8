"""An asset carries a film of its fluid, which its surface plays; where it cannot, that is said and all else stays."""

import shutil
from dataclasses import replace

import numpy as np
import pytest
from scipy import ndimage

from fluidlift.cli import REJECTED, WITH_WARNINGS, main
from fluidlift.config import JobConfig
from fluidlift.io.asset_folder import FILES, load_asset, read_manifest
from fluidlift.io.footage_file import read_footage, read_smoke, write_footage
from fluidlift.io.video import read_clip
from fluidlift.look.footage import FEWEST
from fluidlift.look.surface_skin import WIDTH
from fluidlift.pipeline.preview import preview_scene
from fluidlift.scene.build import SimulationRequest, film_of, first_of_film, scene_of
from fluidlift.scene.simulator import simulator_of
from fluidlift.scene.surface_appearance import DROP, SurfaceAppearance
from fluidlift.scene.surface_film import FINE, FINER, foreshortening
from fluidlift.types import PinholeCamera

FRAMES = 4
CONSEQUENCE = "its surface looks as it did at rest"


def film(path, count=16, size=(64, 48), fluid=True, sigma=0.0):
    """Grain that is another one in each frame, `sigma` px wide, bright red: the body at rest is grey."""
    grain = np.random.default_rng(0).normal(size=(count, size[1], size[0], 3))
    grain = ndimage.gaussian_filter(grain, (0.0, sigma, sigma, 0.0)) if sigma else grain
    frames = np.clip([200, 60, 40] + 20 * grain / grain.std(), 0, 255).astype(np.uint8)
    return write_footage(path, frames, np.full((count, size[1], size[0]), fluid), 0.04)


def dressed(scene, frames=FRAMES):
    """The appearance, and the splats of the last of a few frames."""
    simulator, appearance = simulator_of(scene), SurfaceAppearance(scene)
    for k in range(frames):
        if k:
            simulator.advance(scene.interval)
        appearance.advance(simulator.particles, k)
    return appearance, appearance.dressed(simulator.particles, frames - 1)


def is_red(shown) -> bool:
    skin = shown.ids % 2 == 1
    mean = shown.gaussians.rgb[skin].mean(axis=0)
    return bool(mean[0] > mean[2] + 0.3)


# what the surface plays -----------------------------------------------------------------------------------------


def test_the_surface_plays_the_film(channel, tmp_path):
    appearance, shown = dressed(channel(FRAMES, film=film(tmp_path / "film.mp4")))
    assert appearance.warnings == () and is_red(shown)


@pytest.mark.parametrize("kind", ["stream", "fall"])
def test_the_first_frame_shows_the_film_too_and_is_the_body_at_rest_without_one(channel, tmp_path, kind):
    scene = channel(FRAMES, kind=kind, film=film(tmp_path / "film.mp4"))
    _, first = dressed(scene, 1)
    assert is_red(first)
    particles = first.ids % 2 == 0
    assert particles.sum() == len(scene.body)
    np.testing.assert_array_equal(first.gaussians.means[particles], scene.body.positions)
    _, plain = dressed(channel(FRAMES, kind=kind), 1)
    assert (plain.ids % 2 == 0).all()


def test_a_fall_plays_its_film_on_a_map_over_the_picture(channel, tmp_path):
    """Without one it has no skin, as nothing else is known of how it looks over time."""
    path = film(tmp_path / "film.mp4")
    appearance, shown = dressed(channel(FRAMES, kind="fall", film=path))
    assert appearance.warnings == () and (shown.ids % 2 == 1).any() and is_red(shown)
    _, plain = dressed(channel(FRAMES, kind="fall"))
    assert (plain.ids % 2 == 0).all()


@pytest.mark.parametrize(("sigma", "apart"), [(0.0, FINER), (2.5, FINE)])
def test_drops_before_a_sheet_are_as_sharp_as_the_film_while_nobody_edits_it(channel, tmp_path, sigma, apart):
    """Spray hangs before the sheet of a fall: a quarter of a cell wide it would blur what the film shows there. Splats
    lie closer where its grain is fine."""
    path, largest = film(tmp_path / "film.mp4", sigma=sigma), []
    for changes in ((), ("gravity",)):
        scene = channel(FRAMES, kind="fall", film=path, changes=changes)
        simulator, appearance = simulator_of(scene), SurfaceAppearance(scene)
        appearance.advance(simulator.particles, 0)
        particles = simulator.particles
        top = int(np.argmax(particles.positions[:, 2]))
        moved = particles.positions.copy()
        moved[top, 2] += 0.4  # the camera looks from above: four cells before the sheet, at 1.6 m from it
        shown = appearance.dressed(replace(particles, positions=moved), 0)
        largest.append(float(shown.gaussians.scales[np.flatnonzero(shown.ids == 2 * particles.ids[top])].max()))
        depth = 2.4 - moved[top, 2]
    assert largest[0] == pytest.approx(WIDTH * apart * depth / 96.0, rel=0.02)
    assert largest[1] == pytest.approx(DROP * 0.1, rel=0.02) and largest[1] > largest[0]


def test_the_skin_is_finer_where_the_surface_is_steep_in_the_picture(channel, tmp_path):
    """Tracers lie on a map from above: on a chute that is seen from its foot, neighbours are far apart."""
    size = (128, 96)
    path = film(tmp_path / "film.mp4", size=size)
    foot = PinholeCamera.looking(np.array([-1.0, 0.4, 0.8]), np.array([0.6, 0.4, 0.5]), 50.0, size)

    def level(camera, slope):
        scene = channel(1, film=path, camera=camera)
        appearance, particles = SurfaceAppearance(scene), simulator_of(scene).particles
        places = particles.positions.copy()
        places[:, 2] += np.clip(slope * (places[:, 0] - 0.4), 0.0, 0.6)
        appearance.advance(replace(particles, positions=places), 0)
        state = appearance.state()
        x = state["skin.places"][:, 0]
        return np.median(state["skin.levels"][(x > 0.5) & (x < 0.6)])

    # from its foot 2.2 times as far apart; from above it is only nearer to the camera, by a sixth
    assert level(foot, 2.0) - level(foot, 0.0) == 2
    above = channel(1).camera.resized(size)
    assert level(above, 2.0) - level(above, 0.0) <= 1


def widths_shown(scene, frames) -> list[int]:
    """Columns of the clip's picture in which there is a tracer of the skin, in each frame."""
    simulator, appearance, found = simulator_of(scene), SurfaceAppearance(scene), []
    for k in range(frames):
        if k:
            simulator.advance(scene.interval)
        appearance.advance(simulator.particles, k)
        shown = appearance.dressed(simulator.particles, k)
        uv, _ = scene.camera.project(shown.gaussians.means[shown.ids % 2 == 1])
        found.append(len(np.unique(np.floor(uv[(uv[:, 0] > 8) & (uv[:, 0] < 56), 0]))))
    return found


@pytest.mark.parametrize("kind", ["pour", "basin", "stream"])
def test_what_pours_or_stands_is_as_wide_as_each_frame_shows_it(channel, tmp_path, kind):
    """Its film grows by a column of pixels each frame; the outline of a stream is around all that it ever shows."""
    count = 12
    wet = np.zeros((count, 48, 64), bool)
    for t in range(count):
        wet[t, :, 8 : 44 + t] = True
    grain = np.random.default_rng(0).integers(0, 255, (count, 48, 64, 3)).astype(np.uint8)
    path = write_footage(tmp_path / "film.mp4", grain, wet, 0.04)
    widths = widths_shown(channel(count, kind=kind, film=path), count)
    seen = [44 + t - 8 for t in range(count)]
    if kind == "stream":
        assert np.ptp(widths) <= 1
    else:  # a pixel at the rim is covered by splats whose middles are inside it
        np.testing.assert_allclose(widths[1:-1], seen[1:-1], atol=2)
    edited = widths_shown(channel(2, kind=kind, film=path, changes=("gravity",)), 2)
    assert min(edited) > max(seen), "where somebody changes how it flows it is where it flows"


def test_after_its_film_an_outline_that_grew_comes_back_where_nothing_takes_what_is_poured(channel, tmp_path):
    count = 12
    wet = np.zeros((count, 48, 64), bool)
    for t in range(count):
        wet[t, :, 8 : 33 + 2 * t] = True
    grain = np.random.default_rng(0).integers(0, 255, (count, 48, 64, 3)).astype(np.uint8)
    path = write_footage(tmp_path / "film.mp4", grain, wet, 0.04)
    scene = channel(3 * count, kind="pour", film=path)
    scene = replace(scene, dry=np.zeros(scene.terrain.grid.shape, bool))
    kept, goes_on = (widths_shown(replace(scene, dry_for=known), 3 * count) for known in (np.inf, count * 0.04))
    assert kept[1:count] == goes_on[1:count], "while it plays"
    last = 33 + 2 * (count - 1) - 8
    assert min(goes_on[count:]) >= last - 4, "its last one holds"
    assert min(kept[count:]) < last - 8, "it is as wide as what it shows"


def test_what_the_wall_of_a_vessel_hides_looks_as_what_is_seen_of_it(channel, tmp_path):
    """The film shows dark fluid on the left and a white wall on the right, which stands before the rest of it."""
    count = 8
    wet = np.zeros((count, 48, 64), bool)
    wet[..., :32] = True
    frames = np.where(wet[..., None], 60, 230).astype(np.uint8).repeat(3, axis=-1)
    scene = channel(count, kind="pour", film=write_footage(tmp_path / "film.mp4", frames, wet, 0.04))
    x, _, z = np.moveaxis(scene.terrain.grid.nodes(), -1, 0)
    lid = np.maximum(0.6 - x, np.abs(z - 0.5) - 0.06)
    solid = np.minimum(scene.terrain.signed_distance, lid).astype(np.float32)
    scene = replace(scene, terrain=replace(scene.terrain, signed_distance=solid, opaque=True))
    appearance, particles = SurfaceAppearance(scene), simulator_of(scene).particles
    appearance.advance(particles, 0)
    shown = appearance.dressed(particles, 0)
    hidden, skin = particles.positions[:, 0] > 0.75, shown.ids % 2 == 1
    body = shown.gaussians.select(~skin)
    assert np.abs(body.rgb[hidden] - 60 / 255).max() < 0.1 and body.opacities[hidden].min() > 0.5
    assert shown.gaussians.means[skin][:, 0].max() < 0.75, "no skin lies on what the wall hides"


@pytest.mark.parametrize("kind", ["stream", "fall"])
def test_what_sways_is_seen_where_its_film_shows_it_at_that_instant(channel, tmp_path, kind):
    """Beside the fluid of an instant its skin and its body are there, and are not seen."""
    count, edges = 40, (50, 44, 38, 32)
    wet = np.zeros((count, 48, 64), bool)
    for t in range(count):
        wet[t, :, 8 : edges[min(t, 3)] if t < 8 else 50] = True
    grain = np.random.default_rng(0).integers(0, 255, (count, 48, 64, 3)).astype(np.uint8)
    scene = channel(4, kind=kind, film=write_footage(tmp_path / "film.mp4", grain, wet, 0.04))
    simulator, appearance = simulator_of(scene), SurfaceAppearance(scene)
    for k, edge in enumerate(edges):
        if k:
            simulator.advance(scene.interval)
        appearance.advance(simulator.particles, k)
        shown = appearance.dressed(simulator.particles, k).gaussians
        column = scene.camera.project(shown.means)[0][:, 0]
        there, left = (column > 10) & (column < min(edge, 48) - 3), (column > edge + 3) & (column < 48)
        assert np.mean(shown.opacities[there] > 0.3) > 0.2, "the skin, not the body under it"
        if k > 1:  # three frames of forty later less than a tenth of the patches have given way
            assert left.sum() > 20 and np.mean(shown.opacities[left] > 0.05) < 0.1


def test_patches_that_stay_at_home_are_few(channel, tmp_path):
    """Where two meet, what moves in the film breaks off; nothing shears those of a scene that nobody edited."""
    path = film(tmp_path / "film.mp4")
    few, many = (
        len(dressed(channel(FRAMES, film=path, changes=changes), 1)[0].state()["patches.turns"])
        for changes in ((), ("gravity",))
    )
    assert 1 <= few < many  # the channel is so short that the patches of an edited one are of the least size


def test_a_film_smaller_than_the_clip_is_played_all_the_same(channel, tmp_path, monkeypatch):
    """Clips may be larger than their film: the camera is the same, with larger pixels."""
    from fluidlift.io import footage_file

    monkeypatch.setattr(footage_file, "LARGEST", 32)
    path = film(tmp_path / "film.mp4")
    for kind in ("stream", "fall"):
        appearance, shown = dressed(channel(FRAMES, kind=kind, film=path))
        assert appearance.warnings == () and is_red(shown)


def broken(path, fault):
    """A film that cannot be played, and the word by which its warning names that."""
    if fault == "missing":
        return "missing"
    if fault == "short":
        film(path, FEWEST - 1)
        return f"{FEWEST - 1} frames"
    if fault == "dry":
        film(path, fluid=False)
        return "none"
    film(path, size=(96, 64) if fault == "size" else (64, 48))
    data = path.read_bytes()
    path.write_bytes({"size": data, "cut": data[: len(data) // 2], "text": b"no film " * 99, "empty": b""}[fault])
    return "damaged"


@pytest.mark.parametrize("fault", ["missing", "short", "dry", "size", "cut", "text", "empty"])
def test_a_film_that_cannot_be_played_is_a_warning_and_the_look_is_that_without_one(channel, tmp_path, fault):
    path = tmp_path / "film.mp4"
    word = broken(path, fault)
    appearance = SurfaceAppearance(channel(FRAMES, film=path))
    (text,) = appearance.warnings
    assert word in text and CONSEQUENCE in text and "make the asset" in text
    plain = SurfaceAppearance(channel(FRAMES))
    assert plain.warnings == ()
    p = simulator_of(channel(FRAMES)).particles
    for k in range(2):  # the same particles at both instants: what differs is the look alone
        appearance.advance(p, k)
        plain.advance(p, k)
    one, two = appearance.dressed(p, 1), plain.dressed(p, 1)
    np.testing.assert_array_equal(one.ids, two.ids)
    np.testing.assert_array_equal(one.gaussians.sh, two.gaussians.sh)
    np.testing.assert_array_equal(one.gaussians.means, two.gaussians.means)


def test_a_fall_without_its_film_is_told_as_well(channel, tmp_path):
    appearance, shown = dressed(channel(FRAMES, kind="fall", film=tmp_path / "gone.mp4"))
    assert CONSEQUENCE in appearance.warnings[0] and (shown.ids % 2 == 0).all()


def test_a_film_is_taken_apart_once_and_again_when_it_has_changed(channel, tmp_path):
    """A live preview begins anew with every edit."""
    from fluidlift.scene.surface_film import _taken_apart

    path = film(tmp_path / "film.mp4")
    scene, before = channel(FRAMES, film=path), _taken_apart.cache_info()
    for _ in range(2):
        assert SurfaceAppearance(scene).warnings == ()
    after = _taken_apart.cache_info()
    assert after.misses == before.misses + 1 and after.hits == before.hits + 1
    path.write_bytes(b"something else")
    assert CONSEQUENCE in SurfaceAppearance(scene).warnings[0]


@pytest.mark.parametrize(("pitch", "slope"), [(90.0, 0.0), (30.0, 0.0), (10.0, 0.0), (30.0, 0.3)])
def test_a_surface_is_foreshortened_as_round_patches_of_it_are_in_the_picture(pitch, slope):
    turn, away = np.radians(pitch), 5.0
    camera = PinholeCamera.looking((0.0, -away * np.cos(turn), away * np.sin(turn)), (0.0, 0.0, 0.0), 50.0, (320, 240))
    rng = np.random.default_rng(0)
    means = rng.uniform(-0.2, 0.2, (4000, 3))
    means[:, 2] = slope * means[:, 1]
    patch = means[np.linalg.norm(means[:, :2], axis=1) < 0.1] * [
        1.0,
        1.0 / np.hypot(1.0, slope),
        1.0 / np.hypot(1.0, slope),
    ]
    wide, high = np.std(camera.project(patch)[0], axis=0)
    assert foreshortening(camera, means) == pytest.approx(high / wide, abs=0.06)


def test_another_film_is_another_look_and_a_missing_one_is_none(channel, tmp_path):
    """Frames on disk, and the checkpoint, are those of one film."""
    one, two = film(tmp_path / "a.mp4"), film(tmp_path / "b.mp4", count=17)
    looks = {name: channel(FRAMES, film=p).parts["look"] for name, p in (("none", None), ("one", one), ("two", two))}
    assert len(set(looks.values())) == 3
    assert channel(FRAMES, film=tmp_path / "gone.mp4").parts["look"] == looks["none"]
    assert channel(FRAMES, film=one, film_start=3).parts["look"] != looks["one"]


def test_a_film_begins_so_that_it_holds_the_body_at_rest():
    assert first_of_film(0, 300) == 0 and first_of_film(40, 60) == 0
    assert first_of_film(100, 300) == 100, "from the body at rest on"
    assert first_of_film(250, 300) == 180, "as long as a film may be, to the clip's end"


# what an asset holds ------------------------------------------------------------------------------------------------


@pytest.fixture
def copy(made, tmp_path):
    return shutil.copytree(made.folder, tmp_path / "stream.fluid")


def simulate(folder):
    return main(["sim", str(folder), "--set", "show.usd=false", "--set", "show.preview=false", "--duration", "0.12"])


def said_of(folder):
    return read_manifest(folder)["simulation"]["warnings"]


def test_a_stream_carries_the_clip_with_its_masks(made, finished):
    manifest, clip = read_manifest(made.folder), read_clip(made.clip)
    assert manifest["files"]["film"] == FILES["film"] and FILES["film"] in manifest["hashes"]
    frames, fluid, interval = read_footage(made.folder / FILES["film"], clip.size)
    first = first_of_film(manifest["metrics"]["rest_frame"], len(clip))
    assert len(frames) == len(clip) - first and interval == pytest.approx(clip.interval, rel=1e-3)
    # the clip is grain of a pixel in two colours, and 4:2:0 keeps half of its colour
    assert np.abs(frames.astype(int) - clip.frames[first:]).mean() < 6
    labels = finished.lift.labels.labels
    assert (fluid != (labels[first:] == 1)).mean() < 0.01  # FLUID; the coder rounds the mask's corners
    assert not [w for w in said_of(made.folder) if CONSEQUENCE in w]


def test_smoke_carries_its_color_and_opacity(catalogue_asset):
    job = catalogue_asset("plume")
    manifest, clip = read_manifest(job.folder), read_clip(job.clip)
    assert film_of(job.folder) == job.folder / FILES["film"] and FILES["film"] in manifest["hashes"]
    colors, opacities, _ = read_smoke(job.folder / FILES["film"], clip.size)
    behind, a = 25.0, opacities[..., None] / 255.0
    shown = clip.frames[first_of_film(manifest["metrics"]["rest_frame"], len(clip)) :]
    smoke = shown.min(axis=-1) > 80
    again = a * colors + (1 - a) * behind
    # grain of two pixels between 90 and 230, of which the color of smoke keeps 38 to either side (`TINT`)
    assert np.abs(again - shown)[smoke].mean() < 20
    assert opacities[smoke].mean() > 60 > 5 > opacities[shown.max(axis=-1) < 40].mean()


@pytest.mark.parametrize("fault", ["missing", "damaged"])
def test_an_asset_whose_film_is_gone_or_damaged_simulates_with_a_warning(copy, fault):
    path = copy / FILES["film"]
    if fault == "missing":
        path.unlink()
    else:
        path.write_bytes(path.read_bytes()[:4000])
    assert simulate(copy) == WITH_WARNINGS
    (text,) = [w for w in said_of(copy) if "film of the fluid" in w]
    assert fault in text and CONSEQUENCE in text


def test_a_film_that_is_a_link_is_not_followed(copy, tmp_path):
    path, other = copy / FILES["film"], tmp_path / "other.mp4"
    shutil.move(path, other)
    path.symlink_to(other)
    before = sorted(p.name for p in (copy / "frames" / "splats").iterdir())
    assert simulate(copy) == REJECTED
    assert sorted(p.name for p in (copy / "frames" / "splats").iterdir()) == before


def test_a_film_that_the_manifest_does_not_list_is_not_played(channel, tmp_path):
    """A folder that is no asset has none, whatever lies in it."""
    film(tmp_path / FILES["film"])
    assert film_of(tmp_path) is None


def test_meshes_in_another_folder_and_a_preview_do_not_lose_the_film(made, tmp_path):
    asset = load_asset(made.folder)
    request = SimulationRequest(meshes=tmp_path)
    scene = scene_of(asset, made.folder, request, JobConfig(), footage=None, start=0)
    assert scene.film == made.folder / FILES["film"]
    shown = preview_scene(asset, made.folder, {}, 2)
    start = read_manifest(made.folder)["metrics"]["rest_frame"]
    assert shown.film == scene.film and shown.film_start == start - first_of_film(start, asset.frame_count)
    assert replace(scene, film=None).parts["look"] != scene.parts["look"]
