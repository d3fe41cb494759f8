"""Fields and curves as pictures for the report."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float, UInt8


def colour_map(
    values: Float[np.ndarray, "h w"],
    mask: Bool[np.ndarray, "h w"] | None = None,
    *,
    low: float | None = None,
    high: float | None = None,
    name: str = "viridis",
) -> UInt8[np.ndarray, "h w 3"]:
    """A scalar field in colours, dark grey where there is none."""
    from matplotlib import colormaps

    ok = np.isfinite(values) if mask is None else mask & np.isfinite(values)
    if not ok.any():
        return np.full((*values.shape, 3), 40, np.uint8)
    low = float(np.percentile(values[ok], 2)) if low is None else low
    high = float(np.percentile(values[ok], 98)) if high is None else high
    share = np.clip((np.where(ok, values, low) - low) / max(high - low, 1e-12), 0, 1)
    picture = (colormaps[name](share)[..., :3] * 255).astype(np.uint8)
    picture[~ok] = 40
    return picture


def velocity_slices(
    centers: Float[np.ndarray, "nx ny nz 3"], wet: Bool[np.ndarray, "nx ny nz"], *, scale: int = 5
) -> UInt8[np.ndarray, "h w 3"]:
    """Speed in three slices through the wettest cell planes: from above, along, across."""
    speed = np.linalg.norm(centers, axis=-1)
    top = float(np.percentile(speed[wet], 98)) if wet.any() else 1.0
    panels = []
    for axis in (2, 1, 0):
        other = tuple(a for a in range(3) if a != axis)
        plane = int(np.argmax(wet.sum(axis=other)))
        field, inside = np.take(speed, plane, axis=axis).T, np.take(wet, plane, axis=axis).T
        picture = colour_map(field[::-1], inside[::-1], low=0.0, high=top, name="turbo")
        panels.append(np.repeat(np.repeat(picture, scale, axis=0), scale, axis=1))
    height = max(p.shape[0] for p in panels)
    padded = [np.pad(p, ((0, height - p.shape[0]), (0, 8), (0, 0)), constant_values=255) for p in panels]
    return np.concatenate(padded, axis=1)


def curve(
    values: Sequence[float] | np.ndarray, *, title: str, x: str, y: str, log: bool = False
) -> UInt8[np.ndarray, "h w 3"]:
    """A line plot."""
    import matplotlib

    matplotlib.use("Agg", force=False)
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(5.2, 3.0), dpi=100)
    canvas = FigureCanvasAgg(figure)
    axes = figure.add_subplot(111)
    axes.plot(np.arange(len(values)), values, color="#1f6f8b", linewidth=1.6, marker="." if len(values) < 40 else None)
    axes.set_title(title, fontsize=10)
    axes.set_xlabel(x, fontsize=9)
    axes.set_ylabel(y, fontsize=9)
    if log and np.min(values) > 0:
        axes.set_yscale("log")
    axes.grid(alpha=0.3)
    figure.tight_layout()
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3].copy()


def caption(frame: UInt8[np.ndarray, "h w 3"], text: str) -> UInt8[np.ndarray, "h w 3"]:
    """The frame with a small label in its upper left corner."""
    import cv2

    out = np.array(frame, order="C")  # a copy: the frame may be the clip itself
    scale = max(0.4, out.shape[1] / 900)
    x, y = 8, int(24 * scale) + 6
    # the dark edge is the same text moved by a pixel: thicker letters are wider and would not lie behind the white ones
    edge = [(i, j, 0) for i in (-1, 0, 1) for j in (-1, 0, 1) if i or j]
    for dx, dy, grey in (*edge, (0, 0, 255)):
        place, colour = (x + dx, y + dy), (grey, grey, grey)
        cv2.putText(out, text, place, cv2.FONT_HERSHEY_SIMPLEX, scale, colour, 1, cv2.LINE_AA)
    return out
