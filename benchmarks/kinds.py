"""How often the kind is right that is found of a clip, and whether it is as sure as it is right.

    python benchmarks/kinds.py --work runs/kinds [--only name] [--size 320] [--window middle] [--crops SEED] [--record]

Clips are looked for below FLUIDLIFT_SHARED, or a folder `shared` beside the repository: 1.2 s of each, at 320 px, from
around its middle frame (`--window first` and `last`: its ends). Only mask, flow, kind and tilt are found; what the work
folder holds is used again. What each shows is written below, from its description and a look at it: some show two
kinds. A clip counts as right where the likeliest kind is one of them. `--record` writes benchmarks/results/kinds.json.

`--crops` looks at a part of each picture instead, drawn by a seed: two thirds of either side with half of the fluid or
more (by the hand mask, where there is one), every second one mirrored. These are pictures that nobody has looked at.
"""

from __future__ import annotations

import argparse
import platform
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import date
from pathlib import Path

import cv2
import numpy as np
from clips import default_shared

from fluidlift.config import build_config
from fluidlift.io.video import probe, read_clip, write_video
from fluidlift.pipeline import Inputs
from fluidlift.pipeline.find import View, find_hints

SECONDS = 1.2
"""of a clip that are looked at"""
SHOWS = {
    "beach_waves": "basin", "brague_flood": "stream", "calm_river_reflect": "stream", "cascade": "stream fall",
    "chatelet_fountain": "fall pour", "chocolate_pancakes": "pour", "coffee_cup": "pour", "corn_boil": "basin",
    "dyntex_fountain": "fountain", "forest_brook": "stream", "garden_tap": "pour", "geul_river": "stream",
    "grill_smoke": "plume", "honey_sieve": "stream", "latte_art": "pour", "lava_night": "stream",
    "navizence_drone": "stream", "niagara_river": "stream", "niagara_side": "fall", "pour_glass": "pour",
    "pour_over": "pour", "pour_tumbler": "pour", "scalarflow_smoke": "plume", "sea_inlet": "basin", "splash": "pour",
    "steam_cup": "plume", "sunset_beach": "basin", "surf_topdown": "basin", "tall_fall": "fall",
    "tawi_river": "stream", "wall_cascade": "fall", "waterfall": "fall", "woods_torrent": "stream",
    "woods_weir": "stream fall",
}  # fmt: skip
"""what each clip shows, by name; honey lies in a tray under its jet, a weir is a stream with a ledge"""
BINS = (0.0, 0.6, 0.8, 1.0)
"""of the probability of the likeliest kind: some ten clips in each"""


FLUID = 200
"""grey level of a hand mask from which a pixel is fluid (255; 128 is not judged)"""
CROPPED = 2 / 3
"""of either side of a picture, in a crop of it"""
ENOUGH = 0.5
"""of the fluid, that a crop should show"""
DRAWN = 40
"""crops of which the first with enough is taken, else that with most"""


@dataclass(frozen=True)
class Judged:
    """One clip."""

    name: str
    kind: str
    """the likeliest"""
    share: float
    """its probability"""
    of_truth: float
    """probability of what it shows"""
    right: bool


def judged(name: str, scores: dict[str, float]) -> Judged:
    """The likeliest kind of a clip, and whether it is one that the clip shows."""
    kind, share = max(scores.items(), key=lambda item: item[1])
    shows = SHOWS[name].split()
    return Judged(name, kind, share, sum(scores[k] for k in shows), kind in shows)


def calibration(clips: Sequence[Judged]) -> dict[str, float]:
    """Figures over all clips: how many are right, how sure they are on average, log loss, expected calibration error.

    The last is the mean over the bins, weighted by their clips, of |share that is right - mean probability|.
    """
    right, share = np.array([c.right for c in clips]), np.array([c.share for c in clips])
    error = 0.0
    for low, high in zip(BINS, BINS[1:]):
        here = (share > low) & (share <= high)
        error += abs(float(right[here].sum()) - float(share[here].sum()))
    return {
        "right": float(right.mean()),
        "probability": float(share.mean()),
        "calibration error": error / len(clips),
        "log loss": float(-np.log(np.maximum([c.of_truth for c in clips], 1e-9)).mean()),
        "wrong and over 0.8": float((~right & (share > BINS[-2])).sum()),
    }


