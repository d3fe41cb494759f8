"""Jets and threads in the air above a film, a pool or a puddle: which pixels of a picture show them.

A jet falls along the vertical. In the picture its motion follows the projected vertical, faster than what lies around
it; it is narrow, its upper end is the edge of the fluid, and its motion ends within a width where it meets the lying
part. All of that must hold, otherwise everything is taken to lie. Where they stand in space: `shape/jet_column.py`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import cast

import numpy as np
from jaxtyping import Bool, Float
from scipy import ndimage

from fluidlift.shape.view.habit import ROLL
from fluidlift.types import PinholeCamera

ALONG = np.cos(np.radians(25.0))
"""cosine of the largest angle between the motion of a jet and the projected vertical: 15 degrees for a jet that leans,
10 for errors of flow and tilt"""
ACROSS = np.cos(np.radians(35.0))
"""cosine of the angle between the motion of the lying part and the projected vertical, below which the two are told
apart"""
LARGE = 0.01
"""share of the fluid's pixels from which a jet, twice as fast beyond the scatter as others must be, is believed to hide
fluid behind its top as well, where that runs another way"""
CONTRAST = 3.0
"""robust standard deviations by which a jet falls faster than the lying part would there"""
FASTER = 0.35
"""share of its own speed by which it does so at least"""
NARROW = 0.5
"""width of a jet over that of the lying part, at most"""
STOPS = 0.6
"""speed down the picture a width below the foot over that in the jet, at most: a jet stops where it lands, a current
in a pool decays over many widths"""
SLOWING = 0.5
"""radii above the surface at which a jet that lands has half its speed: in the flow towards a wall the speed falls
linearly over about a radius. Its motion is followed down to there"""
LEVEL_FED = 0.1
"""prior share of level ones among films that get all they have from jets: on level ground, what a jet brings spreads
to all sides, unless walls lead it"""
ONE_WAY = 0.7
"""length of the mean motion over the mean of its lengths, from which a film runs off to one side (evenly to all: 0)"""
ENTERS = 0.2
"""length of the picture's border over which a film may seem to come in, over the root of its area: errors of flow"""
FEWEST = 40
"""pixels of a jet: fewer have no shape"""
BLUR = 4.0
"""px over which flow passes from one motion to another"""
TRUSTED = 0.1
"""confidence of flow below which it is not looked at. Jets are thin and fast: with the 0.3 that counts as measured
elsewhere (`types.flow.TRUSTED`) the scale of a thread of honey changes 400-fold, that of a chute by a quarter"""
BODY_SHARE, NECK_SHARE = 0.8, 0.25
"""of a puddle under threads: its share of the mask at least, and the width of the threads over its own at most. A
vessel seen from the side is filled by a jet of a third of its width, and less of the mask is in it"""


@dataclass(frozen=True)
class JetOutline:
    """A jet in the picture."""

    pixels: Bool[np.ndarray, "h w"]
    centers: Float[np.ndarray, "k 2"]
    """(u, v) of its axis from the top to the foot, px; the last is where its near side meets the lying part"""
    half_widths: Float[np.ndarray, " k"]
    """px"""
    cut: bool
    """whether its top lies at the picture's edge"""
    nozzle: tuple[float, float] | None = None
    """(u, v), px, of where it rises out of its pool; None: it falls from above"""


def projected_vertical(camera: PinholeCamera) -> Float[np.ndarray, "h w 2"]:
    """Unit direction in the picture, at every pixel, of a motion straight down in the world."""
    down = -camera.camera_from_world.rotation[:, 2]
    grid = camera.pixel_grid()
    x = (grid - camera.center) / camera.focal
    # d/dt of (X / Z, Y / Z) for a motion (dX, dY, dZ), times Z
    step = (down[:2] - x * down[2]) * camera.focal
    return step / np.maximum(np.linalg.norm(step, axis=-1, keepdims=True), 1e-12)


