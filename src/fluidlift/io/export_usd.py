"""OpenUSD: a layer that a person opens and edits (fluid.usda) over the heavy payload (fluid.usdc).

Splats are `ParticleField3DGaussianSplat` (usd-core 26.3 or newer). Readers that do not know the schema, Blender for
one, show the `Points` of the same frames, with velocities and stable ids. White water is among the splats, and beside
the points a prim of its own, whose primvar `kind` tells spray, foam and bubbles.

Everything is turned and scaled into the axes and units that the file states; there is no transform at the root.
Renderers of splats are young: many place the centres by the transform and forget the harmonics, or the orientations.
Only volumes stand under one, because OpenVDB files are z up and in metres.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
from pxr import Gf, Kind, Sdf, Tf, Usd, UsdGeom

from fluidlift.errors import require
from fluidlift.io.atomic import atomic_path, write_bytes
from fluidlift.io.frames import FIRST_FRAME, FluidFrame, MovingMesh
from fluidlift.io.pictures import write_png
from fluidlift.io.ply import AXES
from fluidlift.io.usd_camera import write_camera
from fluidlift.io.usd_frames import ClippedFrames, SampledFrames, UsdFrames, refer_to_clips, reload
from fluidlift.io.usd_materials import PreviewMaterial, bind, write_ground, write_material
from fluidlift.io.usd_prims import linear_colors, ordered, placed, placed_mesh, write_mesh, write_volume
from fluidlift.io.validate_usd import validate_usd
from fluidlift.types import PinholeCamera, Similarity3, TriangleMesh

__all__ = ["PreviewMaterial", "UsdSettings", "linear_colors", "validate_usd", "write_camera", "write_usd"]

LAYOUTS = ("file", "clips")

_TEXTURE = ".terrain.png"
"""in place of the suffix: the texture lies beside the files that use it"""


@dataclass(frozen=True)
class UsdSettings:
    """How a USD file is written."""

    start_frame: int = FIRST_FRAME
    """time code of the first frame"""
    up_axis: str = "z"
    """z or y; all data are turned, velocities, orientations and harmonics with them"""
    meters_per_unit: float = 1.0
    """m; 0.01 for tools that count in centimetres"""
    layout: str = "file"
    """file: all frames in the payload; clips: a file for each, beside it in frames/"""
    half: bool = False
    """store orientations, opacities and harmonics of splats in half precision: three fifths of the size. NVIDIA's rule
    and some readers ask for the full one"""
    material: PreviewMaterial | None = None
    """of the surface; None: the colours of its vertices"""
    volume_fields: tuple[str, ...] = ("density", "vel")
    """grids of the frames' OpenVDB files"""

    def __post_init__(self) -> None:
        require(self.up_axis in ("z", "y"), f"up axis '{self.up_axis}'", "z or y")
        require(self.layout in LAYOUTS, f"layout '{self.layout}'", " or ".join(LAYOUTS))
        good = np.isfinite(self.meters_per_unit) and 1e-6 <= self.meters_per_unit <= 1e6
        require(bool(good), f"{self.meters_per_unit} m per unit", "1e-6 to 1e6")

    @property
    def place(self) -> Similarity3 | None:
        """file_from_world; None where the file is as the world: z up, in metres."""
        if self.up_axis == "z" and self.meters_per_unit == 1.0:
            return None
        return Similarity3(1.0 / self.meters_per_unit, AXES[f"{self.up_axis}_up"], np.zeros(3))


