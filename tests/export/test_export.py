"""A finished asset is written for other tools."""

import json
import shutil
from dataclasses import replace

import numpy as np
import pytest
import trimesh
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from fluidlift.cli import DONE, REJECTED, WITH_WARNINGS, main
from fluidlift.errors import InputRejected
from fluidlift.export.volumes import gridded, level_set
from fluidlift.io.asset_folder import load_asset, read_manifest
from fluidlift.io.frames import FluidFrame
from fluidlift.io.ply import read_mesh, read_splats
from fluidlift.io.stage_cache import mark_owner, save_stage
from fluidlift.io.stage_codec import packed
from fluidlift.io.validate_usd import validate_usd
from fluidlift.numerics.sampling import sample_nodes
from fluidlift.scene.splat_files import frame_file, frame_numbers, read_frame
from fluidlift.types import Gaussians, Grid, TriangleMesh
from fluidlift.types.stages import Simulation

WELL = (DONE, WITH_WARNINGS)


def export(made, out, *options):
    return main(["export", str(made.folder), "-o", str(out), "--frames", "1001-1002", *options])


def test_the_surface_holds_the_particles_and_stays_out_of_the_bed(made, tmp_path):
    assert export(made, tmp_path / "out") in WELL
    assert sorted(p.name for p in (tmp_path / "out").iterdir()) == ["1001.ply", "1002.ply", "terrain.glb"]
    mesh, asset = read_mesh(tmp_path / "out" / "1002.ply"), load_asset(made.folder)
    splats = read_frame(frame_file(made.folder, 1002)).gaussians
    h = asset.grid.spacing
    low, high = np.percentile(splats.means, [1, 99], axis=0)
    assert (mesh.vertices.min(0) < low + h).all() and (mesh.vertices.max(0) > high - h).all()
    inside = asset.terrain.grid.contains(mesh.vertices)
    depth = sample_nodes(asset.terrain.signed_distance, asset.terrain.grid, mesh.vertices[inside])
    assert np.percentile(depth, 1) > -0.2 * h  # the stored distance is not exact beside edges


def test_other_tools_read_the_surface_with_its_velocities(made, tmp_path):
    assert export(made, tmp_path / "out") in WELL
    other = trimesh.load(tmp_path / "out" / "1001.ply", process=False)
    data = other.metadata["_ply_raw"]["vertex"]["data"]
    own = read_frame(frame_file(made.folder, 1001))
    _, nearest = cKDTree(own.gaussians.means).query(np.asarray(other.vertices), k=8)
    beside = own.velocities[:, 0][nearest].mean(axis=1)
    # both are means over the neighbourhood, with other weights
    assert np.median(np.abs(data["vx"] - beside)) < 0.25 * np.std(own.velocities[:, 0])
    assert len(other.visual.vertex_colors) == len(other.vertices)


def test_axes_and_units_turn_positions_and_velocities_alike(made, tmp_path):
    assert export(made, tmp_path / "a") in WELL
    assert export(made, tmp_path / "b", "--up-axis", "y", "--meters-per-unit", "0.01") in WELL
    first, second = (trimesh.load(tmp_path / n / "1001.ply", process=False) for n in "ab")
    x, y, z = np.asarray(first.vertices).T
    turned = 100 * np.stack([x, z, -y], 1)
    # the same vertices, in the order in which the mesher's threads ended
    assert len(turned) == len(second.vertices)
    away, same = cKDTree(turned).query(np.asarray(second.vertices))
    assert away.max() < 1e-3 and cKDTree(np.asarray(second.vertices)).query(turned)[0].max() < 1e-3
    data = [m.metadata["_ply_raw"]["vertex"]["data"] for m in (first, second)]
    np.testing.assert_allclose(data[1]["vy"], 100 * data[0]["vz"][same], rtol=1e-4, atol=1e-3)
    header = (tmp_path / "b" / "1001.ply").read_bytes()[:400]
    assert b"0.01 m" in header and b"y up" in header


def test_obj_files_hold_the_same_surface(made, tmp_path):
    assert export(made, tmp_path / "ply") in WELL and export(made, tmp_path / "obj", "--to", "obj") in WELL
    obj = trimesh.load(tmp_path / "obj" / "1001.obj", process=False)
    ply = read_mesh(tmp_path / "ply" / "1001.ply")
    assert len(obj.faces) == len(ply.faces)
    np.testing.assert_allclose(np.sort(obj.vertices[:, 2]), np.sort(ply.vertices[:, 2]), atol=1e-5)


def test_splats_come_back_as_they_were(made, tmp_path):
    assert export(made, tmp_path / "out", "--to", "splats", "--up-axis", "y") in WELL
    back = read_splats(tmp_path / "out" / "1001.ply")
    own = read_frame(frame_file(made.folder, 1001))
    np.testing.assert_allclose(back.gaussians.means, own.gaussians.means, atol=1e-5)
    np.testing.assert_array_equal(back.extras["id"], own.ids)


