"""PLY: Gaussians as 3D Gaussian splatting tools exchange them, points, and meshes. Binary, written with NumPy.

The splat file is that of the first Gaussian splatting code: logarithms of the scales, logits of the opacities,
quaternions w x y z, and the harmonics above degree 0 channel by channel (all coefficients of red, of green, of blue).
Most such files have y down. Here the world's z-up axes are kept unless another frame is asked for; a comment in the
header says which. Further properties carry the stable id and the velocity of each splat.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from fluidlift.errors import InputRejected, require
from fluidlift.io.limits import require_file
from fluidlift.io.ply_records import Element, named_records, open_ply, read_elements, write_elements
from fluidlift.types import Gaussians, Similarity3, TriangleMesh

AXES = {
    "z_up": np.eye(3),
    "y_up": np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]]),
    "y_down": np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]]),
}
"""rotations file_from_world: the world's own axes; glTF's (y up, z back); those of splat viewers (y down, z forward)"""

MAX_SPLATS = 30_000_000
"""of one file. Read, they take 56 bytes each, and 12 more for every harmonic above degree 0"""
PART = 2**18
"""splats that are read at a time"""

_OPACITY_EDGE = 1e-6
"""opacities are kept this far from 0 and 1, where the logit is infinite"""
_LARGEST_LOG = 60.0
"""of a scale: e^60 is finite in single precision, and no splat"""
_FEWEST_TO_JUDGE = 16
"""splats, from which on their numbers tell whether they are activated"""


@dataclass(frozen=True)
class SplatFile:
    """The content of a splat PLY, in world axes."""

    gaussians: Gaussians
    extras: dict[str, np.ndarray] = field(default_factory=dict)
    """further properties by name: id int32 [n], vx, vy, vz float32 [n] in m/s, ..."""
    comments: tuple[str, ...] = ()


def write_gaussians(
    path: Path | str,
    gaussians: Gaussians,
    *,
    ids: Int[np.ndarray, " n"] | None = None,
    velocities: Float[np.ndarray, "n 3"] | None = None,
    extras: Mapping[str, np.ndarray] | None = None,
    axes: str = "z_up",
    comments: Sequence[str] = (),
) -> Path:
    """Write a splat PLY.

    Args:
        gaussians: world, m.
        ids: become the property `id`.
        velocities: m/s, become vx, vy, vz.
        extras: further properties [n] of any number kind.
        axes: "z_up" (the world as it is), "y_up" or "y_down". View-dependent harmonics turn with the frame.
        comments: lines for the header.
    """
    n = len(gaussians)
    require(axes in AXES, f"axes '{axes}'", "one of " + ", ".join(AXES))
    turned = gaussians if axes == "z_up" else gaussians.transformed(Similarity3(rotation=AXES[axes]))
    columns: dict[str, np.ndarray] = dict(zip(("x", "y", "z"), turned.means.T))
    columns |= {name: np.zeros(n, np.float32) for name in ("nx", "ny", "nz")}
    columns |= {f"f_dc_{c}": turned.sh[:, 0, c] for c in range(3)}
    rest = turned.sh[:, 1:].transpose(0, 2, 1).reshape(n, 3 * (turned.sh.shape[1] - 1))
    columns |= {f"f_rest_{i}": rest[:, i] for i in range(rest.shape[1])}
    opacity = np.clip(turned.opacities.astype(np.float64), _OPACITY_EDGE, 1 - _OPACITY_EDGE)
    columns["opacity"] = np.log(opacity / (1 - opacity))
    scales = np.log(np.maximum(turned.scales.astype(np.float64), 1e-20))
    columns |= {f"scale_{a}": scales[:, a] for a in range(3)}
    columns |= {f"rot_{a}": turned.quats[:, a] for a in range(4)}
    columns = {name: column.astype(np.float32) for name, column in columns.items()}
    if ids is not None:
        columns["id"] = np.asarray(ids).astype(np.int32)
    if velocities is not None:
        v = np.asarray(velocities, np.float32).reshape(n, 3) @ AXES[axes].T.astype(np.float32)
        columns |= dict(zip(("vx", "vy", "vz"), v.T))
    columns |= extras or {}
    note = f"fluidlift splats, metres, axes {axes}"
    write_elements(path, [("vertex", named_records(columns, n))], [note, *comments])
    return Path(path)


def read_splats(
    path: Path | str,
    *,
    axes: str | None = None,
    coefficient_major: bool = False,
    activated: bool = False,
    drop_broken: bool = False,
) -> SplatFile:
    """Read a splat PLY into z-up axes, part by part: the memory needed is that of the result.

    Args:
        path: of the file.
        axes: of the file, one of `AXES`; None: those that our own header comment names, else z-up as they stand.
        coefficient_major: harmonics lie coefficient by coefficient (red, green, blue of each), as TriplaneGaussian
            writes them, in place of channel by channel.
        activated: scales and opacities are what they say, in place of their logarithms and logits.
        drop_broken: leave out splats that are not finite or have no rotation, in place of refusing the file.

    Raises:
        InputRejected: no such file, not a binary PLY, a header that promises more than the file holds, missing
            properties, more than `MAX_SPLATS`, numbers that are not finite, or scales or opacities that are already
            activated.
    """
    path = require_file(path, "PLY file")
    require(axes is None or axes in AXES, f"axes '{axes}'", "one of " + ", ".join(AXES))
    elements, comments = open_ply(path)
    if "vertex" not in elements:
        raise InputRejected(f"'{path.name}' has no vertices", "a Gaussian splat PLY")
    vertex = elements["vertex"]
    rest = _require_splats(path, vertex)
    columns = _SplatColumns.of(vertex, rest, coefficient_major)
    for where, records in vertex.parts(PART):
        columns.take(where, records)
    if not activated:
        _require_raw(path, columns)
    keep = _sound(path, columns, activated=activated, drop=drop_broken)
    named = next((c.rsplit(" ", 1)[1] for c in comments if c.startswith("fluidlift splats") and " axes " in c), "z_up")
    world_from_file = AXES.get(axes or named, AXES["z_up"]).T
    extras = {name: column if keep is None else column[keep] for name, column in columns.extras.items()}
    if {"vx", "vy", "vz"} <= extras.keys():
        turned = np.stack([extras[v] for v in ("vx", "vy", "vz")], axis=-1) @ world_from_file.T.astype(np.float32)
        extras |= {v: np.ascontiguousarray(turned[:, i]) for i, v in enumerate(("vx", "vy", "vz"))}
    gaussians = columns.gaussians(activated)
    gaussians = gaussians if keep is None else gaussians.select(keep)
    if not np.array_equal(world_from_file, np.eye(3)):
        gaussians = gaussians.transformed(Similarity3(rotation=world_from_file))
    return SplatFile(gaussians, extras, tuple(comments))


def read_gaussians(path: Path | str) -> Gaussians:
    """The Gaussians of a splat PLY; raises as `read_splats`."""
    return read_splats(path).gaussians


def write_points(
    path: Path | str,
    points: Float[np.ndarray, "n 3"],
    *,
    colors: Float[np.ndarray, "n 3"] | None = None,
    extras: Mapping[str, np.ndarray] | None = None,
    comment: str = "metres, z up",
) -> Path:
    """Write a point cloud as it stands; colours are sRGB in [0, 1]. The comment says in which axes and units."""
    columns = _vertex_columns(points, colors) | dict(extras or {})
    write_elements(path, [("vertex", named_records(columns, len(points)))], [comment])
    return Path(path)


def write_mesh(
    path: Path | str,
    mesh: TriangleMesh,
    *,
    velocities: Float[np.ndarray, "v 3"] | None = None,
    comment: str = "metres, z up",
) -> Path:
    """Write a triangle mesh as it stands; velocities (m/s) become vx, vy, vz of the vertices for motion blur. The
    comment says in which axes and units it stands."""
    columns = _vertex_columns(mesh.vertices, mesh.colors)
    if velocities is not None:
        columns |= dict(zip(("vx", "vy", "vz"), np.asarray(velocities, np.float32).reshape(-1, 3).T))
    faces = np.empty(len(mesh.faces), np.dtype([("count", "u1"), ("vertex_indices", "<i4", (3,))]))
    faces["count"], faces["vertex_indices"] = 3, mesh.faces
    write_elements(path, [("vertex", named_records(columns, len(mesh.vertices))), ("face", faces)], [comment])
    return Path(path)


def read_mesh(path: Path | str) -> TriangleMesh:
    """Read a mesh as `write_mesh` writes it (triangles, vertex_indices as int lists of 3).

    Raises:
        InputRejected: no such file, another kind of PLY, or indices that name no vertex.
    """
    path = require_file(path, "PLY file")
    elements, _ = read_elements(path)
    if (
        "vertex" not in elements
        or "face" not in elements
        or "vertex_indices" not in (elements["face"].dtype.names or ())
    ):
        raise InputRejected(f"'{path.name}' holds no mesh", "a binary PLY with vertices and triangles")
    vertex, faces = elements["vertex"], elements["face"]["vertex_indices"].astype(np.int64)
    if len(faces) and (faces.min() < 0 or faces.max() >= len(vertex)):
        raise InputRejected(f"'{path.name}' has faces that name missing vertices", "a whole mesh")
    points = np.stack([vertex[a].astype(np.float32) for a in "xyz"], axis=-1)
    colors = None
    if {"red", "green", "blue"} <= set(vertex.dtype.names or ()):
        colors = np.stack([vertex[c] for c in ("red", "green", "blue")], axis=-1).astype(np.float32) / 255.0
    return TriangleMesh(points, faces, colors)


@dataclass(frozen=True)
class _SplatColumns:
    """The numbers of a splat file as they stand in it, column by column."""

    means: np.ndarray
    quats: np.ndarray
    scales: np.ndarray
    opacities: np.ndarray
    sh: np.ndarray
    rest: tuple[str, ...]
    coefficient_major: bool
    extras: dict[str, np.ndarray]

    @classmethod
    def of(cls, vertex: Element, rest: tuple[str, ...], coefficient_major: bool) -> _SplatColumns:
        n, names = vertex.count, vertex.dtype.names or ()
        known = {*_NEEDED, *rest, "nx", "ny", "nz"}
        extras = {
            x: np.empty((n, *vertex.dtype[x].shape), vertex.dtype[x].base.newbyteorder("="))
            for x in names
            if x not in known
        }
        means, quats, scales = (np.empty((n, k), np.float32) for k in (3, 4, 3))
        sh = np.empty((n, 1 + len(rest) // 3, 3), np.float32)
        return cls(means, quats, scales, np.empty(n, np.float32), sh, rest, coefficient_major, extras)

    def take(self, where: slice, records: np.ndarray) -> None:
        """Fill in one part."""
        for target, names in (
            (self.means, ("x", "y", "z")),
            (self.quats, _numbered("rot", 4)),
            (self.scales, _numbered("scale", 3)),
            (self.sh[:, 0], _numbered("f_dc", 3)),
        ):
            for i, name in enumerate(names):
                target[where, i] = records[name]
        self.opacities[where] = records["opacity"]
        higher = len(self.rest) // 3
        for i in range(len(self.rest)):
            coefficient, channel = divmod(i, 3) if self.coefficient_major else divmod(i, higher)[::-1]
            self.sh[where, 1 + coefficient, channel] = records[f"f_rest_{i}"]
        for name, column in self.extras.items():
            column[where] = records[name]

    def gaussians(self, activated: bool) -> Gaussians:
        """Activated, with unit quaternions, in the file's axes; the columns are used up."""
        norm = np.linalg.norm(self.quats, axis=1, keepdims=True)
        np.divide(self.quats, np.maximum(norm, 1e-12), out=self.quats)
        if not activated:
            np.exp(np.clip(self.scales, -_LARGEST_LOG, _LARGEST_LOG, out=self.scales), out=self.scales)
            self.opacities[:] = 1.0 / (1.0 + np.exp(-np.clip(self.opacities.astype(np.float64), -60, 60)))
        return Gaussians(self.means, self.quats, self.scales, self.opacities, self.sh)


