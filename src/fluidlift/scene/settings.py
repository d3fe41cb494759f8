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
    skin: bool = True
    """whether the surface plays the clip's film"""

    @classmethod
    def of(cls, config: JobConfig) -> SceneSettings:
        """From those of a job."""
        c = config.simulate
        return cls(c.frames, c.follow, c.guide, config.seed, c.skin)
