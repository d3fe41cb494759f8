"""Squares of a filmed surface, resampled to metres over the plan: what its spectrum is taken from."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float, UInt8
from scipy import ndimage

from fluidlift.errors import require
from fluidlift.look.slope_brightness import level_brightness, mirrored_share
from fluidlift.look.surface_map import SurfaceMap
from fluidlift.look.wave_spectrum import SurfaceWindow
from fluidlift.numerics.srgb import linear_from_srgb
from fluidlift.physics.wave_dispersion import WaveMedium
from fluidlift.types import PinholeCamera

MOST = 6
"""windows: what more of them would say, they say already"""
PLACES = (24, 96)
"""to each side of a window: fewer hold no six of the shortest waves that are resolved, more are no finer a spectrum"""
PER_WAVE = 4.0
"""places to a wavelength, at least: coding and demosaicing take what is finer"""
FINER = 3
"""samples to each side of a place, whose mean it is: across the line of sight pixels are closer together"""
ALWAYS = 0.9
"""share of the film in which a place is fluid, to be in a window"""
APART = 0.5
"""sizes of a window between the middles of two"""
FEWEST = 16
"""frames: fewer tell no frequency from another"""
DARK = 1e-3
"""linear brightness below which there is only noise"""
EVEN = 0.01
"""of the picture's longer side, standard deviation over which the slope of the mean picture is taken: waves of slope
0.005 and more blur by that what is mirrored; what is finer lies on the bed"""
LUMINANCE = np.array([0.2126, 0.7152, 0.0722])


def windows_of(
    frames: UInt8[np.ndarray, "t h w 3"],
    fluid: Bool[np.ndarray, "t h w"],
    interval: float,
    camera: PinholeCamera,
    surface: SurfaceMap,
    depth: Float[np.ndarray, "nx ny"],
    medium: WaveMedium,
) -> list[SurfaceWindow]:
    """Windows of a film, those with most places first; none where it is too short, or shows too little at once.

    Args:
        frames: sRGB.
        fluid: in each of them.
        interval: s between them.
        camera: of the film, of its size.
        surface: at the time of the film.
        depth: m, of the liquid in the columns of `surface`.
        medium: whose gravity and tension count.
    """
    require(frames.shape[:3] == fluid.shape, f"{frames.shape} pictures for masks {fluid.shape}", "one each")
    if len(frames) < FEWEST:
        return []
    camera = camera.resized((frames.shape[2], frames.shape[1]))
    seen, pitch = _seen(fluid, camera, surface)
    half = ndimage.distance_transform_cdt(np.pad(seen, 1), "chessboard")[1:-1, 1:-1] * surface.pitch
    # the coarsest place around decides
    reach = np.maximum(half - 0.5 * surface.pitch, 0.0)
    places = np.where(seen, np.minimum(2.0 * reach / pitch, PLACES[1]), 0.0)
    light, found = _linear(frames), []
    third = len(light) // 3
    shores = [_mirrored(light[part], fluid[part], camera) for part in (slice(third), slice(-third, None))]
    film = light, fluid, shores
    middles = surface.middles()
    for _ in range(MOST):
        at = np.unravel_index(int(places.argmax()), places.shape)
        if places[at] < PLACES[0]:
            break
        n, step, middle = int(places[at]), float(pitch[at]), middles[at]
        found.append(_window(film, interval, camera, surface, depth, medium, (middle, n, step)))
        places[np.abs(middles - middle).max(axis=-1) < APART * n * step] = 0.0
    return found


def _seen(fluid: np.ndarray, camera: PinholeCamera, surface: SurfaceMap) -> tuple[np.ndarray, np.ndarray]:
    """Columns that the film shows as fluid, and the width (m) of a pixel there where it is longest."""
    xy = surface.middles()
    points = np.concatenate([xy, surface.height[..., None]], axis=-1)
    uv, depth = camera.project(points)
    step = 0.1 * surface.pitch
    moved = [(camera.project(points + step * np.eye(3)[a])[0] - uv) / step for a in range(2)]
    pixels = np.linalg.svd(np.stack(moved, axis=-1), compute_uv=False)[..., -1]  # px/m, the fewest
    height, width = fluid.shape[1:]
    inside = (uv >= 2).all(-1) & (uv[..., 0] < width - 2) & (uv[..., 1] < height - 2) & (depth > 0) & surface.wet
    x, y = (np.where(inside, uv[..., a], 0).astype(int) for a in range(2))
    seen = inside & (fluid.mean(axis=0)[y, x] > ALWAYS) & (pixels > 0)
    return seen, 1.0 / np.maximum(pixels, 1e-9)


def _linear(frames: np.ndarray) -> Float[np.ndarray, "t h w"]:
    """Linear luminance."""
    table = linear_from_srgb(np.arange(256, dtype=np.float32) / 255.0).astype(np.float32)
    weights = LUMINANCE.astype(np.float32)
    return np.stack([table[f] @ weights for f in frames])


def _mirrored(light: np.ndarray, fluid: np.ndarray, camera: PinholeCamera) -> Float[np.ndarray, "h w"]:
    """d ln L / d s of the mean picture, were it all mirrored: a slope s moves what is mirrored by 2 s focal lengths.

    That level water is brighter where it is seen at a flatter angle is no part of it.
    """
    share = np.maximum(fluid.sum(axis=0), 1)
    mean = np.where(fluid.any(axis=0), (light * fluid).sum(axis=0) / share, light.mean(axis=0))
    rays = camera.rays(camera.pixel_grid())
    level = level_brightness(np.arctan2(np.linalg.norm(rays[..., :2], axis=-1), -rays[..., 2]))
    shown = np.log(np.maximum(mean, DARK)) - np.log(level)
    along = ndimage.gaussian_filter(shown, EVEN * max(mean.shape), order=(1, 0))
    return 2.0 * camera.focal[1] * along


def _window(
    film: tuple[np.ndarray, np.ndarray, list[np.ndarray]],
    interval: float,
    camera: PinholeCamera,
    surface: SurfaceMap,
    depth: np.ndarray,
    medium: WaveMedium,
    square: tuple[np.ndarray, int, float],
) -> SurfaceWindow:
    """One.

    Args:
        film: linear brightness, masks, and d ln L / d s of the mean pictures of its first and last third, were
            they all mirrored.
        interval: s between frames.
        camera: of the film.
        surface: at its time.
        depth: m, of its columns.
        medium: whose gravity and tension count.
        square: its middle (m), places to a side and metres between them.
    """
    import cv2

    light, fluid, shores = film

    middle, n, pitch = square
    along = (np.arange(n * FINER) + 0.5 - 0.5 * n * FINER) * pitch / FINER
    xy = middle + np.stack(np.meshgrid(along, along, indexing="ij"), axis=-1)
    flat = xy.reshape(-1, 2)
    uv, _ = camera.project(np.concatenate([flat, surface.at(surface.height, flat)[:, None]], axis=1))
    # OpenCV counts from the middle of the first pixel
    u, v = (np.asarray(uv[:, a].reshape(xy.shape[:2]) - 0.5, np.float32) for a in range(2))

    def blocks(picture: np.ndarray) -> np.ndarray:
        sampled = cv2.remap(picture.astype(np.float32), u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        return sampled.reshape(n, FINER, n, FINER).mean(axis=(1, 3))

    bright = np.stack([blocks(p) for p in light])
    known = np.stack([blocks(m) for m in fluid]) > 0.5
    contrast = np.log(np.maximum(bright, DARK))
    usual = (contrast * known).sum(axis=0) / np.maximum(known.sum(axis=0), 1)
    contrast = np.where(known, contrast, usual)
    within = (np.abs(surface.middles() - middle).max(axis=-1) <= 0.5 * n * pitch) & surface.wet
    flow = surface.velocity[within][:, :2]
    sight = np.array([*middle, float(surface.height[within].mean())]) - camera.position
    level = float(np.hypot(*sight[:2]))
    incidence = float(np.arctan2(level, -sight[2]))
    # what waves leave in the mean of a few seconds differs from its beginning to its end, a shore does not
    shore = max(float(np.mean(blocks(shores[0]) * blocks(shores[1]))), 0.0)
    mirrored = float(np.sqrt(shore)) * mirrored_share(incidence)
    return SurfaceWindow(
        contrast,
        pitch,
        interval,
        (float(flow[:, 0].mean()), float(flow[:, 1].mean())),
        float(np.sqrt(flow.var(axis=0).sum())),
        WaveMedium(max(float(depth[within].mean()), pitch), medium.gravity, medium.tension),
        (float(sight[0] / max(level, 1e-9)), float(sight[1] / max(level, 1e-9))),
        incidence,
        PER_WAVE * pitch,
        mirrored,
    )
