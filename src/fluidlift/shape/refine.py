"""Refines Gaussians on one frame, so that they carry every pixel of it, without bending the body (paper: `loss_optGS`).

One view says nothing about depth. Left alone, the optimiser buys likeness with shape: it makes the front transparent,
pulls needles along the lines of sight and scatters Gaussians in depth. Three things hold it back: Gaussians move freely
across the line of sight but only slightly along it; the regularising terms of the loss; and a guard that compares
depth, extents and coverage with those before, and takes the best state that passes. Two additions to the paper's loss
do most of the work: every second step looks at the frame warped to a view from the side (`guard.neighbours`), and the
expected depth is tied to that before (`losses.depth_loss`).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from scipy.ndimage import distance_transform_edt

from fluidlift.errors import InputRejected, require
from fluidlift.numerics.harmonics import basis
from fluidlift.numerics.splatting import SplatCamera
from fluidlift.numerics.splatting_torch import NumbaRasterizer, rotation_matrices
from fluidlift.seams import Rasterizer
from fluidlift.shape.losses import (
    LossWeights,
    anisotropy_loss,
    depth_loss,
    image_loss,
    luminance_loss,
    scale_loss,
    volume_loss,
)  # fmt: skip
from fluidlift.shape.regression_guard import (
    LossFrame,
    ShapeFigures,
    broken,
    neighbours,
    picture_and_figures,
    plain_color,
    psnr,
)
from fluidlift.types.camera import PinholeCamera
from fluidlift.types.gaussians import SH_C0, Gaussians, concatenate

RATES = {"across": 0.08, "along": 0.01, "scales": 0.02, "quats": 0.01, "opacities": 0.1, "colors": 0.1}
"""Adam steps: pixels across and along the line of sight, logarithm, -, logit, harmonics"""

REACH_ALONG = 0.5
"""how far a Gaussian may move along its line of sight, in its own largest scale before"""

PUSH = 5e-5
"""mean gradient of the loss at a Gaussian's centre (normalised coordinates) above which it is split or cloned"""

BORDER = 2
"""px from the edge of the mask that count as its border"""

LIKE_BACKGROUND = 0.15
"""distance in RGB below which a Gaussian has the colour of the background"""


@dataclass(frozen=True)
class RefineResult:
    """Gaussians after the refinement, and whether it was worth it."""

    gaussians: Gaussians
    loss_history: Float[np.ndarray, " iterations"]
    psnr_before: float
    """dB inside the mask"""
    psnr_after: float
    """dB inside the mask, of `gaussians`"""
    kept: bool
    """False: no state passed the guard and `gaussians` are those that came in"""
    notes: tuple[str, ...] = ()


