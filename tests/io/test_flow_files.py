"""Flow of other tools is read in our pixels and axes, flow for other tools is what they expect."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest

from fluidlift.errors import InputRejected
from fluidlift.io.exr import read_channels
from fluidlift.io.exr_write import write_channels
from fluidlift.io.flow_files import FlowLayout, open_flow, read_flo, resized_flow, write_flow
from fluidlift.io.limits import ReadLimits

SIZE = (37, 23)
"""width, height: odd, so that rows and columns cannot be mistaken for one another"""


def read_flow(path: Path, size: tuple[int, int], pairs: int, **more):
    """All of the flow at once."""
    return open_flow(path, size, pairs, **more).window(0, pairs)


def some_flow(pairs: int = 3, size: tuple[int, int] = SIZE) -> np.ndarray:
    """float32 [pairs,H,W,2]: smooth, different in every pair and component."""
    y, x = np.mgrid[: size[1], : size[0]].astype(np.float32)
    one = np.stack([2 + 0.05 * x, -1 + 0.03 * y + 0.01 * x], axis=-1)
    return np.stack([one * (t + 1) for t in range(pairs)])


def some_confidence(pairs: int = 3) -> np.ndarray:
    """float32 [pairs,H,W] in steps of 1/8, which half precision holds."""
    return np.random.default_rng(0).integers(0, 9, (pairs, SIZE[1], SIZE[0])).astype(np.float32) / 8


@pytest.mark.parametrize("format", ["flo", "exr", "npz"])
def test_what_is_written_is_read_again_exactly(tmp_path, format):
    flow, trust = some_flow(), some_confidence()
    for t in range(3):
        path = write_flow(tmp_path, t, flow[t], trust[t], format)
        assert path.name == f"flow.{1001 + t}.{format}"
    read = read_flow(tmp_path, SIZE, 3)
    np.testing.assert_array_equal(read.displacement, flow)
    np.testing.assert_array_equal(read.confidence, np.ones_like(trust) if format == "flo" else trust)


def test_opencv_reads_our_flo_and_we_read_the_flo_of_opencv(tmp_path):
    flow = some_flow(1)[0]
    np.testing.assert_array_equal(cv2.readOpticalFlow(str(write_flow(tmp_path, 0, flow, None))), flow)
    assert cv2.writeOpticalFlow(str(tmp_path / "theirs.flo"), flow)
    np.testing.assert_array_equal(read_flo(tmp_path / "theirs.flo"), flow)


def test_v_of_a_forward_layer_points_up_and_that_of_others_down(tmp_path):
    falling = np.zeros((SIZE[1], SIZE[0], 2), np.float32)
    falling[..., 1] = 3.0  # down in the picture
    written = read_channels(write_flow(tmp_path, 0, falling, None, "exr"))
    assert (written["forward.v"] == -3.0).all(), "Nuke counts rows from below"
    for names, v, down in [
        (("forward.u", "forward.v"), -3.0, 3.0),
        (("main.forward.u", "main.forward.v"), -3.0, 3.0),
        (("u", "v"), 3.0, 3.0),
        (("R", "G"), 3.0, 3.0),
        (("motion.x", "motion.y"), 3.0, 3.0),
    ]:
        zero = np.zeros(SIZE[::-1], np.float32)
        path = write_channels(
            tmp_path / "one.exr", {names[0]: zero + 1, names[1]: zero + v, "A": zero, "backward.u": zero}
        )
        read = read_flow(path, SIZE, 1)
        assert (read.displacement[0] == [1.0, down]).all(), names
        turned = read_flow(path, SIZE, 1, layout=FlowLayout(v_up=names[0].endswith("forward.u") is False))
        assert (turned.displacement[0, ..., 1] == -down).all(), names


def test_the_forward_layer_wins_and_backward_alone_is_refused(tmp_path):
    zero = np.zeros(SIZE[::-1], np.float32)
    path = write_channels(tmp_path / "a.exr", {"R": zero + 9, "G": zero + 9, "forward.u": zero + 2, "forward.v": zero})
    assert (read_flow(path, SIZE, 1).displacement[0, ..., 0] == 2).all()
    path = write_channels(tmp_path / "b.exr", {"backward.u": zero, "backward.v": zero})
    with pytest.raises(InputRejected, match=r"backward\.u.*name the two that hold"):
        read_flow(path, SIZE, 1)
    layout = FlowLayout(channels=("backward.u", "backward.v"), scale=-1.0, v_up=True)
    assert read_flow(path, SIZE, 1, layout=layout).displacement.shape == (1, 23, 37, 2)


def test_vectors_to_and_from_a_frame_in_one_layer_are_not_guessed_at(tmp_path):
    """Blender's pass: which two of the four, and their sign, the user must say."""
    zero = np.zeros(SIZE[::-1], np.float32)
    names = {f"ViewLayer.Vector.{c}": zero + k for k, c in enumerate("XYZW")}
    path = write_channels(tmp_path / "a.exr", names)
    with pytest.raises(InputRejected, match="name the two that hold"):
        read_flow(path, SIZE, 1)
    layout = FlowLayout(channels=("ViewLayer.Vector.Z", "ViewLayer.Vector.W"), scale=-1.0, v_up=True)
    assert (read_flow(path, SIZE, 1, layout=layout).displacement[0] == [-2.0, 3.0]).all()


