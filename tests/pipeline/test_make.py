"""From a clip to an asset folder: everything is there, agrees with itself, and comes out the same again."""

import json
import re
import shutil

import numpy as np
import pytest

from fluidlift.cli import DONE, FAILED, REJECTED, WITH_WARNINGS, main
from fluidlift.config import build_config
from fluidlift.io.asset_folder import load_asset, read_manifest
from fluidlift.io.force_file import read_filmed
from fluidlift.io.scene import SceneEdits
from fluidlift.io.video import read_clip
from fluidlift.look.rasterize import render
from fluidlift.numerics.sampling import sample_nodes
from fluidlift.pipeline import STAGES, Inputs, card_of, make
from fluidlift.pipeline.stages import fit, geometry, simulate
from fluidlift.scene import SimulationRequest
from fluidlift.scene.build import SceneSettings, edited_scene, scene_of
from fluidlift.scene.footage import footage_of
from fluidlift.scene.simulator import simulator_of
from fluidlift.scene.splat_files import frame_files, read_frame
from fluidlift.types import CellType, Label
from fluidlift.validate import validate_asset

FRAMES = 10


@pytest.fixture(scope="module")
def asset(made):
    return load_asset(made.folder)


@pytest.fixture
def copy(made, tmp_path):
    """The asset to be changed."""
    return shutil.copytree(made.folder, tmp_path / "stream.fluid")


def run(made, folder, *options, quick):
    return main(["make", str(made.clip), "-o", str(folder), "--size", "2", *quick, *options])


# what is there --------------------------------------------------------------------------------------------------


def test_the_manifest_says_what_was_made_of_what(made):
    manifest = read_manifest(made.folder)
    assert manifest["frame_count"] == FRAMES
    assert manifest["frame_interval"] == pytest.approx(0.04)
    assert manifest["provenance"]["inputs"]["clip"]["name"] == "stream.mp4"
    assert len(manifest["provenance"]["inputs"]["clip"]["sha256"]) == 64
    assert manifest["provenance"]["config"]["shape"]["cells"] == 24
    assert set(manifest["timings"]) == set(STAGES)
    assert all((made.folder / name).is_file() for name in manifest["files"].values())
    assert str(made.clip.parent) not in json.dumps(manifest)  # nothing about this machine


def test_a_channel_that_runs_to_the_right_is_a_stream_to_the_right(asset):
    assert asset.kind == "stream"
    # the mainstream is the x axis of the world, up to the perspective of the flow
    assert asset.terrain.mainstream[0] > 0.98
    wet = np.isin(asset.cell_types, [CellType.FLUID, CellType.INFLOW])
    assert (asset.velocity.at_centers()[wet][:, 0] > 0).mean() > 0.95


def test_the_fluid_was_found_between_its_banks(finished):
    labels = finished.lift.labels.labels
    inside, outside = labels[:, 26:44, 8:40], labels[:, :10]
    assert (inside == Label.FLUID).mean() > 0.95
    assert (outside == Label.FLUID).mean() < 0.02


def test_the_flow_is_two_pixels_per_frame(finished):
    flow = finished.lift.flow.flow.displacement.astype(float)[:, 26:44, 8:40]
    # compressed video of 96 px: a tenth of a pixel
    np.testing.assert_allclose(np.median(flow, axis=(0, 1, 2)), [2.0, 0.0], atol=0.1)


def test_the_size_is_what_was_asked_for(asset):
    extent = np.ptp(asset.rest.means, axis=0).max()
    # the body has a cell or two of inlet and outlet more than its visible surface, of 24 along the longest side
    assert extent == pytest.approx(2.0, rel=0.15)


def test_the_surface_moves_at_the_speed_of_the_picture(finished, asset):
    """2 px per frame at the distance and focal length of the camera, in metres per second."""
    depth = float(np.median(finished.lift.geometry.depth[26:44, 8:40]))
    expected = 2.0 * depth / asset.camera.focal[0] / asset.interval
    wet = asset.cell_types == CellType.FLUID
    top = wet & ~np.roll(wet, -1, axis=2)
    # under the surface bed friction slows the water down; coarse cells blur the surface speed with what is below
    assert np.median(asset.velocity.at_centers()[top][:, 0]) == pytest.approx(expected, rel=0.25)


