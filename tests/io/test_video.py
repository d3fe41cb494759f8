"""A clip comes in with its real times, upright, in sRGB; anything that is no clip is refused with a reason."""

from __future__ import annotations

import os
import struct
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
import pytest

from fluidlift.errors import InputRejected
from fluidlift.io.limits import ReadLimits
from fluidlift.io.pictures import write_png
from fluidlift.io.stage_cache import Scratch
from fluidlift.io.video import frames_before, probe, read_clip, write_video
from fluidlift.messages import code_of


def rejected(path, *words: str, **options) -> InputRejected:
    """The refusal, which must contain all words."""
    with pytest.raises(InputRejected) as caught:
        read_clip(path, **options)
    text = str(caught.value)
    for word in words:
        assert word in text, text
    return caught.value


def test_frames_and_times_come_back(make_video, clip_frames):
    clip = read_clip(make_video())
    assert clip.frames.shape == (10, 48, 64, 3)
    np.testing.assert_allclose(clip.times, 0.04 * np.arange(10), atol=1e-9)  # time stamps are exact fractions
    # x264's default quality and 4:2:0 colour leave a few levels of error on average
    assert np.abs(clip.frames.astype(int) - clip_frames(10)).mean() < 6
    assert clip.source == "clip.mp4" and clip.alpha is None and clip.warnings == ()


def test_variable_frame_rate_keeps_its_times(make_video):
    times = [0, 20, 90, 130, 250, 260, 300, 420, 440, 500]
    clip = read_clip(make_video(times_ms=times))
    np.testing.assert_allclose(clip.times, np.array(times) / 1000, atol=1e-9)
    assert "variable-frame-rate" in map(code_of, clip.warnings)
    assert probe(make_video(times_ms=times)).variable_frame_rate


def test_start_and_duration_select_by_time(make_video):
    clip = read_clip(make_video(), start=0.08, duration=0.12)
    np.testing.assert_allclose(clip.times, [0.08, 0.12, 0.16], atol=1e-9)


def test_a_late_start_in_a_long_clip_seeks_to_the_same_frames(make_video, clip_frames):
    frames = np.concatenate([clip_frames(25)] * 12)
    path = make_video(frames=frames, options={"g": "25"})
    clip = read_clip(path, start=10.4, duration=0.2)
    np.testing.assert_allclose(clip.times, 10.4 + 0.04 * np.arange(5), atol=1e-9)
    whole = read_clip(path)
    np.testing.assert_array_equal(clip.frames, whole.frames[260:265])


def test_frames_are_scaled_down_by_area_and_never_up(make_video, clip_frames):
    path = make_video(frames=clip_frames(4, (128, 96)))
    small = read_clip(path, max_size=64)
    full = read_clip(path, max_size=512)
    assert small.size == (64, 48) and full.size == (128, 96)
    boxes = full.frames.reshape(4, 48, 2, 64, 2, 3).mean(axis=(2, 4))
    assert np.abs(small.frames - boxes).max() <= 1.0  # rounding


