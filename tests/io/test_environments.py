"""Panoramas of light from files: what is read is what was meant, and what is none is told so."""

import zlib

import cv2
import numpy as np
import pytest

from fluidlift.errors import InputRejected
from fluidlift.io.environments import read_environment_image
from fluidlift.io.exr_write import write_channels
from fluidlift.io.limits import ReadLimits

HEADER = b"#?RADIANCE\n# a comment\nFORMAT=32-bit_rle_rgbe\n\n"


def panorama(rows: int = 16, seed: int = 0) -> np.ndarray:
    """Light over six orders of magnitude."""
    rng = np.random.default_rng(seed)
    return (rng.uniform(0.5, 1, (rows, 2 * rows, 3)) * 10 ** rng.uniform(-3, 3, (rows, 2 * rows, 1))).astype(np.float32)


def rgbe(picture: np.ndarray) -> np.ndarray:
    mantissa, exponent = np.frexp(picture.max(axis=2))
    scaled = picture * (mantissa * 256 / np.maximum(picture.max(axis=2), 1e-30))[..., None]
    return np.concatenate([scaled.astype(np.uint8), (exponent + 128).astype(np.uint8)[..., None]], axis=2)


def packed(pixels: np.ndarray) -> bytes:
    """Run lengths: runs of four or more, everything else as it is."""
    out = bytearray()
    for row in pixels:
        out += bytes((2, 2, len(row) >> 8, len(row) & 255))
        for channel in row.T:
            at = 0
            while at < len(channel):
                same = 1
                while at + same < len(channel) and same < 127 and channel[at + same] == channel[at]:
                    same += 1
                if same >= 4:
                    out += bytes((128 + same, channel[at]))
                    at += same
                else:
                    some = channel[at : at + 3]
                    out += bytes((len(some), *some))
                    at += len(some)
    return bytes(out)


def hdr(path, pixels: np.ndarray, body: bytes | None = None, size: bytes | None = None, header: bytes = HEADER):
    size = size or b"-Y %d +X %d\n" % pixels.shape[:2]
    path.write_bytes(header + size + (pixels.tobytes() if body is None else body))
    return path


@pytest.mark.parametrize("way", [lambda p: p.tobytes(), packed], ids=["plain", "run lengths"])
def test_a_radiance_picture_is_read_as_it_was_meant(tmp_path, way):
    light = panorama()
    light[4:8] = light[4, 0]  # something to run
    light[0, 0] = 0
    pixels = rgbe(np.maximum(light, 1e-9))
    pixels[0, 0] = 0
    read = read_environment_image(hdr(tmp_path / "sky.hdr", pixels, way(pixels)))
    assert read.dtype == np.float32
    # eight bits of mantissa, of the brightest channel of each pixel
    assert (np.abs(read - light) <= light.max(axis=2, keepdims=True) / 128).all()
    assert (read[0, 0] == 0).all()


def test_opencv_writes_what_is_read(tmp_path):
    """A writer that is not ours."""
    light = panorama(32)
    light[:10] = 0.25
    assert cv2.imwrite(str(tmp_path / "a.hdr"), light[..., ::-1])
    theirs = cv2.imread(str(tmp_path / "a.hdr"), cv2.IMREAD_UNCHANGED)[..., ::-1]
    np.testing.assert_allclose(read_environment_image(tmp_path / "a.hdr"), theirs, rtol=1e-6)


def test_pictures_that_run_the_other_way_are_turned(tmp_path):
    pixels = rgbe(panorama(4))
    straight = read_environment_image(hdr(tmp_path / "a.hdr", pixels))
    turned = read_environment_image(hdr(tmp_path / "b.hdr", pixels, size=b"+Y 4 -X 8\n"))
    np.testing.assert_array_equal(turned, straight[::-1, ::-1])


def test_an_openexr_panorama_is_read_by_its_content(tmp_path):
    light = panorama()
    path = write_channels(tmp_path / "sky.bin", dict(zip("RGB", np.moveaxis(light, 2, 0))))
    np.testing.assert_array_equal(read_environment_image(path), light)
    grey = write_channels(tmp_path / "grey.exr", {"Y": light[..., 0]})
    np.testing.assert_array_equal(read_environment_image(grey), light[..., :1].repeat(3, axis=2))
    with pytest.raises(InputRejected, match="channels U, V"):
        read_environment_image(write_channels(tmp_path / "uv.exr", {"U": light[..., 0], "V": light[..., 0]}))


