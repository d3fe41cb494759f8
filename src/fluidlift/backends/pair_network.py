"""What all networks that look at two pictures share: device, padding, normalisation and the limits of memory."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from fluidlift.errors import FluidliftError, InputRejected, require

if TYPE_CHECKING:
    import torch

STRIDE = 8
"""px: RAFT and its heirs compute at an eighth of the picture"""
LEAST = 128
"""px: four levels of correlation need two cells on the coarsest, 2 * 8 * STRIDE"""


class PaddedPair(NamedTuple):
    """Two pictures as a network takes them."""

    first: torch.Tensor
    """float32 [1,3,H',W'] from -1 to 1; H' and W' are multiples of `STRIDE` and at least `LEAST`"""
    second: torch.Tensor
    rows: slice
    """where the pictures lie in the padded ones"""
    columns: slice


def torch_device(name: str) -> torch.device:
    """The device "cpu", "cuda" or "cuda:1".

    Raises:
        ValueError: another name.
        FluidliftError: torch sees no such GPU.
    """
    import torch

    known = name in ("cpu", "cuda") or (name.startswith("cuda:") and name[5:].isdecimal())
    require(known, f"device '{name}'", "cpu, cuda or cuda:0, cuda:1...")
    count = torch.cuda.device_count() if name != "cpu" else 0
    if name != "cpu" and int(name[5:] or 0) >= count:
        raise FluidliftError(
            f"Device '{name}' is not there: torch sees {count} GPU(s). Needed: an NVIDIA GPU and torch with CUDA. "
            "Do: install them, or choose the CPU."
        )
    return torch.device(name)


def padded_pair(first: np.ndarray, second: np.ndarray, device: torch.device) -> PaddedPair:
    """Both pictures, u8 [H,W,3] sRGB or [H,W] grey, with their border pixels repeated on all sides.

    Raises:
        ValueError: pictures of unlike size or type.
    """
    import torch

    require(first.shape == second.shape, f"pictures {first.shape} and {second.shape}", "the same size")
    require(first.dtype == second.dtype == np.uint8, f"pictures {first.dtype} and {second.dtype}", "u8")
    require(first.ndim == 2 or (first.ndim == 3 and first.shape[2] == 3), f"pictures {first.shape}", "[H,W,3] or [H,W]")
    edges = []
    for length in first.shape[:2]:
        missing = max(LEAST, -(-length // STRIDE) * STRIDE) - length
        edges.append((missing // 2, missing - missing // 2))
    (top, bottom), (left, right) = edges

    def tensor(picture: np.ndarray) -> torch.Tensor:
        colour = picture if picture.ndim == 3 else np.repeat(picture[..., None], 3, axis=-1)
        values = torch.from_numpy(np.ascontiguousarray(colour)).to(device).permute(2, 0, 1)[None].float() / 127.5 - 1.0
        return torch.nn.functional.pad(values, (left, right, top, bottom), mode="replicate")

    height, width = first.shape[:2]
    return PaddedPair(tensor(first), tensor(second), slice(top, top + height), slice(left, left + width))


def require_memory(size: tuple[int, int], max_bytes: int) -> None:
    """Refuse pictures (width, height) whose correlation of all pairs of cells would not fit.

    Raises:
        InputRejected: more than `max_bytes`.
    """
    cells = np.prod([max(LEAST, side) / STRIDE for side in size])
    needed = int(4 * cells**2 * (1 + 1 / 4 + 1 / 16 + 1 / 64))  # float32, four levels
    if needed > max_bytes:
        raise InputRejected(
            f"pictures of {size[0]} x {size[1]} px: the network would take {needed / 2**30:.1f} GiB",
            f"at most {max_bytes / 2**30:.1f} GiB",
            "lower read.max_size, or choose dis",
        )


@contextmanager
def memory_errors(device: torch.device) -> Iterator[None]:
    """Say what to do where memory runs out.

    Raises:
        FluidliftError: instead of torch's own error. Other errors pass unchanged.
    """
    import torch

    try:
        yield
    except (torch.OutOfMemoryError, MemoryError, RuntimeError) as error:
        short = isinstance(error, torch.OutOfMemoryError | MemoryError) or "can't allocate memory" in str(error)
        if not short:
            raise
        other = "the CPU (slower)" if device.type == "cuda" else "a machine with more memory"
        raise FluidliftError(
            f"The network ran out of memory on '{device}'. Needed: smaller pictures or more memory. "
            f"Do: lower read.max_size, choose {other}, or use dis."
        ) from None
