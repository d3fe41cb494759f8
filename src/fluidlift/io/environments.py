"""Panoramas of light, as artists download them: Radiance .hdr and OpenEXR, equirectangular, 2:1, linear.

The layout of .hdr is that of Ward, "Real Pixels" (Graphics Gems II, 1991) and of the Radiance file formats: a text
header, then four bytes per pixel, red, green, blue and a common exponent, plain or in run lengths per scan line.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
from jaxtyping import Float

from fluidlift.errors import InputRejected
from fluidlift.io.confined import read_confined
from fluidlift.io.exr import MAX_SIDE, read_channels
from fluidlift.io.limits import ReadLimits, require_file, require_size

SUFFIXES = (".hdr", ".exr")
MAX_HEADER = 64 * 1024
"""bytes before the pixels of an .hdr"""
MAX_BYTES = 2**29
"""of a file"""
NEEDED = "a panorama in linear light: Radiance .hdr, or OpenEXR"
_PLAIN = {b"\x89PNG": "a PNG", b"\xff\xd8\xff": "a JPEG", b"RIFF": "a WebP", b"BM": "a BMP", b"GIF8": "a GIF"}
_SIZE = re.compile(rb"([-+])Y +(\d{1,9}) +([-+])X +(\d{1,9})$")


def read_environment_image(path: Path | str, *, limits: ReadLimits | None = None) -> Float[np.ndarray, "h 2*h 3"]:
    """The light of a panorama: float32, linear, as stored (an EXPOSURE in the header is not undone).

    Rows go from straight up to straight down, and the middle of the picture is straight ahead, as all tools of the
    trade write it.

    Args:
        path: of an .hdr or .exr. What it is is told by its content.
        limits: on its pixels.

    Raises:
        InputRejected: no such file, neither of these formats, cut off, too large, not twice as wide as high, or with
            values that are not finite or below 0; or reading it takes more than `io.confined` lets it take.
    """
    return read_confined(_read_environment, require_file(path, "panorama"), limits)


def _read_environment(path: Path, limits: ReadLimits) -> np.ndarray:
    require_size(path, MAX_BYTES, "panorama")
    with path.open("rb") as file:
        start = file.read(16)
    if start.startswith(b"#?"):
        picture = _radiance(path, limits)
    elif start.startswith(b"\x76\x2f\x31\x01"):
        picture = _openexr(path, limits)
    else:
        kind = next((what for magic, what in _PLAIN.items() if start.startswith(magic)), None)
        if kind is not None:
            raise InputRejected(
                f"'{path.name}' is {kind}: its highlights are cut off at white", NEEDED, "take the .hdr of the panorama"
            )
        raise InputRejected(f"'{path.name}' is no panorama of light", NEEDED, "check that it is the right file")
    return _checked(path, picture)


def _checked(path: Path, picture: np.ndarray) -> np.ndarray:
    height, width = picture.shape[:2]
    if width != 2 * height:
        raise InputRejected(
            f"'{path.name}' is {width} x {height} pixels",
            "an equirectangular panorama, twice as wide as high (2:1)",
            "convert light probes, cube maps and crosses to equirectangular first",
        )
    if height < 4:
        raise InputRejected(f"'{path.name}' is {width} x {height} pixels", "at least 8 x 4 pixels")
    broken = ~np.isfinite(picture)
    if broken.any():
        raise InputRejected(
            f"'{path.name}' has {int(broken.any(axis=2).sum())} pixels that are not finite",
            "finite light", "clamp the sun to 60000 and export it again",
        )  # fmt: skip
    lowest, mean = float(picture.min()), float(picture.mean(dtype=np.float64))
    if lowest < -0.01 * max(mean, 0.0) - 1e-6:  # resampling leaves a little below 0
        raise InputRejected(
            f"'{path.name}' has negative light (down to {lowest:.3g})", "light from 0", "clamp it at 0 and export again"
        )
    return np.maximum(picture, 0.0)


def _openexr(path: Path, limits: ReadLimits) -> np.ndarray:
    channels = read_channels(path, limits=limits)
    by_name = {name.rsplit(".", 1)[-1].upper(): values for name, values in channels.items()}
    by_name |= {name.upper(): values for name, values in channels.items()}  # the layer without a name comes first
    names = ("R", "G", "B") if all(c in by_name for c in "RGB") else ("Y", "Y", "Y")
    if names[0] not in by_name:
        listed = ", ".join(sorted(channels)[:8])
        raise InputRejected(f"'{path.name}' has the channels {listed}", "R, G and B, or Y", "export it as RGB")
    return np.stack([by_name[c] for c in names], axis=-1)


def _radiance(path: Path, limits: ReadLimits) -> np.ndarray:
    data = path.read_bytes()
    at, flip_rows, flip_columns, height, width = _header(path, data)
    if not (0 < width * height <= limits.max_pixels) or max(width, height) > MAX_SIDE:
        raise InputRejected(
            f"'{path.name}' is {width} x {height} pixels", f"1 to {limits.max_pixels} pixels", "scale it down"
        )
    bytes_left = len(data) - at
    packed = 8 <= width < 32768 and data[at : at + 4] == bytes((2, 2, width >> 8, width & 255))
    if packed:
        pixels = _run_lengths(path, data, at, height, width)
    elif bytes_left >= 4 * width * height:
        pixels = np.frombuffer(data, np.uint8, 4 * width * height, at).reshape(height, width, 4)
    else:
        raise _cut_off(path, f"{bytes_left} bytes for {width} x {height} pixels")
    scale = np.ldexp(np.float32(1.0), pixels[..., 3].astype(np.int32) - 136)  # 128, and 8 bits of the mantissa
    scale[pixels[..., 3] == 0] = 0.0
    picture = pixels[..., :3].astype(np.float32) * scale[..., None]
    picture = picture[::-1] if flip_rows else picture
    return np.ascontiguousarray(picture[:, ::-1] if flip_columns else picture)


def _header(path: Path, data: bytes) -> tuple[int, bool, bool, int, int]:
    """Where the pixels begin, whether rows and columns run the other way, height and width."""
    end = data.find(b"\n\n", 0, MAX_HEADER)
    line_end = data.find(b"\n", end + 2, MAX_HEADER + 64) if end >= 0 else -1
    size = _SIZE.match(data[end + 2 : line_end].strip()) if line_end >= 0 else None
    if size is None:
        raise InputRejected(
            f"'{path.name}' has no header of a Radiance picture", "a size such as '-Y 1024 +X 2048' after it",
            "export it again as .hdr",
        )  # fmt: skip
    form = re.search(rb"^FORMAT=(.*)$", data[:end], re.MULTILINE)
    if form is not None and form[1].strip() != b"32-bit_rle_rgbe":
        name = form[1].strip()[:40].decode("ascii", "replace")
        raise InputRejected(f"'{path.name}' has the format {name}", "32-bit_rle_rgbe", "export it again as RGB")
    return line_end + 1, size[1] == b"+", size[3] == b"-", int(size[2]), int(size[4])


def _run_lengths(path: Path, data: bytes, at: int, height: int, width: int) -> np.ndarray:
    """Scan line by scan line: all reds, all greens, all blues, all exponents."""
    mark, out = bytes((2, 2, width >> 8, width & 255)), np.empty((height, width, 4), np.uint8)
    for row in range(height):
        if data[at : at + 4] != mark:
            raise _cut_off(path, f"scan line {row} of {height} does not begin as it must")
        at, line = at + 4, bytearray()
        while len(line) < 4 * width:
            if at + 1 >= len(data):
                raise _cut_off(path, f"it ends in scan line {row} of {height}")
            count = data[at]
            if count == 0:
                raise _cut_off(path, f"a run of nothing in scan line {row}")
            if count > 128:
                line += data[at + 1 : at + 2] * (count - 128)
                at += 2
            else:
                line += data[at + 1 : at + 1 + count]
                at += 1 + count
        if len(line) != 4 * width:
            raise _cut_off(path, f"scan line {row} of {height} is too long")
        out[row] = np.frombuffer(bytes(line), np.uint8).reshape(4, width).T
    return out


def _cut_off(path: Path, why: str) -> InputRejected:
    return InputRejected(
        f"'{path.name}' is damaged or cut off ({why})", "a whole Radiance picture", "download it again"
    )
