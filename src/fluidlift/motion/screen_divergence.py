"""The divergence that an incompressible fluid shows on the screen (paper: `eq::div2DV`), and the projection onto it."""

from __future__ import annotations

import math

import cv2
import numpy as np
from jaxtyping import Bool, Float

from fluidlift.errors import require
from fluidlift.motion.interpolation import diffusion_interpolation
from fluidlift.numerics.poisson import PoissonSystem, solve
from fluidlift.types import PinholeCamera, SolveReport


def screen_divergence(
    displacement: Float[np.ndarray, "h w 2"],
    mask: Bool[np.ndarray, "h w"],
    depth: Float[np.ndarray, "h w"],
    depth_rate: Float[np.ndarray, "h w"],
    camera: PinholeCamera,
    *,
    form: str = "exact",
    axial_rate: Float[np.ndarray, "h w"] | None = None,
) -> Float[np.ndarray, "h w"]:
    """The divergence that an incompressible fluid shows on the screen (paper: `eq::div2DV`), 1/frame.

    A point (x, y, z) in camera axes is seen at u = x/z, v = y/z, which move with u' = (v_x - u v_z)/z and
    v' = (v_y - v v_z)/z. On a plane z = const, d/du = z d/dx, so with div v = 0

        div_2D v_2D = d_x v_x + d_y v_y - 2 v_z / z - (u d_x + v d_y) v_z
                    = -(1/z) (u d_u + v d_v + 2) v_z - d_z v_z.

    The paper writes this without the last term, d_z v_z at fixed (x, y): form "paper". A camera does not see it.
    It also holds only on a plane z = const; on a surface z(u, v) the chain rule adds grad z . d_z v_2D along the ray.
    Form "exact" closes both with one assumption, that just below the surface velocity does not change along the line
    of sight, (u d_x + v d_y + d_z) v = 0. Then d_z v_z = -(1/z) (u d_u + v d_v) v_z and d_z v_2D = -v_2D / z, so

        div_2D v_2D = -(2 v_z + v_2D . grad z) / z,

    which is exact for a rigid translation of any surface, where the paper's form is not. Where d_z v_z is known, give
    it as `axial_rate`; it then takes the place of that closure: paper's right side - axial_rate - v_2D . grad z / z.

    Pixels and normalised coordinates have the same divergence (both axes scale alike above and below the line).

    Args:
        displacement: v_2D, px/frame; used by "exact" for the slope term only.
        mask: the fluid; derivatives do not look beyond it.
        depth: camera z, m.
        depth_rate: v_z, camera z gained by the material in a frame, m/frame.
        camera: gives u and v of the pixels.
        form: "exact" or "paper".
        axial_rate: d_z v_z at fixed x and y, 1/frame.

    Raises:
        ValueError: an unknown form.
    """
    require(form in ("exact", "paper"), f"form '{form}'", "exact or paper")
    mask = np.asarray(mask, bool)
    z = np.where(mask, depth, 1.0).astype(np.float64)
    v_z = np.where(mask, depth_rate, 0.0).astype(np.float64)
    out = -2.0 * v_z
    if form == "paper" or axial_rate is not None:
        from_axis = camera.pixel_grid() - np.asarray(camera.center)
        out -= (from_axis * masked_gradient(v_z, mask)).sum(axis=-1)
    if form == "exact":
        out -= (np.asarray(displacement) * masked_gradient(z, mask)).sum(axis=-1)
        if axial_rate is not None:
            out -= z * axial_rate
    return np.where(mask, out / z, 0.0).astype(np.float32)


REACHES = (4.0, 16.0, math.inf)
"""px, tried in this order by `validated_reach`"""
GAIN = 0.02
"""share of the error that the constraint must save on held-out patches to be used"""
SURE = 1.5
"""standard errors over the patches by which that saving must differ from none; where the constraint holds it is 2 to 5
at the least reach, on the simulated clips -5 to 1"""


