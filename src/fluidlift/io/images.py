"""What a user may bring besides the clip: masks, depth and cameras."""

from __future__ import annotations

import zipfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import Bool, Float

from fluidlift.errors import InputRejected
from fluidlift.io.array_archive import DAMAGE, array_in, mapped_array, members_of, release_pages
from fluidlift.io.exr import read_channels
from fluidlift.io.limits import ReadLimits, read_json, require_file, require_size
from fluidlift.io.pictures import PICTURE_SUFFIXES, read_picture, resample, same_shape, write_png
from fluidlift.io.sequences import is_sequence, list_sequence
from fluidlift.io.video import read_clip
from fluidlift.messages import Notice
from fluidlift.types import PinholeCamera, RigidTransform, VideoClip

__all__ = [
    "read_camera",
    "read_depth",
    "read_distortion",
    "read_json",
    "read_mask",
    "undistort_clip",
    "undistort_mask",
    "write_png",
]


def read_mask(
    path: Path | str,
    size: tuple[int, int],
    frames: int,
    *,
    start: float = 0.0,
    duration: float | None = None,
    limits: ReadLimits | None = None,
) -> Bool[np.ndarray, "*t h w"]:
    """Which pixels are fluid: [H,W] from one picture, [T,H,W] from a folder, a sequence or a video.

    White (or opaque, where an alpha channel says anything) is fluid. A mask of another size but of the clip's aspect
    ratio, such as one drawn on the full-size video, is resampled.

    Args:
        path: a picture, a folder of pictures, a pattern such as masks/%04d.png, or a video.
        size: width, height of the clip in px.
        frames: number of frames of the clip.
        start, duration: s, where the mask is a video that was cut as the clip was.

    Raises:
        InputRejected: empty mask, another aspect ratio, another number of frames, or an unreadable file.
    """
    path = Path(path)
    if is_sequence(path):
        files = [file for _, file in list_sequence(path)]
        count, pictures = len(files), (read_picture(file, limits=limits) for file in files)
    elif path.suffix.lower() in PICTURE_SUFFIXES:
        count, pictures = 1, iter((read_picture(path, limits=limits),))
    else:
        clip = read_clip(path, start=start, duration=duration, max_size=max(*size, 16), limits=limits)
        count, pictures = len(clip), iter(clip.frames if clip.alpha is None else clip.alpha)
    if count not in (1, frames):
        raise InputRejected(
            f"'{path.name}' has {count} masks", f"one, or {frames} (one per frame)", "cut it as the clip is cut"
        )
    fitted = np.empty((count, size[1], size[0]), bool)
    for t, picture in enumerate(pictures):
        fitted[t] = _fitted_mask(_binary(picture), size, path.name)
    if not fitted.any():
        raise InputRejected(
            f"the mask '{path.name}' is empty (nothing is white or opaque)",
            "white (255) where the fluid is, black elsewhere",
            "check that it is not inverted to black and that the layer was exported",
        )
    return fitted[0] if count == 1 else fitted


def _binary(picture: np.ndarray) -> np.ndarray:
    """float32 0/1 of a mask picture of any depth; the alpha channel decides where it is not constant."""
    if picture.ndim == 3 and picture.shape[2] == 4 and picture[..., 3].min() < picture[..., 3].max():
        picture = picture[..., 3]
    elif picture.ndim == 3:
        picture = picture[..., :3].max(axis=-1)
    top = {np.dtype(np.uint8): 255, np.dtype(np.uint16): 65535}.get(picture.dtype, 1.0)
    if picture.max(initial=0) <= 1:
        top = 1.0  # masks of 0 and 1
    return (picture > 0.5 * top).astype(np.float32)


def _fitted_mask(mask: np.ndarray, size: tuple[int, int], name: str) -> np.ndarray:
    _require_shape(mask.shape[1::-1], size, f"the mask '{name}'")
    return resample(mask, size) >= 0.5


def _require_shape(got: tuple[int, int], size: tuple[int, int], what: str) -> None:
    if not same_shape(got, size):
        raise InputRejected(
            f"{what} is {got[0]} x {got[1]} px, another aspect ratio than the clip's {size[0]} x {size[1]}",
            "the size of the video or of the clip",
            "export it at the size of the video, upright",
        )


