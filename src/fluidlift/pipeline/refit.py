"""The parameters of a finished asset, fitted again: `fluidlift fit`."""

from __future__ import annotations

import time
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from fluidlift import __version__
from fluidlift.config import JobConfig
from fluidlift.config.of_asset import settings_of
from fluidlift.errors import InputRejected
from fluidlift.fit.outcome import in_words
from fluidlift.io.kept_values import OF_CLIP, last_value, recalled, stage_keys
from fluidlift.machine import peak_memory_mb
from fluidlift.messages import Notice, as_plain, from_plain
from fluidlift.pipeline.fit_request import request_of
from fluidlift.pipeline.make import fit_figures
from fluidlift.pipeline.other_times import STAGE
from fluidlift.pipeline.runner import Runner
from fluidlift.pipeline.stages.fit import fit
from fluidlift.present import report
from fluidlift.scene.filmed_numbers import NAMES
from fluidlift.seams import Progress, Silence
from fluidlift.types.stages import Elsewhere, Fit, Geometry, Lift, Motion, Read, Segmentation, Shown, Simulation

NEEDED = ("read", "segment", "geometry", "motion")
"""stages whose cached results the fit starts from"""


@dataclass(frozen=True)
class Refitted:
    """What a fit changed."""

    folder: Path
    status: str
    """fitted, unfinished or failed"""
    reason: str
    warnings: tuple[Notice, ...]
    notes: tuple[str, ...]
    """what else should be known: what scene.yaml overrides, the scale"""
    seconds: float
    rows: tuple[dict[str, Any], ...]
    """one per number: name, before, and the entries of `fit_outcome.table`"""

    def lines(self) -> list[str]:
        """A table for a terminal, and what to do next."""
        cells = [("parameter", "before", "after", "between (95 %)", "unit", "where it comes from")]
        for r in self.rows:
            before = "" if r["before"] is None else f"{r['before']:.4g}"
            cells.append((r["name"], before, f"{r['value']:.4g}", in_words(r), r["unit"], r["source"]))
        width = [max(len(row[k]) for row in cells) for k in range(len(cells[0]))]
        shown = ["  ".join(cell.ljust(w) for cell, w in zip(row, width)).rstrip() for row in cells]
        end = f"done in {self.seconds:.0f} s; to play the new values: fluidlift sim {self.folder}"
        return [*shown, *self.notes, end]


def refit(
    folder: Path,
    *,
    overrides: Sequence[str] = (),
    flat: dict[str, Any] | None = None,
    progress: Progress | None = None,
) -> Refitted:
    """Fit the parameters of a finished asset again, from the velocities that `make` found.

    Writes parameters.json, the manifest and the report. Frames, preview and scene.yaml stay: `fluidlift sim` plays the
    new values.

    Args:
        folder: of the asset.
        overrides: `fit.name=value`.
        flat: settings by dotted name; None values are left out.
        progress: where progress is told.

    Raises:
        InputRejected: no asset, one without the cached results of `make` or with those of another version, or settings
            that do not fit; nothing was changed.
    """
    from fluidlift.io.asset_folder import load_asset, read_manifest, update_manifest, write_parameters
    from fluidlift.io.asset_lock import writing
    from fluidlift.io.atomic import disk_errors

    began = time.perf_counter()
    manifest = read_manifest(folder)
    config = settings_of(manifest, overrides, flat or {}, sections=("fit",), work="the fit")
    request_of(config.fit)
    runner = Runner(folder, ("fit",), force=frozenset({"fit"}), progress=progress or Silence())
    read, segmentation, geometry, moved = _recalled(runner, manifest)
    before = load_asset(folder)
    with disk_errors(folder), writing(folder, "a fit"):
        also = _elsewhere(runner, manifest)
        found = runner.run("fit", fit, read, segmentation, geometry, moved, config.fit, *also)
        runner.warnings[:] = [w for w in from_plain(manifest) if w not in _last_warnings(manifest)]
        runner.warnings += found.warnings
        seen = {} if geometry.bed is None else geometry.bed.estimates
        seen = seen | {name: e for name, e in before.estimates.items() if name in NAMES}
        write_parameters(folder, found.parameters, found.estimates | seen)
        _write_report(runner, found, (read, segmentation, geometry, moved), config, manifest)
        origin = manifest.get("provenance", {})
        stored = origin.get("config")
        stored = stored if isinstance(stored, dict) else {}
        update_manifest(
            folder,
            provenance=origin
            | {
                "stages": stage_keys(manifest) | {"fit": runner.keys["fit"]},
                "config": stored | {"fit": config.section("fit")},
            },
            timings={"fit": float(runner.timings["fit"]["seconds"])},
            metrics={
                "fit_converged": found.converged,
                "fit_rollouts": found.rollouts,
                "fit_extra": found.extra,
                "fit": fit_figures(found),
            },
            **as_plain(runner.warnings),
        )
    rows = tuple({"name": r["name"], "before": _number(before, r["name"])} | r for r in found.table)
    return Refitted(
        folder, found.status, found.reason, found.warnings, tuple(_notes(geometry, folder)),
        time.perf_counter() - began, rows,
    )  # fmt: skip


