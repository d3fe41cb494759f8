"""Optical flow from and for other tools: Middlebury .flo, OpenEXR motion vectors, .npz, .npy and KITTI's 16-bit PNG.

One file holds one pair of frames, or (.npz, .npy) the whole clip. What is read is the flow from a frame to the next one
in px per frame of the working picture, +x right and +y down, whatever the file's own size and axes are:

- A file of another size but of the same shape is resampled, and its vectors are scaled with it: flow at the resolution
  of the source fits working pictures of 512 px. Another shape is refused.
- OpenEXR: the channels are, in this order, `forward.u`/`forward.v` as Nuke writes them, any layer with `u`/`v`, then
  `x`/`y`, then `R`/`G`. Nuke counts rows from below, so v of a layer called `forward` points up; the v of all others is
  taken to point down, as in the picture. `FlowLayout` overrules names, axis and scale.
- Values that are no numbers, the 1e9 of Middlebury's unknown flow, and motion by more than the picture's diagonal have
  confidence 0 and displacement 0. A channel or array `confidence` (or `valid`) is read where there is one.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float

from fluidlift.errors import InputRejected, require
from fluidlift.io.atomic import atomic_write, write_bytes
from fluidlift.io.exr import read_channels
from fluidlift.io.exr_write import write_channels
from fluidlift.io.flow_arrays import FlowArray, open_array
from fluidlift.io.flow_sequence import FLOW_SUFFIXES, is_array, numbered_flow
from fluidlift.io.frames import FIRST_FRAME
from fluidlift.io.limits import ReadLimits, require_file
from fluidlift.io.pictures import read_picture, same_shape
from fluidlift.messages import Notice
from fluidlift.types import PixelFlow

UNKNOWN = 1e9
"""px: from here on a .flo file says "unknown" (Baker et al. 2011, the Middlebury benchmark)"""
_MAGIC = b"PIEH"
_EXR_PAIRS = (("u", "v"), ("x", "y"), ("r", "g"))

Pair = tuple[np.ndarray, np.ndarray]
"""displacement float32 [H,W,2] in px per frame, confidence float32 [H,W] from 0 to 1"""


@dataclass(frozen=True)
class FlowLayout:
    """What the numbers of a flow file mean where it does not say so itself."""

    channels: tuple[str, str] | None = None
    """names of the two OpenEXR channels; None: the first pair that is known"""
    v_up: bool | None = None
    """whether v points up; None: as Nuke means it in layers called `forward`, else down"""
    scale: float = 1.0
    """px of the file's own picture per stored unit, such as -1 for vectors that point back"""
    first_number: int | None = None
    """number in the file name of the flow from the clip's first frame; None: the lowest number"""

    def __post_init__(self) -> None:
        require(np.isfinite(self.scale) and self.scale != 0, f"scale {self.scale}", "a number other than 0")


