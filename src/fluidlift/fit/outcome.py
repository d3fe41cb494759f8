"""What a fit found, judged and in words: whether it may be used, and where each number comes from."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace
from typing import Any, Literal

from fluidlift.messages import Notice
from fluidlift.types import Estimate, FitResult, FluidParameters
from fluidlift.types.parameter_table import PARAMETERS, FitVariable

FITTED = "fitted"
LOOSE = "fitted, known loosely"
UNDETERMINED = "prior: not determined by the clip"
LEFT_OUT = "prior: not fitted"
GIVEN = "given"
MEASURED = "measured"
SUBJECT = "the parameter fit"
"""how every warning of a fit begins"""
AT_THE_ENDS = ("inflow_velocity", "inflow_fluctuation", "outflow_velocity")
"""what the first guess reads off the velocities of the clip"""
MORE = "--set fit.max_work=... and --set fit.max_seconds=... give it more"
"""what helps a fit that was cut off"""
WIDTH = 1.96
"""standard deviations on either side that hold 95 %"""

TIES = (
    "Density only changes the pressure, which no picture shows: it keeps its prior unless it is given.",
    "Scale, gravity and time step are tied: the same clip fits a scene twice as large under twice the gravity, or, as "
    "slow motion, one four times as large. Gravity is therefore held near 9.81 m/s^2, and the scale is given, measured "
    "or assumed.",
)


@dataclass(frozen=True)
class Verdict:
    """How a fit ended."""

    status: Literal["fitted", "unfinished", "failed", "left"]
    """unfinished: better than the first guess, but not at the minimum; left: not tried, for the reason given"""
    reason: str = ""
    """what went wrong; empty where nothing did"""

    @property
    def usable(self) -> bool:
        """The values found are better than the first guess."""
        return self.status in ("fitted", "unfinished")

    def warnings(self) -> list[Notice]:
        """For the user."""
        if self.status == "failed":
            return [
                Notice(
                    "fit-failed",
                    f"{SUBJECT} failed: {self.reason}; the first guess is kept (velocities as measured, the rest "
                    "as such fluids usually are). Known values help: fluidlift fit ASSET --hold viscosity=...",
                )
            ]
        if self.status == "unfinished":
            return [
                Notice(
                    "fit-unfinished",
                    f"{SUBJECT} stopped before it converged ({self.reason}): its values are the best found so far, "
                    f"better than the first guess ({MORE})",
                )
            ]
        return []


def verdict(found: FitResult) -> Verdict:
    """Judge a fit by its losses, its estimates and its notes."""
    loss, first, rest = (float(found.extra.get(k, math.nan)) for k in ("loss", "loss_at_prior", "loss_at_rest"))
    if not math.isfinite(loss):
        return Verdict("failed", "the simulated flow breaks down at the first guess")
    if found.reason and "budget" not in found.reason:
        return Verdict("failed", found.reason)
    if not any(e.fitted for e in found.estimates.values()):
        if not found.converged and any("budget" in note for note in found.notes):
            return Verdict("failed", f"it was cut off before it had begun ({MORE})")
        return Verdict("failed", "the clip determines none of the parameters")
    # equal is no failure: the first guess may have been right
    if loss > first * (1.0 + 1e-6):
        return Verdict(
            "failed", f"its values explain the motion worse than the first guess (misfit {loss:.3g}, {first:.3g})"
        )
    if loss > rest:
        return Verdict(
            "failed", f"the simulated flow is no nearer to the clip than still water (misfit {loss:.3g}, {rest:.3g})"
        )
    if not found.converged:
        return Verdict("unfinished", f"after {found.rollouts} rollouts")
    return Verdict("fitted")


def first_guess_as_result(initial: FluidParameters, units: Mapping[str, str]) -> dict[str, Estimate]:
    """Estimates of a fit that failed: the initial values, of which nothing is known."""
    found = {}
    for name, unit in units.items():
        value = getattr(initial, name)
        parts = [("", value)] if not isinstance(value, tuple) else [(f"_{a}", v) for a, v in zip("xyz", value)]
        for end, number in parts:
            found[name + end] = Estimate(float(number), math.inf, False, float(number), unit)
    return found


def as_given(label: str, e: Estimate, initial: FluidParameters) -> Estimate:
    """The estimate of a number that a person knows: exact."""
    value = getattr(initial, family(label))
    number = float(value["xyz".index(label[-1])]) if isinstance(value, tuple) else float(value)
    return Estimate(number, 0.0, False, number, e.unit)


def family(label: str) -> str:
    """The parameter that a label (`gravity_z`) belongs to."""
    return label[:-2] if label[-2:] in ("_x", "_y", "_z") else label


def interval_of(label: str, e: Estimate) -> tuple[float, float] | None:
    """The range that holds the value with 95 %, in the variable that was fitted; None where nothing is known."""
    if not math.isfinite(e.sigma):
        return None
    name, v, reach = family(label), e.value, WIDTH * e.sigma
    scale = FitVariable.LOG if name == "size" else PARAMETERS[name].scale if name in PARAMETERS else FitVariable.LINEAR
    if scale is FitVariable.LOG and v > 0:
        factor = math.exp(min(reach / v, 700.0))
        return v / factor, v * factor
    if scale is FitVariable.LOGIT and 0 < v < 1:
        logit, wide = math.log(v / (1 - v)), min(reach / (v * (1 - v)), 700.0)
        return tuple(1 / (1 + math.exp(-min(max(logit + d, -700.0), 700.0))) for d in (-wide, wide))  # type: ignore[return-value]
    return v - reach, v + reach


def source_of(
    label: str, e: Estimate, *, held: Collection[str], free: Collection[str], measured: Collection[str]
) -> str:
    """Where a number comes from, in words."""
    name = family(label)
    if name in held:
        return GIVEN
    if e.identifiable:
        return FITTED
    if e.fitted:
        return LOOSE
    if name in measured:
        return MEASURED
    return UNDETERMINED if name in free else LEFT_OUT


def table(
    estimates: Mapping[str, Estimate], *, held: Collection[str], free: Collection[str], measured: Collection[str]
) -> list[dict[str, Any]]:
    """One row per number: name, value, sigma, interval (95 %), unit, prior, source; plain values."""
    rows = []
    for label, e in estimates.items():
        interval = interval_of(label, e)
        rows.append(
            {
                "name": label,
                "value": e.value,
                "sigma": e.sigma if math.isfinite(e.sigma) else None,
                "interval": None if interval is None else list(interval),
                "unit": e.unit,
                "prior": e.prior,
                "source": source_of(label, e, held=held, free=free, measured=measured),
            }
        )
    return rows


def size_row(scale: Mapping[str, Any]) -> dict[str, Any] | None:
    """The row of the size, which decides on the unit of all others; None where an earlier version did not note it.

    Args:
        scale: plain values of `MetricScale`.
    """
    across, relative = scale.get("across"), scale.get("relative_error")
    if not across:
        return None
    source = {"size": GIVEN, "depth": GIVEN, "assumed": UNDETERMINED}.get(scale["source"], MEASURED)
    sigma = relative * across if relative is not None else 0.0 if scale["source"] == "size" else math.inf
    (row,) = table({"size": Estimate(across, sigma, relative is not None, 1.0, "m")}, held=(), free=(), measured=())
    return row | {"source": f"{source}: {scale['source']}" if source == MEASURED else source}


def size_estimate(row: Mapping[str, Any]) -> Estimate:
    """The size as an estimate like others."""
    sigma = math.inf if row["sigma"] is None else row["sigma"]
    return Estimate(row["value"], sigma, 0 < sigma < math.inf, row["prior"], row["unit"])


def labelled(e: Estimate, row: Mapping[str, Any]) -> Estimate:
    """The estimate with its interval and source."""
    return replace(e, interval=row["interval"], source=row["source"])


def how_sure(row: Mapping[str, Any]) -> str:
    """A bar of ten: full where the 95 % interval is narrow for the value; empty where it is as wide, or unknown."""
    if row["source"] == GIVEN:
        return "known"
    if row["sigma"] is None or not row["source"].startswith((FITTED, MEASURED)):
        return "▱" * 10
    relative = WIDTH * row["sigma"] / max(abs(row["value"]), 1e-300)
    full = round(10 * (1.0 - min(relative, 1.0)))
    return "▰" * full + "▱" * (10 - full)


def in_words(row: Mapping[str, Any]) -> str:
    """The 95 % interval of a row."""
    if row["source"] == GIVEN and row["sigma"] is not None:
        return "exact"
    if row["interval"] is None:
        return "unknown"
    return f"{row['interval'][0]:.3g} to {row['interval'][1]:.3g}"
