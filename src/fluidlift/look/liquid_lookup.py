"""What `liquid_kernels` looks up in the picture behind a liquid: its colour, and how high the liquid stands over it
(Numba). In NumPy: `liquid.film_shown`.
"""

from __future__ import annotations

import math

import numba as nb

from fluidlift.look.smoothstep import eased

SLANTED = 12.0
"""grains along the line of sight from which on liquid is thicker than one, seen ever so slanting (5 degrees)"""
RIM = 0.5
"""pictures beyond its rim at which a picture that goes on is no more than its mean"""


@nb.njit(cache=True, error_model="numpy", _nrt=False)
def _fetch(image, u, v, out, at):
    """Bilinear, held at the rim."""
    h, w = image.shape[0], image.shape[1]
    x, y = min(max(u - 0.5, 0.0), w - 1.0), min(max(v - 0.5, 0.0), h - 1.0)
    j, i = min(int(x), max(w - 2, 0)), min(int(y), max(h - 2, 0))
    a, b = x - j, y - i
    j1, i1 = min(j + 1, w - 1), min(i + 1, h - 1)
    for k in range(3):
        upper = (1.0 - a) * image[i, j, k] + a * image[i, j1, k]
        lower = (1.0 - a) * image[i1, j, k] + a * image[i1, j1, k]
        out[at + k] = (1.0 - b) * upper + b * lower


@nb.njit(cache=True, error_model="numpy", _nrt=False)
def fetch_beyond(image, u, v, rest, out, at):
    """`_fetch`, and beyond the rim ever more of the mean of a picture that goes on there (rest: its colour and 1; 0: it
    does not go on)."""
    _fetch(image, u, v, out, at)
    if rest[3] > 0.0:
        h, w = image.shape[0], image.shape[1]
        off = math.sqrt((max(-u, u - w, 0.0) / w) ** 2 + (max(-v, v - h, 0.0) / h) ** 2)
        share = min(off / RIM, 1.0)
        for k in range(3):
            out[at + k] += share * (rest[k] - out[at + k])


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