def test_the_rest_body_lies_in_its_grid_and_outside_the_terrain(asset):
    assert asset.grid.contains(asset.rest.means).all()
    distance = sample_nodes(asset.terrain.signed_distance, asset.grid, asset.rest.means)
    assert distance.min() > -0.3 * asset.grid.spacing  # centres may sink by a quarter of a cell


def test_the_camera_of_the_asset_sees_the_body_where_the_video_shows_it(asset, finished):
    uv, z = asset.camera.project(asset.rest.means)
    assert (z > 0).all()
    mask = finished.lift.geometry.mask
    ok = ((uv >= 0) & (uv < asset.camera.size)).all(axis=1)
    col, row = uv[ok].astype(int).T
    # the deep parts of the body project below the water line of the near bank, and rocks hide some of it
    assert mask[row, col].mean() > 0.6


# frames ---------------------------------------------------------------------------------------------------------


def splats(made, k):
    return read_frame(made.folder / "frames" / "splats" / f"{1001 + k}.flsp")


def lost(frame):
    """m, that packing moves a splat along an axis at most: a hundredth of the median smallest axis, which comes back to
    a half of a thousandth."""
    return 0.01 * np.median(frame.gaussians.scales.min(axis=1)) * 1.0005


def test_the_particles_of_the_first_frame_are_the_rest_body_without_what_lies_behind_the_outlet(made, asset):
    first = splats(made, 0)
    particle = first.ids.astype(int) % 2 == 0  # odd ones are the skin's
    ids = first.ids.astype(int)[particle] // 2
    assert (np.diff(ids) > 0).all() and ids[-1] < len(asset.rest)
    gone = np.setdiff1d(np.arange(len(asset.rest)), ids)
    cells = asset.grid.cell_of(asset.rest.means[gone])
    assert (asset.cell_types[tuple(cells.T)] == CellType.OUTFLOW).all() and len(gone) < 0.1 * len(asset.rest)
    # the simulator pushes those that begin inside a wall out of it: few, and by less than a cell
    rest = asset.rest.select(ids)
    moved = np.linalg.norm(first.gaussians.means[particle] - rest.means, axis=1)
    assert (moved > np.sqrt(3) * lost(first)).mean() < 0.1
    assert moved.max() < asset.grid.spacing


def test_the_first_frame_looks_like_the_clip(made, finished, asset):
    lift = finished.lift
    picture, fluid = lift.read.clip.frames[lift.geometry.rest_frame].astype(np.float32) / 255, lift.geometry.mask
    off = []
    for body in (splats(made, 0).gaussians, asset.rest):
        off.append(np.abs(render(body, asset.camera, background=picture).image - picture)[fluid].mean())
    assert off[0] < off[1]


def test_the_files_hold_what_was_simulated(made, finished, asset):
    lift = finished.lift
    footage = footage_of(lift.read, lift.segmentation, lift.geometry)
    scene = scene_of(asset, made.folder, SimulationRequest(), build_config(), footage=footage, start=0)
    simulator = simulator_of(scene)
    for _ in range(2):
        simulator.advance(asset.interval)
    p, shown = simulator.particles, splats(made, 2)
    order, particle = np.argsort(p.ids), np.flatnonzero(shown.ids % 2 == 0)  # odd ones are the skin's
    written = particle[np.argsort(shown.ids[particle])]
    np.testing.assert_array_equal(shown.ids[written], 2 * p.ids[order])
    # the same program on the same numbers, packed; sums over particles may be taken in another order by another thread
    tolerance = lost(shown) + 1e-4 * asset.grid.spacing
    np.testing.assert_allclose(shown.gaussians.means[written], p.positions[order], atol=tolerance)
    velocity = shown.velocities
    np.testing.assert_allclose(velocity[written], p.velocities[order], atol=1e-3 * np.abs(p.velocities).max())


