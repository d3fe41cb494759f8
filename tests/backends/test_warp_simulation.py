"""A whole simulation with the particle work done by Warp: the same liquid as with the CPU's kernels."""

import numpy as np
import pytest

pytest.importorskip("warp", reason="the GPU back end, NVIDIA Warp, is not installed")

from dataclasses import replace

from small_scene import striped_channel

from fluidlift.backends import warp_liquid, warp_particles
from fluidlift.backends.warp_device import warp_device
from fluidlift.errors import FluidliftError
from fluidlift.io.frames import FIRST_FRAME
from fluidlift.physics import deform
from fluidlift.physics.guidance import BodyForce
from fluidlift.pipeline.settings import SimulateSettings
from fluidlift.pipeline.stages.simulate import simulate
from fluidlift.scene.simulator import left_to_the_cpu, particle_work, simulator_of
from fluidlift.scene.splat_files import frame_file, read_frame
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


@pytest.fixture
def no_gpu_needed(monkeypatch):
    """What asks for a GPU gets Warp's CPU device."""
    for module in (warp_liquid, warp_particles):
        monkeypatch.setattr(module, "warp_device", lambda name: warp_device("cpu"))


def test_a_scene_is_simulated_on_the_device_that_is_asked_for(no_gpu_needed):
    scene, ends = striped_channel(3), []
    for device in ("cpu", "cuda"):
        simulator = simulator_of(scene, device)
        assert left_to_the_cpu(simulator, device) == []
        for _ in range(2):
            simulator.advance(scene.interval)
        ends.append(simulator.particles)
    one, other = ends
    np.testing.assert_array_equal(one.ids, other.ids)
    np.testing.assert_array_equal(one.source, other.source)  # looks of what flows in
    assert np.abs(one.positions - other.positions).max() < 0.02 * scene.terrain.grid.spacing
    assert np.abs(one.positions - scene.body.positions[: len(one)]).max() > 0.01


class Whim(BodyForce):
    def applied(self, velocity, masses, box, dt, time=0.0):
        return velocity


def test_what_is_left_to_the_cpu_is_said(no_gpu_needed):
    scene = striped_channel(2)
    smoke = replace(scene, kind="plume")
    for case, forces, word in ((scene, (Whim(),), "because of a force"), (smoke, (), "smoke is simulated on the CPU")):
        (said,) = left_to_the_cpu(simulator_of(case, "cuda", forces), "cuda")
        assert said.code == "device-not-used" and word in said
        assert left_to_the_cpu(simulator_of(case, "cpu", forces), "cpu") == []


def test_frames_are_written_with_splats_that_the_device_deformed(no_gpu_needed, monkeypatch, tmp_path):
    scene, frames = striped_channel(3), []
    for device in ("cpu", "cuda"):
        if device == "cuda":
            monkeypatch.setattr(deform, "_deform", None)  # nothing is left to the host
        done = simulate(scene, SimulateSettings(10_000, device, 10), folder=tmp_path / device)
        assert done.failed is None and done.frames == 3
        frames.append(read_frame(frame_file(tmp_path / device, FIRST_FRAME + 2)).gaussians)
    one, other = frames
    assert len(one) == len(other) > 300
    h = scene.terrain.grid.spacing
    # particles of both differ by up to 0.02 cells, and what they carry by a part of that
    assert np.abs(one.means - other.means).max() < 0.02 * h
    assert np.abs(one.covariances() - other.covariances()).max() < 0.02 * np.square(one.scales).max()
    assert np.ptp(other.scales, axis=1).max() > 0.01 * other.scales.max()  # some are drawn out
