"""The figures: by hand on small arrays, perfect for the truth itself, blind to the scale that one view cannot see."""

import json
import os
import struct
import zipfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from fluidlift.errors import InputRejected
from fluidlift.evaluate import Case, arrays_of_run, evaluate_arrays, evaluate_asset, read_case
from fluidlift.evaluate.images import (
    depth_error,
    depth_scale,
    end_point_error,
    end_point_percentile,
    mask_iou,
    mean_cosine,
    psnr,
    resample_nearest,
    ssim,
)
from fluidlift.evaluate.volumes import (
    align_cameras,
    field_cosine,
    level_set_points,
    occupancy_iou,
    relative_divergence,
    relative_l2,
    sample_cells,
)
from fluidlift.io.asset_folder import save_asset
from fluidlift.types import (
    CellType,
    Estimate,
    FaceVelocity,
    FluidAsset,
    FluidParameters,
    Gaussians,
    Grid,
    PinholeCamera,
    RigidTransform,
    Similarity3,
    Terrain,
    TriangleMesh,
)

GRID = Grid((16, 12, 8), 0.05, (-0.4, -0.3, 0.0))
TOP = 0.2
VELOCITY = np.array([0.5, 0.0, 0.0])
INTERVAL = 0.04
SIZE = (48, 32)
FRAMES = 3


def a_camera() -> PinholeCamera:
    return PinholeCamera.looking((0.1, -0.7, 0.8), (0.0, 0.0, 0.1), 50.0, SIZE)


def a_case() -> Case:
    """A flat pool 0.2 m deep that slides along x as one block; the camera sees its top alone."""
    camera = a_camera()
    uv = camera.pixel_grid()
    rays = camera.rays(uv)
    depth = (TOP - camera.position[2]) / rays[..., 2]
    points = camera.unproject(uv, depth)
    mask = ((points >= GRID.low) & (points < GRID.high)).all(-1)
    there, z = camera.project(points + VELOCITY * INTERVAL)
    flow = np.where(mask[..., None], there - uv, 0)
    stacked = [np.broadcast_to(x, (FRAMES, *x.shape)).copy() for x in (flow, depth * mask, (z - depth) * mask, mask)]
    phi = (GRID.centers()[..., 2] - TOP) / GRID.spacing
    return Case(
        "pool", Path("video.mp4"), camera, INTERVAL, *stacked, None, np.zeros(SIZE[::-1]), GRID, np.array([0, 2]),
        np.broadcast_to(VELOCITY, (2, *GRID.shape, 3)), np.stack([phi, phi]), None,
        {"gravity": [0, 0, -9.81], "viscosity_m2_s": 0.002}, {},
    )  # fmt: skip


def an_asset(camera: PinholeCamera | None = None, world: Similarity3 | None = None) -> FluidAsset:
    """The truth of `a_case` as an asset, in another world if given (asset_from_truth)."""
    world = world or Similarity3()
    s = world.scale
    grid = Grid(GRID.shape, GRID.spacing * s, tuple(world.points(GRID.low)))
    types = np.where(GRID.centers()[..., 2] < TOP, CellType.FLUID, CellType.EMPTY).astype(np.uint8)
    types[:2][types[:2] == CellType.FLUID] = CellType.INFLOW
    types[-1] = CellType.OUTFLOW
    velocity = FaceVelocity(*(np.full(grid.face_shape(a), s * VELOCITY[a]) for a in range(3)))
    mesh = TriangleMesh(np.zeros((0, 3), np.float32), np.zeros((0, 3), np.int64))
    distance = grid.nodes()[..., 2] - grid.origin[2] + 0.5 * grid.spacing
    parameters = FluidParameters(
        kinematic_viscosity=0.002 * s * s, gravity=(0, 0, -9.81 * s), inflow_velocity=tuple(s * VELOCITY)
    )
    sigma = {"kinematic_viscosity": Estimate(0.002 * s * s, 1e-4 * s * s, True, 1e-6)}
    return FluidAsset(
        "stream", Gaussians.empty(), Terrain(grid, distance, np.array([1.0, 0, 0]), mesh), grid, types, velocity,
        parameters, sigma, camera or a_camera(), Similarity3(), INTERVAL, FRAMES,
    )  # fmt: skip


