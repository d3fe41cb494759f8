"""USD files pass OpenUSD's validators and our own, and show what was put in."""

from __future__ import annotations

import numpy as np
import pytest
from pxr import Gf, Sdf, Usd, UsdGeom, UsdShade, UsdVol

from fluidlift.io.export_usd import validate_usd, write_camera, write_usd
from fluidlift.io.frames import FluidFrame, MovingMesh
from fluidlift.io.validate_usd import frame_range
from fluidlift.io.volume_grid import VolumeGrid, write_vdb
from fluidlift.types import Gaussians, PinholeCamera, RigidTransform, TriangleMesh


def frames_of(gaussians, mesh=None, count=3):
    """Frames whose number of splats changes."""
    for t in range(count):
        g = gaussians(20 + 3 * t, seed=t)
        surface = None if mesh is None else mesh
        yield FluidFrame(g, np.arange(len(g)) + t, np.full((len(g), 3), t, np.float32), surface, np.ones((4, 3)))


@pytest.fixture
def usd(tmp_path, gaussians, mesh):
    """A file with everything in it."""
    camera = PinholeCamera.looking(np.array([3.0, -2.0, 2.0]), np.zeros(3), 50, (512, 288))
    write_usd(
        tmp_path / "asset.usda",
        frames=frames_of(gaussians, mesh),
        interval=1001 / 30000,
        terrain=mesh,
        camera=camera,
        attributes={"kind": "stream", "density": 1000.0, "gravity": (0, 0, -9.81), "seed": 3, "fitted": True},
    )
    return tmp_path / "asset.usda"


def test_the_file_has_no_faults(usd):
    assert validate_usd(usd) == []
    assert validate_usd(usd.with_suffix(".usdc")) == []
    assert sorted(p.name for p in usd.parent.iterdir()) == ["asset.usda", "asset.usdc"]


def test_time_scale_and_axes_are_stated(usd):
    stage = Usd.Stage.Open(str(usd))
    assert frame_range(usd) == (1001, 1003)
    assert stage.GetTimeCodesPerSecond() == pytest.approx(30000 / 1001, rel=1e-12)
    assert UsdGeom.GetStageUpAxis(stage) == "Z" and UsdGeom.GetStageMetersPerUnit(stage) == 1.0
    assert stage.GetDefaultPrim().GetPath() == "/Fluid"
    assert stage.GetDefaultPrim().GetAttribute("fluid:density").Get() == 1000.0
    assert stage.GetDefaultPrim().GetAttribute("fluid:gravity").Get() == Gf.Vec3d(0, 0, -9.81)


def test_splats_come_back_at_every_frame(usd, gaussians):
    stage = Usd.Stage.Open(str(usd))
    prim = UsdVol.ParticleField3DGaussianSplat(stage.GetPrimAtPath("/Fluid/Splats"))
    for t, frame in enumerate(frames_of(gaussians)):
        g, time = frame.gaussians, 1001 + t
        np.testing.assert_array_equal(np.array(prim.GetPositionsAttr().Get(time)), g.means)
        half = 2.0**-11  # relative rounding of half precision
        np.testing.assert_allclose(np.array(prim.GetScaleshAttr().Get(time), float), g.scales, rtol=half)
        np.testing.assert_allclose(np.array(prim.GetOpacitieshAttr().Get(time), float), g.opacities, rtol=half)
        sh = np.array(prim.GetRadianceSphericalHarmonicsCoefficientshAttr().Get(time), float)
        np.testing.assert_allclose(sh.reshape(g.sh.shape), g.sh, rtol=half, atol=1e-7)
        quats = [[q.GetReal(), *q.GetImaginary()] for q in prim.GetOrientationshAttr().Get(time)]
        np.testing.assert_allclose(quats, g.quats, atol=half)
        low, high = np.array(prim.GetExtentAttr().Get(time))
        sigma = np.sqrt(np.einsum("nii->ni", g.covariances()))
        np.testing.assert_allclose(low, (g.means - 3 * sigma).min(0), atol=1e-5)
        np.testing.assert_allclose(high, (g.means + 3 * sigma).max(0), atol=1e-5)
    assert prim.GetRadianceSphericalHarmonicsDegreeAttr().Get() == 1
    harmonics = prim.GetRadianceSphericalHarmonicsCoefficientshAttr()
    assert harmonics.GetMetadata("elementSize") == 4 and harmonics.GetMetadata("interpolation") == "vertex"
    first = next(frames_of(gaussians)).gaussians.means
    np.testing.assert_array_equal(np.array(prim.GetPositionsAttr().Get()), first)  # the default value