@pytest.mark.parametrize("turn", [90, 180, 270])
def test_rotation_metadata_sets_the_picture_upright(make_video, turn):
    path = make_video()
    stored = read_clip(path).frames
    _rotate_mp4(path, turn)
    clip = read_clip(path)
    np.testing.assert_array_equal(clip.frames, np.rot90(stored, -turn // 90, axes=(1, 2)))
    info = probe(path)
    assert info.size == clip.size and info.rotation % 360 == -turn % 360


def _rotate_mp4(path: Path, clockwise: int) -> None:
    """Put a rotation into the display matrix of the track header, as phones do."""
    data = bytearray(path.read_bytes())
    at = data.find(b"tkhd") + 4 + 4 + 20 + 8 + 8  # version and flags, times and ids, reserved, layer and volume
    c, s = {90: (0, 1), 180: (-1, 0), 270: (0, -1)}[clockwise]
    data[at : at + 36] = struct.pack(">9i", c << 16, s << 16, 0, -s << 16, c << 16, 0, 0, 0, 1 << 30)
    path.write_bytes(data)


def test_pixels_that_are_not_square_become_square(make_video):
    assert read_clip(make_video(aspect=Fraction(2, 1))).size == (128, 48)


@pytest.mark.parametrize(
    ("name", "codec", "pix_fmt"), [("a.webm", "libvpx-vp9", "yuva420p"), ("a.mov", "qtrle", "argb")]
)
def test_alpha_is_kept(make_video, clip_frames, name, codec, pix_fmt):
    clip = read_clip(make_video(name, clip_frames(5, channels=4), codec=codec, pix_fmt=pix_fmt))
    assert clip.alpha is not None
    assert clip.alpha[:, 12:28, 12:28].min() > 250 and clip.alpha[:, :8].max() < 5  # lossy by a few levels
    assert probe(make_video(name, clip_frames(5, channels=4), codec=codec, pix_fmt=pix_fmt)).alpha


def test_transparent_pixels_do_not_bleed_into_smaller_frames(make_video):
    frames = np.zeros((3, 64, 64, 4), np.uint8)
    frames[..., 0] = 255  # transparent red
    frames[:, 16:49, 16:49] = (0, 0, 255, 255)  # opaque blue, with an edge inside a pixel of the small frame
    frames[1:, 20, 20, 1] = (9, 90)
    clip = read_clip(make_video("b.mov", frames, codec="qtrle", pix_fmt="argb"), max_size=32)
    inside = clip.alpha > 10
    assert clip.frames[..., 0][inside].max() <= 1


def test_gif_is_a_clip(make_video):
    clip = read_clip(make_video("a.gif", codec="gif", pix_fmt="rgb8"))
    assert len(clip) == 10 and clip.alpha is None
    np.testing.assert_allclose(clip.times, 0.04 * np.arange(10), atol=1e-9)


@pytest.mark.parametrize("form", ["folder", "printf", "hashes"])
def test_numbered_pictures_are_a_clip(tmp_path, clip_frames, form):
    frames = clip_frames(4)
    for i, picture in enumerate(frames):
        write_png(tmp_path / "shot" / f"water_{7 + i:04d}.png", picture)
    pattern = {"folder": "", "printf": "water_%04d.png", "hashes": "water_####.png"}[form]
    clip = read_clip(tmp_path / "shot" / pattern, fps=50)
    np.testing.assert_array_equal(clip.frames, frames)
    np.testing.assert_allclose(clip.times, np.arange(4) / 50)
    info = probe(tmp_path / "shot" / pattern, fps=50)
    assert info.frame_count == 4 and info.size == (64, 48) and info.fps == 50


def test_a_gap_in_the_numbers_is_time(tmp_path, clip_frames):
    for number, picture in zip((1, 2, 5), clip_frames(3)):
        write_png(tmp_path / f"{number}.png", picture)
    clip = read_clip(tmp_path, fps=10)
    np.testing.assert_allclose(clip.times, [0, 0.1, 0.4])
    assert "numbers-missing" in map(code_of, clip.warnings)


def test_pictures_with_alpha_and_16_bits(tmp_path, clip_frames):
    for i, picture in enumerate(clip_frames(2, channels=4)):
        write_png(tmp_path / f"{i}.png", picture.astype(np.uint16) * 257)
    clip = read_clip(tmp_path, fps=10)
    np.testing.assert_array_equal(clip.alpha, clip_frames(2, channels=4)[..., 3])


def test_pictures_need_a_frame_rate(tmp_path, clip_frames):
    write_png(tmp_path / "0.png", clip_frames(1)[0])
    rejected(tmp_path, "--fps")


def test_high_dynamic_range_is_tone_mapped(make_video):
    # PQ code 0.58 is 203 cd/m^2, diffuse white (BT.2408); 0.0 is black
    frames = np.zeros((3, 48, 64, 3), np.uint16)
    frames[:, :, 32:] = round(0.58 * 65535)
    frames[1, 0, 0] = 30000
    tags = {"color_trc": 16, "color_primaries": 9, "colorspace": 9}
    path = make_video("hdr.mp4", frames, codec="libx265", pix_fmt="yuv420p10le", tags=tags)
    clip = read_clip(path)
    assert "tone-mapped" in map(code_of, clip.warnings) and probe(path).hdr
    white = clip.frames[2, 24, 48].astype(int)
    # the curve bends at half of white: white lands between the knee (188) and the top
    assert white.min() > 200 and np.ptp(white) <= 3 and clip.frames[2, 24, 8].max() < 5


def test_damaged_packets_in_the_middle_are_left_out(make_video, clip_frames):
    path = make_video("clip.mp4", np.concatenate([clip_frames(10)] * 3), options={"g": "1"})
    data = bytearray(path.read_bytes())
    start, end = data.find(b"mdat") + 4, data.find(b"moov") - 4
    third = (end - start) // 3
    data[start + third : start + 2 * third] = bytes(third)
    path.write_bytes(data)
    clip = read_clip(path)
    assert 10 <= len(clip) < 30 and {"frames-damaged", "file-cut-off"} & set(map(code_of, clip.warnings))
    assert set(np.round(clip.times / 0.04).astype(int)) < set(range(30))


def test_a_file_cut_off_after_its_index_gives_what_is_there(make_video, clip_frames):
    path = make_video("clip.mkv", np.concatenate([clip_frames(10)] * 3))
    path.write_bytes(path.read_bytes()[: path.stat().st_size * 2 // 3])
    clip = read_clip(path)
    assert 2 <= len(clip) < 30


def test_a_missing_file_is_named_and_similar_names_offered(make_video, tmp_path):
    make_video("river.mp4")
    rejected(tmp_path / "rivr.mp4", "no such video", "river.mp4")


def test_an_empty_file_is_refused(tmp_path):
    (tmp_path / "a.mp4").write_bytes(b"")
    rejected(tmp_path / "a.mp4", "empty")


def test_text_is_refused(tmp_path):
    (tmp_path / "a.mp4").write_text("Dear reader\n")
    rejected(tmp_path / "a.mp4", "text file")


@pytest.mark.parametrize(
    "text",
    [
        "ffconcat version 1.0\nfile 'clip.mp4'\n",
        "#EXTM3U\n#EXT-X-TARGETDURATION:1\n#EXTINF:1,\nclip.mp4\n#EXT-X-ENDLIST\n",
        "#!/bin/sh\necho\n",
    ],
)
def test_playlists_do_not_open_other_files(make_video, tmp_path, text):
    make_video("clip.mp4")
    (tmp_path / "list.mp4").write_text(text)
    rejected(tmp_path / "list.mp4", "playlist or script")


def test_random_bytes_are_refused(tmp_path):
    (tmp_path / "a.mp4").write_bytes(np.random.default_rng(0).bytes(4000))
    rejected(tmp_path / "a.mp4", "not a video")


def test_a_truncated_mp4_is_refused(make_video):
    path = make_video()
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 3])
    rejected(path, "damaged or cut off")


def test_one_picture_is_refused(tmp_path, clip_frames):
    rejected(write_png(tmp_path / "a.png", clip_frames(1)[0]), "one picture", "folder")


def test_an_unknown_codec_is_refused(make_video):
    path = make_video()
    path.write_bytes(path.read_bytes().replace(b"avc1", b"zzz9").replace(b"avcC", b"zzzC"))
    rejected(path, "codec")


def test_sound_alone_is_refused(tmp_path):
    path = tmp_path / "a.mp4"
    with av.open(str(path), "w") as container:
        stream = container.add_stream("aac", rate=44100)
        frame = av.AudioFrame.from_ndarray(np.zeros((1, 1024), np.float32), "fltp", "mono")
        frame.sample_rate, frame.pts = 44100, 0
        for packet in (*stream.encode(frame), *stream.encode()):
            container.mux(packet)
    rejected(path, "no video stream", "audio")


def test_one_frame_is_refused(make_video, clip_frames):
    rejected(make_video(frames=clip_frames(1)), "only one frame", "at least two frames")


def test_a_start_past_the_end_is_refused(make_video):
    rejected(make_video(), "past the end", "0.360", start=5.0)
    rejected(make_video(), "past the end", start=50.0)


@pytest.mark.parametrize("options", [{"start": -1.0}, {"start": float("nan")}, {"duration": 0.0}])
def test_times_that_make_no_sense_are_refused(make_video, options):
    rejected(make_video(), "Needed", **options)


def test_limits_name_the_option_that_raises_them(make_video):
    rejected(make_video(), "read.max_pixels", limits=ReadLimits(max_pixels=1000))
    rejected(make_video(), "read.max_frames", limits=ReadLimits(max_frames=5))
    rejected(make_video(), "--max-bytes", limits=ReadLimits(max_bytes=20000))


def test_an_asset_in_the_place_of_a_clip_is_told_to_be_one(tmp_path):
    for name in ("manifest.json", "scene.yaml"):
        (tmp_path / name).write_text("{}")
    write_png(tmp_path / "mask_overlay.png", np.zeros((8, 8, 3), np.uint8))
    with pytest.raises(InputRejected, match=r"is an asset, not a clip\..*fluidlift view"):
        read_clip(tmp_path, fps=25.0)


def test_a_folder_without_pictures_is_refused(tmp_path):
    rejected(tmp_path, "holds no pictures", fps=25)


def test_probe_tells_what_the_clip_is(make_video):
    info = probe(make_video())
    assert (info.size, info.frame_count, info.fps, info.codec) == ((64, 48), 10, 25.0, "h264")
    assert info.duration == pytest.approx(0.4) and not info.variable_frame_rate and not info.hdr
    assert info.to_dict()["size"] == [64, 48]


def test_written_video_has_its_rate_and_colours(tmp_path):
    colors = np.array([[200, 30, 40], [30, 180, 60], [40, 60, 210], [128, 128, 128]], np.uint8)
    frame = np.repeat(np.repeat(colors[None], 31, axis=0), 15, axis=1)  # 31 x 60: an odd height
    path = write_video(tmp_path / "out.mp4", (frame for _ in range(6)), 30000 / 1001)
    clip = read_clip(path)
    assert clip.frames.shape == (6, 32, 60, 3)
    np.testing.assert_allclose(clip.times, np.arange(6) * 1001 / 30000, atol=1e-4)  # container ticks
    middle = clip.frames[3, 16, 7::15].astype(int)
    assert np.abs(middle - colors).max() <= 6  # 8-bit limited-range YUV rounds by about 2, x264 adds a little
    assert [p.name for p in tmp_path.iterdir()] == ["out.mp4"]


@pytest.mark.skipif(not hasattr(os, "sched_setaffinity"), reason="processors cannot be taken away here")
def test_a_repeatable_video_is_the_same_on_one_processor(tmp_path):
    noise = np.random.default_rng(0).integers(0, 255, (60, 80, 3), np.uint8).repeat(4, axis=0).repeat(4, axis=1)
    frames = [np.roll(noise, 3 * t, axis=1) for t in range(12)]
    processors = os.sched_getaffinity(0)
    if len(processors) < 2:
        pytest.skip("one processor")
    several = write_video(tmp_path / "several.mp4", frames, 25, repeatable=True)
    try:
        os.sched_setaffinity(0, {min(processors)})
        one = write_video(tmp_path / "one.mp4", frames, 25, repeatable=True)
    finally:
        os.sched_setaffinity(0, processors)
    assert one.read_bytes() == several.read_bytes()


def test_a_repeatable_video_is_the_same_every_time(tmp_path):
    """Previews once came out as one of four files, by the rounding of x264's macroblock tree with AVX-512."""
    rng = np.random.default_rng(0)
    texture = np.repeat(np.repeat(rng.integers(40, 220, (16, 90, 3), np.uint8), 4, axis=0), 4, axis=1)
    frames = [texture[:, 4 * t : 288 + 4 * t] for t in range(10)]
    files = [write_video(tmp_path / f"{n}.mp4", frames, 25, repeatable=True).read_bytes() for n in range(20)]
    assert len(set(files)) == 1


def test_a_failed_video_leaves_nothing_behind(tmp_path):
    def frames():
        yield np.zeros((32, 32, 3), np.uint8)
        raise RuntimeError("the renderer broke")

    with pytest.raises(RuntimeError):
        write_video(tmp_path / "out.mp4", frames(), 25)
    assert list(tmp_path.iterdir()) == []
    with pytest.raises(ValueError, match="no frames"):
        write_video(tmp_path / "out.mp4", [], 25)


@pytest.fixture
def woven_frames():
    """u8 [8,96,160,3]: a texture that goes 3 px to the right per instant, two instants in alternate rows."""
    rng = np.random.default_rng(0)
    grey = np.repeat(np.repeat(rng.integers(40, 220, (24, 60)), 4, axis=0), 4, axis=1).astype(np.uint8)
    instants = [np.repeat(grey[:, 60 - 3 * t : 220 - 3 * t, None], 3, axis=-1) for t in range(16)]
    frames = np.stack(instants[::2])
    frames[:, 1::2] = np.stack(instants[1::2])[:, 1::2]
    return frames, np.stack(instants[::2])


def test_of_interlaced_frames_one_instant_is_used(make_video, woven_frames):
    woven, first = woven_frames
    clip = read_clip(make_video(frames=woven, options={"crf": "6"}))
    assert clip.size == (160, 96) and "interlaced" in map(code_of, clip.warnings)
    assert "interlaced" in map(code_of, probe(make_video(frames=woven, options={"crf": "6"})).warnings)
    # rows that were left out are interpolated: squares of 4 px keep their sides, their upper edges move by a pixel
    inside = np.abs(clip.frames[3].astype(int) - first[3])[1::4]
    assert np.median(inside) < 6  # levels, of the compression


def test_whole_frames_are_not_taken_for_interlaced(make_video, woven_frames):
    clip = read_clip(make_video(frames=woven_frames[1], options={"crf": "6"}))
    assert "interlaced" not in map(code_of, clip.warnings)


def test_frames_in_a_store_are_those_in_memory(make_video, tmp_path):
    path = make_video()
    stored = read_clip(path, store=Scratch(tmp_path, "read"), limits=ReadLimits(max_bytes=1000))
    assert isinstance(stored.frames, np.memmap)
    np.testing.assert_array_equal(stored.frames, read_clip(path).frames)


@pytest.mark.parametrize(("start", "frames"), [(0.0, 0), (0.08, 2), (0.1, 3)])
def test_frames_before_the_start_are_counted_without_decoding(make_video, start, frames):
    assert frames_before(make_video(), start, 25.0) == frames


def test_a_video_that_is_taken_away_while_it_is_opened_is_refused(tmp_path, monkeypatch):
    """A page asks for the preview of an asset that is being made again."""
    path = write_video(tmp_path / "clip.mp4", np.zeros((4, 32, 48, 3), np.uint8), 25.0)
    opened = av.open

    def gone(*args, **kwargs):
        path.unlink()
        return opened(*args, **kwargs)

    monkeypatch.setattr(av, "open", gone)
    with pytest.raises(InputRejected, match="cannot be read"):
        probe(path)