def a_run(case: Case, depth_scale: float = 1.0) -> dict[str, np.ndarray]:
    """Arrays of a run that found out everything."""
    rng = np.random.default_rng(0)
    return {
        "labels": case.mask.astype(np.uint8),
        "front_depth": (case.depth[0] * depth_scale).astype(np.float32),
        "flow_raw": case.flow[:-1],
        "flow_completed": case.flow[:-1],
        "flow_observed": np.arange(SIZE[0])[None, None, :] % 2 * np.ones((FRAMES - 1, SIZE[1], 1), np.uint8),
        "resim_flow": case.flow[:-1],
        "resim_mask": case.mask,
        "resim_frames": rng.integers(0, 255, (FRAMES, SIZE[1], SIZE[0], 3), dtype=np.uint8),
        "first_frame": np.int64(0),
        "fit_frames": np.array([0, 2]),
        "particle_volume": np.full(FRAMES, 0.3, np.float32),
        "leak_share": np.zeros(FRAMES, np.float32),
    }


PERFECT = {
    "segmentation.iou": 1, "flow.raw.epe": 0, "flow.completed.epe": 0, "flow.resimulated.epe": 0,
    "flow.raw.epe_p90": 0, "flow.completed.epe_observed": 0, "flow.completed.epe_filled": 0,
    "surface.velocity.error": 0, "surface.velocity.relative_error": 0, "surface.velocity.share_found": 1,
    "flow.raw.cosine": 1, "flow.raw.share": 1, "geometry.depth_error": 0, "geometry.occupancy_iou": 1,
    "volume.overlap": 1, "volume.relative_l2": 0, "volume.cosine": 1, "divergence.max": 0,
    "parameters.gravity.relative_error": 0, "parameters.gravity.angle": 0, "parameters.viscosity.relative_error": 0,
    "parameters.viscosity.within_2_sigma": 1, "parameters.inflow.relative_error": 0,
    "resimulation.mask_iou.fitted": 1, "resimulation.mask_iou.predicted": 1, "resimulation.psnr.fitted": 99,
    "resimulation.ssim.predicted": 1, "resimulation.volume_drift": 0, "resimulation.leak_share": 0,
    "cost.seconds": 3, "cost.peak_memory": 2,
}  # fmt: skip
MANIFEST = {"timings": {"flow": 1.0, "fit": 2.0}, "metrics": {"peak_memory_mb": 2.0}}


def check_perfect(sheet) -> None:
    for key, value in PERFECT.items():
        got = sheet[key]
        # 1e-5: single-precision depths; gravity's angle (an arccos near 1) keeps half the digits
        assert got == pytest.approx(value, abs=1e-3 if key.endswith("angle") else 1e-5), key


def test_the_truth_itself_scores_perfectly():
    case = a_case()
    run = a_run(case)
    sheet = evaluate_arrays(an_asset(), run, MANIFEST, case, video=run["resim_frames"])
    check_perfect(sheet)
    # the outlet cells are no fluid of the asset: its end face lies one of 16 cells before the truth's
    assert sheet["geometry.chamfer_cells"] < 0.2


@pytest.mark.parametrize("scale", [0.1, 3.0])
def test_a_scene_known_up_to_scale_scores_as_well_in_any_other_metre(scale):
    case = a_case()
    asset_from_truth = Similarity3(scale, np.eye(3), np.array([5.0, -2.0, 1.0]))
    pose = case.camera.camera_from_world
    # x_cam(asset) = scale * x_cam(truth)
    moved = RigidTransform(pose.rotation, scale * pose.translation - pose.rotation @ asset_from_truth.translation)
    camera = replace(case.camera, camera_from_world=moved)
    run = a_run(case, scale)
    sheet = evaluate_arrays(an_asset(camera, asset_from_truth), run, MANIFEST, case, video=run["resim_frames"])
    assert sheet["geometry.scale"] == pytest.approx(1 / scale, rel=1e-5)
    check_perfect(sheet)


def test_alignment_lays_camera_axes_on_camera_axes():
    truth = a_camera()
    other = PinholeCamera.looking((2.0, 1.0, 3.0), (0.0, 0.5, 0.0), 70.0, SIZE)
    t = align_cameras(truth, other, 2.5)
    points = np.random.default_rng(1).normal(size=(20, 3))
    np.testing.assert_allclose(
        truth.camera_from_world.points(t.points(points)), 2.5 * other.camera_from_world.points(points), atol=1e-12
    )


