"""Masks, depth and cameras that a user brings fit the clip, or are refused with a reason."""

from __future__ import annotations

import json

import numpy as np
import pytest

from fluidlift.errors import InputRejected
from fluidlift.io.images import read_camera, read_depth, read_distortion, read_mask, undistort_clip, undistort_mask
from fluidlift.io.limits import ReadLimits
from fluidlift.io.pictures import read_picture, write_png
from fluidlift.types import PinholeCamera, VideoClip

SIZE = (64, 48)


def disc(size=SIZE) -> np.ndarray:
    """bool [H,W]: an off-centre disc."""
    w, h = size
    y, x = np.mgrid[:h, :w] + 0.5
    return (x / w - 0.4) ** 2 + (y / h - 0.6) ** 2 * (h / w) ** 2 < 0.04


def test_png_round_trip_keeps_every_kind_of_picture(tmp_path):
    rng = np.random.default_rng(0)
    for shape in ((8, 9), (8, 9, 3), (8, 9, 4)):
        for kind in (np.uint8, np.uint16):
            picture = rng.integers(0, np.iinfo(kind).max, shape).astype(kind)
            np.testing.assert_array_equal(read_picture(write_png(tmp_path / "a.png", picture)), picture)


def test_a_picture_over_the_limit_is_refused_before_it_is_decoded(tmp_path):
    path = write_png(tmp_path / "a.png", np.zeros((40, 50), np.uint8))
    data = bytearray(path.read_bytes())
    data[16:24] = (60000).to_bytes(4, "big") * 2  # a header that promises 3.6 gigapixels
    path.write_bytes(data)
    with pytest.raises(InputRejected, match=r"read\.max_pixels"):
        read_picture(path)


def test_a_broken_picture_is_refused(tmp_path):
    (tmp_path / "a.png").write_bytes(b"\x89PNG\r\n\x1a\n" + bytes(50))
    with pytest.raises(InputRejected, match="cannot be decoded"):
        read_picture(tmp_path / "a.png")


@pytest.mark.parametrize("claimed", [2**31 - 1, 1_526_731_728])
def test_a_png_whose_chunk_claims_more_than_the_file_has_takes_no_memory(tmp_path, claimed):
    path = write_png(tmp_path / "a.png", np.zeros((4, 5, 3), np.uint16))
    data = path.read_bytes()
    path.write_bytes(data[:33] + claimed.to_bytes(4, "big") + data[37:])  # the chunk after the header
    with pytest.raises(InputRejected, match="claims"):
        read_picture(path)


@pytest.mark.parametrize("top", [1, 255, 65535])
def test_white_is_fluid_in_masks_of_any_depth(tmp_path, top):
    mask = disc()
    path = write_png(tmp_path / "m.png", mask.astype(np.uint16 if top > 255 else np.uint8) * top)
    np.testing.assert_array_equal(read_mask(path, SIZE, 10), mask)


def test_the_alpha_channel_decides_where_it_varies(tmp_path):
    picture = np.full((48, 64, 4), 255, np.uint8)
    picture[..., 3] = disc() * 255
    np.testing.assert_array_equal(read_mask(write_png(tmp_path / "m.png", picture), SIZE, 10), disc())
    opaque = np.dstack([np.repeat(disc()[..., None] * 255, 3, -1), np.full((48, 64), 255)]).astype(np.uint8)
    np.testing.assert_array_equal(read_mask(write_png(tmp_path / "m.png", opaque), SIZE, 10), disc())


def test_a_mask_of_the_source_size_is_resampled(tmp_path):
    mask = read_mask(write_png(tmp_path / "m.png", disc((256, 192))), SIZE, 10)
    assert mask.shape == (48, 64) and (mask != disc()).mean() < 0.01  # pixels on the rim may go either way


def test_a_mask_of_another_shape_is_refused(tmp_path):
    with pytest.raises(InputRejected, match="aspect ratio"):
        read_mask(write_png(tmp_path / "m.png", disc((48, 64))), SIZE, 10)