def find_jets(
    camera: PinholeCamera,
    mask: Bool[np.ndarray, "h w"],
    motion: Float[np.ndarray, "h w 2"],
    trust: Float[np.ndarray, "h w"],
) -> list[JetOutline]:
    """Jets that fall onto a fluid which lies below them; none unless the evidence is strong (see the module).

    Args:
        camera: its tilt gives the projected vertical.
        mask: fluid pixels.
        motion: mean over the clip, px per frame.
        trust: of the motion, 0 to 1.
    """
    if mask.sum() < 10 * FEWEST:
        return []
    down = projected_vertical(camera)
    upright = float(np.linalg.norm(camera.camera_from_world.rotation[:2, 2]))
    speed = np.linalg.norm(motion, axis=-1)
    falls = (motion * down).sum(-1)
    usual, spread = lying_motion(mask, motion, trust, falls > ALONG * speed)
    excess = falls - (usual * down).sum(-1)
    clear = (excess > CONTRAST * spread) & (excess > FASTER * speed)
    candidate = mask & (trust > TRUSTED) & (falls > ALONG * speed) & clear & (speed > 0.5)
    label, count = cast(tuple[np.ndarray, int], ndimage.label(ndimage.binary_opening(candidate)))
    found = []
    for k in range(1, count + 1):
        part = label == k
        if part.sum() < FEWEST:
            continue
        # a step that was blurred has its edge at half its height
        part &= excess > 0.5 * np.percentile(excess[part], 90)
        hides = part.sum() > LARGE * mask.sum() and float(np.median(excess[part])) > 2.0 * CONTRAST * spread
        against = float(np.median(np.linalg.norm(usual, axis=-1)[part]))
        hides = hides and float(np.median((usual * down).sum(-1)[part])) < ACROSS * against
        outline = _outline(part, mask, down[part].mean(axis=0), upright, hidden_above=hides)
        if outline is not None and _lands(outline, mask, falls, trust):
            found.append(outline)
    return found


def lying_motion(mask, motion, trust, falling) -> tuple[np.ndarray, float]:
    """Motion [h,w,2] of the lying fluid, a quadratic of the place (a plane in uniform motion is one), and its robust
    scatter, px/frame. Of two starts, all of it and what does not follow the vertical, the one that explains more is
    kept: a long jet may be a third of the mask."""
    height, width = mask.shape
    y, x = np.mgrid[-1 : 1 : height * 1j, -1 : 1 : width * 1j]
    terms = np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=-1)
    rows, cols = np.nonzero(mask & (trust > TRUSTED))
    if len(rows) < FEWEST:
        return np.zeros_like(motion), 0.0
    pick = np.linspace(0, len(rows) - 1, min(len(rows), 6000)).astype(int)
    at = rows[pick], cols[pick]
    fits = [_robust_fit(terms[at], motion[at].astype(float), trust[at].astype(float), s) for s in (1.0, ~falling[at])]
    found, spread, robust = min(fits, key=lambda fit: fit[1])
    low, high = (np.percentile(motion[at][robust > 0], q, axis=0) for q in (1, 99))
    return np.clip(terms @ found, low, high), spread  # beside the lying part a quadratic runs away


def _robust_fit(terms, values, weight, start) -> tuple[np.ndarray, float, np.ndarray]:
    """Coefficients by least squares with Tukey's biweight, the robust scatter, and the weights that the points end
    with."""
    robust, spread, found = weight * start, np.inf, np.zeros((terms.shape[1], values.shape[1]))
    for _ in range(20):
        if (robust > 0).sum() < FEWEST:
            return found, np.inf, weight
        weighted = (terms * robust[:, None]).T  # normal equations: six columns and thousands of rows
        found, *_ = np.linalg.lstsq(weighted @ terms, weighted @ values, rcond=None)
        rest = np.linalg.norm(values - terms @ found, axis=1)
        spread = float(np.median(rest)) / 1.17  # the median of the norm of two standard normal numbers
        robust = weight * np.square(1.0 - np.clip(rest / max(4.685 * spread, 1e-6), 0.0, 1.0) ** 2)
    return found, spread, robust