def test_an_edited_asset_becomes_a_scene_without_a_file(made, asset, tmp_path):
    """What `fluidlift sim` reads from the folder, and what is handed over in Python, go the same way."""
    edits = SceneEdits(parameters={"kinematic_viscosity": 1e-3}, duration=0.2)
    (tmp_path / "scene.yaml").write_text("parameters: {kinematic_viscosity: 1.0e-3}\nduration: 0.2\n")
    there = scene_of(asset, tmp_path, SimulationRequest(), build_config(), footage=None, start=0)
    scene = edited_scene(asset, edits)
    assert scene.parts == there.parts and scene.frames == there.frames == 5
    simulator = simulator_of(scene)
    simulator.advance(scene.interval)
    assert len(simulator.particles) > 0
    filmed = read_filmed(made.folder)
    assert filmed.force is not None
    same = edited_scene(asset, SceneEdits(), settings=SceneSettings(None, 0.5, 0.0, 0), filmed=filmed)
    np.testing.assert_allclose(same.force.u, 0.5 * filmed.force.u)


def test_every_frame_has_a_splat_per_particle(made, finished):
    counts = [int((splats(made, k).ids % 2 == 0).sum()) for k in range(FRAMES)]
    assert counts == finished.simulation.count.tolist()


def test_particles_keep_their_ids_and_move_with_the_stream(made, asset):
    before, after = splats(made, 0), splats(made, 3)
    common, i, j = np.intersect1d(before.ids, after.ids, return_indices=True)
    assert len(common) > 0.5 * len(before.gaussians)  # the others have left through the outlet
    shift = np.median(after.gaussians.means[j] - before.gaussians.means[i], axis=0)
    assert shift[0] > 0.1 * 3 * asset.interval * np.linalg.norm(asset.parameters.inflow_velocity)
    assert abs(shift[1]) < 0.5 * shift[0]


def test_the_scene_description_shows_the_first_frame(made):
    from pxr import Usd, UsdGeom

    stage = Usd.Stage.Open(str(made.folder / "asset.usda"))
    assert (stage.GetStartTimeCode(), stage.GetEndTimeCode()) == (1001, 1001)
    assert read_manifest(made.folder)["simulation"]["usd_frames"] == 1
    assert stage.GetTimeCodesPerSecond() == pytest.approx(25.0)
    assert UsdGeom.GetStageUpAxis(stage) == "Z"
    assert UsdGeom.GetStageMetersPerUnit(stage) == pytest.approx(1.0)


def test_the_preview_shows_three_views_of_every_frame(made):
    preview = read_clip(made.folder / "preview.mp4")
    assert len(preview) == FRAMES
    assert preview.size == (3 * 96, 64)


def test_the_report_says_what_the_surface_was_taken_from_and_how_sure_that_is(made, finished):
    text = (made.folder / "report.html").read_text(encoding="utf-8")
    slope, up = finished.lift.geometry.slope, finished.lift.geometry.up
    assert f"level with a probability of {slope.level_share:.2f}" in text
    assert f"± {slope.standard_error:.1f} degrees" in text and f"confidence {up.confidence:.2f}" in text


def test_the_report_tells_the_kind_and_every_stage(made):
    text = (made.folder / "report.html").read_text(encoding="utf-8")
    assert "kind: stream" in text
    for stage in STAGES:
        assert f"<td>{stage}</td>" in text
    # nothing is fetched; the letters of a picture in base64 can spell anything
    assert "http" not in re.sub(r"base64,[A-Za-z0-9+/=]+", "", text)


# again ----------------------------------------------------------------------------------------------------------


def outcome(capsys):
    return json.loads(capsys.readouterr().out)


