"""A finished asset is drawn in other looks, from the command line and by scene.yaml."""

import shutil

import cv2
import numpy as np
import pytest
from scipy import ndimage

from fluidlift.cli import DONE, REJECTED, WITH_WARNINGS, main
from fluidlift.io.asset_folder import load_asset
from fluidlift.io.exr import read_channels
from fluidlift.io.exr_write import write_channels
from fluidlift.io.scene_look import Look
from fluidlift.present.looks import Frame, Painter, Quality
from fluidlift.present.without_fluid import Backdrop
from fluidlift.scene.splat_files import splat_frames
from fluidlift.types import Gaussians, Grid, PinholeCamera, Terrain, TriangleMesh

WELL = (DONE, WITH_WARNINGS)
SMALL = ("--size", "120x80", "--frames", "1002-1002")


def drawn(folder, out, *options):
    """RGBA of frame 1002."""
    assert main(["render", str(folder), "-o", str(out), *SMALL, *options]) in WELL
    found = cv2.imread(str(out / "1002.png"), cv2.IMREAD_UNCHANGED)
    assert found is not None
    return found[..., [2, 1, 0, 3]].astype(int)


@pytest.fixture(scope="module")
def cut_out(made, tmp_path_factory):
    """Where the splats are, seen from the side."""
    return drawn(made.folder, tmp_path_factory.mktemp("cut"), "--view", "side", "--background", "none")[..., 3] > 128


@pytest.mark.parametrize("look", ["relit", "transparent", "surface"])
def test_each_look_shows_the_same_body_in_the_same_place(made, cut_out, tmp_path, look):
    found = drawn(made.folder, tmp_path, "--view", "side", "--background", "none", "--look", look)[..., 3] > 128
    overlap = (found & cut_out).sum() / (found | cut_out).sum()
    # a surface stands a radius outside the middles of its particles, splats reach farther still: a pixel or two
    assert overlap > 0.7, overlap


def test_a_material_changes_the_fluid_and_little_else(made, cut_out, tmp_path):
    options = ("--view", "side", "--background", "terrain", "--look", "surface", "--material")
    milk, lava = (drawn(made.folder, tmp_path / m, *options, m)[..., :3] for m in ("milk", "lava"))
    apart = np.abs(milk - lava).mean(axis=-1)
    far = cv2.dilate(cut_out.astype(np.uint8), np.ones((15, 15))) == 0
    assert apart[cut_out].mean() > 30
    assert np.median(apart[far]) <= 2  # the ground beyond the shadow and the glow is the same
    assert milk[cut_out].mean() > lava[cut_out].mean()


def test_a_material_may_be_written_with_a_space(made, tmp_path):
    options = ("--view", "side", "--look", "surface", "--material")
    apart, joined = (
        drawn(made.folder, tmp_path / str(k), *options, m) for k, m in enumerate(("muddy water", "muddy_water"))
    )
    assert np.abs(apart - joined).max() <= 2  # threads add in another order


def test_the_engines_agree_on_where_the_liquid_is(made, tmp_path):
    options = ("--view", "side", "--background", "terrain", "--look", "surface", "--material", "milk", "--engine")
    mesh, screen = (drawn(made.folder, tmp_path / e, *options, e)[..., :3] for e in ("mesh", "screen"))
    # an opaque white liquid on the same ground: what differs are its edges and ripples
    assert np.abs(mesh - screen).mean() < 25


def test_exposure_counts_in_stops(made, tmp_path):
    options = (
        "--view",
        "side",
        "--background",
        "none",
        "--look",
        "surface",
        "--material",
        "chocolate",
        "--format",
        "exr",
    )
    for name, stops in (("a", "0"), ("b", "-1")):
        assert (
            main(["render", str(made.folder), "-o", str(tmp_path / name), *SMALL, *options, "--exposure", stops])
            in WELL
        )
    first, second = (read_channels(tmp_path / n / "1002.exr") for n in "ab")
    # scene light is what an EXR holds: the exposure is for displays
    np.testing.assert_allclose(first["G"], second["G"], atol=1e-6)
    a, b = (drawn(made.folder, tmp_path / f"p{n}", *options[:-2], "--exposure", n)[..., :3] for n in ("0", "-1"))
    assert b.mean() < a.mean()


