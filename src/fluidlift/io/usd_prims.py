"""The moving prims of an exported fluid, one sample at a time: splats, points, white water, surface."""

from __future__ import annotations

import math

import numpy as np
from pxr import Gf, Sdf, Usd, UsdGeom, UsdVol, Vt

from fluidlift.errors import require
from fluidlift.io.frames import FluidFrame
from fluidlift.numerics.mesh_normals import vertex_normals
from fluidlift.numerics.srgb import linear_from_srgb
from fluidlift.types import Gaussians, Similarity3, TriangleMesh, matrix_from_quat

SIGMAS = 3.0
"""standard deviations that the extent of a Gaussian spans"""

NO_MESH = TriangleMesh(np.zeros((0, 3), np.float32), np.zeros((0, 3), np.int64), np.zeros((0, 3), np.float32))

_SMALLEST = 1e-9
"""units: a scale of nothing is no Gaussian, and readers divide by it"""


class FluidPrims:
    """/Fluid/Splats, /Fluid/Points and, where frames have them, /Fluid/Whitewater and /Fluid/Surface of a stage."""

    def __init__(self, stage: Usd.Stage, coefficients: int, half: bool) -> None:
        self.stage, self.coefficients, self.half = stage, coefficients, half
        self.surface: UsdGeom.Mesh | None = None
        self.white: UsdGeom.Points | None = None
        self._define_splats()
        self.points = _defined_points(stage, "/Fluid/Points")

    def set(self, frame: FluidFrame, time: Usd.TimeCode) -> int:
        """Write one frame, in the axes and units of the file; about how many bytes it took."""
        require(frame.gaussians.sh.shape[1] == self.coefficients, "harmonics whose degree changes over time")
        self._set_splats(frame.gaussians, time)
        if frame.kinds is None:
            _set_points(self.points, frame, time)
        else:
            white = np.asarray(frame.kinds) >= 0
            _set_points(self.points, frame.part(~white), time)
            self.set_whitewater(frame.part(white), time)
        written = len(frame.gaussians) * (90 + 12 * self.coefficients)
        if frame.surface is not None:
            self.set_surface(frame.surface, frame.surface_velocities, time)
            written += 12 * (3 * len(frame.surface.vertices) + len(frame.surface.faces))
        return written

    def set_whitewater(self, frame: FluidFrame, time: Usd.TimeCode) -> None:
        """Write the points of white water; `frame` holds nothing else."""
        points = _defined_whitewater(self.stage) if self.white is None else self.white
        self.white = points
        _set_points(points, frame, time)
        kinds = np.ascontiguousarray(frame.kinds, np.int32)
        UsdGeom.PrimvarsAPI(points).GetPrimvar("kind").Set(Vt.IntArray.FromNumpy(kinds), time)
        opacity = np.ascontiguousarray(np.clip(frame.gaussians.opacities, 0, 1), np.float32)
        points.GetDisplayOpacityPrimvar().Set(Vt.FloatArray.FromNumpy(opacity), time)

    def set_surface(self, surface: TriangleMesh, velocities: np.ndarray | None, time: Usd.TimeCode) -> None:
        """Write the surface; velocities [v,3] are what motion blur is made of: another frame has other vertices."""
        mesh = UsdGeom.Mesh.Define(self.stage, "/Fluid/Surface") if self.surface is None else self.surface
        self.surface = mesh
        write_mesh(mesh, surface, velocities, time)
        mesh.CreateNormalsAttr().Set(vec3(vertex_normals(surface)), time)
        mesh.SetNormalsInterpolation(UsdGeom.Tokens.vertex)

    def _define_splats(self) -> None:
        self.splats = s = UsdVol.ParticleField3DGaussianSplat.Define(self.stage, "/Fluid/Splats")
        self.positions, self.scales = s.CreatePositionsAttr(), s.CreateScalesAttr()
        self.orientations = s.CreateOrientationshAttr() if self.half else s.CreateOrientationsAttr()
        self.opacities = s.CreateOpacitieshAttr() if self.half else s.CreateOpacitiesAttr()
        self.harmonics = (
            s.CreateRadianceSphericalHarmonicsCoefficientshAttr()
            if self.half
            else s.CreateRadianceSphericalHarmonicsCoefficientsAttr()
        )
        s.CreateRadianceSphericalHarmonicsDegreeAttr(math.isqrt(self.coefficients) - 1)
        s.CreateProjectionModeHintAttr("perspective")
        s.CreateSortingModeHintAttr("zDepth")
        self.harmonics.SetMetadata("interpolation", UsdGeom.Tokens.vertex)
        self.harmonics.SetMetadata("elementSize", self.coefficients)

    def _set_splats(self, g: Gaussians, time: Usd.TimeCode) -> None:
        small = np.float16 if self.half else np.float32
        self.positions.Set(Vt.Vec3fArray.FromNumpy(g.means), time)
        self.scales.Set(vec3(np.maximum(g.scales, _SMALLEST)), time)
        quats = np.ascontiguousarray(np.roll(g.quats, -1, axis=1).astype(small))  # Gf keeps the imaginary part first
        self.orientations.Set((Vt.QuathArray if self.half else Vt.QuatfArray).FromNumpy(quats), time)
        opacities = np.ascontiguousarray(np.clip(g.opacities, 0, 1).astype(small))
        self.opacities.Set((Vt.HalfArray if self.half else Vt.FloatArray).FromNumpy(opacities), time)
        self.harmonics.Set(vec3(g.sh.reshape(-1, 3), self.half), time)
        self.splats.CreateExtentAttr().Set(extent(g.means, SIGMAS * _deviations(g)), time)


