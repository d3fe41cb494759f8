"""Cameras that go somewhere: told from those that turn, and the clip laid as before a tripod, against exact truth."""

from importlib.util import find_spec

import cv2
import numpy as np
import pytest

from fluidlift.errors import MissingPackage
from fluidlift.motion.moving_camera import GAIN, Lens, Walking, drawn_again, gain, walked
from fluidlift.motion.parallax import OFF_PLANE, parallax_of
from fluidlift.motion.stabilize import GreyFrames, stabilise
from fluidlift.motion.tracks import follow
from fluidlift.motion.water_plane import flowing
from fluidlift.synthetic.riverside import Riverside, film, walk
from fluidlift.types import PinholeCamera, VideoClip

FRAMES, SIZE, FPS = 20, (320, 208), 20.0  # a second: by then the pattern of the water is another one
GUESS = PinholeCamera.from_fov(50.0, SIZE).focal[0]
"""px: the usual lens; the made one is wider (60 degrees)"""

needs_colmap = pytest.mark.skipif(
    find_spec("pycolmap") is None, reason="needs pycolmap: pip install 'fluidlift[camera]'"
)


def colmap():
    from fluidlift.backends.colmap_poses import ColmapPoses

    return ColmapPoses()


def absent():
    raise MissingPackage("pycolmap is not installed")


@pytest.fixture(scope="module")
def scene():
    return Riverside.make()


@pytest.fixture(scope="module")
def filmed(scene):
    return {
        path: film(scene, walk(path, FRAMES, size=SIZE), fps=FPS, seed=1) for path in ("forward", "sideways", "turning")
    }


@pytest.fixture(scope="module")
def walks(filmed):
    return {
        path: walked(GreyFrames(filmed[path].frames), Walking(Lens(GUESS), colmap))[0]
        for path in ("forward", "sideways")
    }


def clip_of(frames: np.ndarray) -> VideoClip:
    return VideoClip(frames, np.arange(len(frames)) / FPS)


def test_a_camera_that_turns_is_told_from_one_that_goes(filmed):
    found = {path: parallax_of(follow(GreyFrames(clip.frames))) for path, clip in filmed.items()}
    assert found["forward"].went and found["sideways"].went and not found["turning"].went
    assert 2 * found["turning"].off_plane < OFF_PLANE < 0.3 * found["sideways"].off_plane


def test_what_counts_as_standing_is_not_water(filmed):
    clip = filmed["sideways"]
    tracks = follow(GreyFrames(clip.frames))
    first = tracks.seen.argmax(axis=1)
    x, y = np.floor(tracks.places[np.arange(len(first)), first]).astype(int).T
    wet = clip.water[first, y, x]
    standing = parallax_of(tracks).standing
    assert standing.sum() > 100
    assert wet[standing].mean() < 0.15 < wet.mean()  # stones in the water are seen before it


@needs_colmap
@pytest.mark.parametrize("path", ["forward", "sideways"])
def test_the_water_is_laid_to_half_a_pixel(filmed, walks, path):
    clip, found = filmed[path], walks[path]
    here = clip.cameras[found.reference]
    pixels = np.argwhere(clip.water[found.reference][::6, ::6])[:, ::-1] * 6
    points = here.unproject(pixels + 0.5, clip.depth[found.reference][pixels[:, 1], pixels[:, 0]])
    inverse = found.inverse_depth(SIZE)
    misses = []
    for t in range(FRAMES):
        u, v = found.maps(t, SIZE, inverse)
        laid = np.stack([u, v], axis=-1)[pixels[:, 1], pixels[:, 0]] + 0.5
        true, _ = clip.cameras[t].project(points)
        seen = (true > 0).all(axis=1) & (true < SIZE).all(axis=1)
        misses.append(np.linalg.norm(laid - true, axis=1)[seen])
    assert np.concatenate(misses).mean() < 0.5


@needs_colmap
@pytest.mark.parametrize("path", ["forward", "sideways"])
def test_the_plane_of_the_water_is_level(filmed, walks, path):
    camera = filmed[path].cameras[walks[path].reference]
    up = camera.camera_from_world.rotation[:, 2]
    off = np.degrees(np.arccos(up @ walks[path].plane.normal))
    assert off < 2.0  # the habit of people alone is spread by 8 degrees
    assert walks[path].view.pitch == pytest.approx(np.degrees(np.arcsin(-up[2])), abs=2.0)


