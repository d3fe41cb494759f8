"""The rasteriser: our kernels, a vectorised torch rasteriser, and (where installed) Mitsuba's ellipsoids and gsplat.

    python benchmarks/splatting.py [--repeats 7] [--peers torch mitsuba gsplat] [--only forward|gradient] [--page PAGE]

Gaussians fill a ball ("volume") or lie on its shell ("surface"), standard deviation about half their spacing with
lognormal anisotropy, opacity 0.2 to 0.95; the ball covers a little over half of the picture. Four channels: colour and
depth. "gradient" is forward and backward at 20k and 50k Gaussians, 256 and 512 px square; "forward" is a 1280 x 720
picture of 100k, 300k and 1M. Everything a picture needs is timed: projection, sorting and binning, pixels; with the
gradients down to means, quaternions, scales, opacities and features.

Milliseconds of processor time (all threads together; wall time on a GPU), medians of the repeats after one warm-up.
Run on one thread (NUMBA_NUM_THREADS=1 OMP_NUM_THREADS=1) for times per core.

Mitsuba traces rays through ellipsoids (one sample per pixel, `volprim_rf_basic`): another method for the same kind of
scene, so its pictures are close and not equal. Needs `pip install mitsuba` and, on the CPU, LLVM.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from page_section import replace_section

from fluidlift.errors import FluidliftError
from fluidlift.numerics.splatting import SplatCamera, bin_tiles, project, rasterize
from fluidlift.numerics.splatting_kernels import ALPHA_MAX, ALPHA_MIN
from fluidlift.numerics.splatting_torch import NumbaRasterizer, ellipses
from fluidlift.seams import Rasterizer, Splatted, SplatView

BEGIN, END = "<!-- splatting:begin -->", "<!-- splatting:end -->"
GRADIENT = [(20_000, 256), (20_000, 512), (50_000, 256), (50_000, 512)]
FORWARD = [100_000, 300_000, 1_000_000]


@dataclass(frozen=True)
class Scene:
    """What is drawn."""

    view: SplatCamera
    arrays: tuple[np.ndarray, ...]
    """means, quats, scales, opacities, features"""

    @classmethod
    def ball(cls, count: int, size: tuple[int, int], kind: str) -> Scene:
        """A ball of radius 1 m, 2.6 m away."""
        rng = np.random.default_rng(0)
        means = rng.normal(size=(count, 3))
        means /= np.linalg.norm(means, axis=1, keepdims=True)
        if kind == "volume":
            means *= rng.random((count, 1)) ** (1 / 3)
        spacing = (4 / 3 * np.pi / count) ** (1 / 3) if kind == "volume" else (4 * np.pi / count) ** 0.5
        scales = 0.5 * spacing * np.exp(0.4 * rng.normal(size=(count, 3)))
        quats = rng.normal(size=(count, 4))
        arrays = means, quats, scales, rng.uniform(0.2, 0.95, count), rng.random((count, 4))
        w, h = size
        focal = 1.05 * min(size)
        view = SplatCamera(np.eye(3), np.array([0.0, 0.0, 2.6]), (focal, focal), (w / 2, h / 2), size)
        return cls(view, tuple(np.ascontiguousarray(a, np.float32) for a in arrays))

    def tensors(self, gradients: bool) -> list[torch.Tensor]:
        """Operands of a rasteriser."""
        return [torch.tensor(a, requires_grad=gradients) for a in self.arrays]


class TorchRasterizer(Rasterizer):
    """Tiles in turn, vectorised over all pixels and Gaussians of a tile: what torch does without a kernel of its own.

    Lists of the tiles come from our binning, so that only the pixels are compared.
    """

    def splat(
        self, means: torch.Tensor, quats: torch.Tensor, scales: torch.Tensor, opacities: torch.Tensor,
        features: torch.Tensor, view: SplatView,
    ) -> Splatted:  # fmt: skip
        """See `seams.Rasterizer`."""
        numbers = SplatCamera(view.rotation, view.translation, view.focal, view.center, view.size, view.near)
        arrays = [x.detach().numpy() for x in (means, quats, scales, opacities)]
        bins = bin_tiles(project(numbers, *arrays), view.size)
        assert bins.whole is not None
        uv, covariance = ellipses(means, quats, scales, numbers)
        conic = torch.linalg.inv(covariance)
        width, height = view.size
        image, light = [], []
        for t in range(len(bins.starts) - 1):
            index = bins.order[bins.whole.gaussians[bins.starts[t] : bins.starts[t + 1]]]
            x0, y0 = (t % bins.tiles[0]) * bins.tile, (t // bins.tiles[0]) * bins.tile
            pixels = min(bins.tile, height - y0), min(bins.tile, width - x0)
            if len(index) == 0:
                image.append(torch.zeros(*pixels, features.shape[1]))
                light.append(torch.ones(pixels))
                continue
            k = torch.from_numpy(index.astype(np.int64))
            v, u = torch.meshgrid(torch.arange(pixels[0]) + y0 + 0.5, torch.arange(pixels[1]) + x0 + 0.5, indexing="ij")
            dx, dy = u - uv[k, 0, None, None], v - uv[k, 1, None, None]
            a, b, c = (conic[k, i, j, None, None] for i, j in ((0, 0), (0, 1), (1, 1)))
            raw = opacities[k, None, None] * torch.exp(-0.5 * (a * dx * dx + c * dy * dy) - b * dx * dy)
            alpha = torch.where(raw >= float(ALPHA_MIN), raw.clamp(max=float(ALPHA_MAX)), torch.zeros_like(raw))
            passed = torch.cumprod(1 - alpha, 0)
            weights = alpha * torch.cat([torch.ones_like(passed[:1]), passed[:-1]])
            image.append(torch.einsum("nhw,nc->hwc", weights, features[k]))
            light.append(passed[-1])
        across = bins.tiles[0]
        rows = range(0, len(image), across)
        picture = torch.cat([torch.cat(image[r : r + across], 1) for r in rows])
        return Splatted(picture, torch.cat([torch.cat(light[r : r + across], 1) for r in rows]), uv)


def median(run: Callable[[], object], repeats: int, wall: bool = False) -> float:
    """Milliseconds of processor time, or of wall time."""
    clock = time.perf_counter if wall else time.process_time
    run()
    times = []
    for _ in range(repeats):
        begin = clock()
        run()
        times.append(clock() - begin)
    return 1e3 * float(np.median(times))


def with_gradients(rasterizer: Rasterizer, scene: Scene) -> Callable[[], object]:
    """One forward and backward pass."""
    operands = scene.tensors(True)
    w, h = scene.view.size
    push = torch.randn(h, w, 4, generator=torch.Generator().manual_seed(0))

    def run() -> object:
        splatted = rasterizer.splat(*operands, scene.view)
        return torch.autograd.grad((splatted.image * push).sum() + splatted.light.sum(), operands)

    return run


def forward_parts(scene: Scene, repeats: int) -> tuple[float, float, float]:
    """Projection, binning and pixels of our kernels."""
    means, quats, scales, opacities, features = scene.arrays
    projected = project(scene.view, means, quats, scales, opacities)
    bins = bin_tiles(projected, scene.view.size)
    return (
        median(lambda: project(scene.view, means, quats, scales, opacities), repeats),
        median(lambda: bin_tiles(projected, scene.view.size), repeats),
        median(lambda: rasterize(projected, opacities, features, bins, scene.view.size), repeats),
    )


def mitsuba_pass(scene: Scene, gradients: bool) -> Callable[[], object] | None:
    """One pass of Mitsuba's ellipsoids, if it is installed and its LLVM back end runs."""
    try:
        import drjit as dr
        import mitsuba as mi

        mi.set_variant("llvm_ad_rgb")
    except (ImportError, RuntimeError, AttributeError):
        return None
    means, quats, scales, opacities, features = scene.arrays
    turned = quats[:, [1, 2, 3, 0]] / np.linalg.norm(quats, axis=1, keepdims=True)
    w, h = scene.view.size
    shape = {
        "type": "ellipsoids",
        "centers": mi.TensorXf(means),
        "scales": mi.TensorXf(scales),
        "quaternions": mi.TensorXf(np.ascontiguousarray(turned)),
        "opacities": mi.TensorXf(opacities[:, None]),
        "sh_coeffs": mi.TensorXf((features[:, :3] - 0.5) / 0.2820948),
    }
    eye = -scene.view.rotation.T @ scene.view.translation
    world = mi.load_dict(
        {
            "type": "scene",
            "integrator": {"type": "volprim_rf_basic"},
            "sensor": {
                "type": "perspective",
                "fov": float(np.degrees(2 * np.arctan(0.5 * w / scene.view.focal[0]))),
                "to_world": mi.ScalarTransform4f().look_at(eye.tolist(), [0, 0, 0], [0, -1, 0]),
                "film": {"type": "hdrfilm", "width": w, "height": h, "rfilter": {"type": "box"}},
                "sampler": {"type": "independent", "sample_count": 1},
            },
            "body": shape,
        }
    )
    parameters = mi.traverse(world)
    names = parameters.keys()  # the package's own mapping: it cannot be walked itself
    keys = [k for k in names if k.startswith("body.") and k.split(".")[1] in shape]

    def run() -> object:
        if not gradients:
            picture = mi.render(world, spp=1)
            dr.eval(picture)
            dr.sync_thread()
            return picture
        for key in keys:
            dr.enable_grad(parameters[key])
        parameters.update()
        dr.backward(dr.sum(mi.render(world, parameters, spp=1), axis=None))
        found = [dr.grad(parameters[key]) for key in keys]
        dr.eval(*found)
        dr.sync_thread()
        return found

    return run


