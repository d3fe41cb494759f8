"""Turns the figures of `motion.py` into the motion section of docs/experiments/2026-11-motion.md."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from motion_situations import table

BEGIN, END = "<!-- motion:begin -->", "<!-- motion:end -->"

Records = dict[str, dict[str, Any]]


def section(records: Records, before: Records) -> str:
    """The whole section between its markers, as Markdown."""
    records, before = dict(records), dict(before)
    hard, hard_before = records.pop("situations", {}), before.pop("situations", {})
    parts = [
        goals(records), planar(records, before), pictures(records), surface(records, before), volume(records, before),
        masks(records, before), table(hard, hard_before) if hard else "",
    ]  # fmt: skip
    return "\n\n".join(p for p in parts if p)


FINAL_SHARE = 0.6
"""goal: of Farneback's error that may be left"""
FILLED_FACTOR = 2.0
"""goal: error where filled in over that where observed"""
STREAM_COSINE = 0.9
"""goal: volume velocity of a stream"""
CASE_IOU, CLIP_IOU = 0.85, 0.8
"""goals: automatic masks of cases, and of real clips against drawn ones"""


def goals(records: Records) -> str:
    """Which goals each subject meets; a step that is worse than the one before is named with its loss."""
    lines = [
        "## Goals",
        "",
        f"| clip | no step worse | filled at most {FILLED_FACTOR:g} x observed | "
        f"final at most {_percent(FINAL_SHARE)} of Farneback | volume cosine, from true / own motion | mask |",
        "|---|---|---|---|---|---|",
    ]
    for name, r in records.items():
        iou = r["mask"]["iou"]
        mask = _judged(iou >= (CASE_IOU if "steps" in r else CLIP_IOU), f"{iou:.2f}")
        if "steps" not in r:
            lines.append(f"| {name} | - | - | - | - | {mask} |")
            continue
        last = r["steps"]["as made"]
        ratio = None if not last["observed"] or last["filled"] is None else last["filled"] / last["observed"]
        worse = [f"{step} {100 * loss:+.1f} %" for step, loss in _losses(r["steps"])]
        cosines = [v["cosine"] for v in r["volume"].values() if isinstance(v, dict)]
        shown = " / ".join(_number(c) for c in cosines)
        lines.append(
            f"| {name} | {_judged(not worse, ', '.join(worse))} | "
            + (_judged(ratio <= FILLED_FACTOR, f"{ratio:.1f}") if ratio is not None else "-")
            + f" | {_judged(last['of_farneback'] <= FINAL_SHARE, _percent(last['of_farneback']))} | "
            + (_judged(min(cosines) >= STREAM_COSINE, shown) if r["kind"] == "stream" else shown)
            + f" | {mask} |"
        )
    return "\n".join(lines)


def _losses(steps: dict[str, dict[str, float]]) -> list[tuple[str, float]]:
    """Steps whose mean error is above that of the step before, with the relative loss (of 0.05 % and more)."""
    errors = [(name, f["epe"]) for name, f in steps.items()]
    changes = [(b[0], b[1] / a[1] - 1) for a, b in zip(errors, errors[1:])]
    return [(name, change) for name, change in changes if change >= 5e-4]


def _judged(met: bool, shown: str) -> str:
    return ("yes" if met else "**no**") + (f" ({shown})" if shown else "")


def pictures(records: Records) -> str:
    """Links to the pictures of the project's own scenes, as far as they lie there."""
    folder = Path(__file__).resolve().parent.parent / "docs" / "pictures"
    names = [name for name, r in records.items() if r["own"] and (folder / f"motion_{name}.png").is_file()]
    links = [f"![{name}: flow after each step](../pictures/motion_{name}.png)" for name in names]
    return "\n\n".join(["## Pictures", *links]) if links else ""


