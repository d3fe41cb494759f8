"""A whole simulation with the particle work done by Warp: the same liquid as with the CPU's kernels."""

import numpy as np
import pytest

pytest.importorskip("warp", reason="the GPU back end, NVIDIA Warp, is not installed")

from fluidlift.errors import FluidliftError
from fluidlift.pipeline.simulator import particle_work
from fluidlift.synthetic import tanks


def test_a_dam_break_is_the_same_with_warp_and_numba():
    ends = []
    for work in (None, particle_work("cpu"), warp_on_the_cpu()):
        simulator = tanks.dam_break(cells=8, width_cells=4).simulator(work=work)
        for _ in range(4):
            simulator.advance(0.25 * simulator.parameters.time_step)
        ends.append(simulator.particles)
    np.testing.assert_array_equal(ends[0].positions, ends[1].positions)
    assert np.abs(ends[0].velocities).max() > 0.05  # it has begun to fall
    size = np.ptp(ends[0].positions[:, 2])
    # sums in another order, in single precision, over four steps
    np.testing.assert_allclose(ends[2].positions, ends[0].positions, atol=1e-5 * size)


def warp_on_the_cpu():
    from fluidlift.backends.warp_particles import WarpMover, WarpTransfer
    from fluidlift.physics.numba_particles import ParticleWork

    return ParticleWork(WarpTransfer("cpu"), WarpMover("cpu"))


def test_a_gpu_that_is_not_there_is_said():
    import warp

    if warp.get_cuda_device_count():
        pytest.skip("there is a GPU")
    with pytest.raises(FluidliftError, match="sees no GPU"):
        particle_work("cuda")
