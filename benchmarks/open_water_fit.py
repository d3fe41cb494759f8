"""Fits the weights of `shape.open_water` on pixels of wide water: `python benchmarks/open_water_fit.py`.

`benchmarks/open_water_pixels.npz` holds up to 1500 judged pixels outside the mask that change and motion gave, of the
middle of each clip: the three terms of `open_water.Field`, and whether it is fluid. `python benchmarks/masks.py
--water FILE` makes it anew where the clips are there. Printed are the weights, and the log loss and the share that is
right where each clip is predicted by the others.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from masks_fit import fitted, left_out, log_loss

TABLE = Path(__file__).resolve().parent / "open_water_pixels.npz"
TERMS = ("wander", "colour", "height")


def weights(columns: np.ndarray, fluid: np.ndarray, clip: np.ndarray) -> np.ndarray:
    """Weight of each column [n,k] and the bias; each clip counts alike."""
    spread = columns.std(axis=0)
    found = fitted(columns / spread, fluid, 1.0 / np.bincount(clip)[clip])
    return np.append(found[:-1] / spread, found[-1])


def main() -> None:
    """Print the fit."""
    with np.load(TABLE, allow_pickle=False) as table:
        clip, fluid = table["clip"].astype(int), table["fluid"].astype(float)
        columns = np.stack([table[name].astype(float) for name in TERMS], axis=1)
    found = weights(columns, fluid, clip)
    print(", ".join(f"{name} {value:.2f}" for name, value in zip((*TERMS, "bias"), found, strict=True)))
    for chosen in (slice(0, 1), slice(0, 2), slice(0, 3)):
        odds = left_out(columns[:, chosen], fluid, clip)
        right = [float(((odds > 0.0) == (fluid > 0.5))[clip == c].mean()) for c in np.unique(clip)]
        print(f"{' '.join(TERMS[chosen])}: log loss {log_loss(odds, fluid, clip):.3f}, right {np.mean(right):.3f}, "
              f"of the worst clip {min(right):.3f}")  # fmt: skip


if __name__ == "__main__":
    main()