def test_an_empty_mask_is_refused(tmp_path):
    with pytest.raises(InputRejected, match="empty"):
        read_mask(write_png(tmp_path / "m.png", np.zeros((48, 64), np.uint8)), SIZE, 10)


def test_a_folder_gives_one_mask_per_frame(tmp_path):
    for i in range(3):
        write_png(tmp_path / "m" / f"{i}.png", np.roll(disc(), i, axis=1))
    masks = read_mask(tmp_path / "m", SIZE, 3)
    np.testing.assert_array_equal(masks, [np.roll(disc(), i, axis=1) for i in range(3)])
    with pytest.raises(InputRejected, match="3 masks"):
        read_mask(tmp_path / "m", SIZE, 4)


def test_a_video_gives_one_mask_per_frame(make_video):
    frames = np.repeat(disc()[None, ..., None] * 255, 3, axis=-1).astype(np.uint8).repeat(4, axis=0)
    masks = read_mask(make_video("m.mp4", frames), SIZE, 4)
    assert masks.shape == (4, 48, 64) and (masks != disc()).mean() < 0.01


def test_depth_from_16_bit_pictures_is_in_millimetres(tmp_path):
    millimetres = np.arange(48 * 64, dtype=np.uint16).reshape(48, 64)
    depth = read_depth(write_png(tmp_path / "d.png", millimetres), SIZE)
    np.testing.assert_allclose(depth[1:], millimetres[1:] / 1000, rtol=1e-6)
    assert np.isnan(depth[0, 0])  # 0 says nothing
    np.testing.assert_allclose(read_depth(tmp_path / "d.png", SIZE, scale=0.01)[1:], millimetres[1:] / 100, rtol=1e-6)


def test_depth_keeps_to_the_nearest_pixel_at_edges(tmp_path):
    far = np.where(disc((256, 192)), 1.0, 9.0)
    np.save(tmp_path / "d.npy", far)
    assert set(np.unique(read_depth(tmp_path / "d.npy", SIZE))) == {1.0, 9.0}
    np.savez(tmp_path / "d.npz", depth=np.stack([far, far]), other=np.zeros(2))
    assert read_depth(tmp_path / "d.npz", SIZE).shape == (2, 48, 64)


def test_depth_that_cannot_be_used_is_refused(tmp_path):
    np.save(tmp_path / "p.npy", np.array([[{}]], object), allow_pickle=True)
    (tmp_path / "d.exr").write_bytes(b"\x76\x2f\x31\x01")  # cut off
    (tmp_path / "t.npz").write_bytes(b"PK\x03\x04 no archive")
    np.save(tmp_path / "n.npy", np.full((48, 64), np.nan))
    write_png(tmp_path / "8.png", np.ones((48, 64), np.uint8))
    np.save(tmp_path / "0.npy", np.ones((0, 48, 64), np.float32))
    np.save(tmp_path / "e.npy", np.ones((1, 0), np.float32))  # next to nothing, of any shape
    cases = {
        "e.npy": "another aspect ratio",
        "0.npy": "at least one frame",
        "p.npy": "numbers",
        "d.exr": "damaged",
        "t.npz": "cannot be read",
        "n.npy": "no valid",
        "8.png": "8 bits",
    }
    for name, reason in cases.items():
        with pytest.raises(InputRejected, match=reason):
            read_depth(tmp_path / name, SIZE)
    np.savez_compressed(tmp_path / "b.npz", depth=np.ones((48, 64)))
    with pytest.raises(InputRejected, match="too much"):
        read_depth(tmp_path / "b.npz", SIZE, limits=ReadLimits(max_bytes=10000))


def test_our_camera_file_comes_back_at_the_size_of_the_clip(tmp_path):
    camera = PinholeCamera.looking(np.array([3.0, -2, 2]), np.zeros(3), 40, (512, 384))
    (tmp_path / "c.json").write_text(json.dumps(camera.to_dict() | {"gcp_world": [[1, 2, 3]]}))
    small = read_camera(tmp_path / "c.json", SIZE)
    point = np.array([[0.1, 0.2, 0.3]])
    np.testing.assert_allclose(small.project(point)[0], camera.project(point)[0] / 8, rtol=1e-12)
    with pytest.raises(InputRejected, match="aspect ratio"):
        read_camera(tmp_path / "c.json", (64, 64))


