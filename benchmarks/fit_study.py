"""Studies of the fit on flows whose truth is known: the paper's table, its comparison, ablation, optimisers.

    python benchmarks/fit_study.py --seeds 3 --figure fit_comparison.png --json fit_study.json
    python benchmarks/fit_study.py --parts comparison --scenes river

All on twins (`fluidlift.synthetic.twins`) whose given velocities have 20 % of noise on every face and a third of the
cells unseen; the fit sees the first ten frames. Velocities are compared with the exact ones over all fluid cells:
relative L2 is the size of the difference over that of the truth, the cosine the mean over the cells that move.

table: parameters, mean speed and pressure before (first guess) and after the fit, beside the truth (paper, table 1).
comparison: the video's estimate, random parameters, a fit with L2 only, a fit with the full loss (paper, comparison of
  four velocity fields), over frames that the fit never saw. Simulations start from the video's first frame.
ablation: the fit without one of its parts.
optimisers: Levenberg-Marquardt and Adam, what they reach with how many rollouts.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import torch
from fit_twins import CONDITIONS, SCENES, fit_twin, per_cent, recoveries, table, tell, true_value, twin_of

from fluidlift.fit.loss import VelocityLossWeights
from fluidlift.physics.rollout import RolloutParameters, rollout
from fluidlift.synthetic.twins import PLANS, Twin
from fluidlift.types import CellType, FaceVelocity, FitResult, FluidParameters

NOISY = CONDITIONS[1]
SEEN, HORIZON = 10, 6
"""frames that the fit sees, and that follow"""
L2_ONLY = VelocityLossWeights(direction=0.0)
VARIANTS: dict[str, dict[str, Any]] = {
    "full loss": {},
    "without direction": {"weights": L2_ONLY},
    "without magnitude": {"weights": VelocityLossWeights(direction=1.0, magnitude=0.0)},
    "all cells weigh the same": {"weights": VelocityLossWeights(occupied=1.0)},
    "surface cells only": {"weights": VelocityLossWeights(occupied=0.0)},
    "one window": {"windows": 1},
    "windows of one frame": {"frames_per_window": 1},
    "last frame of windows only": {"compare": "last"},
    "starts as the video has them": {"start_rounds": 0},
}
RANDOM_DRAWS = 5
BUDGETS = (25, 50, 100, 200, 400)
"""rollouts; one of Adam's has a backward pass as well"""
DETERMINED = ("kinematic_viscosity", "gravity", "inflow_velocity", "outflow_velocity", "wall_damping")


@dataclass(frozen=True)
class Misfit:
    """How far velocities are from the exact ones."""

    relative: float
    """L2"""
    cosine: float


def misfit(found: Sequence[FaceVelocity], exact: Sequence[FaceVelocity], cell_types: np.ndarray) -> Misfit:
    """Over all frames and fluid cells; the cosine where the truth moves by a tenth of its mean speed or more."""
    fluid = cell_types == CellType.FLUID
    a = np.concatenate([f.at_centers()[fluid] for f in found]).astype(float)
    b = np.concatenate([f.at_centers()[fluid] for f in exact]).astype(float)
    sizes = np.linalg.norm(a, axis=-1), np.linalg.norm(b, axis=-1)
    moving = sizes[1] > 0.1 * sizes[1].mean()
    cosines = (a * b).sum(-1)[moving] / np.maximum(sizes[0] * sizes[1], 1e-12)[moving]
    relative = np.sqrt(np.square(a - b).sum() / np.square(b).sum())
    return Misfit(float(relative), float(cosines.mean()))


def study_twin(scene: str, seed: int) -> tuple[Twin, Twin]:
    """What the fit sees, and the whole with the frames to come."""
    whole = twin_of(scene, seed, NOISY, frames=SEEN + HORIZON)
    seen = None if whole.observed is None else whole.observed[:SEEN]
    return replace(whole, frames=whole.frames[:SEEN], exact=whole.exact[:SEEN], observed=seen), whole


def simulated(whole: Twin, parameters: FluidParameters, *, exact_start: bool = False) -> tuple[FaceVelocity, ...]:
    """All frames but the first, from the given first frame (or the exact one)."""
    start = (whole.exact if exact_start else whole.frames)[0]
    return whole.continued(parameters, start, len(whole.exact) - 1)


def ahead(frames: Sequence[FaceVelocity], whole: Twin) -> Misfit:
    """Misfit of frames 1, 2, ... over the horizon alone."""
    return misfit(frames[SEEN - 1 :], whole.exact[SEEN:], whole.cell_types)


