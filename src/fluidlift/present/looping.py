"""Loops without a visible seam: the frames after the last one fade into the first ones.

A clip of N frames is simulated M frames longer. Frame k < M then shows both frame N + k, which goes on where the clip
ends, and frame k; the first fades out while the second fades in. So frame 0 is the one that follows frame N - 1, and
frame M the one that follows the last faded one: nothing jumps anywhere.

It fades patch by patch, in soft-edged patches that stand still. Two whole bodies over each other would show at once
whatever of the fainter one is outside of the other: many thin splats are opaque together, and surfaces that are drawn
of particles do not know opacities at all. So most places show one of both, and change over at a time of their own.

What fades at an edge is optical depth. A splat of opacity a takes -ln(1 - a exp(-r^2 / 2)) from the light at r standard
deviations from its centre; over its whole footprint that is the dilogarithm of a (times its area). At weight w it gets
the opacity with w times as much: two bodies at w and 1 - w then take as much light as one, and the fluid does not turn
transparent on the way.

Limits. At the edges of patches fine patterns of two instants lie over each other, with up to 30 % less contrast. A body
whose level has changed between beginning and end (a vessel that fills, a flood, smoke that still spreads) is not
faded: a warning says so. Bodies that float glide back to where they were. Particles of the end get new ids there,
since those of the beginning live on.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float

from fluidlift.io.frames import FIRST_FRAME, FluidFrame
from fluidlift.messages import Notice
from fluidlift.scene.splat_files import checkpoint_file, frame_file, read_frame, write_frame
from fluidlift.types import concatenate

if TYPE_CHECKING:
    from fluidlift.scene.build import Scene
    from fluidlift.scene.simulated_history import FrameHistory

OPEN = "loop-not-closed"
"""code of the warning that says why a loop is not closed"""
FAINTEST = 1 / 255
"""opacity below which a splat is not drawn"""
EDGE = 0.3
"""share of a fade over which a single place changes over: the rest it shows one instant alone"""
PATCH = 0.25
"""length of a patch over that of the fluid"""
WAVES = 12
"""whose sum makes the patches: enough for it to be normally distributed"""
LEAST = 0.02
"""share of a place from which on what is shown there counts"""
DRIFT = 0.15
"""share of the fluid's volume that the end may have more or less than the beginning"""


