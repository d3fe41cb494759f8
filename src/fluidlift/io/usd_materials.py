"""UsdPreviewSurface materials: of the fluid in plain numbers, and of a ground with its picture."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from pxr import Gf, Sdf, Tf, Usd, UsdGeom, UsdShade, Vt

from fluidlift.errors import require
from fluidlift.types import TriangleMesh

Color = tuple[float, float, float]

LEAST_OPACITY = 0.25
"""of a preview: tools that fade the reflections with it, as Blender does, would show clear water as nothing"""


@dataclass(frozen=True)
class PreviewMaterial:
    """A fluid as UsdPreviewSurface can say it, which knows no absorption by depth. Colours are linear light."""

    name: str = "source"
    color: Color | None = None
    """diffuse, 0 to 1; None: the colours of the mesh (displayColor)"""
    refractive_index: float = 1.333
    roughness: float = 0.1
    opacity: float = 1.0
    emission: Color = (0.0, 0.0, 0.0)
    """linear radiance"""

    def __post_init__(self) -> None:
        one = f"material '{self.name}' with"
        require(1.0 <= self.refractive_index <= 4.0, f"{one} refractive index {self.refractive_index}", "1 to 4")
        require(0.0 <= self.roughness <= 1.0, f"{one} roughness {self.roughness}", "0 to 1")
        require(0.0 < self.opacity <= 1.0, f"{one} opacity {self.opacity}", "more than 0, at most 1")
        for what, values in (("colour", self.color), ("emission", self.emission)):
            good = values is None or (len(values) == 3 and bool(np.isfinite(values).all()) and min(values) >= 0)
            require(good, f"{one} {what} {values}", "three numbers from 0")

    @classmethod
    def of_depth(
        cls, name: str, depth: float, *, absorption: Color, scattering: float, albedo: Color, emission: Color,
        refractive_index: float, roughness: float,
    ) -> PreviewMaterial:  # fmt: skip
        """What a body of one depth looks like, in the terms of a preview.

        Light that passes `depth` is left to what lies behind (1 - opacity); the rest is the liquid's own colour, mixed
        of what it scatters (albedo) and what it lets through (Beer and Lambert's tint), by how much of each there is.

        Args:
            name: of the material.
            depth: m, of a typical place.
            absorption: 1/m, linear RGB.
            scattering: 1/m.
            albedo: linear colour of a deep body.
            emission: linear radiance.
            refractive_index: next to air's.
            roughness: 0 to 1.
        """
        require(np.isfinite(depth) and depth > 0, f"a depth of {depth} m", "positive metres")
        clear = np.exp(-np.asarray(absorption, float) * depth)
        straight = float(np.exp(-scattering * depth))
        opacity = max(1.0 - straight * float(clear.mean()), LEAST_OPACITY)
        color = straight * clear + (1.0 - straight) * np.asarray(albedo, float)
        return cls(name, _triple(color), refractive_index, roughness, opacity, _triple(np.asarray(emission, float)))


def _triple(values: np.ndarray) -> Color:
    return (float(values[0]), float(values[1]), float(values[2]))


def write_material(stage: Usd.Stage, place: Sdf.Path, material: PreviewMaterial) -> UsdShade.Material:
    """A material below `place`, under its own name."""
    made, surface = _material(stage, place.AppendChild(Tf.MakeValidIdentifier(material.name)))
    kinds = Sdf.ValueTypeNames
    diffuse = surface.CreateInput("diffuseColor", kinds.Color3f)
    if material.color is None:
        reader = UsdShade.Shader.Define(stage, made.GetPath().AppendChild("Colors"))
        reader.CreateIdAttr("UsdPrimvarReader_float3")
        reader.CreateInput("varname", kinds.String).Set("displayColor")
        reader.CreateInput("fallback", kinds.Float3).Set(Gf.Vec3f(0.5))
        diffuse.ConnectToSource(reader.CreateOutput("result", kinds.Float3))
    else:
        diffuse.Set(Gf.Vec3f(*(min(c, 1.0) for c in material.color)))
    if max(material.emission) > 0:
        surface.CreateInput("emissiveColor", kinds.Color3f).Set(Gf.Vec3f(*material.emission))
    for name, value in (
        ("roughness", material.roughness), ("ior", material.refractive_index), ("opacity", material.opacity),
        ("metallic", 0.0),
    ):  # fmt: skip
        surface.CreateInput(name, kinds.Float).Set(float(value))
    return made


def write_ground(stage: Usd.Stage, mesh: UsdGeom.Mesh, ground: TriangleMesh, picture: str) -> None:
    """A dull material on a mesh: the picture where the ground has texture coordinates, else the vertices' colours.

    Args:
        stage: with the mesh.
        mesh: of the ground.
        ground: what it was made of.
        picture: name of the texture, relative to the file; USD counts v from below.
    """
    place = mesh.GetPath().AppendChild("Material")
    if ground.uv is None:
        material = write_material(
            stage, mesh.GetPath(), PreviewMaterial("Material", refractive_index=1.5, roughness=1.0)
        )
        bind(mesh, material)
        return
    corners = np.ascontiguousarray(ground.uv.reshape(-1, 2) * (1.0, -1.0) + (0.0, 1.0), np.float32)
    primvar = UsdGeom.PrimvarsAPI(mesh).CreatePrimvar(
        "st", Sdf.ValueTypeNames.TexCoord2fArray, UsdGeom.Tokens.faceVarying
    )
    primvar.Set(Vt.Vec2fArray.FromNumpy(corners))
    material, surface = _material(stage, place)
    reader, texture = (UsdShade.Shader.Define(stage, place.AppendChild(name)) for name in ("Coordinates", "Texture"))
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
    surface.CreateInput("diffuseColor", kinds.Color3f).ConnectToSource(colour)
    surface.CreateInput("roughness", kinds.Float).Set(1.0)
    bind(mesh, material)


def bind(mesh: UsdGeom.Gprim, material: UsdShade.Material) -> None:
    """Give a prim its material."""
    UsdShade.MaterialBindingAPI.Apply(mesh.GetPrim()).Bind(material)


def _material(stage: Usd.Stage, place: Sdf.Path) -> tuple[UsdShade.Material, UsdShade.Shader]:
    material = UsdShade.Material.Define(stage, place)
    surface = UsdShade.Shader.Define(stage, place.AppendChild("Surface"))
    surface.CreateIdAttr("UsdPreviewSurface")
    material.CreateSurfaceOutput().ConnectToSource(surface.CreateOutput("surface", Sdf.ValueTypeNames.Token))
    return material, surface
