"""What the pictures themselves say about flow: does the true motion explain them better than the one that was found?

    python benchmarks/motion_evidence.py --work runs --page docs/experiments/2026-11-motion.md

Subjects, frames and pixels are those of `motion.py`, less a rim of four pixels and what leaves the fluid. The second
picture of a pair is drawn back along a flow and compared with the first, in the moving detail that the flow is
estimated from. A flow that errs and still leaves less of a difference than the true one cannot be told from it by
comparing pictures.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import cv2
import numpy as np
from motion_steps import measured_frames
from motion_subjects import Subject, Truth, default_shared, prepare, read_truth, subjects
from page_section import replace_section
from report import table

from fluidlift.motion.multiframe import moving_detail
from fluidlift.motion.optical_flow import estimate_flow
from fluidlift.motion.temporal import forward, pixel_indices, sampled

BEGIN, END = "<!-- evidence:begin -->", "<!-- evidence:end -->"
RIM = 9
"""px: the fluid is eroded by a square so wide, for patches at its edge see both sides"""
FAR = 1.0
"""px: error from which a flow is called wrong"""
CLEAR = 1.1
"""ratio of two local differences that counts as one being better"""
PATCH = 3.0
"""px: standard deviation over which differences are gathered, that of a patch of flow"""
LONG = 4
"""pairs of the longer paths: errors of a flow that stays wrong add up along them"""
HEAD = ["clip", "error, px", "not moved", "true flow", "found flow", "wrong", "true fits better", "found fits better"]
HEAD += [f"true, {LONG} pairs", f"found, {LONG} pairs"]


def differences(subject: Subject) -> list[str]:
    """A row of the table: rms differences (log brightness), and how both flows fit where the found one is wrong."""
    truth = read_truth(subject)
    flow = estimate_flow(truth.frames)
    still = np.zeros_like(truth.flow)
    errors, left, fits = [], ([], [], []), {1: [], LONG: []}
    for t in measured_frames(len(flow)):
        for pairs in fits:
            start = min(t, len(flow) - pairs)
            inside, squared = difference(truth, start, pairs, (still, truth.flow, flow.displacement))
            error = np.linalg.norm(flow.displacement[start] - truth.flow[start], axis=-1)
            wrong = inside & (error > FAR)
            fits[pairs].append(np.stack([cv2.GaussianBlur(s, (0, 0), PATCH)[wrong] for s in squared[1:]]))
            if pairs == 1:
                errors.append(error[inside])
                for kept, s in zip(left, squared):
                    kept.append(s[inside])
    error = np.concatenate(errors)
    better = []
    for parts in fits.values():
        of_true, of_found = np.sqrt(np.concatenate(parts, axis=1))
        better += [np.mean(CLEAR * of_true < of_found), np.mean(CLEAR * of_found < of_true)]
    figures = [f"{typical(np.concatenate(x)):.3f}" for x in left]
    return [subject.name, f"{error.mean():.2f}", *figures, *(f"{x:.0%}" for x in (np.mean(error > FAR), *better))]


def difference(
    truth: Truth, start: int, pairs: int, flows: tuple[np.ndarray, ...]
) -> tuple[np.ndarray, list[np.ndarray]]:
    """Pixels whose paths stay in the fluid, and squared differences of the picture `pairs` later along each flow."""
    first, last = moving_detail(truth.frames, start), moving_detail(truth.frames, start + pairs - 1)
    assert first is not None and last is not None, "the clips are long enough"
    inside = cv2.erode((truth.mask[start] & truth.rows[:, None]).astype(np.uint8), np.ones((RIM, RIM))) > 0
    after, out = truth.mask[start + pairs].astype(np.float32), []
    for moved in flows:
        place = pixel_indices(inside.shape)
        for k in range(pairs):
            place = forward(place, np.asarray(moved[start + k], np.float32))
        inside &= sampled(after, place) > 0.5
        columns, rows = cv2.split(place)
        back = cv2.remap(last[1], columns, rows, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
        out.append((back - first[0]) ** 2)
    return inside, out


def typical(squared: np.ndarray) -> float:
    """Root mean square, the largest hundredth clipped: glints."""
    return float(np.sqrt(np.minimum(squared, np.percentile(squared, 99)).mean()))


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--work", type=Path, default=Path("runs"), help="folder for scenes")
    parser.add_argument("--shared", type=Path, default=default_shared(), help="folder with cases and clips")
    parser.add_argument("--page", type=Path, help=f"page with the markers {BEGIN} and {END}")
    given = parser.parse_args()
    cv2.setNumThreads(1)
    rows = []
    for subject in subjects(given.work, given.shared):
        if subject.case is not None:
            prepare(subject)
            rows.append(differences(subject))
            print(*rows[-1], flush=True)
    if given.page:
        replace_section(given.page, "\n".join(table(HEAD, rows)), BEGIN, END)


if __name__ == "__main__":
    main()
