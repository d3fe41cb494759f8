"""What the fluid is: parameters and look."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Any

from fluidlift.viewer.callbacks import heard, show
from fluidlift.viewer.controls import Control, number, path_of, unbroken

if TYPE_CHECKING:
    from fluidlift.viewer.app import Viewer

STOPS = 4.0
"""of exposure, up or down"""
ROOM = 0.25
"""share of a slider that two of its marks must lie apart to be read"""


class FluidPanel:
    """Sliders for the parameters, one place to type exact values, and the look."""

    def __init__(self, viewer: Viewer) -> None:
        self._viewer, self._gui = viewer, viewer.server.gui
        self._sliders: dict[str, Any] = {}
        self._by_label: dict[str, Control] = {}
        values = viewer.draft.parameters
        with self._gui.add_folder("Parameters"):
            for control in viewer.controls:
                self._add_slider(control, control.read(values))
        with self._gui.add_folder("Type a value", expand_by_default=False):
            self._add_typing()
        with self._gui.add_folder("Look"):
            self._add_look()

    def _add_slider(self, control: Control, value: float) -> None:
        low, high, step = control.slider
        label, marks, hint = _label(control, value), _marks(control), f"{control.range_told()}. {control.hint}."
        at = control.slider_of(value)
        if control.log:  # a slider's own box would hold the power of ten: a slider of several thumbs has none
            hint += " 'Type a value' takes the number itself."
            slider = self._gui.add_multi_slider(label, low, high, step, (at,), marks=marks, hint=hint)
        else:
            slider = self._gui.add_slider(label, low, high, step, at, marks=marks, hint=hint)
        heard(slider, lambda event, at: self._slid(event, control, _one(at)))
        self._sliders[control.key] = slider
        self._by_label[control.label] = control
        if control.known:
            self._gui.add_markdown(f"*{control.known}*")

    def _slid(self, event: Any, control: Control, at: float) -> None:
        if event.client is None:
            return
        self._set(control, control.value_of(float(at)))

    def _set(self, control: Control, value: float) -> None:
        viewer = self._viewer
        told = f"{control.label} {control.told(value)}"
        fitted = viewer.draft.fitted
        for name, part in control.write(viewer.draft.parameters, value).items():
            part = None if part == fitted.get(name) else part
            viewer.draft.move(path_of(name), part, told, time.monotonic())
        self._sliders[control.key].label = _label(control, value)
        viewer.messages = ""
        viewer.changed()

    def _add_typing(self) -> None:
        self._which = self._gui.add_dropdown("parameter", tuple(self._by_label))
        self._text = self._gui.add_text("value", "", hint="such as 1e-5")
        self._gui.add_button("Set", icon="check").on_click(self._typed)

    def _typed(self, _: Any) -> None:
        control = self._by_label[self._which.value]
        value, problem = control.typed(self._text.value)
        if value is not None:
            self._set(control, value)
            self._place(control, value)
        self._viewer.say(problem)

    def _place(self, control: Control, value: float) -> None:
        """Move a slider that is not there yet."""
        slider, at = self._sliders[control.key], control.slider_of(value)
        if _one(slider.value) != at:
            show(self._viewer.server, slider, (at,) if control.log else at)

    # look

    def _add_look(self) -> None:
        from fluidlift.io.scene_look import ENVIRONMENTS, MATERIALS, STYLES

        look, gui = self._viewer.draft.look, self._gui
        self._style = gui.add_dropdown(
            "style",
            STYLES,
            initial_value=_known(look.get("style"), STYLES),
            hint="of rendered pictures; splats: as lifted, without light of their own",
        )
        self._material = gui.add_dropdown(
            "material",
            MATERIALS,
            initial_value=_known(look.get("material"), MATERIALS),
            hint="source: as in the clip; the others change look, density and viscosity",
        )
        self._light = gui.add_dropdown(
            "environment",
            ENVIRONMENTS,
            initial_value=_known(look.get("environment"), ENVIRONMENTS),
            hint="light of rendered pictures, of all styles but splats",
        )
        self._exposure = gui.add_slider("exposure, stops", -STOPS, STOPS, 0.25, _stops(look))
        self._tint = gui.add_rgb("tint", _bytes(look.get("tint")))
        gui.add_markdown("Colours are shown here; reflections, refraction and light in rendered pictures ('Run').")
        heard(self._style, lambda e, value: self._looked(e, "style", value))
        heard(self._material, self._materialised)
        heard(self._light, lambda e, value: self._looked(e, "environment", value))
        heard(self._exposure, lambda e, value: self._looked(e, "exposure", float(value)))
        heard(self._tint, lambda e, value: self._looked(e, "tint", [round((c / 255) ** 2.2, 4) for c in value]))

    def _looked(self, event: Any, name: str, value: Any) -> None:
        if event.client is None:
            return
        told = f"{name} {value}"
        self._viewer.draft.move(f"look.{name}", value, told, time.monotonic())
        self._viewer.redraw()

    def _materialised(self, event: Any, name: str) -> None:
        """The liquid of another material: its look, its density and its viscosity. Splats as they were lifted have no
        material: with one, they are lit."""
        if event.client is None:
            return
        viewer = self._viewer
        viewer.edited(lambda: viewer.draft.make_of(name), f"material {name}")

    # state

    def refresh(self) -> None:
        """Show the values of the scene."""
        values, look = self._viewer.draft.parameters, self._viewer.draft.look
        for control in self._viewer.controls:
            slider, value = self._sliders[control.key], control.read(values)
            if slider.label != _label(control, value):
                slider.label = _label(control, value)
            self._place(control, value)
        for handle, name in ((self._style, "style"), (self._material, "material"), (self._light, "environment")):
            show(self._viewer.server, handle, _known(look.get(name), handle.options))
        show(self._viewer.server, self._exposure, _stops(look))
        show(self._viewer.server, self._tint, _bytes(look.get("tint")))


def _label(control: Control, value: float) -> str:
    """With three digits: more would wrap. The box beside the slider, and typing, have them all. Lines break before
    the number, not between it and its unit."""
    amount = f"{number(value, 3)} {control.unit}".strip().replace(" °", "°")
    return f"{control.label} {unbroken(amount)}"


def _one(value: Any) -> float:
    """Place of a slider, which may be one of several thumbs."""
    return float(value[0] if isinstance(value, tuple | list) else value)


def _marks(control: Control) -> tuple[tuple[float, str], ...]:
    """The value before any edit, and those ends of the range whose numbers have room beside it."""
    low, high, _ = control.slider
    fitted = control.slider_of(control.fitted)
    ends = ((low, number(control.low, 3)), (high, number(control.high, 3)))
    return ((fitted, control.origin), *((at, told) for at, told in ends if abs(at - fitted) > ROOM * (high - low)))


def _known(name: Any, options: tuple[str, ...]) -> str:
    """The option, or the first one."""
    return name if name in options else options[0]


def _stops(look: dict[str, Any]) -> float:
    return min(max(float(look.get("exposure", 0.0)), -STOPS), STOPS)


def _bytes(tint: Any) -> tuple[int, int, int]:
    """sRGB, near enough, of a linear tint."""
    r, g, b = (round(255 * min(max(float(c), 0.0), 1.0) ** (1 / 2.2)) for c in (tint or (1, 1, 1)))
    return r, g, b