def _outline(
    part: np.ndarray, mask: np.ndarray, direction: np.ndarray, upright: float, *, hidden_above: bool
) -> JetOutline | None:
    """Axis and widths of a falling part, completed up to the edge of the fluid and down to the surface; None where
    fluid goes on above it that it may not hide. `upright`: how long the vertical appears, of its true length."""
    direction = direction / np.linalg.norm(direction)
    across = np.array([-direction[1], direction[0]])
    rows, cols = np.nonzero(part)
    place = np.stack([cols + 0.5, rows + 0.5], -1)
    s, x = place @ direction, place @ across
    middle, half = float(np.median(x)), 0.5 * float(np.ptp(np.percentile(x, [5, 95]))) / 0.9
    core = np.abs(x - middle) < 0.5 * half
    if not core.any() or half < 1.0:
        return None
    top, foot = np.percentile(s[core], [1, 99])
    grid = np.stack(np.meshgrid(np.arange(mask.shape[1]) + 0.5, np.arange(mask.shape[0]) + 0.5), -1)
    above = (np.abs(grid @ across - middle) < half) & (grid @ direction < top + 1) & mask
    near = above & (grid @ direction > top - 3.0 * half)
    label, _ = cast(tuple[np.ndarray, int], ndimage.label(near | part))
    cap = near & (label == label[rows[core][0], cols[core][0]])
    if cap.any():
        highest = float(np.percentile((grid @ direction)[cap], 2))
        reach = 2.0 * BLUR if hidden_above else 2.5 * half
        if highest < top - reach and not hidden_above:
            return None
        if highest < top - reach:
            cap = np.zeros_like(cap)
        top = min(top, highest) if cap.any() else top
    whole = ndimage.binary_closing(part | cap, iterations=2) & mask
    lateral = np.ptp((grid @ across)[mask & ~whole]) if (mask & ~whole).any() else 0.0
    if 2.0 * half > NARROW * lateral or foot - top < 4.0:
        return None
    outline = _stations(whole, direction, across, middle, (top, foot, foot + SLOWING * half * upright))
    axis = outline.centers[-1] - outline.centers[0]
    # a chute leans; of what is twice as wide as long the axis is not known
    leans = axis @ direction < ALONG * np.linalg.norm(axis)
    return None if leans and foot - top > half else outline


def _stations(whole: np.ndarray, direction: np.ndarray, across: np.ndarray, middle: float, ends) -> JetOutline:
    """Centre and half width at some places between its ends (slices): the top, the foot as far as it is seen, and where
    it meets the ground."""
    rows, cols = np.nonzero(whole)
    place = np.stack([cols + 0.5, rows + 0.5], -1)
    s, x = place @ direction, place @ across
    top, foot, ground = ends
    count = int(np.clip((foot - top) / 6.0, 2, 8))
    edges = np.linspace(top, foot, count + 1)
    centers, halves = [], []
    for low, high in zip(edges[:-1], edges[1:]):
        here = (s >= low) & (s < high)
        area = float(here.sum()) / max(high - low, 1e-6)
        centers.append(float(np.median(x[here])) if here.any() else middle)
        halves.append(max(0.5 * area, 0.5))
    # the ends of the silhouette are rounded: the slices beside them know the width
    halves[0], halves[-1] = max(halves[0], halves[1]), max(halves[-1], halves[-2])
    line = np.polyfit(0.5 * (edges[1:] + edges[:-1]), centers, 1 if count > 3 else 0)
    at = np.concatenate([[top], 0.5 * (edges[1:] + edges[:-1]), [ground]])
    points = at[:, None] * direction + np.polyval(line, at)[:, None] * across
    height, width = whole.shape
    u, v = points[0] - 1.5 * direction
    cut = not (1.0 < u < width - 1.0 and 1.0 < v < height - 1.0)
    return JetOutline(whole, points, np.array([halves[0], *halves, halves[-1]]), cut)


