"""The surface of a liquid straight from its splats, without a mesh.

As in Gaussian Splashing (Feng et al. 2024, arXiv 2401.15318), splats carry normals and a thickness that adds up along
the line of sight instead of hiding what lies behind. Here the thickness has a scale: a Gaussian stands for a volume,
and a ray gets the share of it that the Gaussian's line integral gives, so that a full body measures what it is thick.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from jaxtyping import Float

from fluidlift.errors import require
from fluidlift.look.liquid import SurfaceBuffer
from fluidlift.look.project import sound
from fluidlift.look.smoothstep import smoothstep
from fluidlift.look.solid_contact import carried_on
from fluidlift.look.transparent_kernels import far_normals, rated
from fluidlift.numerics.nearest import nearest
from fluidlift.numerics.sharing import shared
from fluidlift.numerics.splatting import Bins, Projected, SplatCamera, bin_tiles, project
from fluidlift.numerics.splatting_kernels import TILE, exp_negative
from fluidlift.numerics.splatting_projection import REACH_MAX
from fluidlift.numerics.srgb import linear_from_srgb
from fluidlift.types.camera import PinholeCamera
from fluidlift.types.gaussians import Gaussians

SKIN = 1.5
"""spacings of liquid whose middle tells where the surface is: less is grainy, more is blunt"""
WIDTHS = (0.5, 0.9)
"""standard deviations, spacings, in which a Gaussian is drawn here: under the first a full body shows grain, and over
the second its outline swells"""
GRAIN = 1.0
"""spacings, standard deviation by which the thickness is blurred in the picture: splats in rows would show as grain"""
COVERED = (0.15, 0.8)
"""spacings of liquid on the ray at which a pixel begins to be, and is, covered: a lone particle has 0.6 in its middle,
a film of one layer 1. Outlines of thick bodies stand out by most of a spacing"""
FILM = 0.5
"""spacings: thinner liquid on the ground is no more than the place of its splats can tell, and fades out"""
AWAY = (-0.3, 0.1)
"""cosine to the viewer of the splatted normal up to which nothing is seen (the blurred rim of a body, or its far side
through a gap), and from which all is"""
LEANING = 0.2
"""cosine that normals keep: leaning more they would mirror everything, in a seam around the body"""
BURIED = 1.5
"""spacings behind what hides liquid over which the middle of a Gaussian may lie: on ground that is seen at a slant, and
a little inside it"""
REACH = 2.0
"""spacings, a cell: so far particles keep off solids, up to which a liquid that lies on them is carried on"""
NEIGHBOURS = (7, 18)
"""those whose distances are taken together: from one alone, a lattice's shells would show"""
SAMPLES = 4_000
"""Gaussians at which the volume is measured, at most"""
LEAD = 9
"""numbers of a Gaussian for the loops, before its features: u, v, conic, extents, depth, most of its thickness"""


FARTHEST = np.float32(0.5 * REACH_MAX**2)
"""-log of the share of a Gaussian's height that still counts"""


