"""Which parameters can be moved, how far, and how they are told: units, ranges and words."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

from fluidlift.errors import require
from fluidlift.types import Estimate, FluidKind, FluidParameters, kind_of
from fluidlift.types.parameter_table import PARAMETERS, FitVariable

STEPS = 200
"""of a slider, about"""
INFLOW, WHITEWATER = "inflow.factor", "whitewater.amount"
MOST_FOAM = 4.0
"""end of the slider of white water: times what the clip shows; scene.yaml takes more"""
ESTIMATES = {INFLOW: "inflow_velocity", "gravity": "gravity_z", "gravity_tilt": "gravity", "gravity_heading": "gravity",
             WHITEWATER: "foam_share"}  # fmt: skip
"""what a control moves, by its name among the estimates, where that is another"""
BESIDE = {WHITEWATER: "foam on "}
"""words before a number that a control does not move itself: it moves times that"""
WHOLE = str.maketrans({
    " ": "\N{NO-BREAK SPACE}", "/": "\N{DIVISION SLASH}", "-": "\N{MINUS SIGN}",
    ".": "\N{ONE DOT LEADER}\N{WORD JOINER}",
})  # fmt: skip
"""signs at which lines are broken, and those that stand for them"""

Values = dict[str, Any]
"""of `FluidParameters`, by name, `inflow.factor` and `whitewater.amount`"""


def path_of(name: str) -> str:
    """Where a value stands in scene.yaml."""
    return name if "." in name else f"parameters.{name}"


@dataclass(frozen=True)
class Control:
    """One number that a slider moves."""

    key: str
    """of itself"""
    label: str
    unit: str
    low: float
    high: float
    fitted: float
    """what the asset was lifted with, inside the range"""
    read: Callable[[Values], float]
    """the number, from the parameters"""
    write: Callable[[Values, float], Values]
    """parameters that change when it is set"""
    log: bool = False
    """the slider moves the power of ten"""
    hint: str = ""
    known: str = ""
    """value before any edit, interval and source, as the report has them; empty: nothing is known of it"""
    origin: str = "lifted"
    """a word on where `fitted` comes from, its mark on the slider: fitted, given, prior"""

    def __post_init__(self) -> None:
        require(self.low < self.high, f"{self.key} from {self.low} to {self.high}", "an ascending range")
        require(not self.log or self.low > 0, f"{self.key}: a logarithm of {self.low}", "a positive low end")

    def clamped(self, value: float) -> float:
        """Inside the range."""
        return min(max(float(value), self.low), self.high)

    @property
    def slider(self) -> tuple[float, float, float]:
        """Low end, high end and step of the slider: in the unit itself, or powers of ten."""
        low, high = (math.log10(self.low), math.log10(self.high)) if self.log else (self.low, self.high)
        step = (high - low) / STEPS
        power = 10.0 ** math.floor(math.log10(step))
        step = power * min((1, 2, 5, 10), key=lambda m: abs(m * power - step))
        return _digits(low, 4), _digits(high, 4), _digits(step, 1)

    def slider_of(self, value: float) -> float:
        """Position of the slider."""
        low, high, _ = self.slider
        value = self.clamped(value)
        return min(max(_digits(math.log10(value) if self.log else value, 4), low), high)

    def value_of(self, slider: float) -> float:
        """The number at a position of the slider; the fitted one exactly where that is within half a step."""
        low, high, step = self.slider
        if abs(self.slider_of(self.fitted) - slider) < 0.5 * step:
            return self.fitted
        slider = min(max(slider, low), high)
        return self.clamped(_digits(10.0**slider if self.log else slider, 4))

    def told(self, value: float) -> str:
        """With its unit, such as `1.3e-5 m²/s`."""
        return f"{number(value)} {self.unit}".strip()

    def typed(self, text: str) -> tuple[float | None, str]:
        """What a person typed: the number, clamped, or None; and what to tell, empty where all is well."""
        words = text.strip().replace(",", ".").removesuffix(self.unit).strip()
        try:
            value = float(words)
        except ValueError:
            return None, f"{self.label}: '{text[:40]}' is no number. Needed: {self.range_told()}."
        if not math.isfinite(value):
            return None, f"{self.label}: {value:g} is no finite number. Needed: {self.range_told()}."
        kept = self.clamped(value)
        if kept != value:
            return kept, f"{self.label}: {self.told(value)} is outside {self.range_told()}; {self.told(kept)} is taken."
        return kept, ""

    def range_told(self) -> str:
        """Such as `0 to 30 m/s²`."""
        return f"{number(self.low, 3)} to {number(self.high, 3)} {self.unit}".strip()


def number(value: float, digits: int = 4) -> str:
    """With so many digits, as a person writes it: 1000 and 1e-5, not 1e+03 and 1e-05."""
    if value and not 1e-3 <= abs(value) < 1e6:
        mantissa, power = f"{value:.{digits - 1}e}".split("e")
        short = mantissa.rstrip("0").rstrip(".") if "." in mantissa else mantissa
        return f"{short}e{int(power)}"
    return f"{float(f'{value:.{digits}g}'):.10g}"


def unbroken(text: str) -> str:
    """A number and its unit as one word. In labels viser allows a line to end behind / - . and _ by a mark that no
    joiner takes back: these signs give way to those that look the same."""
    return text.translate(WHOLE)


def _digits(value: float, digits: int) -> float:
    """Rounded to so many of them."""
    return float(f"{value:.{digits}g}")


def controls_of(
    fitted: FluidParameters, kind: str | FluidKind, estimates: Mapping[str, Estimate] | None = None
) -> tuple[Control, ...]:
    """The controls of an asset, in the order in which they are shown. Ranges hold what its kind is like and reach past
    the fitted value.

    Args:
        fitted: of the asset, before any edit.
        kind: of the fluid.
        estimates: of its parameters (`FluidAsset.estimates`): how sure each is, and where it comes from.
    """
    speed = _length(fitted.inflow_velocity)
    liquid = not kind_of(kind).is_gas
    found = []
    if liquid:
        found.append(_plain("kinematic_viscosity", fitted, log=True))
    found += _gravity(fitted, liquid)
    if speed > 0:
        found.append(_inflow(speed))
        found.append(_plain("inflow_fluctuation", fitted, span=(0.0, max(speed, 0.1))))
    if liquid:
        found += [_plain(name, fitted) for name in ("density", "surface_tension", "wall_damping", "restitution")]
        found.append(_whitewater())
    return tuple(_with_origin(control, estimates or {}) for control in found)


def _with_origin(control: Control, estimates: Mapping[str, Estimate]) -> Control:
    """With the mark and the words of the report on where its number comes from; of a vector, of the least sure of
    its parts that the clip says something about."""
    names = ESTIMATES.get(control.key, control.key)
    parts = [e for name, e in estimates.items() if name == names or name.startswith(f"{names}_")]
    if not parts:
        return control
    known = max([e for e in parts if e.fitted] or parts, key=lambda e: e.sigma)
    origin = "given" if known.sigma == 0 else "fitted" if known.fitted else "prior"
    told = known.source or origin
    value = f"{number(known.value, 3)} {known.unit}".strip()
    if known.interval is not None and known.fitted:
        between = f"95 %: {number(known.interval[0], 3)} to {number(known.interval[1], 3)} {known.unit}".rstrip()
        told, value = f"{told}; {between}", f"{value} ({between})"
    words = f"{BESIDE.get(control.key, '')}{value}; {known.source or origin}"
    origin = control.origin if control.key in BESIDE else origin
    return replace(control, origin=origin, hint=f"{control.hint}. {told}".lstrip(". "), known=words)


def _length(vector: Any) -> float:
    return math.sqrt(sum(float(x) ** 2 for x in vector))


def _plain(
    name: str, fitted: FluidParameters, *, span: tuple[float, float] | None = None, log: bool = False
) -> Control:
    """The slider of one number of the table; `span` replaces the table's."""
    known, value = PARAMETERS[name], float(getattr(fitted, name))
    span = span or known.span
    low, high = min(span[0], value) if value > 0 or not log else span[0], max(span[1], 2 * value)
    if known.scale is FitVariable.LOGIT:
        high = span[1]
    return Control(
        name, known.label, known.sign, low, high, min(max(value, low), high), lambda p: float(p[name]),
        lambda p, v: {name: v}, log=log, hint=known.hint,
    )  # fmt: skip