class FlowFiles:
    """The flow of a clip on disk, read pair by pair."""

    def __init__(
        self,
        source: FlowArray | list[Path],
        size: tuple[int, int],
        layout: FlowLayout,
        limits: ReadLimits,
        start: int = 0,
    ) -> None:
        self._source, self._size, self._layout, self._limits, self._start = source, size, layout, limits, start
        self.warnings: tuple[Notice, ...] = ()
        """what the user should know"""
        first, own = self._stored(0)
        _require_shape(first, own, size)
        if own != size:
            self.warnings += (
                Notice(
                    "flow-resampled",
                    f"the flow is {own[0]} x {own[1]} px: resampled to {size[0]} x {size[1]}, its vectors scaled "
                    f"with it",
                ),
            )
        if not (self.pair(0)[1] > 0).any():
            raise InputRejected(
                f"'{first}' holds no usable flow (unknown, not finite, or longer than the picture)",
                "displacements in px per frame",
                "check what the file holds; --set motion.flow_scale turns other units into px",
            )

    def __len__(self) -> int:
        return len(self._source)

    @property
    def has_confidence(self) -> bool:
        """Whether the first pair says how sure it is; all finite values are trusted where not."""
        return self._read(0)[3] is not None

    def pair(self, t: int) -> Pair:
        """Flow from frame t to t+1 of the clip and its confidence, at the size asked for.

        Raises:
            InputRejected: the file of this pair is damaged or has another shape.
            IndexError: no such pair.
        """
        if not 0 <= t < len(self):
            raise IndexError(f"pair {t} of {len(self)}")
        name, own, displacement, confidence = self._read(t)
        _require_shape(name, own, self._size)
        return resized_flow(*cleaned_flow(displacement, confidence), self._size)

    def window(self, first: int, last: int) -> PixelFlow:
        """The flow of pairs first to last-1: displacement float32, confidence float16."""
        (w, h), pairs = self._size, last - first
        displacement = np.empty((pairs, h, w, 2), np.float32)
        confidence = np.empty((pairs, h, w), np.float16)
        for i in range(pairs):
            displacement[i], confidence[i] = self.pair(first + i)
        return PixelFlow(displacement, confidence)

    def _stored(self, t: int) -> tuple[str, tuple[int, int]]:
        return self._read(t)[:2]

    def _read(self, t: int) -> tuple[str, tuple[int, int], np.ndarray, np.ndarray | None]:
        """Name, (width, height), and the numbers as they are stored but for axis and scale."""
        if isinstance(self._source, FlowArray):
            name = f"{self._source.name} (frame {self._start + t})"
            displacement, confidence = self._source.pair(t)
            displacement, up = displacement.astype(np.float32), bool(self._layout.v_up)
        else:
            name = f"{self._source[t].name} (frame {self._start + t})"
            displacement, confidence, up = read_pair(self._source[t], self._layout, self._limits)
            displacement = displacement.astype(np.float32, copy=not displacement.flags.writeable)
        # in place and by channel: a picture may have 35 million pixels, and every copy is 300 MB
        for c, sign in enumerate((1, -1 if up else 1)):
            part = displacement[..., c]
            part[~(np.abs(part) < UNKNOWN)] = np.nan  # before the scale, which must not bring the marker into reach
            part *= np.float32(self._layout.scale) * np.float32(sign)
        return name, (displacement.shape[1], displacement.shape[0]), displacement, confidence


def open_flow(
    path: Path | str,
    size: tuple[int, int],
    pairs: int,
    *,
    start: int = 0,
    layout: FlowLayout | None = None,
    limits: ReadLimits | None = None,
) -> FlowFiles:
    """The flow of a clip, to be read pair by pair: memory does not grow with the clip (.npz apart).

    Args:
        path: one file, a folder of numbered files, or a pattern such as flow.%04d.exr or flow.####.flo.
        size: width, height of the clip in px.
        pairs: frames of the clip less one. More may be there.
        start: number of the clip's first frame in the source, where the clip was trimmed.
        layout: what the numbers mean.
        limits: of one picture and of an array in memory.

    Raises:
        InputRejected: nothing readable there, too few pairs or a gap (with the first frame that lacks), another aspect
            ratio, or no usable flow in the first pair.
    """
    require(pairs >= 1 and start >= 0, f"{pairs} pairs from frame {start}", "at least one pair from 0 on")
    layout, limits = layout or FlowLayout(), limits or ReadLimits()
    if is_array(path):
        return FlowFiles(open_array(path, pairs, start, limits), size, layout, limits, start)
    if Path(path).is_file() and Path(path).suffix.lower() in FLOW_SUFFIXES:
        read_pair(Path(path), layout, limits)  # that it is no flow is said before that there is only one
    return FlowFiles(numbered_flow(path, pairs, start, layout.first_number), size, layout, limits, start)


