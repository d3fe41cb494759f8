"""Everything that runs on a GPU, measured in one command: beside the CPU of the same machine, on the same work.

    python benchmarks/device.py [--device cuda] [--only transfer simulation ...] [--limit 120] [--json device.json]

Each part is a process of its own with a time limit, so that one that fails or hangs costs no other:

  transfer    benchmarks/warp_transfer.py: P2G, G2P and the particle half of a step, share of the memory's bandwidth
  liquid      benchmarks/warp_liquid.py: the whole substep, by part, the CPU beside it
  pressure    benchmarks/warp_poisson.py: pressure and viscosity, iterations, launches, share of the bandwidth
  shown       a dam break of 500,000 particles simulated, deformed and drawn at 720p; by way of the host, too
  rollout     the gradient of ten steps of the differentiable rollout: the CPU's kernels, and torch on the device
  fit         a twin fitted by both: seconds, and how far the parameters are apart
  splats      benchmarks/splatting.py with gsplat

Seconds of wall time, medians after one warm-up. On "cpu" the parts run too, for trying them out.
"""

from __future__ import annotations

import argparse
import json
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

HERE = Path(__file__).parent
SCRIPTS: dict[str, list[str]] = {
    "transfer": ["warp_transfer.py", "--counts", "100000", "500000", "2000000"],
    "liquid": ["warp_liquid.py", "--check", "--host", "--frames", "6"],
    "pressure": ["warp_poisson.py", "--no-check"],
    "splats": ["splatting.py", "--peers", "gsplat", "--repeats", "3"],
}
"""parts that are benchmarks of their own"""

Figures = dict[str, float | str]


def median(run: Callable[[], object], repeats: int) -> float:
    """Seconds, after one warm-up."""
    run()
    times = []
    for _ in range(repeats):
        begin = time.perf_counter()
        run()
        times.append(time.perf_counter() - begin)
    return statistics.median(times)


class Shown:
    """A dam break that is simulated on a device, and drawn from there or by way of the host.

    Args:
        device: "cuda", "cuda:1"... or "cpu", whose pictures our own rasteriser draws.
        count: of its particles, about.
    """

    def __init__(self, device: str, count: int) -> None:
        import numpy as np
        import torch
        from warp_liquid import dam

        from fluidlift.backends.gsplat_rasterizer import GsplatRasterizer
        from fluidlift.backends.warp_device import warp_device
        from fluidlift.backends.warp_liquid import WarpLiquids
        from fluidlift.errors import FluidliftError
        from fluidlift.numerics.splatting import SplatCamera
        from fluidlift.numerics.splatting_torch import NumbaRasterizer
        from fluidlift.physics.numba_particles import ParticleWork
        from fluidlift.types import Gaussians

        self.device, self._warp, self._rasterizer = device, warp_device(device), NumbaRasterizer()
        self.not_drawn = ""
        """why there are no pictures"""
        if device != "cpu":
            try:
                self._rasterizer = GsplatRasterizer(device)
            except FluidliftError as error:
                self.not_drawn = str(error)
        tank = dam(count)
        self.count, h = len(tank.particles), tank.grid.spacing
        rgb = np.random.default_rng(0).random((self.count, 3))
        self.rest = Gaussians.isotropic(tank.particles.positions, 0.3 * h, rgb, 0.8)
        looks = self.rest.opacities, self.rest.rgb.astype(np.float32)
        self.looks = [torch.from_numpy(np.ascontiguousarray(a)).to(device) for a in looks]
        low, high = tank.grid.low, tank.grid.high
        away, turn = 1.5 * float((high - low).max()), np.array([[1.0, 0, 0], [0, 0, -1.0], [0, 1.0, 0]])
        place = -turn @ (0.5 * (low + high) - [0.0, away, 0.0])
        self.view = SplatCamera(turn, place, (1000.0, 1000.0), (640.0, 360.0), (1280, 720))
        self.simulator = tank.simulator(work=ParticleWork(liquid=WarpLiquids(device)))

    def settled(self) -> None:
        """Waits for the device."""
        import warp as wp

        wp.synchronize_device(self._warp)

    def on_the_device(self) -> list[Any]:
        """Operands of a rasteriser, by the kernel that works where the particles are."""
        import torch

        found = self.simulator.splats(self.rest)
        assert found is not None
        means, quats, scales, source = (
            torch.from_dlpack(a) for a in (found.means, found.quats, found.scales, found.source)
        )
        opacities, rgb = self.looks
        return [means, quats, scales, opacities[source], rgb[source]]

    def drawn(self, operands: list[Any]) -> Any:
        """The picture, complete."""
        means, quats, scales, opacities, rgb = operands
        image = self._rasterizer.splat(means, quats, scales, opacities, rgb, self.view).image
        image.sum().item()
        return image


