"""Overlap of the automatic mask with masks that a person drew and with exact ones; puts it into benchmarks/results.

    python benchmarks/masks.py --work runs/masks && python -m benchmarks.report

Clips (folders with video.mp4) and cases (with truth.npz) are looked for below FLUIDLIFT_SHARED, or a folder `shared`
beside the repository; the demo is always there. A mask drawn by hand belongs to the middle frame: mask.png beside the
clip, or outlines of mask_outlines.json (percent of width and height: fluid, then what in it is dry, then what a person
could not tell; to about 8 px of 512). It is carried to the steadied picture by the features that both have. Exact masks
count at every frame. Frames and optical flow are kept in the work folder: they do not depend on how a mask is found.
`--overlays` writes pictures: the mask that was found, and the right outline.
"""

from __future__ import annotations

import argparse
import json
import platform
import shutil
import time
from collections.abc import Iterator
from contextlib import nullcontext
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any
from unittest.mock import patch

import cv2
import numpy as np
from clips import default_shared
from report import put

from fluidlift.evaluate.case import read_case
from fluidlift.evaluate.images import mask_iou, resample_nearest
from fluidlift.io.video import read_clip
from fluidlift.motion.optical_flow import DenseInverseSearch, flow_of_pair
from fluidlift.pipeline.inputs import GivenFile
from fluidlift.pipeline.settings import ReadSettings
from fluidlift.pipeline.stages.read import read
from fluidlift.pipeline.work import Work
from fluidlift.shape.evidence import fluid_score, gather_evidence
from fluidlift.shape.fluid_found import likely_overlap
from fluidlift.shape.frame_pictures import typical_picture
from fluidlift.shape.moving_solids import SharedPairs, moving_solids
from fluidlift.shape.open_water import field_around, lies_open, log_wander
from fluidlift.shape.segment import clues_of, overlay, segment
from fluidlift.synthetic.demo import unpack_demo_case
from fluidlift.types.clip import Label, PixelLabels, VideoClip

OUTLINES = Path(__file__).with_name("mask_outlines.json")
UNFIT = ("cascade", "dyntex_fountain", "waterfall")
"""clips whose mask_hand.png covers other water than the clip shows"""
READING = ReadSettings(
    start=0.0,
    duration=None,
    max_size=512,
    fps=25.0,
    stabilise=True,
    crop="none",
    poses=True,
    max_pixels=50_000_000,
    max_frames=600,
)
UNJUDGED = 128
"""value of a drawn mask where a person could not tell"""
NO_WATER = patch.multiple(
    "fluidlift.shape.segment",
    with_open_water=lambda evidence, region, barred: region,
    with_quiet_reaches=lambda evidence, region, barred: region,
)
"""masks without what `open_water`, which is fitted on them, and `quiet_reaches` after it add"""


@dataclass(frozen=True)
class Subject:
    """A clip, and what its mask should be."""

    name: str
    video: Path
    drawn: np.ndarray | None = None
    """u8 [H,W], mask of the middle frame, of any size: 255 fluid, 0 none, `UNJUDGED`"""
    case: Path | None = None
    """folder with the truth of every frame"""


@dataclass(frozen=True)
class Prepared:
    """What does not depend on how masks are found."""

    clip: VideoClip
    displacement: np.ndarray
    """float16 [T-1,H,W,2], px"""
    confidence: np.ndarray
    """float16 [T-1,H,W]"""
    said: np.ndarray | None
    """log odds of fluid that the camera's path told"""
    truth: dict[int, np.ndarray]
    """frame: u8 [H,W], 255 fluid, 0 none, `UNJUDGED`"""

    def flow(self, t: int) -> tuple[np.ndarray, np.ndarray]:
        """Displacement and confidence from frame t to t + 1."""
        return self.displacement[t].astype(np.float32), self.confidence[t].astype(np.float32)


def subjects(shared: Path | None, work: Path) -> Iterator[Subject]:
    """The demo, then cases, then clips for which there is a mask."""
    demo = unpack_demo_case(work / "demo_case")
    yield Subject("demo", demo / "video.mp4", case=demo)
    if shared is None:
        return
    for folder in sorted(p.parent for p in shared.glob("cases/*/truth.npz")):
        for video in sorted(folder.glob("video*.mp4")):
            yield Subject(folder.name + video.stem.removeprefix("video"), video, case=folder)
    for video in sorted([*shared.glob("clips/*/video.mp4"), *shared.glob("clips2/*/video.mp4")]):
        if (drawn := drawn_mask(video.parent)) is not None:
            yield Subject(f"clip {video.parent.name}", video, drawn)


