"""What flows along in `blender_cases.py`: beds, rocks, and the colours that a flow carries in and out.

A bed is a height field: base - slope x, risen by a bank beyond half_width from its line y = bend sin(2 pi x / wave).
With a ledge [x, drop] it falls there into a basin 2 pool wide, whose far end rises by rim [x, rise].
Rocks are [x, y, radius], sunk into it by a third. Liquid comes from the box `inflow` and leaves at the low end.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

FADE, THICK, EMPTY = 4, 6, 2
"""frames in which a new point takes on its colour; points per cell above which some go, and below which some come"""
STREAMS: dict[str, dict[str, Any]] = {
    # low and high are those of the solver's domain, inside its walls
    "stream_bend": {
        "kind": "liquid", "size": [320, 240], "frames": 36, "first": 50, "spacing": 0.03, "low": [-1.5, -0.75, 0.0],
        "high": [1.5, 0.75, 0.66], "eye": [0.75, 2.15, 1.8], "target": [0.06, 0.02, 0.15], "fov": 44.0,
        "bed": {"base": 0.16, "slope": 0.015, "half_width": 0.34, "bend": 0.12, "wave": 3.4, "bank": 0.3},
        "rocks": [[-0.5, -0.1, 0.18], [0.05, 0.22, 0.19], [0.6, 0.0, 0.17]],
        "colors": [[0.02, 0.08, 0.1], [0.8, 0.85, 0.85]],
        "inflow": [[-1.5, -0.75, 0.12], [-1.35, 0.75, 0.54]], "jet": [0.4, 0.0, 0.0],
        "pillars": [[[-1.34, -0.75, 0.4], [-1.25, 0.75, 0.66]]],
    },
    "fall_ledge": {
        "kind": "liquid", "size": [320, 240], "frames": 36, "first": 55, "spacing": 0.025, "low": [-0.7, -0.55, 0.0],
        "high": [1.0, 0.55, 1.0], "eye": [2.3, 0.75, 1.15], "target": [0.05, 0.02, 0.38], "fov": 40.0,
        "bed": {"base": 0.68, "slope": 0.03, "half_width": 0.22, "bend": 0.0, "wave": 3.4, "bank": 0.14,
                "ledge": [-0.1, 0.6], "pool": 0.42, "rim": [0.8, 0.1]},
        "colors": [[0.05, 0.13, 0.15], [0.8, 0.85, 0.85]],
        "inflow": [[-0.7, -0.24, 0.72], [-0.6, 0.24, 0.86]], "jet": [0.7, 0.0, 0.0],
    },
    "film_slope": {
        "kind": "liquid", "size": [320, 240], "frames": 36, "first": 55, "spacing": 0.006, "low": [-0.18, -0.12, 0.0],
        "high": [0.18, 0.12, 0.2], "eye": [0.1, -0.5, 0.34], "target": [0.0, 0.0, 0.07], "fov": 42.0,
        "colors": [[0.2, 0.08, 0.01], [0.9, 0.6, 0.15]],
        "bed": {"base": 0.065, "slope": math.tan(math.radians(15.0))}, "viscosity": 0.004,
        "inflow": [[-0.12, -0.02, 0.165], [-0.085, 0.015, 0.18]], "jet": [0.0, 0.0, -0.25],
    },
}  # fmt: skip


def bed_height(bed: dict[str, Any], x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Metres above z = 0."""
    ground = bed["base"] - bed["slope"] * x
    if "half_width" not in bed:
        return ground
    away = np.abs(y - bed["bend"] * np.sin(2 * math.pi * x / bed["wave"]))
    half = bed["half_width"]
    if "ledge" in bed:
        edge, drop = bed["ledge"]
        low = np.clip((x - edge) / 0.06, 0, 1)
        half = half + (bed["pool"] - half) * low
        rim, up = bed["rim"]
        over = np.clip((x - rim + 0.2) / 0.2, 0, 1)
        ground = ground - drop * low + up * over * over * (3 - 2 * over)
    rise = np.clip((away - half) / bed["bank"], 0.0, 1.0)
    return ground + bed["bank"] * rise * rise * (3 - 2 * rise)


def bed_mesh(spec: dict[str, Any]) -> tuple[np.ndarray, np.ndarray]:
    """The bed as a closed body, three times as long and as wide as the domain and even beyond it."""
    (x0, y0, _), (x1, y1, _) = spec["low"], spec["high"]
    n, across = 150, 150
    x, y = np.linspace(2 * x0 - x1, 2 * x1 - x0, n), np.linspace(2 * y0 - y1, 2 * y1 - y0, across)
    xx, yy = np.meshgrid(x, y, indexing="ij")
    z = bed_height(spec["bed"], np.clip(xx, x0, x1), yy)
    top = np.stack([xx, yy, z], -1).reshape(-1, 3)
    bottom = top * [1.0, 1.0, 0.0] - [0.0, 0.0, z.max()]
    i = np.arange(n * across).reshape(n, across)
    a, b, c, d = i[:-1, :-1].ravel(), i[1:, :-1].ravel(), i[1:, 1:].ravel(), i[:-1, 1:].ravel()
    faces = np.r_[np.c_[a, b, c], np.c_[a, c, d]]
    rim = np.r_[i[:, 0], i[-1, 1:], i[-2::-1, -1], i[0, -2:0:-1]]
    after, below = np.roll(rim, -1), n * across
    sides = np.r_[np.c_[rim, rim + below, after + below], np.c_[rim, after + below, after]]
    return np.r_[top, bottom].astype(np.float32), np.r_[faces, faces[:, ::-1] + below, sides].astype(np.int32)


