"""Frames of splats as a page on the web plays them: 16 bytes per splat, and of those only what changes.

Every splat has a slot for as long as it lives. A record is position (3 x u16, in steps from the low corner of all
frames), logarithm of the scales (3 x u8), orientation (the smallest three of the quaternion, 7 bits each, and 2 bits
that name the fourth), colour (3 x u8, sRGB) and opacity (u8; 0: the slot is empty). A frame is what has to be added to
the frame before, byte by byte, position as the difference from uniform motion; byte planes follow each other, because
runs of zeros deflate well. Shape and colour are only replaced where they have changed by more than can be seen.
"""

from __future__ import annotations

import zlib
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from fluidlift.types import Gaussians

RECORD = 16
"""bytes of a splat"""
FINE = 0.03
"""step of the positions, in standard deviations of the median splat: far below what can be seen"""
_HALF = 63.5
"""stored size of a quaternion component of sqrt(1/2)"""
_KEPT_SCALE, _KEPT_TURN, _KEPT_COLOR = 2, 2, 3
"""largest change, in stored steps, that is not worth storing"""
_PLANES = 6
"""the first planes hold the residuals of positions: three low bytes, three high bytes"""


@dataclass(frozen=True)
class Quantization:
    """What the stored numbers mean, for all frames of one page."""

    low: tuple[float, float, float]
    """m, position of the stored (0, 0, 0)"""
    step: float
    """m"""
    scale_low: float
    """logarithm of the scale (m) that is stored as 0"""
    scale_step: float
    slots: int
    """most splats at once"""

    @classmethod
    def of(cls, frames: Iterable[Gaussians]) -> Quantization:
        """The smallest range that holds all frames; they are taken one by one."""
        low, high = np.full(3, np.inf), np.full(3, -np.inf)
        small, large, slots, usual = np.inf, -np.inf, 1, []
        for g in frames:
            if len(g):
                low, high = np.minimum(low, g.means.min(axis=0)), np.maximum(high, g.means.max(axis=0))
                logs = np.log(np.maximum(g.scales, 1e-9))
                small, large = min(small, float(logs.min())), max(large, float(logs.max()))
                usual.append(float(np.median(g.scales)))
            slots = max(slots, len(g))
        if not usual:
            return cls((0.0, 0.0, 0.0), 1e-3, -7.0, 0.01, slots)
        small = max(small, float(np.log(1e-3 * np.median(usual))))  # a sheet's thickness is a matter of its being thin
        step = max(float((high - low).max()) / 65535, FINE * float(np.median(usual)))
        corner = (float(low[0]), float(low[1]), float(low[2]))
        return cls(corner, step, small, max((large - small) / 255, 1e-6), slots)

    def to_dict(self) -> dict[str, Any]:
        """For the page."""
        return {"low": self.low, "step": self.step, "scaleLow": self.scale_low, "scaleStep": self.scale_step,
                "slots": self.slots}  # fmt: skip

    def records(self, g: Gaussians) -> np.ndarray:
        """u8 [n,16] of Gaussians; the colours are those without direction."""
        out = np.empty((len(g), RECORD), np.uint8)
        place = np.round((g.means.astype(np.float64) - self.low) / self.step)
        out[:, :6] = np.clip(place, 0, 65535).astype("<u2").view(np.uint8).reshape(-1, 6)
        logs = (np.log(np.maximum(g.scales, 1e-9)) - self.scale_low) / self.scale_step
        out[:, 6:9] = np.clip(np.round(logs), 0, 255)
        out[:, 9:12] = _turned(g.quats)
        out[:, 12:15] = np.round(255.0 * g.rgb)
        out[:, 15] = np.clip(np.round(255.0 * g.opacities), 1, 255)  # 0 means that nothing is there
        return out

    def gaussians(self, records: np.ndarray) -> Gaussians:
        """What records u8 [n,16] mean; empty slots are left out."""
        from fluidlift.types import sh_from_rgb

        r = records[records[:, 15] > 0]
        place = np.ascontiguousarray(r[:, :6]).view("<u2").reshape(-1, 3)
        scales = np.exp(self.scale_low + self.scale_step * r[:, 6:9])
        means = self.low + self.step * place.astype(np.float64)
        return Gaussians(means, _quats(r[:, 9:12]), scales, r[:, 15] / 255.0, sh_from_rgb(r[:, 12:15] / 255.0))


