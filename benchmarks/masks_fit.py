"""Fits what the masks take from data, on pixels of made and of real clips: `python benchmarks/masks_fit.py`.

`benchmarks/mask_pixels.npz` holds up to 1500 judged pixels of the middle of each clip: the score of change and motion,
how far change is explained by motion that does not go on (`carried`), whether a moving solid was found there, whether
it lies inside the outline that was found, and whether it is fluid. `python benchmarks/masks.py --pixels` makes it anew
where the clips are there. Printed are the log odds per unit of `carried` above some thresholds, and the weights of
`shape.segment.sureness` with a table of how often it is right, each clip predicted without itself.

And how likely a mask is right, `shape.fluid_found.CHANCE`: of each real clip in `benchmarks/results/masks.json`,
whether its mask overlaps what a person drew by `RIGHT`, by the overlap that its own confidence expects.
"""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
from scipy.optimize import minimize

TABLE = Path(__file__).resolve().parent / "mask_pixels.npz"
RESULTS = Path(__file__).resolve().parent / "results" / "masks.json"
RIGHT = 0.7
"""intersection over union with what a person drew, of a mask that is right"""
THRESHOLDS = (0.2, 0.25, 0.3, 0.35, 0.4, 0.45)
LOUDEST = 8.0
"""log odds: as in `shape.segment`"""
IN_QUESTION = -4.0
"""log odds from which a pixel could be fluid by its change"""


def fitted(columns: np.ndarray, fluid: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """Weights [k] and bias of a logistic regression on columns [n,k]."""

    def loss(b: np.ndarray) -> tuple[float, np.ndarray]:
        odds = columns @ b[:-1] + b[-1]
        step = weight * (1.0 / (1.0 + np.exp(-odds)) - fluid)
        return float((weight * (np.logaddexp(0.0, odds) - fluid * odds)).sum()), np.append(columns.T @ step, step.sum())

    return minimize(loss, np.zeros(columns.shape[1] + 1), jac=True, method="L-BFGS-B").x


def left_out(columns: np.ndarray, fluid: np.ndarray, clip: np.ndarray) -> np.ndarray:
    """Log odds [n] of every pixel by the other clips; each clip counts alike."""
    weight = 1.0 / np.bincount(clip)[clip] / len(np.unique(clip))
    odds = np.zeros(len(fluid))
    for c in np.unique(clip):
        b = fitted(columns[clip != c], fluid[clip != c], weight[clip != c])
        odds[clip == c] = columns[clip == c] @ b[:-1] + b[-1]
    return odds


def log_loss(odds: np.ndarray, fluid: np.ndarray, clip: np.ndarray) -> float:
    """Mean over clips."""
    each = np.logaddexp(0.0, odds) - fluid * odds
    return float(np.mean([each[clip == c].mean() for c in np.unique(clip)]))


def whole_masks() -> None:
    """Print how likely a mask is right."""
    found: dict[str, dict[str, float]] = {}
    for record in json.loads(RESULTS.read_text(encoding="utf-8"))["records"]:
        found.setdefault(record["subject"], {})[record["figure"]] = record["value"]
    both = [v for name, v in found.items() if name.startswith("clip ") and {"IoU", "likely IoU"} <= set(v)]
    likely, right = np.array([[v["likely IoU"]] for v in both]), np.array([v["IoU"] >= RIGHT for v in both], float)
    b, each, without = fitted(likely, right, np.ones(len(right))), np.arange(len(right)), np.zeros((len(right), 0))
    odds = left_out(likely, right, each)
    told, base = (log_loss(o, right, each) for o in (odds, left_out(without, right, each)))
    print(f"masks: {len(right)} clips, {right.mean():.2f} right, log odds {b[0]:.2f} per unit, {b[1]:.2f}", end="")
    print(f"; log loss, each clip left out, {told:.3f}, {base:.3f} without")
    for low, high in ((-np.inf, 0.0), (0.0, np.log(4.0)), (np.log(4.0), np.inf)):
        here = (odds >= low) & (odds < high)
        mean = (1.0 / (1.0 + np.exp(-odds[here]))).mean()
        print(f"  {int(here.sum())} clips: chance {mean:.2f}, right {right[here].mean():.2f}")


def main() -> None:
    """Print all fits."""
    whole_masks()
    with np.load(TABLE, allow_pickle=False) as table:
        names, clip = table["names"], table["clip"].astype(int)
        score, carried = table["score"].astype(float), table["carried"].astype(float)
        solid, inside, fluid = table["solid"], table["inside"], table["fluid"].astype(float)
    real = np.array([str(n).startswith("clip ") for n in names])[clip]
    pick = real & (score > IN_QUESTION)
    clips, truth = clip[pick], fluid[pick]
    print(f"{len(np.unique(clips))} real clips, log loss of the score alone, each clip left out: ", end="")
    print(f"{log_loss(left_out(np.clip(score[pick], -LOUDEST, LOUDEST)[:, None], truth, clips), truth, clips):.3f}")
    for threshold in THRESHOLDS:
        columns = np.stack([np.clip(score, -LOUDEST, LOUDEST), np.maximum(carried - threshold, 0.0)], axis=1)[pick]
        b = fitted(columns, truth, 1.0 / np.bincount(clips)[clips])
        loss = log_loss(left_out(columns, truth, clips), truth, clips)
        print(f"  carried above {threshold:.2f}: {-b[1] / b[0]:5.1f} per unit of the score's, log loss {loss:.3f}")
    from fluidlift.shape.evidence import CARRIED, PER_CARRIED

    whole = np.clip(np.where(solid, -12.0, score - PER_CARRIED * np.maximum(carried - CARRIED, 0.0)), -LOUDEST, LOUDEST)
    columns = np.stack([2.0 * inside - 1.0, whole], axis=1)[real]
    clips, truth = clip[real], fluid[real]
    b = fitted(columns, truth, 1.0 / np.bincount(clips)[clips])
    print(f"sureness: outline {b[0]:.2f}, score {b[1]:.2f}, bias {b[2]:.2f}")
    odds = left_out(columns, truth, clips)
    right_odds = np.where(columns[:, 0] > 0.0, odds, -odds)
    chance = np.maximum(1.0 / (1.0 + np.exp(-right_odds)), 0.5)
    right = (columns[:, 0] > 0.0) == (truth > 0.5)
    weight = 1.0 / np.bincount(clips)[clips] / len(np.unique(clips))
    off, place = 0.0, np.clip(((chance - 0.5) * 20.0).astype(int), 0, 9)
    for k in range(10):
        here, share = place == k, weight[place == k].sum()
        if share > 0.0:
            mean, part = (weight * chance)[here].sum() / share, (weight * right)[here].sum() / share
            off += share * abs(mean - part)
            print(f"  {100 * share:4.1f} % of the pixels: chance {mean:.2f}, right {part:.2f}")
    print(f"  calibration error {off:.3f}")


if __name__ == "__main__":
    main()