def test_a_run_without_arrays_gives_reasons_instead_of_figures():
    sheet = evaluate_arrays(an_asset(), {}, {}, a_case())
    assert sheet["flow.raw.epe"] is None and sheet["volume.cosine"] is None and sheet["cost.seconds"] is None
    assert sheet["divergence.max"] == 0  # needs the asset alone
    missing = [f for f in sheet.figures if f.value is None]
    assert missing and all(f.note for f in missing)
    assert any("flow_raw" in f.note for f in missing)
    assert ("flow.raw.epe", "-") in [row[:2] for row in sheet.table()]
    assert json.loads(sheet.to_json())["figures"]["flow.raw.epe"]["value"] is None


def test_errors_of_a_known_size_are_reported_as_such():
    case = a_case()
    run = a_run(case)
    run["flow_raw"] = case.flow[:-1] + np.array([3.0, 4.0])  # 5 px off
    run["labels"] = np.zeros_like(run["labels"])
    run["resim_flow"] = 0.5 * case.flow[:-1]
    run["particle_volume"] = np.array([1.0, 1.2, 0.9])
    run["leak_share"] = np.array([0.0, 0.02, 0.01])
    observed = run["flow_observed"].astype(bool)
    run["flow_completed"] = case.flow[:-1] + np.where(observed[..., None], [0.0, 0.0], [0.0, 2.0])  # filled: 2 px off
    asset = an_asset()
    halved = replace(asset, velocity=FaceVelocity(*(0.5 * c for c in asset.velocity.components)))
    heavier = replace(halved, parameters=replace(asset.parameters, kinematic_viscosity=0.003, gravity=(0, 0, -4.905)))
    sheet = evaluate_arrays(heavier, run, {}, case)
    assert sheet["segmentation.iou"] == 0
    assert sheet["flow.raw.epe"] is None and sheet["flow.raw.share"] == 0  # nothing was called fluid
    del run["labels"]
    sheet = evaluate_arrays(heavier, run, {}, case)
    assert sheet["flow.raw.epe"] == pytest.approx(5.0, abs=1e-6)
    assert sheet["flow.raw.epe_p90"] == pytest.approx(5.0, abs=1e-6)
    assert sheet["flow.completed.epe_observed"] == pytest.approx(0.0, abs=1e-6)
    assert sheet["flow.completed.epe_filled"] == pytest.approx(2.0, abs=1e-6)
    assert sheet["flow.completed.filled_share"] == pytest.approx(0.5, abs=0.1)  # every other column of the mask
    speed = np.linalg.norm(case.flow[case.mask], axis=-1).mean()
    assert sheet["flow.resimulated.epe"] == pytest.approx(0.5 * speed, rel=1e-5)
    assert sheet["flow.resimulated.cosine"] == pytest.approx(1.0)
    assert sheet["volume.relative_l2"] == pytest.approx(0.5) and sheet["volume.cosine"] == pytest.approx(1.0)
    assert sheet["parameters.viscosity.relative_error"] == pytest.approx(0.5)
    assert sheet["parameters.viscosity.within_2_sigma"] == 0  # 1e-3 off, sigma 1e-4
    assert sheet["parameters.gravity.relative_error"] == pytest.approx(0.5)
    assert sheet["parameters.gravity.within_2_sigma"] is None
    assert sheet["resimulation.volume_drift"] == pytest.approx(-0.1)
    assert sheet["resimulation.volume_drift_worst"] == pytest.approx(0.2)
    assert sheet["resimulation.leak_share"] == pytest.approx(0.02)


