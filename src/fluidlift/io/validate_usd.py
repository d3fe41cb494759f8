"""Is a USD file sound? The validators of OpenUSD, and what they do not look at: the arrays of splats at every time."""

from __future__ import annotations

import importlib.util
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from pxr import Sdf, Tf, Usd, UsdGeom, UsdUtils, UsdValidation

from fluidlift.errors import InputRejected, MissingPackage, required
from fluidlift.io.limits import require_file
from fluidlift.io.usd_checks import prim_faults
from fluidlift.io.usd_open import open_stage

MOST_CODES = 1e6
"""largest time code that is looked at"""


def validate_usd(path: Path | str) -> list[str]:
    """Faults of a USD file, one line each; an empty list means none.

    Besides OpenUSD's own validators: asset paths must stay inside the folder of the file, the stage must say its axes,
    units, rate and frames, and at every time code the arrays of splats, points and meshes must have matching lengths
    and values in their ranges, with ids that stay with their particles.

    Raises:
        InputRejected: no such file.
    """
    path = require_file(path, "USD file")
    try:
        stage = open_stage(path)
    except InputRejected as error:
        return [f"cannot be opened: {error.got}"]
    faults = _missing_files(path)
    with _quiet():
        context = UsdValidation.ValidationContext(UsdValidation.ValidationRegistry().GetOrLoadAllValidators())
        errors = context.Validate(stage)
    for error in errors:
        sites = ", ".join(str(s.GetPrim().GetPath()) for s in error.GetSites() if s.IsPrim())
        faults.append(f"{error.GetName()}: {error.GetMessage()} {sites}".strip())
    try:
        first, last, of_stage = stage.GetStartTimeCode(), stage.GetEndTimeCode(), _stage_faults(stage)
    except Tf.ErrorException:  # a dictionary in place of a number, say
        return [*faults, "time codes or units that are no numbers"]
    if not (abs(first) < MOST_CODES and abs(last) < MOST_CODES):  # a nan fails, too
        return [*faults, f"time codes from {first:g} to {last:g}"]
    faults += of_stage
    codes = range(int(first), int(last) + 1)
    for prim in stage.Traverse():
        try:
            faults += prim_faults(prim, codes)
        except (TypeError, ValueError, OverflowError, Tf.ErrorException) as error:
            faults.append(f"{prim.GetPath()}: values of another type than its schema's ({error})")
    return faults


def splat_rule_faults(path: Path | str) -> list[str]:
    """What NVIDIA's rule for splats (VG.035) says of a file, one line each. It looks at the default values.

    Raises:
        InputRejected: no such file.
        MissingPackage: usd-validation-nvidia is not installed.
    """
    path = require_file(path, "USD file")
    if not has_splat_rule():
        raise MissingPackage("NVIDIA's splat rule needs usd-validation-nvidia: pip install usd-validation-nvidia")
    from usd_validation_nvidia import ValidationEngine
    from usd_validation_nvidia.rules import GaussianSplatSchemaChecker

    engine = ValidationEngine(init_rules=False)
    engine.enable_rule(
        required(GaussianSplatSchemaChecker, "no rule for splats")
    )  # it is registered as one to skip, so only code can ask for it
    with _quiet():
        found: Any = engine.validate(str(path))  # whose types take the method `issues` for a list
        issues = list(found.issues())
    return list(dict.fromkeys(str(issue.message) for issue in issues))  # each is told once per variant of the file


def has_splat_rule() -> bool:
    """Whether `splat_rule_faults` can be asked."""
    return importlib.util.find_spec("usd_validation_nvidia") is not None


def frame_range(path: Path | str) -> tuple[int, int]:
    """First and last time code of a USD file."""
    layer = Sdf.Layer.FindOrOpen(str(path))
    return int(layer.startTimeCode), int(layer.endTimeCode)


@contextmanager
def _quiet() -> Iterator[None]:
    """Without OpenUSD's warnings on stderr: it takes the template of value clips for a file that is missing. Clips
    that are missing are told by `_missing_clips`."""
    heard = UsdUtils.CoalescingDiagnosticDelegate()
    try:
        yield
    finally:
        heard.TakeUncoalescedDiagnostics()


def _missing_files(path: Path) -> list[str]:
    """Dependencies that are not there; `open_stage` has seen that all are inside the folder."""
    with _quiet():
        _, _, unresolved = UsdUtils.ComputeAllDependencies(str(path))
    return [f"missing file: {name}" for name in unresolved]


def _stage_faults(stage: Usd.Stage) -> list[str]:
    """What a stage must say of itself."""
    faults = [] if stage.GetDefaultPrim() else ["no default prim"]
    if not UsdGeom.StageHasAuthoredMetersPerUnit(stage):
        faults.append("no metersPerUnit: readers take centimetres")
    if not stage.HasAuthoredMetadata(UsdGeom.Tokens.upAxis):
        faults.append("no upAxis: readers take y")
    if not stage.HasAuthoredTimeCodeRange():
        faults.append("no startTimeCode and endTimeCode")
    elif stage.GetStartTimeCode() > stage.GetEndTimeCode():
        faults.append("an endTimeCode before the startTimeCode")
    if not stage.GetTimeCodesPerSecond() > 0:
        faults.append("no positive timeCodesPerSecond")
    return faults + _missing_clips(stage)


def _missing_clips(stage: Usd.Stage) -> list[str]:
    """Frames whose clip is not there: the stage would hold the one before, and say nothing."""
    faults = []
    for prim in stage.Traverse():
        for name, info in (Usd.ClipsAPI(prim).GetClips() or {}).items():
            template, spec = info.get("templateAssetPath", ""), prim.GetPrimStack()[0]
            start, end, step = (info.get(f"template{k}", 1.0) for k in ("StartTime", "EndTime", "Stride"))
            width = template.count("#")
            if not width or not step > 0 or not 0 <= (end - start) / step < 1e6:
                continue
            for k in range(round((end - start) / step) + 1):
                file = template.replace("#" * width, f"{round(start + k * step):0{width}d}")
                if not Path(spec.layer.ComputeAbsolutePath(file)).is_file():
                    faults.append(f"missing clip of '{name}': {file}")
    return faults