def faded(opacities: Float[np.ndarray, " n"], weight: float | Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
    """Opacities with `weight` times the optical depth over the whole splat."""
    from scipy.special import spence

    # denser where the dilogarithm is steep
    table = 1.0 - np.linspace(1.0, 0.0, 4096) ** 2
    depth = spence(1.0 - table)
    wanted = weight * np.interp(opacities, table, depth)
    return np.interp(wanted, depth, table).astype(np.float32)


def changed_over(points: Float[np.ndarray, "n 3"], share: float, patch: float) -> float | Float[np.ndarray, " n"]:
    """Share of the tail at places (m), 0 to 1, where it is `share` on the mean; in patches of that size (m).

    The order in which places change over is a sum of waves in all directions, made uniform over 0 to 1.
    """
    from scipy.special import ndtr

    if not np.isfinite(patch):
        return share
    rng = np.random.default_rng(0)
    ways = rng.normal(size=(WAVES, 3))
    ways *= (2.0 * np.pi / patch * rng.uniform(0.7, 1.4, WAVES) / np.linalg.norm(ways, axis=1))[:, None]
    height = np.sin(np.asarray(points, np.float64) @ ways.T + rng.uniform(0.0, 2.0 * np.pi, WAVES)).sum(axis=1)
    turn = ndtr(height / np.sqrt(0.5 * WAVES))
    return np.clip((share * (1.0 + EDGE) - turn) / EDGE, 0.0, 1.0)


def patch_size(points: Float[np.ndarray, "n 3"]) -> float:
    """m, of the patches of a fluid; without a fluid there are none."""
    return PATCH * float(np.ptp(np.percentile(points, [2, 98], axis=0), axis=0).max()) if len(points) else np.inf


def blended(head: FluidFrame, tail: FluidFrame, share: float, patch: float = np.inf) -> FluidFrame:
    """Two frames over each other.

    Args:
        head: of the beginning.
        tail: that goes on after the end.
        share: of the tail, 0 to 1.
        patch: m, size of the patches in which it takes over; infinite: everywhere at once.
    """
    parts = []
    for frame, of_tail in ((head, False), (tail, True)):
        later = np.broadcast_to(changed_over(frame.gaussians.means, share, patch), len(frame.ids))
        weight = later if of_tail else 1.0 - later
        opacities = faded(frame.gaussians.opacities, weight)
        seen = (opacities >= FAINTEST) & (weight >= LEAST)
        shown = replace(frame.gaussians, opacities=opacities).select(seen)
        parts.append(FluidFrame(shown, frame.ids[seen], frame.velocities[seen]))
    first, second = parts
    # an even number: what is even stays a particle, what is odd of the skin
    apart = 2 * (int(max(head.ids.max(initial=-1), tail.ids.max(initial=-1))) // 2 + 1)
    both = 0.0 < share < 1.0
    return FluidFrame(
        concatenate([first.gaussians, second.gaussians]),
        np.concatenate([first.ids, second.ids + apart * both]),
        np.concatenate([first.velocities, second.velocities]),
    )


def blended_poses(head: Float[np.ndarray, "b 7"], tail: Float[np.ndarray, "b 7"], share: float) -> np.ndarray:
    """Positions (m) on a line, orientations (w, x, y, z) on the shorter arc between those of two frames."""
    a, b = head[:, 3:], tail[:, 3:]
    b = np.where((a * b).sum(axis=1, keepdims=True) < 0, -b, b)
    turn = (1.0 - share) * a + share * b
    turn /= np.maximum(np.linalg.norm(turn, axis=1, keepdims=True), 1e-12)
    return np.concatenate([(1.0 - share) * head[:, :3] + share * tail[:, :3], turn], axis=1)


def close_loop(scene: Scene, history: FrameHistory, folder: Path) -> list[Notice]:
    """Fade the end of a simulation into its beginning, on disk; why it was not done, or nothing.

    A fluid that is not the same at both ends is left as it was simulated: a vessel that fills has no loop, and two
    levels over each other would be seen. The checkpoint goes first: should this be interrupted, the next run starts
    at the first frame.

    Args:
        scene: with an `overlap`.
        history: of all frames; brought down to those that stay.
        folder: of the asset, where the frames and the checkpoint are.
    """
    count, fade = scene.frames, scene.overlap
    if len(history) < scene.simulated:
        return [Notice(OPEN, "the loop is not closed: the simulation ended early")]
    checkpoint_file(folder).unlink(missing_ok=True)
    volume = np.array(history.volume)
    drift = volume[count:].mean() / max(volume[:fade].mean(), 1e-12) - 1.0
    steady = abs(drift) <= DRIFT
    if steady:
        _fade(history, count, fade, folder)
    for k in range(count, scene.simulated):
        frame_file(folder, FIRST_FRAME + k).unlink()
    for figures in (history.volume, history.leak, history.count, history.substeps, history.poses):
        del figures[count:]
    if steady:
        return []
    change = f"{100 * abs(drift):.0f} % {'more' if drift > 0 else 'less'} fluid at its end than at its beginning"
    text = (
        f"the loop is not closed: there is {change}, and no more than {100 * DRIFT:.0f} % goes unseen. Choose a "
        "duration after which the level is the same again; what fills or spreads for ever has none"
    )
    return [Notice(OPEN, text)]


def _fade(history: FrameHistory, count: int, fade: int, folder: Path) -> None:
    """Lay the `fade` frames after the first `count` over those from the beginning."""

    def frame(k: int) -> FluidFrame:
        return read_frame(frame_file(folder, FIRST_FRAME + k))

    volume, poses = np.array(history.volume), list(history.poses)
    patch = patch_size(frame(0).gaussians.means)
    for k in range(fade):
        # as much of the fluid changes over in each frame; bodies set out and arrive gently
        share, glide = 1.0 - k / fade, 0.5 * (1.0 + np.cos(np.pi * k / fade))
        shown = blended(frame(k), frame(count + k), share, patch)
        write_frame(folder, FIRST_FRAME + k, shown.gaussians, ids=shown.ids, velocities=shown.velocities)
        history.volume[k] = float((1 - share) * volume[k] + share * volume[count + k])
        history.count[k] = len(shown.ids)
        history.leak[k] = max(history.leak[k], history.leak[count + k])
        history.poses[k] = blended_poses(poses[k], poses[count + k], glide)


def seam(pictures: Float[np.ndarray, "t h w c"]) -> tuple[float, float, float]:
    """How much a loop's pictures change from the last to the first, and from each to the next: mean and largest.

    Mean absolute difference over the pixels, in the unit of the pictures.
    """
    steps = np.array([np.abs(b.astype(np.float64) - a).mean() for a, b in zip(pictures[:-1], pictures[1:])])
    across = float(np.abs(pictures[0].astype(np.float64) - pictures[-1]).mean())
    return across, float(steps.mean()), float(steps.max())