def test_the_bed_is_compared_along_the_lines_of_sight():
    camera = a_camera()
    rays = camera.rays(camera.pixel_grid())
    floor = GRID.origin[2] + 0.5 * GRID.spacing
    bed = (floor - camera.position[2]) / rays[..., 2]
    case, asset = replace(a_case(), static_depth=bed), an_asset()
    asset = replace(asset, terrain=replace(asset.terrain, signed_distance=GRID.nodes()[..., 2] - floor))
    sheet = evaluate_arrays(asset, a_run(case), {}, case)
    # sphere tracing ends within a twentieth of a cell of the floor, and rays are up to twice as long as they are deep
    ends = 2 * 0.05 * GRID.spacing
    assert sheet["geometry.bed_error"] == pytest.approx(0.0, abs=ends)
    assert sheet["geometry.up_angle"] == pytest.approx(0.0, abs=1e-4)
    deeper = replace(case, static_depth=1.1 * bed)
    sheet = evaluate_arrays(asset, a_run(deeper), {}, deeper)
    assert sheet["geometry.bed_error_relative"] == pytest.approx(0.1 / 1.1, abs=ends)
    bare = replace(case, static_depth=np.zeros_like(bed))
    assert evaluate_arrays(asset, a_run(bare), {}, bare)["geometry.bed_error"] is None


def test_a_camera_that_is_taken_for_steeper_than_it_is_tilts_the_vertical():
    case = a_case()
    tilt = np.radians(12.0)
    pose = case.camera.camera_from_world
    turn = np.array([[1, 0, 0], [0, np.cos(tilt), -np.sin(tilt)], [0, np.sin(tilt), np.cos(tilt)]])
    camera = replace(case.camera, camera_from_world=RigidTransform(turn @ pose.rotation, pose.translation))
    assert evaluate_arrays(an_asset(camera), a_run(case), {}, case)["geometry.up_angle"] == pytest.approx(12.0)


def test_a_body_that_is_moved_turned_and_scaled_as_a_whole_keeps_its_shape():
    case, run = a_case(), a_run(a_case())
    tilt = np.array([[1, 0, 0], [0, np.cos(0.2), -np.sin(0.2)], [0, np.sin(0.2), np.cos(0.2)]])
    pose = case.camera.camera_from_world
    wrong = replace(case.camera, camera_from_world=RigidTransform(tilt @ pose.rotation, tilt @ pose.translation))
    run["front_depth"] = 1.2 * run["front_depth"]
    sheet = evaluate_arrays(an_asset(wrong), run, {}, case)
    assert sheet["geometry.occupancy_iou"] < 0.8
    # cells of 1/4 of the depth of the pool, turned against each other, cannot agree exactly
    assert sheet["geometry.occupancy_iou_aligned"] > 0.9
    assert evaluate_arrays(an_asset(), a_run(case), {}, case)["geometry.occupancy_iou_aligned"] == pytest.approx(1.0)


def test_a_resimulation_that_starts_later_is_compared_with_the_frames_it_shows():
    case = a_case()
    case.mask[0] = False
    run = a_run(case)
    run.update(first_frame=np.int64(1), resim_mask=case.mask[1:], fit_frames=np.array([1, 2]))
    sheet = evaluate_arrays(an_asset(), run, {}, case)
    assert sheet["resimulation.mask_iou.fitted"] == 1 and sheet["resimulation.mask_iou.predicted"] == 1
    assert len(sheet.series["resimulation.mask_iou"]) == FRAMES - 1


