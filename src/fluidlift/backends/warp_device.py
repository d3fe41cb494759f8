"""Where Warp's kernels run: "cuda" (the GPU) or "cpu" (one thread; slow, for tests)."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from fluidlift.errors import FluidliftError, MissingPackage, require

if TYPE_CHECKING:
    import warp


def warp_device(name: str = "cuda") -> warp.Device:
    """The device "cuda", "cuda:0", "cuda:1"... or "cpu".

    Raises:
        MissingPackage: Warp is not installed.
        FluidliftError: Warp sees no such GPU.
        ValueError: another name.
    """
    known = name in ("cpu", "cuda") or (name.startswith("cuda:") and name[5:].isdecimal())
    require(known, f"device '{name}'", "cpu, cuda or cuda:0, cuda:1...")
    try:
        import warp
    except ImportError:
        raise MissingPackage(
            "Warp is not installed. Needed: for the GPU. Do: pip install 'fluidlift[cuda]', or choose the CPU."
        ) from None
    warp.config.log_level = max(warp.config.log_level, warp.LOG_WARNING)  # standard output belongs to the caller
    warp.init()
    if name == "cpu":
        return warp.get_device("cpu")
    count = warp.get_cuda_device_count()
    number = int(name[5:] or 0)
    if number >= count:
        seen = "no GPU" if count == 0 else f"{count} GPU(s), numbered from 0"
        raise FluidliftError(
            f"Device '{name}' is not there: Warp sees {seen}. Needed: an NVIDIA GPU (compute capability 7.5 or newer) "
            "and its driver (nvidia-smi must list it). Do: install the driver, or choose the CPU."
        )
    return warp.get_device(f"cuda:{number}")


def empty(size: int | tuple[int, ...], dtype: Any, device: warp.Device) -> warp.array:
    """A Warp array of a size or shape that nothing has been written to; `dtype`: a number, vector or matrix type."""
    import warp

    return warp.empty(size, dtype=dtype, device=device)


def on_device(values: np.ndarray, dtype: type, device: warp.Device) -> warp.array:
    """float32 values as a Warp array of `dtype` (a float, vector or matrix type); shared, not copied, on the CPU."""
    import warp

    return warp.array(np.ascontiguousarray(values, np.float32), dtype=dtype, device=device, copy=False)