def test_a_file_written_here_opens_in_openexr_itself(tmp_path):
    pytest.importorskip("OpenEXR", reason="the reference reader OpenEXR is not installed")
    flow, trust = some_flow(1)[0], some_confidence(1)[0]
    path = write_flow(tmp_path, 0, flow, trust, "exr")
    code = (  # in a process of its own: what a foreign library does to this one stays out of the tests
        "import OpenEXR, numpy, sys\n"
        "c = OpenEXR.File(sys.argv[1], separate_channels=True).channels()\n"
        "numpy.savez(sys.argv[2], **{k: v.pixels for k, v in c.items()})"
    )
    subprocess.run([sys.executable, "-c", code, str(path), str(tmp_path / "c.npz")], check=True)
    theirs = np.load(tmp_path / "c.npz")
    np.testing.assert_array_equal(theirs["forward.u"], flow[..., 0])
    np.testing.assert_array_equal(theirs["forward.v"], -flow[..., 1])
    np.testing.assert_array_equal(theirs["confidence"], trust)


def test_flow_at_the_size_of_the_source_is_scaled_in_length_too(tmp_path):
    """A motion of one hundredth of the picture stays one, whatever the number of pixels."""
    big = (SIZE[0] * 4, SIZE[1] * 4)
    flow = np.empty((big[1], big[0], 2), np.float32)
    flow[:] = [0.01 * big[0], -0.02 * big[1]]
    flow[:, : big[0] // 2][:7] = np.nan  # a hole must not pull its surroundings to zero
    write_flow(tmp_path, 0, flow, None)
    found = open_flow(tmp_path, SIZE, 1)
    displacement, trust = found.pair(0)
    assert "resampled" in found.warnings[0] and displacement.shape == (23, 37, 2)
    np.testing.assert_allclose(displacement[trust > 0], [[0.37, -0.46]] * int((trust > 0).sum()), rtol=1e-5)  # float32
    assert trust[0, 0] == 0 and trust[1, 0] == pytest.approx(0.25) and trust[-1, -1] == 1  # 7 of 8 rows lack


def test_enlarged_flow_of_a_rotation_is_still_a_rotation():
    y, x = np.mgrid[:40, :60].astype(np.float32) + 0.5
    spin = np.stack([-(y - 20), x - 30], axis=-1) * np.float32(0.02)
    large, trust = resized_flow(spin, np.ones((40, 60), np.float32), (120, 80))
    y, x = np.mgrid[:80, :120].astype(np.float32) + 0.5
    inner = (slice(2, -2), slice(2, -2))  # beyond the outer pixel centres there is nothing to interpolate
    exact = np.stack([-(y - 40), x - 60], axis=-1) * 0.02
    np.testing.assert_allclose(large[inner], exact[inner], atol=1e-4)  # OpenCV's weights have 11 bits
    assert (trust == 1).all()


def test_another_shape_is_refused_with_both_sizes(tmp_path):
    write_flow(tmp_path, 0, some_flow(1, (40, 23))[0], None)
    with pytest.raises(InputRejected, match=r"40 x 23 px.*37 x 23"):
        read_flow(tmp_path, SIZE, 1)


def test_a_later_file_of_another_shape_is_refused_by_name(tmp_path):
    write_flow(tmp_path, 0, some_flow(1)[0], None)
    write_flow(tmp_path, 1, some_flow(1, (20, 23))[0], None)
    flow = open_flow(tmp_path, SIZE, 2)
    with pytest.raises(InputRejected, match=r"flow\.1002\.flo.*20 x 23"):
        flow.pair(1)


def test_a_missing_pair_is_named_with_its_frame(tmp_path):
    flow = some_flow(1)[0]
    for t in (0, 1, 3):
        write_flow(tmp_path, t, flow, None)
    with pytest.raises(InputRejected, match=r"3 flow file.*from frame 2 to 3 \(number 1003\).*4 pairs"):
        read_flow(tmp_path, SIZE, 4)
    with pytest.raises(InputRejected, match="from frame 1 to 2"):
        read_flow(tmp_path / "flow.1001.flo", SIZE, 2)
    np.save(tmp_path / "clip.npy", some_flow(3))
    with pytest.raises(InputRejected, match=r"3 pair.*from frame 3 to 4.*5 pairs"):
        read_flow(tmp_path / "clip.npy", SIZE, 5)


def test_a_trimmed_clip_takes_the_pairs_of_its_own_frames(tmp_path):
    flow = some_flow(4)
    for t in range(4):
        write_flow(tmp_path / "files", t, flow[t], None)
    np.savez(tmp_path / "clip.npz", flow=flow)
    for path in ("files", "files/flow.%04d.flo", "files/flow.####.flo", "clip.npz"):
        np.testing.assert_array_equal(read_flow(tmp_path / path, SIZE, 2, start=1).displacement, flow[1:3])
    layout = FlowLayout(first_number=1002)
    np.testing.assert_array_equal(read_flow(tmp_path / "files", SIZE, 2, layout=layout).displacement, flow[1:3])


@pytest.mark.parametrize("name", ["flow", "displacement", "anything"])
@pytest.mark.parametrize("first", [False, True], ids=["channels last", "channels first"])
def test_arrays_of_a_clip_are_read_with_their_confidence(tmp_path, name, first):
    flow, trust = some_flow(), some_confidence()
    stored = np.moveaxis(flow, 3, 1) if first else flow
    np.savez(tmp_path / "a.npz", **{name: stored, "confidence": trust})
    read = read_flow(tmp_path / "a.npz", SIZE, 3)
    np.testing.assert_array_equal(read.displacement, flow)
    np.testing.assert_array_equal(read.confidence, trust)
    np.save(tmp_path / "a.npy", stored[1])
    np.testing.assert_array_equal(read_flow(tmp_path / "a.npy", SIZE, 1).displacement[0], flow[1])


def test_what_is_not_known_has_no_confidence_and_no_motion(tmp_path):
    flow = some_flow(1)[0]
    flow[0, 0] = np.nan
    flow[1, 1] = np.inf, 0
    flow[2, 2] = 1e10, 1e10  # Middlebury's marker
    flow[3, 3] = 60, 0  # longer than the diagonal of 43.6 px
    np.save(tmp_path / "a.npy", flow)
    read = read_flow(tmp_path / "a.npy", SIZE, 1)
    gone = np.zeros(SIZE[::-1], bool)
    gone[range(4), range(4)] = True
    np.testing.assert_array_equal(read.confidence[0] == 0, gone)
    assert (read.displacement[0][gone] == 0).all() and np.isfinite(read.displacement).all()
    layout = FlowLayout(scale=1e-6)
    assert read_flow(tmp_path / "a.npy", SIZE, 1, layout=layout).confidence[0, 2, 2] == 0, "the marker is no length"


def test_kitti_pictures_are_flow(tmp_path):
    flow = np.round(some_flow(1)[0] * 64) / 64
    valid = np.random.default_rng(1).random(SIZE[::-1]) < 0.7
    coded = np.dstack([valid, flow[..., 1] * 64 + 2**15, flow[..., 0] * 64 + 2**15]).astype(np.uint16)  # OpenCV: BGR
    cv2.imwrite(str(tmp_path / "000000_10.png"), coded)
    read = read_flow(tmp_path / "000000_10.png", SIZE, 1)
    np.testing.assert_array_equal(read.confidence[0] > 0, valid)
    np.testing.assert_array_equal(read.displacement[0][valid], flow[valid])


def damaged(folder: Path) -> dict[str, tuple[str, bytes | object]]:
    """File name by reason: what must be refused."""
    whole = write_flow(folder / "good", 0, some_flow(1)[0], None).read_bytes()
    return {
        "cut.flo": ("bytes.*6820 bytes", whole[:-5]),
        "long.flo": ("6820 bytes", whole + b"x"),
        "huge.flo": ("100000 x 100000", b"PIEH" + np.array([100000, 100000], "<i4").tobytes() + b"0" * 64),
        "negative.flo": ("-3 x", b"PIEH" + np.array([-3, -3], "<i4").tobytes() + b"0" * 64),
        "other.flo": ("does not begin", b"RIFF" + whole[4:]),
        "text.npz": ("cannot be read", b"hello"),
        "cut.npy": (
            "cannot be read",
            b"\x93NUMPY\x01\x00v\x00{'descr': '<f4', 'fortran_order': False, 'shape': (9, 9, 2), }",
        ),
        "flow.mp4": ("no flow of a known kind", b"hello"),
        "empty.flo": ("empty", b""),
    }


def test_damaged_and_hostile_files_are_refused(tmp_path):
    for name, (reason, data) in damaged(tmp_path).items():
        (tmp_path / name).write_bytes(data)
        with pytest.raises(InputRejected, match=reason):
            read_flow(tmp_path / name, SIZE, 1)
    np.savez(tmp_path / "pickled.npz", flow=np.array([{"run": "me"}], object))
    np.savez_compressed(tmp_path / "bomb.npz", flow=np.zeros((1, 400, 400, 2), np.float32))
    np.savez(tmp_path / "two.npz", a=np.zeros(2), b=np.zeros(2))
    np.savez(tmp_path / "words.npz", flow=np.array(["a", "b"]))
    np.savez(tmp_path / "nothing.npz", flow=np.full((23, 37, 2), np.nan))
    limits = ReadLimits(max_bytes=100_000)
    for name, reason in {
        "pickled.npz": "cannot be read", "bomb.npz": "unpacks to too much", "two.npz": "holds a, b",
        "words.npz": "numbers", "nothing.npz": "no usable flow",
    }.items():  # fmt: skip
        with pytest.raises(InputRejected, match=reason):
            read_flow(tmp_path / name, SIZE, 1, limits=limits)


def test_folders_that_are_not_one_sequence_are_refused(tmp_path):
    flow = some_flow(1)[0]
    (tmp_path / "none").mkdir()
    write_flow(tmp_path / "mixed", 0, flow, None, "flo")
    write_flow(tmp_path / "mixed", 1, flow, None, "exr")
    for t in (0, 1):
        write_flow(tmp_path / "twice", t, flow, None)
    (tmp_path / "twice" / "flow.1002.flo").rename(tmp_path / "twice" / "other.1001.flo")
    for name, reason in {"none": "holds no flow", "mixed": "several kinds", "twice": "same number"}.items():
        with pytest.raises(InputRejected, match=reason):
            read_flow(tmp_path / name, SIZE, 1)
    with pytest.raises(InputRejected, match="no such folder"):
        read_flow(tmp_path / "nowhere" / "%04d.flo", SIZE, 1)


def test_a_clip_that_does_not_fit_in_memory_is_still_read_pair_by_pair(tmp_path):
    np.save(tmp_path / "clip.npy", some_flow(6))
    tight = ReadLimits(max_bytes=20_000)
    flow = open_flow(tmp_path / "clip.npy", SIZE, 6, limits=tight)
    assert len(flow) == 6
    np.testing.assert_array_equal(flow.pair(5)[0], some_flow(6)[5])
    np.testing.assert_array_equal(flow.window(2, 4).displacement, some_flow(6)[2:4])
    with pytest.raises(IndexError):
        flow.pair(6)
