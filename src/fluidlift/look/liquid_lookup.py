"""What `liquid_kernels` looks up in the picture behind a liquid: its colour, and how high the liquid stands over it
(Numba). In NumPy: `liquid.film_shown`.
"""

# pyright: reportCallIssue=false
# numba's stub of `njit` does not know `_nrt`, without which a kernel does not count references to arrays

from __future__ import annotations

import math

import numba as nb
import numpy as np
from jaxtyping import Float, Int

from fluidlift.look.smoothstep import eased

SLANTED = 12.0
"""grains along the line of sight from which on liquid is thicker than one, seen ever so slanting (5 degrees)"""
SMALLEST = 8
"""px, rows and columns of the smallest picture"""
MARCHED, HALVED = 16, 5
"""steps on the way to what is hidden, and times that the one with its outline is halved at least: to a pixel of 512"""
BLURRED = 2.0
"""px over which a picture that is enlarged mixes what it shows"""
RIM = 0.5
"""pictures beyond its rim at which a picture that goes on is no more than its mean"""


def pyramid(
    image: Float[np.ndarray, "h w 3"], *, deep: bool
) -> tuple[Float[np.ndarray, " values"], Int[np.ndarray, "k 3"]]:
    """A picture, and with `deep` ever smaller ones of it, each half as wide and high, one after the other in one array;
    of each where it begins, its rows and its columns (Williams 1983)."""
    import cv2

    levels: list[np.ndarray] = [np.ascontiguousarray(image, np.float32)]
    while deep and min(levels[-1].shape[:2]) >= 2 * SMALLEST:
        rows, columns = levels[-1].shape[:2]
        levels.append(cv2.resize(levels[-1], (columns // 2, rows // 2), interpolation=cv2.INTER_AREA))
    sizes = np.array([level.shape[:2] for level in levels], np.int64)
    starts = np.concatenate([[0], np.cumsum(3 * sizes.prod(axis=1))[:-1]])
    values = levels[0].reshape(-1) if len(levels) == 1 else np.concatenate([level.reshape(-1) for level in levels])
    return values, np.column_stack([starts, sizes]).astype(np.int64)


@nb.njit(cache=True, error_model="numpy", _nrt=False)
def _fetch(values, levels, k, u, v):
    """Colour at u, v (px of the first picture) of the k-th one: bilinear, held at the rim."""
    start, h, w = levels[k, 0], levels[k, 1], levels[k, 2]
    if k > 0:
        u, v = u * (w / levels[0, 2]), v * (h / levels[0, 1])
    x, y = min(max(u - 0.5, 0.0), w - 1.0), min(max(v - 0.5, 0.0), h - 1.0)
    j, i = min(int(x), max(w - 2, 0)), min(int(y), max(h - 2, 0))
    a, b = x - j, y - i
    n0, across, down = start + 3 * (i * w + j), 3 * (min(j + 1, w - 1) - j), 3 * w * (min(i + 1, h - 1) - i)
    p, q, r, s = (1.0 - a) * (1.0 - b), a * (1.0 - b), (1.0 - a) * b, a * b
    n1, n2, n3 = n0 + across, n0 + down, n0 + across + down
    return (
        p * values[n0] + q * values[n1] + r * values[n2] + s * values[n3],
        p * values[n0 + 1] + q * values[n1 + 1] + r * values[n2 + 1] + s * values[n3 + 1],
        p * values[n0 + 2] + q * values[n1 + 2] + r * values[n2 + 2] + s * values[n3 + 2],
    )


@nb.njit(cache=True, error_model="numpy", _nrt=False)
def fetch_beyond(values, levels, u, v, wide, rest, out, at):
    """The colour of `pyramid`'s picture over some `wide` px around u, v, and beyond the rim ever more of the mean of a
    picture that goes on there (rest: its colour and 1; 0: it does not go on)."""
    level = min(math.log2(wide), levels.shape[0] - 1.0) if wide > 1.0 else 0.0
    k = int(level)
    out[at], out[at + 1], out[at + 2] = _fetch(values, levels, k, u, v)
    if level > k:
        r, g, b = _fetch(values, levels, k + 1, u, v)
        share = level - k
        out[at] += share * (r - out[at])
        out[at + 1] += share * (g - out[at + 1])
        out[at + 2] += share * (b - out[at + 2])
    if rest[3] > 0.0:
        h, w = levels[0, 1], levels[0, 2]
        off = math.sqrt((max(-u, u - w, 0.0) / w) ** 2 + (max(-v, v - h, 0.0) / h) ** 2)
        share = min(off / RIM, 1.0)
        for k in range(3):
            out[at + k] += share * (rest[k] - out[at + k])


@nb.njit(cache=True, inline="always")
def hides(depth, liquid, rests, i, j, front):
    """Whether what a pixel shows is nearer than `front`, or of what a liquid rests on, out of that liquid (whose
    depths are `liquid`)."""
    z = depth[i, j]
    return 0.0 < z and (z < front or (rests and not 0.0 < liquid[i, j] <= z))


@nb.njit(cache=True, inline="always")
def borders(depth, i, j, u, v, front):
    """Whether the colour at u, v (px), between pixel i, j and its neighbours, is in part that of something nearer."""
    m = min(i + 1, depth.shape[0] - 1) if v - i > 0.5 else max(i - 1, 0)
    n = min(j + 1, depth.shape[1] - 1) if u - j > 0.5 else max(j - 1, 0)
    return 0.0 < depth[m, j] < front or 0.0 < depth[i, n] < front


@nb.njit(cache=True, inline="always")
def blurred_end(start, u, v, coarse):
    """As far on from `start` through u, v (px) as a picture that was enlarged `coarse` times is mixed with what is
    there."""
    x, y = u - start[0], v - start[1]
    away = math.sqrt(x * x + y * y)
    if coarse <= 1.0 or away < 1e-6:
        return u, v
    on = 1.0 + BLURRED * (coarse - 1.0) / away
    return start[0] + on * x, start[1] + on * y


@nb.njit(cache=True, error_model="numpy", _nrt=False)
def seen_beside(start, end, depth, front, far, liquid, rests, coarse):
    """Where (px) to look for what something before it hides at `end`: the middle of the last pixel on the line from
    `start` where nothing hides (`hides`) the ray, from `front` to `far`, where it leaves the liquid.

    What is hidden is taken for what is seen beside its outline: taken from anywhere else, it would stand around every
    rock as a band with an edge. In a picture that was enlarged, so many times (`coarse`), what hides reaches over its
    outline by up to `BLURRED` of the former pixels.
    """
    u, v = end
    h, w = depth.shape
    free, hidden = 0.0, 1.0
    for n in range(1, MARCHED + HALVED):  # the first outline: behind one rock stands another
        s = n / MARCHED if hidden == 1.0 and n < MARCHED else 0.5 * (free + hidden)
        i = min(max(int(start[1] + s * (v - start[1])), 0), h - 1)
        j = min(max(int(start[0] + s * (u - start[0])), 0), w - 1)
        if hides(depth, liquid, rests, i, j, front + s * (far - front)):
            hidden = s
        else:
            free = s
    free -= min(BLURRED * (coarse - 1.0) / max(math.hypot(u - start[0], v - start[1]), 1e-9), free)
    i = min(max(int(start[1] + free * (v - start[1])), 0), h - 1)
    j = min(max(int(start[0] + free * (u - start[0])), 0), w - 1)
    return j + 0.5, i + 0.5


@nb.njit(cache=True, inline="always")
def _flatter(before, own, after):
    """Slope per pixel of what a pixel shows, of the side on which it changes less; a value that is not above 0 is none.
    Across the edge of what stands there one side is another thing."""
    left = own - before if before > 0.0 else math.inf
    right = after - own if after > 0.0 else math.inf
    slope = left if abs(left) < abs(right) else right
    return slope if abs(slope) < math.inf else 0.0


@nb.njit(cache=True, inline="always")
def _inverse(depth, i, j):
    """Inverse depth; 0: infinitely far, or beyond the rim."""
    if i < 0 or j < 0 or i >= depth.shape[0] or j >= depth.shape[1] or depth[i, j] <= 0.0:
        return 0.0
    return 1.0 / depth[i, j]


@nb.njit(cache=True, error_model="numpy", forceinline=True, _nrt=False)
def shown_of_film(i, j, z, depth, lens, grain):
    """Share, 0 to 1, that is seen of liquid at depth z: it goes to 0 with the liquid's height over what it lies on.

    The height is measured across the plane that the picture behind shows there: n . p = 1 with the slopes of its
    inverse depth for n, from which the point p lies (1 - n . p) / |n| away.
    """
    if grain <= 0.0 or depth[i, j] <= 0.0 or depth[i, j] - z > SLANTED * grain:
        return 1.0
    own = _inverse(depth, i, j)
    x = lens[0] * _flatter(_inverse(depth, i, j - 1), own, _inverse(depth, i, j + 1))
    y = lens[1] * _flatter(_inverse(depth, i - 1, j), own, _inverse(depth, i + 1, j))
    along = own - (j + 0.5 - lens[2]) / lens[0] * x - (i + 0.5 - lens[3]) / lens[1] * y
    return eased((1.0 - z * own) / (grain * math.sqrt(x * x + y * y + along * along)))
