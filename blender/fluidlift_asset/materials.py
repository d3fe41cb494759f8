"""What a liquid looks like in Cycles and EEVEE: the numbers of `fluidlift.look.materials`, as nodes.

Bodies that light passes get a refracting surface and their absorption and scattering as a volume, in 1/m; bodies that
are opaque within millimetres get their colour. Colours are linear.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import bpy

from .build import COLOR

OPAQUE = 300.0
"""1/m of scattering, from which on nothing is seen through a few millimetres"""
DYED, LEAST = 0.1, 1e-3
"""m through which light takes on a tint in full, and what a channel of it counts at least"""
TURNS = 8
"""of light in a body that scatters it, that Cycles follows at least"""

Color = tuple


class Liquid(NamedTuple):
    """A preset of fluidlift."""

    refractive_index: float
    roughness: float
    absorption: Color
    """1/m"""
    scattering: float
    """1/m"""
    albedo: Color
    """of a body so deep that one sees nothing behind it"""
    emission: Color = (0.0, 0.0, 0.0)


LIQUIDS = {
    "source": Liquid(1.333, 0.12, (0.0, 0.0, 0.0), 400.0, (0.8, 0.8, 0.8)),
    "water": Liquid(1.333, 0.0, (0.27, 0.056, 0.010), 0.0, (0.8, 0.8, 0.8)),
    "muddy_water": Liquid(1.334, 0.0, (0.9, 1.6, 3.4), 22.0, (0.30, 0.185, 0.085)),
    "honey": Liquid(1.49, 0.04, (3.0, 16.0, 70.0), 15.0, (0.1992, 0.0614, 0.0164)),
    "lava": Liquid(1.58, 0.45, (300.0, 300.0, 300.0), 3000.0, (0.035, 0.030, 0.028), (4.5, 0.60, 0.006)),
    "milk": Liquid(1.35, 0.05, (1.1, 2.4, 14.0), 3200.0, (0.91, 0.88, 0.76)),
    "oil": Liquid(1.47, 0.02, (9.0, 7.0, 150.0), 0.8, (0.0073, 0.0093, 0.0004)),
    "chocolate": Liquid(1.457, 0.22, (400.0, 900.0, 1500.0), 4000.0, (0.105, 0.042, 0.018)),
}


def liquid_material(name: str, tint: Color = (1.0, 1.0, 1.0)) -> bpy.types.Material:
    """The material of a preset, made anew; of "source" the colour is that of the vertices."""
    title = f"fluidlift {name}"
    material = bpy.data.materials.get(title) or bpy.data.materials.new(title)
    if material.node_tree is None:
        material.use_nodes = True
    liquid = LIQUIDS.get(name, LIQUIDS["source"])
    nodes, links = material.node_tree.nodes, material.node_tree.links
    nodes.clear()
    output, shader = nodes.new("ShaderNodeOutputMaterial"), nodes.new("ShaderNodeBsdfPrincipled")
    output.location = (320, 0)
    links.new(shader.outputs[0], output.inputs["Surface"])
    opaque = liquid.scattering >= OPAQUE
    color = tuple(a * t for a, t in zip(liquid.albedo, tint))
    if opaque:
        material.diffuse_color = (*color, 1.0)
    else:  # in plain views of Blender: what comes through five centimetres
        material.diffuse_color = (*(math.exp(-0.05 * a) * t for a, t in zip(liquid.absorption, tint)), 0.6)
    _set(shader, ("Base Color",), (*color, 1.0) if opaque else (1.0, 1.0, 1.0, 1.0))
    _set(shader, ("IOR",), liquid.refractive_index)
    _set(shader, ("Roughness",), liquid.roughness)
    _set(shader, ("Transmission Weight", "Transmission"), 0.0 if opaque else 1.0)
    strength = max(liquid.emission)
    if strength > 0:
        glow = tuple(e / strength * t for e, t in zip(liquid.emission, tint))
        _set(shader, ("Emission Color", "Emission"), (*glow, 1.0))
        _set(shader, ("Emission Strength",), strength)
    if name == "source":
        _colors_of_vertices(material, shader, tint)
    for name_of_flag in ("use_screen_refraction", "use_raytrace_refraction"):  # EEVEE's, of older and newer versions
        if hasattr(material, name_of_flag):
            setattr(material, name_of_flag, not opaque)
    if not opaque:
        _lit_through(material, output, shader)
        _body(material, output, liquid, tint)
    return material


def body_material() -> bpy.types.Material:
    """Of obstacles that have colours: those of their vertices, dull."""
    title = "fluidlift obstacle"
    material = bpy.data.materials.get(title)
    if material is not None:
        return material
    material = bpy.data.materials.new(title)
    if material.node_tree is None:
        material.use_nodes = True
    nodes, links = material.node_tree.nodes, material.node_tree.links
    nodes.clear()
    output, shader = nodes.new("ShaderNodeOutputMaterial"), nodes.new("ShaderNodeBsdfPrincipled")
    output.location = (320, 0)
    links.new(shader.outputs[0], output.inputs["Surface"])
    _colors_of_vertices(material, shader, (1.0, 1.0, 1.0))
    return material


class Foam(NamedTuple):
    """A kind of white water."""

    roughness: float
    refractive_index: float


WHITEWATER = {"spray": Foam(0.1, 1.333), "foam": Foam(0.8, 1.1), "bubbles": Foam(0.3, 1.333)}
"""by their numbers: spray is drops, which glitter; foam is walls of water around air, matte and next to without gloss;
bubbles are faint by their opacity"""


def whitewater_material(kind: str) -> bpy.types.Material:
    """Of a kind of white water, as a person left it or new: the points' own colour, as opaque as they are."""
    title = f"fluidlift {kind}"
    material = bpy.data.materials.get(title)
    if material is not None:
        return material
    material = bpy.data.materials.new(title)
    if material.node_tree is None:
        material.use_nodes = True
    material.diffuse_color = (0.85, 0.87, 0.9, 1.0)
    if hasattr(material, "blend_method"):  # EEVEE's of older versions takes points for solid otherwise
        material.blend_method = "HASHED"
    nodes, links = material.node_tree.nodes, material.node_tree.links
    nodes.clear()
    output, shader = nodes.new("ShaderNodeOutputMaterial"), nodes.new("ShaderNodeBsdfPrincipled")
    output.location = (320, 0)
    links.new(shader.outputs[0], output.inputs["Surface"])
    _set(shader, ("IOR",), WHITEWATER[kind].refractive_index)
    _set(shader, ("Roughness",), WHITEWATER[kind].roughness)
    _colors_of_vertices(material, shader, (1.0, 1.0, 1.0))
    opacity = nodes.new("ShaderNodeAttribute")
    opacity.location = (-220, -200)
    opacity.attribute_name = "opacity"
    links.new(opacity.outputs["Fac"], shader.inputs["Alpha"])
    return material