def test_points_carry_ids_and_velocities(usd):
    stage = Usd.Stage.Open(str(usd))
    points = UsdGeom.Points(stage.GetPrimAtPath("/Fluid/Points"))
    np.testing.assert_array_equal(np.array(points.GetIdsAttr().Get(1003)), np.arange(26) + 2)
    np.testing.assert_array_equal(np.array(points.GetVelocitiesAttr().Get(1003)), np.full((26, 3), 2))
    assert points.GetWidthsInterpolation() == "vertex"


def test_full_precision_is_used_where_half_would_lose_thin_splats(tmp_path, gaussians):
    g = gaussians(10)
    thin = Gaussians(g.means, g.quats, g.scales * 1e-3, g.opacities, g.sh)
    write_usd(tmp_path / "a.usda", frames=[(thin, np.arange(10), np.zeros((10, 3)))], interval=0.04)
    stage = Usd.Stage.Open(str(tmp_path / "a.usda"))
    prim = UsdVol.ParticleField3DGaussianSplat(stage.GetPrimAtPath("/Fluid/Splats"))
    np.testing.assert_array_equal(np.array(prim.GetScalesAttr().Get(1001)), thin.scales)
    assert validate_usd(tmp_path / "a.usda") == []


def test_frames_without_splats_and_without_surface_are_sound(tmp_path, gaussians, mesh):
    frames = list(frames_of(gaussians, mesh, 2))
    frames.append(FluidFrame(Gaussians.empty(4), np.zeros(0, int), np.zeros((0, 3))))
    write_usd(tmp_path / "a.usda", frames=frames, interval=0.04)
    assert validate_usd(tmp_path / "a.usda") == []
    stage = Usd.Stage.Open(str(tmp_path / "a.usda"))
    assert len(UsdGeom.Mesh(stage.GetPrimAtPath("/Fluid/Surface")).GetPointsAttr().Get(1003)) == 0


def test_a_volume_follows_the_frames(tmp_path, gaussians):
    frames = []
    for t in range(2):
        write_vdb(tmp_path / f"velocity/{1001 + t}.vdb", [VolumeGrid("density", np.ones((4, 4, 4)), 0.1)])
        frames.append(FluidFrame(gaussians(5), np.arange(5), np.zeros((5, 3)), volume=f"velocity/{1001 + t}.vdb"))
    write_usd(tmp_path / "a.usda", frames=frames, interval=0.04)
    assert validate_usd(tmp_path / "a.usda") == []
    stage = Usd.Stage.Open(str(tmp_path / "a.usda"))
    field = UsdVol.OpenVDBAsset(stage.GetPrimAtPath("/Fluid/Volume/density"))
    assert field.GetFilePathAttr().Get(1002).path == "./velocity/1002.vdb"


def test_the_usd_camera_sees_what_the_pinhole_camera_sees():
    pose = PinholeCamera.looking(np.array([3.0, -2.0, 2.0]), np.zeros(3), 50, (512, 288)).camera_from_world
    camera = PinholeCamera((400.0, 380.0), (250.0, 150.0), (512, 288), RigidTransform(pose.rotation, pose.translation))
    stage = Usd.Stage.CreateInMemory()
    prim = UsdGeom.Camera.Define(stage, "/Camera")
    write_camera(prim, camera)
    frustum = prim.GetCamera(Usd.TimeCode.Default()).frustum
    see = frustum.ComputeViewMatrix() * frustum.ComputeProjectionMatrix()
    for point in np.random.default_rng(0).normal(size=(5, 3)):
        x, y, _ = see.Transform(Gf.Vec3d(*point))
        uv, _ = camera.project(point)
        # single precision of focal length and apertures
        np.testing.assert_allclose([(x + 1) / 2 * 512, (1 - y) / 2 * 288], uv, atol=1e-3)


