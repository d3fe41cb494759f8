"""gsplat (Apache-2.0) behind the seam of rasterisers: the same pictures on an NVIDIA GPU.

gsplat's wheel holds CUDA sources and compiles them at the first call (minutes), for which it needs nvcc and a CUDA
build of torch. A failed build shows only as a missing library; here that becomes a message with the remedy.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np

from fluidlift.errors import FluidliftError, MissingPackage, require
from fluidlift.messages import Notice
from fluidlift.numerics.splatting import SplatCamera
from fluidlift.numerics.splatting_projection import BLUR
from fluidlift.numerics.splatting_torch import NumbaRasterizer
from fluidlift.seams import Rasterizer, Splatted, SplatView

if TYPE_CHECKING:
    import torch
    from torch import Tensor

_INSTALL = "pip install gsplat packaging ninja"
_FAR = 1e10
"""m, gsplat's own far plane"""


class GsplatRasterizer(Rasterizer):
    """gsplat's `rasterization` in its classic mode.

    The first one made on a machine waits for gsplat to compile itself; a Gaussian is drawn at once, so that whatever
    is wrong with the installation is told here and not in the middle of the work.

    Args:
        device: "cuda", "cuda:1"...

    Raises:
        MissingPackage: gsplat is not installed.
        FluidliftError: torch sees no GPU, or gsplat cannot compile or run.
        ValueError: another device.
    """

    def __init__(self, device: str = "cuda") -> None:
        self._gsplat = _package()
        self._device = _cuda(device)
        self._try()

    def splat(
        self, means: Tensor, quats: Tensor, scales: Tensor, opacities: Tensor, features: Tensor, view: SplatView
    ) -> Splatted:
        """See `seams.Rasterizer`. Non-finite Gaussians are left out, as on the CPU."""
        import torch

        home = means.device
        operands = [x.to(self._device, torch.float32) for x in (means, quats, scales, opacities[:, None], features)]
        sound = torch.stack([x.isfinite().all(1) for x in operands]).all(0)[:, None]
        means, quats, scales, opacities, features = (torch.where(sound, x, torch.zeros_like(x)) for x in operands)
        world, intrinsic = _matrices(view)
        width, height = view.size
        # a quaternion of zeros would turn to NaN where gsplat normalises it
        quats = torch.where(sound, quats, quats.new_tensor([1.0, 0.0, 0.0, 0.0]))
        image, alpha, notes = self._gsplat.rasterization(
            means, quats, scales, opacities[:, 0], features,
            torch.from_numpy(world)[None].to(self._device), torch.from_numpy(intrinsic)[None].to(self._device),
            width, height, near_plane=view.near, far_plane=_FAR, eps2d=float(BLUR), sh_degree=None, packed=False,
            tile_size=16, render_mode="RGB", rasterize_mode="classic", camera_model="pinhole",
        )  # fmt: skip
        centers = notes["means2d"]
        if centers.requires_grad:
            centers.retain_grad()
        return Splatted(image[0].to(home), (1.0 - alpha[0, ..., 0]).to(home), centers)

    def _try(self) -> None:
        import torch

        one = torch.ones(1, 3)
        view = SplatCamera(np.eye(3), np.zeros(3), (8.0, 8.0), (4.0, 4.0), (8, 8))
        try:
            self.splat(2 * one, torch.tensor([[1.0, 0, 0, 0]]), one, 0.5 * torch.ones(1), one, view)
        except (ImportError, OSError, RuntimeError, AttributeError, TypeError) as error:
            raise FluidliftError(
                f"gsplat does not run here ({type(error).__name__}: {str(error)[:200]}). Needed: a CUDA build of "
                "torch, nvcc of the same CUDA version on the PATH (gsplat compiles itself at the first call) and a C++ "
                f"compiler. Do: {_INSTALL}, install the CUDA toolkit and set TORCH_CUDA_ARCH_LIST to your GPU's "
                "architecture (such as 8.9), or draw on the CPU."
            ) from error


def best_rasterizer(name: str = "auto", say: Callable[[Notice], None] | None = None) -> Rasterizer:
    """The rasteriser of this name: "cpu", "gsplat", or "auto" (gsplat where it runs, else the CPU).

    Args:
        name: which.
        say: is told why "auto" took the CPU on a machine with a GPU.

    Raises:
        ValueError: another name.
        MissingPackage, FluidliftError: "gsplat" was asked for and does not run (see `GsplatRasterizer`).
    """
    require(name in ("auto", "cpu", "gsplat"), f"rasteriser '{name}'", "auto, cpu or gsplat")
    if name == "gsplat":
        return GsplatRasterizer()
    if name == "auto" and _gpus() > 0:
        try:
            return GsplatRasterizer()
        except FluidliftError as error:
            if say is not None:
                say(Notice("gpu-not-used", f"Drawing on the CPU: {error}"))
    return NumbaRasterizer()


def _package() -> Any:
    try:
        return importlib.import_module("gsplat")
    except ImportError as error:
        raise MissingPackage(
            f"gsplat is not installed ({error}). Needed: to draw Gaussians on the GPU. Do: {_INSTALL}, or draw on the "
            "CPU."
        ) from None


def _gpus() -> int:
    import torch

    return torch.cuda.device_count() if torch.cuda.is_available() else 0


def _cuda(name: str) -> torch.device:
    import torch

    known = name == "cuda" or (name.startswith("cuda:") and name[5:].isdecimal())
    require(known, f"device '{name}'", "cuda or cuda:0, cuda:1...")
    count, number = _gpus(), int(name[5:] or 0)
    if number >= count:
        seen = "no GPU" if count == 0 else f"{count} GPU(s), numbered from 0"
        raise FluidliftError(
            f"Device '{name}' is not there: torch sees {seen}. Needed: an NVIDIA GPU, its driver and a CUDA build of "
            "torch. Do: install torch for CUDA (https://pytorch.org/get-started), or draw on the CPU."
        )
    return torch.device(name)


def _matrices(view: SplatView) -> tuple[np.ndarray, np.ndarray]:
    """gsplat's `viewmats` (camera from world, 4 x 4) and `Ks` (3 x 3) of one camera, float32."""
    world = np.eye(4, dtype=np.float32)
    world[:3, :3], world[:3, 3] = view.rotation, view.translation
    (fx, fy), (cx, cy) = view.focal, view.center
    return world, np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]], np.float32)
