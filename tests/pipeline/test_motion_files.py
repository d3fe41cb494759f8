"""`fluidlift motion`: flow and velocities of every frame, in files that other tools read."""

import json
import shutil
import struct
from importlib import resources
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from fluidlift.cli import DONE, REJECTED, WITH_WARNINGS, main
from fluidlift.io.exr import read_channels
from fluidlift.io.flow_files import write_flow
from fluidlift.io.pictures import read_picture, write_png
from fluidlift.pipeline import frame_files, motion_files
from fluidlift.pipeline.frame_files import FrameWriter
from fluidlift.pipeline.mask_facts import is_straight

FRAMES = 5
PAIRS = FRAMES - 1
COARSE = ("--set", "shape.cells=24")


@pytest.fixture(scope="module")
def demo():
    """The clip that comes with the package and its camera."""
    data = resources.files("fluidlift.synthetic") / "data"
    return [str(data / "demo.mp4"), "--camera", str(data / "demo_camera.json"), "--duration", str(0.04 * FRAMES)]


def measure(demo, folder, *options):
    code = main(["motion", *demo, "-o", str(folder), "--max-size", "160", *COARSE, *options])
    assert code in (DONE, WITH_WARNINGS)
    return folder


@pytest.fixture(scope="module")
def measured(demo, tmp_path_factory):
    return measure(demo, tmp_path_factory.mktemp("motion") / "exr", "--raw")


def facts_of(folder):
    return json.loads((folder / "motion.json").read_text())


def flow_of(folder, number, name="flow"):
    """px per frame, x right and y down: Nuke's v points up."""
    channels = read_channels(folder / name / f"flow.{number}.exr")
    return np.stack([channels["forward.u"], -channels["forward.v"]], axis=-1)


def points_of(path):
    """Records of a PLY of points, read by its header."""
    head, _, body = path.read_bytes().partition(b"end_header\n")
    kinds = {"float": "<f4", "double": "<f8", "uchar": "u1"}
    lines = [line.split() for line in head.decode().splitlines()]
    record = np.dtype([(words[2], kinds[words[1]]) for words in lines if words[0] == "property"])
    return np.frombuffer(body, record)


def test_every_frame_has_its_files_and_numbers_begin_at_1001(measured):
    expected = [f"{1001 + t}" for t in range(PAIRS)]
    for name, suffix in (("observed", "png"), ("overlay", "png"), ("velocity", "vdb"), ("surface", "ply")):
        assert sorted(p.stem for p in (measured / name).glob(f"*.{suffix}")) == expected, name
    for name in ("flow", "raw_flow"):
        assert sorted(p.name for p in (measured / name).iterdir()) == [f"flow.{n}.exr" for n in expected]
    # the last frame has a mask, but no flow goes on from it
    assert sorted(p.stem for p in (measured / "mask").glob("*.png")) == [*expected, str(1001 + PAIRS)]
    assert not [p for p in measured.rglob("*") if ".part" in p.name]


def test_the_flow_runs_to_the_right_as_the_demo_river_does(measured):
    mask, flow = read_picture(measured / "mask" / "1002.png") == 255, flow_of(measured, 1002)
    assert np.median(flow[mask][:, 0]) > 1.0
    assert not flow[~mask].any()


def test_the_velocities_on_the_surface_are_those_of_the_summary(measured):
    facts = facts_of(measured)
    points = points_of(measured / "surface" / "1002.ply")
    speed = np.sqrt(points["vx"] ** 2 + points["vy"] ** 2 + points["vz"] ** 2)
    row = facts["per_frame"][1]
    assert (row["number"], facts["first_number"], facts["frames"]) == (1002, 1001, FRAMES)
    assert np.median(speed) == pytest.approx(row["surface_speed_median"], rel=1e-5)  # float32
    assert 0 < points["observed"].mean() <= 1
    assert row["flux_in"] > 0 and row["divergence_max"] < 1e-2 and 0 < row["trusted_share"] <= 1
    assert facts["units"]["velocity"] == "m/s, z up"