def read_pair(path: Path, layout: FlowLayout, limits: ReadLimits) -> tuple[np.ndarray, np.ndarray | None, bool]:
    """What one file holds: displacement [H,W,2] as stored, confidence [H,W] or None, and whether v points up.

    Raises:
        InputRejected: damaged, of another kind, or too large.
    """
    suffix = path.suffix.lower()
    if suffix == ".flo":
        return read_flo(path, limits=limits), None, bool(layout.v_up)
    if suffix == ".exr":
        return _from_exr(path, layout, limits)
    if suffix == ".png":
        return *_from_kitti(path, limits), bool(layout.v_up)
    return *open_array(path, 1, 0, limits).pair(0), bool(layout.v_up)


def read_flo(path: Path | str, *, limits: ReadLimits | None = None) -> Float[np.ndarray, "h w 2"]:
    """A Middlebury .flo file as it is, float32; unknown flow is 1e9 or more.

    Raises:
        InputRejected: no such file, not a .flo file, cut off, or more pixels than `limits.max_pixels`.
    """
    path, limits = require_file(path, ".flo file"), limits or ReadLimits()
    with path.open("rb") as file:
        head = file.read(12)
        if len(head) < 12 or head[:4] != _MAGIC:
            raise InputRejected(f"'{path.name}' does not begin as a .flo file does", "Middlebury's .flo")
        width, height = struct.unpack("<ii", head[4:])
        if width < 1 or height < 1 or width * height > limits.max_pixels:
            raise InputRejected(f"'{path.name}' says {width} x {height} px", f"1 to {limits.max_pixels} pixels")
        expected, found = 12 + 8 * width * height, path.stat().st_size
        if found != expected:
            raise InputRejected(
                f"'{path.name}' has {found} bytes", f"{expected} bytes for {width} x {height} px", "copy it again"
            )
        return np.fromfile(file, "<f4", 2 * width * height).reshape(height, width, 2)


def _from_exr(path: Path, layout: FlowLayout, limits: ReadLimits) -> tuple[np.ndarray, np.ndarray | None, bool]:
    channels = read_channels(path, limits=limits)
    u, v = layout.channels or _known_channels(path, list(channels))
    if u not in channels or v not in channels:
        raise InputRejected(f"'{path.name}' has the channels {', '.join(channels)}", f"{u} and {v}")
    up = u.lower().split(".")[-2:-1] == ["forward"] if layout.v_up is None else layout.v_up
    layer = u.rpartition(".")[0]
    trust = (f"{layer}.confidence", f"{layer}.valid", "confidence", "valid")
    named = next((channels[n] for n in trust if n in channels), None)
    return np.stack([channels[u], channels[v]], axis=-1), named, up


def _known_channels(path: Path, names: list[str]) -> tuple[str, str]:
    """The two channels that hold the motion to the next frame."""
    split = {name: tuple(name.lower().rpartition(".")[::2]) for name in names}
    layers = sorted({layer for layer, _ in split.values()}, key=lambda layer: (not layer.endswith("forward"), layer))
    for pair in _EXR_PAIRS:
        for layer in layers:
            parts = {part: name for name, (its, part) in split.items() if its == layer}
            four = {"x", "y", "z", "w"} <= parts.keys()  # Blender's: to and from this frame, and not in our order
            if not layer.endswith("backward") and not four and pair[0] in parts and pair[1] in parts:
                return parts[pair[0]], parts[pair[1]]
    raise InputRejected(
        f"'{path.name}' has the channels {', '.join(names)}",
        "forward.u and forward.v, u and v, x and y, or R and G",
        "name the two that hold the motion to the next frame: --set motion.flow_channels=R,G",
    )


def _from_kitti(path: Path, limits: ReadLimits) -> Pair:
    """(sample - 2^15) / 64 px in red and green, validity in blue (Menze and Geiger 2015)."""
    picture = read_picture(path, limits=limits)
    if picture.dtype != np.uint16 or picture.ndim != 3 or picture.shape[2] != 3:
        raise InputRejected(f"'{path.name}' is not 16-bit RGB", "flow as KITTI stores it", "write .flo or .exr")
    displacement = picture[..., :2].astype(np.float32)
    displacement -= 2**15
    displacement /= 64
    return displacement, (picture[..., 2] > 0).astype(np.float32)