def _numbered(stem: str, count: int) -> tuple[str, ...]:
    return tuple(f"{stem}_{i}" for i in range(count))


_NEEDED = ("x", "y", "z", *_numbered("f_dc", 3), "opacity", *_numbered("scale", 3), *_numbered("rot", 4))


def _require_splats(path: Path, vertex: Element) -> tuple[str, ...]:
    """The names of the higher harmonics of what is a splat file of bearable size."""
    names = vertex.dtype.names or ()
    missing = [name for name in _NEEDED if name not in names]
    rest = tuple(name for name in names if name.startswith("f_rest_"))
    if missing or len(rest) not in (0, 9, 24, 45) or any(f"f_rest_{i}" not in names for i in range(len(rest))):
        what = f"missing {', '.join(missing)}" if missing else f"{len(rest)} of f_rest"
        raise InputRejected(
            f"'{path.name}' is not a splat file ({what})",
            "a PLY with f_dc, opacity, scale and rot, and 0, 9, 24 or 45 of f_rest",
            "convert it to the uncompressed PLY of 3D Gaussian splatting",
        )
    lists = [name for name in (*_NEEDED, *rest) if vertex.dtype[name].shape]
    if lists:
        raise InputRejected(f"'{path.name}' has lists as {', '.join(lists[:3])}", "one number per property")
    if vertex.count > MAX_SPLATS:
        raise InputRejected(
            f"'{path.name}' holds {vertex.count} splats", f"at most {MAX_SPLATS}", "thin it in a splat editor"
        )
    return rest