def random_parameters(twin: Twin, rng: np.random.Generator) -> FluidParameters:
    """Plausible scales, arbitrary values: half to twice, viscosity over two decades, gravity turned by 15 degrees."""
    guess = twin.start

    def around(value: float, decades: float) -> float:
        return value * 10 ** rng.uniform(-decades, decades)

    turn = rng.standard_normal(3)
    down = np.asarray(guess.gravity)
    aside = np.cross(turn / np.linalg.norm(turn), [0, 0, 1])
    gravity = down + np.tan(np.radians(15)) * np.linalg.norm(down) * aside
    pace = around(1.0, 0.3)
    return replace(
        guess,
        kinematic_viscosity=around(guess.kinematic_viscosity, 1.0),
        gravity=tuple(gravity),
        inflow_velocity=tuple(pace * v for v in guess.inflow_velocity),
        outflow_velocity=around(guess.outflow_velocity, 0.3),
        wall_damping=float(rng.uniform(0, 1)),
        restitution=float(rng.uniform(0, 0.5)),
    )


def state_of(twin: Twin, parameters: FluidParameters) -> tuple[float, float]:
    """Mean speed (m/s) and mean size of the pressure (Pa) in the fluid after the seen frames, from the exact start."""
    step = twin.interval / twin.steps_per_frame
    known = RolloutParameters.of(replace(parameters, time_step=step))
    last = twin.continued(parameters, twin.exact[0], SEEN - 1)[-1]
    result = rollout(last, twin.domain(), known, steps=1, patterns=_pattern(twin))
    fluid = twin.cell_types == CellType.FLUID
    speed = np.linalg.norm(last.at_centers()[fluid], axis=-1).mean()
    return float(speed), float(np.abs(result.pressure(known)[fluid]).mean())


def _pattern(twin: Twin) -> Any:
    return None if twin.pattern is None else torch.from_numpy(twin.pattern)


def before_and_after(scenes: Sequence[str], seeds: int) -> tuple[list[str], list[dict[str, Any]]]:
    """Table 1 of the paper: seed 0 in full, misfits over all seeds."""
    lines, log = ["## Before and after the fit", ""], []
    totals = []
    for scene in scenes:
        found_misfits = []
        for seed in range(seeds):
            seen, whole = study_twin(scene, seed)
            found = fit_twin(seen)
            sets = {"before": seen.start, "after": found.parameters, "truth": seen.truth}
            ends = {k: simulated(whole, p, exact_start=True) for k, p in sets.items()}
            found_misfits.append({k: misfit(f, whole.exact[1:], whole.cell_types) for k, f in ends.items()})
            before, after = (found_misfits[-1][k].relative for k in ("before", "after"))
            tell(f"table: {scene} {seed}: {before:.3f} -> {after:.3f}")
            if seed == 0:
                lines += [f"### {scene}", "", *_parameter_table(whole, found, sets)]
            log.append({"scene": scene, "seed": seed, **{k: vars(m) for k, m in found_misfits[-1].items()}})
            if seed == 0:
                log[-1]["parameters"] = parameter_values(whole, found, sets)
        for label in ("before", "after"):
            some = [m[label] for m in found_misfits]
            totals.append([
                scene, label, f"{np.median([m.relative for m in some]):.3f}", f"{max(m.relative for m in some):.3f}",
                f"{np.median([m.cosine for m in some]):.4f}",
            ])  # fmt: skip
    lines += ["### Simulated velocity against the exact one, from the exact first frame", ""]
    head = ["scene", "", "relative L2, median", "worst seed", "cosine, median"]
    return lines + table(head, totals), log


def parameter_values(whole: Twin, found: FitResult, sets: dict[str, FluidParameters]) -> dict[str, dict[str, float]]:
    """Value of each parameter, mean speed and mean pressure, by name and by set."""
    out = {
        f"{label} [{e.unit}]" if e.unit else label: {k: float(true_value(p, label)) for k, p in sets.items()}
        for label, e in found.estimates.items()
    }
    states = {k: state_of(whole, p) for k, p in sets.items()}
    means = ("mean speed [m/s]", "mean pressure [Pa]")
    return out | {name: {k: s[i] for k, s in states.items()} for i, name in enumerate(means)}


def _parameter_table(whole: Twin, found: FitResult, sets: dict[str, FluidParameters]) -> list[str]:
    body = []
    for label, e in found.estimates.items():
        numbers = [f"{true_value(p, label):.4g}" for p in sets.values()]
        known = "" if e.identifiable else "prior" if e.value == e.prior else "loosely"
        body.append([f"{label} [{e.unit}]" if e.unit else label, *numbers, f"{e.sigma:.2g}", known])
    states = [state_of(whole, p) for p in sets.values()]
    body.append(["mean speed [m/s]", *(f"{s[0]:.4g}" for s in states), "", ""])
    body.append(["mean pressure [Pa]", *(f"{s[1]:.4g}" for s in states), "", ""])
    return table(["", *sets, "sigma", ""], body)