def planar(records: Records, before: Records) -> str:
    """One table of steps for each clip with a truth."""
    lines = ["## Planar velocity, step by step"]
    for name, r in records.items():
        if "steps" not in r:
            continue
        s = r["shares"]
        lines += [
            "",
            f"**{name}**: {r['speed_px']:.2f} px/frame in the mean; flow failed on {_percent(s['failed'])} of the "
            f"pixels, {_percent(s['filled'])} were filled in ({_percent(s['failed_and_filled'])} of the failed ones). "
            f"Frames {', '.join(map(str, r['frames']))}.",
            "",
            "| step | error | 90 % | cosine | speed found | of Farneback | observed | filled | did not fail | failed |"
            + _old(before, "error"),
            "|---|---|---|---|---|---|---|---|---|---|" + _old(before, "---"),
        ]
        for step, f in r["steps"].items():
            lines.append(
                f"| {step} | {f['epe']:.3f} | {f['p90']:.2f} | {f['cosine']:.3f} | {_percent(f['gain'])} | "
                f"{_percent(f['of_farneback'])} | {_number(f['observed'])} | {_number(f['filled'])} | "
                f"{_number(f['good'])} | {_number(f['failed'])} |"
                + (f" {_number(before.get(name, {}).get('steps', {}).get(step, {}).get('epe'))} |" if before else "")
            )
    return "\n".join(lines)


def surface(records: Records, before: Records) -> str:
    """Velocity of the visible surface in m/s."""
    lines = [
        "## Surface velocity",
        "",
        "| clip | truth, m/s | error, m/s | relative | speed found | from Farneback alone |" + _old(before, "relative"),
        "|---|---|---|---|---|---|" + _old(before, "---"),
    ]
    for name, r in records.items():
        if "surface" not in r:
            continue
        s, f = r["surface"]["as made"], r["surface"]["Farneback"]
        old = before.get(name, {}).get("surface", {}).get("as made", {}).get("relative")
        lines.append(
            f"| {name} | {s['speed_m_s']:.3f} | {s['error_m_s']:.3f} | {_percent(s['relative'])} | "
            f"{_percent(s['gain'])} | {_percent(f['relative'])} |" + (f" {_percent(old)} |" if before else "")
        )
    return "\n".join(lines)


def volume(records: Records, before: Records) -> str:
    """Velocity of the whole volume against the grid of the truth."""
    lines = [
        "## Volume velocity",
        "",
        "| clip | surface motion | relative L2 | cosine | speed found | divergence max | mean | in, out, up (l/s) |"
        + _old(before, "L2, cosine"),
        "|---|---|---|---|---|---|---|---|" + _old(before, "---"),
    ]
    for name, r in records.items():
        for source in ("true motion", "estimated motion"):
            v = r.get("volume", {}).get(source)
            if v is None:
                continue
            old = before.get(name, {}).get("volume", {}).get(source, {})
            flux = ", ".join(f"{1e3 * v[k]:.3g}" for k in ("flux_in", "flux_out", "flux_surface"))
            lines.append(
                f"| {name} | {source} | {_number(v['relative_l2'])} | {_number(v['cosine'])} | {_percent(v['gain'])} | "
                f"{v['divergence_max']:.1e} | {v['divergence_mean']:.1e} | {flux} |"
                + (f" {_number(old.get('relative_l2'))}, {_number(old.get('cosine'))} |" if before else "")
            )
        a = r.get("asset")
        if a:
            old = before.get(name, {}).get("asset") or {}
            shown = f" {_number(old.get('volume.relative_l2'))}, {_number(old.get('volume.cosine'))} |"
            lines.append(
                f"| {name} | the pipeline's own | {_number(a.get('volume.relative_l2'))} | "
                f"{_number(a.get('volume.cosine'))} | - | {_number(a.get('divergence.max'))} | "
                f"{_number(a.get('divergence.mean'))} | - |" + (shown if before else "")
            )
    return "\n".join(lines)


def masks(records: Records, before: Records) -> str:
    """Automatic masks."""
    lines = [
        "## Masks",
        "",
        "| clip | IoU | worst frame |" + _old(before, "IoU"),
        "|---|---|---|" + _old(before, "---"),
    ]
    for name, r in records.items():
        old = before.get(name, {}).get("mask", {}).get("iou")
        m = r["mask"]
        lines.append(
            f"| {name} | {m['iou']:.3f} | {_number(m.get('worst'))} |" + (f" {_number(old)} |" if before else "")
        )
    return "\n".join(lines)


def _old(before: Records, what: str) -> str:
    """A further column where an earlier run is given."""
    if not before:
        return ""
    return "---|" if what == "---" else f" before: {what} |"


def _percent(value: float | None) -> str:
    return "-" if value is None else f"{100 * value:.0f} %"


def _number(value: float | None) -> str:
    return "-" if value is None else f"{value:.3f}"