def test_the_switch_shows_one_representation(usd):
    stage = Usd.Stage.Open(str(usd))
    switch = stage.GetDefaultPrim().GetVariantSet("representation")
    assert switch.GetVariantSelection() == "all"
    switch.SetVariantSelection("points")
    visible = {
        n: UsdGeom.Imageable(stage.GetPrimAtPath(f"/Fluid/{n}")).ComputeVisibility() for n in ("Splats", "Points")
    }
    assert visible == {"Splats": "invisible", "Points": "inherited"}


def test_writing_again_replaces_the_file_even_while_it_is_open(usd, gaussians):
    stage = Usd.Stage.Open(str(usd))
    write_usd(usd, frames=frames_of(gaussians, count=5), interval=0.04)
    assert frame_range(usd) == (1001, 1005)
    assert len(stage.GetPrimAtPath("/Fluid/Points").GetAttribute("ids").Get(1005)) == 32


def test_samples_saved_along_the_way_are_kept(tmp_path, gaussians, monkeypatch):
    monkeypatch.setattr("fluidlift.io.export_usd._SAVE_AFTER", 1)  # after every frame
    write_usd(tmp_path / "a.usda", frames=frames_of(gaussians, count=6), interval=0.04)
    assert validate_usd(tmp_path / "a.usda") == []
    stage = Usd.Stage.Open(str(tmp_path / "a.usda"))
    prim = UsdVol.ParticleField3DGaussianSplat(stage.GetPrimAtPath("/Fluid/Splats"))
    for t, frame in enumerate(frames_of(gaussians, count=6)):
        np.testing.assert_array_equal(np.array(prim.GetPositionsAttr().Get(1001 + t)), frame.gaussians.means)


def _spoil(stage: Usd.Stage, what: str) -> None:
    prim = UsdVol.ParticleField3DGaussianSplat(stage.GetPrimAtPath("/Fluid/Splats"))
    points = UsdGeom.Points(stage.GetPrimAtPath("/Fluid/Points"))
    if what == "opacities outside":
        prim.GetOpacitieshAttr().Set([2.0] * 23, 1002)
    elif what == "scales for":
        prim.GetScaleshAttr().Set([(1, 1, 1)], 1002)
    elif what == "harmonics for":
        prim.GetRadianceSphericalHarmonicsDegreeAttr().Set(3)
    elif what == "outside the extent":
        prim.GetExtentAttr().Set([(0, 0, 0), (0, 0, 0)], 1002)
    elif what == "occur twice":
        points.GetIdsAttr().Set([7] * 23, 1002)
    elif what == "velocities for":
        points.GetVelocitiesAttr().Set([(0, 0, 0)], 1002)
    elif what == "name no point":
        UsdGeom.Mesh(stage.GetPrimAtPath("/Fluid/Terrain")).GetFaceVertexIndicesAttr().Set([0, 1, 99] * 4)
    elif what == "no default prim":
        stage.GetRootLayer().ClearDefaultPrim()
    elif what == "missing file":
        stage.GetDefaultPrim().GetReferences().AddReference("./nowhere.usda")
    elif what == "outside the folder":
        outside = stage.GetRootLayer().realPath.replace("asset.usda", "../elsewhere.usda")
        Sdf.Layer.CreateNew(outside).Save()
        stage.GetRootLayer().subLayerPaths.append("../elsewhere.usda")


@pytest.mark.parametrize(
    "what",
    [
        "opacities outside", "scales for", "harmonics for", "outside the extent", "occur twice", "velocities for",
        "name no point", "no default prim", "missing file", "outside the folder",
    ],
)  # fmt: skip
def test_faults_are_found(usd, what):
    stage = Usd.Stage.Open(str(usd))
    _spoil(stage, what)
    stage.GetRootLayer().Save()
    assert any(what in fault for fault in validate_usd(usd)), validate_usd(usd)


def test_a_broken_file_is_a_fault_not_a_crash(tmp_path):
    (tmp_path / "a.usda").write_text("#usda 1.0\ndef {")
    assert len(validate_usd(tmp_path / "a.usda")) == 1


