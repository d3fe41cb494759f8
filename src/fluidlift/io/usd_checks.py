"""What OpenUSD's validators do not look at: the arrays of splats, points, meshes and cameras at every time code."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np
from pxr import Usd, UsdGeom, UsdVol

from fluidlift.io.frame_checks import ParticleFrame, identity_faults, repeated
from fluidlift.types import triple

NORM = 1e-3
"""of a unit quaternion, as NVIDIA's rule has it; rounding to half precision moves it by up to 5e-4"""

Check = Callable[[Usd.Prim, Usd.TimeCode], list[str]]

_HARMONICS = "radiance:sphericalHarmonicsCoefficients"


def prim_faults(prim: Usd.Prim, codes: range) -> Iterator[str]:
    """Faults of one prim, at its default values and at every time code that it or the stage names.

    Args:
        prim: of a type that is looked at; others have none.
        codes: of the frames. What moves needs a sample at each of them.
    """
    checks = next((c for schema, c in _CHECKS if prim.IsA(schema)), ())
    if not checks:
        return
    moving = [a for a in prim.GetAttributes() if a.GetNumTimeSamples()]
    own = sorted({t for a in moving for t in a.GetTimeSamples()})
    missing = sorted(set(map(float, codes)) - set(own)) if own else []
    if missing:
        yield f"{prim.GetPath()}: no samples at {len(missing)} of {len(codes)} frames, such as {missing[0]:g}"
    for time in (Usd.TimeCode.Default(), *map(Usd.TimeCode, own)):
        for check in checks:
            yield from (f"{prim.GetPath()} at {_told(time)}: {fault}" for fault in check(prim, time))
    if prim.IsA(UsdGeom.Points):
        yield from _identities(prim, own)


def _told(time: Usd.TimeCode) -> str:
    return "default" if time.IsDefault() else f"{time.GetValue():g}"


def _array(prim: Usd.Prim, time: Usd.TimeCode, *names: str) -> np.ndarray | None:
    """The first attribute of these names that has a value."""
    for name in names:
        attribute = prim.GetAttribute(name)
        if attribute and (value := attribute.Get(time)) is not None:
            return np.asarray(value)
    return None


def _lengths(prim: Usd.Prim, time: Usd.TimeCode, expected: dict[str, tuple[int, ...]], of: str) -> list[str]:
    """Optional arrays that have another length than one of those expected, or numbers that are not finite."""
    faults = []
    for name, lengths in expected.items():
        values = _array(prim, time, name)
        if values is None:
            continue
        if len(values) not in lengths:
            faults.append(f"{len(values)} {name} for {of}")
        elif values.dtype.kind == "f" and not np.isfinite(values.astype(np.float32)).all():
            faults.append(f"{name} that are not finite")
    return faults


def _splat_faults(prim: Usd.Prim, time: Usd.TimeCode) -> list[str]:
    positions = _array(prim, time, "positions", "positionsh")
    if positions is None:
        return ["no positions"]
    n, faults = len(positions), []
    degree = int(prim.GetAttribute("radiance:sphericalHarmonicsDegree").Get(time))
    if not 0 <= degree <= 3:
        faults.append(f"harmonics of degree {degree}, not 0 to 3")
    per_splat = (degree + 1) ** 2
    arrays = {
        "scales": (_array(prim, time, "scales", "scalesh"), n),
        "orientations": (_array(prim, time, "orientations", "orientationsh"), n),
        "opacities": (_array(prim, time, "opacities", "opacitiesh"), n),
        "harmonics": (_array(prim, time, _HARMONICS, _HARMONICS + "h"), n * per_splat),
    }
    for name, (values, length) in arrays.items():
        if values is None:
            faults.append(f"no {name}")
        elif len(values) != length:
            faults.append(f"{len(values)} {name} for {n} splats, not {length}")
        elif not np.isfinite(values.astype(np.float32)).all():
            faults.append(f"{name} that are not finite")
    if time.IsDefault():
        faults += _harmonics_faults(prim, per_splat)
    if faults or n == 0:
        return faults
    if not np.isfinite(positions).all():
        faults.append("positions that are not finite")
    faults += _range_faults({name: values for name, (values, _) in arrays.items() if values is not None})
    return faults + _extent_faults(prim, time, positions)


def _range_faults(arrays: dict[str, np.ndarray]) -> list[str]:
    """Of scales, opacities and orientations [n,...] that are finite."""
    faults, opacities = [], arrays["opacities"]
    if not arrays["scales"].min() > 0:
        faults.append("scales of 0 or less")
    if opacities.min() < 0 or opacities.max() > 1:
        faults.append("opacities outside 0 to 1")
    norms = np.linalg.norm(arrays["orientations"].astype(np.float32), axis=-1)
    if np.abs(norms - 1).max() > NORM:
        faults.append("orientations that are not unit quaternions")
    return faults


def _harmonics_faults(prim: Usd.Prim, per_splat: int) -> list[str]:
    """Readers need to be told how the coefficients are shared out."""
    for name in (_HARMONICS, _HARMONICS + "h"):
        attribute = prim.GetAttribute(name)
        if attribute and attribute.HasValue():
            primvar = UsdGeom.Primvar(attribute)
            if primvar.GetInterpolation() != UsdGeom.Tokens.vertex or primvar.GetElementSize() != per_splat:
                return [f"harmonics without interpolation 'vertex' and element size {per_splat}"]
    return []


