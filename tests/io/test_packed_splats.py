"""Packed frames: every number within its bound, pictures alike, ids exact, and files of strangers refused in words."""

import struct
import zlib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fluidlift.errors import InputRejected
from fluidlift.io import packed_splats
from fluidlift.io.packed_splats import MAX_PACKED, packable, read_packed, write_packed
from fluidlift.io.ply import write_gaussians
from fluidlift.look.rasterize import render
from fluidlift.look.surface_skin import PITCH, THICKNESS, WIDTH, of_skin
from fluidlift.look.whitewater_splats import kinds_of, whitewater_splats
from fluidlift.scene.splat_files import frame_files, read_frame, write_frame
from fluidlift.types import Gaussians, PinholeCamera, concatenate
from fluidlift.types.gaussians import SH_C0

TURN = 3 * 0.5 * np.sqrt(0.5) / 511 * (1 + 1e-3)
"""of a component: half a step, and of the largest, which follows from the others, at most the sum of their three; and
a thousandth of that for what is of second order"""
SINGLE = 1e-6
"""of a number, for single precision on the way"""


def cloud(n: int, degree: int = 0, seed: int = 0, size: float = 1.0, at: float = 0.0) -> Gaussians:
    """Splats of all shapes, turned in all ways, of a body `size` m wide that lies at `at` m."""
    rng = np.random.default_rng(seed)
    quats = rng.normal(size=(n, 4))
    quats /= np.linalg.norm(quats, axis=1, keepdims=True) if n else 1.0
    scales = size * np.exp(rng.normal(-4.5, 0.7, (n, 3)))
    sh = np.concatenate([rng.uniform(-2, 2, (n, 1, 3)), rng.normal(0, 0.1, (n, (degree + 1) ** 2 - 1, 3))], axis=1)
    return Gaussians(rng.uniform(at, at + size, (n, 3)), quats, scales, rng.uniform(0, 1, n), sh)


def moving(n: int, speed: float = 1.0, seed: int = 1) -> np.ndarray:
    return (speed * np.random.default_rng(seed).normal(size=(n, 3))).astype(np.float32)


def same_turn(a: np.ndarray, b: np.ndarray) -> float:
    """The largest difference of a component of quaternions, whose sign means nothing."""
    return float(np.abs(a - b * np.sign((a * b).sum(axis=1, keepdims=True))).max(initial=0.0))


@given(
    n=st.integers(0, 200), degree=st.integers(0, 3), seed=st.integers(0, 99), size=st.sampled_from([1e-3, 1.0, 500.0]),
    at=st.sampled_from([0.0, -3.0, 4e5]), speed=st.sampled_from([0.0, 1e-20, 0.3, 40.0]),
)  # fmt: skip
def test_every_number_comes_back_within_its_bound(tmp_path_factory, n, degree, seed, size, at, speed):
    g, v = cloud(n, degree, seed, size, at), moving(n, speed, seed)
    ids = np.random.default_rng(seed).integers(-(2**31), 2**31, n)
    found = read_packed(write_packed(tmp_path_factory.mktemp("p") / "a.flsp", g, ids=ids, velocities=v))
    back = found.gaussians
    np.testing.assert_array_equal(found.ids, ids)
    if n == 0:
        assert len(back) == 0 and back.sh.shape == g.sh.shape
        return
    # half a step is a hundredth of the median smallest axis, or what single precision leaves of the farthest place
    near = max(0.01 * float(np.median(g.scales.min(axis=1))), 2**-26 * float(np.abs(g.means).max()))
    assert np.abs(back.means - g.means).max() <= near * (1 + SINGLE)
    slow = 0.001 * float(np.sqrt(np.square(v, dtype=np.float64).sum(axis=1).mean()))
    assert np.abs(found.velocities - v).max() <= slow * (1 + 1e-4) + 1e-30
    assert np.abs(np.log(back.scales / g.scales)).max() <= 0.5 / 1024 + 1e-5
    assert SH_C0 * np.abs(back.sh[:, 0] - g.sh[:, 0]).max() <= 0.5 / 255 + SINGLE
    assert np.abs(back.sh[:, 1:] - g.sh[:, 1:]).max(initial=0.0) <= 0.5 / 128 + SINGLE
    assert (np.abs(back.opacities - g.opacities) <= g.opacities / 2048 + 3e-8).all()
    assert same_turn(back.quats, g.quats) <= TURN
    np.testing.assert_allclose(np.linalg.norm(back.quats, axis=1), 1.0, atol=1e-6)


def test_what_was_packed_once_is_packed_again_without_a_loss(tmp_path):
    g, ids, v = cloud(500), np.arange(500), moving(500)
    once = read_packed(write_packed(tmp_path / "a.flsp", g, ids=ids, velocities=v))
    twice = read_packed(write_packed(tmp_path / "b.flsp", once.gaussians, ids=ids, velocities=once.velocities))
    for name in ("means", "scales", "opacities", "sh"):
        np.testing.assert_allclose(getattr(twice.gaussians, name), getattr(once.gaussians, name), rtol=2e-6, atol=1e-6)
    assert same_turn(twice.gaussians.quats, once.gaussians.quats) <= TURN


