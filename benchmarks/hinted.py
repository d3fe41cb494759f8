"""What a person's hints change: drafts of clips alone and with a hints file, and how right each is.

    python benchmarks/hinted.py --hints hints --work runs/hinted [--only name] [--find] [--record]

`--hints` is a folder of <clip>.yaml (docs/hints.md), written by a person who looked at the clip for a minute. Clips are
looked for below FLUIDLIFT_SHARED, or a folder `shared` beside the repository. Each is made twice, at 320 px, from 1.2 s
around its middle frame, which the mask drawn by hand belongs to (as for `masks.py`). What lies in the work folder is
not made again. `--find` looks at mask, kind and tilt only. `--record` writes benchmarks/results/hinted.json.
"""

from __future__ import annotations

import argparse
import platform
import shutil
from dataclasses import dataclass
from datetime import date
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from as_filmed import fluidlift
from clips import default_shared
from masks import UNJUDGED, _carried, drawn_mask

from fluidlift.config import build_config
from fluidlift.evaluate.as_filmed import WRONG
from fluidlift.evaluate.images import mask_iou
from fluidlift.io.asset_folder import read_manifest
from fluidlift.io.hints_file import read_hints
from fluidlift.io.kept_values import recalled
from fluidlift.io.video import probe, read_clip
from fluidlift.pipeline import Inputs, card_of
from fluidlift.pipeline.find import Found, find_hints
from fluidlift.shape.drawn import frame_at
from fluidlift.shape.segment import overlay
from fluidlift.types.clip import Label
from fluidlift.types.hints import NOTHING_SAID, ClipHints
from fluidlift.types.stages import Read

SIZE, SECONDS = 320, 1.2
"""px of the longer side, and s of the clip that are made"""
WAYS = ("alone", "hinted")


@dataclass(frozen=True)
class Subject:
    """A clip with hints."""

    name: str
    video: Path
    hints: Path
    drawn: np.ndarray | None
    """mask of its middle frame, as of `drawn_mask`"""

    @property
    def middle(self) -> float:
        """s: its middle frame."""
        info = probe(self.video)
        return (info.frame_count or 0) // 2 * info.duration / max(info.frame_count or 1, 1)

    @property
    def start(self) -> float:
        """s at which the part in use begins."""
        return round(max(self.middle - 0.5 * SECONDS, 0.0), 2)


def subjects(hints: Path, shared: Path) -> list[Subject]:
    """Those with a hints file, in order."""
    found = []
    for file in sorted(hints.glob("*.yaml")):
        video = next((p for p in shared.glob(f"clips*/{file.stem}/video.mp4")), None)
        if video is None:
            raise SystemExit(f"no clip '{file.stem}' below {shared}")
        found.append(Subject(file.stem, video, file, drawn_mask(video.parent)))
    return found


def looked(s: Subject, folder: Path, said: ClipHints) -> Found:
    """Mask, kind and tilt, as `make` finds them; what it has left in its folder is used."""
    base = {"read.max_size": SIZE, "read.start": s.start, "read.duration": SECONDS}
    return find_hints(
        Inputs(s.video), folder, build_config(None, None, (), None, base=dict(said.settings) | base), said
    )


def made(s: Subject, work: Path, way: str) -> Path:
    """The asset."""
    folder = work / way / f"{s.name}.fluid"
    if not (folder / "manifest.json").is_file():
        fluidlift(
            "make", str(s.video), "-o", str(folder), "--start", str(s.start), "--duration", str(SECONDS),
            "--max-size", str(SIZE), *(("--hints", str(s.hints)) if way == "hinted" else ()),
        )  # fmt: skip
    return folder


@dataclass(frozen=True)
class Seen:
    """What was seen of a clip."""

    read: Read
    labels: np.ndarray
    """u8 [T,H,W]"""
    kind: str
    tilt: float
    """degrees below the horizon, as seen"""

    @property
    def frames(self) -> np.ndarray:
        return np.asarray(self.read.clip.frames)


def found_alone(s: Subject, work: Path, way: str) -> tuple[Seen, dict[str, Any]]:
    """Without making anything; read, flow and segment of what was made alone are used."""
    folder, known = work / f"{way}_find" / s.name, work / "alone" / f"{s.name}.fluid" / "work"
    for stage in ("read", "flow", "segment"):
        if (known / stage).is_dir() and not (folder / "work" / stage).exists():
            shutil.copytree(known / stage, folder / "work" / stage)
    found = looked(s, folder, read_hints(s.hints) if way == "hinted" else NOTHING_SAID)
    v = found.view
    seen = Seen(found.read, np.asarray(found.segmentation.labels.labels), v.kind, v.up.pitch - v.up.raised)
    return seen, {"scale": v.scale_sentence, "warnings": [str(w) for w in v.warnings]}