def _gravity(fitted: FluidParameters, liquid: bool) -> list[Control]:
    """Strength, tilt from straight down and heading of the tilt; three numbers that are one vector."""
    word = "gravity" if liquid else "buoyancy"
    strength = _length(fitted.gravity)
    controls = [
        Control("gravity", word, "m/s²", 0.0, max(30.0, 2 * strength), strength, lambda p: _length(p["gravity"]),
                lambda p, v: {"gravity": turned(v, *direction(p["gravity"], fitted.gravity))},
                hint="earth 9.81, moon 1.62 m/s²"),
    ]  # fmt: skip
    if not liquid:
        return controls
    tilt, heading = direction(fitted.gravity, fitted.gravity)
    return [
        *controls,
        Control("gravity_tilt", "gravity tilt", "°", 0.0, 180.0, tilt,
                lambda p: direction(p["gravity"], fitted.gravity)[0],
                lambda p, v: {"gravity": turned(_length(p["gravity"]), v, _heading(p, fitted))},
                hint="0: straight down; 90: sideways; 180: up"),
        Control("gravity_heading", "tilt towards", "°", -180.0, 180.0, heading,
                lambda p: direction(p["gravity"], fitted.gravity)[1],
                lambda p, v: {"gravity": turned(_length(p["gravity"]), direction(p["gravity"], fitted.gravity)[0], v)},
                hint="0: along x, the mainstream; 90: along y; only with a tilt"),
    ]  # fmt: skip


