"""Exports show the ground that the frames flow over: what scene.yaml does to the terrain arrives in every format."""

import shutil

import numpy as np
import pytest
import trimesh
from PIL import Image
from pxr import Usd, UsdGeom

from fluidlift.cli import DONE, WITH_WARNINGS, main
from fluidlift.io import export_page as page
from fluidlift.io.asset_folder import load_asset, read_manifest, update_manifest
from fluidlift.io.ply import AXES, read_splats
from fluidlift.look.rasterize import render
from fluidlift.scene.splat_files import frame_file, read_frame, write_frame
from fluidlift.types import Gaussians, PinholeCamera, RigidTransform

WELL = (DONE, WITH_WARNINGS)
MOVE = (3.0, -2.0, 0.5)
"""m; far from where the terrain was"""


@pytest.fixture
def copy(made, tmp_path):
    return shutil.copytree(made.folder, tmp_path / "copy.fluid")


def exported(folder, out, to, *options):
    assert main(["export", str(folder), "-o", str(out), "--frames", "1001-1001", "--to", to, *options]) in WELL
    return out


def box_of_glb(path, name=None):
    """Bounds of a mesh, z up."""
    scene = trimesh.load(path, process=False)
    mesh = scene.geometry[name] if name else next(iter(scene.geometry.values()))
    x, y, z = np.asarray(mesh.vertices).T
    points = np.stack([x, -z, y], axis=1)
    return np.stack([points.min(0), points.max(0)])


def box_of_usd(path):
    stage = Usd.Stage.Open(str(path))
    points = np.array(UsdGeom.Mesh(stage.GetPrimAtPath("/Fluid/Terrain")).GetPointsAttr().Get())
    return np.stack([points.min(0), points.max(0)])


@pytest.fixture
def in_page(monkeypatch):
    """Vertices of the ground that goes into a page."""
    found, write = [], page.write_page

    def spy(path, frames, held, scene):
        found.append(np.asarray(scene.terrain.vertices))
        return write(path, frames, held, scene)

    monkeypatch.setattr(page, "write_page", spy)
    return found


def test_a_terrain_that_was_moved_is_moved_in_every_format(copy, tmp_path, in_page):
    was = np.asarray(load_asset(copy).terrain.mesh.vertices)
    (copy / "scene.yaml").write_text(f"terrain:\n  - move: {list(MOVE)}\n")
    moved = np.stack([was.min(0), was.max(0)]) + MOVE
    for to in ("mesh", "obj", "splats"):
        out = exported(copy, tmp_path / to, to)
        np.testing.assert_allclose(box_of_glb(out / "terrain.glb"), moved, atol=1e-5)  # single precision of metres
    out = exported(copy, tmp_path / "gltf", "gltf")
    for name in ("hero.glb", "surface.glb"):
        np.testing.assert_allclose(box_of_glb(out / name, "terrain"), moved, atol=1e-5)
    np.testing.assert_allclose(box_of_usd(exported(copy, tmp_path / "usd", "usd") / "fluid.usda"), moved, atol=1e-5)
    exported(copy, tmp_path / "page.html", "html")
    np.testing.assert_allclose(np.stack([in_page[0].min(0), in_page[0].max(0)]), moved, atol=1e-5)


@pytest.mark.parametrize(
    ("edit", "expected"),
    [
        ("rotate: 90", lambda p, c: np.stack([c[0] - (p[:, 1] - c[1]), c[1] + (p[:, 0] - c[0]), p[:, 2]], 1)),
        ("scale: [2, 1, 1.5]", lambda p, c: c + (p - c) * [2, 1, 1.5]),
    ],
)
def test_turned_and_scaled_ground_is_so_in_exports(copy, tmp_path, edit, expected):
    asset = load_asset(copy)
    was, grid = np.asarray(asset.terrain.mesh.vertices, float), asset.terrain.grid
    center = np.array([*0.5 * (grid.low + grid.high)[:2], grid.low[2]])
    (copy / "scene.yaml").write_text(f"terrain:\n  - {edit}\n")
    points = expected(was, center)
    box = box_of_glb(exported(copy, tmp_path / "out", "splats") / "terrain.glb")
    np.testing.assert_allclose(box, [points.min(0), points.max(0)], atol=1e-5)


