"""How often the kind is right that is found of a clip, and whether it is as sure as it is right.

    python benchmarks/kinds.py --work runs/kinds [--only name] [--size 320] [--window middle] [--crops SEED] [--record]
    python benchmarks/kinds.py --work runs/kinds [--made] --table benchmarks/kind_features.json

Clips are looked for below FLUIDLIFT_SHARED, or a folder `shared` beside the repository: 1.2 s of each, at 320 px, from
around its middle frame (`--window first` and `last`: its ends). Only mask, flow, kind and tilt are found; what the work
folder holds is used again. What each shows is written below, from its description and a look at it: some show two
kinds. A clip counts as right where the likeliest kind is one of them. `--record` writes benchmarks/results/kinds.json.

`--crops` looks at a part of each picture instead, drawn by a seed: two thirds of either side with half of the fluid or
more (by the hand mask, where there is one), every second one mirrored. These are pictures that nobody has looked at.
`--made` looks at made clips. `--table` adds the features of what was looked at to the table of `kinds_fit.py`, in place
of those that it has of the same.
"""

from __future__ import annotations

import argparse
import json
import platform
import zlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from datetime import date
from itertools import islice
from pathlib import Path

import cv2
import numpy as np
from clips import default_shared

from fluidlift.config import build_config
from fluidlift.io.video import probe, read_clip, write_video
from fluidlift.pipeline import Inputs
from fluidlift.pipeline.find import FoundView, find_hints
from fluidlift.synthetic.demo import demo_clip

SECONDS = 1.2
"""of a clip that are looked at"""
SHOWS = {
    "beach_waves": "basin", "brague_flood": "stream", "calm_river_reflect": "stream", "cascade": "stream fall",
    "chatelet_fountain": "fall pour", "chocolate_pancakes": "pour", "coffee_cup": "pour", "corn_boil": "basin",
    "dyntex_fountain": "fountain", "forest_brook": "stream", "garden_tap": "pour", "geul_river": "stream",
    "grill_smoke": "plume", "honey_sieve": "stream", "latte_art": "basin", "lava_night": "stream",
    "navizence_drone": "stream", "niagara_river": "stream", "niagara_side": "fall", "pour_glass": "pour",
    "pour_over": "basin pour", "pour_tumbler": "pour", "scalarflow_smoke": "plume", "sea_inlet": "basin",
    "splash": "pour", "steam_cup": "plume", "sunset_beach": "basin", "surf_topdown": "basin", "tall_fall": "fall",
    "tawi_river": "stream", "wall_cascade": "fall", "waterfall": "fall", "woods_torrent": "stream",
    "woods_weir": "stream fall",
}  # fmt: skip
"""what each clip shows, by name; honey lies in a tray under its jet, a weir is a stream with a ledge, latte art a cup
looked into (as a pour all of it would stand upright in the air)"""
BINS = (0.0, 0.6, 0.8, 1.0)
"""of the probability of the likeliest kind: some ten clips in each"""


FRAMES = 30
"""of a made clip"""
FLUID = 200
"""grey level of a hand mask from which a pixel is fluid (255; 128 is not judged)"""
CROPPED = 2 / 3
"""of either side of a picture, in a crop of it"""
ENOUGH = 0.5
"""of the fluid, that a crop should show"""
CASES = {"honey": "stream", "pisco": "stream", "river": "stream", "smoke": "plume"}
"""of another simulator, and a surveyed river"""
CUT = {"dyntex_fountain": "fountain fall"}
"""what parts of pictures show where it is something else: without its top a fountain cannot be told from a fall"""
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


def judged(name: str, scores: dict[str, float], shown: str) -> Judged:
    """The likeliest kind of a clip, and whether it is one of those that it shows."""
    kind, share = max(scores.items(), key=lambda item: item[1])
    shows = shown.split()
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


def found(video: Path, folder: Path, size: int, window: str) -> FoundView:
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


def made_clips() -> dict[str, tuple[str, Callable[[], tuple[np.ndarray, float]]]]:
    """Name, kinds, and what gives the pictures and the frames per second, of clips made by the package."""
    from fluidlift.synthetic.clear_stream import CAMERAS, ClearStream, film_of_bed
    from fluidlift.synthetic.fountain import FRAME_RATE, filmed_airborne
    from fluidlift.synthetic.hand_pour import hand_pour
    from fluidlift.synthetic.record import record
    from fluidlift.synthetic.riverside import Riverside, film, walk
    from fluidlift.synthetic.scenes import scene_of

    def bed(seed: int) -> np.ndarray:
        return film_of_bed(ClearStream.make(seed), tuple(CAMERAS.values())[seed], FRAMES).frames

    def simulated(name: str, seed: int) -> tuple[np.ndarray, float]:
        scene = scene_of(name, size=(240, 176), seed=seed, cells=48)
        return record(scene, FRAMES).frames, scene.fps

    airborne = dict.fromkeys(("single", "row", "froth", "inclined", "windy"), "fountain")
    airborne |= {"fall": "fall", "weir": "fall stream", "spout": "pour fall"}
    clips: dict[str, tuple[str, Callable[[], tuple[np.ndarray, float]]]] = {}
    for seed in range(2):
        for name, shows in airborne.items():
            clips[f"air {name} {seed}"] = shows, lambda n=name, s=seed: (filmed_airborne(n, s).frames, FRAME_RATE)
        for path in ("standing", "turning"):
            cameras = walk(path, FRAMES)
            clips[f"riverside {path} {seed}"] = (
                "stream",
                lambda c=cameras, s=seed: (film(Riverside.make(s), c).frames, 25.0),
            )
        clips[f"clear {seed}"] = "stream", lambda s=seed: (bed(s), 25.0)
        clips[f"scene dam {seed}"] = "dam", lambda s=seed: simulated("dam", s)
    for seed in range(8):
        clips[f"hand {seed}"] = "pour", lambda s=seed: (hand_pour(s).frames, 25.0)
    for name, shows in (("stream", "stream"), ("pour", "pour"), ("honey", "stream")):
        clips[f"scene {name} 0"] = shows, lambda n=name: simulated(n, 0)
    return clips


