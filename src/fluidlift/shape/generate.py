"""The embedded generator: from a picture, a mask and a model of the front surface to Gaussians, without any weights."""

from __future__ import annotations

from dataclasses import dataclass
from typing import cast

import numpy as np
from jaxtyping import Bool, Float, UInt8
from scipy import ndimage, sparse
from scipy.sparse.linalg import splu

from fluidlift.errors import require
from fluidlift.numerics.over_time import median_over_time, sorted_over_time
from fluidlift.shape.background import weight_of_unseen
from fluidlift.types import SH_C0, CellType, Gaussians, PinholeCamera, Setting, decompose_covariances, sh_from_rgb
from fluidlift.types.fluid_masks import FluidMasks

COARSE = 256
"""px on the longer side of the picture in which a hole is filled, at most"""

ALONG_ROWS = 9.0
"""times better conducts the filling of a hole along rows than along columns"""

_WET = (CellType.FLUID, CellType.INFLOW)


MIXED = 2
"""px around the fluid whose colours lens and coding mix with it"""

SHORE = 5
"""px inside wide fluid up to which the plate is the clip's picture: the outermost splats are 2 to 3 px wide, and the
blend into what is inpainted reaches 3 px. Begun outside, a line of painted ground ran along masks that are too small"""

WIDE = 3 * SHORE
"""px from the rim, at least, in the middle of wide fluid. A thread or a jet would stay in the plate as a whole"""


@dataclass(frozen=True)
class BackgroundPlate:
    """The scene without its fluid."""

    image: UInt8[np.ndarray, "h w 3"]
    """sRGB, inpainted where no frame shows the background"""
    seen: Bool[np.ndarray, "h w"]
    """True where some frame shows the background"""
    kept: Bool[np.ndarray, "h w"]
    """True where the picture is the clip's: what is seen, and the rim of wide fluid"""