def of_asset(folder: Path) -> tuple[Seen, dict[str, Any]]:
    """What an asset was made from, and its card."""
    manifest = read_manifest(folder)
    read, segmentation, geometry = (recalled(folder, manifest, name) for name in ("read", "segment", "geometry"))
    seen = Seen(
        read, np.asarray(segmentation.labels.labels), geometry.kind, geometry.up.pitch - geometry.up.raised
    )  # fmt: skip
    card = card_of(manifest)
    if isinstance(card, str):
        return seen, {"verdict": f"none: {card}"}
    values = {key: card[key].value for key in ("level", "mean", "ring", "current_cosine")}
    return seen, {"verdict": card.verdict, "wrong": sum(f.verdict == WRONG for f in card.figures)} | values


def overlap(s: Subject, seen: Seen) -> float | None:
    """IoU of the mask with the one drawn by hand, at the middle frame."""
    if s.drawn is None:
        return None
    clip = seen.read.clip
    raw = read_clip(s.video, start=max(s.middle - 1e-3, 0.0), duration=0.2, max_size=SIZE).frames[0]
    t = frame_at(clip.times, s.middle)
    drawn = cv2.resize(s.drawn, raw.shape[1::-1], interpolation=cv2.INTER_NEAREST)
    motion = _carried(raw, seen.frames[t]) if seen.read.stabilised else np.eye(2, 3)
    truth = cv2.warpAffine(
        drawn, motion, clip.size, flags=cv2.INTER_NEAREST, borderMode=cv2.BORDER_CONSTANT, borderValue=UNJUDGED
    )
    judged = truth != UNJUDGED
    return float(mask_iou((seen.labels[t] == Label.FLUID) & judged, truth > UNJUDGED))


def figures(s: Subject, work: Path, way: str, *, find: bool) -> dict[str, Any]:
    """All of one asset, and a picture of its mask."""
    seen, more = found_alone(s, work, way) if find else of_asset(made(s, work, way))
    pictures = work / "pictures"
    pictures.mkdir(parents=True, exist_ok=True)
    t = frame_at(seen.read.clip.times, s.middle)
    cv2.imwrite(str(pictures / f"{s.name}_{way}.png"), overlay(seen.frames[t], seen.labels[t])[..., ::-1])
    return {"kind": seen.kind, "tilt": seen.tilt, "mask": overlap(s, seen)} | more


FIGURES = {"mask": "mask IoU", "tilt": "tilt", "wrong": "figures that do not hold", "level": "level",
           "mean": "mean picture", "ring": "ring"}  # fmt: skip


def write(rows: dict[str, dict[str, dict[str, Any]]]) -> None:
    """The figures, with the kind in the name of the subject."""
    from report import put

    records = []
    for name, ways in rows.items():
        kinds = [ways[way]["kind"] for way in WAYS]
        subject = f"{name.replace('_', ' ')}: {kinds[0]}" + (f", {kinds[1]}" if kinds[1] != kinds[0] else "")
        for key, figure in FIGURES.items():
            for way in WAYS:
                if (value := ways[way].get(key)) is not None:
                    records.append({"subject": subject, "figure": f"{figure}, {way}", "value": round(float(value), 3)})
    put(
        "hinted", records, command="python benchmarks/hinted.py --hints hints --work runs/hinted --record",
        date=date.today().isoformat(), machine=f"2 cores, {platform.system()}, Python {platform.python_version()}",
    )  # fmt: skip


def main() -> int:
    """Make, measure, tell."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--hints", type=Path, required=True, help="folder of <clip>.yaml")
    parser.add_argument("--work", type=Path, default=Path("runs/hinted"), help="folder for what is made")
    parser.add_argument("--only", nargs="+", help="names of clips")
    parser.add_argument("--ways", nargs="+", default=WAYS, choices=WAYS, help="alone, hinted or both")
    parser.add_argument("--find", action="store_true", help="mask, kind and tilt only")
    parser.add_argument("--record", action="store_true", help="write benchmarks/results/hinted.json")
    wanted = parser.parse_args()
    shared = default_shared()
    if shared is None:
        raise SystemExit("no clips: set FLUIDLIFT_SHARED")
    rows: dict[str, dict[str, dict[str, Any]]] = {}
    for s in subjects(wanted.hints, shared):
        if wanted.only and s.name not in wanted.only:
            continue
        rows[s.name] = {way: figures(s, wanted.work, way, find=wanted.find) for way in wanted.ways}
        for way, found in rows[s.name].items():
            told = (f"{k} {v:.3f}" if isinstance(v, float) else f"{k} {v}" for k, v in found.items())
            print(f"{s.name:20} {way:7}", "; ".join(told), flush=True)
    if wanted.record:
        write(rows)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
