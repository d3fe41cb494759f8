"""OpenUSD: asset.usda, the layer that a person opens and edits, over asset.usdc, the heavy time-sampled payload.

Splats are `ParticleField3DGaussianSplat` (usd-core 26.3 or newer). Readers that do not know the schema, Blender for
one, show the `Points` of the same frames, with velocities and stable ids. z is up, one unit is a metre.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
from pxr import Gf, Kind, Sdf, Tf, Usd, UsdGeom, UsdShade, UsdVol, Vt

from fluidlift.errors import require
from fluidlift.io.atomic import atomic_path, write_bytes
from fluidlift.io.color import linear_from_srgb
from fluidlift.io.frames import FIRST_FRAME, FluidFrame, MovingMesh
from fluidlift.io.pictures import write_png
from fluidlift.io.validate_usd import validate_usd
from fluidlift.types import Gaussians, PinholeCamera, TriangleMesh

__all__ = ["linear_colors", "validate_usd", "write_camera", "write_usd"]

SIGMAS = 3.0
"""standard deviations that the extent of a Gaussian spans"""

_NOTHING = TriangleMesh(np.zeros((0, 3), np.float32), np.zeros((0, 3), np.int64), np.zeros((0, 3), np.float32))

_TEXTURE = ".terrain.png"
"""in place of the suffix: the texture lies beside the files that use it"""

_SAVE_AFTER = 128 * 2**20
"""bytes of samples; saved samples are read from the disk again only when needed, so memory stays bounded"""

_HALF_POSITIVE = 6.2e-5
"""the smallest normal half-precision number; smaller scales are stored in full precision"""

_APERTURE = 3.6
"""horizontal aperture in tenths of a metre (0.1 scene units, as the schema counts): a 36 mm film back scaled up by 100
for units of metres; only its ratio to the focal length shows in the picture"""


def write_usd(
    path: Path | str,
    *,
    frames: Iterable[FluidFrame | tuple],
    interval: float,
    start_frame: int = FIRST_FRAME,
    terrain: TriangleMesh | None = None,
    camera: PinholeCamera | None = None,
    bodies: Sequence[MovingMesh] = (),
    attributes: Mapping[str, Any] | None = None,
    half: bool = True,
) -> list[Path]:
    """Write `path` (asset.usda) and, beside it, its payload with the suffix .usdc and the terrain's texture.

    Args:
        path: ends in .usda.
        frames: `FluidFrame`s or tuples (gaussians, ids, velocities); taken one by one, never all in memory.
        interval: s between frames; frames per second is its inverse.
        start_frame: time code of the first frame.
        terrain: solid surface with colours, or with a texture.
        camera: of the video.
        bodies: solids in the fluid, with a pose for every frame.
        attributes: custom attributes of the asset, written as fluid:NAME (numbers, 3-vectors, text).
        half: store scales, opacities, orientations and harmonics in half precision; positions never are, because 11
            bits are a centimetre at ten metres.

    Returns:
        The files written.

    Raises:
        InputRejected: the disk is full or may not be written.
        ValueError: no frames, or arrays of wrong lengths.
    """
    path = Path(path)
    require(path.suffix == ".usda", f"'{path.name}'", "a name that ends in .usda")
    require(interval > 0, f"interval {interval}", "positive seconds")
    fps = _rate(interval)
    payload = path.with_suffix(".usdc")
    pictures = []
    if terrain is not None and terrain.texture is not None:
        pictures = [write_png(path.with_suffix(_TEXTURE), terrain.texture)]
    with atomic_path(payload) as temporary:
        temporary.unlink(missing_ok=True)
        count = _write_payload(
            temporary, frames, fps, start_frame, (terrain, camera, bodies), half, path.stem + _TEXTURE
        )
    _reload(payload)
    times = (start_frame, start_frame + count - 1)
    write_bytes(path, _interface(payload.name, fps, times, attributes or {}).encode())
    _reload(path)
    return [path, payload, *pictures]


def _rate(interval: float) -> float:
    """Frames per second; rates such as 30000/1001 come out as exactly as a double can hold them."""
    return float(Fraction(1.0 / interval).limit_denominator(1001))


def _reload(path: Path) -> None:
    """If this process has the replaced file open, show it the new content."""
    layer = Sdf.Layer.Find(str(path))
    if layer is not None:
        layer.Reload(force=True)


def _interface(payload: str, fps: float, times: tuple[int, int], attributes: Mapping[str, Any]) -> str:
    """The text layer: a reference to the heavy data, the parameters, and a switch between representations."""
    layer = Sdf.Layer.CreateAnonymous(".usda")
    stage = Usd.Stage.Open(layer, Usd.Stage.LoadNone)  # the payload is elsewhere
    root = UsdGeom.Xform.Define(stage, "/Fluid").GetPrim()
    _set_stage(stage, root, fps, times)
    Usd.ModelAPI(root).SetKind(Kind.Tokens.component)
    root.GetPayloads().AddPayload(f"./{payload}")
    for name, value in attributes.items():
        _custom_attribute(root, name, value)
    variants = root.GetVariantSets().AddVariantSet("representation")
    shown = {"all": (), "splats": ("Points",), "points": ("Splats", "Surface"), "surface": ("Splats", "Points")}
    for variant, hidden in shown.items():
        variants.AddVariant(variant)
        variants.SetVariantSelection(variant)
        with variants.GetVariantEditContext():
            for child in hidden:
                over = stage.OverridePrim(f"/Fluid/{child}")
                UsdGeom.Imageable(over).CreateVisibilityAttr(UsdGeom.Tokens.invisible)
    variants.SetVariantSelection("all")
    return layer.ExportToString()


def _set_stage(stage: Usd.Stage, root: Usd.Prim, fps: float, times: tuple[int, int]) -> None:
    stage.SetDefaultPrim(root)
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.z)
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    stage.SetTimeCodesPerSecond(fps)
    stage.SetFramesPerSecond(fps)
    stage.SetStartTimeCode(times[0])
    stage.SetEndTimeCode(times[1])


def _custom_attribute(prim: Usd.Prim, name: str, value: Any) -> None:
    if isinstance(value, bool):
        kind = Sdf.ValueTypeNames.Bool
    elif isinstance(value, int):
        kind = Sdf.ValueTypeNames.Int
    elif isinstance(value, str):
        kind = Sdf.ValueTypeNames.String
    elif np.ndim(value) == 0:
        kind, value = Sdf.ValueTypeNames.Double, float(value)
    else:
        require(np.shape(value) == (3,), f"attribute '{name}' of shape {np.shape(value)}", "a number, text or 3-vector")
        kind, value = Sdf.ValueTypeNames.Vector3d, Gf.Vec3d(*(float(x) for x in value))
    prim.CreateAttribute(f"fluid:{name}", kind, custom=True).Set(value)


def _write_payload(
    path: Path,
    frames: Iterable[FluidFrame | tuple],
    fps: float,
    start_frame: int,
    beside: tuple[TriangleMesh | None, PinholeCamera | None, Sequence[MovingMesh]],
    half: bool,
    picture: str = "",
) -> int:
    """All prims; the number of frames. `beside` the fluid: terrain, camera, bodies; `picture`: of the terrain."""
    terrain, camera, bodies = beside
    stage = Usd.Stage.CreateNew(str(path))
    root = UsdGeom.Xform.Define(stage, "/Fluid").GetPrim()
    if terrain is not None:
        ground = UsdGeom.Mesh.Define(stage, "/Fluid/Terrain")
        _write_mesh(ground, terrain, None, Usd.TimeCode.Default())
        if terrain.uv is not None:
            _write_texture(stage, ground, terrain.uv, picture)
    if camera is not None:
        write_camera(UsdGeom.Camera.Define(stage, "/Fluid/Camera"), camera)
    for number, solid in enumerate(bodies):
        _write_body(stage, solid, number, start_frame)
    body = _Body(stage, half)
    unsaved, count = 0, 0
    for count, frame in enumerate(frames, start=1):  # the count is the result
        unsaved += body.add(FluidFrame(*frame).checked(), start_frame + count - 1)
        if unsaved > _SAVE_AFTER:
            stage.GetRootLayer().Save()
            unsaved = 0
    require(count > 0, "no frames to write")
    for solid in bodies:
        poses = (np.shape(solid.positions), np.shape(solid.orientations))
        require(poses == ((count, 3), (count, 4)), f"poses {poses} of body '{solid.name}'", f"{count} of each")
    _set_stage(stage, root, fps, (start_frame, start_frame + count - 1))
    stage.GetRootLayer().Save()
    return count


class _Body:
    """The moving prims. The first frame is written as the default value too: some readers look at nothing else."""

    def __init__(self, stage: Usd.Stage, half: bool) -> None:
        self.stage, self.half = stage, half
        self.splats: UsdVol.ParticleField3DGaussianSplat | None = None
        self.points = UsdGeom.Points.Define(stage, "/Fluid/Points")
        self.colors = self.points.CreateDisplayColorPrimvar(UsdGeom.Tokens.vertex)
        self.surface: UsdGeom.Mesh | None = None
        self.volume_fields: list[UsdVol.OpenVDBAsset] = []
        self.coefficients = 0

    def add(self, frame: FluidFrame, code: int) -> int:
        """Write one frame; about how many bytes it took."""
        first = self.splats is None
        if first:
            self._define(frame.gaussians)
        require(frame.gaussians.sh.shape[1] == self.coefficients, "harmonics whose degree changes over time")
        for time in ([Usd.TimeCode.Default()] if first else []) + [Usd.TimeCode(code)]:
            self._set_splats(frame.gaussians, time)
            self._set_points(frame, time)
        written = len(frame.gaussians) * (90 + 6 * self.coefficients)
        if frame.surface is not None:
            if self.surface is None:
                self.surface = UsdGeom.Mesh.Define(self.stage, "/Fluid/Surface")
                _write_mesh(self.surface, frame.surface, frame.surface_velocities, Usd.TimeCode.Default())
            _write_mesh(self.surface, frame.surface, frame.surface_velocities, Usd.TimeCode(code))
            written += 12 * (2 * len(frame.surface.vertices) + len(frame.surface.faces))
        elif self.surface is not None:
            _write_mesh(self.surface, _NOTHING, np.zeros((0, 3)), Usd.TimeCode(code))
        if frame.volume is not None:
            self._set_volume(frame.volume, code)
        return written

    def _define(self, gaussians: Gaussians) -> None:
        self.coefficients = gaussians.sh.shape[1]
        self.splats = UsdVol.ParticleField3DGaussianSplat.Define(self.stage, "/Fluid/Splats")
        s = self.splats
        # half precision keeps scales apart only above its smallest normal number
        half_scales = self.half and (len(gaussians) == 0 or float(gaussians.scales.min()) > 16 * _HALF_POSITIVE)
        self.positions = s.CreatePositionsAttr()
        self.scales = s.CreateScaleshAttr() if half_scales else s.CreateScalesAttr()
        self.orientations = s.CreateOrientationshAttr() if self.half else s.CreateOrientationsAttr()
        self.opacities = s.CreateOpacitieshAttr() if self.half else s.CreateOpacitiesAttr()
        self.harmonics = (
            s.CreateRadianceSphericalHarmonicsCoefficientshAttr()
            if self.half
            else s.CreateRadianceSphericalHarmonicsCoefficientsAttr()
        )
        self.half_scales = half_scales
        s.CreateRadianceSphericalHarmonicsDegreeAttr(math.isqrt(self.coefficients) - 1)
        s.CreateProjectionModeHintAttr("perspective")
        s.CreateSortingModeHintAttr("zDepth")
        self.harmonics.SetMetadata("interpolation", UsdGeom.Tokens.vertex)
        self.harmonics.SetMetadata("elementSize", self.coefficients)

    def _set_splats(self, g: Gaussians, time: Usd.TimeCode) -> None:
        small = np.float16 if self.half else np.float32
        self.positions.Set(Vt.Vec3fArray.FromNumpy(g.means), time)
        self.scales.Set(_vec3(g.scales, self.half_scales), time)
        quats = np.ascontiguousarray(np.roll(g.quats, -1, axis=1).astype(small))  # Gf keeps the imaginary part first
        self.orientations.Set((Vt.QuathArray if self.half else Vt.QuatfArray).FromNumpy(quats), time)
        opacities = np.ascontiguousarray(np.clip(g.opacities, 0, 1).astype(small))
        self.opacities.Set((Vt.HalfArray if self.half else Vt.FloatArray).FromNumpy(opacities), time)
        self.harmonics.Set(_vec3(g.sh.reshape(-1, 3), self.half), time)
        reach = SIGMAS * np.sqrt(np.maximum(np.einsum("nii->ni", g.covariances()), 0)) if len(g) else np.zeros((0, 3))
        self.splats.CreateExtentAttr().Set(_extent(g.means, reach), time)

    def _set_points(self, frame: FluidFrame, time: Usd.TimeCode) -> None:
        g = frame.gaussians
        widths = (2.0 * np.cbrt(np.prod(g.scales.astype(np.float64), axis=1))).astype(np.float32)
        self.points.CreatePointsAttr().Set(Vt.Vec3fArray.FromNumpy(g.means), time)
        self.points.CreateWidthsAttr().Set(Vt.FloatArray.FromNumpy(widths), time)
        self.points.SetWidthsInterpolation(UsdGeom.Tokens.vertex)
        self.points.CreateIdsAttr().Set(Vt.Int64Array.FromNumpy(np.ascontiguousarray(frame.ids, np.int64)), time)
        velocities = np.ascontiguousarray(frame.velocities, np.float32)
        self.points.CreateVelocitiesAttr().Set(Vt.Vec3fArray.FromNumpy(velocities), time)
        self.colors.Set(_vec3(linear_colors(g.rgb), False), time)
        self.points.CreateExtentAttr().Set(_extent(g.means, 0.5 * widths[:, None]), time)

    def _set_volume(self, file: str, code: int) -> None:
        if not self.volume_fields:
            volume = UsdVol.Volume.Define(self.stage, "/Fluid/Volume")
            for name in ("density", "vel"):
                asset = UsdVol.OpenVDBAsset.Define(self.stage, f"/Fluid/Volume/{name}")
                asset.CreateFieldNameAttr(name)
                asset.CreateFilePathAttr(Sdf.AssetPath(f"./{file}"))
                volume.CreateFieldRelationship(name, asset.GetPath())
                self.volume_fields.append(asset)
        for asset in self.volume_fields:
            asset.GetFilePathAttr().Set(Sdf.AssetPath(f"./{file}"), code)


def linear_colors(rgb: np.ndarray) -> np.ndarray:
    """displayColor is linear light; our colours are sRGB."""
    return linear_from_srgb(np.asarray(rgb, np.float32)).astype(np.float32)


def _vec3(values: np.ndarray, half: bool) -> Vt.Vec3hArray | Vt.Vec3fArray:
    kind, array = (np.float16, Vt.Vec3hArray) if half else (np.float32, Vt.Vec3fArray)
    limit = np.finfo(kind).max
    return array.FromNumpy(np.ascontiguousarray(np.clip(values, -limit, limit).astype(kind)))


def _extent(points: np.ndarray, reach: np.ndarray) -> Vt.Vec3fArray:
    if not len(points):
        return Vt.Vec3fArray([Gf.Vec3f(0), Gf.Vec3f(0)])
    box = np.stack([(points - reach).min(axis=0), (points + reach).max(axis=0)]).astype(np.float32)
    return Vt.Vec3fArray.FromNumpy(np.ascontiguousarray(box))


def _write_mesh(mesh: UsdGeom.Mesh, value: TriangleMesh, velocities: np.ndarray | None, time: Usd.TimeCode) -> None:
    points = np.ascontiguousarray(value.vertices, np.float32)
    mesh.CreatePointsAttr().Set(Vt.Vec3fArray.FromNumpy(points), time)
    mesh.CreateFaceVertexCountsAttr().Set(Vt.IntArray(len(value.faces), 3), time)
    indices = np.ascontiguousarray(value.faces, np.int32).reshape(-1)
    mesh.CreateFaceVertexIndicesAttr().Set(Vt.IntArray.FromNumpy(indices), time)
    mesh.CreateExtentAttr().Set(_extent(points, np.zeros(3)), time)
    mesh.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
    if value.colors is not None:
        mesh.CreateDisplayColorPrimvar(UsdGeom.Tokens.vertex).Set(_vec3(linear_colors(value.colors), False), time)
    if velocities is not None:
        mesh.CreateVelocitiesAttr().Set(_vec3(np.asarray(velocities), False), time)


def _write_texture(stage: Usd.Stage, mesh: UsdGeom.Mesh, uv: np.ndarray, picture: str) -> None:
    """A preview material with the picture, on a mesh with texture coordinates; USD counts v from below."""
    place = mesh.GetPath().AppendChild("Material")
    corners = np.ascontiguousarray(uv.reshape(-1, 2) * (1.0, -1.0) + (0.0, 1.0), np.float32)
    primvar = UsdGeom.PrimvarsAPI(mesh).CreatePrimvar(
        "st", Sdf.ValueTypeNames.TexCoord2fArray, UsdGeom.Tokens.faceVarying
    )
    primvar.Set(Vt.Vec2fArray.FromNumpy(corners))
    material = UsdShade.Material.Define(stage, place)
    reader, texture, surface = (
        UsdShade.Shader.Define(stage, place.AppendChild(name)) for name in ("Coordinates", "Texture", "Surface")
    )
    kinds = Sdf.ValueTypeNames
    reader.CreateIdAttr("UsdPrimvarReader_float2")
    reader.CreateInput("varname", kinds.String).Set("st")
    found = reader.CreateOutput("result", kinds.Float2)
    texture.CreateIdAttr("UsdUVTexture")
    texture.CreateInput("file", kinds.Asset).Set(Sdf.AssetPath(f"./{picture}"))
    texture.CreateInput("sourceColorSpace", kinds.Token).Set("sRGB")
    texture.CreateInput("st", kinds.Float2).ConnectToSource(found)
    for wrap in ("wrapS", "wrapT"):
        texture.CreateInput(wrap, kinds.Token).Set("clamp")
    colour = texture.CreateOutput("rgb", kinds.Float3)
    surface.CreateIdAttr("UsdPreviewSurface")
    surface.CreateInput("diffuseColor", kinds.Color3f).ConnectToSource(colour)
    surface.CreateInput("roughness", kinds.Float).Set(1.0)
    material.CreateSurfaceOutput().ConnectToSource(surface.CreateOutput("surface", kinds.Token))
    UsdShade.MaterialBindingAPI.Apply(mesh.GetPrim()).Bind(material)


def _write_body(stage: Usd.Stage, solid: MovingMesh, number: int, start_frame: int) -> None:
    """A mesh under a transform with a sample per frame; its name, with its number where names become the same."""
    name = Tf.MakeValidIdentifier(solid.name)
    place = f"/Fluid/Bodies/{name}"
    if stage.GetPrimAtPath(place):
        place += f"_{number}"
    prim = UsdGeom.Mesh.Define(stage, place)
    _write_mesh(prim, solid.mesh, None, Usd.TimeCode.Default())
    move = prim.AddTranslateOp(UsdGeom.XformOp.PrecisionDouble)
    turn = prim.AddOrientOp(UsdGeom.XformOp.PrecisionDouble)
    for k, (x, q) in enumerate(zip(solid.positions, solid.orientations)):
        position, orientation = Gf.Vec3d(*map(float, x)), Gf.Quatd(*map(float, q))
        for time in ([Usd.TimeCode.Default()] if k == 0 else []) + [Usd.TimeCode(start_frame + k)]:
            move.Set(position, time)
            turn.Set(orientation, time)


def write_camera(prim: UsdGeom.Camera, camera: PinholeCamera) -> None:
    """A pinhole camera: USD's look along -z with y up, so the y and z axes of OpenCV's are turned over."""
    (fx, fy), (cx, cy), (width, height) = camera.focal, camera.center, camera.size
    focal = _APERTURE * fx / width
    prim.CreateProjectionAttr(UsdGeom.Tokens.perspective)
    prim.CreateFocalLengthAttr(focal)
    prim.CreateHorizontalApertureAttr(_APERTURE)
    prim.CreateVerticalApertureAttr(focal * height / fy)
    prim.CreateHorizontalApertureOffsetAttr(focal * (0.5 * width - cx) / fx)
    prim.CreateVerticalApertureOffsetAttr(focal * (cy - 0.5 * height) / fy)
    prim.CreateClippingRangeAttr(Gf.Vec2f(0.01, 100000.0))
    world_from_camera = np.eye(4)
    world_from_camera[:3, :3] = camera.camera_from_world.rotation.T @ np.diag([1.0, -1.0, -1.0])
    world_from_camera[:3, 3] = camera.position
    prim.MakeMatrixXform().Set(Gf.Matrix4d(world_from_camera.T.tolist()))  # row vectors
