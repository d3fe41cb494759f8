"""What each hard situation alone does to the flow: textures that move as formulas say (`synthetic.moving_texture`)."""

from __future__ import annotations

from typing import Any

import numpy as np
from motion_steps import HALF_WINDOW

from fluidlift.motion.direction import mainstream_direction
from fluidlift.motion.mainstream import complete_flow
from fluidlift.motion.optical_flow import DenseInverseSearch, Farneback, estimate_flow, mean_flow
from fluidlift.motion.sequence import MotionScene, motion_sequence
from fluidlift.synthetic.moving_texture import MovingTexture, Situation, moving_texture
from fluidlift.types import PinholeCamera, PixelFlow

SITUATIONS = {
    "plain": Situation(),
    "exposure +4 % a frame": Situation(brightness=0.04),
    "glints on 6 %": Situation(highlights=0.06),
    "pattern on 40 %": Situation(textured=0.4),
    "noise of 6 levels": Situation(noise=6.0),
    "advancing front": Situation(front=True),
    "all of them": Situation(brightness=0.04, highlights=0.06, textured=0.4, noise=6.0, front=True),
}
FLOWS = ("bend", "expansion", "vortex")
SIZE, FRAMES, SPEED = (192, 144), 12, 4.0


def situations() -> dict[str, dict[str, float]]:
    """Mean end-point error (px/frame) of the middle frame over all flows, after each step, by situation."""
    out: dict[str, dict[str, float]] = {}
    for name, situation in SITUATIONS.items():
        errors: dict[str, list[np.ndarray]] = {}
        for flow in FLOWS:
            if situation.front and flow == "vortex":  # a whirl has no front
                continue
            clip = moving_texture(flow, frames=FRAMES, size=SIZE, speed=SPEED, seed=1, situation=situation)
            for step, found in _steps(clip).items():
                t = FRAMES // 2
                error = np.linalg.norm(found - clip.flow[t], axis=-1)[clip.mask[t]]
                errors.setdefault(step, []).append(error)
        out[name] = {step: float(np.concatenate(parts).mean()) for step, parts in errors.items()}
    return out


def _steps(clip: MovingTexture) -> dict[str, np.ndarray]:
    """Displacement of the middle frame after each step; there is no depth, so nothing is projected."""
    t = FRAMES // 2
    first, second, mask = clip.frames[t], clip.frames[t + 1], clip.mask
    flow = estimate_flow(clip.frames)
    part = slice(t - HALF_WINDOW, t + HALF_WINDOW + 1)
    mean, trust = mean_flow(PixelFlow(flow.displacement[part], flow.confidence[part]), mask[t])
    full, _ = complete_flow(mean, trust, mask[t], mainstream_direction(mean, trust, mask[t]))
    camera = PinholeCamera.from_fov(50.0, SIZE)
    made = motion_sequence(
        lambda a, b: PixelFlow(flow.displacement[a:b], flow.confidence[a:b]), lambda k: mask[k], len(flow),
        MotionScene(camera, None, None, None, "stream", 0.04), frames=[t], volume_frames=[],
    )  # fmt: skip
    return {
        "Farneback": Farneback().displacement(first, second), "DIS": DenseInverseSearch().displacement(first, second),
        "multiframe": flow.displacement[t], "confidence": mean, "mainstream": full,
        "as made": next(iter(made)).displacement,
    }  # fmt: skip


def table(found: dict[str, dict[str, float]], before: dict[str, dict[str, Any]]) -> str:
    """As Markdown; with the last step of an earlier run beside, where given."""
    steps = list(next(iter(found.values())))
    lines = [
        "## Hard situations", "",
        "| situation | " + " | ".join(steps) + (" | before: as made |" if before else " |"),
        "|---|" + "---|" * (len(steps) + bool(before)),
    ]  # fmt: skip
    for name, errors in found.items():
        old = before.get(name, {}).get("as made")
        tail = "" if not before else (" - |" if old is None else f" {old:.3f} |")
        lines.append(f"| {name} | " + " | ".join(f"{errors[s]:.3f}" for s in steps) + " |" + tail)
    return "\n".join(lines)