def test_a_twist_is_seen_in_exports(copy, tmp_path):
    was = np.asarray(load_asset(copy).terrain.mesh.vertices)
    (copy / "scene.yaml").write_text("terrain:\n  - twist: 60\n")
    box = box_of_glb(exported(copy, tmp_path / "out", "splats") / "terrain.glb")
    assert np.abs(box - [was.min(0), was.max(0)]).max() > 0.1


def test_a_bed_from_a_file_arrives_with_its_texture(copy, tmp_path):
    asset = load_asset(copy)
    (x0, y0, z), (x1, y1, _) = asset.terrain.grid.low, asset.terrain.grid.high
    picture = np.zeros((16, 16, 3), np.uint8)
    picture[:, :8], picture[:, 8:] = (200, 30, 10), (20, 40, 180)
    Image.fromarray(picture).save(copy / "bed.png")
    (copy / "bed.mtl").write_text("newmtl bed\nmap_Kd bed.png\n")
    corners = [(x0, y0), (x1, y0), (x1, y1), (x0, y1)]
    lines = ["mtllib bed.mtl", *(f"v {x} {y} {z + 0.05}" for x, y in corners), "vt 0 0", "vt 1 0", "vt 1 1", "vt 0 1"]
    (copy / "bed.obj").write_text("\n".join([*lines, "usemtl bed", "f 1/1 2/2 3/3 4/4"]))
    (copy / "scene.yaml").write_text("terrain:\n  - mesh: bed.obj\n")
    out = exported(copy, tmp_path / "out", "splats")
    mesh = next(iter(trimesh.load(out / "terrain.glb", process=False).geometry.values()))
    shown = np.asarray(mesh.visual.material.baseColorTexture.convert("RGB")).reshape(-1, 3)
    for color in ((200, 30, 10), (20, 40, 180)):
        # glTF may hold it as JPEG
        assert np.abs(shown.astype(int) - color).max(axis=1).min() < 10
    usd = exported(copy, tmp_path / "usd", "usd")
    assert [p.name for p in usd.glob("*.png")] and box_of_usd(usd / "fluid.usda")[1, 2] == pytest.approx(z + 0.05)


def test_a_channel_made_longer_is_longer_in_exports(copy, tmp_path):
    before = box_of_glb(exported(copy, tmp_path / "a", "splats") / "terrain.glb")
    update_manifest(copy, simulation=read_manifest(copy)["simulation"] | {"extended_downstream": 1.0})
    after = box_of_glb(exported(copy, tmp_path / "b", "splats") / "terrain.glb")
    # whole cells, at least as many as cover the metre
    assert 0.9 < np.linalg.norm(np.ptp(after, axis=0)[:2] - np.ptp(before, axis=0)[:2]) < 1.2


def test_a_file_with_other_axes_and_units_shows_the_same_picture_to_who_takes_it_as_it_stands(copy, tmp_path):
    """Splats with harmonics of degree 3, y up in centimetres, read without looking at the file's own words."""
    splats, rng = read_frame(frame_file(copy, 1001)), np.random.default_rng(0)
    g = splats.gaussians
    sh = np.concatenate([g.sh[:, :1], rng.normal(0, 0.1, (len(g), 15, 3))], axis=1)
    g = Gaussians(g.means, g.quats, g.scales, g.opacities, sh)
    g = read_frame(write_frame(copy, 1001, g, ids=splats.ids, velocities=splats.velocities)).gaussians  # as it is kept
    out = exported(copy, tmp_path / "out", "splats", "--up-axis", "y", "--meters-per-unit", "0.01")
    data = (out / "1001.ply").read_bytes()
    assert b"axes y_up" in data
    (out / "plain.ply").write_bytes(data.replace(b"axes y_up", b"axes z_up", 1))
    found = read_splats(out / "plain.ply").gaussians
    camera, turn = load_asset(copy).camera, AXES["y_up"]
    world = camera.camera_from_world
    there = RigidTransform(world.rotation @ turn.T, 100 * world.translation)
    moved = PinholeCamera(camera.focal, camera.center, camera.size, there)
    ours, theirs = render(g, camera).image, render(found, moved).image
    # single precision of harmonics that were turned; splats at the edge of what is drawn (1/255) may come or go
    assert np.abs(theirs - ours).mean() < 1e-4
    unturned = Gaussians(found.means, found.quats, found.scales, found.opacities, g.sh)
    assert np.abs(render(unturned, moved).image - ours).mean() > 1e-3