def rock_mesh(spec: dict[str, Any], rock: list[float]) -> tuple[np.ndarray, np.ndarray]:
    """A lumpy ball that stands in the bed."""
    x, y, radius = rock
    n, m = 24, 14
    around = 2 * math.pi * np.arange(n) / n
    up = math.pi * np.arange(1, m) / m
    u, v = np.meshgrid(up, around, indexing="ij")
    ring = np.stack([np.sin(u) * np.cos(v), np.sin(u) * np.sin(v), np.cos(u)], -1).reshape(-1, 3)
    points = np.r_[ring, [[0.0, 0.0, 1.0], [0.0, 0.0, -1.0]]]
    px, py, pz = points.T
    lumps = 1 + 0.12 * np.sin(4 * px + 9 * x) * np.cos(5 * py + 7 * y) + 0.08 * np.sin(6 * pz)
    z = float(bed_height(spec["bed"], np.array(x), np.array(y)))
    i = np.arange((m - 1) * n).reshape(m - 1, n)
    a, b, c, d = (k.ravel() for k in (i[:-1], i[1:], np.roll(i, -1, 1)[1:], np.roll(i, -1, 1)[:-1]))
    top, bottom = len(ring), len(ring) + 1
    faces = [np.c_[a, b, c], np.c_[a, c, d], np.c_[i[0], np.roll(i[0], -1), np.full(n, top)][:, [2, 0, 1]]]
    faces.append(np.c_[np.roll(i[-1], -1), i[-1], np.full(n, bottom)])
    return (points * (radius * lumps)[:, None] + [x, y, z + radius / 3]).astype(np.float32), np.concatenate(faces)


class Carried:
    """Points with a shade each, 0 to 1, all through a liquid that comes and goes."""

    def __init__(self, spec: dict[str, Any], low: np.ndarray, velocity: np.ndarray) -> None:
        """From the corner of the grid and the velocity at its cells, [nx,ny,nz,3], 0 where there is no liquid."""
        self.random, self.low, self.h = np.random.default_rng(3), low, spec["spacing"]
        self.shape, self.came = velocity.shape[:3], spec["jet"]
        self.points, self.shades, self.goals = np.empty((0, 3)), np.empty(0), np.empty(0)
        self.age, self.frame = np.empty(0, int), 0
        self.patches = self.random.uniform(size=(256, 256, 64))
        self.renew(velocity)
        self.shades, self.age = self.goals.copy(), np.full(len(self.points), FADE)

    def _cells(self) -> np.ndarray:
        at = np.floor((self.points - self.low) / self.h).astype(int)
        return np.ravel_multi_index(tuple(np.clip(at, 0, np.array(self.shape) - 1).T), self.shape)

    def _pattern(self, at: np.ndarray) -> np.ndarray:
        """Patches some cells wide, which come in with the inflow, and grain in them."""
        from scipy import ndimage

        wide = 3.5 * self.h
        then = (at - np.array(self.came) * self.frame / 25 - self.low) / wide
        smooth = ndimage.map_coordinates(self.patches, then.T, order=1, mode="grid-wrap")
        return np.clip(0.5 + 4.0 * (smooth - 0.5), 0, 1) * 0.7 + 0.3 * self.random.uniform(size=len(at))

    def renew(self, velocity: np.ndarray) -> None:
        """Points outside the liquid go, and those in crowds; into cells with few of them come new ones."""
        from scipy.spatial import cKDTree

        wet = velocity.any(axis=-1).ravel()
        cell = self._cells()
        crowd = np.bincount(cell, minlength=wet.size)[cell]
        keep = wet[cell] & (self.random.uniform(size=len(cell)) * crowd < THICK)
        thin = np.flatnonzero(wet & (np.bincount(cell[keep], minlength=wet.size) < EMPTY))
        new = np.repeat(np.stack(np.unravel_index(thin, self.shape), -1), EMPTY, axis=0)
        new = self.low + (new + self.random.uniform(size=new.shape)) * self.h
        goals = self._pattern(new)
        shown = self.shades[cKDTree(self.points).query(new)[1]] if len(self.points) else goals
        self.points, self.shades = np.r_[self.points[keep], new], np.r_[self.shades[keep], shown]
        self.goals, self.age = np.r_[self.goals[keep], goals], np.r_[self.age[keep], np.zeros(len(new), int)]

    def step(self, points: np.ndarray, velocity: np.ndarray) -> None:
        """A frame later: where the points are now, and the velocity."""
        self.points, self.frame = points, self.frame + 1
        left = np.maximum(FADE - self.age, 1)
        self.shades = self.shades + np.where(self.age < FADE, (self.goals - self.shades) / left, 0.0)
        self.age = self.age + 1
        self.renew(velocity)