def _set(shader: bpy.types.ShaderNode, names: tuple, value) -> None:
    """The first input of these names that this version of Blender has."""
    for name in names:
        if name in shader.inputs:
            shader.inputs[name].default_value = value
            return


def _colors_of_vertices(material: bpy.types.Material, shader: bpy.types.ShaderNode, tint: Color) -> None:
    nodes, links = material.node_tree.nodes, material.node_tree.links
    attribute, dye = nodes.new("ShaderNodeAttribute"), nodes.new("ShaderNodeVectorMath")
    attribute.location, dye.location = (-420, 0), (-220, 0)
    attribute.attribute_name = COLOR
    dye.operation = "MULTIPLY"
    dye.inputs[1].default_value = tuple(tint)
    links.new(attribute.outputs["Color"], dye.inputs[0])
    links.new(dye.outputs[0], shader.inputs["Base Color"])


def _lit_through(material: bpy.types.Material, output: bpy.types.ShaderNode, shader: bpy.types.ShaderNode) -> None:
    """Lamps shine straight through the surface: Cycles finds next to no light that is refracted on its way to the bed,
    which would lie in the dark. The volume still takes its share of it."""
    nodes, links = material.node_tree.nodes, material.node_tree.links
    path, clear, mix = (nodes.new(f"ShaderNode{n}") for n in ("LightPath", "BsdfTransparent", "MixShader"))
    path.location, clear.location, mix.location = (-220, 420), (-220, 120), (140, 120)
    links.new(path.outputs["Is Shadow Ray"], mix.inputs[0])
    links.new(shader.outputs[0], mix.inputs[1])
    links.new(clear.outputs[0], mix.inputs[2])
    links.new(mix.outputs[0], output.inputs["Surface"])