def test_a_run_on_a_smaller_raster_is_scored_in_its_own_pixels():
    case = a_case()
    half = (SIZE[0] // 2, SIZE[1] // 2)
    run = {
        "labels": resample_nearest(case.mask, half).astype(np.uint8),
        "flow_raw": 0.5 * resample_nearest(case.flow[:-1], half, axes=(1, 2)),
    }
    sheet = evaluate_arrays(an_asset(), run, {}, case)
    assert sheet["segmentation.iou"] == 1
    assert sheet["flow.raw.epe"] == pytest.approx(0, abs=1e-6)


def test_end_point_error_and_cosine_by_hand():
    truth = np.zeros((1, 2, 2, 2))
    truth[..., 0] = 2.0
    flow = truth.copy()
    flow[0, 0, 0] = (2.0, 3.0)  # 3 px off
    flow[0, 0, 1] = (0.0, 2.0)  # at a right angle, sqrt(8) off
    flow[0, 1, 0] = (0.0, 0.0)  # still
    mask = np.ones((1, 2, 2), bool)
    assert end_point_error(flow, truth, mask) == pytest.approx((3 + 8**0.5 + 2) / 4)
    assert mean_cosine(flow, truth, mask) == pytest.approx((2 / 13**0.5 + 0 + 0 + 1) / 4)
    assert end_point_error(flow, truth, ~mask) is None and mean_cosine(flow, 0 * truth, mask) is None


def test_mask_iou_by_hand():
    a, b = np.zeros((2, 2, 2), bool), np.zeros((2, 2, 2), bool)
    a[0, 0], b[0, :, 0] = True, True  # one of three
    np.testing.assert_allclose(mask_iou(a, b), [1 / 3, 1.0])


def test_likeness_of_pictures_by_hand():
    grey = np.full((16, 16, 3), 100, np.uint8)
    assert psnr(grey, grey) == np.inf and ssim(grey, grey) == pytest.approx(1.0)
    assert psnr(grey + np.uint8(10), grey) == pytest.approx(20 * np.log10(255 / 10))
    # constant pictures: only the luminance term is left
    c1 = (0.01 * 255) ** 2
    assert ssim(grey + np.uint8(10), grey) == pytest.approx((2 * 100 * 110 + c1) / (100**2 + 110**2 + c1), rel=1e-6)
    mask = np.zeros((16, 16), bool)
    mask[0] = True
    changed = grey.copy()
    changed[1:] = 0
    assert psnr(changed, grey, mask) == np.inf


def test_depth_is_compared_after_the_median_ratio():
    truth = np.array([[2.0, 4.0, 6.0, 0.0]])
    depth = np.array([[1.0, 2.0, 4.0, 7.0]])
    mask = truth > 0
    assert depth_scale(depth, truth, mask) == pytest.approx(2.0)
    error, over_relief, relative = depth_error(depth, truth, mask, 2.0)
    assert error == pytest.approx(2 / 3) and relative == 0.0  # two of three are right: the median is
    assert over_relief == pytest.approx((2 / 3) / (4 / 3))
    assert depth_scale(np.full((1, 4), np.nan), truth, mask) is None


def test_fields_and_sets_by_hand():
    a, b = np.array([[1.0, 0, 0], [0, 1, 0]]), np.array([[1.0, 0, 0], [1, 0, 0]])
    assert relative_l2(a, b) == pytest.approx(1.0)
    assert field_cosine(a, b) == pytest.approx(0.5)
    assert relative_l2(a, 0 * b) is None and field_cosine(0 * a, b) == 0.0
    p, t, i = np.array([[1, 1, 0, 0], [1, 0, 1, 0], [0, 0, 0, 1]], bool)
    assert occupancy_iou(p, t, i) == pytest.approx(1 / 3)
    assert occupancy_iou(p, t, i, stray=3) == pytest.approx(1 / 6)


def test_divergence_is_measured_in_cells_crossed():
    grid = Grid((2, 1, 1), 0.5)
    velocity = FaceVelocity(np.array([1.0, 2.0, 2.0]).reshape(3, 1, 1), np.zeros((2, 2, 1)), np.zeros((2, 1, 2)))
    div = np.diff(velocity.u, axis=0) / grid.spacing  # 2 and 0 per s; mean speed 1.75
    largest, mean = relative_divergence(div, velocity, np.ones((2, 1, 1), bool), grid.spacing)
    assert largest == pytest.approx(1 / 1.75) and mean == pytest.approx(0.5 / 1.75)


def test_still_air_does_not_slow_a_sampled_surface():
    grid = Grid((4, 4, 4), 1.0)
    fluid = grid.centers()[..., 2] < 2
    u = np.where(np.pad(fluid, ((0, 1), (0, 0), (0, 0)), mode="edge"), 3.0, 0.0)
    velocity = FaceVelocity(u, np.zeros((4, 5, 4)), np.zeros((4, 4, 5)))
    at = np.array([[2.0, 2.0, 1.9], [2.0, 2.0, 0.7]])
    np.testing.assert_allclose(sample_cells(velocity, fluid, grid, at)[:, 0], 3.0)


def test_points_of_a_level_set_lie_on_its_surface():
    phi = (GRID.centers()[..., 2] - 0.13) / GRID.spacing
    points = level_set_points(phi, GRID)
    top = points[np.abs(points[:, 2] - 0.13) < 1e-9]
    assert len(top) == GRID.shape[0] * GRID.shape[1]
    sides = points[points[:, 2] < 0.129]  # where the body runs out of the grid
    on_side = (np.abs(sides - GRID.low) < 1e-9) | (np.abs(sides - GRID.high) < 1e-9)
    assert on_side.any(axis=1).all() and len(top) + len(sides) == len(points)


def write_case(folder: Path, **changes) -> Path:
    """The files of `a_case`; `changes` replace arrays of truth.npz (None removes one)."""
    case = a_case()
    folder.mkdir()
    (folder / "video.mp4").write_bytes(b"not read here")
    (folder / "camera.json").write_text(json.dumps(case.camera.to_dict()))
    scene = {"case": "pool", "dt": 0.04, "dx": GRID.spacing, "grid": GRID.shape, "domain_min": GRID.origin}
    (folder / "scene.json").write_text(json.dumps(scene))
    arrays = {
        "flow": case.flow.astype(np.float16), "depth": case.depth.astype(np.float16),
        "dz": case.depth_change.astype(np.float16), "mask": np.packbits(case.mask, axis=-1),
        "static_depth": case.static_depth, "key_frames": case.key_frames.astype(np.int32),
        "grid_velocity": case.velocity.astype(np.float16), "grid_phi": case.level_set.astype(np.float16),
    }  # fmt: skip
    arrays.update(changes)
    np.savez_compressed(folder / "truth.npz", **{k: v for k, v in arrays.items() if v is not None})
    triangle = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], np.float32)
    np.savez(folder / "solids.npz", bed_v=triangle, bed_f=np.array([[0, 1, 2]]), bed_rgb=np.ones(3, np.float32))
    return folder


