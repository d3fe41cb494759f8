"""What a USD export takes from the asset besides its frames: material, obstacles, volumes of smoke."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from pxr import Gf, Usd, UsdGeom, UsdVol

from fluidlift.io.frames import FluidFrame
from fluidlift.io.stage_cache import mark_owner, save_stage
from fluidlift.io.stage_codec import packed
from fluidlift.io.validate_usd import splat_rule_faults, validate_usd
from fluidlift.pipeline.usd_exporting import bodies_of, preview_of, write_usd_asset
from fluidlift.types import FluidParameters, Gaussians, Grid, PinholeCamera, TriangleMesh
from fluidlift.types.stages import Simulation

COUNT = 4


@pytest.fixture
def folder(tmp_path):
    """An asset's folder with a floating ball and the poses that the simulation gave it."""
    path = tmp_path / "a.fluid"
    path.mkdir()
    (path / "scene.yaml").write_text(
        "obstacles:\n  - {name: ball, shape: sphere, position: [0, 0, 1], radius: 0.1, motion: free}\n"
        "look: {material: honey}\n"
    )
    poses = np.zeros((COUNT, 1, 7))
    poses[:, 0, 0], poses[:, 0, 2], poses[:, 0, 3] = np.arange(COUNT), 1.0, 1.0
    arrays, data = packed(Simulation(np.ones(len(poses)), np.zeros(len(poses)), np.ones(len(poses), int), poses))
    save_stage(path, "simulate", "k", arrays, {"seconds": 1.0, "value": data})
    mark_owner(path, "simulate", "k")
    return path


def asset(kind: str = "stream") -> SimpleNamespace:
    rng = np.random.default_rng(0)
    rest = Gaussians.isotropic(rng.uniform(0, 1, (200, 3)), 0.02, np.full((200, 3), 0.5))
    ground = TriangleMesh(np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], np.float32), np.array([[0, 1, 2]]))
    return SimpleNamespace(
        kind=kind, rest=rest, grid=Grid((10, 10, 10), 0.1, (0.0, 0.0, 0.0)), terrain=SimpleNamespace(mesh=ground),
        camera=PinholeCamera.looking((0.5, -3.0, 1.0), (0.5, 0.5, 0.5), 50, (64, 48)), parameters=FluidParameters(),
    )  # fmt: skip


def job(folder, out, kind="stream", picked=range(COUNT)):
    out.mkdir()
    return SimpleNamespace(folder=folder, out=out, asset=asset(kind), picked=picked, interval=0.04 * picked.step)


def frames(count: int):
    rest = asset().rest
    return [FluidFrame(rest, np.arange(200), np.zeros((200, 3), np.float32))] * count


def test_the_material_of_the_scene_is_seen_as_deep_as_the_body_is(folder):
    honey = preview_of(folder, asset())
    assert honey is not None and honey.name == "honey" and honey.refractive_index == 1.49
    assert honey.color is not None and honey.color[0] > honey.color[2] and honey.opacity > 0.95  # half a metre of it
    (folder / "scene.yaml").write_text("look: {material: water}\n")
    water = preview_of(folder, asset())
    assert water is not None and water.opacity == 0.25  # clear, and still something to see
    (folder / "scene.yaml").write_text("")
    assert preview_of(folder, asset()) is None  # the clip's own colours


def test_obstacles_stand_where_the_simulation_had_them_in_the_frames_that_are_picked(folder, tmp_path):
    from fluidlift.io.export_usd import UsdSettings

    one = job(folder, tmp_path / "out", picked=range(1, COUNT, 2))
    assert write_usd_asset(one, frames(2), UsdSettings(start_frame=1002, up_axis="y")) == ()
    path = tmp_path / "out" / "fluid.usda"
    assert validate_usd(path) == [] and splat_rule_faults(path) == []
    stage = Usd.Stage.Open(str(path))
    ball = UsdGeom.Xformable(stage.GetPrimAtPath("/Fluid/Bodies/ball"))
    for code, x in ((1002, 1.0), (1003, 3.0)):  # frames 1 and 3 of the simulation
        place = ball.ComputeLocalToWorldTransform(code).Transform(Gf.Vec3d(0, 0, 0))
        np.testing.assert_allclose(place, (x, 1.0, 0.0), atol=1e-12)  # y up


def test_obstacles_whose_motion_is_not_known_are_left_out_with_a_warning(folder):
    mark_owner(folder, "simulate", None)
    bodies, warnings = bodies_of(folder, range(COUNT))
    assert bodies == [] and "fluidlift sim" in warnings[0]
    (folder / "scene.yaml").write_text("")
    assert bodies_of(folder, range(COUNT)) == ([], ())


@pytest.mark.parametrize("layout", ["file", "clips"])
def test_smoke_refers_to_a_volume_per_frame(folder, tmp_path, layout):
    from fluidlift.io.export_usd import UsdSettings

    (folder / "scene.yaml").write_text("")
    one = job(folder, tmp_path / "out", "plume", range(2))
    write_usd_asset(one, frames(2), UsdSettings(layout=layout, up_axis="y"))
    path = tmp_path / "out" / "fluid.usda"
    assert validate_usd(path) == []
    stage = Usd.Stage.Open(str(path))
    for name in ("density", "vel"):
        field = UsdVol.OpenVDBAsset(stage.GetPrimAtPath(f"/Fluid/Volume/{name}")).GetFilePathAttr()
        assert [field.Get(1001 + k).path for k in range(2)] == [f"./volumes/{1001 + k}.vdb" for k in range(2)]
    assert (tmp_path / "out" / "volumes" / "1002.vdb").is_file()