def read_depth(
    path: Path | str, size: tuple[int, int], *, scale: float | None = None, positive: bool = True,
    limits: ReadLimits | None = None,
) -> Float[np.ndarray, "*t h w"]:  # fmt: skip
    """Camera depth z (not ray length), float32 [H,W] or, from arrays, [T,H,W]; nan where the file says nothing.

    Depth is taken from the nearest pixel: averages across an edge lie where nothing is.

    Args:
        path: OpenEXR, a 16-bit PNG or TIFF, a float TIFF, .npy, or .npz (its array `depth`, or its only array).
        size: width, height of the clip in px.
        scale: m per stored unit. None: 0.001 (millimetres) for 16-bit pictures, 1 for floats.
        positive: what is not positive says nothing; False: any number is meant (disparity with an offset).

    Raises:
        InputRejected: an unreadable file, another aspect ratio, 8-bit samples, or no valid depth.
    """
    path = require_file(path, "depth file")
    limits = limits or ReadLimits()
    suffix = path.suffix.lower()
    if suffix in (".npy", ".npz"):
        depth = _depth_array(path, limits)
    elif suffix == ".exr":
        depth = _depth_channel(path, limits)
    else:
        depth = read_picture(path, limits=limits)
        if depth.dtype == np.uint8:
            raise InputRejected(f"'{path.name}' has 8 bits", "16-bit or floating-point depth", "export 16-bit PNG")
        if depth.ndim == 3:
            depth = depth[..., 0]
    if scale is None:
        scale = 0.001 if depth.dtype == np.uint16 else 1.0
    if depth.ndim not in (2, 3):
        raise InputRejected(f"'{path.name}' holds an array {depth.shape}", "[H,W] or [T,H,W]")
    _require_shape(depth.shape[:-3:-1], size, f"the depth '{path.name}'")
    layers = depth[None] if depth.ndim == 2 else depth
    if len(layers) == 0:
        raise InputRejected(f"'{path.name}' holds an array {depth.shape}", "at least one frame of depth")
    if len(layers) > limits.max_frames or layers[0].size > limits.max_pixels:
        raise InputRejected(
            f"'{path.name}' holds an array {depth.shape}",
            f"at most {limits.max_frames} frames of {limits.max_pixels} pixels",
        )
    fitted = np.empty((len(layers), size[1], size[0]), np.float32)
    for layer, out in zip(layers, fitted):  # one by one: the array may be larger than memory
        out[:] = cv2.resize(layer.astype(np.float32) * np.float32(scale), size, interpolation=cv2.INTER_NEAREST_EXACT)
        release_pages(layers)
    fitted[~(np.isfinite(fitted) & ((fitted > 0) | (not positive)))] = np.nan
    if not np.isfinite(fitted).any():
        raise InputRejected(f"no valid depth in '{path.name}'", "positive metres", "look at it: is it black?")
    return fitted[0] if depth.ndim == 2 else fitted


def _depth_channel(path: Path, limits: ReadLimits) -> np.ndarray:
    """The channel of an OpenEXR file that holds depth; renderers write 1e10 or more where there is nothing."""
    channels = read_channels(path, limits=limits)
    wanted = ("z", "depth.z", "depth", "depth.v", "y", "v", "r")
    named = {name.lower(): name for name in channels}
    layer = [n for n in named if n.endswith((".z", "depth.v", ".depth"))]  # ViewLayer.Depth.Z and the like
    hit = next((named[n] for n in (*wanted, *layer) if n in named), None)
    if hit is None:
        raise InputRejected(f"'{path.name}' has the channels {', '.join(channels)}", "a channel Z, depth.Z, Y or R")
    return np.where(channels[hit] < 1e9, channels[hit], np.nan)


def _depth_array(path: Path, limits: ReadLimits) -> np.ndarray:
    """The array, mapped where it is large."""
    require_size(path, limits.max_bytes, "depth array")
    try:
        if not zipfile.is_zipfile(path):
            return mapped_array(path, kinds="fui")
        with zipfile.ZipFile(path) as archive:
            members = members_of(archive, limits.max_bytes)
            if "depth" not in members and len(members) != 1:
                listed = ", ".join(members)[:200] or "nothing"
                raise InputRejected(f"'{path.name}' holds {listed}", "an array 'depth'")
            return array_in(archive, members.get("depth") or next(iter(members.values())), kinds="fui")
    except DAMAGE as error:
        raise InputRejected(
            f"'{path.name}' cannot be read as an array ({str(error)[:200]})",
            "numbers saved with numpy.save or numpy.savez",
        ) from None


def read_camera(path: Path | str, size: tuple[int, int]) -> PinholeCamera:
    """The camera of the clip, scaled to its size.

    Two kinds of file: width, height, K, R, t as `PinholeCamera.to_dict` writes them (further keys are let pass), and
    nerfstudio's transforms.json (OpenGL axes, z-up world; all frames must have one pose, since the camera stands).

    Args:
        path: a JSON file.
        size: width, height of the clip in px.

    Raises:
        InputRejected: an unreadable file, missing keys, another aspect ratio, or a moving camera.
    """
    data = read_json(path, "camera JSON")
    name = Path(path).name
    if not isinstance(data, dict):
        raise InputRejected(f"'{name}' holds no camera", "a JSON object with width, height and K")
    camera = _from_transforms(data, name) if "frames" in data and "K" not in data else PinholeCamera.from_dict(data)
    _require_shape(camera.size, size, f"the camera of '{name}'")
    return camera.resized(size)


