"""A USD file shows what was put in, at every frame."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from pxr import Gf, Usd, UsdGeom, UsdShade, UsdVol
from read_usd import UsdFluid, read_camera

from fluidlift.io.export_usd import PreviewMaterial, UsdSettings, validate_usd, write_camera, write_usd
from fluidlift.io.frames import FluidFrame, MovingMesh
from fluidlift.io.validate_usd import frame_range
from fluidlift.io.volume_grid import VolumeGrid, write_vdb
from fluidlift.look.rasterize import render
from fluidlift.types import Gaussians, PinholeCamera, RigidTransform, Similarity3, TriangleMesh

INTERVAL = 1001 / 30000


def frames_of(gaussians, mesh=None, count=3, coefficients=4):
    """Particles that move at their own speed; two leave and five are born in each frame."""
    pool, rng = gaussians(20 + 5 * count, coefficients), np.random.default_rng(1)
    velocities = rng.normal(size=(len(pool), 3)).astype(np.float32)
    for t in range(count):
        ids = np.arange(2 * t, 20 + 5 * t)
        g = pool.select(ids)
        moved = replace(g, means=g.means + velocities[ids] * np.float32(t * INTERVAL))
        yield FluidFrame(moved, ids + 100, velocities[ids], mesh, None if mesh is None else np.ones((4, 3)))


@pytest.fixture
def usd(tmp_path, gaussians, mesh):
    """A file with everything in it."""
    camera = PinholeCamera.looking(np.array([3.0, -2.0, 2.0]), np.zeros(3), 50, (512, 288))
    write_usd(
        tmp_path / "asset.usda",
        frames=frames_of(gaussians, mesh),
        interval=INTERVAL,
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
        np.testing.assert_array_equal(np.array(prim.GetScalesAttr().Get(time)), g.scales)
        np.testing.assert_array_equal(np.array(prim.GetOpacitiesAttr().Get(time)), g.opacities)
        sh = np.array(prim.GetRadianceSphericalHarmonicsCoefficientsAttr().Get(time))
        np.testing.assert_array_equal(sh.reshape(g.sh.shape), g.sh)
        quats = [[q.GetReal(), *q.GetImaginary()] for q in prim.GetOrientationsAttr().Get(time)]
        np.testing.assert_array_equal(np.float32(quats), g.quats)
        low, high = np.array(prim.GetExtentAttr().Get(time))
        sigma = np.sqrt(np.einsum("nii->ni", g.covariances()))
        np.testing.assert_allclose(low, (g.means - 3 * sigma).min(0), atol=1e-5)
        np.testing.assert_allclose(high, (g.means + 3 * sigma).max(0), atol=1e-5)
    assert prim.GetRadianceSphericalHarmonicsDegreeAttr().Get() == 1
    harmonics = prim.GetRadianceSphericalHarmonicsCoefficientsAttr()
    assert harmonics.GetMetadata("elementSize") == 4 and harmonics.GetMetadata("interpolation") == "vertex"
    first = next(frames_of(gaussians)).gaussians.means
    np.testing.assert_array_equal(np.array(prim.GetPositionsAttr().Get()), first)  # the default value


def test_points_carry_ids_and_velocities(usd, gaussians):
    stage = Usd.Stage.Open(str(usd))
    points = UsdGeom.Points(stage.GetPrimAtPath("/Fluid/Points"))
    np.testing.assert_array_equal(np.array(points.GetIdsAttr().Get(1003)), np.arange(104, 130))
    written = list(frames_of(gaussians))[2]
    np.testing.assert_array_equal(np.array(points.GetVelocitiesAttr().Get(1003)), written.velocities)
    np.testing.assert_array_equal(np.array(points.GetPointsAttr().Get(1003)), written.gaussians.means)
    assert points.GetWidthsInterpolation() == "vertex"


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
    assert len(stage.GetPrimAtPath("/Fluid/Points").GetAttribute("ids").Get(1005)) == 32  # 20 + 4 (5 - 2)


def test_samples_saved_along_the_way_are_kept(tmp_path, gaussians, monkeypatch):
    monkeypatch.setattr("fluidlift.io.usd_frames._SAVE_AFTER", 1)  # after every frame
    write_usd(tmp_path / "a.usda", frames=frames_of(gaussians, count=6), interval=0.04)
    assert validate_usd(tmp_path / "a.usda") == []
    stage = Usd.Stage.Open(str(tmp_path / "a.usda"))
    prim = UsdVol.ParticleField3DGaussianSplat(stage.GetPrimAtPath("/Fluid/Splats"))
    for t, frame in enumerate(frames_of(gaussians, count=6)):
        np.testing.assert_array_equal(np.array(prim.GetPositionsAttr().Get(1001 + t)), frame.gaussians.means)


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
    frames = [(gaussians(5), np.arange(5), np.zeros((5, 3)))] * count
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


# layouts, axes and units ----------------------------------------------------------------------------------------


def settings(**changes) -> UsdSettings:
    return UsdSettings(**changes)


@pytest.mark.parametrize("layout", ["file", "clips"])
@pytest.mark.parametrize(("up_axis", "unit"), [("z", 1.0), ("y", 0.01)])
def test_splats_points_and_surface_come_back_from_each_layout_axis_and_unit(
    tmp_path, gaussians, mesh, layout, up_axis, unit
):
    camera = PinholeCamera(
        (400.0, 380.0), (250.0, 150.0), (512, 288), RigidTransform(translation=np.array([0, 0, 4.0]))
    )
    chosen = settings(layout=layout, up_axis=up_axis, meters_per_unit=unit)
    frames = list(frames_of(gaussians, mesh, coefficients=16))
    write_usd(
        tmp_path / "a.usda", frames=frames, interval=INTERVAL, terrain=mesh, camera=camera, settings=chosen,
        attributes={"gravity": (0, 0, -9.81)},
    )  # fmt: skip
    assert validate_usd(tmp_path / "a.usda") == []
    fluid = UsdFluid(tmp_path / "a.usda")
    assert fluid.codes == range(1001, 1004) and fluid.interval == pytest.approx(INTERVAL)
    exact = up_axis == "z"  # nothing is computed: the same bits
    for code in (1001, 1003):
        back, given = fluid.frame(code), frames[code - 1001]
        np.testing.assert_array_equal(back.ids, given.ids)
        for name in ("means", "scales", "opacities", "sh"):
            got, put = getattr(back.gaussians, name), getattr(given.gaussians, name)
            # single precision, of a few rotations and multiplications there and back
            np.testing.assert_allclose(got, put, rtol=0 if exact else 1e-5, atol=0 if exact else 2e-6)
        np.testing.assert_allclose(back.gaussians.covariances(), given.gaussians.covariances(), rtol=1e-4, atol=1e-8)
        np.testing.assert_allclose(back.velocities, given.velocities, atol=1e-5)
        np.testing.assert_allclose(back.surface.vertices, mesh.vertices, atol=1e-5)
        np.testing.assert_allclose(back.surface.colors, mesh.colors, atol=1e-6)
        np.testing.assert_allclose(back.surface_velocities, np.ones((4, 3)), atol=1e-6)
    seen = fluid.camera(camera.size)
    np.testing.assert_allclose(
        [*seen.focal, *seen.center], [*camera.focal, *camera.center], rtol=1e-6
    )  # attributes of a camera are single precision
    np.testing.assert_allclose(seen.position, camera.position, atol=1e-9)
    stage = Usd.Stage.Open(str(tmp_path / "a.usda"))
    root = stage.GetDefaultPrim()
    assert root.GetAttribute("fluid:gravity").Get() == (Gf.Vec3d(0, 0, -9.81) if exact else Gf.Vec3d(0, -9.81, 0))


def test_the_default_axes_and_units_of_readers_are_said_even_so(tmp_path, gaussians):
    chosen = settings(layout="clips", up_axis="y", meters_per_unit=0.01, start_frame=7)
    files = write_usd(tmp_path / "a.usda", frames=frames_of(gaussians), interval=INTERVAL, settings=chosen)
    # every layer that a person can open on its own
    for file in (f for f in files if f.suffix in (".usda", ".usdc") and "manifest" not in f.name):
        stage = Usd.Stage.Open(str(file))
        assert UsdGeom.GetStageUpAxis(stage) == "Y" and UsdGeom.GetStageMetersPerUnit(stage) == 0.01
        assert stage.GetDefaultPrim().GetPath() == "/Fluid"
        assert stage.GetTimeCodesPerSecond() == pytest.approx(30000 / 1001, rel=1e-12)
    assert frame_range(tmp_path / "a.usda") == (7, 9)


def test_the_picture_of_a_y_up_file_through_its_own_camera_is_the_picture_of_the_world(tmp_path, gaussians):
    """Axes as they stand in the file: what a renderer that ignores upAxis draws."""
    frames = list(frames_of(gaussians, coefficients=16, count=1))
    camera = PinholeCamera.looking(np.array([3.0, -4.0, 2.0]), np.zeros(3), 50, (96, 64))
    write_usd(
        tmp_path / "a.usda", frames=frames, interval=0.04, camera=camera, settings=settings(up_axis="y", layout="clips")
    )
    stage = Usd.Stage.Open(str(tmp_path / "a.usda"))
    s = UsdVol.ParticleField3DGaussianSplat(stage.GetPrimAtPath("/Fluid/Splats"))
    quats = np.array([[q.GetReal(), *q.GetImaginary()] for q in s.GetOrientationsAttr().Get(1001)])
    means = np.array(s.GetPositionsAttr().Get(1001))
    sh = np.array(s.GetRadianceSphericalHarmonicsCoefficientsAttr().Get(1001)).reshape(len(means), 16, 3)
    turned = Gaussians(
        means, quats, np.array(s.GetScalesAttr().Get(1001)), np.array(s.GetOpacitiesAttr().Get(1001)), sh
    )
    own = read_camera(UsdGeom.Camera(stage.GetPrimAtPath("/Fluid/Camera")), (96, 64), Similarity3())
    before, after = render(frames[0].gaussians, camera).image, render(turned, own).image
    assert before.max() > 0.3 and np.abs(own.position - camera.position).max() > 1
    # single precision; a splat at the edge of what is still drawn (1/255) may come or go
    np.testing.assert_allclose(after, before, atol=5e-3)
    assert np.abs(after - before).mean() < 1e-5
    flat = replace(turned, sh=frames[0].gaussians.sh)  # harmonics that were not turned
    assert np.abs(render(flat, own).image - before).mean() > 1e-4


def test_clips_hold_one_frame_each_and_old_ones_are_removed(tmp_path, gaussians, mesh):
    write_usd(
        tmp_path / "a.usda", frames=frames_of(gaussians, count=5), interval=INTERVAL, settings=settings(layout="clips")
    )
    write_usd(tmp_path / "a.usda", frames=frames_of(gaussians), interval=INTERVAL, settings=settings(layout="clips"))
    names = sorted(p.name for p in (tmp_path / "frames").iterdir())
    assert names == ["a.1001.usdc", "a.1002.usdc", "a.1003.usdc", "a.manifest.usda"]
    clip = Usd.Stage.Open(str(tmp_path / "frames" / "a.1002.usdc"))
    assert clip.GetPrimAtPath("/Fluid/Points").GetAttribute("points").GetTimeSamples() == [1002.0]
    assert frame_range(tmp_path / "a.usda") == (1001, 1003)
    assert validate_usd(tmp_path / "a.usda") == []


@pytest.mark.parametrize("layout", ["file", "clips"])
def test_a_surface_that_comes_late_and_goes_early_is_there_only_then(tmp_path, gaussians, mesh, layout):
    frames = list(frames_of(gaussians, mesh, count=4))
    for k in (0, 1, 3):
        frames[k] = frames[k]._replace(surface=None, surface_velocities=None)
    write_usd(tmp_path / "a.usda", frames=frames, interval=INTERVAL, settings=settings(layout=layout))
    assert validate_usd(tmp_path / "a.usda") == []
    stage = Usd.Stage.Open(str(tmp_path / "a.usda"))
    points = UsdGeom.Mesh(stage.GetPrimAtPath("/Fluid/Surface")).GetPointsAttr()
    assert [len(points.Get(1001 + k)) for k in range(4)] == [0, 0, 4, 0]
    assert len(points.Get()) == 4  # without time: something to see


def test_the_default_values_are_the_first_frame_that_holds_anything(tmp_path, gaussians):
    empty = FluidFrame(Gaussians.empty(4), np.zeros(0, int), np.zeros((0, 3)))
    for layout in ("file", "clips"):
        write_usd(
            tmp_path / "a.usda",
            frames=[empty, *frames_of(gaussians)],
            interval=INTERVAL,
            settings=settings(layout=layout),
        )
        stage = Usd.Stage.Open(str(tmp_path / "a.usda"))
        assert len(stage.GetPrimAtPath("/Fluid/Splats").GetAttribute("positions").Get()) == 20
        assert len(stage.GetPrimAtPath("/Fluid/Points").GetAttribute("points").Get(1001)) == 0


def test_particles_keep_their_place_in_the_arrays_while_none_is_born_or_leaves(tmp_path, gaussians):
    frames = [next(frames_of(gaussians)) for _ in range(2)]
    order = np.random.default_rng(0).permutation(20)
    shuffled = frames[1]._replace(
        gaussians=frames[1].gaussians.select(order), ids=frames[1].ids[order], velocities=frames[1].velocities[order]
    )
    write_usd(tmp_path / "a.usda", frames=[frames[0], shuffled], interval=INTERVAL)
    stage = Usd.Stage.Open(str(tmp_path / "a.usda"))
    between = np.array(stage.GetPrimAtPath("/Fluid/Points").GetAttribute("points").Get(1001.5))
    np.testing.assert_allclose(between, frames[0].gaussians.means, atol=1e-6)  # interpolated, not mixed up


def test_half_precision_is_three_fifths_of_the_size_and_sound(tmp_path, gaussians):
    frames = [FluidFrame(gaussians(3000, 16), np.arange(3000), np.zeros((3000, 3)))]
    sizes = []
    for half in (False, True):
        write_usd(tmp_path / "a.usda", frames=frames, interval=0.04, settings=settings(half=half))
        assert validate_usd(tmp_path / "a.usda") == []
        sizes.append((tmp_path / "a.usdc").stat().st_size)
        back = UsdFluid(tmp_path / "a.usda").frame(1001).gaussians
        rounding = 2.0**-11 if half else 0.0  # relative, of half precision
        np.testing.assert_allclose(back.sh, frames[0].gaussians.sh, rtol=rounding, atol=1e-7 if half else 0)
        np.testing.assert_array_equal(back.scales, frames[0].gaussians.scales)  # small ones would be lost
    assert sizes[1] < 0.65 * sizes[0]


# materials, volumes, metadata -----------------------------------------------------------------------------------


def shader_of(stage, path):
    material = UsdShade.MaterialBindingAPI(stage.GetPrimAtPath(path)).ComputeBoundMaterial()[0]
    return UsdShade.Shader(material.GetPrim().GetChild("Surface"))


def test_the_surface_shows_the_colours_of_the_clip_or_a_material(tmp_path, gaussians, mesh):
    write_usd(tmp_path / "a.usda", frames=frames_of(gaussians, mesh), interval=INTERVAL, terrain=mesh)
    stage = Usd.Stage.Open(str(tmp_path / "a.usda"))
    source, _, _ = shader_of(stage, "/Fluid/Surface").GetInput("diffuseColor").GetConnectedSource()
    assert UsdShade.Shader(source.GetPrim()).GetInput("varname").Get() == "displayColor"
    honey = PreviewMaterial.of_depth(
        "honey", 0.02, absorption=(9.0, 48.0, 240.0), scattering=6.0, albedo=(0.8, 0.42, 0.06), emission=(0, 0, 0),
        refractive_index=1.49, roughness=0.04,
    )  # fmt: skip
    write_usd(
        tmp_path / "b.usda", frames=frames_of(gaussians, mesh), interval=INTERVAL, settings=settings(material=honey)
    )
    assert validate_usd(tmp_path / "b.usda") == []
    stage = Usd.Stage.Open(str(tmp_path / "b.usda"))
    shader = shader_of(stage, "/Fluid/Surface")
    red, green, blue = shader.GetInput("diffuseColor").Get()
    assert red > green > blue and shader.GetInput("ior").Get() == pytest.approx(1.49)
    # Beer and Lambert: two centimetres let a third of the light through
    through = np.exp(-6.0 * 0.02) * np.exp(-np.array([9.0, 48.0, 240.0]) * 0.02).mean()
    assert shader.GetInput("opacity").Get() == pytest.approx(1 - through, rel=1e-6)


def test_lava_glows(tmp_path, gaussians, mesh):
    lava = PreviewMaterial("lava", (0.03, 0.03, 0.03), 1.58, 0.45, 1.0, (4.5, 0.6, 0.006))
    write_usd(
        tmp_path / "b.usda", frames=frames_of(gaussians, mesh), interval=INTERVAL, settings=settings(material=lava)
    )
    stage = Usd.Stage.Open(str(tmp_path / "b.usda"))
    shader = shader_of(stage, "/Fluid/Surface")
    np.testing.assert_allclose(shader.GetInput("emissiveColor").Get(), (4.5, 0.6, 0.006), rtol=1e-6)


def test_a_volume_in_a_y_up_file_stands_where_its_particles_do(tmp_path, gaussians):
    write_vdb(tmp_path / "1001.vdb", [VolumeGrid("density", np.ones((4, 4, 4)), 0.1)])
    frame = FluidFrame(gaussians(5), np.arange(5), np.zeros((5, 3)), volume="1001.vdb")
    chosen = settings(up_axis="y", meters_per_unit=0.01, volume_fields=("density",))
    write_usd(tmp_path / "a.usda", frames=[frame], interval=0.04, settings=chosen)
    assert validate_usd(tmp_path / "a.usda") == []
    stage = Usd.Stage.Open(str(tmp_path / "a.usda"))
    world = UsdGeom.Xformable(stage.GetPrimAtPath("/Fluid/Volume")).ComputeLocalToWorldTransform(1001)
    point = [float(v) for v in frame.gaussians.means[0]]  # of the OpenVDB file: z up, metres
    at = np.array(stage.GetPrimAtPath("/Fluid/Points").GetAttribute("points").Get(1001)[0])
    np.testing.assert_allclose(np.array(world.Transform(Gf.Vec3d(*point))), at, rtol=1e-5, atol=1e-4)
    assert not stage.GetPrimAtPath("/Fluid/Volume/vel")


def test_the_asset_says_its_name_and_kind(usd):
    stage = Usd.Stage.Open(str(usd))
    root = Usd.ModelAPI(stage.GetDefaultPrim())
    assert root.GetKind() == "component" and root.GetAssetName() == "asset"


def test_surfaces_are_smooth(tmp_path, gaussians):
    import trimesh

    ball = trimesh.creation.icosphere(subdivisions=3)
    surface = TriangleMesh(np.asarray(ball.vertices, np.float32), np.asarray(ball.faces))
    frame = next(frames_of(gaussians))._replace(surface=surface, surface_velocities=np.zeros((len(ball.vertices), 3)))
    write_usd(tmp_path / "a.usda", frames=[frame], interval=0.04)
    stage = Usd.Stage.Open(str(tmp_path / "a.usda"))
    mesh = UsdGeom.Mesh(stage.GetPrimAtPath("/Fluid/Surface"))
    assert mesh.GetNormalsInterpolation() == "vertex"
    np.testing.assert_allclose(mesh.GetNormalsAttr().Get(1001), ball.vertices, atol=0.02)  # facets of 9 degrees


@pytest.mark.parametrize(
    "wrong", [{"up_axis": "x"}, {"layout": "folder"}, {"meters_per_unit": 0.0}, {"meters_per_unit": float("nan")}]
)
def test_settings_that_mean_nothing_are_faults_of_the_caller(wrong):
    with pytest.raises(ValueError, match=str(next(iter(wrong.values())))):
        settings(**wrong)
