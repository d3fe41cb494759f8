"""Reads a case: a clip with a known truth, in one folder.

Files: `video.mp4`; `camera.json` (width, height, K, R, t); `scene.json` (domain_min, dx, grid, gravity, dt, ...);
`truth.npz` (flow, depth, dz, mask, visible, static_depth, key_frames, grid_velocity, grid_phi or grid_density, ...);
`solids.npz` (<name>_v, <name>_f, <name>_rgb).
"""

from __future__ import annotations

import zipfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from fluidlift.errors import InputRejected
from fluidlift.io.array_archive import DAMAGE, IN_MEMORY, array_in, members_of
from fluidlift.io.limits import parse_json
from fluidlift.types import Grid, PinholeCamera, TriangleMesh

LARGEST_BYTES = 4 << 30
"""unpacked size of one npz that is still read"""
LARGEST_SMALL = 1 << 30
"""bytes of its arrays that are held in memory"""

SMOKE_SHARE = 0.05
"""a cell of a gas counts as occupied above this share of the largest density"""


@dataclass(frozen=True)
class Case:
    """What really happened in a clip of T frames of H x W pixels."""

    name: str
    video: Path
    camera: PinholeCamera
    """in the world of the truth"""
    interval: float
    """s between frames"""
    flow: Float[np.ndarray, "t h w 2"]
    """px/frame of the surface point at each pixel centre, from t to t+1; 0 outside the mask"""
    depth: Float[np.ndarray, "t h w"]
    """camera z of the fluid surface, m; 0 outside the mask"""
    depth_change: Float[np.ndarray, "t h w"]
    """change of camera z of the same point from t to t+1, m"""
    mask: Bool[np.ndarray, "t h w"]
    """fluid visible"""
    visible: Bool[np.ndarray, "t h w"] | None
    """the point is still the visible surface at t+1"""
    static_depth: Float[np.ndarray, "h w"]
    """camera z of the solids alone, m; 0 = none"""
    grid: Grid
    key_frames: Int[np.ndarray, " k"]
    velocity: Float[np.ndarray, "k nx ny nz 3"]
    """m/s at cell centres at the key frames"""
    level_set: Float[np.ndarray, "k nx ny nz"] | None
    """cells, negative inside; None for a gas"""
    density: Float[np.ndarray, "k nx ny nz"] | None
    """of a gas; None for a liquid"""
    scene: dict[str, Any]
    solids: dict[str, TriangleMesh]

    def __len__(self) -> int:
        return len(self.mask)

    @property
    def size(self) -> tuple[int, int]:
        """Width, height in px."""
        return self.camera.size

    def occupied(self, key: int) -> Bool[np.ndarray, "nx ny nz"]:
        """Cells that hold fluid at the key frame of this index."""
        if self.level_set is not None:
            return self.level_set[key] < 0
        assert self.density is not None
        density = self.density[key].astype(np.float32)
        return density > SMOKE_SHARE * max(float(density.max()), 1e-9)


def _plain_file(folder: Path, name: str) -> Path:
    path = folder / name
    if path.is_symlink() or not path.is_file():
        raise InputRejected(
            f"no plain file '{name}' in case '{folder.name}'",
            "a case folder with video.mp4, camera.json, scene.json, truth.npz and solids.npz",
        )
    return path


def read_json(path: Path) -> dict[str, Any]:
    """A JSON object.

    Raises:
        InputRejected: not JSON, or not an object.
    """
    try:
        data = parse_json(path.read_bytes())
    except (OSError, ValueError) as error:
        raise InputRejected(f"'{path.name}' cannot be read ({type(error).__name__})", "a JSON object") from None
    if not isinstance(data, dict):
        raise InputRejected(f"'{path.name}' holds a {type(data).__name__}", "a JSON object")
    return data


