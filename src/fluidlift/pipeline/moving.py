"""The stage that fits the physics: what the parameters are, and what was known of them before."""

from __future__ import annotations

from dataclasses import asdict, replace
from typing import Any

import numpy as np

from fluidlift.config import JobConfig
from fluidlift.errors import InputRejected
from fluidlift.pipeline.body import camera_of, setting_of
from fluidlift.pipeline.fit_outcome import (
    AT_THE_ENDS,
    Verdict,
    as_given,
    family,
    first_guess_as_result,
    labelled,
    size_estimate,
    size_row,
    table,
    verdict,
)
from fluidlift.pipeline.fit_request import FitRequest, request_of, startable
from fluidlift.pipeline.lifting import targets_of
from fluidlift.pipeline.reading import clip_of
from fluidlift.pipeline.rising import outline_rises, with_buoyancy
from fluidlift.pipeline.seeing import masks_of
from fluidlift.pipeline.story import Result, Story, one_torch_thread
from fluidlift.types import (
    CellType,
    Estimate,
    FaceVelocity,
    FitResult,
    FluidKind,
    FluidParameters,
    kind_of,
)

AT_WALLS = ("restitution", "wall_damping")
"""not fitted unless asked for: how the velocity falls off towards a wall under water was not seen but assumed
(`motion.bed`), and a steady flow whose slope the geometry lacks is best explained by walls without friction"""


def fit(story: Story, config: JobConfig) -> Result:
    """Physical parameters that make the grid move like the targets; the first guess where the fit fails."""
    from fluidlift.fit.optimize import DEFAULT_FREE
    from fluidlift.fit.ranges import UNITS

    setting, kind = setting_of(story), kind_of(story["geometry"].meta["kind"])
    request, along = request_of(config.fit), setting.terrain.mainstream
    _check_request(request, kind)
    targets = targets_of(story)
    initial = request.applied(first_guess(story, targets), along=along)
    # speeds that come from free fall were not measured: they say nothing about friction inside or at the walls
    assumed = story["motion"].meta["free_fall_share"] > 0.3
    usual = AT_THE_ENDS if assumed else tuple(name for name in DEFAULT_FREE if name not in AT_WALLS)
    if filling_rate(story) is not None:  # the level in the vessel says how much enters
        usual = tuple(name for name in usual if name != "inflow_velocity")
    free = request.free_of(usual)
    moved = _told_by_velocities(story, free)
    found, judged = _attempt(story, config, targets, startable(initial, request.held), moved)
    parameters, estimates = found.parameters, dict(found.estimates)
    if not judged.usable:
        # the buoyancy of smoke was guessed from its speed by the fit
        parameters = replace(initial, gravity=parameters.gravity) if kind.is_gas else initial
        estimates = first_guess_as_result(parameters, UNITS)
    known = {name: getattr(initial, name) for name in request.held}
    parameters = replace(parameters, **known)
    if "wall_damping" not in (*free, *known):
        d = sticking(kind, story["motion"].meta["reports"])
        parameters = replace(parameters, wall_damping=d)
        if "wall_damping" in estimates:
            estimates["wall_damping"] = replace(estimates["wall_damping"], value=d, prior=d)
    estimates = {n: as_given(n, e, initial) if family(n) in known else e for n, e in estimates.items()}
    parameters, estimates, lift = (
        (parameters, estimates, {}) if moved == free else with_buoyancy(story, parameters, estimates, targets[0])
    )
    rows = table(estimates, held=set(known), free=set(free), measured=set(AT_THE_ENDS))
    size = size_row(story["geometry"].meta["scale"])
    if size is not None:
        rows, estimates = [*rows, size], estimates | {"size": size_estimate(size)}
    notes = list(found.notes)
    if assumed and not request.free:
        notes.append(
            "viscosity, restitution and wall damping keep their priors: the steep part was too fast to be measured"
        )
    return Result(
        {"loss_history": np.asarray(found.loss_history, np.float64)},
        {
            "warnings": judged.warnings(),
            "parameters": parameters.to_dict(),
            "estimates": {r["name"]: asdict(labelled(estimates[r["name"]], r)) for r in rows},
            "table": rows,
            "initial": initial.to_dict(),
            "converged": found.converged,
            "status": judged.status,
            "reason": judged.reason,
            "rollouts": found.rollouts,
            "notes": notes,
            "extra": {k: float(v) for k, v in (found.extra | lift).items()},
        },
    )