def _recalled(runner: Runner, manifest: dict[str, Any]) -> tuple[Read, Segmentation, Geometry, Motion]:
    """What the fit starts from."""
    values: dict[str, Any] = {name: runner.recall(manifest, name, OF_CLIP[name]) for name in NEEDED}
    missing = [name for name in NEEDED if values[name] is None]
    if missing:
        made = manifest.get("provenance", {}).get("versions", {})
        version = made.get("fluidlift") if isinstance(made, dict) else None
        name = runner.folder.name
        got = f"'{name}' no longer holds the velocities that a fit starts from (work/{missing[0]})"
        if version not in (None, __version__):
            got = f"'{name}' was made by fluidlift {version}, and its work/{missing[0]} cannot be used"
        raise InputRejected(
            got, "an asset with the work/ folder that 'fluidlift make' left",
            f"run 'fluidlift make CLIP -o {name}' again with its clip, and then the fit",
        )  # fmt: skip
    return values["read"], values["segment"], values["geometry"], values["motion"]


def _elsewhere(runner: Runner, manifest: dict[str, Any]) -> tuple[Elsewhere, ...]:
    """Velocities at other times of a long clip, where `make` had some; as arguments of the fit."""
    found = runner.recall(manifest, STAGE, Elsewhere)
    return () if found is None else (found,)


def _write_report(
    runner: Runner, found: Fit, start: tuple[Read, Segmentation, Geometry, Motion], config: JobConfig,
    manifest: dict[str, Any],
) -> None:  # fmt: skip
    """The report anew, where everything that it shows is still cached; it says whose values the frames show."""
    folder = runner.folder
    flow, refined = (recalled(folder, manifest, name) for name in ("flow", "refine"))
    done, shown = last_value(folder, "simulate", Simulation), last_value(folder, "show", Shown)
    if flow is None or refined is None or done is None or shown is None:
        return
    told = "Fitted again: the frames show the values before until fluidlift sim plays these."
    read, segmentation, geometry, moved = start
    lift = Lift(read, flow, segmentation, geometry, refined, moved, replace(found, notes=(*found.notes, told)))
    stages = manifest.get("metrics", {}).get("stages", {})
    timings = stages if isinstance(stages, dict) else {}
    fresh = {"fit": runner.timings["fit"] | {"peak_memory_mb": round(peak_memory_mb(), 1)}}
    known = {
        k: t for k, t in timings.items() if isinstance(t, dict) and {"seconds", "cached", "peak_memory_mb"} <= t.keys()
    }
    models = manifest.get("provenance", {}).get("models", ())
    report.write_report(lift, done, shown, folder, config.preset, known | fresh, runner.warnings, models)


def _number(asset: Any, label: str) -> float | None:
    """The value of `gravity_z`, `density`, ... in an asset."""
    if label in asset.estimates:
        return asset.estimates[label].value
    value = getattr(asset.parameters, label.removesuffix("_x").removesuffix("_y").removesuffix("_z"), None)
    return float(value["xyz".index(label[-1])] if isinstance(value, tuple) else value) if value is not None else None


def _notes(geometry: Geometry, folder: Path) -> list[str]:
    """What scene.yaml overrides, and where metres come from."""
    from fluidlift.io.scene import read_scene

    notes = [geometry.scale_sentence]
    with suppress(InputRejected):
        edited = read_scene(folder).get("parameters")
        if isinstance(edited, dict) and edited:
            names = ", ".join(f"{k} = {v}" for k, v in edited.items())
            notes.append(f"scene.yaml sets {names}: a simulation takes that, whatever was fitted")
    return [n for n in notes if n]


def _last_warnings(manifest: dict[str, Any]) -> list[Any]:
    """What the fit before this one warned of."""
    figures = manifest.get("metrics", {}).get("fit", {})
    found = figures.get("warnings", []) if isinstance(figures, dict) else []
    return found if isinstance(found, list) else []