def test_a_second_run_has_nothing_to_do(made, copy, quick, capsys):
    before = {p: p.read_bytes() for p in (copy / "parameters.json", copy / "rest" / "gaussians.ply")}
    capsys.readouterr()
    assert run(made, copy, "--json", quick=quick) == made.code
    found = outcome(capsys)
    assert all(stage["cached"] for stage in found["stages"].values())
    assert found["warnings"] == read_manifest(made.folder)["warnings"]
    assert all(p.read_bytes() == data for p, data in before.items())


def test_the_same_clip_settings_and_seed_give_the_same_asset(made, tmp_path, quick):
    """Simulation and pictures are left out the second time: they follow from what is compared here."""
    other = tmp_path / "again.fluid"
    code = run(made, other, "--set", "simulate.frames=1", "--set", "show.usd=false", quick=quick)
    manifest = read_manifest(made.folder)
    # one frame is too few to be held against the clip: what was said of the ten does not count
    alike = [w for w in manifest["warnings"] if w != card_of(manifest).warning()]
    assert code == (WITH_WARNINGS if alike else DONE)
    for name in ("parameters.json", "rest/gaussians.ply", "rest/camera.json", "rest/terrain.glb"):
        assert (other / name).read_bytes() == (made.folder / name).read_bytes(), name
    a, b = load_asset(made.folder), load_asset(other)
    for one, two in zip(a.velocity.components, b.velocity.components):
        np.testing.assert_array_equal(one, two)


def test_another_seed_gives_another_body_from_the_same_motion(made, copy, quick, capsys):
    capsys.readouterr()
    run(made, copy, "--seed", "1", "--json", "--set", "simulate.frames=1", "--set", "show.usd=false", quick=quick)
    stages = outcome(capsys)["stages"]
    assert [name for name in STAGES if not stages[name]["cached"]] == ["refine", "calibrate", "simulate", "show"]
    assert (copy / "rest/gaussians.ply").read_bytes() != (made.folder / "rest/gaussians.ply").read_bytes()
    assert (copy / "parameters.json").read_bytes() == (made.folder / "parameters.json").read_bytes()


def test_a_lost_picture_or_frame_is_made_again_and_nothing_else(made, copy, quick, capsys):
    (copy / "preview.mp4").unlink()
    capsys.readouterr()
    run(made, copy, "--json", quick=quick)
    stages = outcome(capsys)["stages"]
    assert [name for name in STAGES if not stages[name]["cached"]] == ["show"]
    assert (copy / "preview.mp4").is_file()


def test_what_a_person_wrote_into_the_scene_file_stays(made, copy, quick):
    (copy / "scene.yaml").write_text("# my own words\n", encoding="utf-8")
    run(made, copy, quick=quick)
    assert (copy / "scene.yaml").read_text(encoding="utf-8") == "# my own words\n"


def test_an_edited_duration_is_simulated_and_nothing_before_it_runs_again(made, copy, quick, capsys):
    (copy / "scene.yaml").write_text("duration: 0.16\n", encoding="utf-8")
    capsys.readouterr()
    run(made, copy, "--json", "--set", "show.usd=false", quick=quick)
    stages = outcome(capsys)["stages"]
    assert [name for name in STAGES if not stages[name]["cached"]] == ["simulate", "show"]
    assert len(frame_files(copy)) == 4  # 0.16 s at 25 per second


def test_a_given_body_replaces_the_embedded_generator(made, tmp_path, hasty, asset):
    """The body of the asset, handed in as somebody else's, comes out where it was, seen by the same camera."""
    given = tmp_path / "given"
    given.mkdir()
    shutil.copyfile(made.folder / "rest" / "gaussians.ply", given / "0000.ply")
    shutil.copyfile(made.folder / "rest" / "camera.json", given / "camera.json")
    folder = tmp_path / "x.fluid"
    code = main(["make", str(made.clip), "-o", str(folder), "--size", "2", "--geometry-from", str(given), *hasty])
    assert code in (DONE, WITH_WARNINGS)
    found = load_asset(folder)
    assert found.camera.focal == pytest.approx(asset.camera.focal)
    # both worlds have their origin under the middle of the fluid; cells are twice as large here
    np.testing.assert_allclose(found.camera.position, asset.camera.position, atol=0.2)
    np.testing.assert_allclose(np.ptp(found.rest.means, axis=0), np.ptp(asset.rest.means, axis=0), atol=0.2)