def _sound(path: Path, columns: _SplatColumns, *, activated: bool, drop: bool) -> np.ndarray | None:
    """None if every splat is sound; else which are, or a refusal that says what is wrong with how many."""
    faults: dict[str, np.ndarray] = {}
    for what, array in (
        ("positions", columns.means), ("rotations", columns.quats), ("scales", columns.scales),
        ("opacities", columns.opacities), ("colours", columns.sh),
    ):  # fmt: skip
        whole = ~np.isnan(array) if what == "opacities" and not activated else np.isfinite(array)  # logit 1 is infinite
        broken = np.asarray(~whole.all(axis=tuple(range(1, array.ndim))))
        if what == "rotations":
            broken |= np.abs(columns.quats).max(1, initial=0.0) < 1e-6
        if what == "scales":
            broken |= np.any(columns.scales <= 0 if activated else columns.scales > _LARGEST_LOG, axis=1)
        if broken.any():
            faults[what] = broken
    if not faults:
        return None
    keep = ~np.any(list(faults.values()), axis=0)
    if not drop:
        parts = ", ".join(f"{int(b.sum())} with broken {what}" for what, b in faults.items())
        raise InputRejected(
            f"'{path.name}' holds {int((~keep).sum())} of {len(keep)} splats that are not finite or have no rotation "
            f"({parts})",
            "finite splats",
            "remove them in a splat editor, or make the body again",
        )
    return keep