def test_usd_holds_the_surface_at_every_frame(made, tmp_path):
    from pxr import Usd, UsdGeom

    assert export(made, tmp_path / "out", "--to", "usd") in WELL
    assert validate_usd(tmp_path / "out" / "fluid.usda") == []
    stage = Usd.Stage.Open(str(tmp_path / "out" / "fluid.usda"))
    moving = [
        UsdGeom.Mesh(p).GetPointsAttr() for p in stage.Traverse()
        if p.IsA(UsdGeom.Mesh) and UsdGeom.Mesh(p).GetPointsAttr().GetNumTimeSamples()
    ]  # fmt: skip
    assert [m.GetTimeSamples() for m in moving] == [[1001.0, 1002.0]]


def test_the_outcome_is_told_in_json(made, tmp_path, capsys):
    assert export(made, tmp_path / "out", "--to", "splats", "--json") in WELL
    told = json.loads(capsys.readouterr().out)
    assert told["frames"] == 2 and told["first"] == 1001 and told["fps"] == pytest.approx(25)
    assert read_manifest(made.folder)["simulation"]["frames"] > 2


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (("--to", "objj"), "did you mean obj"),
        (("--meters-per-unit", "0"), "0.01 for centimetres"),
        (("--frames", "2000-2001"), "numbers from 1001"),
    ],
)
def test_what_cannot_be_written_is_refused(made, tmp_path, capsys, options, words):
    assert main(["export", str(made.folder), "-o", str(tmp_path / "out"), *options]) == REJECTED
    assert words in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("command", ["export", "render"])
def test_a_place_that_cannot_be_written_is_refused(made, capsys, command):
    assert main([command, str(made.folder), "-o", "/proc/no", "--frames", "1001-1001"]) == REJECTED
    said = capsys.readouterr().err
    assert "cannot be written" in said and "a folder that can be written" in said


def test_a_frame_that_is_missing_in_the_middle_is_named(tmp_path):
    for k in (1001, 1002, 1004):
        (tmp_path / "frames" / "splats").mkdir(parents=True, exist_ok=True)
        (tmp_path / "frames" / "splats" / f"{k}.flsp").touch()
    with pytest.raises(InputRejected, match=r"frame 1003 is missing: frames/splats/1003\.flsp.*--restart"):
        frame_numbers(tmp_path, 4, (1002, 1004))
    assert frame_numbers(tmp_path, 4, (1004, 1004)) == range(3, 4)
    assert frame_numbers(tmp_path, 4, None) == range(2)
    with pytest.raises(InputRejected, match="numbers from 1001 to 1004"):
        frame_numbers(tmp_path, 4, (1001, 1005))


def test_a_page_that_was_not_asked_for_says_how(made, tmp_path, capsys):
    assert export(made, tmp_path / "river.html") == REJECTED
    assert "add --to html" in capsys.readouterr().err


def test_volumes_hold_the_motion_and_the_amount_of_the_fluid(made):
    asset, frame = load_asset(made.folder), read_frame(frame_file(made.folder, 1002))
    velocity, density, grid = gridded(frame, asset.grid)
    filled = density > 0
    offset = (grid.low - asset.grid.low) / asset.grid.spacing
    np.testing.assert_allclose(offset, np.round(offset), atol=1e-6)  # on the cells of the simulation
    liquid = frame.ids % 2 == 0  # odd ones are the skin's, which is no liquid
    assert liquid.any() and (~liquid).any()
    held = np.zeros(filled.shape, bool)
    held[tuple(grid.cell_of(frame.gaussians.means[liquid]).T)] = True
    np.testing.assert_array_equal(filled, held)
    assert density.max() == 1.0
    # a cell's velocity is a mean of what is in it and beside it
    mean = velocity.at_centers()[filled].mean(axis=0)
    np.testing.assert_allclose(mean, frame.velocities[liquid].mean(axis=0), atol=0.5 * frame.velocities.std())


def test_the_density_of_smoke_is_what_its_splats_take_out_of_a_beam():
    """Fog of that extinction in the cells takes as much light in all as the splats do: 2 pi s^2 a each."""
    rng = np.random.default_rng(0)
    opacity = rng.uniform(0.02, 0.2, 500)
    smoke = Gaussians.isotropic(rng.uniform(0, 1, (500, 3)), 0.05, np.full((500, 3), 0.5), opacity)
    frame = FluidFrame(smoke, np.arange(500), np.zeros((500, 3), np.float32))
    _, density, grid = gridded(frame, Grid((10, 10, 10), 0.1), smoke=True)
    drawn = opacity.astype(np.float32) - 1 / 255
    assert density.sum() * grid.spacing**3 == pytest.approx(2 * np.pi * 0.05**2 * drawn.sum(), rel=1e-4)
    hidden = replace(smoke, opacities=np.full(500, 0.002, np.float32))  # there for other tools, but not drawn
    assert not gridded(frame._replace(gaussians=hidden), Grid((10, 10, 10), 0.1), smoke=True)[1].any()


