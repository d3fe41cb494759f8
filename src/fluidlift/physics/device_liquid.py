"""What a liquid needs that is simulated where its particles are, such as on a GPU, and what cannot be done there."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from fluidlift.physics.free_surface import SolidShares
from fluidlift.physics.guidance import BodyForce, Guiding, Nudging, SteadyForce
from fluidlift.physics.surroundings import Surroundings
from fluidlift.seams import LiquidStepper


@dataclass(frozen=True)
class DeviceSetup:
    """All that a `LiquidStepper` is made of."""

    surroundings: Surroundings
    solids: SolidShares
    """of the whole box"""
    forces: tuple[BodyForce, ...]
    """beside gravity"""
    start_levels: np.ndarray | None
    """cells [nx,ny], the water at the outlet at the start (see `physics.outlet`); None: there is no outlet"""


class DeviceLiquid(ABC):
    """Makes the stepper of a liquid."""

    @abstractmethod
    def begin(self, setup: DeviceSetup) -> LiquidStepper:
        """A stepper without particles."""


def left_to_the_host(surroundings: Surroundings, forces: Sequence[BodyForce], bodies: int) -> str:
    """Why the grid of a liquid is left to the host, in a few words; "" where it is not.

    Args:
        surroundings: of the liquid.
        forces: beside gravity.
        bodies: number of rigid bodies.
    """
    parameters = surroundings.parameters
    reasons = {
        "rigid bodies": bodies > 0,
        "surface tension": parameters.surface_tension > 0,
        "a force of its own kind": not all(isinstance(f, (SteadyForce, Nudging, Guiding)) for f in forces),
        "a prescribed outflow": surroundings.settings.prescribe_outflow,
        "drops that fly": surroundings.settings.airy_above is not None,
        "an inlet that moves": surroundings.inlet.moves,
    }
    return ", ".join(reason for reason, true in reasons.items() if true)
