"""The frames of an exported USD file, read back by the tests into the world: z up, metres, m/s."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from pxr import Usd, UsdGeom, UsdVol

from fluidlift.errors import InputRejected
from fluidlift.io.frames import FluidFrame
from fluidlift.io.ply import AXES
from fluidlift.io.usd_open import open_stage
from fluidlift.numerics.srgb import srgb_from_linear
from fluidlift.types import Gaussians, PinholeCamera, RigidTransform, Similarity3, TriangleMesh

_FLIP = np.diag([1.0, -1.0, -1.0])
"""USD cameras look along -z, y up; ours along z, y down"""


class UsdFluid:
    """An exported file, one file or clips. Other files are read as far as their prims have the same names."""

    def __init__(self, path: Path | str) -> None:
        """Open a file.

        Raises:
            InputRejected: as `open_stage`, or no fluid in it.
        """
        path = Path(path)
        self._stage = open_stage(path)
        self._splats = UsdVol.ParticleField3DGaussianSplat(self._stage.GetPrimAtPath("/Fluid/Splats"))
        if not self._splats:
            raise InputRejected(f"'{path.name}' has no splats at /Fluid/Splats", "a file made with fluidlift export")
        up, unit = UsdGeom.GetStageUpAxis(self._stage), UsdGeom.GetStageMetersPerUnit(self._stage)
        bounds = (self._stage.GetStartTimeCode(), self._stage.GetEndTimeCode(), self._stage.GetTimeCodesPerSecond())
        if not (1e-9 < unit < 1e9 and np.abs(bounds).max() < 1e9 and bounds[2] > 0):  # a nan fails, too
            raise InputRejected(f"'{path.name}' has no sound units, times or rate", "a file made with fluidlift export")
        axes = AXES.get(f"{str(up).lower()}_up")
        if axes is None:
            raise InputRejected(f"'{path.name}' has the up axis '{str(up)[:20]}'", "Y or Z", "export it again")
        self._place = Similarity3(1.0 / unit, axes, np.zeros(3))
        """file_from_world"""

    @property
    def codes(self) -> range:
        """Time codes of the frames."""
        return range(int(self._stage.GetStartTimeCode()), int(self._stage.GetEndTimeCode()) + 1)

    @property
    def interval(self) -> float:
        """s between frames."""
        return 1.0 / self._stage.GetTimeCodesPerSecond()

    def frames(self) -> Iterator[FluidFrame]:
        """All frames, one by one."""
        return (self.frame(code) for code in self.codes)

    def frame(self, code: float) -> FluidFrame:
        """The frame of a time code: splats with the ids and velocities of the points, and the surface if there is one.

        Raises:
            InputRejected: arrays that do not fit together.
        """
        points = UsdGeom.Points(self._stage.GetPrimAtPath("/Fluid/Points"))
        world = self._place.inverse()
        try:
            found = FluidFrame(
                self._gaussians(code).transformed(world),
                np.asarray(points.GetIdsAttr().Get(code)),
                world.vectors(_vectors(points.GetVelocitiesAttr(), code)).astype(np.float32),
                *self._surface(code, world),
            ).checked()
        except (TypeError, ValueError, OverflowError, RuntimeError) as error:
            got = f"frame {code:g} of a USD file whose arrays do not fit ({error})"
            raise InputRejected(got, "a whole file", "export it again") from None
        return found

    def camera(self, size: tuple[int, int]) -> PinholeCamera:
        """The camera, for a picture of `size` (width, height) px.

        Raises:
            InputRejected: there is none.
        """
        prim = UsdGeom.Camera(self._stage.GetPrimAtPath("/Fluid/Camera"))
        if not prim:
            raise InputRejected("a USD file without a camera at /Fluid/Camera", "a file made with fluidlift export")
        return read_camera(prim, size, self._place)

    def _gaussians(self, code: float) -> Gaussians:
        s = self._splats
        positions = _vectors(s.GetPositionsAttr(), code)
        quats = _either(s.GetOrientationsAttr(), s.GetOrientationshAttr(), code)
        harmonics = _either(
            s.GetRadianceSphericalHarmonicsCoefficientsAttr(), s.GetRadianceSphericalHarmonicsCoefficientshAttr(), code
        )
        degree = s.GetRadianceSphericalHarmonicsDegreeAttr().Get()
        return Gaussians(
            positions,
            np.roll(np.reshape(quats, (-1, 4)), 1, axis=1),  # Gf keeps the imaginary part first
            _either(s.GetScalesAttr(), s.GetScaleshAttr(), code).reshape(-1, 3),
            _either(s.GetOpacitiesAttr(), s.GetOpacitieshAttr(), code),
            harmonics.reshape(len(positions), (degree + 1) ** 2, 3),
        )

    def _surface(self, code: float, world: Similarity3) -> tuple[TriangleMesh | None, np.ndarray | None]:
        mesh = UsdGeom.Mesh(self._stage.GetPrimAtPath("/Fluid/Surface"))
        if not mesh:
            return None, None
        points = _vectors(mesh.GetPointsAttr(), code)
        faces = np.asarray(mesh.GetFaceVertexIndicesAttr().Get(code), np.int64).reshape(-1, 3)
        colors = mesh.GetDisplayColorPrimvar().Get(code)
        shown = None if colors is None else srgb_from_linear(np.asarray(colors, np.float32).reshape(-1, 3))
        velocities = mesh.GetVelocitiesAttr().Get(code)
        moving = None if velocities is None else world.vectors(np.asarray(velocities).reshape(-1, 3)).astype(np.float32)
        return TriangleMesh(world.points(points).astype(np.float32), faces, shown), moving


def _vectors(attribute: Usd.Attribute, code: float) -> np.ndarray:
    return np.asarray(attribute.Get(code), np.float32).reshape(-1, 3)


def _either(full: Usd.Attribute, half: Usd.Attribute, code: float) -> np.ndarray:
    """The one that has values; the full one if both have."""
    value = full.Get(code) if full.HasAuthoredValue() else half.Get(code)
    return np.asarray(value).astype(np.float32)


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