def test_the_level_set_of_a_ball_is_its_distance_and_knows_its_inside():
    ball = trimesh.creation.icosphere(subdivisions=4, radius=0.3)
    grid = level_set(TriangleMesh(np.asarray(ball.vertices), np.asarray(ball.faces)), 0.05)
    index = np.stack(np.meshgrid(*(np.arange(n) for n in grid.values.shape), indexing="ij"), -1)
    distance = np.linalg.norm(np.asarray(grid.origin) + (index + 0.5) * 0.05, axis=-1) - 0.3
    near = np.abs(distance) < 0.1
    np.testing.assert_allclose(grid.values[near], distance[near], atol=0.002)  # the ball is made of flat triangles
    assert grid.active is not None and grid.active[distance < 0].all() and (grid.values[distance < -0.01] < 0).all()
    assert grid.background == pytest.approx(0.15)


def test_vdb_files_are_numbered_and_refuse_other_axes(made, tmp_path, capsys):
    assert export(made, tmp_path / "out", "--to", "vdb") in WELL
    files = sorted((tmp_path / "out").iterdir())
    assert [f.name for f in files] == ["1001.vdb", "1002.vdb"]
    data = files[0].read_bytes()
    for name in (b"vel", b"density", b"surface", b"level set"):
        assert name in data
    assert export(made, tmp_path / "other", "--to", "vdb", "--up-axis", "y") == REJECTED
    assert "z up and metres" in capsys.readouterr().err


@pytest.fixture
def floating(made, tmp_path):
    """The small asset with a turned box that the simulation carried a metre along x in its two first frames."""
    folder = shutil.copytree(made.folder, tmp_path / "floating.fluid")
    entry = "{name: a/b, shape: box, size: [0.1, 0.2, 0.3], position: [0, 0, 1], motion: free, density: 400}"
    (folder / "scene.yaml").write_text(f"obstacles:\n  - {entry}\n")
    poses = np.zeros((2, 1, 7))
    poses[:, 0, 0], poses[:, 0, 2] = (0.0, 1.0), 1.0
    poses[:, 0, 3], poses[:, 0, 6] = np.sqrt(0.5), np.sqrt(0.5)  # a quarter turn about z
    arrays, data = packed(Simulation(np.ones(len(poses)), np.zeros(len(poses)), np.ones(len(poses), int), poses))
    save_stage(folder, "simulate", "k", arrays, {"seconds": 1.0, "value": data})
    mark_owner(folder, "simulate", "k")
    return folder


def test_obstacles_lie_beside_the_meshes_where_the_simulation_had_them(floating, tmp_path):
    out = tmp_path / "out"
    assert main(["export", str(floating), "-o", str(out), "--frames", "1001-1002"]) in WELL
    (body,) = json.loads((out / "bodies.json").read_text())["bodies"]
    assert body["name"] == "a/b" and body["mesh"] == "bodies/01_a_b.ply" and body["first"] == 1001
    half = np.sqrt(0.5)
    np.testing.assert_allclose(body["poses"], [[0, 0, 1, half, 0, 0, half], [1, 0, 1, half, 0, 0, half]], atol=1e-12)
    mesh = read_mesh(out / body["mesh"])
    np.testing.assert_allclose(np.ptp(mesh.vertices, axis=0), [0.1, 0.2, 0.3], atol=1e-6)
    (floating / "scene.yaml").write_text("")
    assert main(["export", str(floating), "-o", str(out), "--frames", "1001-1002"]) in WELL
    assert not (out / "bodies.json").exists() and not list(out.glob("bodies/*"))  # of an earlier run


def test_obstacles_turn_with_the_axes_and_take_the_units_of_the_meshes(floating, tmp_path):
    command = ["export", str(floating), "--frames", "1001-1002"]
    assert main([*command, "-o", str(tmp_path / "z")]) in WELL
    assert main([*command, "-o", str(tmp_path / "y"), "--up-axis", "y", "--meters-per-unit", "0.01"]) in WELL
    placed = []
    for name in "zy":
        (body,) = json.loads((tmp_path / name / "bodies.json").read_text())["bodies"]
        pose = np.array(body["poses"][1])
        turn = Rotation.from_quat(pose[3:], scalar_first=True)
        placed.append(turn.apply(read_mesh(tmp_path / name / body["mesh"]).vertices) + pose[:3])
    x, y, z = placed[0].T
    np.testing.assert_allclose(placed[1], 100 * np.stack([x, z, -y], 1), atol=1e-4)


def test_obstacles_whose_motion_is_not_known_are_told(floating, tmp_path, capsys):
    mark_owner(floating, "simulate", None)
    assert main(["export", str(floating), "-o", str(tmp_path / "out"), "--frames", "1001-1002"]) == WITH_WARNINGS
    assert "fluidlift sim" in capsys.readouterr().err and not (tmp_path / "out" / "bodies.json").exists()
