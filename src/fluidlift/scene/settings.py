"""What a scene takes from a job, beside its asset and its edits."""

from __future__ import annotations

from dataclasses import dataclass

from fluidlift.config import JobConfig


@dataclass(frozen=True)
class SceneSettings:
    """What a scene takes from the job, beside its asset and its edits."""

    frames: int | None
    follow: float
    guide: float
    seed: int

    @classmethod
    def of(cls, config: JobConfig) -> SceneSettings:
        """From those of a job."""
        return cls(config.simulate.frames, config.simulate.follow, config.simulate.guide, config.seed)