def add_to_table(table: Path, looks: Sequence[dict[str, object]]) -> None:
    """Put looks into a table, in place of those of the same part of the same clip."""
    kept = json.loads(table.read_text(encoding="utf-8"))["looks"] if table.is_file() else []
    known = {(look["clip"], look["part"]): look for look in [*kept, *looks]}
    lines = ",\n".join(json.dumps(known[key]) for key in sorted(known))
    table.write_text('{"looks": [\n' + lines + "\n]}\n", encoding="utf-8")


@dataclass(frozen=True)
class Subject:
    """What is looked at."""

    name: str
    part: str
    shows: str
    video: Callable[[], Path]
    """writes it, where it is not there"""


def real_subjects(shared: Path, work: Path, window: str, seed: int | None) -> Iterator[Subject]:
    """Clips, or parts of their pictures."""
    for name, shows in sorted(SHOWS.items()):
        for video in islice(shared.glob(f"clips*/{name}/video.mp4"), 1):
            if seed is None:
                yield Subject(name, window, shows, lambda v=video: v)
            else:
                out = work / f"{name}_{window}_crop{seed}.mp4"
                yield Subject(
                    name, f"{window} crop {seed}", CUT.get(name, shows), lambda v=video, o=out: crop(v, o, seed)
                )


def made_subjects(shared: Path | None, work: Path) -> Iterator[Subject]:
    """Clips of the package, and the cases, where they are there."""
    yield Subject("demo", "made", "stream", demo_clip)
    for name, shows in CASES.items():
        for video in () if shared is None else shared.glob(f"cases/{name}/video.mp4"):
            yield Subject(f"case {name}", "made", shows, lambda v=video: v)
    for name, (shows, frames) in made_clips().items():
        out = work / f"{name.replace(' ', '_')}.mp4"
        yield Subject(name, "made", shows, lambda f=frames, o=out: write_video(o, *f(), quality=14, repeatable=True))


def main() -> int:
    """Look, judge, tell."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--work", type=Path, default=Path("runs/kinds"), help="folder for what is found")
    parser.add_argument("--only", nargs="+", help="names of clips")
    parser.add_argument("--size", type=int, default=320, help="px of the longer side")
    parser.add_argument("--window", choices=("first", "middle", "last"), default="middle", help="part of each clip")
    parser.add_argument("--crops", type=int, metavar="SEED", help="parts of the pictures instead; not recorded")
    parser.add_argument("--made", action="store_true", help="clips that the package makes instead; not recorded")
    parser.add_argument("--table", type=Path, help="table of features to add to")
    parser.add_argument("--record", action="store_true", help="write benchmarks/results/kinds.json")
    wanted = parser.parse_args()
    shared = default_shared()
    if shared is None and not wanted.made:
        raise SystemExit("no clips: set FLUIDLIFT_SHARED")
    wanted.work.mkdir(parents=True, exist_ok=True)
    subjects = (
        made_subjects(shared, wanted.work)
        if wanted.made
        else real_subjects(shared, wanted.work, wanted.window, wanted.crops)
    )
    clips, looks = [], []
    for s in subjects:
        if wanted.only and s.name not in wanted.only:
            continue
        folder = wanted.work / f"{s.name}_{wanted.size}_{s.part}".replace(" ", "_")
        view = found(s.video(), folder, wanted.size, "middle" if wanted.made else wanted.window)
        evidence = view.kind_evidence
        clips.append(judged(s.name, evidence.scores, s.shows))
        features = {name: round(float(value), 3) for name, value in evidence.features.items()}
        looks.append({"clip": s.name.replace("_", " "), "part": s.part, "shows": s.shows, "features": features})
        told = sorted(evidence.scores.items(), key=lambda item: -item[1])[:3]
        print(f"{s.name:20} {'right' if clips[-1].right else 'WRONG'}", " ".join(f"{k} {v:.2f}" for k, v in told),
              f"-> {view.kind}, tilt {view.up.pitch - view.up.raised:.1f}", flush=True)  # fmt: skip
    if not clips:
        raise SystemExit("none of the clips is there")
    if wanted.table:
        add_to_table(wanted.table, looks)
    figures = calibration(clips)
    print(f"{len(clips)} clips: " + ", ".join(f"{k} {v:.3f}" for k, v in figures.items()))
    if wanted.record and wanted.crops is None and not wanted.made:
        write(clips, figures, "python benchmarks/kinds.py --work runs/kinds --record")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