def drawn_mask(clip: Path) -> np.ndarray | None:
    """u8 [H,W], the mask of the middle frame of a clip in a folder of its own, where a person drew one."""
    for path in (clip / "mask.png", *([] if clip.name in UNFIT else [clip / "mask_hand.png"])):
        if path.is_file():
            return cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
    outlines = json.loads(OUTLINES.read_text(encoding="utf-8"))
    return filled(outlines[clip.name]) if clip.name in outlines else None


def filled(outlines: dict[str, list[list[list[float]]]], size: int = 1024) -> np.ndarray:
    """u8 [size,size], the mask that polygons bound, which are in percent of width and height."""
    mask = np.zeros((size, size), np.uint8)
    for what, value in (("fluid", 255), ("dry", 0), ("unjudged", UNJUDGED)):
        for polygon in outlines.get(what, []):
            cv2.fillPoly(mask, [np.rint(np.array(polygon) * (size / 100.0)).astype(np.int32)], value)
    return mask


def prepared(subject: Subject, work: Path) -> Prepared:
    """Frames as the pipeline sees them, the flow of all pairs, and the truth, from the work folder where they lie."""
    folder = work / subject.name.replace(" ", "_")
    if not (folder / "done").is_file():
        folder.mkdir(parents=True, exist_ok=True)
        _prepare(subject, folder)
    clip = VideoClip(np.load(folder / "frames.npy", mmap_mode="r"), np.load(folder / "times.npy"), subject.name)
    kept = np.load(folder / "kept.npy")
    flows = (np.load(folder / f"{name}.npy", mmap_mode="r") for name in ("displacement", "confidence"))
    said = np.load(folder / "said.npy") if (folder / "said.npy").is_file() else None
    return Prepared(clip, *flows, said, _truth(subject, clip, kept, np.load(folder / "middle.npy")))


