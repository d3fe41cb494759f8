"""Fit a twin: a flow that was rolled out with known parameters, found again from a wrong start.

    python examples/fit_a_twin.py [river|pour|honey [NOISE]]

NOISE is the error of every velocity over the mean speed, such as 0.2.
"""

import sys

import numpy as np

import fluidlift as fl
from fluidlift.synthetic.twins import make_twin

name, noise = (sys.argv[1:] + ["river", "0"][len(sys.argv) - 1 :])[:2]
twin = make_twin(name, seed=0, noise=float(noise))  # frames, their cells, the truth, and a wrong first guess
found = fl.fit_parameters(
    twin.frames, twin.cell_types, None, twin.grid, twin.interval, twin.start,
    kind=twin.kind, mainstream=twin.mainstream, steps_per_frame=twin.steps_per_frame,
)  # fmt: skip

truth, start = twin.truth.to_dict(), twin.start.to_dict()
print(f"{'converged' if found.converged else 'not converged'} in {found.rollouts} rollouts")
for label, e in found.estimates.items():
    field, _, axis = label.rpartition("_")
    vector = axis in ("x", "y", "z") and field in truth
    true, first = ((d[field]["xyz".index(axis)] if vector else d.get(label, np.nan)) for d in (truth, start))
    known = "identifiable" if e.identifiable else "known loosely" if e.fitted else "prior"
    print(f"  {label:22} {first:9.3g} > {e.value:9.3g} ± {e.sigma:.1e}, true {true:9.3g} {e.unit:8} {known}")
