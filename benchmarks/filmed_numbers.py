"""How often the intervals of foam, white water and waves hold what was made: docs/experiments/2026-11-whitewater.md.

    python benchmarks/filmed_numbers.py [--seeds 40] [--only foam|law|waves]

Films and surfaces of `tests/made_foam.py` and `tests/made_waves.py`, whose share of foam is known exactly, whose law of
white water is that of a record sixty times as long, and whose waves are those that were put in. A line for each case:
how often the intervals of 90 and of 95 % hold the truth, the mean of the estimates over it, and the middle width.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "tests"))

from made_foam import filmed, foam_film, surface  # noqa: E402
from made_waves import DEEP, MadeWaves, window  # noqa: E402

from fluidlift.look.wave_spectrum import FilmedWaves, waves_in  # noqa: E402
from fluidlift.scene.filmed_numbers import wave_estimates  # noqa: E402
from fluidlift.scene.whitewater_law import LAW, foam_estimate, law_estimates, law_of  # noqa: E402
from fluidlift.types import Estimate  # noqa: E402

LEVELS = (0.9, 0.95)
FOAM = {
    "as the tests": {"share": 0.12, "frames": 60},
    "40 frames": {"share": 0.12, "frames": 40},
    "4 s": {"share": 0.12, "frames": 120},
    "little": {"share": 0.02, "frames": 90},
    "much": {"share": 0.35, "frames": 90},
    "long-lived": {"share": 0.12, "frames": 60, "life": 1.5},
    "large patches": {"share": 0.12, "frames": 60, "radius": 10.0},
    "fast": {"share": 0.12, "frames": 60, "speed": 150.0},
    "slow film": {"share": 0.12, "frames": 40, "interval": 0.1},
}
LAWS = {"memory 4 frames": 4.0, "memory 2 frames": 2.0, "memory 10 frames": 10.0}
WAVES = {
    "on a current": (0.5, 0.05, (0.6, 0.1), 90),
    "low, on water at rest": (0.5, 0.02, (0.0, 0.0), 90),
    "against a current": (0.35, 0.1, (-0.4, 0.3), 90),
    "in 1.2 s": (0.5, 0.05, (0.6, 0.1), 30),
    "short": (0.3, 0.04, (0.3, 0.0), 60),
}


def told(name: str, cases: list[dict[float, Estimate]], truth: float) -> None:
    """One line."""
    ends = {lv: np.array([e[lv].interval or (0.0, np.inf) for e in cases]) for lv in LEVELS}
    held = [np.mean((low <= truth) & (truth <= high)) for low, high in (ends[lv].T for lv in LEVELS)]
    value = np.mean([e[LEVELS[0]].value for e in cases]) / truth
    wide = np.median(np.sqrt(ends[0.95][:, 1] / np.maximum(ends[0.95][:, 0], 1e-12)))
    print(f"{name:44} n {len(cases):3}  90 %: {held[0]:.2f}  95 %: {held[1]:.2f}", end="  ")
    print(f"mean/truth {value:.2f}  x/: {wide:.2f}", flush=True)


def foam(seeds: range) -> None:
    """Of made films."""
    for name, case in FOAM.items():
        films = [filmed(foam_film(seed, **case)) for seed in seeds]
        shown = [f for f in films if f.share > 0]  # less than two thousandths count as none
        told(f"foam, {name}", [{lv: foam_estimate(f, lv) for lv in LEVELS} for f in shown], case["share"])


def laws(seeds: range) -> None:
    """Of made surfaces of a second and made films of two."""
    for name, memory in LAWS.items():
        truth = law_of(surface(999, 1500, memory=memory), 0.12, 0.05).numbers
        found = []
        for seed in seeds:
            film, record = filmed(foam_film(seed, share=0.12, frames=60)), surface(seed, 25, memory=memory)
            found.append({lv: law_estimates(record, film, 0.05, lv) for lv in LEVELS})
        for k, number in enumerate(LAW):
            told(f"{number}, {name}", [{lv: f[lv][number] for lv in LEVELS} for f in found], truth[k])


def seen_waves(seeds: range) -> Iterator[tuple[str, list[FilmedWaves], float]]:
    """Cases, what was found in each, and the slope that was put in."""
    for name, (length, slope, current, frames) in WAVES.items():
        made = [MadeWaves.running(length, slope, current, 0.0, DEEP, seed=seed) for seed in seeds]
        found = [waves_in([window(m, current, frames=frames, seed=s)[0]]) for m, s in zip(made, seeds)]
        yield name, [f for f in found if isinstance(f, FilmedWaves)], slope


def waves(seeds: range) -> None:
    """Of made windows: the error of sampling alone, and with what is not known of water and sky."""
    for name, found, slope in seen_waves(seeds):
        for optics in (False, True):
            each = [{lv: wave_estimates(f, lv, optics=optics) for lv in LEVELS} for f in found]
            end = "" if optics else ", sampling alone"
            length = WAVES[name][0]
            told(f"slope, {name}{end}", [{lv: e[lv]["wave_slope"] for lv in LEVELS} for e in each], slope)
            if not optics:
                # the mean wavenumber of lengths that vary by 12 %
                told(f"length, {name}", [{lv: e[lv]["wave_length"] for lv in LEVELS} for e in each],
                     length / float(np.exp(0.5 * 0.12**2)))  # fmt: skip
                # e^(k's variance): <1/k^2> of the same lengths, for slopes that are alike
                told(f"amplitude, {name}", [{lv: e[lv]["wave_amplitude"] for lv in LEVELS} for e in each],
                     np.sqrt(2.0) * slope * length / (2.0 * np.pi) * float(np.exp(0.12**2)))  # fmt: skip


def main() -> int:
    """See the module."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=40)
    parser.add_argument("--only", choices=("foam", "law", "waves"))
    given = parser.parse_args()
    for name, part in (("foam", foam), ("law", laws), ("waves", waves)):
        if given.only in (None, name):
            part(range(1000, 1000 + given.seeds))
    return 0


if __name__ == "__main__":
    sys.exit(main())
