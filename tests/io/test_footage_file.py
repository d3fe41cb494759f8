"""The film that an asset carries comes back as it was written; any other file is refused."""

import numpy as np
import pytest

from fluidlift.errors import InputRejected
from fluidlift.io import footage_file
from fluidlift.io.footage_file import LARGEST, LIMITS, MOST_FRAMES, read_footage, write_footage
from fluidlift.io.limits import ReadLimits
from fluidlift.io.video import write_video

INTERVAL = 0.04


def moving(size: tuple[int, int], count: int = 10) -> tuple[np.ndarray, np.ndarray]:
    """Pictures of smooth waves of low colour contrast (4:2:0 halves colours), and masks with a rim that moves."""
    width, height = size
    y, x = np.mgrid[:height, :width]
    t = np.arange(count)[:, None, None]
    bright = 120 + 60 * np.sin(0.35 * x + 0.3 * t) * np.cos(0.25 * y)
    frames = np.clip(bright[..., None] + [-10, 0, 10], 0, 255).astype(np.uint8)
    return frames, y > 0.4 * height + 3 * np.sin(0.2 * x + 0.5 * t)


@pytest.mark.parametrize("size", [(64, 48), (63, 48), (64, 47), (63, 47)])
def test_pictures_masks_and_rate_come_back(tmp_path, size):
    frames, fluid = moving(size)
    back, masks, interval = read_footage(write_footage(tmp_path / "rest" / "film.mp4", frames, fluid, INTERVAL), size)
    assert back.shape == frames.shape and back.dtype == np.uint8 and masks.dtype == bool
    # constant rate factor 14 on pictures without noise, and YUV of eight bits: a level or two, some more at the mask's
    # own edge, which is nowhere near the pictures but for the last row
    error = np.abs(back.astype(int) - frames)
    assert error.mean() < 2.0 and np.quantile(error, 0.999) < 12
    # ringing of the coder passes the middle grey in a pixel here and there along the rim
    assert (masks != fluid).mean() < 0.002
    assert interval == pytest.approx(INTERVAL, rel=1e-6)


def test_a_rate_that_is_no_whole_number_is_kept(tmp_path):
    frames, fluid = moving((32, 32))
    _, _, interval = read_footage(write_footage(tmp_path / "f.mp4", frames, fluid, 1001 / 30000), (32, 32))
    # time stamps of the file are whole ticks
    assert interval == pytest.approx(1001 / 30000, rel=1e-3)


def test_the_same_pictures_give_the_same_file(tmp_path):
    one, two = (write_footage(tmp_path / f"{n}.mp4", *moving((64, 48)), INTERVAL).read_bytes() for n in "ab")
    assert one == two


def test_a_clip_that_is_larger_is_carried_smaller(tmp_path, monkeypatch):
    """Whatever size a clip was read at, its film can be read back."""
    monkeypatch.setattr(footage_file, "LARGEST", 32)
    frames, fluid = moving((100, 60))
    back, masks, _ = read_footage(write_footage(tmp_path / "film.mp4", frames, fluid, INTERVAL), (100, 60))
    assert back.shape == (10, 19, 32, 3) and masks.shape == (10, 19, 32)
    boxes = np.abs(masks.mean(axis=(1, 2)) - fluid.mean(axis=(1, 2)))
    assert boxes.max() < 0.04, "the rim, 32 of 608 pixels, is known to half a pixel"
    assert abs(float(back.mean()) - float(frames.mean())) < 2.0


def test_a_film_of_another_size_is_refused(tmp_path):
    path = write_footage(tmp_path / "film.mp4", *moving((64, 48)), INTERVAL)
    for size in ((96, 64), (48, 64), (64, 96)):
        with pytest.raises(InputRejected, match="make the asset again"):
            read_footage(path, size)


def test_a_film_that_was_cut_off_is_refused(tmp_path):
    """A reader of clips takes what is there; here the missing part would be missed in every simulation to come."""
    rng = np.random.default_rng(0)
    frames = rng.integers(0, 255, (20, 48, 64, 3), np.uint8)  # noise: each frame takes some kilobytes
    path = write_footage(tmp_path / "film.mp4", frames, np.ones((20, 48, 64), bool), INTERVAL)
    whole = path.read_bytes()
    for share in (0.02, 0.5, 0.9):
        path.write_bytes(whole[: int(share * len(whole))])
        with pytest.raises(InputRejected):
            read_footage(path, (64, 48))


@pytest.mark.parametrize(
    "content", [b"", b"not a film at all\n" * 40, bytes(range(256)) * 30, b"ffconcat version 1.0\nfile /etc/passwd\n"]
)
def test_a_file_that_is_no_video_is_refused(tmp_path, content):
    path = tmp_path / "film.mp4"
    path.write_bytes(content)
    with pytest.raises(InputRejected):
        read_footage(path, (64, 48))


def test_no_file_and_a_folder_are_refused(tmp_path):
    for path in (tmp_path / "film.mp4", tmp_path):
        with pytest.raises(InputRejected):
            read_footage(path, (64, 48))


def test_the_limits_hold_the_largest_film_and_no_larger_one(tmp_path):
    rows = LARGEST + LARGEST % 2
    assert 2 * rows * LARGEST <= LIMITS.max_pixels < 4 * LARGEST**2
    # the reader counts four bytes a pixel
    assert MOST_FRAMES * 2 * rows * LARGEST * 4 <= LIMITS.max_bytes
    assert MOST_FRAMES <= LIMITS.max_frames


def test_frames_that_are_too_many_or_too_large_are_refused(tmp_path, monkeypatch):
    path = write_footage(tmp_path / "film.mp4", *moving((64, 48)), INTERVAL)
    for limits in (ReadLimits(max_frames=9), ReadLimits(max_pixels=64 * 95), ReadLimits(max_bytes=9 * 64 * 96 * 4)):
        monkeypatch.setattr(footage_file, "LIMITS", limits)
        with pytest.raises(InputRejected):
            read_footage(path, (64, 48))
    monkeypatch.setattr(footage_file, "LIMITS", LIMITS)
    monkeypatch.setattr(footage_file, "MOST_BYTES", path.stat().st_size - 1)
    with pytest.raises(InputRejected, match="bytes"):
        read_footage(path, (64, 48))


def test_a_plain_video_of_the_right_size_is_read_as_its_lower_half_says(tmp_path):
    """A stranger's file: whatever it shows, masks are masks."""
    grey = np.full((8, 96, 64, 3), 100, np.uint8)
    grey[:, 72:] = 200
    _, masks, _ = read_footage(write_video(tmp_path / "film.mp4", grey, 25.0), (64, 48))
    assert not masks[:, :22].any() and masks[:, 26:].all()  # the coder's blocks blur the edge by a pixel or two