def splat_surface(
    gaussians: Gaussians,
    normals: Float[np.ndarray, "n 3"],
    camera: PinholeCamera,
    *,
    volume: float | None = None,
    colors: Float[np.ndarray, "n 3"] | None = None,
    far_side: bool = True,
    ground: Float[np.ndarray, "h w"] | None = None,
) -> SurfaceBuffer:
    """The nearest surface of the liquid that Gaussians fill, and how much of it lies behind.

    The first `SKIN` spacings of liquid on each ray tell the surface: it lies half of them before their middle, with
    the mean of their normals and colours.

    Args:
        gaussians: n Gaussians, world, m; broken ones are left out, opacities play no part.
        normals: outward, world, of any length; 0 where a Gaussian knows of no surface.
        camera: who looks.
        volume: m^3 that each Gaussian stands for; None: measured (`mean_volume`).
        colors: linear, carried by the liquid; None: the Gaussians' own (sRGB) made linear.
        far_side: look for the normals there too: light leaves a drop bent once more. Takes about as long again.
            Without it the liquid lies on the ground, and its surface is carried on to where that comes out of it.
        ground: camera z (m; 0: none) of what hides liquid. A Gaussian that lies behind it counts in those pixels
            alone that look past it: a rock before a pond cuts no hole with a blurred rim.

    Raises:
        ValueError: normals or colours of another number, ground of another size, or a volume that is not positive.
    """
    n, (width, height) = len(gaussians), camera.size
    require(np.shape(normals) == (n, 3), f"normals {np.shape(normals)}", f"({n}, 3)")
    if colors is not None:
        require(np.shape(colors) == (n, 3), f"colours {np.shape(colors)}", f"({n}, 3)")
    require(volume is None or (np.isfinite(volume) and volume > 0), f"volume {volume}", "positive m^3")
    ok = sound(gaussians) & np.isfinite(normals).all(1)
    g = gaussians if ok.all() else gaussians.select(ok)
    volume = mean_volume(g.means) if volume is None else volume
    if len(g) == 0 or volume <= 0:
        return _nothing(height, width)
    spacing = volume ** (1.0 / 3.0)
    carried = linear_from_srgb(g.rgb) if colors is None else np.asarray(colors, np.float32)[ok]
    features = np.concatenate([np.asarray(normals, np.float32)[ok], carried], axis=1)
    wall = None
    if ground is not None:
        require(np.shape(ground) == (height, width), f"ground of {np.shape(ground)}", f"({height}, {width})")
        wall = np.where(ground > 0, ground + BURIED * spacing, np.inf).astype(np.float32)
    total, skin = splatted_thickness(g, features, camera, volume, SKIN * spacing, wall=wall)
    seen = _surface(total, skin, camera, spacing, ground)
    if not far_side:  # it lies on the ground
        return seen if ground is None else carried_on(seen, np.asarray(ground, np.float32), camera, REACH * spacing)
    _, skin = splatted_thickness(g, features[:, :3], camera, volume, SKIN * spacing, far=True, wall=wall)
    back = np.empty((height, width, 3), np.float32)
    far_normals(skin, _eye(camera), LEANING, back)
    return replace(seen, back_normal=back)


def _even(
    thickness: np.ndarray, depth: np.ndarray, camera: PinholeCamera, spacing: float, ground: np.ndarray | None
) -> np.ndarray:
    """Without the grain of single splats, by as many px as suit the middle of the depths; the sum stays. Pixels of
    the ground (m; 0, None: none) that show no liquid have no say: behind a rock liquid is as thick as beside it."""
    import cv2

    there = depth > 0
    if not there.any():
        return thickness
    px = GRAIN * spacing * max(camera.focal) / float(np.median(depth[there]))
    sigma = max(min(px, 0.05 * max(camera.size)), 0.1)
    reach = 2 * int(3.0 * sigma + 0.5) + 1

    def bell(picture: np.ndarray) -> np.ndarray:
        picture = np.ascontiguousarray(picture, np.float32)
        return cv2.GaussianBlur(picture, (reach, reach), sigma, borderType=cv2.BORDER_CONSTANT)

    if ground is None or not (ground > 0).any():
        return bell(thickness)
    counts = (there | (ground <= 0)).astype(np.float32)
    return bell(thickness * counts) / np.maximum(bell(counts), 1e-3)