def _heading(p: Values, fitted: FluidParameters) -> float:
    return direction(p["gravity"], fitted.gravity)[1]


def direction(gravity: Any, otherwise: Any) -> tuple[float, float]:
    """Tilt from straight down (0 to 180) and its heading from x towards y (-180 to 180), degrees; those of another
    vector where the first one is zero. Straight down has the heading 0."""
    strength = _length(gravity)
    if strength == 0:
        return (0.0, 0.0) if _length(otherwise) == 0 else direction(otherwise, otherwise)
    x, y, z = (float(c) / strength for c in gravity)
    across = math.hypot(x, y)
    tilt = math.degrees(math.atan2(across, -z))
    return tilt, math.degrees(math.atan2(y, x)) if across > 1e-6 else 0.0


def turned(strength: float, tilt: float, heading: float) -> list[float]:
    """Gravity, m/s², of so many m/s², tilted from straight down by so many degrees towards a heading."""
    t, h = math.radians(tilt), math.radians(heading)
    vector = (math.sin(t) * math.cos(h), math.sin(t) * math.sin(h), -math.cos(t))
    return [float(f"{strength * c:.6g}") + 0.0 for c in vector]


def _inflow(speed: float) -> Control:
    return Control(
        INFLOW, "inflow", "×", 0.0, 4.0, 1.0, lambda p: float(p[INFLOW]), lambda p, v: {INFLOW: v},
        hint=f"times the clip's own, {speed:.3g} m/s",
    )  # fmt: skip


def _whitewater() -> Control:
    return Control(
        WHITEWATER, "white water", "×", 0.0, MOST_FOAM, 0.0, lambda p: float(p[WHITEWATER]),
        lambda p, v: {WHITEWATER: v}, origin="none",
        hint="spray, foam and bubbles where an edit makes the water break, times what the clip shows; drawn by a full "
        "simulation ('Run'), not live",
    )  # fmt: skip