def test_nerfstudio_cameras_see_what_ours_see(tmp_path):
    camera = PinholeCamera.looking(np.array([3.0, -2, 2]), np.zeros(3), 40, (64, 48))
    pose = np.eye(4)
    pose[:3, :3] = camera.camera_from_world.rotation.T @ np.diag([1, -1, -1])
    pose[:3, 3] = camera.position
    frame = {"file_path": "0.png", "transform_matrix": pose.tolist()}
    data = {"w": 64, "h": 48, "fl_x": camera.focal[0], "fl_y": camera.focal[1], "frames": [frame, frame]}
    (tmp_path / "transforms.json").write_text(json.dumps(data))
    point = np.array([[0.1, 0.2, 0.3]])
    read = read_camera(tmp_path / "transforms.json", SIZE)
    np.testing.assert_allclose(read.project(point)[0], camera.project(point)[0], rtol=1e-9)
    pose[0, 3] += 0.5
    data["frames"][1] = {"transform_matrix": pose.tolist()}
    (tmp_path / "transforms.json").write_text(json.dumps(data))
    with pytest.raises(InputRejected, match="moving camera"):
        read_camera(tmp_path / "transforms.json", SIZE)


@pytest.mark.parametrize("text", ["{", "[]", '{"width": 64}', '{"width": 64, "height": 48, "K": [1]}', "[" * 100000])
def test_broken_camera_files_are_refused(tmp_path, text):
    (tmp_path / "c.json").write_text(text)
    with pytest.raises(InputRejected):
        read_camera(tmp_path / "c.json", SIZE)


def test_straight_lines_are_straight_after_the_lens_is_corrected(tmp_path):
    camera = PinholeCamera.from_fov(60, (320, 240))
    k1 = -0.2
    (tmp_path / "c.json").write_text(json.dumps(camera.to_dict() | {"distortion": [k1, 0, 0, 0]}))
    # a picture of the line y = -0.3 z, as a lens with k1 bends it
    grid = (camera.pixel_grid() - camera.center) / camera.focal
    ideal = grid.copy()
    for _ in range(30):  # fixed point: x_ideal = x_bent / (1 + k1 r^2)
        ideal = grid / (1 + k1 * (ideal**2).sum(-1, keepdims=True))
    soft = np.clip(1 - np.abs(ideal[..., 1] + 0.3) / 0.02, 0, 1)
    picture = np.repeat(np.round(255 * soft)[..., None], 3, -1).astype(np.uint8)
    clip = VideoClip(np.stack([picture, picture]), np.array([0.0, 0.1]))
    rows = np.arange(240)[:, None] + 0.5
    expected = camera.center[1] - 0.3 * camera.focal[1]
    flat = undistort_clip(clip, camera, read_distortion(tmp_path / "c.json")).frames[0, ..., 0].astype(float)
    columns = slice(20, 300)
    found = (flat * rows).sum(0)[columns] / flat.sum(0)[columns]
    assert np.abs(found - expected).max() < 0.2  # a soft line 11 px wide: the centroid suffers only from rounding
    mask = undistort_mask(picture[..., 0] > 127, camera, read_distortion(tmp_path / "c.json"))
    np.testing.assert_array_equal(np.abs(rows - expected)[mask.any(axis=1)] < 4, True)  # the line, half as high: 5.5 px
    bent = (picture[..., 0] * rows).sum(0)[columns] / picture[..., 0].astype(float).sum(0)[columns]
    assert np.abs(bent - expected).max() > 3.0


def test_a_camera_without_distortion_says_so(tmp_path):
    (tmp_path / "c.json").write_text(json.dumps(PinholeCamera.from_fov(60, (320, 240)).to_dict()))
    assert read_distortion(tmp_path / "c.json") is None