@needs_colmap
@pytest.mark.parametrize("path", ["forward", "sideways"])
def test_what_stands_stands_and_what_flows_is_found(filmed, walks, path):
    clip, found = filmed[path], walks[path]
    laid, unseen = np.empty_like(clip.frames), {}
    drawn_again(clip.frames, found, laid, unseen=unseen.__setitem__)
    assert sorted(unseen) == list(range(FRAMES)), "what a turn had left unseen is told anew of all"
    assert not unseen[found.reference].any() and (unseen[0].any() or unseen[FRAMES - 1].any())
    dry = ~clip.water[found.reference]
    here = clip.frames[found.reference].astype(float)

    def change(frames: np.ndarray) -> float:
        """Median grey levels between the reference frame and the ends of the clip, on what stands."""
        return float(np.median(np.abs(frames[[0, -1]].astype(float) - here).mean(axis=-1)[:, dry]))

    assert change(laid) < 0.3 * change(clip.frames)
    wet = cv2.resize(flowing(found.swept).astype(np.uint8), SIZE, interpolation=cv2.INTER_NEAREST) > 0
    assert (wet & ~dry).sum() / (wet | ~dry).sum() > 0.85
    against = cv2.resize(found.fluid_evidence, SIZE)
    assert against.max() <= 0 and against[dry].mean() < 4 * against[~dry].mean()


@needs_colmap
def test_a_path_along_which_no_more_stands_still_is_not_believed(filmed, walks):
    frames, laid = filmed["sideways"].frames, np.empty_like(filmed["sideways"].frames)
    drawn_again(frames, walks["sideways"], laid)
    grey, already = GreyFrames(frames), GreyFrames(laid)
    assert gain(grey, grey, walks["sideways"]) > 2 * GAIN and gain(grey, already, walks["sideways"]) <= 0.0
    found, said = walked(grey, Walking(Lens(GUESS), colmap), already)
    assert found is None and said is not None and said.code == "camera-path-unknown" and "things" in said


@needs_colmap
def test_the_same_clip_gives_the_same_bits(filmed, walks):
    again = walked(GreyFrames(filmed["sideways"].frames), Walking(Lens(GUESS), colmap))[0]
    assert np.array_equal(again.path.rotations, walks["sideways"].path.rotations)
    assert np.array_equal(again.plane.normal, walks["sideways"].plane.normal)


@needs_colmap
def test_a_clip_is_steadied_by_its_path(filmed):
    steady, report = stabilise(clip_of(filmed["sideways"].frames), walking=Walking(Lens(GUESS), colmap))
    assert report.stabilised and report.view is not None and report.fluid_evidence is not None
    assert report.warnings == () and len(steady) == FRAMES
    assert report.unseen is not None and report.unseen[[0, -1]].any()


def test_a_camera_that_turns_is_steadied_as_before(filmed):
    clip = clip_of(filmed["turning"].frames)
    plain, before = stabilise(clip)
    same, after = stabilise(clip, walking=Walking(Lens(GUESS), absent))
    assert np.array_equal(plain.frames, same.frames) and before.warnings == after.warnings and after.view is None


def test_without_the_package_the_clip_is_steadied_as_before_and_that_is_told(filmed):
    clip = clip_of(filmed["sideways"].frames)
    plain, _ = stabilise(clip)
    same, report = stabilise(clip, walking=Walking(Lens(GUESS), absent))
    assert np.array_equal(plain.frames, same.frames)
    told = [w for w in report.warnings if w.code == "camera-extra-missing"]
    assert len(told) == 1 and "fluidlift[camera]" in told[0]


def test_a_path_that_is_not_found_is_told(filmed):
    class Lost:
        def solve(self, *_, **__):
            return None

    _, report = stabilise(clip_of(filmed["sideways"].frames), walking=Walking(Lens(GUESS), Lost))
    assert [w.code for w in report.warnings if w.code.startswith("camera-path")] == ["camera-path-unknown"]
    assert report.view is None