def write_usd(
    path: Path | str,
    *,
    frames: Iterable[FluidFrame | tuple],
    interval: float,
    terrain: TriangleMesh | None = None,
    camera: PinholeCamera | None = None,
    bodies: Sequence[MovingMesh] = (),
    attributes: Mapping[str, Any] | None = None,
    settings: UsdSettings | None = None,
) -> list[Path]:
    """Write `path` (asset.usda) and, beside it, its payload with the suffix .usdc and the terrain's texture.

    Args:
        path: ends in .usda.
        frames: `FluidFrame`s or tuples (gaussians, ids, velocities), world, m and m/s; taken one by one, never all in
            memory. Their arrays are put in the order of the ids. All of them tell kinds, or none does.
        interval: s between frames; frames per second is its inverse.
        terrain: solid surface with colours, or with a texture.
        camera: of the video.
        bodies: solids in the fluid, with a pose for every frame.
        attributes: custom attributes of the asset, written as fluid:NAME (numbers, 3-vectors, text). They stay in SI;
            vectors turn with the axes.
        settings: axes, units, layout, material.

    Returns:
        The files written.

    Raises:
        InputRejected: the disk is full or may not be written.
        ValueError: no frames, or arrays of wrong lengths.
    """
    path, settings = Path(path), settings or UsdSettings()
    require(path.suffix == ".usda", f"'{path.name}'", "a name that ends in .usda")
    require(interval > 0, f"interval {interval}", "positive seconds")
    fps = _rate(interval)
    payload, files = path.with_suffix(".usdc"), []
    if terrain is not None and terrain.texture is not None:
        files = [write_png(path.with_suffix(_TEXTURE), terrain.texture)]
    with atomic_path(payload) as temporary:
        temporary.unlink(missing_ok=True)
        stage = Usd.Stage.CreateNew(str(temporary))
        _set_stage(stage, UsdGeom.Xform.Define(stage, "/Fluid").GetPrim(), fps, settings)
        _write_beside(stage, terrain, camera, bodies, path.stem + _TEXTURE, settings)
        into: UsdFrames = SampledFrames(stage, settings.half)
        if settings.layout == "clips":
            into = ClippedFrames(path, stage, settings.half, fps)
        count = _write_frames(stage, frames, into, settings)
        for solid in bodies:
            poses = (np.shape(solid.positions), np.shape(solid.orientations))
            require(poses == ((count, 3), (count, 4)), f"poses {poses} of body '{solid.name}'", f"{count} of each")
        times = (settings.start_frame, settings.start_frame + count - 1)
        _set_times(stage, times)
        files += into.finish()
        whitewater = bool(stage.GetPrimAtPath("/Fluid/Whitewater"))
        stage.GetRootLayer().Save()
    reload(payload)
    interface = _interface(path, fps, times, attributes or {}, settings, whitewater=whitewater)
    write_bytes(path, interface.encode())
    reload(path)
    return [path, payload, *files]


def _rate(interval: float) -> float:
    """Frames per second; rates such as 30000/1001 come out as exactly as a double can hold them."""
    return float(Fraction(1.0 / interval).limit_denominator(1001))


def _interface(
    path: Path,
    fps: float,
    times: tuple[int, int],
    attributes: Mapping[str, Any],
    settings: UsdSettings,
    *,
    whitewater: bool,
) -> str:
    """The text layer: a reference to the heavy data, the parameters, and a switch between representations."""
    layer = Sdf.Layer.CreateAnonymous(".usda")
    stage = Usd.Stage.Open(layer, Usd.Stage.LoadNone)  # the payload is elsewhere
    root = UsdGeom.Xform.Define(stage, "/Fluid").GetPrim()
    _set_stage(stage, root, fps, settings)
    _set_times(stage, times)
    model = Usd.ModelAPI(root)
    model.SetKind(Kind.Tokens.component)
    model.SetAssetName(path.stem)
    model.SetAssetIdentifier(Sdf.AssetPath(f"./{path.name}"))
    if settings.layout == "clips":
        refer_to_clips(root, path, times)
    root.GetPayloads().AddPayload(f"./{path.with_suffix('.usdc').name}")
    for name, value in attributes.items():
        _custom_attribute(root, name, value, settings.place)
    variants = root.GetVariantSets().AddVariantSet("representation")
    white = ("Whitewater",) if whitewater else ()  # among the splats it is one of them
    shown = {"all": (), "splats": ("Points", "Surface", *white), "points": ("Splats", "Surface"),
             "surface": ("Splats", "Points")}  # fmt: skip
    for variant, hidden in shown.items():
        variants.AddVariant(variant)
        variants.SetVariantSelection(variant)
        with variants.GetVariantEditContext():
            for child in hidden:
                over = stage.OverridePrim(f"/Fluid/{child}")
                UsdGeom.Imageable(over).CreateVisibilityAttr(UsdGeom.Tokens.invisible)
    variants.SetVariantSelection("all")
    return layer.ExportToString()


def _set_stage(stage: Usd.Stage, root: Usd.Prim, fps: float, settings: UsdSettings) -> None:
    stage.SetDefaultPrim(root)
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.y if settings.up_axis == "y" else UsdGeom.Tokens.z)
    UsdGeom.SetStageMetersPerUnit(stage, settings.meters_per_unit)
    stage.SetTimeCodesPerSecond(fps)
    stage.SetFramesPerSecond(fps)


