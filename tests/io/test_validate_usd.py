"""Faults of a USD file are found, whichever frame they are in; sound files have none, by anyone's rules."""

from __future__ import annotations

import sys
from dataclasses import replace

import numpy as np
import pytest
from pxr import Gf, Sdf, Usd, UsdGeom, UsdVol, Vt

from fluidlift.errors import MissingPackage
from fluidlift.io.export_usd import UsdSettings, write_usd
from fluidlift.io.frame_checks import ParticleFrame, gaussian_faults, identity_faults, particle_faults
from fluidlift.io.frames import FluidFrame, MovingMesh
from fluidlift.io.validate_usd import splat_rule_faults, validate_usd
from fluidlift.io.volume_grid import VolumeGrid, write_vdb
from fluidlift.types import PinholeCamera

INTERVAL = 0.04
BAD = 1002
"""the frame that is spoilt: not the first, not the last"""


def frames_of(gaussians, mesh, count=3):
    """Twenty particles that move at their own speed, and a surface."""
    pool = gaussians(20)
    velocities = np.random.default_rng(1).normal(size=(20, 3)).astype(np.float32)
    for t in range(count):
        moved = replace(pool, means=pool.means + velocities * np.float32(t * INTERVAL))
        yield FluidFrame(moved, np.arange(20), velocities, mesh, np.ones((4, 3)))


@pytest.fixture(params=["file", "clips"])
def usd(request, tmp_path, gaussians, mesh):
    """A file with everything in it, in each layout."""
    folder = tmp_path / "out"
    frames = []
    for k, frame in enumerate(frames_of(gaussians, mesh)):
        name = f"volumes/{1001 + k}.vdb"
        write_vdb(folder / name, [VolumeGrid("density", np.ones((4, 4, 4)), 0.1)])
        frames.append(frame._replace(volume=name))
    turn = np.tile([1.0, 0, 0, 0], (3, 1))
    write_usd(
        folder / "fluid.usda", frames=frames, interval=INTERVAL, terrain=mesh,
        camera=PinholeCamera.looking(np.array([3.0, -2.0, 2.0]), np.zeros(3), 50, (512, 288)),
        bodies=[MovingMesh("raft", mesh, np.zeros((3, 3)), turn)],
        settings=UsdSettings(layout=request.param, volume_fields=("density",)),
    )  # fmt: skip
    return folder / "fluid.usda"


def test_a_sound_file_has_no_faults_by_anyones_rules(usd):
    assert validate_usd(usd) == []
    assert splat_rule_faults(usd) == []


def test_nothing_is_printed_about_the_template_of_the_clips(usd, capfd):
    validate_usd(usd)
    splat_rule_faults(usd)
    assert capfd.readouterr().err == ""


def holder(path, time=BAD) -> Usd.Stage:
    """The stage of the layer that holds the samples of a frame."""
    clip = path.parent / "frames" / f"{path.stem}.{time}.usdc"
    return Usd.Stage.Open(str(clip if clip.is_file() else path.with_suffix(".usdc")))