def _prepare(subject: Subject, folder: Path) -> None:
    scratch = folder / "scratch"
    scratch.mkdir(exist_ok=True)
    found = read(GivenFile(subject.video, ""), None, READING, work=Work.alone(scratch))
    if found.fluid_evidence is not None:
        np.save(folder / "said.npy", found.fluid_evidence)
    frames, estimator = np.array(found.clip.frames), DenseInverseSearch()
    displacement = np.empty((len(frames) - 1, *frames.shape[1:3], 2), np.float16)
    confidence = np.empty(displacement.shape[:3], np.float16)
    for t in range(len(displacement)):
        displacement[t], confidence[t] = flow_of_pair(frames[t], frames[t + 1], estimator)
    raw = read_clip(subject.video, start=0.0, duration=None, max_size=READING.max_size).frames
    kept = {"frames": frames, "times": found.clip.times, "kept": found.kept, "displacement": displacement}
    for name, array in (kept | {"confidence": confidence, "middle": raw[len(raw) // 2]}).items():
        np.save(folder / f"{name}.npy", array)
    (folder / "middle.txt").write_text(str(len(raw) // 2), encoding="utf-8")
    shutil.rmtree(scratch)
    (folder / "done").touch()


def _truth(subject: Subject, clip: VideoClip, kept: np.ndarray, middle: np.ndarray) -> dict[int, np.ndarray]:
    height, width = clip.frames.shape[1:3]
    if subject.case is not None:
        masks = read_case(subject.case).mask
        masks = [resample_nearest(masks[k], (width, height)) for k in kept if k < len(masks)]
        return {t: np.where(mask, np.uint8(255), np.uint8(0)) for t, mask in enumerate(masks)}
    assert subject.drawn is not None, "a clip without a case has a drawn mask"
    drawn = cv2.resize(subject.drawn, middle.shape[1::-1], interpolation=cv2.INTER_NEAREST)
    alike = [float(np.abs(clip.frames[t][::4, ::4].astype(int) - middle[::4, ::4]).mean()) for t in range(len(clip))]
    near = int(np.abs(kept - _middle_number(subject, kept)).argmin()) if min(alike) > 1.0 else int(np.argmin(alike))
    motion = _carried(middle, np.asarray(clip.frames[near]))
    options = {"flags": cv2.INTER_NEAREST, "borderMode": cv2.BORDER_CONSTANT, "borderValue": UNJUDGED}
    return {near: cv2.warpAffine(drawn, motion, (width, height), **options)}


def _middle_number(subject: Subject, kept: np.ndarray) -> int:
    capture = cv2.VideoCapture(str(subject.video))
    count = int(capture.get(cv2.CAP_PROP_FRAME_COUNT))
    return count // 2 if count > 0 else int(kept[len(kept) // 2])


def _carried(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """[2,3], similarity that lays one picture on another."""
    one, other = (cv2.cvtColor(np.ascontiguousarray(x), cv2.COLOR_RGB2GRAY) for x in (first, second))
    orb = cv2.ORB_create(2000)
    (places, looks), (there, others) = (orb.detectAndCompute(x, None) for x in (one, other))
    if looks is None or others is None:
        return np.eye(2, 3)
    pairs = cv2.BFMatcher(cv2.NORM_HAMMING, crossCheck=True).match(looks, others)
    if len(pairs) < 20:
        return np.eye(2, 3)
    begin = np.array([places[m.queryIdx].pt for m in pairs], np.float32)
    end = np.array([there[m.trainIdx].pt for m in pairs], np.float32)
    cv2.setRNGSeed(0)
    motion, inliers = cv2.estimateAffinePartial2D(begin, end, ransacReprojThreshold=1.5)
    return np.eye(2, 3) if motion is None or inliers.sum() < 15 else motion


def overlap(labels: np.ndarray, truth: dict[int, np.ndarray]) -> float:
    """Mean intersection over union of the fluid in labels u8 [T,H,W], where it is judged."""
    found = []
    for t, mask in truth.items():
        judged = mask != UNJUDGED
        found.append(float(mask_iou((labels[t] == Label.FLUID) & judged, mask > UNJUDGED)))
    return float(np.mean(found))


def calibration(found: PixelLabels, truth: dict[int, np.ndarray], *, bins: int = 10) -> np.ndarray:
    """[bins,3]: pixels, mean chance that the label is right, and share that is right, by that chance (0.5 to 1)."""
    rows = np.zeros((bins, 3))
    for t, mask in truth.items():
        judged = mask != UNJUDGED
        chance = 0.5 + 0.5 * found.confidence[t][judged].astype(float)
        right = ((found.labels[t] == Label.FLUID) == (mask > UNJUDGED))[judged]
        place = np.clip(((chance - 0.5) * 2 * bins).astype(int), 0, bins - 1)
        for column, weight in enumerate((np.ones(len(place)), chance, right.astype(float))):
            rows[:, column] += np.bincount(place, weight, bins) / len(truth) / judged.sum()
    return rows


def sampled_pixels(ready: Prepared, found: PixelLabels, most: int = 1500) -> dict[str, np.ndarray]:
    """What is known of some judged pixels of the middle of a clip: what change and motion say, outline, and truth."""
    t = list(ready.truth)[len(ready.truth) // 2]
    pairs = SharedPairs(ready.clip, ready.flow)
    evidence = gather_evidence(ready.clip, pairs)
    size = evidence.noise.shape[::-1]
    truth = cv2.resize(ready.truth[t], size, interpolation=cv2.INTER_NEAREST)
    inside = cv2.resize((found.labels[t] == Label.FLUID).astype(np.float32), size) > 0.5
    places = np.flatnonzero(truth != UNJUDGED)  # at outlines, too: there masks are wrong, and confidence is judged
    picked = np.random.default_rng(0).permutation(places)[:most]
    columns = {
        "score": fluid_score(replace(evidence, carried=np.zeros_like(evidence.carried))), "carried": evidence.carried,
        "solid": moving_solids(ready.clip, pairs, evidence.noise.shape), "inside": inside, "fluid": truth > UNJUDGED,
    }  # fmt: skip
    return {name: values.ravel()[picked] for name, values in columns.items()}


def water_pixels(ready: Prepared, found: PixelLabels, most: int = 1500) -> dict[str, np.ndarray] | None:
    """What `shape.open_water` reads of some judged pixels outside the mask, and truth; None where it is not asked.

    The mask is that without it: `main` switches it off for this.
    """
    t = list(ready.truth)[len(ready.truth) // 2]
    evidence = gather_evidence(ready.clip, SharedPairs(ready.clip, ready.flow))
    size = evidence.noise.shape[::-1]
    region = cv2.resize((found.labels[t] == Label.FLUID).astype(np.float32), size) > 0.5
    wander = log_wander(evidence)
    if not lies_open(region, wander):
        return None
    truth = cv2.resize(ready.truth[t], size, interpolation=cv2.INTER_NEAREST)
    places = np.flatnonzero((truth != UNJUDGED) & ~region)
    picked = np.random.default_rng(0).permutation(places)[:most]
    field = field_around(wander, typical_picture(evidence.pictures), region, region)
    columns = {"wander": field.wander, "colour": field.colour, "height": field.height, "fluid": truth > UNJUDGED}
    return {name: values.ravel()[picked] for name, values in columns.items()}


def picture(frame: np.ndarray, labels: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """u8 [H,W,3]: what was found, blue, and the outline of what should be, red."""
    shown = overlay(np.ascontiguousarray(frame), labels)
    outlines = cv2.findContours((mask > UNJUDGED).astype(np.uint8), cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)[0]
    cv2.drawContours(shown, outlines, -1, (255, 0, 0), 1)
    shown[mask == UNJUDGED] = shown[mask == UNJUDGED] // 2 + 64
    return shown


def write_pixels(path: Path, pixels: dict[str, dict[str, np.ndarray]]) -> None:
    """One table of all clips: numbers alone, no pictures."""
    names = list(pixels)
    joined = {k: np.concatenate([pixels[n][k] for n in names]) for k in pixels[names[0]]}
    joined |= {k: v.astype(np.float16) for k, v in joined.items() if v.dtype.kind == "f"}
    clip = np.repeat(np.arange(len(names), dtype=np.uint8), [len(pixels[n]["fluid"]) for n in names])
    np.savez_compressed(path, names=np.array(names), clip=clip, **joined)


def over_real_clips(records: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Median, mean and least overlap of the real clips."""
    real = [r["value"] for r in records if r["figure"] == "IoU" and r["subject"].startswith("clip ")]
    found = {"median": np.median(real), "mean": np.mean(real), "least": np.min(real)}
    return [
        {"subject": f"{len(real)} clips, {name}", "figure": "IoU", "value": round(float(value), 3)}
        for name, value in found.items()
    ]


def main() -> None:
    """Measure what was asked for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--work", type=Path, required=True, help="folder for frames and flow")
    parser.add_argument("--only", nargs="*", help="names of subjects")
    parser.add_argument("--overlays", type=Path, help="folder for pictures")
    parser.add_argument("--pixels", type=Path, help="file for a sample of pixels, which masks_fit.py reads")
    parser.add_argument("--water", type=Path, help="file for a sample of pixels, which open_water_fit.py reads")
    parser.add_argument("--dry", action="store_true", help="write no results")
    args = parser.parse_args()
    args.work.mkdir(parents=True, exist_ok=True)
    records, sure, ious, pixels, water = [], [], [], {}, {}
    for subject in subjects(default_shared(), args.work):
        if args.only and subject.name.removeprefix("clip ") not in args.only:
            continue
        ready = prepared(subject, args.work)
        began = time.process_time()
        try:
            with NO_WATER if args.water is not None else nullcontext():
                found = segment(
                    ready.clip, ready.flow, clues=lambda ready=ready: clues_of(ready.clip, ready.flow, said=ready.said)
                )
        except Exception as error:  # a clip that is refused counts as one without a mask
            print(subject.name, error, flush=True)
            continue
        seconds, iou = time.process_time() - began, overlap(found.labels, ready.truth)
        sure.append(calibration(found, ready.truth))
        ious.append(iou)
        print(f"{subject.name:28} {iou:.3f} {seconds:5.1f} s", flush=True)
        likely = likely_overlap(found.labels, found.confidence)
        records += [
            {"subject": subject.name, "figure": "IoU", "value": round(iou, 3)},
            {"subject": subject.name, "figure": "likely IoU", "value": round(likely, 3)},
            {"subject": subject.name, "figure": "time", "value": round(seconds, 1)},
        ]
        if args.pixels is not None:
            pixels[subject.name] = sampled_pixels(ready, found)
        if args.water is not None and (some := water_pixels(ready, found)) is not None:
            water[subject.name] = some
        if args.overlays is not None:
            args.overlays.mkdir(parents=True, exist_ok=True)
            t = list(ready.truth)[len(ready.truth) // 2]
            shown = picture(ready.clip.frames[t], found.labels[t], ready.truth[t])
            cv2.imwrite(str(args.overlays / f"{subject.name.replace(' ', '_')}.png"), shown[..., ::-1])
    table = np.mean(sure, axis=0)
    off = float(np.abs(table[:, 1] - table[:, 2]).sum())
    print(f"median {np.median(ious):.3f} mean {np.mean(ious):.3f} least {np.min(ious):.3f} calibration error {off:.3f}")
    for share, chance, right in table:
        if share > 1e-3:
            print(f"  {100 * share:4.1f} % of the pixels: chance {chance / share:.2f}, right {right / share:.2f}")
    if args.pixels is not None:
        write_pixels(args.pixels, pixels)
    if args.water is not None:
        write_pixels(args.water, water)
    if not args.dry:
        summary = [{"subject": "all", "figure": "calibration error", "value": round(off, 3)}]
        summary += over_real_clips(records) if args.only is None else []
        put(
            "masks",
            records + summary,
            date=time.strftime("%Y-%m-%d"),
            machine=f"{platform.machine()}, {platform.system()}",
        )


if __name__ == "__main__":
    main()