def test_a_case_comes_back_from_its_folder_as_it_was_written(tmp_path):
    got, want = read_case(write_case(tmp_path / "pool")), a_case()
    assert got.name == "pool" and got.interval == 0.04 and got.grid == GRID and len(got) == FRAMES
    np.testing.assert_array_equal(got.mask, want.mask)
    np.testing.assert_allclose(got.flow, want.flow, rtol=1e-3, atol=1e-3)  # half precision
    assert list(got.solids) == ["bed"] and got.visible is None and got.density is None
    assert got.occupied(1).sum() == GRID.shape[0] * GRID.shape[1] * 4


@pytest.mark.parametrize(
    ("changes", "word"),
    [
        ({"flow": None}, "flow"),
        ({"flow": np.zeros((FRAMES, 5, 5, 2))}, "flow"),
        ({"depth": np.full((FRAMES, SIZE[1], SIZE[0]), np.nan)}, "not finite"),
        ({"mask": np.zeros((FRAMES, SIZE[1], 1), np.uint8)}, "mask"),
        ({"key_frames": np.array([9, 10])}, "key frames"),
        ({"grid_velocity": np.zeros((2, 3, 3, 3, 3))}, "grid_velocity"),
        ({"static_depth": np.array([[{"a": 1}]], dtype=object)}, "plain arrays"),
    ],
)
def test_a_malformed_truth_is_rejected_by_name(tmp_path, changes, word):
    with pytest.raises(InputRejected, match=word):
        read_case(write_case(tmp_path / "pool", **changes))


@pytest.mark.parametrize(
    ("name", "content", "word"),
    [
        ("scene.json", "[1, 2]", "scene.json"),
        ("scene.json", '{"grid": [4, 4], "domain_min": [0, 0, 0], "dx": 0.1}', "grid"),
        ("camera.json", "{", "camera.json"),
        ("camera.json", '{"width": 4}', "camera"),
        ("truth.npz", "no zip", "truth.npz"),
        ("solids.npz", None, "solids.npz"),
    ],
)
def test_a_damaged_file_is_rejected_by_name(tmp_path, name, content, word):
    folder = write_case(tmp_path / "pool")
    (folder / name).unlink() if content is None else (folder / name).write_text(content)
    with pytest.raises(InputRejected, match=word):
        read_case(folder)


