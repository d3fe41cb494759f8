"""The plane under a pattern, from how its spectrum changes over the picture."""

import cv2
import numpy as np
import pytest

from fluidlift.shape.kind import estimate_up, level_camera
from fluidlift.shape.slope import plane_axes
from fluidlift.shape.texture_gradient import PATTERNLESS, texture_evidence, texture_patches, weighed
from fluidlift.shape.view import PictureEvidence
from fluidlift.types import PinholeCamera, UpEvidence

SIZE = (256, 192)
PITCHES = np.arange(10.0, 81.0, 5.0)
UP = np.array([0.0, 0.0, 1.0])
FULL = np.ones(SIZE[::-1], bool)


def tilted(pitch, roll=0.0):
    return level_camera(PinholeCamera.from_fov(50.0, SIZE), UpEvidence(pitch, roll, "", 1.0))


def pattern(seed, stretch=1.0, n=512):
    """Noise of one octave about 90 waves per side, [n,n], that is `stretch` times longer one way than the other."""
    rng, waves = np.random.default_rng(seed), np.fft.fftfreq(n) * n
    size = np.hypot(waves[:, None] * np.sqrt(stretch), waves / np.sqrt(stretch))
    kept = np.exp(-2.0 * np.log(np.maximum(size, 1e-3) / 90.0) ** 2)
    noise = np.fft.ifft2(np.fft.fft2(rng.standard_normal((n, n))) * np.sqrt(kept)).real
    return (noise / noise.std()).astype(np.float32)


def filmed(camera, normal, textures):
    """Pictures u8 [t,h,w,3] of patterns on a plane, at a depth of 1 in the middle; grey where it is hardly seen."""
    camera_up = np.cross(normal, [1.0, 0.3, 0.2])
    first = camera_up / np.linalg.norm(camera_up)
    axes = np.stack([first, np.cross(normal, first)])
    fine = PinholeCamera.from_fov(50.0, (3 * SIZE[0], 3 * SIZE[1]))  # three samples per pixel each way
    fine = PinholeCamera(fine.focal, fine.center, fine.size, camera.camera_from_world)
    rays, middle = fine.rays(fine.pixel_grid()), camera.rays(np.array(SIZE) / 2)
    facing = -rays @ normal
    seen = facing > 0.1 * facing.max()
    where = (rays @ axes.T) / np.where(seen, facing, 1.0)[..., None] * -(middle @ normal) / 2.0
    seen = cv2.resize(seen.astype(np.uint8), SIZE, interpolation=cv2.INTER_NEAREST) > 0
    pictures = []
    for t in textures:
        x, y = (np.mod(where[..., i] * len(t), len(t)).astype(np.float32) for i in (0, 1))
        picture = cv2.resize(cv2.remap(t, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP), SIZE,
                             interpolation=cv2.INTER_AREA)  # fmt: skip
        pictures.append(np.clip(110 + 25 * picture, 0, 255) * seen)
    return np.repeat(np.array(pictures, np.uint8)[..., None], 3, axis=-1), seen


def posterior(pictures, mask):
    """Mean and standard deviation of the pitch, degrees, all pitches alike before and the evidence in full."""
    patches = texture_patches(pictures, mask)
    assert patches is not None
    log = np.array([texture_evidence(tilted(p), patches, UP) for p in PITCHES])
    share = np.exp(log - log.max())
    share /= share.sum()
    mean = float(share @ PITCHES)
    return mean, float(np.sqrt(share @ (PITCHES - mean) ** 2))


@pytest.mark.parametrize("pitch", [25.0, 40.0, 55.0])
@pytest.mark.parametrize(("stretch", "bound"), [(1.0, 6.5), (1.8, 9.2)], ids=["isotropic", "stretched"])
def test_a_pattern_that_is_the_same_all_over_a_plane_shows_its_tilt(pitch, stretch, bound):
    mean, _ = posterior(*filmed(tilted(pitch), UP, [pattern(i, stretch) for i in range(3)]))
    # half of the prior of how people hold cameras (13 degrees); stretched more than usual, 1 over the root of two of it
    assert abs(mean - pitch) < bound


def test_a_level_plane_is_no_better_than_another_under_a_picture_without_a_pattern():
    flat = np.full((3, *SIZE[::-1], 3), 90, np.uint8)
    assert texture_patches(flat, FULL) is None


def test_noise_of_the_camera_is_no_pattern():
    rng = np.random.default_rng(0)
    pictures = np.repeat((110 + rng.normal(0, 3, (3, *SIZE[::-1], 1))).astype(np.uint8), 3, axis=-1)
    mean, error = posterior(pictures, FULL)
    # white noise looks like a wall that faces the camera: what it says is bounded, see below
    assert mean > 60.0 or error > 10.0


