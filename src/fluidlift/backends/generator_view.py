"""From the original picture to what a generator sees of it, and from the generator's camera back to the original.

Every generator looks at a square cut-out of its own making. `Crop` remembers how that lies in the original, so that the
camera of the cut-out becomes one of the whole picture: its focal length and principal point are scaled and shifted,
its pose stays. A cut-out away from the middle therefore has its principal point away from the middle of the picture.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, UInt8

from fluidlift.errors import InputRejected, require
from fluidlift.types import Gaussians, PinholeCamera, Similarity3, UpEvidence

Z_UP_FROM_Y_UP = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
"""x right, y up, z towards the viewer (OpenGL) to x right, y away from the viewer, z up"""
Z_UP_FROM_OPENCV = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
"""x right, y down, z forward to x right, y away from the viewer, z up"""


@dataclass(frozen=True)
class Crop:
    """Where a generator's picture lies in the original: (u, v) there = scale * (u, v) + offset here."""

    scale: tuple[float, float]
    """px of the generator's picture per px of the original"""
    offset: tuple[float, float]
    """px of the generator's picture: where the upper left corner of the original would lie"""
    size: tuple[int, int]
    """width, height of the generator's picture"""

    @classmethod
    def of_box(cls, box: tuple[float, float, float, float], size: tuple[int, int]) -> Crop:
        """A box (left, upper, right, lower; px) that becomes a picture of `size`."""
        left, upper, right, lower = box
        scale = (size[0] / (right - left), size[1] / (lower - upper))
        return cls(scale, (-left * scale[0], -upper * scale[1]), size)

    def after(self, first: Crop) -> Crop:
        """This one, cut from a picture that `first` had made."""
        (sx, sy), (ox, oy) = self.scale, self.offset
        scale = (sx * first.scale[0], sy * first.scale[1])
        return Crop(scale, (sx * first.offset[0] + ox, sy * first.offset[1] + oy), self.size)

    def seen(self, camera: PinholeCamera) -> PinholeCamera:
        """The camera of the generator's picture, given the one of the original."""
        (sx, sy), (ox, oy) = self.scale, self.offset
        return replace(
            camera,
            focal=(camera.focal[0] * sx, camera.focal[1] * sy),
            center=(camera.center[0] * sx + ox, camera.center[1] * sy + oy),
            size=self.size,
        )

    def camera(self, seen: PinholeCamera, size: tuple[int, int]) -> PinholeCamera:
        """The camera of the original picture (of `size`), given the one of the generator's picture."""
        require(seen.size == self.size, f"a camera of {seen.size} px", f"one of the cut-out, {self.size} px")
        (sx, sy), (ox, oy) = self.scale, self.offset
        return replace(
            seen,
            focal=(seen.focal[0] / sx, seen.focal[1] / sy),
            center=((seen.center[0] - ox) / sx, (seen.center[1] - oy) / sy),
            size=(int(size[0]), int(size[1])),
        )


@dataclass(frozen=True)
class Prepared:
    """A picture as its generator wants it."""

    image: np.ndarray
    """[h, w, 3], uint8 or float32 in [0, 1], on the generator's background"""
    crop: Crop
    alpha: Float[np.ndarray, "h w"] | None = None
    """coverage in [0, 1], where the generator takes it"""


def require_picture(image: UInt8[np.ndarray, "h w 3"], mask: Bool[np.ndarray, "h w"], smallest: int = 8) -> None:
    """Raise `InputRejected` unless there is something to make a body of.

    Args:
        image: u8, sRGB.
        mask: the fluid.
        smallest: px that the fluid must be wide and high.
    """
    fits = image.ndim == 3 and image.shape[2] == 3 and image.dtype == np.uint8 and mask.shape == image.shape[:2]
    require(fits, f"a picture {image.shape} {image.dtype} and a mask {mask.shape}", "uint8 [h, w, 3] and [h, w]")
    if not mask.any():
        raise InputRejected(
            "no fluid in this frame", "a mask with the fluid", "choose another frame, or check the mask"
        )
    left, upper, right, lower = box_of(mask)
    if min(right - left, lower - upper) + 1 < smallest:
        raise InputRejected(
            f"fluid of {right - left + 1} x {lower - upper + 1} px", f"at least {smallest} px across",
            "raise --max-size, or check the mask",
        )  # fmt: skip


def box_of(mask: Bool[np.ndarray, "h w"]) -> tuple[int, int, int, int]:
    """First and last column and row: left, upper, right, lower, the last ones included."""
    rows, columns = np.flatnonzero(mask.any(1)), np.flatnonzero(mask.any(0))
    return int(columns[0]), int(rows[0]), int(columns[-1]), int(rows[-1])


def rgba(image: UInt8[np.ndarray, "h w 3"], mask: Bool[np.ndarray, "h w"]) -> UInt8[np.ndarray, "h w 4"]:
    """The picture with the mask as its alpha."""
    return np.dstack([image, np.where(mask, 255, 0).astype(np.uint8)])


def square_camera(seen: Crop, fov_degrees: float, eye: np.ndarray) -> PinholeCamera:
    """The camera of a cut-out that looks from `eye` at the origin, z up, with one field of view both ways.

    The cut-out may be a pixel off square; as its field of view is the same both ways, its focal lengths then differ.
    """
    camera = PinholeCamera.looking(eye, np.zeros(3), fov_degrees, (seen.size[0], seen.size[0]))
    f = camera.focal[0] / seen.size[0]
    (w, h) = seen.size
    return replace(camera, focal=(f * w, f * h), center=(w / 2, h / 2), size=(w, h))


def tilted(
    gaussians: Gaussians, camera: PinholeCamera, *, pitch: float, roll: float = 0.0
) -> tuple[Gaussians, PinholeCamera]:
    """Body and camera turned together so that the camera looks `pitch` degrees below the horizon.

    For generators whose z is only the picture's up (`knows_up` is False): they take every camera for a level one. The
    picture stays as it is; the camera comes to the origin, with y away from the viewer.
    """
    from fluidlift.shape.kind import level_camera  # which the environment of a generator may not hold

    target = level_camera(camera, UpEvidence(pitch, roll, "generator", 1.0))
    turn = target.camera_from_world.rotation.T @ camera.camera_from_world.rotation
    move = Similarity3(1.0, turn, -turn @ camera.position)
    return gaussians.transformed(move), target