def _extent_faults(prim: Usd.Prim, time: Usd.TimeCode, positions: np.ndarray) -> list[str]:
    box = _array(prim, time, "extent")
    if box is None or box.shape != (2, 3):
        return ["no extent"]
    if not np.isfinite(box).all():
        return ["an extent that is not finite"]
    room = 1e-5 * max(1e-3, float(np.abs(positions).max()))
    inside = (positions >= box[0] - room).all() and (positions <= box[1] + room).all()
    return [] if inside else ["positions outside the extent"]


def _points_faults(prim: Usd.Prim, time: Usd.TimeCode) -> list[str]:
    points = _array(prim, time, "points")
    if points is None:
        return ["no points"]
    n = len(points)
    names = ("points", "widths", "ids", "velocities", "primvars:displayColor", "primvars:displayOpacity",
             "primvars:kind")  # fmt: skip
    expected: dict[str, tuple[int, ...]] = dict.fromkeys(names, (n,))
    faults = _lengths(prim, time, expected, f"{n} points")
    ids, widths = _array(prim, time, "ids"), _array(prim, time, "widths")
    if ids is not None and repeated(ids):
        faults.append("ids that occur twice")
    if widths is not None and len(widths) and not widths.min() > 0:
        faults.append("widths of 0 or less")
    kinds, opacity = _array(prim, time, "primvars:kind"), _array(prim, time, "primvars:displayOpacity")
    if prim.GetName() == "Whitewater" and (kinds is None or (len(kinds) and not 0 <= kinds.min() <= kinds.max() <= 2)):
        faults.append("kinds other than 0, 1 and 2")
    if opacity is not None and len(opacity) and not 0 <= opacity.min() <= opacity.max() <= 1:
        faults.append("opacities outside 0 to 1")
    return faults + (_extent_faults(prim, time, points) if n and not faults else [])


def _identities(prim: Usd.Prim, codes: list[float]) -> Iterator[str]:
    """Whether an id is the same particle from one frame to the next."""
    rate, before = prim.GetStage().GetTimeCodesPerSecond(), None
    for k, code in enumerate(codes):
        found = (_array(prim, Usd.TimeCode(code), name) for name in ("ids", "points", "velocities"))
        arrays = [a for a in found if a is not None and np.isfinite(a).all()]
        if len(arrays) < 3 or len({len(a) for a in arrays}) > 1 or repeated(arrays[0]):
            before = None
            continue
        now = ParticleFrame(*triple(arrays))
        if before is not None:
            seconds = (code - codes[k - 1]) / rate
            yield from (f"{prim.GetPath()} at {code:g}: {fault}" for fault in identity_faults(before, now, seconds))
        before = now


def _mesh_faults(prim: Usd.Prim, time: Usd.TimeCode) -> list[str]:
    points, counts = _array(prim, time, "points"), _array(prim, time, "faceVertexCounts")
    indices = _array(prim, time, "faceVertexIndices")
    if points is None or counts is None or indices is None:
        return ["a mesh without points or faces"]
    faults = []
    if counts.sum() != len(indices):
        faults.append("face counts that do not match the indices")
    if len(indices) and (indices.min() < 0 or indices.max() >= len(points)):
        faults.append("indices that name no point")
    n = len(points)
    expected: dict[str, tuple[int, ...]] = {
        "points": (n,), "velocities": (n,), "normals": (n, len(indices)), "primvars:displayColor": (1, n),
        "primvars:st": (n, len(indices)),
    }  # fmt: skip
    faults += _lengths(prim, time, expected, f"{n} points")
    return faults + (_extent_faults(prim, time, points) if n and not faults else [])


def _transform_faults(prim: Usd.Prim, time: Usd.TimeCode) -> list[str]:
    """A transform is finite and no reflection; where it turns and moves only, it does not scale."""
    matrix = np.array(UsdGeom.Xformable(prim).GetLocalTransformation(time))
    if not np.isfinite(matrix).all():
        return ["a transform that is not finite"]
    return [] if np.linalg.det(matrix[:3, :3]) > 0 else ["a transform that mirrors or flattens"]


def _camera_faults(prim: Usd.Prim, time: Usd.TimeCode) -> list[str]:
    names = ("focalLength", "horizontalAperture", "verticalAperture")
    values = [float(prim.GetAttribute(name).Get(time)) for name in names]
    return [] if np.isfinite(values).all() and min(values) > 0 else ["a focal length or aperture of 0 or less"]


_CHECKS: tuple[tuple[type, tuple[Check, ...]], ...] = (
    (UsdVol.ParticleField3DGaussianSplat, (_splat_faults, _transform_faults)),
    (UsdGeom.Points, (_points_faults, _transform_faults)),
    (UsdGeom.Mesh, (_mesh_faults, _transform_faults)),
    (UsdGeom.Camera, (_camera_faults, _transform_faults)),
    (UsdVol.Volume, (_transform_faults,)),
)