def _lands(outline: JetOutline, mask: np.ndarray, falls: np.ndarray, trust: np.ndarray) -> bool:
    """Whether its motion ends on fluid: within its width below the foot there is fluid that falls much less."""
    step = outline.centers[-1] - outline.centers[-2]
    length = float(np.linalg.norm(step))
    step = step / length if length > 0 else np.array([0.0, 1.0])
    half = float(outline.half_widths[-1])
    offsets = np.linspace(-0.7, 0.7, 9)[:, None] * half * np.array([-step[1], step[0]])
    known = outline.pixels & (trust > TRUSTED)
    own = float(np.median(falls[known])) if known.any() else 0.0
    least = np.inf
    for d in (0.25, 0.5, 0.75, 1.0):  # seen at a grazing angle, the lying part may be narrower than the jet
        below = outline.centers[-1] + max(2.0 * half * d, BLUR) * step + offsets
        row, col = np.floor(below[:, 1]).astype(int), np.floor(below[:, 0]).astype(int)
        inside = (row >= 0) & (row < mask.shape[0]) & (col >= 0) & (col < mask.shape[1])
        row, col = row[inside], col[inside]
        wet = mask[row, col] & ~outline.pixels[row, col]
        if wet.sum() < 0.6 * len(below):
            break
        least = min(least, float(np.median(falls[row[wet], col[wet]])))
    return least < STOPS * own


def feed_all(
    outlines: list[JetOutline],
    lying: Bool[np.ndarray, "h w"],
    motion: Float[np.ndarray, "h w 2"],
    trust: Float[np.ndarray, "h w"],
) -> bool:
    """Whether jets bring all of what lies below them, and it runs off to one side: nothing comes in over the border of
    the picture. Such a film is rarely level (`LEVEL_FED`).

    Args:
        outlines: of the jets.
        lying: pixels of what lies.
        motion: mean over the clip, px per frame.
        trust: of the motion, 0 to 1.
    """
    known = lying & ~airborne_pixels(outlines, lying.shape) & (trust > TRUSTED)
    if not outlines or known.sum() < FEWEST:
        return False
    flow, weight = motion[known], trust[known]
    if np.linalg.norm(weight @ flow) < ONE_WAY * float(weight @ np.linalg.norm(flow, axis=1)):
        return False
    m = round(BLUR)
    inwards = [
        (known[:, :m], motion[:, :m, 0]), (known[:, -m:], -motion[:, -m:, 0]),
        (known[:m], motion[:m, :, 1]), (known[-m:], -motion[-m:, :, 1]),
    ]  # fmt: skip
    over = np.concatenate([speed[seen] for seen, speed in inwards])
    slow = 0.1 * float(np.median(np.linalg.norm(flow, axis=1)))
    return float((over > slow).sum()) < ENTERS * m * float(np.sqrt(known.sum()))


