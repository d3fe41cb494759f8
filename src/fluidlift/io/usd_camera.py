"""The pinhole camera as a UsdGeom.Camera, and back."""

from __future__ import annotations

import numpy as np
from pxr import Gf, Usd, UsdGeom

from fluidlift.types import PinholeCamera, RigidTransform, Similarity3

FILM = 0.036
"""m: the width of the film back that is written, that of a 35 mm camera. Only its ratio to the focal length is known"""
CLIPPING = (0.01, 100_000.0)
"""m"""

_FLIP = np.diag([1.0, -1.0, -1.0])
"""USD's cameras look along -z with y up, OpenCV's along z with y down"""


def write_camera(prim: UsdGeom.Camera, camera: PinholeCamera, place: Similarity3 | None = None) -> None:
    """Write a camera whose picture is that of the pinhole camera, principal point and unequal focal lengths included.

    Args:
        prim: to fill.
        camera: world, m.
        place: file_from_world; its scale is units per metre. None: the file is in metres.

    The schema counts focal length and apertures in tenths of a scene unit. A principal point to the right of the
    picture's middle is a film back moved to the left, so its offset is negative; one below it, a positive one upwards.
    """
    place = place or Similarity3()
    (fx, fy), (cx, cy), (width, height) = camera.focal, camera.center, camera.size
    aperture = 10.0 * FILM * place.scale
    focal = aperture * fx / width
    prim.CreateProjectionAttr(UsdGeom.Tokens.perspective)
    prim.CreateFocalLengthAttr(focal)
    prim.CreateHorizontalApertureAttr(aperture)
    prim.CreateVerticalApertureAttr(focal * height / fy)
    prim.CreateHorizontalApertureOffsetAttr(focal * (0.5 * width - cx) / fx)
    prim.CreateVerticalApertureOffsetAttr(focal * (cy - 0.5 * height) / fy)
    prim.CreateClippingRangeAttr(Gf.Vec2f(CLIPPING[0] * place.scale, CLIPPING[1] * place.scale))
    file_from_camera = np.eye(4)
    file_from_camera[:3, :3] = place.rotation @ camera.camera_from_world.rotation.T @ _FLIP
    file_from_camera[:3, 3] = place.points(camera.position)
    prim.MakeMatrixXform().Set(Gf.Matrix4d(file_from_camera.T.tolist()))  # row vectors


def read_camera(
    prim: UsdGeom.Camera, size: tuple[int, int], place: Similarity3, time: Usd.TimeCode | None = None
) -> PinholeCamera:
    """The pinhole camera of a picture of `size` (width, height) px that sees what a USD camera sees.

    Args:
        prim: a camera.
        size: of the picture; the film back may have another shape, pixels are then not square.
        place: file_from_world, as in `write_camera`.
        time: None: the default values.
    """
    time = time or Usd.TimeCode.Default()
    focal, across, up, right, top = (
        float(attribute.Get(time))
        for attribute in (
            prim.GetFocalLengthAttr(), prim.GetHorizontalApertureAttr(), prim.GetVerticalApertureAttr(),
            prim.GetHorizontalApertureOffsetAttr(), prim.GetVerticalApertureOffsetAttr(),
        )
    )  # fmt: skip
    width, height = size
    fx, fy = focal * width / across, focal * height / up
    center = (0.5 * width - right * fx / focal, 0.5 * height + top * fy / focal)
    matrix = np.array(prim.ComputeLocalToWorldTransform(time)).T
    turned = matrix[:3, :3] / np.linalg.norm(matrix[:3, :3], axis=0)
    rotation = (place.rotation.T @ turned @ _FLIP).T
    position = place.inverse().points(matrix[:3, 3])
    return PinholeCamera((fx, fy), center, size, RigidTransform(rotation, -rotation @ position))
