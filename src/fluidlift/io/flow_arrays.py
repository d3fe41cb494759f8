"""Flow in .npy and .npz files: one pair or a whole clip, channels last or first."""

from __future__ import annotations

import zipfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from fluidlift.errors import InputRejected
from fluidlift.io.array_archive import DAMAGE, array_in, mapped_array, members_of
from fluidlift.io.limits import ReadLimits, require_file, require_size

_FLOW_KEYS = ("displacement", "flow", "flows", "forward")
_TRUST_KEYS = ("confidence", "valid")


@dataclass(frozen=True)
class FlowArray:
    """The flow of a clip in one array, of which only the pairs that are asked for need be in memory."""

    name: str
    displacement: np.ndarray
    """[T,H,W,2], of any kind of number, perhaps on disk"""
    confidence: np.ndarray | None
    """[T,H,W]"""

    def __len__(self) -> int:
        return len(self.displacement)

    def pair(self, t: int) -> tuple[np.ndarray, np.ndarray | None]:
        """float32 [H,W,2], and [H,W] or None."""
        trust = None if self.confidence is None else np.asarray(self.confidence[t], np.float32)
        return np.asarray(self.displacement[t], np.float32), trust


def open_array(path: Path | str, pairs: int, start: int, limits: ReadLimits) -> FlowArray:
    """Pairs start to start + pairs - 1 of a .npz (read at once) or .npy file (mapped, read as needed).

    Arrays of the flow are [T,H,W,2], [T,2,H,W], [H,W,2] or [2,H,W], named displacement or flow, or the only one of the
    file; confidence or valid is [T,H,W] or [H,W].

    Raises:
        InputRejected: no such file, objects instead of numbers, too large, another shape, or too few pairs.
    """
    path = require_file(path, "flow file")
    try:
        flow, trust = _from_npz(path, limits) if path.suffix.lower() == ".npz" else (mapped_array(path), None)
    except DAMAGE as error:
        raise InputRejected(
            f"'{path.name}' cannot be read as an array ({str(error)[:200]})",
            "numbers saved with numpy.save or numpy.savez",
        ) from None
    flow = _channels_last(path, flow)
    if flow.shape[1] * flow.shape[2] > limits.max_pixels or not flow.size:
        raise InputRejected(f"'{path.name}' holds {flow.shape}", f"1 to {limits.max_pixels} pixels")
    if trust is not None:
        trust = trust.reshape(1, *trust.shape) if trust.ndim == 2 else trust
        if trust.shape != flow.shape[:3] or trust.dtype.kind not in "buif":
            raise InputRejected(f"'{path.name}' holds a confidence {trust.shape}", f"numbers {flow.shape[:3]}")
    if len(flow) < start + pairs:
        raise InputRejected(
            f"'{path.name}' holds the flow of {len(flow)} pair(s), and none from frame {len(flow)} to {len(flow) + 1}",
            f"{start + pairs} pairs",
            "export the flow of every frame of the clip but the last",
        )
    wanted = slice(start, start + pairs)
    return FlowArray(path.name, flow[wanted], None if trust is None else trust[wanted])


def _from_npz(path: Path, limits: ReadLimits) -> tuple[np.ndarray, np.ndarray | None]:
    require_size(path, limits.max_bytes, "flow array")
    if not zipfile.is_zipfile(path):  # a .npy file under another name
        return mapped_array(path), None
    with zipfile.ZipFile(path) as archive:
        members = members_of(archive, limits.max_bytes)
        names = [n for n in members if n not in _TRUST_KEYS]
        key = next((k for k in _FLOW_KEYS if k in names), names[0] if len(names) == 1 else None)
        if key is None:
            listed = ", ".join(members)[:200] or "nothing"
            raise InputRejected(f"'{path.name}' holds {listed}", "an array 'displacement'")
        trust = next((members[k] for k in _TRUST_KEYS if k in members), None)
        return array_in(archive, members[key]), None if trust is None else array_in(archive, trust)


def _channels_last(path: Path, flow: np.ndarray) -> np.ndarray:
    """[T,H,W,2]."""
    if flow.dtype.kind not in "fiu":
        raise InputRejected(f"'{path.name}' holds {flow.dtype}", "numbers")
    flow = flow.reshape(1, *flow.shape) if flow.ndim == 3 else flow
    if flow.ndim == 4 and flow.shape[3] == 2:
        return flow
    if flow.ndim == 4 and flow.shape[1] == 2:
        return np.moveaxis(flow, 1, 3)
    raise InputRejected(f"'{path.name}' holds an array {flow.shape}", "[T,H,W,2] or [H,W,2]")
