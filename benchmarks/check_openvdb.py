"""Read our OpenVDB files back with the official library.

OpenVDB has no wheel on PyPI, so this runs in two steps that may use two interpreters:

    python benchmarks/check_openvdb.py write FOLDER           # with fluidlift
    /usr/bin/python3 benchmarks/check_openvdb.py read FOLDER  # with OpenVDB (Debian: python3-openvdb)

The second step exits with 1 when a voxel, a position, a mask or a name differs.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np

CASES = {
    # name: (shape, first index, origin, spacing, share of active voxels)
    "dense": ((24, 16, 40), (0, 0, 0), (0.0, 0.0, 0.0), 0.1, 1.0),
    "sparse": ((33, 17, 9), (0, 0, 0), (1.5, -2.25, 0.5), 0.05, 0.02),
    "negative": ((20, 21, 22), (-7, -130, -4099), (-3.0, -4.0, -5.0), 0.25, 0.5),
    "node_borders": ((16, 16, 24), (4088, 120, -8), (0.0, 0.0, 0.0), 1.0, 1.0),
    "single_voxel": ((1, 1, 1), (-1, -1, -1), (-0.5, 0.0, 0.5), 0.125, 1.0),
}


def data(name: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Scalars, vectors and mask of a case: the same numbers in both interpreters."""
    shape, *_, share = CASES[name]
    rng = np.random.RandomState(sorted(CASES).index(name))  # the same stream in every NumPy
    scalars = rng.rand(*shape).astype(np.float32) + 0.5
    return scalars, rng.randn(*shape, 3).astype(np.float32), rng.rand(*shape) <= share


def write(folder: Path) -> int:
    """Write every case with fluidlift."""
    from fluidlift.io.volume_grid import VolumeGrid, write_vdb

    for name, (_, first, origin, spacing, _) in CASES.items():
        scalars, vectors, mask = data(name)
        grids = [
            VolumeGrid("density", scalars, spacing, origin, mask, first),
            VolumeGrid("vel", vectors, spacing, origin, mask, first, grid_class="unknown"),
        ]
        write_vdb(folder / f"{name}.vdb", grids)
    print(json.dumps({"written": sorted(CASES)}))
    return 0


def read(folder: Path) -> int:
    """Compare every case with what OpenVDB reads."""
    try:
        import openvdb
    except ImportError:
        import pyopenvdb as openvdb
    faults = []
    for name, (_shape, first, origin, spacing, _) in CASES.items():
        scalars, vectors, mask = data(name)
        grids = {g.name: g for g in openvdb.readAll(str(folder / f"{name}.vdb"))[0]}
        if sorted(grids) != ["density", "vel"]:
            faults.append(f"{name}: grids {sorted(grids)}")
            continue
        for grid, truth in ((grids["density"], scalars), (grids["vel"], vectors)):
            got = np.zeros(truth.shape, np.float32)
            grid.copyToArray(got, ijk=first)
            expected = np.where(mask if truth.ndim == 3 else mask[..., None], truth, 0)
            if not np.array_equal(got, expected):
                faults.append(f"{name}/{grid.name}: largest difference {np.abs(got - expected).max()}")
            if grid.activeVoxelCount() != mask.sum():
                faults.append(f"{name}/{grid.name}: {grid.activeVoxelCount()} active voxels, not {mask.sum()}")
            low, high = grid.evalActiveVoxelBoundingBox()
            where = np.argwhere(mask) + first
            if tuple(low) != tuple(where.min(0)) or tuple(high) != tuple(where.max(0)):
                faults.append(f"{name}/{grid.name}: bounds {low} {high}")
            center = np.array(grid.transform.indexToWorld(first))
            if not np.allclose(center, np.array(origin) + 0.5 * spacing, atol=1e-9):
                faults.append(f"{name}/{grid.name}: first voxel at {center}")
            inactive = grid.getConstAccessor()
            for ijk in np.argwhere(~mask)[:50] + first:
                if inactive.isValueOn(tuple(int(i) for i in ijk)):
                    faults.append(f"{name}/{grid.name}: {ijk} is active")
    version = getattr(openvdb, "LIBRARY_VERSION", "?")
    print(json.dumps({"openvdb": str(version), "cases": sorted(CASES), "faults": faults}, indent=2))
    return 1 if faults else 0


if __name__ == "__main__":
    steps = {"write": write, "read": read}
    if len(sys.argv) != 3 or sys.argv[1] not in steps:
        sys.exit(__doc__)
    sys.exit(steps[sys.argv[1]](Path(sys.argv[2])))