def peer_times(name: str, scene: Scene, gradients: bool, repeats: int) -> str:
    """A figure, or why there is none."""
    if name == "mitsuba":
        run = mitsuba_pass(scene, gradients)
        return "not installed" if run is None else f"{median(run, repeats):.0f}"
    wall = name == "gsplat"
    try:
        rasterizer: Rasterizer = TorchRasterizer()
        if name == "gsplat":
            from fluidlift.backends.gsplat_rasterizer import GsplatRasterizer

            rasterizer = GsplatRasterizer()
    except FluidliftError as error:
        return str(error).split(".")[0]
    if gradients:
        return f"{median(with_gradients(rasterizer, scene), repeats, wall):.0f}"
    operands = scene.tensors(False)
    return f"{median(lambda: rasterizer.splat(*operands, scene.view).light.sum().item(), repeats, wall):.0f}"


def gradient_table(repeats: int, peers: list[str], peer_repeats: int) -> Iterator[str]:
    """Lines of the table of forward and backward passes."""
    yield "| forward + backward, ms | ours |" + "".join(f" {p} |" for p in peers)
    yield "|---|---|" + "---|" * len(peers)
    for kind in ("volume", "surface"):
        for count, side in GRADIENT:
            scene = Scene.ball(count, (side, side), kind)
            ours = median(with_gradients(NumbaRasterizer(), scene), repeats)
            rest = [peer_times(p, scene, True, peer_repeats) for p in peers]
            yield f"| {kind} {count // 1000}k, {side}^2 | {ours:.0f} |" + "".join(f" {r} |" for r in rest)