def test_a_pattern_is_never_believed_beyond_the_share_of_those_that_say_nothing():
    habit = np.log(np.array([[0.2, 0.3], [0.4, 0.1]]))
    said = weighed(np.array([[0.0, -1e4], [-1e4, -1e4]]), habit)
    share = np.exp(said + habit) / np.exp(said + habit).sum()
    # all of the pattern's half goes to one plane, and the habit keeps the other
    np.testing.assert_allclose(share[0, 1], PATTERNLESS * 0.3, rtol=1e-6)
    np.testing.assert_allclose(weighed(np.zeros((2, 2)), habit), 0.0, atol=1e-12)


def test_a_wall_that_faces_the_camera_tilts_it_by_less_than_the_habit_is_unsure():
    wall = -tilted(40.0).camera_from_world.rotation[2]
    pictures, _ = filmed(tilted(40.0), wall, [pattern(i) for i in range(3)])
    patches = texture_patches(pictures, FULL)
    assert patches is not None
    habit = -0.5 * ((PITCHES - 40.0) / 13.0) ** 2
    share = np.exp(habit + weighed(np.array([texture_evidence(tilted(p), patches, UP) for p in PITCHES]), habit))
    share /= share.sum()
    mean = float(share @ PITCHES)
    assert abs(mean - 40.0) < 13.0
    # and it is not sure of it
    assert np.sqrt(share @ (PITCHES - mean) ** 2) > 6.5


def test_a_stream_across_the_view_shows_the_tilt_by_its_pattern():
    camera = tilted(55.0)
    pictures, mask = filmed(camera, UP, [pattern(i) for i in range(3)])
    points = camera.unproject(camera.pixel_grid(), 1.0 / np.maximum(-camera.rays(camera.pixel_grid()) @ UP, 0.1))
    across = (points[..., 1] - np.median(points[..., 1])) / 0.4
    mask &= np.abs(across) < 1.0
    velocity = 0.02 * (1 - 0.75 * across**2)[..., None] * plane_axes(0.0, 0.0)[0]
    motion = np.where(mask[..., None], camera.project(points + velocity)[0] - camera.pixel_grid(), 0.0)
    texture = texture_patches(pictures, mask)
    assert texture is not None
    found = estimate_up("stream", mask, motion, np.ones(mask.shape), camera, PictureEvidence(texture=texture))
    without = estimate_up("stream", mask, motion, np.ones(mask.shape), camera)
    # habit is 15 off; so little of a pattern is believed that it is a step on the way, as measured 3 degrees of 17
    assert 55.0 - found.pitch < 0.9 * (55.0 - without.pitch)
    assert found.source.endswith("pattern")


def test_a_thread_holds_no_window():
    mask = np.zeros(SIZE[::-1], bool)
    mask[:, 100:120] = True
    pictures, _ = filmed(tilted(40.0), UP, [pattern(0)])
    assert texture_patches(pictures, mask) is None


def test_the_size_of_the_picture_changes_nothing():
    pictures, mask = filmed(tilted(40.0), UP, [pattern(i) for i in range(2)])
    big = np.stack([cv2.resize(p, (1024, 768), interpolation=cv2.INTER_NEAREST) for p in pictures])
    small = np.stack([cv2.resize(p, (512, 384), interpolation=cv2.INTER_NEAREST) for p in pictures])
    found = []
    for seen in (small, big):
        size = seen.shape[2], seen.shape[1]
        camera = PinholeCamera.from_fov(50.0, size)
        patches = texture_patches(seen, cv2.resize(mask.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST) > 0)
        assert patches is not None
        tilts = [level_camera(camera, UpEvidence(p, 0.0, "", 1.0)) for p in (30.0, 50.0)]
        found.append([texture_evidence(c, patches, UP) for c in tilts])
    (a, b), (c, d) = found
    # pictures shrunk to the same size: the same windows but for a rounding of grey levels and of the mask's rim
    assert a - b == pytest.approx(c - d, rel=0.2, abs=1.0)


@pytest.mark.parametrize("pitch", [40.0, 75.0])
def test_the_pattern_of_standing_water_shows_how_far_it_is_looked_down_on(pitch):
    pictures, mask = filmed(tilted(pitch), UP, [pattern(i) for i in range(3)])
    still = np.zeros((*mask.shape, 2)), np.zeros(mask.shape)
    seen = PictureEvidence(texture=texture_patches(pictures, mask))
    found, usual, in_pot = (
        estimate_up("basin", mask, *still, tilted(0.0), picture)
        for picture in (seen, PictureEvidence(), PictureEvidence(texture=seen.texture, contained=True))
    )
    assert abs(found.pitch - pitch) < 0.5 * abs(usual.pitch - pitch), (found, usual)
    assert "pattern" in found.source and "pattern" not in usual.source
    assert in_pot == usual, "what stirs in a vessel is not the same all over"
