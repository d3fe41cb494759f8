"""Runs `fluidlift make` on every case and clip, measures it, and puts the figures into benchmarks/results.

    python benchmarks/clips.py --work runs && python -m benchmarks.report
    python benchmarks/clips.py --work runs --only river --preset standard --page docs/experiments/2026-11-clips.md

Cases (folders with truth.npz) are scored with `fluidlift evaluate`; clips (folders with video.mp4 alone) have no truth.
They are looked for below FLUIDLIFT_SHARED, or a folder `shared` beside the repository; the demo case of the package and
a made dam break are always there. Each run is a process of its own and leaves one JSON file in the work folder; what
is there already is not run again (`--again` does). Figures of the preset draft that were run go into `clips.json` and
`cases.json`; `--page` writes tables of everything that the work folder holds between the markers of a page.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from report import put, table

ROOT = Path(__file__).resolve().parent.parent
BEGIN, END = "<!-- results:begin -->", "<!-- results:end -->"
GROUPS = {
    "segmentation": "Mask", "flow": "Planar velocity", "geometry": "Geometry", "volume": "Volume velocity",
    "parameters": "Parameters", "divergence": "Divergence", "resimulation": "Re-simulation",
}  # fmt: skip
"""groups of figures that the table of cases shows; cost has its own table"""


@dataclass(frozen=True)
class Subject:
    """Something to run on."""

    name: str
    clip: Path
    truth: Path | None = None
    options: tuple[str, ...] = field(default=())
    hand_mask: Path | None = None


def _made(name: str, folder: Path, **how: Any) -> Path:
    """A made scene, from an earlier run where it is there: it takes a minute or two."""
    from fluidlift.synthetic.record import make_scene

    return folder if (folder / "truth.npz").is_file() else make_scene(name, folder, **how)


def subjects(shared: Path | None, work: Path) -> Iterator[Subject]:
    """The demo and a made dam break, then cases, then clips."""
    from fluidlift.synthetic.demo import data_file, unpack_demo_case

    demo = unpack_demo_case(work / "demo_case")
    yield Subject("demo", demo / "video.mp4", demo, ("--camera", str(data_file("demo_camera.json"))))
    dam = _made("dam", work / "dam_case", size=(320, 240), frames=50, seed=5, cells=64)
    yield Subject("dam", dam / "video.mp4", dam, ("--camera", str(dam / "camera.json")))
    yield Subject("dam_no_camera", dam / "video.mp4", dam)
    if shared is None:
        return
    for folder in sorted(p.parent for p in shared.glob("cases/*/truth.npz")):
        camera = ("--camera", str(folder / "camera.json"))
        yield Subject(folder.name, folder / "video.mp4", folder, camera)
        for other in sorted(folder.glob("video_*.mp4")):
            yield Subject(f"{folder.name}_{other.stem.removeprefix('video_')}", other, folder, camera)
    for video in sorted(shared.glob("clips/*/video.mp4")):
        folder, camera, mask = video.parent, video.parent / "camera.json", video.parent / "mask_hand.png"
        options = ("--camera", str(camera)) if camera.is_file() else ()
        yield Subject(f"clip {folder.name}", video, None, options, mask if mask.is_file() else None)


def default_shared() -> Path | None:
    """FLUIDLIFT_SHARED, or `shared` beside the repository, where that exists."""
    path = Path(os.environ.get("FLUIDLIFT_SHARED") or ROOT.parent / "shared")
    return path if path.is_dir() else None


def measured(command: list[str], log: Path) -> tuple[int, float, float | None]:
    """Exit code, wall time (s) and peak resident memory (MB, of the process and its children) of a command."""
    began = time.perf_counter()
    with log.open("w", encoding="utf-8") as stream:
        process = subprocess.Popen(command, stdout=stream, stderr=subprocess.STDOUT)
        if not hasattr(os, "wait4"):
            return process.wait(), time.perf_counter() - began, None
        try:
            _, status, usage = os.wait4(process.pid, 0)
        except BaseException:
            process.kill()
            raise
    process.returncode = os.waitstatus_to_exitcode(status)
    peak = usage.ru_maxrss / (2**20 if sys.platform == "darwin" else 2**10)
    return process.returncode, time.perf_counter() - began, peak


def run(subject: Subject, preset: str, work: Path, extra: list[str]) -> dict[str, Any]:
    """Make an asset and measure it."""
    label = f"{subject.name.replace(' ', '_')}.{preset}"
    asset, log = work / f"{label}.fluid", work / f"{label}.log"
    command = [sys.executable, "-m", "fluidlift", "make", str(subject.clip), "-o", str(asset), "--preset", preset]
    command += ["--force", "read", *subject.options, *extra]
    code, seconds, peak = measured(command, log)
    record: dict[str, Any] = {
        "name": subject.name, "preset": preset, "exit_code": code, "wall_s": round(seconds, 1), "machine": machine(),
        "peak_memory_mb": None if peak is None else round(peak), "date": time.strftime("%Y-%m-%d"), "options": extra,
    }  # fmt: skip
    if code not in (0, 4):
        record["message"] = log.read_text(encoding="utf-8", errors="replace").strip().splitlines()[-1:]
        return record
    manifest = json.loads((asset / "manifest.json").read_text(encoding="utf-8"))
    record |= {k: manifest[k] for k in ("kind", "frame_count", "grid", "timings", "metrics", "warnings")}
    record["version"] = manifest["provenance"].get("versions", {}).get("fluidlift")
    if subject.truth is not None:
        from fluidlift.evaluate import evaluate_asset

        record["evaluation"] = evaluate_asset(asset, subject.truth).to_dict()
    if subject.hand_mask is not None:
        record["hand_mask_iou"] = hand_mask_iou(asset, subject.hand_mask)
    return record


def hand_mask_iou(asset: Path, mask: Path) -> float:
    """Intersection over union of the pixels that are fluid in most frames and a mask that a person drew."""
    import numpy as np

    from fluidlift.evaluate import arrays_of_run
    from fluidlift.evaluate.images import mask_iou
    from fluidlift.io.asset_folder import read_manifest
    from fluidlift.io.images import read_mask
    from fluidlift.types import Label

    labels = arrays_of_run(asset, read_manifest(asset))["labels"]
    found = (labels == Label.FLUID).mean(axis=0) > 0.5
    drawn = read_mask(mask, (found.shape[1], found.shape[0]), len(labels))
    return float(np.mean(mask_iou(found[None], drawn[None])))


def machine() -> str:
    """Processor and cores, without names."""
    model = platform.machine()
    info = Path("/proc/cpuinfo")
    if info.is_file():
        names = [line.split(":", 1)[1].strip() for line in info.read_text().splitlines() if "model name" in line]
        model = names[0] if names else model
    return f"{model}, {os.cpu_count()} cores, {platform.system()}, Python {platform.python_version()}"


def number(value: Any, digits: int = 3) -> str:
    """A figure for a table, '-' where there is none."""
    return f"{value:.{digits}g}" if isinstance(value, int | float) else "-"


GROUP_NAMES = {"segmentation": "mask", "resimulation": "resimulated"}
"""of groups of figures in cases.json, where they differ"""


def keep(record: dict[str, Any]) -> None:
    """Put the figures of a run into benchmarks/results."""
    if record["exit_code"] not in (0, 4):
        return
    about = {"date": record["date"], "machine": record["machine"]}
    name = record["name"].removeprefix("clip ")
    figures = {"frames": record["frame_count"], "Gaussians": record["metrics"].get("gaussians"),
               "time": record["wall_s"], "memory": record["peak_memory_mb"],
               "IoU with hand mask": record.get("hand_mask_iou"), **record["timings"]}  # fmt: skip
    put("clips", [{"subject": name, "figure": k, "value": v} for k, v in figures.items() if v is not None], **about)
    found = record.get("evaluation", {"figures": {}})["figures"]
    records = []
    for key, f in found.items():
        group, _, figure = key.partition(".")
        if group in GROUPS and isinstance(f.get("value"), int | float):
            title = f"{GROUP_NAMES.get(group, group)} {figure}"
            records.append({"subject": name, "figure": title, "value": f["value"], "unit": f["unit"] or ""})
    put("cases", records, **about)


def run_table(records: list[dict[str, Any]]) -> list[str]:
    """One row per run."""
    rows = []
    for r in records:
        done = r["exit_code"] in (0, 4)
        size = "x".join(map(str, r["grid"]["shape"])) if done else "-"
        rows.append([
            r["name"], {0: "done", 4: "done, warnings"}.get(r["exit_code"], f"failed ({r['exit_code']})"),
            r.get("kind", "-"), str(r.get("frame_count", "-")), size,
            str(r["metrics"].get("gaussians", "-")) if done else "-", f"{r['wall_s']:.0f}",
            number(r["peak_memory_mb"], 4), number(r.get("hand_mask_iou")),
        ])  # fmt: skip
    head = ["run", "outcome", "kind", "frames", "grid", "Gaussians", "time, s", "memory, MB", "IoU with hand mask"]
    return table(head, rows)


def stage_table(records: list[dict[str, Any]]) -> list[str]:
    """Seconds per stage."""
    done = [r for r in records if "timings" in r]
    stages = list(dict.fromkeys(s for r in done for s in r["timings"]))
    seconds = [[r["timings"].get(s) for s in stages] for r in done]
    rows = [[r["name"], *(number(t) for t in row)] for r, row in zip(done, seconds)]
    return table(["seconds", *stages], rows) if rows else []


def case_tables(records: list[dict[str, Any]]) -> list[str]:
    """Figures against the truth: one table per group, one column per case."""
    scored = [r for r in records if "evaluation" in r]
    if not scored:
        return []
    figures = [r["evaluation"]["figures"] for r in scored]
    keys = list(dict.fromkeys(k for f in figures for k in f))
    lines = []
    for group, title in GROUPS.items():
        rows = []
        for key in (k for k in keys if k.split(".")[0] == group):
            unit = next((f[key]["unit"] for f in figures if key in f and f[key]["unit"]), "")
            values = [number(f.get(key, {}).get("value")) for f in figures]
            rows.append([key.removeprefix(group + "."), unit, *values])
        if rows:
            lines += [f"**{title}**", "", *table(["figure", "unit", *(r["name"] for r in scored)], rows)]
    return lines


def warning_list(records: list[dict[str, Any]]) -> list[str]:
    """What the runs warned about, and why those that failed did."""
    lines = [f"- {r['name']}: {text}" for r in records for text in [*r.get("warnings", ()), *r.get("message", ())]]
    return ["**Warnings and failures**", "", *lines, ""] if lines else []


def write_page(work: Path, page: Path) -> None:
    """Replace what is between the markers of the page."""
    records = [json.loads(p.read_text(encoding="utf-8")) for p in sorted(work.glob("*.run.json"))]
    lines: list[str] = []
    for preset in sorted({r["preset"] for r in records}, key=["draft", "standard", "hero"].index):
        some = [r for r in records if r["preset"] == preset]
        some.sort(key=lambda r: (r["name"].startswith("clip "), r["name"] != "demo", r["name"]))
        where = sorted({f"{r['machine']} (fluidlift {r.get('version') or '-'}, {r['date']})" for r in some})
        lines += [f"## Preset {preset}", "", "Measured on " + "; ".join(where) + ".", ""]
        lines += run_table(some) + stage_table(some) + case_tables(some) + warning_list(some)
    text = page.read_text(encoding="utf-8")
    if BEGIN not in text or END not in text:
        raise SystemExit(f"{page.name} has no markers {BEGIN} and {END}")
    head, tail = text.split(BEGIN)[0], text.split(END)[1]
    page.write_text(f"{head}{BEGIN}\n" + "\n".join(lines).rstrip() + f"\n{END}{tail}", encoding="utf-8")


def main() -> int:
    """Run what is missing, keep its figures, then write the page."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--work", type=Path, required=True, help="folder for assets, logs and one JSON per run")
    parser.add_argument("--shared", type=Path, default=default_shared(), help="folder with cases/ and clips/")
    parser.add_argument("--preset", action="append", choices=["draft", "standard", "hero"], help="default: draft")
    parser.add_argument("--only", action="append", metavar="NAME", help="names that contain this; may be repeated")
    parser.add_argument("--again", action="store_true", help="run again what has been run")
    parser.add_argument("--tables-only", action="store_true", help="run nothing, write the page")
    parser.add_argument("--page", type=Path, help=f"page with the markers {BEGIN} and {END}")
    parser.add_argument("--set", action="append", default=[], metavar="SECTION.NAME=VALUE", help="passed on to make")
    args = parser.parse_args()
    args.work.mkdir(parents=True, exist_ok=True)
    if args.shared is None:
        print("no cases or clips beside the demo: set FLUIDLIFT_SHARED or --shared", file=sys.stderr)
    extra = [word for setting in args.set for word in ("--set", setting)]
    for preset in [] if args.tables_only else args.preset or ["draft"]:
        for subject in subjects(args.shared, args.work):
            if args.only and not any(part in subject.name for part in args.only):
                continue
            file = args.work / f"{subject.name.replace(' ', '_')}.{preset}.run.json"
            if file.is_file() and not args.again:
                print(f"{subject.name} {preset}: already there")
                continue
            record = run(subject, preset, args.work, extra)
            half = file.with_suffix(".part")
            half.write_text(json.dumps(record, indent=1), encoding="utf-8")
            half.replace(file)
            if preset == "draft":
                keep(record)
            outcome = f"exit code {record['exit_code']}, {record['wall_s']:.0f} s, {record['peak_memory_mb']} MB"
            print(f"{subject.name} {preset}: {outcome}", flush=True)
    if args.page is not None:
        write_page(args.work, args.page)
    return 0


if __name__ == "__main__":
    sys.exit(main())