def _require_raw(path: Path, columns: _SplatColumns) -> None:
    """Refuse a file whose scales or opacities were written without the logarithm and the logit.

    Such a file is found by what it would mean: scales that are all positive would be logarithms of standard
    deviations above 1. They are refused if half of the splats were then wider than a quarter of the body, or lay
    100-fold over each other (a filled body has about one layer, many united frames some tens), although as plain
    numbers they would not. Opacities that all lie in [0, 1] would mean 0.5 to 0.73 everywhere; they are refused if they
    spread over more than half of that range, or the scales give the file away.
    """
    if len(columns.means) < _FEWEST_TO_JUDGE:
        return
    body = columns.means[np.isfinite(columns.means).all(1)]
    scales, logit = columns.scales[np.isfinite(columns.scales)], columns.opacities[np.isfinite(columns.opacities)]
    if not len(body) or not len(scales) or not len(logit):
        return
    low, high = np.percentile(body, [5, 95], axis=0)

    def absurd(width: float) -> bool:
        room = float(np.prod(np.maximum(high - low, width)))
        return width > 0.25 * float(np.linalg.norm(high - low)) or len(body) * 4.19 * width**3 > 100 * room

    middle = float(np.median(scales))
    plain_scales = bool(scales.min() >= 0) and absurd(float(np.exp(min(middle, _LARGEST_LOG)))) and not absurd(middle)
    within = bool(logit.min() >= 0 and logit.max() <= 1)
    plain_opacities = within and (plain_scales or float(logit.max() - logit.min()) > 0.5)
    if plain_scales or plain_opacities:
        which = " and ".join(["scales"] * plain_scales + ["opacities"] * plain_opacities)
        raise InputRejected(
            f"the {which} of '{path.name}' are already activated (from {float(scales.min()):.3g} to "
            f"{float(scales.max()):.3g}, and {float(logit.min()):.3g} to {float(logit.max()):.3g})",
            "logarithms of the scales and logits of the opacities, as 3D Gaussian splatting writes them",
            "save it again with them (LGM: compatible=True)",
        )


def _vertex_columns(points: np.ndarray, colors: np.ndarray | None) -> dict[str, np.ndarray]:
    columns: dict[str, np.ndarray] = {}
    columns |= dict(zip(("x", "y", "z"), np.asarray(points, np.float32).T))
    if colors is not None:
        eight = np.round(255 * np.clip(np.asarray(colors), 0, 1)).astype(np.uint8)
        columns |= dict(zip(("red", "green", "blue"), eight.T))
    return columns