def mean_volume(positions: Float[np.ndarray, "n 3"]) -> float:
    """m^3 that each particle of a liquid stands for, from the distances of neighbours inside it; 0 of fewer than 19.

    Particles whose neighbours lie to one side are at a surface, and have too few; only the others count, if there are
    any. Good to some per cent: where the spacing of the simulation is known, its cube is better.
    """
    low, high = NEIGHBOURS
    if len(positions) <= high:
        return 0.0
    some = positions[:: max(1, len(positions) // SAMPLES)]
    distance, near = nearest(positions, some, high + 1, workers=-1)
    aside = np.linalg.norm(positions[near[:, 1:]].mean(axis=1) - some, axis=1)
    inside = aside < 0.15 * distance[:, -1]
    reach = distance[inside] if inside.sum() >= 10 else distance
    # of the particle itself, k - 1 others and the k-th on the ball, half of which lies inside
    each = 4.0 / 3.0 * math.pi * reach[:, low:] ** 3 / (np.arange(low, high + 1) + 0.5)
    return float(np.median(each.mean(axis=1)))


def splatted_thickness(
    gaussians: Gaussians,
    features: Float[np.ndarray, "n c"],
    camera: PinholeCamera,
    volume: float,
    skin: float,
    *,
    far: bool = False,
    wall: Float[np.ndarray, "h w"] | None = None,
) -> tuple[Float[np.ndarray, "h w"], Float[np.ndarray, "h w 2+c"]]:
    """Metres of liquid on each ray, and the first `skin` metres of them (with `far`: the last): how much was found, and
    the sums over it of depth (camera z, m) and features, each times metres. wall: depth up to which Gaussians count in
    a pixel (float32; None: all do).

    The integral of a Gaussian of volume V along camera z is V N(u, v) du dv / dx dy: the normal distribution in the
    picture, of the projected covariance, times the pixels that a square metre has at its depth.
    """
    width, height = camera.size
    stretch = np.linalg.norm(camera.rays(camera.pixel_grid()), axis=-1).astype(np.float32)
    total = np.zeros((height, width), np.float32)
    wall = np.full((height, width), np.inf, np.float32) if wall is None else wall
    first = np.zeros((height, width, 2 + features.shape[1]), np.float32)
    found = _projected(gaussians, camera, volume)
    for part, bins, pairs in _in_order(found, np.flatnonzero(found.extents[:, 0] > 0), camera.size, far):
        packed = _packed(found, part, features, camera, volume)
        thickness_kernel(packed, bins.starts, pairs, far, np.float32(skin), (stretch, wall), total, first)
    return total, first


def _projected(gaussians: Gaussians, camera: PinholeCamera, volume: float) -> Projected:
    spacing = volume ** (1.0 / 3.0)
    scales = np.clip(gaussians.scales, WIDTHS[0] * spacing, WIDTHS[1] * spacing).astype(np.float32)
    opaque = np.ones(len(gaussians), np.float32)
    return project(SplatCamera.of(camera), gaussians.means, gaussians.quats, scales, opaque)


def _in_order(
    found: Projected, some: np.ndarray, size: tuple[int, int], far: bool
) -> Iterator[tuple[np.ndarray, Bins, np.ndarray]]:
    """Drawn Gaussians, nearest first, in as many parts as memory asks for; the tiles that each part meets. With `far`
    the farthest part comes first."""
    part = Projected(found.means[some], found.conics[some], found.depths[some], found.extents[some])
    bins = bin_tiles(part, size)
    if bins.whole is not None:
        yield some[bins.order], bins, bins.whole.gaussians
        return
    order = some[np.argsort(found.depths[some], kind="stable")]
    halves = [order[: len(order) // 2], order[len(order) // 2 :]]
    for half in reversed(halves) if far else halves:
        yield from _in_order(found, half, size, far)


def _packed(
    found: Projected, part: np.ndarray, features: np.ndarray, camera: PinholeCamera, volume: float
) -> Float[np.ndarray, "m 9+c"]:
    """What the loops read of the Gaussians of a part."""
    conic, depth = found.conics[part].astype(np.float64), found.depths[part].astype(np.float64)
    root = np.sqrt(np.maximum(conic[:, 0] * conic[:, 2] - conic[:, 1] ** 2, 0.0))
    most = volume * camera.focal[0] * camera.focal[1] / depth**2 * root / (2 * math.pi)
    columns = [found.means[part], conic, found.extents[part], depth[:, None], most[:, None], features[part]]
    return np.ascontiguousarray(np.concatenate(columns, axis=1), np.float32)


@shared(lambda packed, starts, *_: (0, len(starts) - 1), fastmath={"contract", "reassoc"}, error_model="numpy")
def thickness_kernel(begin, end, packed, starts, gaussians, backwards, skin, rays, total, first):
    """`thickness_plain`, tile by tile, in rows of 16 pixels without branches (see `numerics.splatting_kernels`).
    `backwards`: the farthest first; rays: metres per metre of camera z, and the depth up to which Gaussians count."""
    height, width = total.shape
    stretch, wall = rays
    tiles_x = -(-width // TILE)
    half, none, channels = np.float32(0.5), np.float32(0.0), first.shape[2]
    for t in range(begin, end):
        if starts[t] == starts[t + 1]:
            continue
        x0, y0 = (t % tiles_x) * TILE, (t // tiles_x) * TILE
        rows, columns = min(TILE, height - y0), min(TILE, width - x0)
        away, found = np.zeros((TILE, TILE), np.float32), np.zeros((TILE, TILE), np.float32)
        ends = np.zeros((TILE, TILE), np.float32)
        sums, share = np.zeros((TILE, channels, TILE), np.float32), np.zeros(TILE, np.float32)
        for i in range(rows):
            for j in range(columns):
                away[i, j], found[i, j] = stretch[y0 + i, x0 + j], total[y0 + i, x0 + j]
                ends[i, j] = wall[y0 + i, x0 + j]
                for c in range(channels):
                    sums[i, c, j] = first[y0 + i, x0 + j, c]
        for n in range(starts[t], starts[t + 1]):
            k = gaussians[starts[t] + starts[t + 1] - 1 - n] if backwards else gaussians[n]
            u, v, a, b, c = packed[k, 0], packed[k, 1], packed[k, 2], packed[k, 3], packed[k, 4]
            hy, z, most = packed[k, 6], packed[k, 7], packed[k, 8]
            above = max(0, np.int64(math.ceil(v - hy - half)) - y0)
            below = min(rows - 1, np.int64(math.floor(v + hy - half)) - y0)
            for i in range(above, below + 1):
                dy = np.float32(y0 + i) + half - v
                bend, rise = b * dy, half * c * dy * dy
                px, taken = np.float32(x0) + half - u, none
                for j in range(np.uint64(TILE)):
                    dx = np.float32(np.int32(j)) + px
                    power = (half * a * dx + bend) * dx + rise
                    metres = most * exp_negative(min(max(power, none), FARTHEST)) * away[i, j]
                    metres = metres if power <= FARTHEST and z <= ends[i, j] else none
                    found[i, j] += metres
                    share[j] = max(min(metres, skin - sums[i, 0, j]), none)
                    taken += share[j]
                if taken > none:
                    for j in range(np.uint64(TILE)):
                        sums[i, 0, j] += share[j]
                    for f in range(1, channels):
                        value = packed[k, 7] if f == 1 else packed[k, LEAD - 2 + f]  # depth, then the features
                        for j in range(np.uint64(TILE)):
                            sums[i, f, j] += share[j] * value
        for i in range(rows):
            for j in range(columns):
                total[y0 + i, x0 + j] = found[i, j]
                for c in range(channels):
                    first[y0 + i, x0 + j, c] = sums[i, c, j]


def thickness_plain(packed, skin, rays, total, first) -> None:
    """Add up thickness, and fill the skin front to back: the twin of `thickness_kernel`, for reading."""
    (height, width), (stretch, wall) = total.shape, rays
    u, v = np.arange(width, dtype=np.float32) + 0.5, np.arange(height, dtype=np.float32)[:, None] + 0.5
    for one in packed:
        dx, dy = u - one[0], v - one[1]
        power = 0.5 * (one[2] * dx * dx + one[4] * dy * dy) + one[3] * dx * dy
        metres = np.where((power <= FARTHEST) & (one[7] <= wall), one[8] * np.exp(-power) * stretch, 0.0)
        total += metres
        share = np.maximum(np.minimum(metres, skin - first[..., 0]), 0.0)
        first += share[..., None] * np.concatenate([[1.0, one[7]], one[LEAD:]]).astype(np.float32)


def _surface(
    total: np.ndarray, skin: np.ndarray, camera: PinholeCamera, spacing: float, ground: np.ndarray | None
) -> SurfaceBuffer:
    """Sums along the rays to the surface that they make."""
    covered, depth = np.empty_like(total), np.empty_like(total)
    normal, albedo = (np.empty((*total.shape, 3), np.float32) for _ in range(2))
    numbers = np.array([*(spacing * share for share in COVERED), *AWAY, LEANING])
    rated(total, skin, _eye(camera), numbers, covered, depth, normal, albedo)
    thickness = np.where(covered > 0, _even(total, depth, camera, spacing, ground), 0.0)
    return SurfaceBuffer(np.maximum(depth, 0.0), normal, thickness, albedo, covered, grain=FILM * spacing)


def _eye(camera: PinholeCamera) -> tuple[np.ndarray, np.ndarray]:
    lens = np.array([*camera.focal, *camera.center], np.float64)
    return lens, np.ascontiguousarray(camera.camera_from_world.rotation, np.float64)


def rated_plain(
    total: Float[np.ndarray, "h w"], skin: Float[np.ndarray, "h w 8"], camera: PinholeCamera, spacing: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Cover, depth (m), normal and colour of a surface, from metres of liquid on each ray and sums over its skin
    (`splatted_thickness`): the twin of `transparent_kernels.rated`, for reading."""
    rays = camera.rays(camera.pixel_grid())
    away = np.linalg.norm(rays, axis=-1)
    toward = -rays / away[..., None]
    rim = smoothstep(_cosine(skin[..., 2:5], toward), *AWAY)
    covered = smoothstep(total / spacing, *COVERED) * rim
    found = np.maximum(skin[..., 0], 1e-12)
    there = covered > 0
    # half of the skin lies before its middle; metres along the ray are more than those of camera z
    depth = np.where(there, skin[..., 1] / found - 0.5 * skin[..., 0] / away, 0.0)
    albedo = np.clip(skin[..., 5:8] / found[..., None], 0.0, 1.0) * there[..., None]
    return covered, depth, facing_plain(skin[..., 2:5], toward), albedo


def _cosine(vectors: np.ndarray, toward: np.ndarray) -> np.ndarray:
    """To `toward`; 1 where there is no vector."""
    return np.einsum("hwk,hwk->hw", _unit(vectors, toward), toward)


def facing_plain(vectors: np.ndarray, toward: np.ndarray) -> np.ndarray:
    """Unit normals on the side of `toward`, at least by `LEANING`."""
    normal = _unit(vectors, toward)
    cosine = np.clip(np.einsum("hwk,hwk->hw", normal, toward), -1.0, 1.0)[..., None]
    across = _unit(normal - cosine * toward, np.zeros_like(toward))
    kept = LEANING * toward + np.sqrt(1 - LEANING**2) * across
    return _unit(np.where(cosine < LEANING, kept, normal), toward)


def _unit(vectors: np.ndarray, otherwise: np.ndarray) -> np.ndarray:
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return np.where(length > 1e-9, vectors / np.maximum(length, 1e-9), otherwise)


def _nothing(height: int, width: int) -> SurfaceBuffer:
    flat, deep = np.zeros((height, width), np.float32), np.zeros((height, width, 3), np.float32)
    return SurfaceBuffer(flat, deep, flat, deep, flat)