def _set_times(stage: Usd.Stage, times: tuple[int, int]) -> None:
    stage.SetStartTimeCode(times[0])
    stage.SetEndTimeCode(times[1])


def _custom_attribute(prim: Usd.Prim, name: str, value: Any, place: Similarity3 | None) -> None:
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
        turned = np.asarray(value, float) if place is None else place.rotation @ np.asarray(value, float)
        kind, value = Sdf.ValueTypeNames.Vector3d, Gf.Vec3d(*(float(x) + 0.0 for x in turned))
    prim.CreateAttribute(f"fluid:{name}", kind, custom=True).Set(value)


def _write_beside(
    stage: Usd.Stage,
    terrain: TriangleMesh | None,
    camera: PinholeCamera | None,
    bodies: Sequence[MovingMesh],
    picture: str,
    settings: UsdSettings,
) -> None:
    """What is not fluid: terrain with the name of its texture, camera, solids."""
    place = settings.place
    if terrain is not None:
        ground = UsdGeom.Mesh.Define(stage, "/Fluid/Terrain")
        write_mesh(ground, placed_mesh(terrain, place), None, Usd.TimeCode.Default())
        if terrain.uv is not None or terrain.colors is not None:
            write_ground(stage, ground, terrain, picture)
    if camera is not None:
        write_camera(UsdGeom.Camera.Define(stage, "/Fluid/Camera"), camera, place)
    for number, solid in enumerate(bodies):
        _write_body(stage, solid, number, settings.start_frame, place or Similarity3())


def _write_frames(
    stage: Usd.Stage, frames: Iterable[FluidFrame | tuple], into: UsdFrames, settings: UsdSettings
) -> int:
    """The moving prims; the number of frames."""
    count, volumes, whitewater = 0, {}, None
    for count, given in enumerate(frames, start=1):  # the count is the result
        frame = ordered(FluidFrame.of(given))
        whitewater = frame.kinds is not None if whitewater is None else whitewater
        require(whitewater == (frame.kinds is not None), "kinds of white water in some frames", "in all or in none")
        code = settings.start_frame + count - 1
        into.add(placed(frame, settings.place), code)
        if frame.volume is not None:
            volumes[code] = frame.volume
    require(count > 0, "no frames to write")
    if volumes:
        write_volume(stage, volumes, settings.volume_fields, settings.place)
    surface = UsdGeom.Mesh.Get(stage, "/Fluid/Surface")
    if surface:
        place = UsdGeom.Scope.Define(stage, "/Fluid/Materials").GetPath()
        bind(surface, write_material(stage, place, settings.material or PreviewMaterial()))
    return count


def _write_body(stage: Usd.Stage, solid: MovingMesh, number: int, start_frame: int, place: Similarity3) -> None:
    """A mesh under a transform with a sample per frame; its name, with its number where names become the same."""
    name = Tf.MakeValidIdentifier(solid.name)
    path = f"/Fluid/Bodies/{name}"
    if stage.GetPrimAtPath(path):
        path += f"_{number}"
    prim = UsdGeom.Mesh.Define(stage, path)
    write_mesh(prim, placed_mesh(solid.mesh, Similarity3(place.scale)), None, Usd.TimeCode.Default())
    move = prim.AddTranslateOp(UsdGeom.XformOp.PrecisionDouble)
    turn = prim.AddOrientOp(UsdGeom.XformOp.PrecisionDouble)
    positions = place.points(np.asarray(solid.positions, np.float64).reshape(-1, 3))
    orientations = _continued(place.quats(np.asarray(solid.orientations, np.float64).reshape(-1, 4)))
    for k, (x, q) in enumerate(zip(positions, orientations)):
        position, orientation = Gf.Vec3d(*map(float, x)), Gf.Quatd(*map(float, q))
        for time in ([Usd.TimeCode.Default()] if k == 0 else []) + [Usd.TimeCode(start_frame + k)]:
            move.Set(position, time)
            turn.Set(orientation, time)


def _continued(quats: np.ndarray) -> np.ndarray:
    """The same rotations [k,4] with signs such that none is far from the one before: tools may interpolate linearly."""
    flips = np.where(np.einsum("kj,kj->k", quats[1:], quats[:-1]) < 0, -1.0, 1.0)
    return quats * np.concatenate([np.ones(min(len(quats), 1)), np.cumprod(flips)])[:, None]
