"""Frames on demand: what is kept, what is read again, what is missing."""

import threading
from dataclasses import dataclass, replace

import numpy as np
import pytest

from fluidlift.io.ply import write_gaussians
from fluidlift.look.surface_skin import PITCH, THICKNESS, WIDTH
from fluidlift.types import Gaussians, concatenate
from fluidlift.viewer.frames import FrameCache, FrameMissing, read_frame, splat_frame

SKIN_SCALES = np.array([WIDTH * PITCH, WIDTH * PITCH, THICKNESS])
"""of a skin's splats, cells"""


@dataclass
class Block:
    index: int
    nbytes: int = 100


class Disk:
    """Counts what is read."""

    def __init__(self):
        self.read = []

    def __call__(self, index):
        self.read.append(index)
        return Block(index)


def gaussians(n=5):
    rng = np.random.default_rng(3)
    quats = rng.normal(size=(n, 4))
    quats /= np.linalg.norm(quats, axis=1, keepdims=True)
    return Gaussians(
        rng.normal(size=(n, 3)), quats, rng.uniform(0.01, 0.1, (n, 3)), rng.uniform(0.2, 0.9, n),
        rng.normal(size=(n, 1, 3)),
    )  # fmt: skip


def test_memory_stays_within_its_bound_however_many_frames_are_played():
    disk = Disk()
    cache = FrameCache(disk, 350)
    for _ in range(20):
        for k in range(10):
            assert cache.get(k).index == k
            assert cache.nbytes <= 350 and len(cache) <= 3


def test_the_frames_that_were_wanted_last_stay():
    disk = Disk()
    cache = FrameCache(disk, 300)
    for k in (0, 1, 2, 0, 3, 0):
        cache.get(k)
    assert disk.read == [0, 1, 2, 3]  # 1 made room for 3, since 0 was looked at again
    cache.get(1)
    assert disk.read == [0, 1, 2, 3, 1]


def test_a_frame_larger_than_the_cache_is_shown_all_the_same():
    cache = FrameCache(lambda k: Block(k, 10**9), 10)
    assert cache.get(4).index == 4 and len(cache) == 1


def test_a_frame_that_cannot_be_read_is_asked_for_again_next_time():
    broken = [True]

    def load(index):
        if broken[0]:
            raise FrameMissing("Frame 1001 is not there")
        return Block(index)

    cache = FrameCache(load, 1000)
    for _ in range(2):
        with pytest.raises(FrameMissing):
            cache.get(0)
    broken[0] = False
    assert cache.get(0).index == 0


def test_two_threads_that_want_one_frame_read_it_once():
    gate, read = threading.Event(), []

    def load(index):
        read.append(index)
        gate.wait(60)
        return Block(index)

    cache = FrameCache(load, 1000)
    threads = [threading.Thread(target=cache.get, args=(7,)) for _ in range(4)]
    for t in threads:
        t.start()
    gate.set()
    for t in threads:
        t.join(60)
    assert read == [7]


def test_what_is_sent_is_the_splats_shape_and_colour():
    g = gaussians()
    frame = splat_frame(g, np.ones((5, 3)))
    np.testing.assert_allclose(frame.covariances, g.covariances(), rtol=1e-6)
    assert frame.rgb.dtype == np.uint8 and frame.opacities.shape == (5, 1)
    np.testing.assert_allclose(frame.rgb / 255, g.rgb, atol=0.5 / 255 + 1e-6)  # eight bits
    assert frame.nbytes == 5 * (12 + 36 + 3 + 1 + 12)
    assert frame.fastest == pytest.approx(np.sqrt(3))


def test_splats_that_are_not_finite_are_left_out():
    g = gaussians()
    g.means[2] = np.nan
    assert len(splat_frame(g, np.ones((5, 3))).velocities) == 4


def test_a_frame_is_read_back_with_its_velocities(tmp_path):
    g, velocities = gaussians(), np.arange(15.0).reshape(5, 3)
    (tmp_path / "frames" / "splats").mkdir(parents=True)
    write_gaussians(tmp_path / "frames" / "splats" / "1003.ply", g, ids=np.arange(5), velocities=velocities)
    frame = read_frame(tmp_path, 2)
    np.testing.assert_allclose(frame.centers, g.means, rtol=1e-6)
    np.testing.assert_allclose(frame.velocities, velocities)


def test_a_missing_frame_and_half_of_one_are_told_by_their_number(tmp_path):
    folder = tmp_path / "frames" / "splats"
    folder.mkdir(parents=True)
    with pytest.raises(FrameMissing, match="1004"):
        read_frame(tmp_path, 3)
    write_gaussians(folder / "1004.ply", gaussians(), ids=np.arange(5), velocities=np.zeros((5, 3)))
    data = (folder / "1004.ply").read_bytes()
    (folder / "1004.ply").write_bytes(data[: len(data) - 40])
    with pytest.raises(FrameMissing, match="1004"):
        read_frame(tmp_path, 3)


def with_skin(cell=0.05):
    """Six round splats of a liquid, and two flat ones of a skin over it."""
    body = Gaussians.isotropic(np.random.default_rng(1).uniform(size=(6, 3)), 0.4 * cell, np.full((6, 3), 0.5))
    paint = Gaussians.isotropic(np.array([[0.2, 0.3, 1.0], [0.4, 0.3, 1.0]]), 1.0, np.full((2, 3), 0.5))
    return concatenate([body, replace(paint, scales=np.tile(SKIN_SCALES * cell, (2, 1)))]), body.means


def test_a_skin_is_shown_but_counts_as_no_liquid(tmp_path):
    splats, body = with_skin()
    (tmp_path / "frames" / "splats").mkdir(parents=True)
    path = tmp_path / "frames" / "splats" / "1001.ply"
    write_gaussians(path, splats, ids=np.arange(8), velocities=np.zeros((8, 3)))
    frame = read_frame(tmp_path, 0, cell=0.05)
    assert len(frame.centers) == 8
    np.testing.assert_allclose(frame.liquid, body, rtol=1e-6)  # files hold single precision
    assert len(read_frame(tmp_path, 0).liquid) == 8  # of unknown cells, or of others, all are liquid
    assert len(read_frame(tmp_path, 0, cell=0.06).liquid) == 8