def _check_request(request: FitRequest, kind: FluidKind) -> None:
    """Raises InputRejected where a kind of fluid has no such parameter, or its clip cannot tell it."""
    if kind.is_gas and "gravity" in request.held:
        raise InputRejected(
            f"a known gravity for a {kind}, whose gravity stands for its buoyancy", "another parameter",
            "give gravity in scene.yaml, for the simulation",
        )  # fmt: skip
    if kind.starts_at_rest and request.free:
        raise InputRejected(
            f"a fit of {', '.join(request.free)} to a {kind}, whose velocities are known as it stands, before it moves",
            "values that you know", "leave out fit.free and give them with --hold or in scene.yaml",
        )  # fmt: skip


def _told_by_velocities(story: Story, free: tuple[str, ...]) -> tuple[str, ...]:
    """What is fitted to velocities: all but the lift of smoke whose outline rises, which says more of it than they."""
    if not kind_of(story["geometry"].meta["kind"]).is_gas or set(free) <= {"gravity"} or not outline_rises(story):
        return free
    return tuple(name for name in free if name != "gravity")


def _attempt(
    story: Story, config: JobConfig, targets: list[FaceVelocity], initial: FluidParameters, free: tuple[str, ...]
) -> tuple[FitResult, Verdict]:
    """One fit, judged; equations without a solution are a failure like others."""
    from fluidlift.fit.optimize import fit_parameters

    setting = setting_of(story)
    if kind_of(story["geometry"].meta["kind"]).starts_at_rest:
        reason = "a body at rest tells nothing of its parameters: they are those of such a fluid, or as given"
        return FitResult(initial, {}, np.zeros(0), False, 0), Verdict("left", reason)
    try:
        with one_torch_thread():
            found = fit_parameters(
                targets, setting.cell_types, setting.terrain, setting.terrain.grid, clip_of(story).interval, initial,
                kind=story["geometry"].meta["kind"], mainstream=setting.terrain.mainstream, method=config.fit.method,
                free=free, prior_sigmas=prior_widths(story), restarts=config.fit.restarts + 1,
                max_work=config.fit.max_work, max_seconds=config.fit.max_seconds, device=config.fit.device,
                progress=story.step,
            )  # fmt: skip
    except (np.linalg.LinAlgError, FloatingPointError) as error:
        return FitResult(initial, {}, np.zeros(0), False, 0), Verdict("failed", f"no solution ({error})")
    return found, verdict(found)


def prior_widths(story: Story) -> dict[str, float]:
    """Relative widths of what is known before the fit looks: the time step to 1 %, gravity to 2 % of 9.81 m/s^2.

    The time between two frames is on record; a fit that may stretch it makes up for errors of the velocities with it.
    Gravity is what it is everywhere. Under an assumed size it could stand for the unknown scale as well: freed, it goes
    to nearly nothing wherever the motion is slow for the assumed size, and water without weight leaves its bed. A
    plume's buoyancy is free.
    """
    known = {"time_step": 0.01}
    return known if kind_of(story["geometry"].meta["kind"]).is_gas else known | {"gravity": 0.02}


