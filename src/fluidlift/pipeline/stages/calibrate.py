"""The stage that calibrates: the steady force with which the simulator keeps the filmed flow by itself.

Body, bed, inflow and motion are estimates of their own. Where they contradict each other, a free run leaves the filmed
flow within a second. One run of the simulator that is drawn towards it says what is missing: the mean of the pull is a
force in each place (flux adjustment), and the asset keeps it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float

from fluidlift.messages import Notice
from fluidlift.pipeline.work import Work
from fluidlift.scene.build import Scene
from fluidlift.scene.force_weight import pull_rate
from fluidlift.types import CellType, FaceVelocity, kind_of
from fluidlift.types.stages import Calibration, Elsewhere, Motion

if TYPE_CHECKING:
    from fluidlift.types import FluidAsset

GAIN = 2.0
"""of the force that is learnt over the pull: how many times less the flow stays behind. On a river, the demo and one
filmed along, the free run's mean velocity near the surface is off by 0.21, 0.13 and 0.26 of its size with 0, by 0.18,
0.11 and 0.23 with 2; with 4 by 0.17, 0.12 and 0.22, with 10 the first has 0.22 again. For what lies alone: what falls
is gone before a force that was learnt where it passed can help it, and its sheet is rolled up instead. Of two falls the
current of the re-simulation was off by 0.95 and 0.61 with 2, and by 0.83 and 0.52 with 0 (cosines 0.43 and 0.85, 0.68
and 0.93)"""

LEARNING = 12.0
"""time constants of the pull over which it is learnt: such a controller is damped critically from 10 on
((1 + x)^2 = 4 (1 + gain) x); 6 to 15 were the same"""

SETTLED = 0.25
"""share of the run that does not count: the body sinks into its cells, and waves of the start run off"""

LONGEST = 40
"""frames of the run: what counts of it is a second at 30 per second, the time in which most free runs leave the clip"""

STRONG = 1.0
"""left of the difference to the filmed flow under the pull, over the flow's speed, from which shape, motion and mass do
not fit together: the simulated flow is as far from the filmed one as water at rest"""

SLOW = 0.2
"""of the speed of a wave: in slower flows the sloshing of the start is larger than the flow, and is no contradiction"""


def mean_target(asset: FluidAsset, motion: Motion, elsewhere: Elsewhere | None = None) -> FaceVelocity:
    """Mean of the filmed velocities (m/s), continued from the liquid into air and walls.

    Of the part that is made that of all its frames, where it is known, and else of its targets; of other stretches
    that of their targets. Each counts by its frames.
    """
    from fluidlift.physics.boundaries import continued

    stretches = [] if elsewhere is None else elsewhere.velocities
    means = [_mean(targets) for targets in (motion.velocities, *stretches)]
    frames = [len(targets) for targets in (motion.velocities, *stretches)]
    if motion.mean is not None:
        means[0], frames[0] = motion.mean, len(motion.completed)
    components = zip(*(m.components for m in means), strict=True)
    mean = FaceVelocity(*(np.average(c, axis=0, weights=frames).astype(np.float32) for c in components))
    return continued(mean, asset.cell_types)


def _mean(targets: Sequence[FaceVelocity]) -> FaceVelocity:
    components = zip(*(t.components for t in targets), strict=True)
    return FaceVelocity(*(np.asarray(np.mean(c, axis=0, dtype=np.float32)) for c in components))


def calibrate(
    scene: Scene,
    target: FaceVelocity,
    shares: Float[np.ndarray, "h w"] | None = None,
    dry_for: float = math.inf,
    *,
    wanted: bool = True,
    device: str = "cpu",
    work: Work | None = None,
) -> Calibration:
    """The force that keeps `target`, and how well it does.

    Args:
        scene: unedited.
        target: m/s, on the faces of its grid.
        shares: of the clip's frames in which each pixel is fluid; None: no cell is known to stay dry, or wet. For a
            fluid that does not lie on ground these cells are the whole result: nothing is simulated, no force learnt.
        dry_for: s from the body at rest for which cells that are known to stay dry do so.
        wanted: False leaves all as it is.
        device: of the simulation.
        work: told how many frames are done.

    Raises:
        FluidliftError: the simulation broke down.
    """
    from fluidlift.physics.guidance import Nudging
    from fluidlift.scene.filmed_cells import dry_cells, wet_cells
    from fluidlift.scene.simulator import simulator_of, wave_speed

    kind = kind_of(scene.kind)
    if not wanted or kind.is_gas or not len(scene.body):
        return Calibration()
    if kind.rises_from_pool:  # it flies by itself; what strays lands in the pool
        return Calibration()
    grid, dry, wet = scene.terrain.grid, None, None
    if shares is not None:
        dry = dry_cells(scene.terrain, scene.camera, shares > 0, scene.cell_types)
        wet = wet_cells(grid, scene.camera, shares, scene.body.positions) & ~dry
    if not kind.lies_on_ground:
        return (
            Calibration() if dry is None else Calibration(FaceVelocity.zeros(grid), dry=dry, dry_for=dry_for, wet=wet)
        )
    frames = min(scene.frames, LONGEST)
    speed = _typical(target, scene.cell_types)
    if speed <= 0:
        return Calibration()
    wave, rate = wave_speed(scene), pull_rate(scene, speed)
    rates = tuple(np.full(c.shape, rate, np.float32) for c in target.components)
    gain = GAIN if kind.nearly_level else 0.0
    pull = Nudging(target, rates, after=SETTLED * frames * scene.interval, gain=gain, learning=LEARNING / rate)
    known = replace(scene, force=None, dry=dry, dry_for=dry_for, wet=wet)
    simulator = simulator_of(known, device, forces=(pull,), deform=False)
    for k in range(1, frames):
        if work is not None:
            work.step(k, frames)
        simulator.advance(scene.interval)
    force = pull.mean()
    size = _typical(force, scene.cell_types)
    left = _typical(pull.behind(), scene.cell_types) / max(speed, SLOW * wave)
    warnings = []
    if left > STRONG:
        warnings.append(
            Notice(
                "flow-not-held",
                "shape, measured motion and mass do not fit together: drawn towards the filmed flow, the simulation "
                f"still differs from it by {100 * left:.0f} % of its speed; the level will rise or fall; a --mask, "
                "--pitch or --size that is known would help",
            )
        )
    return Calibration(force, size, speed, left, frames, tuple(warnings), dry, dry_for, wet)


def _typical(field: FaceVelocity, cell_types: np.ndarray) -> float:
    """Root mean square in the liquid, in the unit of the field."""
    liquid = cell_types == CellType.FLUID
    return float(np.sqrt(np.square(field.at_centers()[liquid]).sum(axis=-1).mean())) if liquid.any() else 0.0