def cleaned_flow(displacement: Float[np.ndarray, "h w 2"], confidence: Float[np.ndarray, "h w"] | None) -> Pair:
    """Finite values only: what is not a number, or longer than the picture's diagonal, becomes 0 with confidence 0."""
    height, width = displacement.shape[:2]
    with np.errstate(over="ignore", invalid="ignore"):
        known = np.hypot(displacement[..., 0], displacement[..., 1]) <= np.hypot(width, height)  # False for NaN
    trust = np.ones((height, width), np.float32) if confidence is None else confidence.astype(np.float32)
    np.nan_to_num(trust, copy=False, nan=0.0)
    np.clip(trust, 0.0, 1.0, out=trust)
    trust[~known] = 0.0
    return np.where(known[..., None], displacement, 0.0).astype(np.float32, copy=False), trust


def resized_flow(
    displacement: Float[np.ndarray, "h w 2"], confidence: Float[np.ndarray, "h w"], size: tuple[int, int]
) -> Pair:
    """Flow on a picture of another size (width, height), in its pixels.

    Averages are weighted with confidence, so that pixels without flow do not pull their neighbours to 0.
    """
    height, width = confidence.shape
    if (width, height) == size:
        return displacement, confidence
    method = cv2.INTER_AREA if size[0] <= width and size[1] <= height else cv2.INTER_LINEAR
    trust = cv2.resize(confidence, size, interpolation=method)
    weighted = cv2.resize(displacement * confidence[..., None], size, interpolation=method)
    out = np.where(trust[..., None] > 1e-6, weighted / np.maximum(trust, 1e-6)[..., None], 0.0)
    return (out * np.array([size[0] / width, size[1] / height])).astype(np.float32), trust


def write_flow(
    folder: Path | str,
    t: int,
    displacement: Float[np.ndarray, "h w 2"],
    confidence: Float[np.ndarray, "h w"] | None,
    format: str = "flo",
) -> Path:
    """Write the flow from frame t to t+1 as `flow.####` (numbers from 1001) into `folder`; the file written.

    - "flo": what is not a number is marked as unknown. The format has no place for confidence: it is left out.
    - "exr": `forward.u`, `forward.v` in px as Nuke reads them (v points up), and `confidence`.
    - "npz": `displacement` (+y down) and `confidence`.

    Raises:
        ValueError: operands of unlike size, or another format.
        InputRejected: the disk does not take it.
    """
    displacement = np.asarray(displacement, np.float32)
    require(displacement.ndim == 3 and displacement.shape[2] == 2, f"displacement {displacement.shape}", "[H,W,2]")
    require(
        confidence is None or confidence.shape == displacement.shape[:2],
        "a confidence of another size than the displacement",
    )
    require(format in ("flo", "exr", "npz"), f"flow format '{format}'", "flo, exr or npz")
    path = Path(folder) / f"flow.{FIRST_FRAME + t:04d}.{format}"
    if format == "flo":
        height, width = displacement.shape[:2]
        known = np.where(np.isfinite(displacement).all(axis=-1, keepdims=True), displacement, 10 * UNKNOWN)
        return write_bytes(path, _MAGIC + struct.pack("<ii", width, height) + known.astype("<f4").tobytes())
    extra = {} if confidence is None else {"confidence": np.asarray(confidence, np.float32)}
    if format == "exr":
        return write_channels(path, {"forward.u": displacement[..., 0], "forward.v": -displacement[..., 1], **extra})
    with atomic_write(path) as file:
        np.savez_compressed(file, allow_pickle=False, displacement=displacement, **extra)
    return path


def _require_shape(name: str, own: tuple[int, int], size: tuple[int, int]) -> None:
    if not same_shape(own, size):
        raise InputRejected(
            f"the flow '{name}' is {own[0]} x {own[1]} px",
            f"{size[0]} x {size[1]} px or the same shape at another size",
            "export the flow of the whole picture",
        )