def test_scene_yaml_names_the_look_and_options_override_it(made, tmp_path):
    folder = shutil.copytree(made.folder, tmp_path / "copy.fluid")
    (folder / "scene.yaml").write_text("look: {style: relit, material: lava}\n")
    view = ("--view", "side", "--background", "none")
    by_file = drawn(folder, tmp_path / "file", *view)
    by_option = drawn(made.folder, tmp_path / "option", *view, "--look", "relit", "--material", "lava")
    np.testing.assert_array_equal(by_file, by_option)
    plain = drawn(folder, tmp_path / "plain", *view, "--look", "splats")
    np.testing.assert_array_equal(plain, drawn(made.folder, tmp_path / "own", *view))


def test_light_comes_from_a_file(made, tmp_path):
    red = {c: np.full((8, 16), 1.0 if c == "R" else 0.05, np.float32) for c in "RGB"}
    write_channels(tmp_path / "red.exr", red)
    options = ("--view", "side", "--background", "none", "--look", "relit", "--environment", str(tmp_path / "red.exr"))
    found = drawn(made.folder, tmp_path / "out", *options)
    seen = found[found[..., 3] > 200]
    assert seen[:, 0].mean() > 3 * seen[:, 2].mean()


def test_looks_stand_before_the_clips_own_background(made, tmp_path):
    plate = drawn(made.folder, tmp_path / "splats")
    surface = drawn(made.folder, tmp_path / "surface", "--look", "surface", "--material", "milk")
    same = np.abs(plate[..., :3] - surface[..., :3]).max(axis=-1) <= 1
    assert 0.15 < same.mean() < 0.95  # the banks are the plate in both; the fluid is not


def test_the_same_frame_gives_the_same_picture(made, tmp_path):
    asset = load_asset(made.folder)
    fluid, _, velocities = next(iter(splat_frames(made.folder, 1)))
    painter = Painter(Look("surface", "honey"), asset.terrain, made.folder)
    once, twice = (
        painter.picture(Frame(fluid, velocities), asset.camera.resized((96, 64)), Backdrop()).image for _ in range(2)
    )
    # the threads of pysplashsurf add up in any order: vertices move by up to 1e-7 m, light by as much
    np.testing.assert_allclose(once, twice, rtol=0, atol=1e-6)


@pytest.mark.parametrize("look", [Look("splats"), Look("relit", "honey"), Look("transparent", "honey")])
def test_the_same_frame_gives_the_same_picture_to_the_bit_where_nothing_is_meshed(made, look):
    asset = load_asset(made.folder)
    fluid, _, velocities = next(iter(splat_frames(made.folder, 1)))
    painter = Painter(look, asset.terrain, made.folder)
    once, twice = (
        painter.picture(Frame(fluid, velocities), asset.camera.resized((96, 64)), Backdrop()).image for _ in range(2)
    )
    np.testing.assert_array_equal(once, twice)


def test_a_finer_picture_averaged_is_the_same_picture_with_smooth_edges(made):
    asset = load_asset(made.folder)
    fluid, _, velocities = next(iter(splat_frames(made.folder, 1)))
    camera = asset.camera.resized((96, 64))
    look = Look("relit", "honey")
    plain, fine = (Painter(look, asset.terrain, made.folder, quality=Quality(k)) for k in (1, 2))
    a, b = (p.picture(Frame(fluid, velocities), camera, Backdrop(cut_out=True)) for p in (plain, fine))
    assert b.image.shape == a.image.shape and b.alpha.shape == a.alpha.shape == b.depth.shape
    # it is the finer picture, averaged
    wide = plain.picture(Frame(fluid, velocities), camera.resized((192, 128)), Backdrop(cut_out=True))
    np.testing.assert_allclose(b.image, wide.image.reshape(64, 2, 96, 2, 3).mean(axis=(1, 3)), atol=1e-6)
    np.testing.assert_allclose(b.alpha, wide.alpha.reshape(64, 2, 96, 2).mean(axis=(1, 3)), atol=1e-6)
    # and edges apart the same light: the rasteriser's blur of half a pixel is half as wide in the finer picture, so
    # that outlines lie elsewhere
    inside, outside = (ndimage.binary_erosion(m, iterations=2) for m in (a.alpha > 0.98, a.alpha < 0.02))
    assert inside.sum() > 300 and outside.sum() > 300
    assert np.median(np.abs(a.image - b.image)) < 0.01
    assert np.abs(a.alpha - b.alpha)[inside | outside].mean() < 0.01
    plate = np.random.default_rng(0).uniform(0, 1, (64, 96, 3)).astype(np.float32)
    lit = fine.picture(Frame(fluid, velocities), camera, Backdrop(np.zeros_like(plate)))
    kept = fine.picture(Frame(fluid, velocities), camera, Backdrop(plate))
    bare = lit.image.max(axis=-1) == 0  # no sample of the pixel meets a splat
    assert bare.mean() > 0.1
    np.testing.assert_allclose(kept.image[bare], plate[bare], atol=1e-6)
    with pytest.raises(ValueError, match="supersample"):
        Quality(0)


