"""Is a USD file sound? The validators of OpenUSD, and what they do not look at: the arrays of splats at every time."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from pxr import Sdf, Tf, Usd, UsdGeom, UsdUtils, UsdValidation, UsdVol

from fluidlift.io.limits import require_file


def validate_usd(path: Path | str) -> list[str]:
    """Faults of a USD file, one line each; an empty list means none.

    Besides OpenUSD's own validators: asset paths must stay inside the folder of the file, and at every time code the
    arrays of splats, points and meshes must have matching lengths and values in their ranges.

    Raises:
        InputRejected: no such file.
    """
    path = require_file(path, "USD file")
    try:
        stage = Usd.Stage.Open(str(path))
    except Tf.ErrorException as error:
        return [f"cannot be opened: {' '.join(str(error).split())}"]
    faults = _foreign_paths(path)
    context = UsdValidation.ValidationContext(UsdValidation.ValidationRegistry().GetOrLoadAllValidators())
    for error in context.Validate(stage):
        sites = ", ".join(str(s.GetPrim().GetPath()) for s in error.GetSites() if s.IsPrim())
        faults.append(f"{error.GetName()}: {error.GetMessage()} {sites}".strip())
    if not stage.GetDefaultPrim():
        faults.append("no default prim")
    for prim in stage.Traverse():
        faults += _check_prim(prim)
    return faults


def _foreign_paths(path: Path) -> list[str]:
    """Dependencies that are absolute, missing, or outside the folder."""
    folder = path.resolve().parent
    layers, assets, unresolved = UsdUtils.ComputeAllDependencies(str(path))
    faults = [f"missing file: {name}" for name in unresolved]
    for name in [layer.realPath for layer in layers] + list(assets):
        if folder not in Path(name).resolve().parents:
            faults.append(f"file outside the folder: {Path(name).name}")
    for layer in layers:
        for reference in layer.GetCompositionAssetDependencies():
            if Path(reference).is_absolute() or ".." in Path(reference).parts:
                faults.append(f"path that is not inside the folder: {reference}")
    return faults


def _check_prim(prim: Usd.Prim) -> list[str]:
    checks = (
        (UsdVol.ParticleField3DGaussianSplat, _splat_faults),
        (UsdGeom.Points, _points_faults),
        (UsdGeom.Mesh, _mesh_faults),
    )
    for schema, check in checks:
        if prim.IsA(schema):
            codes = sorted({t for a in prim.GetAttributes() for t in a.GetTimeSamples()})
            times = [Usd.TimeCode.Default(), *map(Usd.TimeCode, codes)]
            return [f"{prim.GetPath()} at {time}: {fault}" for time in times for fault in check(prim, time)]
    return []


def _array(prim: Usd.Prim, time: Usd.TimeCode, *names: str) -> np.ndarray | None:
    """The first attribute of these names that has a value."""
    for name in names:
        attribute = prim.GetAttribute(name)
        if attribute and (value := attribute.Get(time)) is not None:
            return np.asarray(value)
    return None


def _splat_faults(prim: Usd.Prim, time: Usd.TimeCode) -> list[str]:
    positions = _array(prim, time, "positions", "positionsh")
    if positions is None:
        return ["no positions"]
    n, faults = len(positions), []
    degree = prim.GetAttribute("radiance:sphericalHarmonicsDegree").Get(time)
    per_splat = (int(degree) + 1) ** 2
    harmonics = "radiance:sphericalHarmonicsCoefficients"
    arrays = {
        "scales": (_array(prim, time, "scales", "scalesh"), n),
        "orientations": (_array(prim, time, "orientations", "orientationsh"), n),
        "opacities": (_array(prim, time, "opacities", "opacitiesh"), n),
        "harmonics": (_array(prim, time, harmonics, harmonics + "h"), n * per_splat),
    }
    for name, (values, length) in arrays.items():
        if values is None:
            faults.append(f"no {name}")
        elif len(values) != length:
            faults.append(f"{len(values)} {name} for {n} splats, not {length}")
        elif not np.isfinite(values.astype(np.float32)).all():
            faults.append(f"{name} that are not finite")
    if faults or n == 0:
        return faults
    if not np.isfinite(positions).all():
        faults.append("positions that are not finite")
    if arrays["scales"][0].min() < 0:
        faults.append("negative scales")
    opacities = arrays["opacities"][0]
    if opacities.min() < 0 or opacities.max() > 1:
        faults.append("opacities outside 0 to 1")
    norms = np.linalg.norm(arrays["orientations"][0].astype(np.float32), axis=-1)
    if np.abs(norms - 1).max() > 5e-3:  # half precision rounds each part by up to 2.5e-4
        faults.append("orientations that are not unit quaternions")
    return faults + _extent_faults(prim, time, positions)


def _extent_faults(prim: Usd.Prim, time: Usd.TimeCode, positions: np.ndarray) -> list[str]:
    extent = _array(prim, time, "extent")
    if extent is None or extent.shape != (2, 3):
        return ["no extent"]
    room = 1e-5 * max(1.0, float(np.abs(positions).max()))
    inside = (positions >= extent[0] - room).all() and (positions <= extent[1] + room).all()
    return [] if inside else ["positions outside the extent"]


def _points_faults(prim: Usd.Prim, time: Usd.TimeCode) -> list[str]:
    points = _array(prim, time, "points")
    if points is None:
        return ["no points"]
    faults = []
    for name in ("widths", "ids", "velocities", "primvars:displayColor"):
        values = _array(prim, time, name)
        if values is not None and len(values) != len(points):
            faults.append(f"{len(values)} {name} for {len(points)} points")
    ids = _array(prim, time, "ids")
    if ids is not None and len(np.unique(ids)) != len(ids):
        faults.append("ids that occur twice")
    return faults + (_extent_faults(prim, time, points) if len(points) else [])


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
    for name in ("velocities", "primvars:displayColor"):
        values = _array(prim, time, name)
        if values is not None and len(values) not in (1, len(points)):
            faults.append(f"{len(values)} {name} for {len(points)} points")
    return faults


def frame_range(path: Path | str) -> tuple[int, int]:
    """First and last time code of a USD file."""
    layer = Sdf.Layer.FindOrOpen(str(path))
    return int(layer.startTimeCode), int(layer.endTimeCode)