def shown(device: str, count: int | None = None) -> Iterator[Figures]:
    """Seconds of a frame of 1/30 s, by part, drawn from where it is simulated; and what the way over the host takes.

    Warp's CPU device has one thread: there are fewer particles on it.
    """
    import numpy as np
    import torch

    from fluidlift.physics.deform import deform_gaussians

    scene = Shown(device, count or (500_000 if device != "cpu" else 20_000))
    taken: dict[str, list[float]] = {}
    apart = 0.0

    def timed(part: str, work: Callable[..., Any], *operands: Any) -> Any:
        begin = time.perf_counter()
        out = work(*operands)
        scene.settled()
        taken.setdefault(part, []).append(time.perf_counter() - begin)
        return out

    def raised(body: Any) -> list[Any]:
        arrays = body.means, body.quats, body.scales, body.opacities, body.rgb
        return [torch.from_numpy(np.ascontiguousarray(a, np.float32)).to(device) for a in arrays]

    for _ in range(9):
        timed("simulated", scene.simulator.advance, 1 / 30)
        operands = timed("deformed, on the device", scene.on_the_device)
        image = None if scene.not_drawn else timed("drawn", scene.drawn, operands)
        particles = timed("by way of the host: taken there", getattr, scene.simulator, "particles")
        body = timed("by way of the host: deformed, on the CPU", deform_gaussians, scene.rest, particles)
        operands = timed("by way of the host: taken back", raised, body)
        if image is not None:
            apart = max(apart, float((scene.drawn(operands) - image).abs().max()))
    # what is compiled is there after some frames, and the column falls
    milliseconds = {part: 1e3 * statistics.median(times[4:]) for part, times in taken.items()}
    found: Figures = {f"{scene.count} particles, {part}: ms": value for part, value in milliseconds.items()}
    if scene.not_drawn:
        yield found | {"not drawn:": scene.not_drawn}
        return
    here = sum(milliseconds[part] for part in ("simulated", "deformed, on the device", "drawn"))
    found["frames per second"] = 1e3 / here
    found["frames per second, by way of the host"] = 1e3 / (
        sum(milliseconds.values()) - milliseconds["deformed, on the device"]
    )
    found["pictures of both apart, of 1"] = apart
    yield found


def rollout(device: str, sizes: tuple[int, ...] = (32, 48, 64, 96)) -> Iterator[Figures]:
    """Seconds of the gradient of ten steps, and how far the gradients are apart."""
    for n in sizes:
        yield rollout_of(n, device)


def rollout_of(n: int, device: str) -> Figures:
    """`rollout` on n^3 cells."""
    import torch
    from rollout_gradient import SHAPES, box_with_pillar, distance

    from fluidlift.physics.rollout import RolloutParameters, flatten, rollout
    from fluidlift.physics.rollout_pressure import RolloutOptions
    from fluidlift.physics.rollout_torch import rollout_on_device
    from fluidlift.physics.rollout_torch_domain import TorchDomain
    from fluidlift.types import FaceVelocity, Grid

    domain, physical = box_with_pillar(n, "float32")
    start = FaceVelocity.zeros(Grid((n, n, n), 1.0 / n))
    start.u[:] = 1.0
    flat, options, placed = flatten(start, torch.float32), RolloutOptions(), TorchDomain.of(domain, device)
    gradients: dict[str, list[float]] = {}

    def on_host() -> None:
        run("cpu", lambda parameters: rollout(flat, domain, parameters, steps=10, options=options))

    def on_device() -> None:
        given = {"steps": 10, "options": options, "device": device}
        run("device", lambda parameters: rollout_on_device(flat, placed, parameters, **given))

    def run(where: str, roll: Callable[[Any], Any]) -> None:
        parameters = RolloutParameters.of(physical, torch.float32)
        leaves = [getattr(parameters, name).requires_grad_() for name in SHAPES]
        (roll(parameters).velocity ** 2).mean().backward()
        gradients[where] = [float(x) for leaf in leaves for x in leaf.grad.reshape(-1)]

    found: Figures = {f"{n}^3, CPU: s": median(on_host, 3), f"{n}^3, torch on {device}: s": median(on_device, 3)}
    found[f"{n}^3: gradients apart, relative"] = distance(gradients["device"], gradients["cpu"])
    return found