def spoil_arrays(stage: Usd.Stage, what: str) -> None:
    s = UsdVol.ParticleField3DGaussianSplat(stage.GetPrimAtPath("/Fluid/Splats"))
    points = UsdGeom.Points(stage.GetPrimAtPath("/Fluid/Points"))
    surface = UsdGeom.Mesh(stage.GetPrimAtPath("/Fluid/Surface"))
    ids = np.array(points.GetIdsAttr().Get(BAD))
    nan = Vt.Vec3fArray([Gf.Vec3f(float("nan"))] * 20)
    changes = {
        "opacities outside 0 to 1": lambda: s.GetOpacitiesAttr().Set([2.0] * 20, BAD),
        "1 scales for 20 splats": lambda: s.GetScalesAttr().Set([(1, 1, 1)], BAD),
        "scales of 0 or less": lambda: s.GetScalesAttr().Set([(1, 0, 1)] * 20, BAD),
        "no unit": lambda: s.GetOrientationsAttr().Set([Gf.Quatf(0.9, 0, 0, 0)] * 20, BAD),
        "splats, not 80": lambda: s.GetRadianceSphericalHarmonicsCoefficientsAttr().Set([(0, 0, 0)] * 20, BAD),
        "positions outside the extent": lambda: s.GetExtentAttr().Set([(0, 0, 0), (0, 0, 0)], BAD),
        "positions that are not finite": lambda: s.GetPositionsAttr().Set(nan, BAD),
        "ids that occur twice": lambda: points.GetIdsAttr().Set([7] * 20, BAD),
        "ids that jump": lambda: points.GetIdsAttr().Set([int(i) for i in np.roll(ids, 7)], BAD),
        "as if all particles were new": lambda: points.GetIdsAttr().Set([int(i) + 100 for i in ids], BAD),
        "1 velocities for 20 points": lambda: points.GetVelocitiesAttr().Set([(0, 0, 0)], BAD),
        "velocities that are not finite": lambda: points.GetVelocitiesAttr().Set(nan, BAD),
        "widths of 0 or less": lambda: points.GetWidthsAttr().Set([-1.0] * 20, BAD),
        "indices that name no point": lambda: surface.GetFaceVertexIndicesAttr().Set([0, 1, 99] * 4, BAD),
        "face counts": lambda: surface.GetFaceVertexCountsAttr().Set([3, 3], BAD),
        "2 velocities for 4 points": lambda: surface.GetVelocitiesAttr().Set([(0, 0, 0)] * 2, BAD),
        "3 normals for 4 points": lambda: surface.GetNormalsAttr().Set([(0, 0, 1)] * 3, BAD),
    }
    changes[what]()


@pytest.mark.parametrize(
    "what",
    [
        "opacities outside 0 to 1", "1 scales for 20 splats", "scales of 0 or less", "no unit", "splats, not 80",
        "positions outside the extent", "positions that are not finite", "ids that occur twice", "ids that jump",
        "as if all particles were new", "1 velocities for 20 points", "velocities that are not finite",
        "widths of 0 or less", "indices that name no point", "face counts", "2 velocities for 4 points",
        "3 normals for 4 points",
    ],
)  # fmt: skip
def test_faults_of_a_single_frame_are_found_and_the_frame_is_named(usd, what):
    stage = holder(usd)
    spoil_arrays(stage, what)
    stage.GetRootLayer().Save()
    words = "not unit quaternions" if what == "no unit" else what
    found = [fault for fault in validate_usd(usd) if words in fault]
    assert found and all("1002" in fault or "1003" in fault for fault in found), validate_usd(usd)


def spoil_stage(path, what: str) -> None:
    stage = Usd.Stage.Open(str(path))
    layer = stage.GetRootLayer()
    if what == "no default prim":
        layer.ClearDefaultPrim()
    elif what == "no metersPerUnit":
        stage.ClearMetadata("metersPerUnit")
    elif what == "no upAxis":
        stage.ClearMetadata("upAxis")
    elif what == "no startTimeCode":
        stage.ClearMetadata("startTimeCode")
        stage.ClearMetadata("endTimeCode")
    elif what == "endTimeCode before":
        stage.SetEndTimeCode(3)
    elif what == "no samples at 2 of 5 frames":
        stage.SetEndTimeCode(1005)
    elif what == "missing file":
        stage.GetDefaultPrim().GetReferences().AddReference("./nowhere.usda")
    elif what == "outside the folder":
        Sdf.Layer.CreateNew(str(path.parent.parent / "elsewhere.usda")).Save()
        layer.subLayerPaths.append("../elsewhere.usda")
    elif what == "mirrors or flattens":
        UsdGeom.Xformable(stage.GetPrimAtPath("/Fluid/Points")).AddScaleOp().Set(Gf.Vec3f(-1, 1, 1))
    elif what == "focal length":
        stage.GetPrimAtPath("/Fluid/Camera").GetAttribute("focalLength").Set(0.0)
    elif what == "element size":
        name = "radiance:sphericalHarmonicsCoefficients"
        stage.GetPrimAtPath("/Fluid/Splats").GetAttribute(name).SetMetadata("elementSize", 1)
    layer.Save()


@pytest.mark.parametrize(
    "what",
    [
        "no default prim", "no metersPerUnit", "no upAxis", "no startTimeCode", "endTimeCode before",
        "no samples at 2 of 5 frames", "missing file", "outside the folder", "mirrors or flattens", "focal length",
        "element size",
    ],
)  # fmt: skip
def test_faults_of_the_stage_are_found(usd, what):
    spoil_stage(usd, what)
    assert any(what in fault for fault in validate_usd(usd)), validate_usd(usd)