def project_screen_divergence(
    displacement: Float[np.ndarray, "h w 2"],
    mask: Bool[np.ndarray, "h w"],
    observed: Bool[np.ndarray, "h w"],
    depth: Float[np.ndarray, "h w"],
    depth_rate: Float[np.ndarray, "h w"],
    camera: PinholeCamera,
    *,
    form: str = "exact",
    reach: float | None = None,
) -> tuple[Float[np.ndarray, "h w 2"], SolveReport]:
    """The completed flow with the divergence of `screen_divergence` in the failed pixels; observed ones stay.

    The least change is a gradient: v - grad q with -laplace q = wanted - div v on the failed pixels. Through the
    borders of the picture the fluid may pass (q = 0 outside). Observed neighbours and banks are fixed (no gradient
    across); a patch enclosed by them can only meet its divergence up to a constant, which then is left in it, spread
    evenly.

    The constraint may be met softly, as the least |v' - v|^2 + reach^2 (div v' - wanted)^2, that is
    -laplace q + q / reach^2 = wanted - div v: a pixel answers to divergence within `reach` of it. An infinite reach is
    the paper's hard constraint, 0 leaves the flow as it is.

    How strictly is a question to the fluid. The right side assumes what a camera cannot see, the gradient of velocity
    below the surface. Water that wells up and dives under turbulence breaks it: on simulated rivers, honey, smoke and a
    pour, even the true depth and depth rate explain at most a seventh of the variance of the true divergence, at any
    scale from 1 to 16 px. The hard constraint then makes the filling up to 2.7 times as wrong (smoke: a tenth better).
    Where the surface does not stretch, as in slow eddies seen from above or round a rock, it removes up to half of the
    filling's error. By default the observed pixels decide (`validated_reach`).

    Args:
        displacement: from `complete_flow`, px/frame.
        mask: the fluid.
        observed: from `complete_flow`.
        depth: camera z, m.
        depth_rate: m/frame, see `screen_divergence`.
        camera: of the picture.
        form: see `screen_divergence`.
        reach: px, see above; None: `validated_reach`.

    Returns:
        displacement float32 [H,W,2] and the report of the solve.
    """
    d, mask = np.asarray(displacement, np.float32), np.asarray(mask, bool)
    failed = mask & ~np.asarray(observed, bool)
    if reach is None:
        reach = validated_reach(d, mask, observed, depth, depth_rate, camera, form=form)
    if reach == 0 or not failed.any():
        return d.copy(), SolveReport(True, 0, 0.0, "none", "the constraint was not used")
    wanted = screen_divergence(d, mask, depth, depth_rate, camera, form=form)
    return _projected(d, mask, failed, wanted, reach, 1e-3)