def filling_rate(story: Story) -> float | None:
    """Volume (m^3/s) that a vessel gains over the clip, from its rounded silhouette; None where nothing fills.

    What a jet brings is seen better in the vessel than in the jet, whose speed is a blur and whose mask is too wide.
    """
    from fluidlift.shape.surface import rounded_volume

    g, clip = story["geometry"], clip_of(story)
    if not kind_of(g.meta["kind"]).fills_vessel or g.meta["pool_level"] is None:
        return None
    camera, fluid, start = camera_of(story), masks_of(story), g.meta["rest_frame"]
    distance = float(np.median(g.arrays["depth"][g.arrays["depth"] > 0]))
    times, volumes = [], []
    for t in np.unique(np.linspace(start, len(clip) - 1, 8).astype(int)):
        if not fluid[t].any():
            continue
        volumes.append(rounded_volume(camera, fluid[t], distance))
        times.append(float(clip.times[t]))
    if len(times) < 4:
        return None
    rate = float(np.polyfit(times, volumes, 1)[0])
    return rate if rate > 0 else None


def first_guess(story: Story, targets: list[FaceVelocity]) -> FluidParameters:
    """Where the fit starts: velocities measured at the ends, the rest from what such a fluid usually has."""
    setting, kind = setting_of(story), kind_of(story["geometry"].meta["kind"])
    cells, direction = setting.cell_types, setting.terrain.mainstream
    mean = np.mean([t.at_centers() for t in targets], axis=0)
    inlet = cells == CellType.INFLOW
    wet = inlet | (cells == CellType.FLUID)
    bulk = mean[inlet].mean(axis=0) if inlet.any() else mean[wet].mean(axis=0)
    spread = np.std([t.at_centers()[inlet] for t in targets], axis=0).mean() if inlet.any() else 0.0
    outlet = np.zeros(cells.shape, bool)
    if (cells == CellType.OUTFLOW).any():
        from scipy import ndimage

        outlet = ndimage.binary_dilation(cells == CellType.OUTFLOW, iterations=2) & (cells == CellType.FLUID)
    out = float((mean[outlet] @ direction).mean()) if outlet.any() else float((mean[wet] @ direction).mean())
    speed = float(np.linalg.norm(mean[wet], axis=1).max()) if wet.any() else 0.0
    filling = filling_rate(story)
    if filling is not None and inlet.any():
        # the mouth of the inlet is its cross-section across the stream, one layer of its cells
        layer = setting.terrain.grid.spacing**2 * float(inlet.any(axis=int(np.argmax(np.abs(direction)))).sum())
        bulk = direction * min(filling / layer, float(np.linalg.norm(bulk)))
    interval = clip_of(story).interval
    courant = setting.terrain.grid.spacing / max(speed, 1e-6)
    return FluidParameters(
        kinematic_viscosity=kind.kinematic_viscosity,
        inflow_velocity=(float(bulk[0]), float(bulk[1]), float(bulk[2])),
        inflow_fluctuation=float(spread),
        outflow_velocity=max(out, 0.0),
        restitution=0.05,
        wall_damping=kind.wall_damping,
        time_step=float(np.clip(min(interval, 2.0 * courant), interval / 20, interval)),
    )


def sticking(kind: str | FluidKind, reports: list[dict[str, Any]]) -> float:
    """Share of the tangential velocity that a wall takes per step of the simulation: all of it where the motion is that
    of a viscous film (`motion.bed.film_share`), whose profile from the bed up is the flow itself. Where that is
    doubtful the two are mixed by ratio, as they differ by more than an order of magnitude.

    The fit keeps its own start: its steps take a share at walls beside what viscosity does there, and with all of it
    the viscosity of a film of four cells with an exact parabola comes out at 0.53 of the true one (1.37 with 0.05).

    Args:
        kind: of the fluid.
        reports: of the motion's targets (`lifting.plain_report`).
    """
    viscous = [r.get("viscous", 0.0) for r in reports]
    return kind_of(kind).wall_damping ** (1.0 - (float(np.median(viscous)) if viscous else 0.0))


def parameters_of(story: Story) -> FluidParameters:
    """The fitted parameters."""
    return FluidParameters().updated(story["fit"].meta["parameters"])


def estimates_of(story: Story) -> dict[str, Estimate]:
    """The fitted parameters with their uncertainties."""
    # JSON has no infinity
    return {
        name: Estimate(**(e | {"sigma": float("inf") if e["sigma"] is None else e["sigma"]}))
        for name, e in story["fit"].meta["estimates"].items()
    }