def test_a_turn_of_every_largest_component_and_sign_comes_back(tmp_path):
    q = np.concatenate([np.eye(4), -np.eye(4), np.full((1, 4), 0.5), np.full((1, 4), -0.5)])
    g = replace(cloud(10), quats=q)
    back = read_packed(write_packed(tmp_path / "a.flsp", g, ids=np.arange(10), velocities=moving(10))).gaussians
    assert same_turn(back.quats, q.astype(np.float32)) <= TURN
    np.testing.assert_allclose(back.quats[:4], np.eye(4), atol=1e-7)  # those that are not turned are exact


def test_the_picture_of_a_packed_frame_is_the_same_to_fifty_decibels(tmp_path):
    g = cloud(4000, seed=3)
    g = replace(g, sh=np.clip(g.sh, -1.7, 1.7))
    camera = PinholeCamera.looking(np.array([0.5, -1.5, 1.0]), np.full(3, 0.5), 45.0, (160, 120))
    back = read_packed(write_packed(tmp_path / "a.flsp", g, ids=np.arange(4000), velocities=moving(4000))).gaussians
    assert -10 * np.log10(np.square(render(g, camera).image - render(back, camera).image).mean()) > 50


def test_skin_and_white_water_are_still_told_from_the_body(tmp_path):
    """Both are told by their size, to a thousandth."""
    cell, rng = 0.0137, np.random.default_rng(0)
    paint = Gaussians.isotropic(rng.uniform(size=(50, 3)), 1.0, np.full((50, 3), 0.5))
    kinds = np.tile(np.arange(3, dtype=np.uint8), 20)
    foam = whitewater_splats(rng.uniform(size=(60, 3)), kinds, np.full(60, 2.0), (0.9, 0.9, 0.9), cell)
    g = concatenate(
        [
            cloud(400, seed=2),
            replace(paint, scales=np.tile(cell * np.array([THICKNESS, WIDTH * PITCH, WIDTH * PITCH]), (50, 1))),
            foam,
        ]
    )
    back = read_packed(write_packed(tmp_path / "a.flsp", g, ids=np.arange(510), velocities=moving(510))).gaussians
    np.testing.assert_array_equal(of_skin(back, cell), of_skin(g, cell))
    np.testing.assert_array_equal(kinds_of(back, cell)[-60:], kinds)


def test_neighbours_that_lie_and_move_alike_take_a_sixth_of_a_ply(tmp_path):
    """A block as a simulation has it: in the order of a grid, hardly stretched, of one opacity."""
    side = np.arange(24) * 0.01
    at = np.stack(np.meshgrid(side, side, side, indexing="ij"), -1).reshape(-1, 3)
    rng, n = np.random.default_rng(0), len(at)
    g = Gaussians.isotropic(at + rng.normal(0, 5e-4, at.shape), 0.004, rng.uniform(0.3, 0.5, (n, 3)))
    v = np.array([0.4, 0, 0]) + 0.02 * rng.normal(size=(n, 3))
    packed = write_packed(tmp_path / "a.flsp", g, ids=2 * np.arange(n), velocities=v)
    plain = write_gaussians(tmp_path / "a.ply", g, ids=2 * np.arange(n), velocities=v)
    assert packed.stat().st_size < plain.stat().st_size / 6


# what cannot be packed ------------------------------------------------------------------------------------------------


def broken(name: str, value: float) -> Gaussians:
    g = cloud(20)
    array = getattr(g, name).copy()
    array[7] = value
    return replace(g, **{name: array})


@pytest.mark.parametrize(
    ("name", "value"),
    [("means", np.nan), ("means", np.inf), ("quats", 0.0), ("scales", np.inf), ("scales", np.nan), ("opacities", 1.5),
     ("opacities", np.nan), ("sh", 1e9)],
)  # fmt: skip
def test_numbers_that_mean_nothing_are_kept_as_they_are_in_a_ply(tmp_path, name, value):
    bad, v = broken(name, value), moving(20)
    assert not packable(bad, v)
    with pytest.raises(ValueError, match="mean nothing"):
        write_packed(tmp_path / "a.flsp", bad, ids=np.arange(20), velocities=v)
    write_frame(tmp_path, 1001, cloud(20), ids=np.arange(20), velocities=v)
    write_frame(tmp_path, 1001, bad, ids=np.arange(20), velocities=v)
    assert [p.name for p in frame_files(tmp_path)] == ["1001.ply"]  # what is packed has made room
    write_frame(tmp_path, 1001, cloud(20), ids=np.arange(20), velocities=v)
    assert [p.name for p in frame_files(tmp_path)] == ["1001.flsp"]