def validated_reach(
    displacement: Float[np.ndarray, "h w 2"],
    mask: Bool[np.ndarray, "h w"],
    observed: Bool[np.ndarray, "h w"],
    depth: Float[np.ndarray, "h w"],
    depth_rate: Float[np.ndarray, "h w"],
    camera: PinholeCamera,
    *,
    form: str = "exact",
) -> float:
    """The reach in px with which the constraint predicts this fluid's own observed motion best; 0: not at all.

    Observed patches, as wide as the failed regions, are hidden in a regular pattern, filled from their neighbours and
    projected. The constraint is used where it brings them nearer to what was observed: by at least `GAIN` of the error
    and by more than `SURE` standard errors over the patches. Larger reaches are tried as long as they do better.

    It depends on the fluid and not on the frame: one answer will do for a clip. Args: as `project_screen_divergence`.
    """
    d, mask = np.asarray(displacement, np.float32), np.asarray(mask, bool)
    observed = mask & np.asarray(observed, bool)
    failed = mask & ~observed
    if not failed.any() or not observed.any():
        return 0.0
    width = 4 * float(cv2.distanceTransform(failed.astype(np.uint8), cv2.DIST_L2, 5)[failed].mean())
    side = int(np.clip(width, 8, max(8.0, 0.25 * math.sqrt(float(mask.sum())))))
    rows, cols = (np.asarray(index) // side for index in np.indices(mask.shape))
    hidden = observed & (rows % 2 == 0) & (cols % 2 == 0)
    known = observed & ~hidden
    patch = (rows * (int(cols.max()) + 1) + cols)[hidden]
    if len(np.unique(patch)) < 3 or not known.any():
        return 0.0
    near = np.where(mask, depth, 1.0).astype(np.float32)
    around = cv2.GaussianBlur(np.where(known[..., None], d, 0.0), (0, 0), side)
    n = around / np.maximum(np.linalg.norm(around, axis=-1, keepdims=True), 1e-12)
    filled, reached, _ = diffusion_interpolation(
        d * near[..., None], CERTAIN * known, mask, n, anisotropy=4.0, depth=near, tolerance=3e-3
    )
    guess = np.where((known | ~reached)[..., None], d, filled / near[..., None]).astype(np.float32)
    wanted = screen_divergence(guess, mask, depth, depth_rate, camera, form=form)

    def errors(v: np.ndarray) -> np.ndarray:
        return np.bincount(patch, np.linalg.norm((v - d)[hidden], axis=-1))

    without = errors(guess)
    best, least, certainty = 0.0, without, 0.0
    for reach in REACHES:
        found = errors(_projected(guess, mask, mask & ~known, wanted, reach, 1e-2)[0])
        if found.sum() >= least.sum():
            break
        best, least, saved = reach, found, without - found
        certainty = max(certainty, float(saved.sum() / max(math.sqrt(float((saved**2).sum())), 1e-12)))
    return best if certainty > SURE and least.sum() < (1 - GAIN) * without.sum() else 0.0


CERTAIN = 100.0
"""weight of known pixels in the filling of hidden ones: they stay as they are"""


def _projected(
    d: np.ndarray, mask: np.ndarray, failed: np.ndarray, wanted: np.ndarray, reach: float, tolerance: float
) -> tuple[np.ndarray, SolveReport]:
    faces, weights = [], []
    for axis, component in ((0, d[..., 1]), (1, d[..., 0])):
        low, high = _sides(mask, axis)
        count = np.maximum(low.astype(np.float32) + high, 1.0)
        first, second = _sides(np.where(mask, component, 0.0), axis)
        faces.append((first + second) / count)
        failed_low, failed_high = _sides(failed, axis)
        open_face = failed_low & failed_high
        border = [slice(None), slice(None)]
        border[axis] = slice(None, None, mask.shape[axis])
        open_face[tuple(border)] = (failed_low | failed_high)[tuple(border)]
        weights.append(open_face.astype(np.float32)[..., None])
    # the term q / reach^2: one layer of cells leaks through its two faces to q = 0 above and below
    leak = np.where(failed, 0.5 / reach**2, 0.0).astype(np.float32)
    system = PoissonSystem(failed[..., None], weights[0], weights[1], np.stack([leak, leak], axis=-1), 1.0)
    excess = np.where(failed, wanted - np.diff(faces[0], axis=0) - np.diff(faces[1], axis=1), 0.0)
    # within a short reach plain conjugate gradients are done before a multigrid hierarchy is built
    method = "conjugate_gradient" if reach <= 8 else "multigrid"
    q, report = solve(system, excess[..., None].astype(np.float32), method=method, tolerance=tolerance)
    out = d.copy()
    for axis, channel in ((0, 1), (1, 0)):
        pad = [(0, 0), (0, 0)]
        pad[axis] = (1, 1)
        change = np.diff(np.pad(np.where(failed, q[..., 0], 0.0), pad), axis=axis) * weights[axis][..., 0]
        low, high = [slice(None)] * 2, [slice(None)] * 2
        low[axis], high[axis] = slice(None, -1), slice(1, None)
        out[..., channel] -= np.where(failed, 0.5 * (change[tuple(low)] + change[tuple(high)]), 0.0)
    return out, report


def masked_gradient(field: Float[np.ndarray, "h w"], mask: Bool[np.ndarray, "h w"]) -> Float[np.ndarray, "h w 2"]:
    """(d/du, d/dv) per px from neighbours inside the mask: central, one-sided at its rim, 0 where there is none."""
    parts = []
    for axis in (1, 0):
        pair = np.diff(np.where(mask, field, 0.0), axis=axis)
        both = np.logical_and(*(np.take(mask, range(a, mask.shape[axis] - 1 + a), axis=axis) for a in (0, 1)))
        step_low, step_high = _sides(np.where(both, pair, 0.0), axis)
        there_low, there_high = _sides(both, axis)
        parts.append((step_low + step_high) / np.maximum(there_low.astype(np.float32) + there_high, 1.0))
    return np.where(np.asarray(mask, bool)[..., None], np.stack(parts, axis=-1), 0.0)


def _sides(values: np.ndarray, axis: int) -> tuple[np.ndarray, np.ndarray]:
    """Values before and after each face across `axis`, 0 beyond the ends."""
    before, after = [(0, 0), (0, 0)], [(0, 0), (0, 0)]
    before[axis], after[axis] = (1, 0), (0, 1)
    return np.pad(values, before), np.pad(values, after)