def forward_table(repeats: int, peers: list[str], peer_repeats: int) -> Iterator[str]:
    """Lines of the table of pictures."""
    yield "| forward 1280 x 720, ms | projection | binning | pixels | ours |" + "".join(f" {p} |" for p in peers)
    yield "|---|---|---|---|---|" + "---|" * len(peers)
    for kind in ("volume", "surface"):
        for count in FORWARD:
            scene = Scene.ball(count, (1280, 720), kind)
            parts = forward_parts(scene, repeats)
            rest = [peer_times(p, scene, False, peer_repeats) for p in peers]
            cells = [f"{p:.0f}" for p in (*parts, sum(parts))] + rest
            yield f"| {kind} {count // 1000}k |" + "".join(f" {c} |" for c in cells)


def main() -> None:
    """Prints the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--repeats", type=int, default=7)
    parser.add_argument("--peers", nargs="*", default=["torch"], choices=["torch", "mitsuba", "gsplat"])
    parser.add_argument("--peer-repeats", type=int, default=3)
    parser.add_argument("--only", choices=["forward", "gradient"])
    parser.add_argument("--page", type=Path, help=f"page with the markers {BEGIN} and {END}")
    options = parser.parse_args()
    torch.set_num_threads(1)
    lines: list[str] = []
    for name, rows in (("gradient", gradient_table), ("forward", forward_table)):
        if options.only not in (None, name):
            continue
        if lines:
            lines.append("")
        for line in rows(options.repeats, options.peers, options.peer_repeats):
            lines.append(line)
            print(line, flush=True)
    if options.page is not None:
        replace_section(options.page, "\n".join(lines), BEGIN, END)


if __name__ == "__main__":
    main()
