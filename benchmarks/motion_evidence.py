"""What the pictures themselves say about flow: does the true motion explain them better than the one that was found?

    python benchmarks/motion_evidence.py --work runs --page docs/results.md

Subjects, frames and pixels are those of `motion.py` (the fluid less a rim of four pixels). The second picture of a pair
is drawn back along a flow and compared with the first, in the moving detail that the flow is estimated from. A flow
that errs and still leaves less of a difference than the true one cannot be told from it by comparing pictures.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import cv2
import numpy as np
from motion_page import replace_section
from motion_steps import measured_frames
from motion_subjects import Subject, default_shared, prepare, read_truth, subjects
from results import table

from fluidlift.motion.multiframe import moving_detail
from fluidlift.motion.optical_flow import estimate_flow
from fluidlift.motion.temporal import pixel_indices

BEGIN, END = "<!-- evidence:begin -->", "<!-- evidence:end -->"
RIM = 9
"""px: the fluid is eroded by a square so wide, for patches at its edge see both sides"""
FAR = 1.0
"""px: error from which a flow is called wrong"""
CLEAR = 1.1
"""ratio of two local differences that counts as one being better"""
PATCH = 3.0
"""px: standard deviation over which differences are gathered, that of a patch of flow"""
HEAD = ["clip", "error, px", "not moved", "true flow", "found flow", "wrong", "true fits better", "found fits better"]


def differences(subject: Subject) -> list[str]:
    """A row of the table: rms differences (log brightness), and how both flows fit where the found one is wrong."""
    truth = read_truth(subject)
    flow = estimate_flow(truth.frames)
    errors, still, true, found, fits = [], [], [], [], []
    for t in measured_frames(len(flow)):
        detail = moving_detail(truth.frames, t)
        assert detail is not None, "the clips are long enough"
        first, second = detail
        inside = cv2.erode((truth.mask[t] & truth.rows[:, None]).astype(np.uint8), np.ones((RIM, RIM))) > 0
        left = []
        for moved in (np.zeros_like(truth.flow[t]), truth.flow[t], flow.displacement[t]):
            place = pixel_indices(first.shape) + moved.astype(np.float32)
            back = cv2.remap(second, *cv2.split(place), cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
            left.append((back - first) ** 2)
        error = np.linalg.norm(flow.displacement[t] - truth.flow[t], axis=-1)
        errors.append(error[inside])
        for kept, squared in zip((still, true, found), left):
            kept.append(squared[inside])
        local = [cv2.GaussianBlur(squared, (0, 0), PATCH)[inside & (error > FAR)] for squared in left[1:]]
        fits.append(np.stack(local))
    of_true, of_found = np.sqrt(np.concatenate(fits, axis=1))
    error = np.concatenate(errors)
    return [
        subject.name,
        f"{error.mean():.2f}",
        *(f"{typical(np.concatenate(x)):.3f}" for x in (still, true, found)),
        f"{np.mean(error > FAR):.0%}",
        f"{np.mean(CLEAR * of_true < of_found):.0%}",
        f"{np.mean(CLEAR * of_found < of_true):.0%}",
    ]


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