def find_neck(mask: Bool[np.ndarray, "h w"], *, pitch: float = 35.0) -> JetOutline | None:
    """Threads that hang into a wide puddle, from the silhouette alone; None where it does not show them.

    For jets without texture: a narrow part at the top of the mask (rows at most `NECK_SHARE` as wide as the widest),
    above a body that holds most of it and is wider than it is tall, as a puddle on the ground looks. The silhouette
    shows the neck down to the far edge of the puddle; the foot is inside it, by its own width at least.

    Args:
        mask: fluid pixels.
        pitch: degrees that the camera looks down; the puddle is foreshortened by its sine.
    """
    rows = np.flatnonzero(mask.any(axis=1))
    if len(rows) < 20:
        return None
    label, _ = cast(tuple[np.ndarray, int], ndimage.label(mask))
    mask = label == np.argmax(np.bincount(label[mask]))
    rows = np.flatnonzero(mask.any(axis=1))
    widths = mask.sum(axis=1)[rows].astype(float)
    widest = float(np.percentile(widths, 95))
    wide = widths > NECK_SHARE * widest
    first = int(np.argmax(wide))
    body = mask.copy()
    body[: rows[first]] = False
    box = np.flatnonzero(body.any(axis=1)), np.flatnonzero(body.any(axis=0))
    lies = body.sum() >= BODY_SHARE * mask.sum() and len(box[0]) <= len(box[1])
    if not lies or first < max(6, 0.02 * mask.shape[0]):
        return None
    neck = mask & ~body
    middle, width = float(np.median(np.nonzero(neck)[1]) + 0.5), float(np.median(neck.sum(axis=1)[rows[:first]]))
    foot = float(rows[first]) + width * float(np.sin(np.radians(pitch)))
    y, x = np.mgrid[0.5 : mask.shape[0], 0.5 : mask.shape[1]]
    over = body & (y < foot) & (np.abs(x - middle) < 0.5 * width)
    # the far edge of the puddle shows on both sides of the threads; what falls gets narrower, not wider
    neck &= np.abs(x - middle) < 0.75 * width
    outline = _stations(neck | over, np.array([0.0, 1.0]), np.array([-1.0, 0.0]), -middle, (float(rows[0]), foot, foot))
    return replace(outline, half_widths=np.minimum.accumulate(outline.half_widths))


def airborne_pixels(outlines: list[JetOutline], shape: tuple[int, int]) -> Bool[np.ndarray, "h w"]:
    """All pixels of the jets."""
    out = np.zeros(shape, bool)
    for outline in outlines:
        out |= outline.pixels
    return out


def lying_pixels(mask: Bool[np.ndarray, "h w"], airborne: Bool[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
    """The lying part of the mask, with what jets hide of it: their pixels below the line that joins the far edges of
    the lying part on both sides."""
    lying = mask & ~airborne
    if not airborne.any() or not lying.any():
        return lying
    cols = np.flatnonzero(lying.any(axis=0))
    edge = np.argmax(lying, axis=0)
    shadowed = np.any(airborne, axis=0)
    free = cols[~shadowed[cols]]
    if len(free) == 0:
        return lying
    outside = np.where((free[0] <= np.arange(mask.shape[1])) & (np.arange(mask.shape[1]) <= free[-1]), 0, mask.shape[0])
    line = np.maximum(np.interp(np.arange(mask.shape[1]), free, edge[free]), outside)
    return lying | (airborne & (np.arange(mask.shape[0])[:, None] >= line[None]))


def roll_of(outlines: list[JetOutline], camera: PinholeCamera) -> float:
    """Degrees clockwise by which the picture is turned, as far as jets say so against the habit of holding a camera
    level (`view.habit.ROLL`); weighted by how well an axis is known from an outline of its length and width.

    Args:
        outlines: of the jets.
        camera: without roll, tilted as it is believed to be.
    """
    down = projected_vertical(camera)
    total, weight = 0.0, 1.0 / ROLL**2
    for outline in outlines:
        axis = outline.centers[-1] - outline.centers[0]
        length = float(np.linalg.norm(axis))
        u, v = np.mean(outline.centers, axis=0)
        expected = down[int(np.clip(v, 0, down.shape[0] - 1)), int(np.clip(u, 0, down.shape[1] - 1))]
        cross, dot = expected[0] * axis[1] - expected[1] * axis[0], expected @ axis
        error = 2.0 + np.degrees(np.arctan2(0.5 * float(np.median(outline.half_widths)), max(length, 1e-6)))
        total += np.degrees(np.arctan2(cross, dot)) / error**2
        weight += 1.0 / error**2
    return float(total / weight)
