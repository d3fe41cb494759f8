"""Tilt and focal length of the camera by a learned model of the view, weighed beside what else is known of them."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from fluidlift.backends.registry import ModelChoice
from fluidlift.backends.view_model import ViewGuess, make_view_estimator
from fluidlift.pipeline.depths import spread_frames
from fluidlift.pipeline.settings import ViewModelSettings
from fluidlift.pipeline.work import Work
from fluidlift.shape.view import LearnedTilt
from fluidlift.types import PinholeCamera
from fluidlift.types.stages import Read, ViewGuesses

MISTAKEN_LENS = 0.1
"""probability that a model's focal length is nothing but mistaken, anywhere within a factor of `ANY_LENS`: assumed"""
ANY_LENS = 8.0
"""20 to 110 degrees, about, across the longer side"""


@dataclass(frozen=True)
class LearnedView(ViewGuess):
    """What a model says of the camera of a whole clip; its pitch is that at its own focal length."""

    model: str = ""

    @classmethod
    def of(cls, found: ViewGuesses) -> LearnedView | None:
        """Median of the pictures; the spread between them adds to the errors, as the camera is one. None of none."""
        if len(found.pitch) == 0:
            return None
        values = np.stack([found.pitch, found.roll, np.log(found.focal)], axis=-1)
        spread = values.std(axis=0, ddof=1) if len(values) > 1 else np.zeros(3)
        pitch, roll, focal = np.median(values, axis=0)
        error = np.sqrt(np.mean(found.errors**2, axis=0) + spread**2)
        told = not found.errors[:, 2].any()
        return cls(
            float(pitch), float(roll), float(np.exp(focal)), float(error[0]), float(error[1]),
            0.0 if told else float(error[2]), float(np.median(found.pitch_by_focal)), found.model,
        )  # fmt: skip

    def lens(self, camera: PinholeCamera, error: float) -> PinholeCamera:
        """The camera with the focal length that its own evidence and the model give together.

        Where they are so far apart that the model is rather mistaken, it counts for as little.

        Args:
            camera: as it is taken to be without the model.
            error: relative standard deviation of its focal length.
        """
        if self.focal_error <= 0.0:
            return camera
        spread = max(error, 1e-3)
        apart = np.log(self.focal / camera.focal[0])
        together = np.hypot(spread, self.focal_error)
        right = (1.0 - MISTAKEN_LENS) * np.exp(-0.5 * (apart / together) ** 2) / (together * np.sqrt(2.0 * np.pi))
        share = right / (right + MISTAKEN_LENS / np.log(ANY_LENS))
        moved = share * apart * spread**2 / together**2
        focal = float(camera.focal[0] * np.exp(moved))
        return replace(camera, focal=(focal, focal))

    def tilt(self, camera: PinholeCamera) -> LearnedTilt:
        """Its tilt, for the focal length that the camera is taken to have in the end."""
        moved = 0.0 if self.focal_error <= 0.0 else self.pitch_by_focal * np.log(camera.focal[0] / self.focal)
        return LearnedTilt(self.model, self.pitch + float(moved), self.roll, self.pitch_error, self.roll_error)


def view_of(
    read: Read, model: ViewModelSettings, camera: PinholeCamera | None, start: int, work: Work
) -> LearnedView | None:
    """What a model says of some frames from `start` on; None where it sees nothing in them.

    Args:
        read: the clip.
        model: of the view.
        camera: where its focal length is known.
        start: first frame in which there is enough fluid.
        work: keeps what the model says, which is slow.

    Raises:
        InputRejected: weights that do not fit.
        FluidliftError: no such device, or too little memory.
    """
    pick = spread_frames(len(read.clip), start, model.frames)
    return LearnedView.of(work.part("view", view_by_model, read, model, pick, camera))


def view_by_model(
    read: Read, model: ViewModelSettings, frames: list[int], camera: PinholeCamera | None, *, work: Work
) -> ViewGuesses:
    """What a learned model says of some frames, one after the other."""
    weights = None if model.weights is None else model.weights.name
    estimator = make_view_estimator(model.model, ModelChoice(weights, model.device))
    found: list[ViewGuess] = []
    for done, t in enumerate(frames):
        guess = estimator.guess(np.ascontiguousarray(read.clip.frames[t]), camera)
        found += [] if guess is None else [guess]
        work.step(done + 1, len(frames))
    errors = [[g.pitch_error, g.roll_error, g.focal_error] for g in found]
    pitch, roll, focal, by_focal = (
        np.array([getattr(g, name) for g in found], float) for name in ("pitch", "roll", "focal", "pitch_by_focal")
    )
    return ViewGuesses(model.model, pitch, roll, focal, np.array(errors, float).reshape(-1, 3), by_focal)