def _defined_points(stage: Usd.Stage, path: str) -> UsdGeom.Points:
    points = UsdGeom.Points.Define(stage, path)
    points.CreateWidthsAttr()
    points.SetWidthsInterpolation(UsdGeom.Tokens.vertex)
    points.CreateDisplayColorPrimvar(UsdGeom.Tokens.vertex)
    return points


def _defined_whitewater(stage: Usd.Stage) -> UsdGeom.Points:
    points = _defined_points(stage, "/Fluid/Whitewater")
    points.CreateDisplayOpacityPrimvar(UsdGeom.Tokens.vertex)
    primvars = UsdGeom.PrimvarsAPI(points)
    kind = primvars.CreatePrimvar("kind", Sdf.ValueTypeNames.IntArray, UsdGeom.Tokens.vertex)
    kind.GetAttr().SetDocumentation("0 spray, 1 foam, 2 bubbles")
    return points


def _set_points(points: UsdGeom.Points, frame: FluidFrame, time: Usd.TimeCode) -> None:
    g = frame.gaussians
    widths = (2.0 * np.cbrt(np.prod(g.scales.astype(np.float64), axis=1))).astype(np.float32)
    points.CreatePointsAttr().Set(Vt.Vec3fArray.FromNumpy(g.means), time)
    points.CreateWidthsAttr().Set(Vt.FloatArray.FromNumpy(widths), time)
    points.CreateIdsAttr().Set(Vt.Int64Array.FromNumpy(np.ascontiguousarray(frame.ids, np.int64)), time)
    points.CreateVelocitiesAttr().Set(vec3(frame.velocities), time)
    points.GetDisplayColorPrimvar().Set(vec3(linear_colors(g.rgb)), time)
    points.CreateExtentAttr().Set(extent(g.means, 0.5 * widths[:, None]), time)


def ordered(frame: FluidFrame) -> FluidFrame:
    """By id: as long as no particle is born or leaves, each keeps its place in every array."""
    ids = np.asarray(frame.ids)
    if len(ids) < 2 or (np.diff(ids) > 0).all():
        return frame
    order = np.argsort(ids, kind="stable")
    own = frame.part(order)
    return frame._replace(gaussians=own.gaussians, ids=own.ids, velocities=own.velocities, kinds=own.kinds)


def placed(frame: FluidFrame, place: Similarity3 | None) -> FluidFrame:
    """Turned and scaled into the axes and units of the file, view-dependent colours included; None: as it is."""
    if place is None:
        return frame
    surface, moving = frame.surface, frame.surface_velocities
    return frame._replace(
        gaussians=frame.gaussians.transformed(place),
        velocities=place.vectors(np.asarray(frame.velocities)),
        surface=None if surface is None else placed_mesh(surface, place),
        surface_velocities=None if moving is None else place.vectors(np.asarray(moving)),
    )


