"""The pinhole camera as a UsdGeom.Camera, and back."""

from __future__ import annotations

import numpy as np
from pxr import Gf, UsdGeom

from fluidlift.types import PinholeCamera, Similarity3

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