def test_missing_volumes_and_clips_are_named(usd):
    (usd.parent / "volumes" / "1002.vdb").unlink()
    assert any("missing file" in f and "1002.vdb" in f for f in validate_usd(usd)), validate_usd(usd)
    if (usd.parent / "frames").is_dir():
        (usd.parent / "frames" / "fluid.1003.usdc").unlink()
        assert any("missing clip" in f and "fluid.1003.usdc" in f for f in validate_usd(usd))


def test_nvidias_rule_can_fail_as_well(usd):
    """It looks at the default values; half-precision attributes it does not know."""
    stage = Usd.Stage.Open(str(usd))
    stage.GetPrimAtPath("/Fluid/Splats").GetAttribute("opacities").Set([2.0] * 20)
    stage.GetRootLayer().Save()
    (fault,) = splat_rule_faults(usd)
    assert "2.0" in fault


def test_half_precision_is_what_nvidias_rule_does_not_know(tmp_path, gaussians, mesh):
    frames = frames_of(gaussians, mesh)
    write_usd(tmp_path / "a.usda", frames=frames, interval=INTERVAL, settings=UsdSettings(half=True))
    assert validate_usd(tmp_path / "a.usda") == []
    assert any("orientations" in fault for fault in splat_rule_faults(tmp_path / "a.usda"))


def test_a_missing_validator_says_what_to_install(usd, monkeypatch):
    monkeypatch.setitem(sys.modules, "usd_validation_nvidia", None)
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with pytest.raises(MissingPackage, match="pip install usd-validation-nvidia"):
        splat_rule_faults(usd)


def test_a_broken_file_is_a_fault_not_a_crash(tmp_path):
    (tmp_path / "a.usda").write_text("#usda 1.0\ndef {")
    assert len(validate_usd(tmp_path / "a.usda")) == 1


# frames in memory -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("what", ["startTimeCode", "endTimeCode", "timeCodesPerSecond"])
def test_a_dictionary_in_place_of_a_number_is_a_fault_not_a_crash(tmp_path, what):
    (tmp_path / "a.usda").write_text(f"#usda 1.0\n(\n    {what} = {{\n        int a = 1\n    }}\n)\n")
    assert validate_usd(tmp_path / "a.usda") != []


def particles(gaussians, **changes) -> ParticleFrame:
    positions = gaussians(200).means
    return ParticleFrame(np.arange(200), positions, np.zeros_like(positions))._replace(**changes)


def test_a_fast_particle_does_not_jump_but_one_that_changes_places_does(gaussians):
    before = particles(gaussians)
    fast = np.full((200, 3), 100.0)  # m/s: 7 m in a frame, several times the body's size
    later = before._replace(positions=before.positions + fast * INTERVAL, velocities=fast)
    assert identity_faults(before, later, INTERVAL) == []
    mixed = before._replace(ids=np.roll(before.ids, 3))
    assert "jump" in identity_faults(before, mixed, INTERVAL)[0]
    assert identity_faults(before, before._replace(ids=before.ids + 150), INTERVAL) != []
    assert identity_faults(before, particles(gaussians, ids=np.arange(0)), INTERVAL) == []


def test_particles_that_are_not_finite_or_not_unique_are_counted(gaussians):
    broken = particles(gaussians, velocities=np.full((200, 3), np.nan))
    assert particle_faults(broken) == ["200 velocities that are not finite"]
    assert particle_faults(particles(gaussians, ids=np.arange(200) // 2)) == ["100 ids that occur twice"]


def test_covariances_that_single_precision_cannot_tell_from_flat_are_found(gaussians):
    g = gaussians(10)
    assert gaussian_faults(g) == []
    scales = g.scales.copy()
    scales[3] = (1.0, 1.0, 1e-5)
    scales[4] = (1e-3, 0.0, 1e-3)
    assert gaussian_faults(replace(g, scales=scales)) == ["2 covariances that are not positive definite"]
    values = np.linalg.eigvalsh(replace(g, scales=scales).covariances())
    assert (values[:, 0] <= 0).sum() >= 1 and (values[[0, 1, 2, 5], 0] > 0).all()  # as a decomposition would say
    assert "opacities" in gaussian_faults(replace(g, opacities=g.opacities + 1))[0]