def test_more_splats_than_are_packed_become_a_ply_and_read_the_same(tmp_path, monkeypatch):
    g, v = cloud(20), moving(20)
    monkeypatch.setattr(packed_splats, "MAX_PACKED", 19)
    path = write_frame(tmp_path, 1001, g, ids=np.arange(20), velocities=v)
    assert path.suffix == ".ply"
    np.testing.assert_array_equal(read_frame(path).velocities, v)


# files of strangers ---------------------------------------------------------------------------------------------------


@pytest.fixture
def sound(tmp_path) -> bytes:
    return write_packed(tmp_path / "s.flsp", cloud(50), ids=np.arange(50), velocities=moving(50)).read_bytes()


def with_head(data: bytes, *, version: int = 1, degree: int = 0, count: int = 50) -> bytes:
    return struct.pack("<4sBBHI", b"FLSP", version, degree, 0, count) + data[12:]


def with_record(data: bytes, column: int, **changes) -> bytes:
    """With another step, lowest code or sizes in the record of a column."""
    at = 12 + 28 * column
    step, lowest, *sizes = struct.unpack_from("<di4I", data, at)
    told = (changes.get("step", step), changes.get("lowest", lowest), *changes.get("sizes", sizes))
    return data[:at] + struct.pack("<di4I", *told) + data[at + 28 :]


def claims_much() -> bytes:
    """A file of 30 kB that says it holds five million splats, in streams of a few zeros."""
    packed = zlib.compress(bytes(1000))
    records = struct.pack("<di4I", 1.0, 0, len(packed), 0, 0, 0) * 9
    return struct.pack("<4sBBHI", b"FLSP", 1, 0, 0, MAX_PACKED) + records + packed * 9


def bomb(n: int = 10_000) -> bytes:
    """A stream that holds more than its column."""
    packed = zlib.compress(bytes(4 * n))
    records = struct.pack("<di4I", 1.0, 0, len(packed), 0, 0, 0) * 8 + struct.pack("<di4I", 1.0, 0, 0, 0, 0, 0)
    return struct.pack("<4sBBHI", b"FLSP", 1, 0, 0, n) + records + packed * 8


STRANGE = {
    "empty": (lambda d: b"", "empty"),
    "another kind": (lambda d: b"ply\n" + d, "does not begin as"),
    "a head alone": (lambda d: d[:12], "breaks off"),
    "cut off": (lambda d: d[:-1], "its size is not what it says"),
    "longer": (lambda d: d + b"\0", "its size is not what it says"),
    "a newer version": (lambda d: with_head(d, version=2), "version 2"),
    "another degree": (lambda d: with_head(d, degree=4), "of degree 4"),
    "too many": (lambda d: with_head(d, count=2**32 - 1), "4294967295 splats"),
    "too many of a degree": (lambda d: with_head(d, degree=3, count=MAX_PACKED // 8), "of degree 3"),
    "fewer": (lambda d: with_head(d, count=49), "cannot be what it says"),
    "more": (lambda d: with_head(d, count=51), "incorrect header check"),
    "no step": (lambda d: with_record(d, 0, step=0.0), "cannot be what it says"),
    "a step that is not a number": (lambda d: with_record(d, 0, step=float("nan")), "cannot be what it says"),
    "an endless step": (lambda d: with_record(d, 0, step=float("inf")), "cannot be what it says"),
    "scales without bound": (lambda d: with_record(d, 2, step=1e6), "numbers that no splat has"),
    "a component that none is": (lambda d: with_record(d, 5, lowest=4), "numbers that no splat has"),
    "opacities beyond 1": (lambda d: with_record(d, 6, lowest=0x4400), "numbers that no splat has"),
    "five million splats of nothing": (lambda d: claims_much(), "cannot be what it says"),
    "more in a stream than it says": (lambda d: bomb(), "not as long as it says"),
}


@pytest.mark.parametrize("name", STRANGE)
def test_a_file_that_is_damaged_or_lies_is_refused_in_one_line(tmp_path, sound, name):
    change, told = STRANGE[name]
    (tmp_path / "a.flsp").write_bytes(change(sound))
    with pytest.raises(InputRejected, match=told) as refused:
        read_packed(tmp_path / "a.flsp")
    assert "\n" not in str(refused.value)


@given(st.data())
def test_any_other_byte_is_a_frame_or_a_refusal(tmp_path_factory, data):
    folder = tmp_path_factory.mktemp("p")
    written = write_packed(folder / "a.flsp", cloud(50), ids=np.arange(50), velocities=moving(50))
    spoiled = bytearray(written.read_bytes())
    for _ in range(data.draw(st.integers(1, 4))):
        spoiled[data.draw(st.integers(0, len(spoiled) - 1))] = data.draw(st.integers(0, 255))
    Path(written).write_bytes(bytes(spoiled))
    try:
        found = read_packed(written)
    except InputRejected:
        return
    assert packable(found.gaussians, found.velocities)