def read_arrays(path: Path) -> dict[str, np.ndarray]:
    """All arrays of an npz file, none of them pickled.

    Raises:
        InputRejected: damaged, pickled, or larger than `LARGEST_BYTES` unpacked.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            members = members_of(archive, LARGEST_BYTES)
            small = sum(item.file_size for item in members.values() if item.file_size <= IN_MEMORY)
            if small > LARGEST_SMALL:  # larger ones are mapped, and take no memory
                raise ValueError(f"small arrays of {small} bytes in all")
            return {name: array_in(archive, item) for name, item in members.items()}
    except DAMAGE as error:
        raise InputRejected(
            f"'{path.name}' cannot be read ({type(error).__name__}: {error})", "an npz of plain arrays"
        ) from None


class _Truth:
    """Typed access to the arrays of truth.npz."""

    def __init__(self, arrays: dict[str, np.ndarray]) -> None:
        self.arrays = arrays

    def get(self, name: str, shape: tuple[int | None, ...]) -> np.ndarray:
        """The array, checked: None in `shape` is any length."""
        if name not in self.arrays:
            raise InputRejected(f"truth.npz without '{name}'", f"an array of shape {shape}")
        array = self.arrays[name]
        fits = array.ndim == len(shape) and all(want in (None, got) for want, got in zip(shape, array.shape))
        if not fits or array.dtype.kind not in "fiub":
            raise InputRejected(f"'{name}' in truth.npz is {array.dtype} {array.shape}", f"numbers of shape {shape}")
        if array.dtype.kind == "f" and not np.isfinite(array).all():
            raise InputRejected(f"'{name}' in truth.npz holds numbers that are not finite", "finite numbers")
        return array

    def bits(self, name: str, frames: int, size: tuple[int, int]) -> np.ndarray:
        """A packed mask, bool [T,H,W]."""
        packed = self.get(name, (frames, size[1], (size[0] + 7) // 8))
        if packed.dtype != np.uint8:
            raise InputRejected(f"'{name}' in truth.npz is {packed.dtype}", "uint8, packed along the rows")
        return np.unpackbits(packed, axis=-1)[..., : size[0]].astype(bool)


def _grid(scene: dict[str, Any]) -> Grid:
    try:
        shape = tuple(int(n) for n in scene["grid"])
        origin = tuple(float(x) for x in scene["domain_min"])
        if len(shape) != 3 or len(origin) != 3:
            raise ValueError("three numbers each")
        return Grid(shape, float(scene["dx"]), origin)
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        raise InputRejected(
            f"scene.json whose grid cannot be read ({type(error).__name__}: {error})",
            "grid [nx,ny,nz], domain_min [3] in m and dx in m",
        ) from None


def _interval(scene: dict[str, Any]) -> float:
    dt = scene.get("dt", 0.04)
    if not isinstance(dt, int | float) or not np.isfinite(dt) or dt <= 0:
        raise InputRejected(f"scene.json with dt = {dt!r}", "seconds between frames, positive")
    return float(dt)


def _solids(arrays: dict[str, np.ndarray]) -> dict[str, TriangleMesh]:
    meshes = {}
    for key in arrays:
        if not key.endswith("_v"):
            continue
        name = key[:-2]
        vertices, faces = arrays[key], arrays.get(f"{name}_f")
        fits = vertices.ndim == 2 and vertices.shape[1] == 3 and np.isfinite(vertices).all()
        if not fits or faces is None or faces.ndim != 2 or faces.shape[1] != 3 or faces.dtype.kind not in "iu":
            raise InputRejected(f"solid '{name}' in solids.npz", f"{name}_v [n,3] in m and {name}_f [m,3] integers")
        if faces.size and (faces.min() < 0 or faces.max() >= len(vertices)):
            raise InputRejected(f"solid '{name}' in solids.npz has faces of missing vertices", "indices of vertices")
        rgb = arrays.get(f"{name}_rgb")
        colors = None if rgb is None or rgb.shape != (3,) else np.broadcast_to(rgb.astype(np.float32), vertices.shape)
        meshes[name] = TriangleMesh(vertices.astype(np.float32), faces.astype(np.int64), colors)
    return meshes


def read_case(folder: Path) -> Case:
    """Read and check a case folder.

    Raises:
        InputRejected: a file is missing, a link, damaged, pickled or too large, or an array has the wrong shape.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise InputRejected(f"'{folder.name}' is not a folder", "a case folder")
    camera = PinholeCamera.from_dict(read_json(_plain_file(folder, "camera.json")))
    scene = read_json(_plain_file(folder, "scene.json"))
    truth = _Truth(read_arrays(_plain_file(folder, "truth.npz")))
    grid, (w, h) = _grid(scene), camera.size
    frames = truth.get("flow", (None, h, w, 2)).shape[0]
    keys = truth.get("key_frames", (None,)).astype(np.int64)
    if len(keys) == 0 or keys.min() < 0 or keys.max() >= frames:
        raise InputRejected(f"key frames {keys.tolist()} of {frames} frames", "at least one, each a frame of the clip")
    k = len(keys)
    liquid = "grid_phi" in truth.arrays
    name = "grid_phi" if liquid else "grid_density"
    volume = truth.get(name, (k, *grid.shape))
    return Case(
        str(scene.get("case", folder.name)),
        _plain_file(folder, "video.mp4"),
        camera,
        _interval(scene),
        truth.get("flow", (frames, h, w, 2)),
        truth.get("depth", (frames, h, w)),
        truth.get("dz", (frames, h, w)),
        truth.bits("mask", frames, (w, h)),
        truth.bits("visible", frames, (w, h)) if "visible" in truth.arrays else None,
        truth.get("static_depth", (h, w)),
        grid,
        keys,
        truth.get("grid_velocity", (k, *grid.shape, 3)),
        volume if liquid else None,
        None if liquid else volume,
        scene,
        _solids(read_arrays(_plain_file(folder, "solids.npz"))),
    )