def placed_mesh(mesh: TriangleMesh, place: Similarity3 | None) -> TriangleMesh:
    """A mesh in the axes and units of the file; None: as it is."""
    if place is None:
        return mesh
    vertices = place.points(mesh.vertices.astype(np.float64)).astype(np.float32)
    return TriangleMesh(vertices, mesh.faces, mesh.colors, mesh.uv, mesh.texture)


def write_mesh(mesh: UsdGeom.Mesh, value: TriangleMesh, velocities: np.ndarray | None, time: Usd.TimeCode) -> None:
    """One sample of a mesh of triangles, seen from both sides; velocities [v,3] in units per second."""
    faces = np.ascontiguousarray(value.faces, np.int32)
    mesh.CreatePointsAttr().Set(vec3(value.vertices), time)
    mesh.CreateFaceVertexCountsAttr().Set(Vt.IntArray.FromNumpy(np.full(len(faces), 3, np.int32)), time)
    mesh.CreateFaceVertexIndicesAttr().Set(Vt.IntArray.FromNumpy(faces.reshape(-1)), time)
    mesh.CreateExtentAttr().Set(extent(value.vertices, np.zeros(3)), time)
    mesh.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
    mesh.CreateDoubleSidedAttr(True)
    if value.colors is not None:
        mesh.CreateDisplayColorPrimvar(UsdGeom.Tokens.vertex).Set(vec3(linear_colors(value.colors)), time)
    if velocities is not None:
        mesh.CreateVelocitiesAttr().Set(vec3(velocities), time)


def linear_colors(rgb: np.ndarray) -> np.ndarray:
    """displayColor is linear light; our colours are sRGB."""
    return linear_from_srgb(np.asarray(rgb, np.float32)).astype(np.float32)


def vec3(values: np.ndarray, half: bool = False) -> Vt.Vec3hArray | Vt.Vec3fArray:
    """[n,3] as USD takes it."""
    kind, array = (np.float16, Vt.Vec3hArray) if half else (np.float32, Vt.Vec3fArray)
    limit = np.finfo(kind).max
    return array.FromNumpy(np.ascontiguousarray(np.clip(values, -limit, limit).astype(kind)))


def extent(points: np.ndarray, reach: np.ndarray) -> Vt.Vec3fArray:
    """The box around points [n,3] that reach this far along the axes."""
    if not len(points):
        return Vt.Vec3fArray([Gf.Vec3f(0), Gf.Vec3f(0)])
    box = np.stack([(points - reach).min(axis=0), (points + reach).max(axis=0)])
    return Vt.Vec3fArray.FromNumpy(box.astype(np.float32))


def _deviations(g: Gaussians) -> np.ndarray:
    """[n,3] standard deviations along the axes of the world: the roots of the covariances' diagonals."""
    return np.linalg.norm(matrix_from_quat(g.quats) * g.scales[:, None, :], axis=2)


def write_volume(stage: Usd.Stage, files: dict[int, str], fields: tuple[str, ...], place: Similarity3 | None) -> None:
    """A volume whose OpenVDB file follows the frames.

    Args:
        stage: to add it to.
        files: name of the file by time code, relative to the stage's own.
        fields: grids in each of them.
        place: file_from_world. OpenVDB files stay as they are: the prim turns and scales them.
    """
    volume = UsdVol.Volume.Define(stage, "/Fluid/Volume")
    if place is not None:
        matrix = np.eye(4)
        matrix[:3, :3] = place.scale * place.rotation
        volume.MakeMatrixXform().Set(Gf.Matrix4d(matrix.T.tolist()))
    for name in fields:
        asset = UsdVol.OpenVDBAsset.Define(stage, f"/Fluid/Volume/{name}")
        asset.CreateFieldNameAttr(name)
        attribute = asset.CreateFilePathAttr(Sdf.AssetPath(f"./{next(iter(files.values()))}"))
        for code, file in files.items():
            attribute.Set(Sdf.AssetPath(f"./{file}"), code)
        volume.CreateFieldRelationship(name, asset.GetPath())