def fit(device: str) -> Iterator[Figures]:
    """Seconds of a fit, and its parameters against those of the CPU's, in their standard deviations."""
    from fluidlift.fit.optimize import fit_parameters
    from fluidlift.synthetic.twins import make_twin

    for scene, cells in (("river", (32, 16, 16)), ("honey", (48, 24, 24))):
        twin = make_twin(scene, seed=0, noise=0.1, cells=cells, frames=5)
        found: Figures = {}
        ends = {}
        for name in ("cpu", device if device != "cpu" else "cpu:0"):
            begin = time.perf_counter()
            ends[name] = fit_parameters(
                twin.frames, twin.cell_types, None, twin.grid, twin.interval, twin.start, mainstream=twin.mainstream,
                steps_per_frame=twin.steps_per_frame, windows=1, start_rounds=1, device=name, device_from=0,
                free=("kinematic_viscosity", "inflow_velocity", "outflow_velocity"),
            )  # fmt: skip
            found[f"{scene} {cells}, {name}: s"] = time.perf_counter() - begin
        first, second = ends.values()
        apart = [
            abs(e.value - second.estimates[label].value) / e.sigma
            for label, e in first.estimates.items()
            if e.identifiable
        ]
        found[f"{scene} {cells}: largest difference, sigmas"] = max(apart)
        yield found


PARTS: dict[str, Callable[[str], Iterator[Figures]]] = {"shown": shown, "rollout": rollout, "fit": fit}


def machine_of(device: str) -> str:
    """Name of the GPU, or of the processor."""
    import torch

    if device.startswith("cuda") and torch.cuda.is_available():
        return torch.cuda.get_device_name(device)
    return "CPU"


def run_part(name: str, device: str, limit: float) -> Any:
    """What a part prints, or why it failed."""
    script = SCRIPTS.get(name)
    command = [sys.executable, str(HERE / script[0]), *script[1:]] if script else [sys.executable, __file__]
    command += [] if script else ["--part", name, "--device", device]
    begin = time.perf_counter()
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=limit)
        text, error = done.stdout, "" if done.returncode == 0 else done.stderr[-1500:]
    except subprocess.TimeoutExpired as late:
        text = (late.stdout or b"").decode() if isinstance(late.stdout, bytes) else late.stdout or ""
        error = f"longer than {limit:g} s"
    lines = text.strip().splitlines()
    print(f"== {name}, {time.perf_counter() - begin:.0f} s\n" + "\n".join([*lines, error]).strip(), flush=True)
    return {"lines": lines, "error": error}


def main() -> None:
    """Prints the figures of all parts, and writes them."""
    names = [*SCRIPTS, *PARTS]
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", default="cuda", help="cuda, cuda:1... or cpu")
    parser.add_argument("--only", nargs="*", choices=names, default=names, metavar="PART")
    parser.add_argument("--limit", type=float, default=120.0, help="s, of each part")
    parser.add_argument("--json", type=Path, help="file for the figures")
    parser.add_argument("--part", choices=list(PARTS), help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.part:
        for found in PARTS[options.part](options.device):  # told at once: a part that is cut short has told something
            for name, value in found.items():
                print(f"{name} {value:.4g}" if isinstance(value, float) else f"{name} {value}", flush=True)
        return
    print(machine_of(options.device))
    found = {name: run_part(name, options.device, options.limit) for name in options.only}
    if options.json is not None:
        options.json.write_text(json.dumps({"machine": machine_of(options.device), "parts": found}, indent=1))


if __name__ == "__main__":
    main()