@pytest.mark.parametrize("suffix", ["png", "jpg", "hdr"])
def test_a_picture_of_8_bits_is_no_light_whatever_its_name(tmp_path, suffix):
    kind = "jpg" if suffix == "jpg" else "png"
    data = cv2.imencode("." + kind, np.full((8, 16, 3), 200, np.uint8))[1].tobytes()
    (tmp_path / f"sky.{suffix}").write_bytes(data)
    with pytest.raises(InputRejected, match=r"cut off at white.*\.hdr"):
        read_environment_image(tmp_path / f"sky.{suffix}")


def test_every_cut_through_a_file_is_told(tmp_path):
    pixels = rgbe(panorama(8))
    for body in (packed(pixels), pixels.tobytes()):
        whole = hdr(tmp_path / "whole.hdr", pixels, body).read_bytes()
        read_environment_image(tmp_path / "whole.hdr")
        for length in (*range(1, 90, 7), len(whole) // 2, len(whole) - 1):
            (tmp_path / "cut.hdr").write_bytes(whole[:length])
            with pytest.raises(InputRejected):
                read_environment_image(tmp_path / "cut.hdr")


def test_damaged_files_never_do_worse_than_be_refused(tmp_path):
    rng = np.random.default_rng(0)
    whole = np.frombuffer(hdr(tmp_path / "a.hdr", rgbe(panorama(8)), packed(rgbe(panorama(8)))).read_bytes(), np.uint8)
    for _ in range(200):
        data = whole.copy()
        at = rng.integers(0, len(data), 3)
        data[at] = rng.integers(0, 256, 3)
        (tmp_path / "b.hdr").write_bytes(data.tobytes())
        try:
            read = read_environment_image(tmp_path / "b.hdr")
        except InputRejected:
            continue
        assert np.isfinite(read).all() and read.min() >= 0 and read.shape[1] == 2 * read.shape[0]


@pytest.mark.parametrize(
    ("light", "told"),
    [
        (np.ones((8, 12, 3)), "2:1"),
        (np.ones((2, 4, 3)), "at least"),
        (np.full((8, 16, 3), np.inf), "not finite"),
        (np.full((8, 16, 3), -1.0), "negative"),
    ],
)
def test_what_cannot_light_a_scene_is_told(tmp_path, light, told):
    path = write_channels(tmp_path / "a.exr", dict(zip("RGB", np.moveaxis(light.astype(np.float32), 2, 0))))
    with pytest.raises(InputRejected, match=told):
        read_environment_image(path)


def test_a_little_below_0_is_the_ringing_of_a_filter_and_counts_as_dark(tmp_path):
    light = np.ones((8, 16, 3), np.float32)
    light[3, 3] = -1e-3
    path = write_channels(tmp_path / "a.exr", dict(zip("RGB", np.moveaxis(light, 2, 0))))
    assert read_environment_image(path).min() == 0


def test_a_huge_panorama_is_refused_before_it_is_read(tmp_path):
    pixels = rgbe(panorama(8))
    with pytest.raises(InputRejected, match="100000 x 50000"):
        read_environment_image(hdr(tmp_path / "a.hdr", pixels, size=b"-Y 50000 +X 100000\n"))
    with pytest.raises(InputRejected, match="1 to 100 pixels"):
        read_environment_image(hdr(tmp_path / "b.hdr", pixels), limits=ReadLimits(max_pixels=100))


def test_other_files_are_told_what_is_needed(tmp_path):
    for name, data in (
        ("a.hdr", b"hello"),
        ("b.hdr", zlib.compress(b"x" * 100)),
        ("c.hdr", b"#?RADIANCE\nFORMAT=32-bit_rle_xyze\n\n-Y 4 +X 8\n" + bytes(128)),
        ("d.hdr", b"#?RADIANCE\n\n+X 8 +Y 4\n" + bytes(128)),
        ("e.hdr", b""),
    ):
        (tmp_path / name).write_bytes(data)
        with pytest.raises(InputRejected):
            read_environment_image(tmp_path / name)
    with pytest.raises(InputRejected, match="similar ones there"):
        read_environment_image(tmp_path / "aa.hdr")
    with pytest.raises(InputRejected, match="folder"):
        read_environment_image(tmp_path)