def test_an_interrupted_job_goes_on_where_it_stopped(made, copy, quick, capsys, monkeypatch):
    def stop(*inputs, **beside):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(fit, "first_guess", stop)
        assert run(made, copy, "--force", "fit", quick=quick) == FAILED
    assert "goes on from there" in capsys.readouterr().err
    assert run(made, copy, "--json", quick=quick) == made.code
    stages = outcome(capsys)["stages"]
    assert stages["motion"]["cached"] and stages["refine"]["cached"]


def test_an_interrupt_in_a_fresh_folder_keeps_what_was_done(stream_clip, tmp_path, hasty, monkeypatch, capsys):
    def stop(*inputs, **beside):
        raise KeyboardInterrupt

    folder = tmp_path / "x.fluid"
    with monkeypatch.context() as patch:
        patch.setattr(geometry, "sighted", stop)
        assert main(["make", str(stream_clip), "-o", str(folder), *hasty]) == FAILED
    assert [name for name in STAGES if any((folder / "work" / name).glob("*.json"))] == ["read", "flow", "segment"]
    assert main(["validate", str(folder)]) == REJECTED  # half an asset is none
    capsys.readouterr()


def test_a_full_disk_in_a_later_stage_is_said_as_such(made, copy, quick, monkeypatch, capsys):
    import errno

    def full(scene):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(simulate, "preflight", full)
    assert run(made, copy, "--force", "simulate", quick=quick) == REJECTED
    assert "disk full" in capsys.readouterr().err
    assert (copy / "rest" / "gaussians.ply").is_file()  # the asset that was there before stays


# from code ------------------------------------------------------------------------------------------------------


def test_unknown_stages_are_rejected_before_anything_is_written(stream_clip, tmp_path):
    from fluidlift.errors import InputRejected

    with pytest.raises(InputRejected, match="segment"):
        make(Inputs(stream_clip), tmp_path / "x.fluid", build_config(), force=["segmentation"])
    assert not (tmp_path / "x.fluid").exists()


# validation -----------------------------------------------------------------------------------------------------


def failed(folder):
    return [f.check for f in validate_asset(folder) if not f.passed]


def test_a_missing_frame_is_found(copy):
    (copy / "frames" / "splats" / "1004.flsp").unlink()
    assert "splat frames are complete" in failed(copy)


def test_a_damaged_frame_is_found(copy):
    middle = copy / "frames" / "splats" / "1002.flsp"
    middle.write_bytes(middle.read_bytes()[:1000])
    assert failed(copy) == ["every frame can be read"]


def test_a_damaged_part_is_found(copy):
    (copy / "rest" / "velocity.npz").write_bytes(b"nothing")
    assert failed(copy) == ["files are as they were written", "parts can be read"]


def test_a_velocity_with_divergence_is_found(copy):
    path = copy / "rest" / "velocity.npz"
    with np.load(path) as archive:
        arrays = dict(archive)
    uneven = np.where(np.arange(len(arrays["u"])) % 2, 0.5, 1.5)  # from face to face along x
    arrays["u"] = arrays["u"] * uneven.astype(np.float32)[:, None, None]
    np.savez(path, **arrays)
    assert failed(copy) == ["files are as they were written", "velocity is divergence-free"]


def test_gaussians_outside_the_grid_are_found(copy):
    from fluidlift.io.ply import read_gaussians, write_gaussians
    from fluidlift.types import Similarity3

    path = copy / "rest" / "gaussians.ply"
    write_gaussians(path, read_gaussians(path).transformed(Similarity3(1.0, np.eye(3), np.array([9.0, 0, 0]))))
    assert failed(copy) == ["files are as they were written", "Gaussians lie in the grid"]