def test_the_volume_is_an_openvdb_file_of_cells_in_metres(measured):
    """Magic number, version, and the grid `vel` of vectors; the layout itself is tested with the writer."""
    data = (measured / "velocity" / "1001.vdb").read_bytes()
    assert struct.unpack("<q", data[:8])[0] == 0x56444220
    assert b"vel" in data[:400] and b"Tree_vec3s_5_4_3" in data[:400]


def test_flo_files_are_read_by_opencv_and_mark_what_is_no_fluid(demo, measured, tmp_path):
    folder = measure(demo, tmp_path / "flo", "--format", "flo")
    flow, mask = cv2.readOpticalFlow(str(folder / "flow" / "flow.1002.flo")), flow_of(measured, 1002)
    fluid = read_picture(folder / "mask" / "1002.png") == 255
    np.testing.assert_array_equal(flow[fluid], mask[fluid])
    assert (np.abs(flow[~fluid]) >= 1e9).all()  # Middlebury's "unknown"


@pytest.mark.parametrize("kind", ["exr", "npz"])
def test_its_own_raw_flow_given_back_gives_the_same_motion(demo, measured, tmp_path, kind):
    """Of the same masks: they are found in the flow of single pairs, or in the one that is given."""
    same = ("--mask", str(measured / "mask"))
    first = measure(demo, tmp_path / "first", "--raw", *same)
    source = first if kind == "exr" else measure(demo, tmp_path / "npz", "--raw", "--format", "npz", *same)
    again = measure(demo, tmp_path / "again", "--flow", str(source / "raw_flow"), *same)
    for number in range(1001, 1001 + PAIRS):
        np.testing.assert_array_equal(flow_of(again, number), flow_of(first, number))
    assert (again / "velocity" / "1002.vdb").stat().st_size == (first / "velocity" / "1002.vdb").stat().st_size


def test_flow_of_the_whole_file_is_selected_by_the_start(demo, tmp_path):
    """Every pair of the file says its own number: 0.08 s at 25 frames per second is frame 2."""
    flow = tmp_path / "flow"
    for t in range(12):
        write_flow(flow, t, np.full((104, 160, 2), (0.25 * t, 0.0), np.float32), np.ones((104, 160), np.float32), "npz")
    folder = measure([*demo, "--start", "0.08"], tmp_path / "out", "--flow", str(flow), "--raw")
    for t in range(PAIRS):
        np.testing.assert_allclose(flow_of(folder, 1001 + t, "raw_flow")[..., 0], 0.25 * (t + 2))


def test_flow_with_too_few_pairs_is_refused_with_the_frame(demo, tmp_path, capsys):
    for t in range(PAIRS - 1):
        write_flow(tmp_path / "flow", t, np.ones((104, 160, 2), np.float32), None, "flo")
    out = tmp_path / "out"
    assert main(["motion", *demo, "-o", str(out), "--max-size", "160", "--flow", str(tmp_path / "flow")]) == REJECTED
    assert f"frame {PAIRS - 1} to {PAIRS}" in capsys.readouterr().err
    assert not out.exists()
    text = tmp_path / "text.flo"
    text.write_text("no flow")
    assert main(["motion", *demo, "-o", str(out), "--flow", str(text)]) == REJECTED
    assert "does not begin as a .flo file does" in capsys.readouterr().err


def test_flow_of_another_shape_is_refused(demo, tmp_path, capsys):
    for t in range(PAIRS):
        write_flow(tmp_path / "flow", t, np.ones((80, 80, 2), np.float32), None, "flo")
    code = main(["motion", *demo, "-o", str(tmp_path / "out"), "--max-size", "160", "--flow", str(tmp_path / "flow")])
    assert code == REJECTED and "80 x 80" in capsys.readouterr().err