def test_no_frames_and_wrong_lengths_are_faults_of_the_caller(tmp_path, gaussians):
    with pytest.raises(ValueError, match="no frames"):
        write_usd(tmp_path / "a.usda", frames=[], interval=0.04)
    with pytest.raises(ValueError, match="ids"):
        write_usd(tmp_path / "a.usda", frames=[(gaussians(5), np.arange(4), np.zeros((5, 3)))], interval=0.04)
    assert list(tmp_path.iterdir()) == []


def test_bodies_stand_where_they_were_at_every_frame(tmp_path, gaussians, mesh):
    turn = np.array([[1.0, 0, 0, 0], [np.sqrt(0.5), 0, 0, np.sqrt(0.5)], [0, 0, 0, 1.0]])  # 0, 90, 180 degrees about z
    positions = np.array([[0.0, 0, 0], [1, 0, 0], [2, 0, 3]])
    bodies = [MovingMesh(name, mesh, positions, turn) for name in ("raft", "7 seas", "7 seas")]
    write_usd(tmp_path / "asset.usda", frames=frames_of(gaussians), interval=0.04, bodies=bodies)
    assert validate_usd(tmp_path / "asset.usda") == []
    stage = Usd.Stage.Open(str(tmp_path / "asset.usda"))
    prims = list(stage.GetPrimAtPath("/Fluid/Bodies").GetChildren())
    assert [p.GetName() for p in prims] == ["raft", "__seas", "__seas_2"]
    for k, turned in enumerate(([1, 0, 0], [0, 1, 0], [-1, 0, 0])):
        world = UsdGeom.Xformable(prims[0]).ComputeLocalToWorldTransform(1001 + k)
        np.testing.assert_allclose(world.Transform(Gf.Vec3d(1, 0, 0)), positions[k] + turned, atol=1e-12)


def test_bodies_of_another_number_of_poses_are_faults_of_the_caller(tmp_path, gaussians, mesh):
    body = MovingMesh("raft", mesh, np.zeros((2, 3)), np.tile([1.0, 0, 0, 0], (2, 1)))
    with pytest.raises(ValueError, match="raft"):
        write_usd(tmp_path / "asset.usda", frames=frames_of(gaussians), interval=0.04, bodies=[body])


def test_the_ground_stands_still_and_carries_its_texture(tmp_path, gaussians):
    vertices = np.array([[0, 0, 0], [2, 0, 0], [2, 2, 0]], np.float32)
    uv = np.array([[[0, 1], [1, 1], [1, 0]]], np.float32)
    texture = np.full((6, 8, 3), (10, 120, 240), np.uint8)
    ground = TriangleMesh(vertices, np.array([[0, 1, 2]]), np.full((3, 3), 0.5, np.float32), uv, texture)
    count = 4
    frames = [(gaussians(5), np.arange(5), np.zeros((5, 3))) for _ in range(count)]
    files = write_usd(tmp_path / "a.usda", frames=frames, interval=0.04, terrain=ground)
    assert [f.name for f in files] == ["a.usda", "a.usdc", "a.terrain.png"]
    assert validate_usd(tmp_path / "a.usda") == []
    stage = Usd.Stage.Open(str(tmp_path / "a.usda"))
    prim = stage.GetPrimAtPath("/Fluid/Terrain")
    # the same bed in every frame of the asset: it has no samples in time, the fluid has
    assert all(a.GetNumTimeSamples() == 0 for a in prim.GetAttributes())
    assert stage.GetPrimAtPath("/Fluid/Splats").GetAttribute("positions").GetNumTimeSamples() == count
    st = UsdGeom.PrimvarsAPI(prim).GetPrimvar("st")
    assert st.GetInterpolation() == "faceVarying"
    np.testing.assert_allclose(st.Get(), [[0, 0], [1, 0], [1, 1]])  # v from below
    material = UsdShade.MaterialBindingAPI(prim).ComputeBoundMaterial()[0]
    shader = UsdShade.Shader(material.GetPrim().GetChild("Texture"))
    assert shader.GetInput("file").Get().resolvedPath.endswith("a.terrain.png")
    assert shader.GetInput("sourceColorSpace").Get() == "sRGB"