def _turned(quats: np.ndarray) -> np.ndarray:
    """u8 [n,3]: 7 bits of each of the smallest three in the order w, x, y, z; the top bits of the first two name the
    largest."""
    largest = np.abs(quats).argmax(axis=1)
    rows = np.arange(len(quats))
    q = quats * np.where(quats[rows, largest] < 0, -1.0, 1.0)[:, None]
    kept = q[np.arange(4) != largest[:, None]].reshape(-1, 3)
    out = np.clip(np.round(_HALF * (np.sqrt(2.0) * kept + 1.0)), 0, 127).astype(np.uint8)
    out[:, 0] |= ((largest & 1) << 7).astype(np.uint8)
    out[:, 1] |= ((largest >> 1) << 7).astype(np.uint8)
    return out


def _quats(stored: np.ndarray) -> np.ndarray:
    largest = (stored[:, 0] >> 7) | ((stored[:, 1] >> 7) << 1)
    kept = ((stored & 127) / _HALF - 1.0) / np.sqrt(2.0)
    q = np.zeros((len(stored), 4))
    q[np.arange(4) != largest[:, None]] = kept.ravel()
    q[np.arange(len(stored)), largest] = np.sqrt(np.maximum(0.0, 1.0 - (kept**2).sum(axis=1)))
    return q / np.linalg.norm(q, axis=1, keepdims=True)


class FrameEncoder:
    """Turns frames, in order, into what a page adds up."""

    def __init__(self, held: Quantization) -> None:
        self.range = held
        self._now = np.zeros((held.slots, RECORD), np.uint8)
        self._place = np.zeros((2, held.slots, 3), np.uint16)
        """of the frame before, and of the one before that"""
        self._ids = np.zeros(0, np.int64)
        self._slots = np.zeros(0, np.int64)

    def encode(self, gaussians: Gaussians, ids: np.ndarray) -> bytes:
        """The next frame, deflated. Every id occurs once in it."""
        slots, born = self._assigned(np.asarray(ids, np.int64))
        wanted, before = self.range.records(gaussians), self._now.copy()
        after = before.copy()
        after[:, 15] = 0  # whatever is not in this frame is gone
        after[slots] = _lazy(before[slots], wanted, born)
        expected = 2 * self._place[0] - self._place[1]  # in 16 bits, as the page computes it
        place = expected.copy()
        place[slots] = np.ascontiguousarray(wanted[:, :6]).view("<u2").reshape(-1, 3)
        residual = (place - expected).view(np.int16)
        zigzag = ((residual << 1) ^ (residual >> 15)).view(np.uint16)  # the sign in the lowest bit
        planes = np.concatenate([zigzag & 255, zigzag >> 8, after[:, 6:] - before[:, 6:]], axis=1).astype(np.uint8)
        self._now = after
        self._place = np.stack([place, self._place[0]])
        return zlib.compress(np.ascontiguousarray(planes.T).tobytes(), 6)

    def _assigned(self, ids: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The slot of every id, and which of them are new there."""
        order = np.argsort(self._ids)
        known, place = self._ids[order], self._slots[order]
        at = np.minimum(np.searchsorted(known, ids), max(len(known) - 1, 0))
        old = known[at] == ids if len(known) else np.zeros(len(ids), bool)
        slots = np.zeros(len(ids), np.int64)
        slots[old] = place[at[old]] if len(known) else 0
        free = np.ones(self.range.slots, bool)
        free[slots[old]] = False
        slots[~old] = np.flatnonzero(free)[: int((~old).sum())]
        self._ids, self._slots = ids, slots
        return slots, ~old


def _lazy(before: np.ndarray, wanted: np.ndarray, born: np.ndarray) -> np.ndarray:
    """The wanted records, with what has hardly changed left as it was."""
    out = wanted.copy()
    change = np.abs(before.astype(np.int16) - wanted)
    for columns, kept in ((slice(6, 9), _KEPT_SCALE), (slice(9, 12), _KEPT_TURN), (slice(12, 16), _KEPT_COLOR)):
        same = (change[:, columns].max(axis=1) <= kept) & ~born
        out[same, columns] = before[same, columns]
    return out


def decoded(frames: Iterable[bytes], slots: int) -> Iterator[np.ndarray]:
    """Records u8 [slots,16] of every frame: what the page's script does, for tests."""
    now, place, earlier = (np.zeros((slots, k), t) for k, t in ((RECORD, np.uint8), (3, np.uint16), (3, np.uint16)))
    for data in frames:
        planes = np.frombuffer(zlib.decompress(data), np.uint8).reshape(RECORD, slots).T
        zigzag = planes[:, :3].astype(np.uint16) | (planes[:, 3:_PLANES].astype(np.uint16) << 8)
        residual = (zigzag >> 1) ^ (-(zigzag & 1).astype(np.int32)).astype(np.uint16)
        place, earlier = 2 * place - earlier + residual, place
        now = now.copy()
        now[:, :6] = np.ascontiguousarray(place).view(np.uint8).reshape(-1, 6)
        now[:, 6:] += planes[:, _PLANES:]
        yield now