def test_a_run_that_was_stopped_goes_on_with_the_next_frame(demo, measured, tmp_path, monkeypatch):
    written, write = [], frame_files.FrameWriter.write

    def stop(self, t, found):
        if t == 2 and not written.count(2):
            written.append(2)
            raise KeyboardInterrupt
        written.append(t)
        write(self, t, found)

    monkeypatch.setattr(frame_files.FrameWriter, "write", stop)
    arguments = ["motion", *demo, "-o", str(tmp_path / "out"), "--max-size", "160", *COARSE]
    assert main(arguments) == 1
    assert main(arguments) in (DONE, WITH_WARNINGS)
    assert written == [0, 1, 2, 2, 3]
    rows, whole = facts_of(tmp_path / "out")["per_frame"], facts_of(measured)["per_frame"]
    assert [r["frame"] for r in rows] == list(range(PAIRS))
    assert [r["surface_speed_mean"] for r in rows] == [r["surface_speed_mean"] for r in whole]
    np.testing.assert_array_equal(flow_of(tmp_path / "out", 1003), flow_of(measured, 1003))


def test_a_lost_file_is_written_again_and_the_rest_is_cached(demo, tmp_path, capsys):
    folder = measure(demo, tmp_path / "out")
    (folder / "velocity" / "1002.vdb").unlink()
    capsys.readouterr()
    measure(demo, folder, "--json")
    stages = json.loads(capsys.readouterr().out)["stages"]
    assert [name for name, stage in stages.items() if not stage["cached"]] == ["velocities"]
    assert (folder / "velocity" / "1002.vdb").is_file()


def test_an_unknown_stage_is_refused(demo, tmp_path, capsys):
    assert main(["motion", *demo, "-o", str(tmp_path / "out"), "--force", "fit"]) == REJECTED
    assert "velocities" in capsys.readouterr().err


def test_masks_that_a_person_has_changed_are_not_written_over(demo, tmp_path, capsys):
    folder = measure(demo, tmp_path / "out")
    mask = folder / "mask" / "1003.png"
    corrected = np.full_like(read_picture(mask), 255)
    write_png(mask, corrected)
    again = ["motion", *demo, "-o", str(folder), "--max-size", "160", *COARSE, "--set", "motion.half_window=0"]
    capsys.readouterr()
    assert main(again) == REJECTED
    said = capsys.readouterr().err
    assert "changed" in said and "--force velocities" in said
    np.testing.assert_array_equal(read_picture(mask), corrected)
    # given back, they are taken and stay as they are, file by file
    before = {p: p.read_bytes() for p in (folder / "mask").iterdir()}
    assert main([*again, "--mask", str(folder / "mask")]) in (DONE, WITH_WARNINGS)
    assert {p: p.read_bytes() for p in (folder / "mask").iterdir()} == before
    assert main([*again, "--force", "velocities"]) in (DONE, WITH_WARNINGS)
    assert not read_picture(mask).all()


def test_mask_goes_into_a_folder_of_motion_and_motion_back(demo, measured, tmp_path):
    """Both write mask/ and overlay/: each takes the other's files for its own only as long as nobody edits them."""
    folder = shutil.copytree(measured, tmp_path / "out")
    overlay = (folder / "overlay" / "1001.png").read_bytes()
    assert main(["mask", *demo, "-o", str(folder), "--max-size", "160"]) in (DONE, WITH_WARNINGS)
    assert (folder / "overlay" / "1001.png").read_bytes() != overlay
    measure(demo, folder, "--raw")
    assert (folder / "overlay" / "1001.png").read_bytes() == overlay


def test_masks_of_a_clip_without_a_camera_file_are_not_said_to_be_straight(demo, measured, tmp_path):
    assert is_straight(measured / "mask")
    folder = measure([demo[0], *demo[3:]], tmp_path / "out")
    assert not is_straight(folder / "mask")


@pytest.mark.parametrize(
    ("flux_in", "flux_out", "words"),
    [
        (0.405, -0.178, "flows in at both ends (0.405 and 0.178 m3/s, medians), and 0.583"),
        (-0.1, 0.2, "flows out at both ends"),
        (-0.1, -0.2, "taken for each other"),
        (0.1, 0.175, "0.1 m3/s flow in and 0.175 m3/s flow out"),
    ],
)
def test_fluxes_that_do_not_agree_are_told_with_their_direction(flux_in, flux_out, words):
    (told,) = motion_files._unbalanced([{"flux_in": flux_in, "flux_out": flux_out}] * 3)
    assert words in told