def refine(
    gaussians: Gaussians,
    image: UInt8[np.ndarray, "h w 3"],
    mask: Bool[np.ndarray, "h w"],
    camera: PinholeCamera,
    *,
    iterations: int = 60,
    background: str | tuple[float, float, float] | None = None,
    seed: int = 0,
    max_gaussians: int = 60_000,
    weights: LossWeights | None = None,
    rasterizer: Rasterizer | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> RefineResult:
    """Fit Gaussians to one frame; split where the picture asks for it, prune what belongs to rocks and banks.

    Args:
        gaussians: the generated body, world, m.
        image: the frame, sRGB.
        mask: the fluid in the frame (rocks are not fluid).
        camera: who saw the frame; resized to it if need be.
        iterations: steps of Adam.
        background: plain colour behind the fluid, in [0, 1], or "black". None: the plain colour that is farthest from
            those of the fluid, so that pruning by the colour of the background cannot eat the fluid.
        seed: of the shifts between the copies of cloned Gaussians.
        max_gaussians: densification stops here (never fewer than came in).
        weights: of the loss.
        rasterizer: draws; None: the CPU's.
        progress: called with (done, total).

    Raises:
        InputRejected: an empty mask, or no Gaussian in the picture.
        ValueError: image and mask of different size.
    """
    height, width = mask.shape
    require(
        image.shape == (height, width, 3), f"image {image.shape} and mask {mask.shape}", "the same height and width"
    )
    require(iterations >= 0, f"{iterations} iterations", "0 or more")
    if not mask.any():
        raise InputRejected("an empty fluid mask", "at least one fluid pixel in the frame to refine on")
    weights = weights or LossWeights()
    camera = camera if camera.size == (width, height) else camera.resized((width, height))
    frame = LossFrame.of(image, mask, camera, plain_color(image, mask, background))
    picture, first = picture_and_figures(gaussians.select(_in_front(gaussians, frame.view)), frame)
    before = psnr(picture, frame)
    if first.coverage < 1e-4:
        raise InputRejected("Gaussians of which none is seen inside the mask", "a body in front of this camera")

    threads = torch.get_num_threads()
    torch.set_num_threads(1)  # torch's spinning threads would slow the kernels, which use all cores themselves
    try:
        step = partial(_step, weights=weights, rasterizer=rasterizer or NumbaRasterizer())
        return _run(gaussians, frame, (first, before), iterations, step, seed, max_gaussians, progress)
    finally:
        torch.set_num_threads(threads)


class _Raw:
    """The optimiser's variables (never seen outside this module) and Adam on them."""

    def __init__(self, gaussians: Gaussians, view: SplatCamera) -> None:
        rotation = np.asarray(view.rotation, np.float32)
        self.rotation = torch.from_numpy(rotation)
        depth = (gaussians.means @ rotation.T + np.float32(view.translation))[:, 2]
        pixel = np.maximum(depth, view.near) / max(view.focal)
        degree = int(round(gaussians.sh.shape[1] ** 0.5)) - 1
        d = gaussians.means + np.float32(view.rotation.T @ view.translation)
        d = d / np.maximum(np.linalg.norm(d, axis=1, keepdims=True), 1e-12)
        rest = np.einsum("nk,nkc->nc", basis(d, degree)[:, 1:], gaussians.sh[:, 1:])
        tensor = torch.from_numpy
        widest = 0.25 * max(view.size) * pixel[:, None]
        largest = np.minimum(gaussians.scales, widest).max(1, initial=0.0)
        self.fixed = {
            "anchor": tensor(gaussians.means.copy()),
            "pixel": tensor(pixel.astype(np.float32)[:, None]),
            "reach": tensor(np.maximum(largest, 1e-12)[:, None]),
            "ray": tensor(d.astype(np.float32) @ rotation.T),
            "rest": tensor(rest.astype(np.float32)),
            "higher": tensor(gaussians.sh[:, 1:].copy()),
        }
        opacity = np.clip(gaussians.opacities, 1e-3, 0.995)
        self.free = {
            "across": torch.zeros(len(gaussians), 3),
            "along": torch.zeros(len(gaussians), 1),
            # one as wide as the picture is an accident, and would be dealt to every tile
            "scales": tensor(np.log(np.clip(gaussians.scales, 1e-9, widest.astype(np.float32)))),
            "quats": tensor(gaussians.quats.copy()),
            "opacities": tensor(np.log(opacity / (1 - opacity)).astype(np.float32)),
            "colors": tensor(gaussians.sh[:, 0].copy()),
        }
        self.first = {k: torch.zeros_like(v) for k, v in self.free.items()}
        self.second = {k: torch.zeros_like(v) for k, v in self.free.items()}
        self.steps = 0

    def __len__(self) -> int:
        return len(self.free["along"])

    def activated(self, free: dict[str, torch.Tensor]) -> tuple[torch.Tensor, ...]:
        """Means (m), scales (m), opacities, colours for this view."""
        ray = self.fixed["ray"]
        across = free["across"] - (free["across"] * ray).sum(1, keepdim=True) * ray
        shift = (across + free["along"] * ray) * self.fixed["pixel"]
        means = self.fixed["anchor"] + shift @ self.rotation
        colors = (0.5 + SH_C0 * free["colors"] + self.fixed["rest"]).clamp(min=0)
        return means, free["scales"].exp(), torch.sigmoid(free["opacities"]), colors

    def step(self, gradients: dict[str, torch.Tensor], pace: float) -> None:
        """One step of Adam (0.9, 0.99: the run is short), then the bound along the line of sight."""
        self.steps += 1
        for key, g in gradients.items():
            m, v = self.first[key], self.second[key]
            m.mul_(0.9).add_(g, alpha=0.1)
            v.mul_(0.99).addcmul_(g, g, value=0.01)
            scale = RATES[key] * pace / (1 - 0.9**self.steps)
            self.free[key] -= scale * m / ((v / (1 - 0.99**self.steps)).sqrt() + 1e-15)
        bound = REACH_ALONG * self.fixed["reach"] / self.fixed["pixel"]
        self.free["along"].clamp_(-bound, bound)

    def take(self, index: torch.Tensor) -> None:
        """Keep the rows of `index` (repeats allowed)."""
        for group in (self.fixed, self.free, self.first, self.second):
            for key in group:
                group[key] = group[key][index].contiguous()

    def gaussians(self) -> Gaussians:
        """As they are now."""
        means, scales, opacities, _ = self.activated(self.free)
        quats = torch.nn.functional.normalize(self.free["quats"], dim=1)
        sh = torch.cat([self.free["colors"][:, None], self.fixed["higher"]], 1)
        return Gaussians(means.numpy(), quats.numpy(), scales.numpy(), opacities.numpy(), sh.numpy())


def _run(
    gaussians: Gaussians, frame: LossFrame, start: tuple[ShapeFigures, float], iterations: int,
    step: Callable[..., tuple[float, torch.Tensor]], seed: int, max_gaussians: int,
    progress: Callable[[int, int], None] | None,
) -> RefineResult:  # fmt: skip
    """From the figures of the body and its PSNR in dB at the start."""
    rng, (first, before) = torch.Generator().manual_seed(seed), start
    seen = _in_front(gaussians, frame.view)
    sides = neighbours(frame, gaussians.select(seen), first)
    frame = replace(frame, depth=first.depth.astype(np.float32))
    opposite = frame.before_another_color()
    unseen, raw = gaussians.select(~seen), _Raw(gaussians.select(seen), frame.view)
    unit = float(raw.free["scales"].exp().median())
    pushes = torch.zeros(len(raw))
    density_steps = {round(iterations * q) for q in (0.2, 0.35, 0.5, 0.65)} - {0, iterations}
    checks = {round(iterations * q) for q in (0.25, 0.5, 0.75, 1.0)} - {0}
    history = np.zeros(iterations)
    best, after, notes, reasons = None, before, [], ()
    pruned, since = 0, 0
    for i in range(iterations):
        pace = 1.0 if i < iterations / 2 else 0.1 ** (2 * i / iterations - 1)
        # the frame itself and its neighbours in turn; the frame alone would be painted onto the body from one side
        shown = sides[(i // 2) % len(sides)] if i % 2 else frame
        # later on the opposite colour every other time: what is tinted by the background at the border loses its tint
        if i % 4 == 0 and 2 * i >= iterations:
            shown = opposite
        history[i], push = step(raw, shown, unit, pace)
        pushes += push
        if i + 1 in density_steps:
            room = max(max_gaussians, len(gaussians)) - len(unseen)
            _densify(raw, pushes / (i + 1 - since), room, frame.view, first.depth, rng)
            pruned += _prune_background(raw, frame)
            since = i + 1
            pushes = torch.zeros(len(raw))
        if i + 1 in checks:
            if i + 1 == iterations:
                pruned += _prune_background(raw, frame)
                _wash_border(raw, frame)
            candidate = concatenate([raw.gaussians(), unseen]) if len(raw) else unseen
            picture, figures = picture_and_figures(candidate, frame)
            reasons = broken(first, figures)
            likeness = psnr(picture, frame)
            if not reasons and likeness > after:
                best, after = candidate, likeness
        if progress:
            progress(i + 1, iterations)
    if reasons:
        notes.append("the last state of the refinement was given up: " + "; ".join(reasons))
    if pruned:
        notes.append(f"{pruned} Gaussians of the colour of the background were pruned at the border of the mask")
    if best is None:
        return RefineResult(gaussians, history, before, before, False, tuple(notes))
    return RefineResult(best, history, before, after, True, tuple(notes))


def _in_front(gaussians: Gaussians, view: SplatCamera) -> np.ndarray:
    """bool [n]: finite and in front of the camera; the others take no part."""
    z = gaussians.means @ np.float32(view.rotation[2]) + np.float32(view.translation[2])
    finite = np.isfinite(gaussians.scales).all(1) & np.isfinite(gaussians.opacities) & np.isfinite(z)
    return finite & np.isfinite(gaussians.quats).all(1) & np.isfinite(gaussians.sh).all((1, 2)) & (z > view.near)


def _step(
    raw: _Raw, frame: LossFrame, unit: float, pace: float, *, weights: LossWeights, rasterizer: Rasterizer
) -> tuple[float, torch.Tensor]:
    """One iteration; the loss and how hard the picture pulls at each Gaussian's centre (normalised coordinates)."""
    free = {k: v.detach().requires_grad_() for k, v in raw.free.items()}
    target, weight = torch.from_numpy(frame.target), torch.from_numpy(frame.weight)
    means, scales, opacities, colors = raw.activated(free)
    z = means @ torch.from_numpy(np.float32(frame.view.rotation[2])) + float(frame.view.translation[2])
    features = torch.cat([colors, z[:, None]], 1)
    splatted = rasterizer.splat(means, free["quats"], scales, opacities, features, frame.view)
    drawn, light = splatted.image, splatted.light
    picture = drawn[..., :3] + light[..., None] * torch.tensor(frame.plain)
    sizes = scales / unit
    loss = (
        weights.image * image_loss(picture, target, weight, weights.dissimilarity)
        + weights.anisotropy * anisotropy_loss(sizes, weights.stretch)
        + weights.volume * volume_loss(sizes, weights.volume_form)
        + weights.scale * scale_loss(sizes)
        + weights.luminance * luminance_loss(free["colors"])
        + weights.depth * depth_loss(drawn[..., 3], light, torch.from_numpy(frame.depth), unit)
    )
    loss.backward()
    gradients = {k: v.grad for k, v in free.items() if v.grad is not None}
    raw.step(gradients, pace)
    return float(loss.detach()), splatted.pull().to(means.device).norm(dim=1) * (0.5 * max(frame.view.size))


def _densify(
    raw: _Raw, pushes: torch.Tensor, room: int, view: SplatCamera, depth: np.ndarray, rng: torch.Generator
) -> None:
    """More Gaussians where the picture pulls hardest: large ones are split, small ones cloned.

    A split moves the halves apart along the axis that is longest across the line of sight, and along it as the visible
    surface slopes (`depth`, before the refinement). Two splits in turn make four Gaussians of half the width.

    The threshold is a quarter of that of 3D Gaussian Splatting (paper: a lower threshold). Gaussians finer than half a
    pixel stay as they are: what they would add cannot be seen.
    """
    sizes = raw.free["scales"].exp().max(1).values / raw.fixed["pixel"][:, 0]
    wanted = torch.where((pushes > PUSH) & (sizes > 0.5), pushes, torch.zeros_like(pushes))
    count = min(int((wanted > 0).sum()), room - len(raw), max(len(raw) // 2, 1))
    if count <= 0:
        return
    chosen = torch.sort(torch.argsort(wanted, descending=True, stable=True)[:count]).values
    n = len(raw)
    raw.take(torch.cat([torch.arange(n), chosen]))
    for group in (raw.first, raw.second):
        for value in group.values():
            value[n:] = 0
    large = sizes[chosen] > 1.0
    old, new = chosen[large], torch.arange(n, n + count)[large]
    scales, axes = raw.free["scales"], rotation_matrices(raw.free["quats"][old])
    ray = raw.fixed["ray"][old] @ raw.rotation
    along = torch.einsum("nia,ni->na", axes, ray)
    axis = (scales[old].exp() * (1 - along**2).clamp(min=0).sqrt()).argmax(1)
    shift = axes[torch.arange(len(old)), :, axis]
    shift = 0.6 * scales[old, axis].exp()[:, None] * (shift - (shift * ray).sum(1, keepdim=True) * ray)
    anchor, middle = raw.fixed["anchor"], raw.activated(raw.free)[0][old]
    for index, move in ((old, -shift), (new, shift)):
        slope = _surface_step(view, depth, middle.numpy(), move.numpy(), scales[old].exp().max(1).values.numpy())
        anchor[index] += move + torch.from_numpy(slope)[:, None] * ray
    for index in (old, new):
        scales[index] -= math.log(1.26)
        scales[index, axis] -= math.log(1.27)
    old, new = chosen[~large], torch.arange(n, n + count)[~large]
    raw.free["across"][new] += 0.3 * torch.randn(len(new), 3, generator=rng)
    # two of them cover as much as the one did
    opacity = 1 - torch.sqrt(1 - torch.sigmoid(raw.free["opacities"][old]))
    raw.free["opacities"][old] = raw.free["opacities"][new] = torch.logit(opacity, 1e-4)


def _surface_step(
    view: SplatCamera, depth: np.ndarray, middle: np.ndarray, move: np.ndarray, scale: np.ndarray
) -> Float[np.ndarray, " n"]:
    """How far (m) along the line of sight the visible surface runs under a move across it; 0 away from the surface."""
    (u0, v0), z0 = _pixels(view, middle)
    (u1, v1), _ = _pixels(view, middle + move)
    height, width = depth.shape
    seen = (np.minimum(u0, u1) >= 0) & (np.maximum(u0, u1) < width)
    seen &= (np.minimum(v0, v1) >= 0) & (np.maximum(v0, v1) < height)
    out = np.zeros(len(middle), np.float32)
    at, to = depth[v0[seen], u0[seen]], depth[v1[seen], u1[seen]]
    step = np.where(np.abs(z0[seen] - at) < 3 * scale[seen], to - at, 0.0)
    bound = 3 * np.linalg.norm(move[seen], axis=1)  # a steeper step is an edge
    out[seen] = np.where(np.abs(step) < bound, np.nan_to_num(step), 0.0)
    return out


def _pixels(view: SplatCamera, points: np.ndarray) -> tuple[tuple[np.ndarray, np.ndarray], np.ndarray]:
    """Column and row (int64) of points, and their camera z (m)."""
    x = points @ np.float32(view.rotation.T) + np.float32(view.translation)
    focal, center = np.array(view.focal, np.float32), np.array(view.center, np.float32)
    uv = x[:, :2] / np.maximum(x[:, 2:], view.near) * focal + center
    column, row = np.floor(np.clip(uv, -1e6, 1e6)).astype(np.int64).T
    return (column, row), x[:, 2]


def _prune_background(raw: _Raw, frame: LossFrame) -> int:
    """Drop what turned into background: its colour, or transparent, and at the border of the mask or outside it.

    Generated bodies bridge rocks and reefs. On a plain background the picture asks for its colour there, and what has
    taken it is no fluid (paper: pruning by the colour of the background).
    """
    means, _, opacities, colors = raw.activated(raw.free)
    outer = _at_border(means.numpy(), frame)
    plain = (colors - torch.tensor(frame.plain)).norm(dim=1).numpy() < LIKE_BACKGROUND
    clear = opacities.numpy() < 0.02
    gone = outer & (plain | clear)
    raw.take(torch.from_numpy(np.flatnonzero(~gone)))
    return int(gone.sum())


def _at_border(means: np.ndarray, frame: LossFrame) -> Bool[np.ndarray, " n"]:
    """Centres within the cut-out that lie outside the mask or within `BORDER` px of its edge."""
    (column, row), _ = _pixels(frame.view, means)
    height, width = frame.mask.shape
    within = (column >= 0) & (column < width) & (row >= 0) & (row < height)
    deep = cv2.erode(frame.mask.astype(np.uint8), np.ones((2 * BORDER + 1,) * 2, np.uint8), borderValue=1) > 0
    outer = np.zeros(len(means), bool)
    outer[within] = ~deep[row[within], column[within]]
    return outer


def _wash_border(raw: _Raw, frame: LossFrame) -> None:
    """Take the background's tint from Gaussians at the border: their hue is that of the nearest pixel well inside."""
    means, _, _, colors = raw.activated(raw.free)
    deep = cv2.erode(frame.mask.astype(np.uint8), np.ones((2 * BORDER + 1,) * 2, np.uint8), borderValue=1) > 0
    if not deep.any():
        return
    outer = np.flatnonzero(_at_border(means.numpy(), frame))
    (column, row), _ = _pixels(frame.view, means.numpy()[outer])
    nearest = distance_transform_edt(~deep, return_distances=False, return_indices=True)
    inner = frame.target[tuple(nearest[:, row, column])]
    light = colors[outer].mean(1, keepdim=True)
    hue = torch.from_numpy(inner - inner.mean(1, keepdims=True))
    raw.free["colors"][outer] = ((light + hue) - 0.5 - raw.fixed["rest"][outer]) / SH_C0
