"""The parameters of a finished asset, fitted again: `fluidlift fit`."""

from __future__ import annotations

import time
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from fluidlift import __version__
from fluidlift.config import JobConfig
from fluidlift.errors import InputRejected
from fluidlift.pipeline import moving, reporting
from fluidlift.pipeline.fit_outcome import SUBJECT, in_words
from fluidlift.pipeline.fit_request import request_of
from fluidlift.pipeline.make import fit_figures
from fluidlift.pipeline.resimulate import is_key, settings_of, stage_keys
from fluidlift.pipeline.story import Progress, Silence, Story, peak_memory_mb

NEEDED = ("read", "segment", "geometry", "motion")
"""stages whose cached results the fit starts from"""
SHOWN = ("flow", "refine")
"""stages that only the report needs"""
LAST = ("simulate", "show")
"""stages whose frames stay as they are"""


@dataclass(frozen=True)
class Refitted:
    """What a fit changed."""

    folder: Path
    status: str
    """fitted, unfinished or failed"""
    reason: str
    warnings: tuple[str, ...]
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
    story = Story(folder, ("fit",), force=frozenset({"fit"}), progress=progress or Silence())
    _recall(story, manifest)
    before = load_asset(folder)
    with disk_errors(folder), writing(folder, "a fit"):
        story.run("fit", lambda: moving.fit(story, config), settings=config.section("fit"), after=("motion",))
        own = story["fit"].meta["warnings"]
        story.warnings[:] = [w for w in manifest.get("warnings", ()) if not str(w).startswith(SUBJECT)] + own
        parameters = moving.parameters_of(story)
        write_parameters(folder, parameters, moving.estimates_of(story))
        _write_report(story, folder, config, manifest)
        origin = manifest.get("provenance", {})
        stored = origin.get("config")
        stored = stored if isinstance(stored, dict) else {}
        update_manifest(
            folder,
            provenance=origin
            | {
                "stages": stage_keys(manifest) | {"fit": story.keys["fit"]},
                "config": stored | {"fit": config.section("fit")},
            },
            timings={"fit": float(story.timings["fit"]["seconds"])},
            metrics={
                "fit_converged": story["fit"].meta["converged"],
                "fit_rollouts": story["fit"].meta["rollouts"],
                "fit_extra": story["fit"].meta["extra"],
                "fit": fit_figures(story),
            },
            warnings=story.warnings,
        )
    meta = story["fit"].meta
    rows = tuple({"name": r["name"], "before": _number(before, r["name"])} | r for r in meta["table"])
    return Refitted(
        folder, meta["status"], meta["reason"], tuple(own), tuple(_notes(story, folder)),
        time.perf_counter() - began, rows,
    )  # fmt: skip


def _recall(story: Story, manifest: dict[str, Any]) -> None:
    """The cached results that the fit starts from, and those that the report shows, where they are still there."""
    keys = stage_keys(manifest)
    for name in (*NEEDED, *SHOWN):
        if name in keys:
            story.recall(name, keys[name])
    missing = [name for name in NEEDED if name not in story.results]
    if missing:
        made = manifest.get("provenance", {}).get("versions", {})
        version = made.get("fluidlift") if isinstance(made, dict) else None
        got = f"'{story.folder.name}' no longer holds the velocities that a fit starts from (work/{missing[0]})"
        if version not in (None, __version__):
            got = f"'{story.folder.name}' was made by fluidlift {version}, and its work/{missing[0]} cannot be used"
        raise InputRejected(
            got, "an asset with the work/ folder that 'fluidlift make' left",
            f"run 'fluidlift make CLIP -o {story.folder.name}' again with its clip, and then the fit",
        )  # fmt: skip
    for name in LAST:
        # frames have no key in the manifest: the cache notes whose they are
        owner = story.folder / "work" / name / "owner"
        with suppress(OSError, UnicodeDecodeError):
            key = "" if owner.is_symlink() else owner.read_text("ascii")[:128]
            if is_key(key):
                story.recall(name, key)


def _write_report(story: Story, folder: Path, config: JobConfig, manifest: dict[str, Any]) -> None:
    """The report anew, where everything that it shows is still cached; it says whose values the frames show."""
    if not {"flow", "refine", *LAST} <= story.results.keys():
        return
    facts = story["fit"].meta
    facts["notes"] = [
        *facts["notes"],
        "Fitted again: the frames show the values before until fluidlift sim plays these.",
    ]
    stages = manifest.get("metrics", {}).get("stages", {})
    timings = stages if isinstance(stages, dict) else {}
    fresh = {"fit": story.timings["fit"] | {"peak_memory_mb": round(peak_memory_mb(), 1)}}
    known = {
        k: t for k, t in timings.items() if isinstance(t, dict) and {"seconds", "cached", "peak_memory_mb"} <= t.keys()
    }
    reporting.write_report(story, folder, config, known | fresh)


def _number(asset: Any, label: str) -> float | None:
    """The value of `gravity_z`, `density`, ... in an asset."""
    if label in asset.estimates:
        return asset.estimates[label].value
    value = getattr(asset.parameters, label.removesuffix("_x").removesuffix("_y").removesuffix("_z"), None)
    return float(value["xyz".index(label[-1])] if isinstance(value, tuple) else value) if value is not None else None


def _notes(story: Story, folder: Path) -> list[str]:
    """What scene.yaml overrides, and where metres come from."""
    from fluidlift.io.scene import read_scene

    notes = [story["geometry"].meta["scale"].get("sentence", "")]
    with suppress(InputRejected):
        edited = read_scene(folder).get("parameters")
        if isinstance(edited, dict) and edited:
            names = ", ".join(f"{k} = {v}" for k, v in edited.items())
            notes.append(f"scene.yaml sets {names}: a simulation takes that, whatever was fitted")
    return [n for n in notes if n]