def test_fluxes_that_agree_are_not_told():
    assert not motion_files._unbalanced([{"flux_in": 0.1, "flux_out": 0.12}, {}])


def test_a_scale_that_hangs_on_an_assumed_level_says_so(demo, tmp_path, capsys):
    camera = json.loads(Path(demo[2]).read_text())
    for level, assumed in ((None, True), (0.0, False)):
        given = {k: v for k, v in camera.items() if k != "water_level_z"}
        given |= {} if level is None else {"water_level_z": level}
        (tmp_path / "camera.json").write_text(json.dumps(given))
        folder = tmp_path / f"out{level}"
        measure([demo[0], "--camera", str(tmp_path / "camera.json"), *demo[3:]], folder, "--kind", "stream")
        facts = facts_of(folder)
        assert facts["scale"]["source"] == "camera"
        assert ("z = 0 is assumed" in facts["scale"]["warning"]) == assumed
        assert facts["scale_sentence"].endswith("with the water at z = 0, assumed") == assumed


def test_a_folder_that_cannot_be_made_is_refused_before_anything_is_decoded(demo, tmp_path, capsys, monkeypatch):
    """Root may write everywhere: a system call that fails stands for the disk."""

    def no(*_, **__):
        raise FileNotFoundError(2, "No such file or directory")

    monkeypatch.setattr(Path, "mkdir", no)
    for command in ("mask", "motion", "make"):
        assert main([command, *demo, "-o", str(tmp_path / "out")]) == REJECTED
        said = capsys.readouterr().err
        assert "cannot be written" in said and "read" not in said.split("fluidlift:")[0]
    assert not (tmp_path / "out").exists()


def test_no_raw_flow_of_an_earlier_run_stays_beside_the_new_files(demo, measured, tmp_path):
    folder = shutil.copytree(measured, tmp_path / "out")
    measure(demo, folder, "--format", "npz")
    assert not list((folder / "raw_flow").iterdir())
    # but the one that is given is the user's
    folder = shutil.copytree(measured, tmp_path / "given")
    measure(demo, folder, "--format", "npz", "--flow", str(folder / "raw_flow"))
    assert len(list((folder / "raw_flow").iterdir())) == PAIRS


def test_the_tilt_of_the_camera_can_be_told(demo, tmp_path):
    folder = measure([demo[0], *demo[3:]], tmp_path / "out", "--pitch", "30", "--fov", "60", "--roll", "0")
    _, _, forward = json.loads((folder / "camera.json").read_text())["R"]
    assert forward[2] == pytest.approx(-0.5, abs=1e-6)  # sin 30


def test_flow_without_confidence_is_said_to_be_trusted_as_given(demo, measured, tmp_path, capsys):
    for t in range(PAIRS):
        write_flow(tmp_path / "flow", t, np.ones((104, 160, 2), np.float32), None, "flo")
    capsys.readouterr()
    folder = measure(demo, tmp_path / "out", "--flow", str(tmp_path / "flow"))
    assert "trusted as given" in capsys.readouterr().out
    assert facts_of(folder)["flow_trusted_as_given"] and not facts_of(measured)["flow_trusted_as_given"]


def test_the_overlay_shows_the_picture_where_the_fluid_is_slow_and_the_colour_where_it_is_fast():
    picture = np.full((1, 4, 3), 100, np.uint8)
    writer = SimpleNamespace(clip=SimpleNamespace(frames=[picture]), scale=2.0)
    flow = np.array([[[0.0, 0.0], [0.5, 0.0], [2.0, 0.0], [2.0, 0.0]]], np.float32)
    fluid = np.array([[True, True, True, False]])
    still, slow, fast, outside = FrameWriter._overlay(writer, 0, flow, fluid)[0].astype(int)
    assert (still == 100).all() and (outside == 100).all()
    # red is to the right: a quarter of the speed has a quarter of the fast one's colour, to a level
    np.testing.assert_allclose(slow - 100, (fast - 100) / 4, atol=1)
    assert fast[0] > 150 > 100 > fast[2]
