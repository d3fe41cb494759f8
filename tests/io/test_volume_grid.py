"""What is written as OpenVDB holds the voxels, where they are, and nothing else.

`benchmarks/check_openvdb.py` compares with the official library, which has no wheel. Here an independent reader of the
format, written from its description (every byte is accounted for), stands in for it; the library is used too where it
can be imported.
"""

from __future__ import annotations

import numpy as np
import pytest
from read_vdb import read_vdb

from fluidlift.io.volume_grid import VolumeGrid, velocity_grid, write_vdb
from fluidlift.types import FaceVelocity, Grid

CASES = {
    "dense": ((16, 8, 24), (0, 0, 0), 1.0),
    "ragged and sparse": ((13, 9, 5), (0, 0, 0), 0.03),
    "negative indices": ((10, 11, 12), (-7, -130, -4099), 0.5),
    "across nodes": ((12, 12, 12), (4090, 122, -6), 1.0),
    "one voxel": ((1, 1, 1), (-1, -1, -1), 1.0),
}


@pytest.mark.parametrize("case", list(CASES))
def test_every_voxel_comes_back(tmp_path, case):
    shape, first, share = CASES[case]
    rng = np.random.default_rng(3)
    scalars, vectors = rng.random(shape).astype(np.float32), rng.normal(size=(*shape, 3)).astype(np.float32)
    active = rng.random(shape) <= share
    origin, spacing = (-1.5, 2.0, 0.25), 0.125
    grids = [
        VolumeGrid("density", scalars, spacing, origin, active, first),
        VolumeGrid("vel", vectors, spacing, origin, active, first, grid_class="unknown"),
    ]
    back = read_vdb(write_vdb(tmp_path / "a.vdb", grids))
    assert [g["name"] for g in back] == ["density", "vel"]
    for grid, truth in zip(back, (scalars[..., None], vectors)):
        where = np.argwhere(active)
        assert len(grid["voxels"]) == len(where)
        for ijk in where:
            np.testing.assert_array_equal(grid["voxels"][tuple(ijk + first)], truth[tuple(ijk)])
        assert grid["meta"]["file_bbox_min"] == tuple(where.min(0) + first)
        assert grid["meta"]["file_bbox_max"] == tuple(where.max(0) + first)
        translation, scale = np.array(grid["maps"][0]), np.array(grid["maps"][1])
        np.testing.assert_allclose(translation + scale * first, np.array(origin) + spacing / 2, atol=1e-12)
        np.testing.assert_allclose(grid["maps"][3:], [[8.0] * 3, [64.0] * 3, [4.0] * 3])
    assert back[1]["meta"]["class"] == "unknown" and back[0]["meta"]["class"] == "fog volume"
    assert back[1]["meta"]["vector_type"] == "contravariant relative"


def test_without_a_mask_only_what_differs_from_the_background_is_stored(tmp_path):
    values = np.zeros((20, 20, 20), np.float32)
    values[3, 4, 17] = 2.5
    (grid,) = read_vdb(write_vdb(tmp_path / "a.vdb", [VolumeGrid("density", values, 1.0)]))
    assert {k: float(v[0]) for k, v in grid["voxels"].items()} == {(3, 4, 17): 2.5}


def test_a_level_set_keeps_its_background(tmp_path):
    values = np.random.default_rng(0).normal(size=(9, 9, 9)).astype(np.float32)
    grid = VolumeGrid("surface", values, 0.1, active=np.abs(values) < 1, grid_class="level set", background=0.3)
    (back,) = read_vdb(write_vdb(tmp_path / "a.vdb", [grid]))
    assert back["background"] == pytest.approx(0.3) and len(back["voxels"]) == (np.abs(values) < 1).sum()


def test_an_empty_grid_is_a_file_too(tmp_path):
    (grid,) = read_vdb(write_vdb(tmp_path / "a.vdb", [VolumeGrid("density", np.zeros((8, 8, 8)), 1.0)]))
    assert grid["voxels"] == {}


def test_velocities_lie_at_cell_centres(tmp_path):
    grid = Grid((4, 3, 2), 0.5, (-1.0, 0.0, 2.0))
    x = [grid.faces(a)[..., 0] for a in range(3)]
    velocity = FaceVelocity(2 * x[0], np.zeros_like(x[1]), np.ones_like(x[2]))  # u = 2x
    (back,) = read_vdb(write_vdb(tmp_path / "a.vdb", [velocity_grid(velocity, grid)]))
    for (i, j, k), value in back["voxels"].items():
        center = np.array(back["maps"][0]) + 0.5 * np.array([i, j, k])
        np.testing.assert_allclose(value, [2 * center[0], 0, 1], atol=1e-6)


def test_numbers_that_are_not_finite_and_equal_names_are_faults_of_the_caller(tmp_path):
    with pytest.raises(ValueError, match="finite"):
        VolumeGrid("density", np.full((2, 2, 2), np.nan), 1.0)
    grid = VolumeGrid("density", np.ones((2, 2, 2)), 1.0)
    with pytest.raises(ValueError, match="same name"):
        write_vdb(tmp_path / "a.vdb", [grid, grid])


def test_openvdb_itself_reads_the_file(tmp_path):
    openvdb = pytest.importorskip("openvdb", reason="OpenVDB has no wheel; see benchmarks/check_openvdb.py")
    values = np.random.default_rng(1).random((20, 9, 30)).astype(np.float32)
    path = write_vdb(tmp_path / "a.vdb", [VolumeGrid("density", values, 0.1, (1.0, 2.0, 3.0))])
    got = np.zeros_like(values)
    openvdb.readAll(str(path))[0][0].copyToArray(got)
    np.testing.assert_array_equal(got, values)


def test_equal_grids_give_equal_files_and_other_ones_another_identifier(tmp_path):
    values = np.random.default_rng(0).random((9, 8, 7, 3)).astype(np.float32)
    files = [write_vdb(tmp_path / f"{k}.vdb", [VolumeGrid("vel", v, 0.1)]).read_bytes() for k, v in
             enumerate((values, values.copy(), values + 1))]  # fmt: skip
    assert files[0] == files[1]
    assert files[0][21:57] != files[2][21:57]  # after magic number, three versions and a flag