def found(video: Path, folder: Path, size: int, window: str) -> View:
    """Mask, kind and tilt as `make` finds them."""
    info = probe(video)
    seconds = min(SECONDS, info.duration)
    left = info.duration - seconds
    start = {"first": 0.0, "middle": 0.5 * left, "last": left}[window]
    base = {"read.max_size": size, "read.start": start, "read.duration": seconds}
    return find_hints(Inputs(video), folder, build_config(None, None, (), None, base=base)).view


def crop(video: Path, out: Path, seed: int) -> Path:
    """A part of each picture of a clip as a clip of its own."""
    info = probe(video)
    frames = read_clip(video, max_size=max(info.size)).frames
    height, width = frames.shape[1:3]
    rows, columns = (int(CROPPED * n) // 2 * 2 for n in (height, width))
    drawn = next((f for f in (video.parent / "mask.png", video.parent / "mask_hand.png") if f.is_file()), None)
    mask = np.ones((height, width))
    if drawn is not None:
        mask = cv2.resize(cv2.imread(str(drawn), cv2.IMREAD_GRAYSCALE), (width, height), interpolation=0) > FLUID
    rng = np.random.default_rng([seed, zlib.crc32(video.parent.name.encode())])
    best, place = -1.0, (0, 0)
    for _ in range(DRAWN):
        y, x = int(rng.integers(0, height - rows + 1)), int(rng.integers(0, width - columns + 1))
        share = float(mask[y : y + rows, x : x + columns].sum() / max(mask.sum(), 1))
        best, place = max((best, place), (share, (y, x)))
        if share >= ENOUGH:
            break
    part = frames[:, place[0] : place[0] + rows, place[1] : place[1] + columns]
    part = part[:, :, ::-1] if rng.random() < 0.5 else part
    return write_video(out, np.ascontiguousarray(part), info.fps, quality=14, repeatable=True)


def write(clips: Sequence[Judged], figures: dict[str, float], command: str) -> None:
    """Into benchmarks/results/kinds.json."""
    from report import put

    records = [{"subject": "all clips", "figure": k, "value": round(v, 3)} for k, v in figures.items()]
    for c in clips:
        shown = {"figure": "probability of what it shows", "value": round(c.of_truth, 2)}
        records.append({"subject": c.name.replace("_", " ")} | shown)
    machine = f"2 cores, {platform.system()}, Python {platform.python_version()}"
    put("kinds", records, command=command, date=date.today().isoformat(), machine=machine)


def main() -> int:
    """Look, judge, tell."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--work", type=Path, default=Path("runs/kinds"), help="folder for what is found")
    parser.add_argument("--only", nargs="+", help="names of clips")
    parser.add_argument("--size", type=int, default=320, help="px of the longer side")
    parser.add_argument("--window", choices=("first", "middle", "last"), default="middle", help="part of each clip")
    parser.add_argument("--crops", type=int, metavar="SEED", help="parts of the pictures instead; not recorded")
    parser.add_argument("--record", action="store_true", help="write benchmarks/results/kinds.json")
    wanted = parser.parse_args()
    shared = default_shared()
    if shared is None:
        raise SystemExit("no clips: set FLUIDLIFT_SHARED")
    clips = []
    for name in sorted(SHOWS):
        video = next(iter(shared.glob(f"clips*/{name}/video.mp4")), None)
        if video is None or (wanted.only and name not in wanted.only):
            continue
        folder = f"{name}_{wanted.size}_{wanted.window}"
        if wanted.crops is not None:
            folder += f"_crop{wanted.crops}"
            wanted.work.mkdir(parents=True, exist_ok=True)
            video = crop(video, wanted.work / f"{folder}.mp4", wanted.crops)
        view = found(video, wanted.work / folder, wanted.size, wanted.window)
        clips.append(judged(name, view.kind_evidence.scores))
        told = sorted(view.kind_evidence.scores.items(), key=lambda item: -item[1])[:3]
        print(f"{name:20} {'right' if clips[-1].right else 'WRONG'}", " ".join(f"{k} {v:.2f}" for k, v in told),
              f"-> {view.kind}, tilt {view.up.pitch - view.up.raised:.1f}", flush=True)  # fmt: skip
    if not clips:
        raise SystemExit("none of the clips is there")
    figures = calibration(clips)
    print(f"{len(clips)} clips: " + ", ".join(f"{k} {v:.3f}" for k, v in figures.items()))
    if wanted.record and wanted.crops is None:
        write(clips, figures, "python benchmarks/kinds.py --work runs/kinds --record")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