def _median_where(frames: UInt8[np.ndarray, "t h w 3"], where: Bool[np.ndarray, "t h w"]) -> UInt8[np.ndarray, "h w 3"]:
    """Median of the frames that count at each pixel, rounded down; 0 where none does."""
    count = where.sum(axis=0)
    # the others go to the end of the order
    order = sorted_over_time(np.where(where[..., None], frames, np.uint8(255)))
    low, high = (
        np.take_along_axis(order, np.maximum(at, 0)[None, ..., None], axis=0)[0].astype(np.uint16)
        for at in ((count - 1) // 2, np.minimum(count // 2, len(frames) - 1))
    )
    return np.where(count[..., None] > 0, (low + high) // 2, 0).astype(np.uint8)


def background_plate(
    frames: UInt8[np.ndarray, "t h w 3"],
    fluid: Bool[np.ndarray, "t h w"] | FluidMasks,
    solid: Bool[np.ndarray, "h w"] | None = None,
    *,
    shore: bool = False,
) -> BackgroundPlate:
    """Median of the frames where they show no fluid; the rest inpainted from the ground around it.

    Along the shore of wide fluid the median of all frames stays: the splats that cover it end about there.

    Args:
        frames: sRGB.
        fluid: per frame.
        solid: still things in the fluid: they stay in the picture, but the bed beside them is not painted with them.
        shore: the fluid lies or falls on ground, and stays there. Of smoke and of jets a rim would be left in the air.
    """
    pick = np.unique(np.linspace(0, len(frames) - 1, min(len(frames), 25)).astype(int))
    covered = np.stack([fluid[t] for t in pick])
    wet = np.stack([ndimage.binary_dilation(c, iterations=MIXED) for c in covered])
    if solid is not None:
        wet &= ~solid
    seen = ~np.all(wet, axis=0)
    median = median_over_time(frames[pick]).astype(np.uint8)
    if not seen.any():
        return BackgroundPlate(median, seen, seen)
    image = _median_where(frames[pick], ~wet)
    beside = np.zeros_like(seen) if solid is None else ndimage.binary_dilation(solid, iterations=3)
    if shore:
        seen = _without_missed(seen, wet.mean(axis=0), image, median, beside)
    ground = seen & ~beside
    kept = seen
    if shore:
        # where the fluid sways, the ground beside it is seen up to what it always covers
        dry = ndimage.binary_dilation(~np.any(covered, axis=0), iterations=SHORE)
        kept = seen | (_rim_of_wide_fluid(np.all(covered, axis=0)) & dry)
    if ground.any() and not seen.all():
        painted = _inpainted(image, ~ground)
        blend = weight_of_unseen(kept)[..., None]
        image = (np.where(seen[..., None], image, median) * (1 - blend) + painted * blend).astype(np.uint8)
    return BackgroundPlate(image, seen, kept)


def _without_missed(
    seen: np.ndarray, share: np.ndarray, image: np.ndarray, usual: np.ndarray, beside: np.ndarray
) -> np.ndarray:
    """What is seen, bool [h,w], without fluid that the masks of a few frames have missed.

    Most of the time fluid is there, and its colours are nearer to those of that fluid than to those of the ground
    around.

    Args:
        seen: pixels that some frame shows without fluid.
        share: [h,w] of the frames in which they are fluid.
        image: [h,w,3], what is seen without it.
        usual: [h,w,3], what is usually seen.
        beside: bool [h,w], what lends the ground no colours.
    """
    doubtful = seen & (share > 0.5)
    sure = seen & ~doubtful & ~beside
    if not doubtful.any() or not sure.any():
        return seen
    ground = _inpainted(image, ~sure).astype(np.float32)
    to_ground, to_fluid = (np.abs(image - other).sum(axis=-1) for other in (ground, usual.astype(np.float32)))
    return seen & ~(doubtful & (to_fluid < to_ground))


def _rim_of_wide_fluid(fluid: Bool[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
    """Pixels within `SHORE` inside, and `MIXED` outside, the outline of fluid that is `WIDE`."""
    inside = ndimage.distance_transform_edt(np.pad(fluid, 1, mode="edge"))[1:-1, 1:-1]
    wide = ndimage.distance_transform_edt(inside < WIDE) <= WIDE + MIXED
    return wide & (inside <= SHORE)


def _inpainted(image: np.ndarray, hole: np.ndarray) -> np.ndarray:
    """The hole filled by diffusion from its rim, three times as far along rows as along columns.

    What is behind a fluid that stands is layered by height, sky over trees over a shore: it goes on sideways. Diffusion
    has no seams, where fronts that march in from the rim meet in some. It is solved at a quarter of the size or less.
    """
    import cv2

    h, w = hole.shape
    factor = max(4.0, max(h, w) / COARSE)
    small = (max(int(w / factor), 8), max(int(h / factor), 8))
    coarse = cv2.resize(hole.astype(np.float32), small, interpolation=cv2.INTER_AREA) > 0.01
    if coarse.all():
        return image
    filled = cv2.resize(image, small, interpolation=cv2.INTER_AREA).astype(np.float64)
    filled[coarse] = _diffused(filled, coarse)
    wide = cv2.resize(filled, (w, h), interpolation=cv2.INTER_CUBIC)
    return np.clip(np.round(wide), 0, 255).astype(np.uint8)


def _diffused(values: np.ndarray, hole: np.ndarray) -> np.ndarray:
    """[n,c] in a hole, bool [h,w], of values [h,w,c]: the weights of neighbours in a row are `ALONG_ROWS`, else 1."""
    number = np.arange(hole.size).reshape(hole.shape)
    pairs = [(number[:, :-1], number[:, 1:], ALONG_ROWS), (number[:-1], number[1:], 1.0)]
    i, j = np.concatenate([a.ravel() for a, _, _ in pairs]), np.concatenate([b.ravel() for _, b, _ in pairs])
    weight = np.concatenate([np.full(a.size, w) for a, _, w in pairs])
    edges = sparse.coo_array((np.tile(weight, 2), (np.append(i, j), np.append(j, i))), (hole.size, hole.size)).tocsr()
    inside, rim = np.flatnonzero(hole), np.flatnonzero(~hole)
    rows = edges[inside]
    system = sparse.diags_array(rows.sum(axis=1)) - rows[:, inside]
    given = rows[:, rim] @ values.reshape(hole.size, -1)[rim]
    return splu(system.tocsc()).solve(np.asarray(given, np.float64))


def front_gaussians(
    frame: UInt8[np.ndarray, "h w 3"],
    mask: Bool[np.ndarray, "h w"],
    depth: Float[np.ndarray, "h w"],
    camera: PinholeCamera,
    *,
    stride: int = 1,
) -> Gaussians:
    """One flat Gaussian per pixel block on the visible surface, as large as the block is there.

    Args:
        frame: the picture that gives the colours.
        mask: fluid.
        depth: camera z, m (positive on the mask).
        camera: in the world.
        stride: width of a block, px.
    """
    require(depth.shape == mask.shape, f"depth {depth.shape} for a mask {mask.shape}")
    ok = mask & (depth > 0)
    if not ok.any():
        return Gaussians.empty()
    index = ndimage.distance_transform_edt(~ok, return_distances=False, return_indices=True)
    whole = depth[tuple(index)]  # derivatives at the rim use values from inside
    points = camera.unproject(camera.pixel_grid(), whole)
    du, dv = np.gradient(points, axis=1) * stride, np.gradient(points, axis=0) * stride
    rows, cols = np.mgrid[stride // 2 : mask.shape[0] : stride, stride // 2 : mask.shape[1] : stride]
    keep = ok[rows, cols]
    rows, cols = rows[keep], cols[keep]
    a, b = du[rows, cols], dv[rows, cols]
    footprint = whole[rows, cols] / camera.focal[0] * stride
    for edge in (a, b):  # a depth jump between neighbours is not a long Gaussian
        length = np.linalg.norm(edge, axis=1, keepdims=True)
        edge *= np.minimum(1.0, 4.0 * footprint[:, None] / np.maximum(length, 1e-12))
    normal = np.cross(a, b)
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
    thin = 0.25 * footprint
    covariance = 0.3 * (_outer(a) + _outer(b)) + _outer(normal * thin[:, None])
    quats, scales = decompose_covariances(covariance, floor=(0.02 * float(np.median(footprint))) ** 2)
    colours = frame[rows, cols].astype(np.float32) / 255.0
    return Gaussians(points[rows, cols], quats, scales, np.full(len(rows), 0.95), sh_from_rgb(colours))


def _outer(v: np.ndarray) -> np.ndarray:
    return v[:, :, None] * v[:, None, :]


def hull_gaussians(
    frame: UInt8[np.ndarray, "h w 3"],
    setting: Setting,
    camera: PinholeCamera,
    *,
    shade: float = 0.85,
    seed: int = 0,
) -> Gaussians:
    """Gaussians on the sides of the body that the camera does not see: its bed, its ends, what lies off the picture.

    The cells of the body next to another kind of cell are sampled at half the grid spacing; colours come from the
    picture along the line of sight (the nearest pixel for what lies outside it), as wide a mean as the Gaussian looks,
    darkened a little below the surface.
    """
    grid = setting.terrain.grid
    wet = body_cells(setting)
    rim = wet & ~ndimage.binary_erosion(wet, border_value=0)
    base = np.argwhere(rim)
    if len(base) == 0:
        return Gaussians.empty()
    rng = np.random.default_rng(seed)
    offsets = np.array([[i, j, k] for i in (0.25, 0.75) for j in (0.25, 0.75) for k in (0.25, 0.75)])
    local = (base[:, None] + offsets[None]).reshape(-1, 3) + rng.uniform(-0.08, 0.08, (len(base) * 8, 3))
    points = grid.low + local * grid.spacing
    below = None
    if setting.surface_height is not None:
        column = np.repeat(base[:, :2], 8, axis=0)
        level = setting.surface_height[column[:, 0], column[:, 1]]
        middle = grid.low[2] + (np.repeat(base[:, 2], 8) + 0.5) * grid.spacing
        falls = middle >= level  # cells above the surface belong to jets
        keep = falls | (points[:, 2] < level)
        points, below = points[keep], np.where(falls, 0.0, level - points[:, 2])[keep]
    colours = picture_colours(frame, points, camera, size=0.42 * grid.spacing)
    if below is not None:
        colours = colours * np.where(below > grid.spacing, shade, 1.0)[:, None]
    return Gaussians.isotropic(points, 0.42 * grid.spacing, colours, 0.8)


def body_cells(setting: Setting) -> Bool[np.ndarray, "nx ny nz"]:
    """Cells that hold fluid at the first instant, those of the inlet and the outlet among them."""
    cells = setting.cell_types
    wet = np.isin(cells, [int(c) for c in _WET])
    if setting.surface_height is not None:
        z = setting.terrain.grid.centers()[..., 2]
        below = z < setting.surface_height[..., None]
        touching = ndimage.binary_dilation(wet, iterations=6) if wet.any() else wet
        wet = wet | ((cells == CellType.OUTFLOW) & below & touching)
    return wet


def picture_colours(
    frame: UInt8[np.ndarray, "h w 3"], points: Float[np.ndarray, "n 3"], camera: PinholeCamera, *, size: float = 0.0
) -> Float[np.ndarray, "n 3"]:
    """sRGB in [0, 1] where each point appears in a picture; the nearest pixel for points outside it.

    Args:
        frame: the picture.
        points: world, m.
        camera: of the picture, in the world.
        size: standard deviation (m) of what gets the colour. The picture is averaged as widely as that looks from the
            camera (to the next power of two, px): a glint of one pixel is not the colour of a large splat. 0: a pixel.
    """
    row, col, z = camera.nearest_pixels(points)
    if size <= 0.0:
        return frame[row, col].astype(np.float32) / 255.0
    picture = frame.astype(np.float32) / 255.0
    wide = size * camera.focal[0] / np.maximum(z, 1e-9)
    level = np.clip(np.round(np.log2(np.maximum(wide, 0.5))) + 1, 0, np.log2(max(frame.shape[:2]))).astype(int)
    colours = np.empty((len(points), 3), np.float32)
    for step in np.unique(level):
        here = level == step
        seen = ndimage.gaussian_filter(picture, (2.0 ** (step - 1),) * 2 + (0,), mode="nearest") if step else picture
        colours[here] = seen[row[here], col[here]]
    return colours


def beneath_front(
    gaussians: Gaussians,
    depth: Float[np.ndarray, "h w"],
    mask: Bool[np.ndarray, "h w"],
    camera: PinholeCamera,
    *,
    smallest: float = 0.3,
    drop_above: bool = False,
) -> Gaussians:
    """Splats of the inside made small enough not to show through the visible surface above them.

    One at distance d below the surface gets a standard deviation of d / 2 at most, so that what stands out weighs less
    than exp(-2). Their places stay, because they are also what is simulated.

    Args:
        gaussians: of the hull and the filling, world.
        depth: camera z of the visible surface, m.
        mask: where it is seen; what lies elsewhere stays as it is.
        camera: in the world.
        smallest: part of its size that a splat keeps at least: it may come to the surface later.
        drop_above: those whose centre is nearer than the visible surface go.
    """
    ok = mask & (depth > 0)
    if not ok.any() or len(gaussians) == 0:
        return gaussians
    index = ndimage.distance_transform_edt(~ok, return_distances=False, return_indices=True)
    whole = depth[tuple(index)]
    points = camera.unproject(camera.pixel_grid(), whole)
    normal = np.cross(np.gradient(points, axis=1), np.gradient(points, axis=0))
    normal /= np.maximum(np.linalg.norm(normal, axis=-1, keepdims=True), 1e-12)
    row, col, z = camera.nearest_pixels(gaussians.means)
    uv, _ = camera.project(gaussians.means)
    inside = (uv >= 0).all(1) & (uv[:, 0] < mask.shape[1]) & (uv[:, 1] < mask.shape[0])
    seen = inside & ok[row, col] & (z > 0)
    where = np.where(seen[:, None], uv, 0.5)[:, ::-1].T - 0.5  # at grazing sight a pixel is long: between its middles
    gap = z - ndimage.map_coordinates(whole, where, order=1, mode="nearest")
    facing = np.abs((normal * (points - camera.position)).sum(-1)) / whole
    below = np.maximum(gap, 0.0) * facing[row, col]
    largest = gaussians.scales.max(axis=1)
    share = np.clip(0.5 * below / np.maximum(largest, 1e-12), smallest, 1.0)
    scales = gaussians.scales * np.where(seen, share, 1.0)[:, None].astype(gaussians.scales.dtype)
    small = Gaussians(gaussians.means, gaussians.quats, scales, gaussians.opacities, gaussians.sh)
    return small.select(~seen | (gap >= 0)) if drop_above else small


def within_silhouette(
    gaussians: Gaussians,
    allowed: Bool[np.ndarray, "h w"],
    camera: PinholeCamera,
    *,
    smallest: float = 0.3,
) -> Gaussians:
    """What does not contradict the silhouette: splats of the inside that would be seen where the picture shows no fluid
    go, and those near the edge are made small enough not to stick out.

    One at distance d from the edge gets a standard deviation of d / 2 at most, as in `beneath_front`. What lies off the
    picture or behind the camera stays as it is. The cells of a grid, the far side of a fall and the top of a jet all
    reach a little beyond the silhouette; nothing else hides them there.

    Args:
        gaussians: of the hull and the filling, world.
        allowed: pixels that show fluid, or something solid that may hide it.
        camera: in the world.
        smallest: part of its size that a splat keeps at least.
    """
    if len(gaussians) == 0 or allowed.all() or not allowed.any():
        return gaussians
    row, col, z = camera.nearest_pixels(gaussians.means)
    uv, _ = camera.project(gaussians.means)
    inside = (z > 0) & (uv >= 0).all(1) & (uv[:, 0] < allowed.shape[1]) & (uv[:, 1] < allowed.shape[0])
    # to the edge between two pixels, not to the middle of the next one
    distance = cast(np.ndarray, ndimage.distance_transform_edt(allowed))
    away = np.maximum(distance[row, col] - 0.5, 0.0)
    wide = gaussians.scales.max(axis=1) * camera.focal[0] / np.maximum(z, 1e-9)
    share = np.where(inside, np.clip(0.5 * away / np.maximum(wide, 1e-12), smallest, 1.0), 1.0)
    scales = gaussians.scales * share[:, None].astype(gaussians.scales.dtype)
    small = Gaussians(gaussians.means, gaussians.quats, scales, gaussians.opacities, gaussians.sh)
    return small.select(~inside | allowed[row, col])


def fluid_colour_frame(frame: UInt8[np.ndarray, "h w 3"], mask: Bool[np.ndarray, "h w"]) -> UInt8[np.ndarray, "h w 3"]:
    """The picture with fluid colours carried to every pixel, so that look-ups beside the mask find fluid."""
    if not mask.any():
        return frame
    core = ndimage.binary_erosion(mask, iterations=2)
    source = core if core.any() else mask
    index = ndimage.distance_transform_edt(~source, return_distances=False, return_indices=True)
    return np.where(mask[..., None], frame, frame[tuple(index)])


def bounded_colours(
    gaussians: Gaussians,
    frame: UInt8[np.ndarray, "h w 3"],
    camera: PinholeCamera,
    *,
    slack: float = 0.04,
) -> Gaussians:
    """Colours held within what the picture shows around each Gaussian (5 x 5 px).

    An optimiser may paint a faint Gaussian at the rim in any colour, because it hardly counts there; once the fluid
    moves it comes to the front and shows as a speck.
    """
    low = ndimage.minimum_filter(frame, size=(5, 5, 1))
    high = ndimage.maximum_filter(frame, size=(5, 5, 1))
    floor = picture_colours(low, gaussians.means, camera) - slack
    ceiling = picture_colours(high, gaussians.means, camera) + slack
    sh = gaussians.sh.copy()
    sh[:, :1] = sh_from_rgb(np.clip(0.5 + SH_C0 * sh[:, 0], floor, ceiling))
    return Gaussians(gaussians.means, gaussians.quats, gaussians.scales, gaussians.opacities, sh)


def united_mask(fluid: Bool[np.ndarray, "t h w"]) -> Bool[np.ndarray, "h w"]:
    """Pixels that are fluid in at least a third of the frames (one frame for pairs)."""
    return fluid.mean(axis=0) >= 0.34
