"""Fits the weights of `shape.kind` to clips whose kind is known: `python benchmarks/kinds_fit.py [--write]`.

`benchmarks/kind_features.json` holds the features of real and of made clips, parts of their pictures and of their time,
with the kinds that each shows (`python benchmarks/kinds.py --table FILE`, with `--made` too, measures them anew). The
weights are those of a softmax over the kinds, most probable under both the clips (each counts once, however many parts
of it there are) and a prior: the weights that were set by hand from what each kind is (`BY_HAND`), normal with a
standard deviation of `SPREAD`. A few dozen clips say little of most of the weights, which then stay what they were.

Printed are share right, log loss and calibration error, by hand, fitted, and with each clip predicted by the others.
`--write` writes src/fluidlift/shape/kind_weights.py.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from kinds import Judged, calibration
from scipy.optimize import minimize
from scipy.special import log_softmax

from fluidlift.shape.kind import KINDS, terms

TABLE = Path(__file__).resolve().parent / "kind_features.json"
WEIGHTS = Path(__file__).resolve().parents[1] / "src" / "fluidlift" / "shape" / "kind_weights.py"
SPREAD = 0.35
"""log odds: standard deviation of a weight about that set by hand; see the table that is printed"""
SHARPNESS = 0.85
"""by which the log odds are multiplied in the end (temperature scaling: Guo et al. 2017). Each clip by the others, log
loss summed over whole pictures and two sets of parts of them is 1.90 at 1, 1.88 at 0.8 and least, 1.87, at 0.85"""
SHARPNESSES = (0.6, 0.7, 0.8, 0.85, 0.9, 1.0)
"""that are tried"""
SPREADS = (0.2, 0.35, 0.5, 0.7, 1.0, 1.5)
"""that are tried"""
LEAST = 0.05
"""log odds: smaller weights are left out"""
BY_HAND = {
    # smoke rises from below, is grey, and its outline changes; it neither hangs from above, nor fills the picture,
    # unless all of it goes up and out at the top; a thin plume puffs.
    # It has no surface, and so no edges; and it takes in air, and widens on its way up
    "plume": {"always": -1.35, "rising": 2.34, "grey": 1.67, "grey and rising": 1.08, "changing": 0.72,
              "falling": -1.8, "sideways": -0.9, "hanging, not lifted": -2.25, "filling": -1.8,
              "slender and still": -0.9, "lifted and sharp": -2.7, "drawn across": -0.9, "wider below": -2.7},
    # a jet hangs from above, falls and is slender; what falls a few decimetres is too fast for optical flow, and
    # it may be a small part of what it fills
    "pour": {"falling": 1.44, "followed": -1.8, "slender": 2.16, "hanging": 1.44, "wide": -1.08, "bulky": -2.25,
             "rising": -0.72, "lifted": -1.8, "sideways": -0.72, "slender and still": 0.9, "lifted and sharp": 1.8,
             "lifted and smooth": -1.8, "drawn across": -1.35, "drawn down": 0.9, "vessel filled by a jet": 6.3},
    # a curtain falls, is not slender, and slow enough in the picture to be followed, as it is metres high; what becomes
    # faster on its way down is drawn out along it
    "fall": {"falling": 2.52, "followed": 0.9, "slender": -1.44, "rising": -1.08, "sideways": -1.26,
             "foreground": -0.9, "thrown": -2.7, "vessel": -1.8, "drawn across": -2.7, "drawn down": 0.9},
    # what rises as well as it falls, free of its background, is thrown up: no brink does that
    "fountain": {"always": -1.8, "thrown": 6.3, "drawn across": -1.8},
    # a stream runs across the picture, or along the line of sight and then fills the foreground; not out of a vessel.
    # A surface that lies is foreshortened where it is not seen from above, and so is its pattern
    "stream": {"always": 0.54, "sideways": 1.62, "wide, not falling": 0.72, "wide foreground": 1.8,
               "falling, far": -1.62, "rising, not filling": -1.35, "staying": -1.35, "vessel": -2.7,
               "seen from above": 1.35, "drawn across": 0.9, "drawn down": -0.9},
    # what stays passes nothing on: it goes to and fro, round and round, or has but one side to go to
    "basin": {"always": -3.06, "wide and still": 0.72, "wide foreground": 1.8, "staying": 5.4, "staying inside": 1.35,
              "slender": -2.16, "falling": -1.8, "hanging, not bulky": -1.8, "changing": -1.8,
              "seen from above": 1.35, "contained": 0.9, "drawn across": 0.9, "drawn down": -0.9},
    # a body that stands comes down from where it was and spreads over ground that was dry
    "dam": {"always": -1.8, "collapsing": 6.3},
}  # fmt: skip
"""log odds per term (`shape.kind.terms`)"""


@dataclass(frozen=True)
class Rows:
    """Of the table: n looks at clips."""

    names: np.ndarray
    """[n], of the clips"""
    parts: np.ndarray
    """[n], which part of it: a window of time, a crop"""
    columns: np.ndarray
    """[n,k], terms"""
    shows: np.ndarray
    """bool [n,kinds]"""
    terms: tuple[str, ...]

    @property
    def weight(self) -> np.ndarray:
        """[n], of each look: a clip counts once."""
        _, clip = np.unique(self.names, return_inverse=True)
        return 1.0 / np.bincount(clip)[clip]

    def where(self, pick: np.ndarray) -> Rows:
        """Some of them."""
        return Rows(self.names[pick], self.parts[pick], self.columns[pick], self.shows[pick], self.terms)


def read(table: Path = TABLE) -> Rows:
    """All looks of the table."""
    looks = json.loads(table.read_text(encoding="utf-8"))["looks"]
    weighed = [terms(look["features"], None) for look in looks]
    return Rows(
        np.array([look["clip"] for look in looks]),
        np.array([look["part"] for look in looks]),
        np.array([list(w.values()) for w in weighed]),
        np.array([[kind in look["shows"].split() for kind in KINDS] for look in looks]),
        tuple(weighed[0]),
    )


def by_hand(names: Sequence[str]) -> np.ndarray:
    """[kinds,k], log odds per term."""
    return np.array([[BY_HAND[kind].get(term, 0.0) for term in names] for kind in KINDS])


def fitted(rows: Rows, prior: np.ndarray, spread: float = SPREAD) -> np.ndarray:
    """The most probable weights [kinds,k], where each look may show one or several kinds."""

    def loss(flat: np.ndarray) -> tuple[float, np.ndarray]:
        weights = flat.reshape(prior.shape)
        share = np.exp(log_softmax(rows.columns @ weights.T, axis=1))
        of_truth = np.maximum((share * rows.shows).sum(axis=1), 1e-12)
        off = (weights - prior) / spread**2
        step = share - share * rows.shows / of_truth[:, None]
        value = -float(rows.weight @ np.log(of_truth)) + 0.5 * float(((weights - prior) * off).sum())
        return value, ((rows.weight[:, None] * step).T @ rows.columns + off).ravel()

    found = minimize(loss, prior.ravel(), jac=True, method="L-BFGS-B", options={"maxiter": 1000})
    return found.x.reshape(prior.shape)


def left_out(rows: Rows, prior: np.ndarray, spread: float) -> np.ndarray:
    """Probabilities [n,kinds] of each clip by the others."""
    share = np.zeros(rows.shows.shape)
    for name in np.unique(rows.names):
        here = rows.names == name
        weights = fitted(rows.where(~here), prior, spread)
        share[here] = np.exp(log_softmax(rows.columns[here] @ weights.T, axis=1))
    return share


def figures(rows: Rows, share: np.ndarray) -> str:
    """In words: of the real clips, each part of them apart, and of the made ones."""
    said = []
    for part in np.unique(rows.parts):
        here = rows.parts == part
        judged = [
            Judged(str(name), KINDS[int(p.argmax())], float(p.max()), float(p[shown].sum()), bool(shown[p.argmax()]))
            for name, p, shown in zip(rows.names[here], share[here], rows.shows[here], strict=True)
        ]
        f = calibration(judged)
        said.append(f"{part} ({len(judged)}): " + ", ".join(f"{name} {value:.3f}" for name, value in f.items()))
    return "\n    ".join(said)


def written(weights: np.ndarray, names: Sequence[str]) -> str:
    """The module that holds the weights."""
    lines = ['"""Log odds per term of `shape.kind.terms` for each kind; written by `benchmarks/kinds_fit.py`."""', "",
             "WEIGHTS = {"]  # fmt: skip
    for kind, row in zip(KINDS, weights, strict=True):
        kept = [f'"{name}": {w:.2f}' for name, w in zip(names, row, strict=True) if abs(w) >= LEAST]
        lines += [f'    "{kind}": {{', *(f"        {entry}," for entry in kept), "    },"]
    return "\n".join([*lines, "}", ""])


def main() -> None:
    """Print, and write where asked."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--write", action="store_true", help="write the weights")
    asked = parser.parse_args()
    rows = read()
    prior = by_hand(rows.terms)
    print("by hand\n   ", figures(rows, np.exp(log_softmax(rows.columns @ prior.T, axis=1))))
    for spread in SPREADS:
        print(f"spread {spread}, each clip by the others\n   ", figures(rows, left_out(rows, prior, spread)))
    others = np.log(left_out(rows, prior, SPREAD))
    for sharpness in SHARPNESSES:
        share = np.exp(log_softmax(sharpness * others, axis=1))
        print(f"spread {SPREAD}, each clip by the others, sharpness {sharpness}\n   ", figures(rows, share))
    weights = SHARPNESS * fitted(rows, prior)
    print(
        f"spread {SPREAD}, sharpness {SHARPNESS}, all clips\n   ",
        figures(rows, np.exp(log_softmax(rows.columns @ weights.T, axis=1))),
    )
    if asked.write:
        WEIGHTS.write_text(written(weights, rows.terms), encoding="utf-8")


if __name__ == "__main__":
    main()