def _from_transforms(data: dict[str, Any], name: str) -> PinholeCamera:
    try:
        poses = np.array([f["transform_matrix"] for f in data["frames"]], float).reshape(-1, 4, 4)
        first = {**data, **data["frames"][0]}
        size = (int(first["w"]), int(first["h"]))
        if "fl_x" in first:
            focal = float(first["fl_x"]), float(first.get("fl_y", first["fl_x"]))
        else:
            focal = (0.5 * size[0] / np.tan(0.5 * float(first["camera_angle_x"])),) * 2
        center = float(first.get("cx", size[0] / 2)), float(first.get("cy", size[1] / 2))
        if len(poses) == 0 or np.abs(poses - poses[0]).max() > 1e-3 * max(1.0, np.abs(poses[0, :3, 3]).max()):
            raise InputRejected(f"'{name}' has a moving camera", "one pose", "give a clip from a standing camera")
        rotation = poses[0, :3, :3] @ np.diag([1.0, -1.0, -1.0])  # world from camera, OpenGL axes to OpenCV axes
        pose = RigidTransform(rotation, poses[0, :3, 3]).inverse()
        return PinholeCamera(focal, center, size, pose)
    except (KeyError, TypeError, ValueError, IndexError, AttributeError, OverflowError) as error:
        raise InputRejected(
            f"'{name}' is a transforms.json that cannot be read ({type(error).__name__}: {error})",
            "w, h, fl_x or camera_angle_x, and frames with a rigid transform_matrix (4x4)",
        ) from None


def read_distortion(path: Path | str) -> tuple[float, ...] | None:
    """k1, k2, p1, p2 (and k3) of a camera file in OpenCV's model, or None where it has none or only zeros."""
    data = read_json(path, "camera JSON")
    if not isinstance(data, dict):
        return None
    listed = data.get("distortion_k1_k2_p1_p2", data.get("distortion"))
    values = listed if listed is not None else [data.get(k, 0.0) for k in ("k1", "k2", "p1", "p2", "k3")]
    try:
        numbers = tuple(float(v) for v in values)
    except (TypeError, ValueError, OverflowError):
        raise InputRejected(f"distortion {values} in '{Path(path).name}'", "4 or 5 numbers: k1 k2 p1 p2 (k3)") from None
    if not any(numbers):
        return None
    if len(numbers) not in (4, 5) or not np.isfinite(numbers).all():
        raise InputRejected(f"distortion {numbers} in '{Path(path).name}'", "4 or 5 numbers: k1 k2 p1 p2 (k3)")
    return numbers


def undistort_clip(clip: VideoClip, camera: PinholeCamera, distortion: tuple[float, ...]) -> VideoClip:
    """The clip as the pinhole camera without lens distortion would have seen it.

    Pixels that the lens did not see are black, and transparent where the clip has an alpha channel.

    Args:
        camera: at the size of the clip.
        distortion: k1, k2, p1, p2 (and k3), OpenCV's model, for the same camera.
    """
    maps = _lens_maps(camera, distortion)
    frames = np.stack([cv2.remap(frame, *maps, cv2.INTER_LINEAR) for frame in clip.frames])
    alpha = None
    if clip.alpha is not None:
        alpha = np.stack([cv2.remap(layer, *maps, cv2.INTER_LINEAR) for layer in clip.alpha])
    note = Notice("lens-straightened", "lens distortion was removed with the coefficients of the camera file")
    return replace(clip, frames=frames, alpha=alpha, warnings=(*clip.warnings, note))


def undistort_mask(
    mask: Bool[np.ndarray, "*t h w"], camera: PinholeCamera, distortion: tuple[float, ...]
) -> Bool[np.ndarray, "*t h w"]:
    """A mask that was drawn on the distorted video, moved as `undistort_clip` moves the pictures."""
    maps = _lens_maps(camera, distortion)
    layers = mask.reshape(-1, *mask.shape[-2:]).astype(np.uint8)
    return np.stack([cv2.remap(layer, *maps, cv2.INTER_NEAREST) for layer in layers]).reshape(mask.shape) > 0


def _lens_maps(camera: PinholeCamera, distortion: tuple[float, ...]) -> tuple[np.ndarray, np.ndarray]:
    """Where each pixel of the corrected picture lies in the distorted one."""
    (fx, fy), (cx, cy) = camera.focal, camera.center
    matrix = np.array([[fx, 0, cx - 0.5], [0, fy, cy - 0.5], [0, 0, 1.0]])  # OpenCV puts pixel centres at integers
    return cv2.initUndistortRectifyMap(matrix, np.array(distortion), None, matrix, camera.size, cv2.CV_32FC1)