def medium(liquid: Liquid, tint: Color) -> tuple[list[float], list[float]]:
    """Absorption and scattering, 1/m for each channel, of a body that shows its colour where it is deep.

    What a clear one absorbs is its own. In others light is lost at the same rate, and the share of it that goes on is
    that with which a half space has the colour: van de Hulst's R = (1 - s)(1 - 0.139 s) / (1 + 1.17 s) with
    s = sqrt(1 - share) (Multiple Light Scattering, 1980), of which the surface throws a part back inside.
    """
    absorbed = [a - math.log(max(t, LEAST)) / DYED for a, t in zip(liquid.absorption, tint)]
    if liquid.scattering == 0:
        return absorbed, [0.0, 0.0, 0.0]
    scattered, inside = [], held_inside(liquid.refractive_index)
    for k, (color, t) in enumerate(zip(liquid.albedo, tint)):
        r = color * t / (1.0 - inside + inside * color * t)
        b, c = 1.139 + 1.17 * r, 1.0 - r
        s = (b - math.sqrt(b * b - 4 * 0.139 * c)) / (2 * 0.139)
        lost = absorbed[k] + liquid.scattering
        scattered.append((1.0 - s * s) * lost)
        absorbed[k] = lost - scattered[k]
    return absorbed, scattered


def held_inside(index: float, steps: int = 500) -> float:
    """Share of even light inside a body that its surface throws back, by reciprocity from what it mirrors outside."""
    mirrored = 0.0
    for k in range(steps):
        cos = (k + 0.5) / steps
        bent = math.sqrt(1.0 - (1.0 - cos * cos) / index**2)
        across, along = (cos - index * bent) / (cos + index * bent), (bent - index * cos) / (bent + index * cos)
        mirrored += cos * (across**2 + along**2) / steps
    return 1.0 - (1.0 - mirrored) / index**2


def _body(material: bpy.types.Material, output: bpy.types.ShaderNode, liquid: Liquid, tint: Color) -> None:
    """Absorption and scattering. Blender's nodes take a density (1/m) and a colour: what is absorbed is the density
    times what the colour lacks to white, what is scattered the density times the colour."""
    nodes, links = material.node_tree.nodes, material.node_tree.links
    absorbed, scattered = medium(liquid, tint)
    absorption = nodes.new("ShaderNodeVolumeAbsorption")
    absorption.location = (-220, -400)
    density = max(absorbed)
    absorption.inputs["Density"].default_value = density
    absorption.inputs["Color"].default_value = (*(1.0 - a / density if density > 0 else 1.0 for a in absorbed), 1.0)
    last, density = absorption.outputs[0], max(scattered)
    if density > 0:
        scatter, both = nodes.new("ShaderNodeVolumeScatter"), nodes.new("ShaderNodeAddShader")
        scatter.location, both.location = (-220, -560), (60, -400)
        scatter.inputs["Color"].default_value = (*(v / density for v in scattered), 1.0)
        scatter.inputs["Density"].default_value = density
        links.new(last, both.inputs[0])
        links.new(scatter.outputs[0], both.inputs[1])
        last = both.outputs[0]
    links.new(last, output.inputs["Volume"])


def turns_in_volumes(scene: bpy.types.Scene, name: str) -> None:
    """Let Cycles follow light through a body that scatters it: by default it stops at the first turn, and honey is as
    dark as what it absorbs."""
    liquid = LIQUIDS.get(name, LIQUIDS["source"])
    if 0 < liquid.scattering < OPAQUE and hasattr(scene, "cycles"):
        scene.cycles.volume_bounces = max(scene.cycles.volume_bounces, TURNS)