def test_an_archive_that_numpy_cannot_take_is_rejected(tmp_path):
    folder = write_case(tmp_path / "pool")
    with zipfile.ZipFile(folder / "solids.npz") as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    header = b"{'descr': '|u1', 'fortran_order': False, 'shape': (4611686018427387904,)}\n"
    lying = b"\x93NUMPY\x01\x00" + struct.pack("<H", len(header)) + header
    for packing, others in ((zipfile.ZIP_LZMA, {}), (zipfile.ZIP_DEFLATED, {"bed_v.npy": lying})):
        with zipfile.ZipFile(folder / "solids.npz", "w", packing) as archive:
            for name, content in (members | others).items():
                archive.writestr(name, content)
        with pytest.raises(InputRejected, match=r"solids\.npz"):
            read_case(folder)
    data = bytearray((folder / "truth.npz").read_bytes())
    data[200:260] = bytes(60)
    (folder / "truth.npz").write_bytes(data)
    with pytest.raises(InputRejected, match=r"truth\.npz"):
        read_case(folder)


def test_a_link_in_place_of_a_file_is_rejected(tmp_path):
    folder = write_case(tmp_path / "pool")
    (folder / "video.mp4").unlink()
    (folder / "video.mp4").symlink_to(folder / "scene.json")
    with pytest.raises(InputRejected, match=r"video\.mp4"):
        read_case(folder)


def shared_cases() -> Path:
    root = Path(os.environ.get("FLUIDLIFT_SHARED", Path(__file__).resolve().parents[2] / "shared"))
    return root / "cases"


@pytest.mark.parametrize("name", ["river", "honey", "smoke"])
def test_cases_of_another_simulator_are_read_and_agree_with_themselves(name):
    folder = shared_cases() / name
    if not folder.is_dir():
        pytest.skip(f"no case '{name}': set FLUIDLIFT_SHARED to the folder that holds cases/")
    case = read_case(folder)
    assert (case.depth[case.mask] > 0).all() and not case.flow[~case.mask].any()
    assert case.solids and case.occupied(0).any()
    run = {"labels": case.mask.astype(np.uint8), "flow_raw": case.flow[:-1]}
    sheet = evaluate_arrays(an_asset(), run, {}, case)
    assert sheet["segmentation.iou"] == 1 and sheet["flow.raw.epe"] == 0


def test_nine_of_ten_errors_lie_below_the_ninetieth_percentile():
    truth = np.zeros((1, 101, 2))
    flow = truth + np.arange(101.0)[None, :, None] * [0.6, 0.8]  # lengths 0 to 100
    every = np.ones((1, 101), bool)
    assert end_point_percentile(flow, truth, every) == pytest.approx(90.0)
    assert end_point_percentile(flow, truth, ~every) is None


def test_a_surface_at_half_speed_has_half_its_speed_as_error():
    case = a_case()
    run = a_run(case)
    # halved on the screen is halved in the world only to first order: the pool moves 20 mm at 0.9 m, hence 2 %
    run["flow_completed"] = 0.5 * case.flow[:-1]
    sheet = evaluate_arrays(an_asset(), run, {}, case)
    assert sheet["surface.velocity.relative_error"] == pytest.approx(0.5, abs=0.02)
    assert sheet["surface.velocity.error"] == pytest.approx(0.5 * np.linalg.norm(VELOCITY), abs=0.01)
    assert sheet["surface.velocity.share_found"] == pytest.approx(0.5, abs=0.02)
    del run["flow_completed"]
    assert evaluate_arrays(an_asset(), run, {}, case)["surface.velocity.error"] is None


def test_arrays_of_an_asset_of_an_earlier_version_come_from_its_file_and_of_one_without_work_there_are_none(tmp_path):
    assert arrays_of_run(tmp_path, {}) == {}
    (tmp_path / "work").mkdir()
    np.savez_compressed(tmp_path / "work" / "evaluation.npz", labels=np.ones((2, 3, 4), np.uint8))
    assert arrays_of_run(tmp_path, {})["labels"].shape == (2, 3, 4)


def test_pictures_are_compared_with_the_clip_that_the_asset_was_made_of(tmp_path):
    # another clip of the same motion than that of the case, which cannot even be read
    case, folder = write_case(tmp_path / "pool"), tmp_path / "pool.fluid"
    save_asset(folder, an_asset())
    (folder / "work").mkdir(exist_ok=True)
    run = a_run(a_case())
    stored = folder / "work" / "evaluation.npz"
    np.savez_compressed(stored, **run)
    assert evaluate_asset(folder, case)["resimulation.psnr"] is None
    np.savez_compressed(stored, **run, clip_frames=run["resim_frames"])
    assert evaluate_asset(folder, case)["resimulation.psnr.fitted"] == 99