@pytest.mark.parametrize("look", [Look("relit", "source"), Look("transparent", "milk")], ids=lambda look: look.style)
def test_splats_throw_a_shadow_on_the_ground_and_none_on_a_clip(tmp_path, look):
    grid = Grid((20, 20, 12), 0.1, (-1.0, -1.0, -0.1))
    height = np.broadcast_to(-0.1 + 0.1 * np.arange(13.0), (21, 21, 13)).astype(np.float32)
    floor = TriangleMesh(np.array([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]), np.array([[0, 1, 2], [0, 2, 3]]))
    inside = np.stack(np.meshgrid(*[np.arange(-6, 7)] * 3, indexing="ij"), -1).reshape(-1, 3) * 0.05
    ball = inside[np.linalg.norm(inside, axis=1) < 0.25] + (0.0, 0.0, 0.6)
    fluid = Gaussians.isotropic(ball.astype(np.float32), 0.025, np.full((len(ball), 3), 0.6))
    frame, none = (Frame(g, np.zeros((len(g), 3), np.float32)) for g in (fluid, Gaussians.empty()))
    camera = PinholeCamera.looking(np.array([0.0, -2.0, 3.0]), np.array([0.0, 0.0, 0.2]), 45.0, (64, 48))
    painter = Painter(look, Terrain(grid, height, np.array([1.0, 0, 0]), floor), tmp_path, kind="pour")
    full, empty = (painter.picture(f, camera, Backdrop()).image for f in (frame, none))
    outline = painter.picture(frame, camera, Backdrop(cut_out=True)).alpha
    beside = ndimage.maximum_filter(outline, 3) == 0
    darker = 1.0 - full[beside].mean(axis=-1) / np.maximum(empty[beside].mean(axis=-1), 1e-6)
    # nothing gets brighter, and where the sun (0.7 of the light) is hidden there is less than half
    assert darker.min() > -1e-4 and darker.max() > 0.5 and (darker > 0.02).sum() > 50
    # a clip's plate has the shadows of its own fluid
    plate = np.full((48, 64, 3), 0.5, np.float32)
    np.testing.assert_allclose(painter.picture(frame, camera, Backdrop(plate)).image[beside], 0.5, atol=1e-6)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (("--look", "surfce"), "did you mean surface"),
        (("--look", "relit", "--material", "hony"), "did you mean honey"),
        (("--look", "relit", "--environment", "studo"), "did you mean studio"),
        (("--look", "relit", "--engine", "screen"), "the look surface"),
        (("--look", "surface", "--engine", "mitsubi"), "did you mean mitsuba"),
        (("--look", "splats", "--material", "honey"), "add --look relit"),
        (("--look", "relit", "--exposure", "99"), "-20 to 20"),
        (("--engine", "mitsuba", "--background", "none"), "--background plate or terrain"),
        (("--look", "surface", "--engine", "mitsuba", "--samples", "0"), "1 to 100000"),
    ],
)
def test_what_cannot_be_drawn_is_refused_before_anything_is_written(made, tmp_path, capsys, options, words):
    assert main(["render", str(made.folder), "-o", str(tmp_path / "out"), *options]) == REJECTED
    assert words in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_a_final_frame_is_traced(made, tmp_path):
    pytest.importorskip("mitsuba", reason="Mitsuba is not installed")
    options = ("--engine", "mitsuba", "--samples", "4", "--view", "side", "--material", "milk")
    assert (
        main(["render", str(made.folder), "-o", str(tmp_path), "--size", "60x40", "--frames", "1002-1002", *options])
        in WELL
    )
    found = cv2.imread(str(tmp_path / "1002.png"))
    quick = tmp_path / "quick"
    options = ("--look", "surface", "--view", "side", "--material", "milk")
    assert (
        main(["render", str(made.folder), "-o", str(quick), "--size", "60x40", "--frames", "1002-1002", *options])
        in WELL
    )
    other = cv2.imread(str(quick / "1002.png"))
    # the same opaque white body on the same ground under the same sky; noise, and light between ground and liquid
    assert np.abs(found.astype(int) - other).mean() < 35