def compare(scenes: Sequence[str], seeds: int, figure: Path | None) -> tuple[list[str], list[dict[str, Any]]]:
    """The four velocity fields of the paper, over frames that the fit did not see."""
    log, panels = [], {}
    for scene in scenes:
        for seed in range(seeds):
            seen, whole = study_twin(scene, seed)
            rng = np.random.default_rng([seed, 9])
            fields = {"video estimate": whole.frames[1:]}
            draws = [simulated(whole, random_parameters(seen, rng)) for _ in range(RANDOM_DRAWS)]
            order = sorted(range(RANDOM_DRAWS), key=lambda i: ahead(draws[i], whole).relative)
            fields["random parameters"] = draws[order[RANDOM_DRAWS // 2]]
            fields["fit, L2 only"] = simulated(whole, fit_twin(seen, weights=L2_ONLY).parameters)
            fields["fit, full loss"] = simulated(whole, fit_twin(seen).parameters)
            fields["true parameters"] = simulated(whole, seen.truth)
            for name, frames in fields.items():
                log.append({"scene": scene, "seed": seed, "field": name, **vars(ahead(frames, whole))})
            said = ", ".join(f"{name} {ahead(frames, whole).relative:.3f}" for name, frames in fields.items())
            tell(f"comparison: {scene} {seed}: {said}")
            if seed == 0:
                panels[scene] = (whole, {"exact": whole.exact[1:]} | fields)
    lines = ["## Four velocity fields, over frames that the fit did not see", ""]
    names = list(dict.fromkeys(r["field"] for r in log))
    body = []
    for scene in scenes:
        for name in names:
            some = [r for r in log if r["scene"] == scene and r["field"] == name]
            relative, cosine = [r["relative"] for r in some], [r["cosine"] for r in some]
            body.append([scene, name, f"{np.median(relative):.3f}", f"{max(relative):.3f}", f"{np.median(cosine):.4f}"])
    lines += table(["scene", "velocity", "relative L2, median", "worst seed", "cosine, median"], body)
    if figure is not None:
        draw_fields(panels, figure)
        lines += [f"![{figure.stem}]({figure.name})", ""]
    return lines, log


def draw_fields(panels: dict[str, tuple[Twin, dict[str, Sequence[FaceVelocity]]]], path: Path) -> None:
    """One row per scene: a slice through the last frame of each field, speed as colour and arrows in the slice."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    columns = max(len(fields) for _, fields in panels.values())
    shapes = [twin.grid.shape for twin, _ in panels.values()]
    heights = [min(s[2] / s[0], 1.1) for s in shapes]
    figure, axes = pyplot.subplots(
        len(panels), columns, squeeze=False, figsize=(2.6 * columns, 2.6 * sum(heights) + 0.5 * len(panels)),
        gridspec_kw={"height_ratios": heights}, layout="constrained",
    )  # fmt: skip
    for row, (scene, (twin, fields)) in zip(axes, panels.items(), strict=True):
        wet = twin.cell_types == CellType.FLUID
        across = int(np.argmax(wet.sum(axis=(0, 2))))
        inside = wet[:, across]
        top = float(np.percentile(np.linalg.norm(fields["exact"][-1].at_centers()[wet], axis=-1), 96))
        for axis, (name, frames) in zip(row, fields.items(), strict=True):
            v = frames[-1].at_centers()[:, across]
            # light grey: cells that the video does not show
            unseen = np.zeros_like(inside)
            if name == "video estimate" and twin.observed is not None:
                unseen = inside & ~twin.observed[-1][:, across]
            speed = np.where(inside & ~unseen, np.linalg.norm(v, axis=-1), np.nan)
            axis.set_facecolor("white")
            axis.imshow(np.where(unseen, 0.8, np.nan).T, origin="lower", cmap="gray", vmin=0, vmax=1)
            axis.imshow(np.where(twin.cell_types[:, across] == CellType.SOLID, 0.35, np.nan).T, origin="lower",
                        cmap="gray", vmin=0, vmax=1)  # fmt: skip
            axis.imshow(speed.T, origin="lower", cmap="viridis", vmin=0, vmax=top)
            x, z = np.nonzero(inside & ~unseen)
            axis.quiver(x, z, v[x, z, 0], v[x, z, 2], color="white", angles="xy", scale_units="xy", scale=top / 1.6,
                        width=0.006, headwidth=4)  # fmt: skip
            error = misfit(frames[-1:], fields["exact"][-1:], twin.cell_types).relative
            axis.set_title(name if name == "exact" else f"{name}\nerror {per_cent(error)}", fontsize=8)
            axis.set(xticks=[], yticks=[])
        row[0].set_ylabel(scene, fontsize=9)
        figure.colorbar(row[0].images[-1], ax=list(row), shrink=0.9, pad=0.01, label="m/s")
    figure.savefig(path, dpi=130)
    pyplot.close(figure)


def optimisers(scenes: Sequence[str], seeds: int) -> tuple[list[str], list[dict[str, Any]]]:
    """What both methods reach with a budget; exact velocities, one window, and only what the data determine is free."""
    log = []
    for scene, seed in product(scenes, range(min(seeds, 1))):
        twin = twin_of(scene, seed, CONDITIONS[0])
        for method, budget in product(("lm", "adam"), BUDGETS):
            began = time.perf_counter()
            found = fit_twin(twin, method=method, max_rollouts=budget, windows=1, free=DETERMINED)
            seconds = time.perf_counter() - began
            rows = [r for r in recoveries(twin, found, seed, CONDITIONS[0]) if r.identifiable]
            log.append({
                "scene": scene, "seed": seed, "method": method, "budget": budget, "rollouts": found.rollouts,
                "loss": found.extra["loss"], "before": found.extra["loss_at_prior"], "seconds": seconds,
                "error": float(np.median([r.error for r in rows])) if rows else None,
                "history": [float(x) for x in found.loss_history], "converged": found.converged,
            })  # fmt: skip
            tell(f"optimisers: {scene} {seed} {method} {budget}: loss {found.extra['loss']:.3g}")
    body = []
    for r in log:
        numbers = [f"{r['before']:.3g}", f"{r['loss']:.3g}", "" if r["error"] is None else per_cent(r["error"])]
        done = "yes" if r["converged"] else "no"
        twin = f"{r['scene']} {r['seed']}"
        body.append([twin, r["method"], str(r["budget"]), str(r["rollouts"]), *numbers, f"{r['seconds']:.1f}", done])
    head = ["twin", "method", "budget", "rollouts", "loss before", "loss", "median error", "s", "converged"]
    return ["## Optimisers", "", *table(head, body)], log


def ablate(scenes: Sequence[str], seeds: int) -> tuple[list[str], list[dict[str, Any]]]:
    """The fit without one of its parts, each on the same twins."""
    log = []
    for scene in scenes:
        for seed in range(seeds):
            seen, whole = study_twin(scene, seed)
            known: set[str] | None = None
            for name, options in VARIANTS.items():
                found = fit_twin(seen, **options)
                rows = recoveries(seen, found, seed, NOISY)
                # the same numbers for all: those that the full fit identifies
                known = {r.label for r in rows if r.identifiable} if known is None else known
                mine = [r for r in rows if r.label in known]
                log.append({
                    "scene": scene, "seed": seed, "variant": name, "error": float(np.median([r.error for r in mine])),
                    "worst": max(r.error for r in mine), "inside": float(np.mean([r.inside for r in mine])),
                    "identifiable": sum(r.identifiable for r in rows),
                    **vars(ahead(simulated(whole, found.parameters), whole)),
                })  # fmt: skip
                tell(f"ablation: {scene} {seed}: {name}: {log[-1]['error']:.3f}, velocity {log[-1]['relative']:.3f}")
    body = []
    for scene in [*scenes, "all"]:
        for name in VARIANTS:
            some = [r for r in log if r["variant"] == name and scene in (r["scene"], "all")]
            body.append([
                scene, name, f"{np.mean([r['identifiable'] for r in some]):.1f}",
                per_cent(float(np.median([r["error"] for r in some]))),
                per_cent(float(np.median([r["worst"] for r in some]))), f"{np.mean([r['inside'] for r in some]):.2f}",
                f"{np.mean([r['relative'] for r in some]):.4f}", f"{np.mean([r['cosine'] for r in some]):.4f}",
            ])  # fmt: skip
    head = ["scene", "fit", "identifiable", "median error", "worst error", "inside 95 %", "relative L2 ahead", "cosine"]
    lines = ["## Ablation", "", "Errors of the numbers that the full fit identifies; medians and means over seeds.", ""]
    return lines + table(head, body), log


def main() -> None:
    """See the module."""
    parts = {"table": before_and_after, "comparison": compare, "ablation": ablate, "optimisers": optimisers}
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", nargs="+", default=SCENES, choices=sorted(PLANS))
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--parts", nargs="+", default=list(parts), choices=list(parts))
    parser.add_argument("--figure", type=Path, help="PNG of the four fields")
    parser.add_argument("--json", type=Path)
    chosen = parser.parse_args()
    lines, log = [], {}
    for name in chosen.parts:
        if name == "comparison":
            text, log[name] = compare(chosen.scenes, chosen.seeds, chosen.figure)
        else:
            text, log[name] = parts[name](chosen.scenes, chosen.seeds)
        lines += text
    print("\n".join(lines))
    if chosen.json is not None:
        chosen.json.write_text(json.dumps(log, indent=1))


if __name__ == "__main__":
    sys.exit(main())
