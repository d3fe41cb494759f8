"""Sun and sky for a scene that has no light yet: without something to mirror, water is a grey film."""

from __future__ import annotations

import math

import bpy
from mathutils import Vector

SKY, SUN = "fluidlift sky", "fluidlift sun"
ELEVATION, AZIMUTH, RADIUS = 40.0, -95.0, 1.5
"""degrees: of the sun, from +y towards +x; as in fluidlift's own pictures"""
STRENGTH = 0.7 * math.pi / math.sin(math.radians(ELEVATION))
"""W/m²: level white ground has a radiance of 0.7 by it, and of 1 with the sky"""
COLORS = (
    (0.0, (0.20, 0.17, 0.13)), (0.485, (0.20, 0.17, 0.13)), (0.505, (0.50, 0.54, 0.58)), (0.57, (0.42, 0.50, 0.62)),
    (0.75, (0.20, 0.31, 0.52)), (1.0, (0.13, 0.22, 0.44)),
)  # fmt: skip
"""linear, from straight down (0) over the horizon (0.5) to straight up (1): dry earth, haze, blue"""
_FACTORY = 0.0509
"""the grey of the world that Blender starts with"""


def light_up(scene: bpy.types.Scene, into: bpy.types.Collection) -> None:
    """Put up the sky where the scene has no world, or the one that Blender starts with; and a sun where it has none."""
    if not _blank(scene.world):
        return
    scene.world = bpy.data.worlds.get(SKY) or _sky()
    if any(o.type == "LIGHT" and o.data.type == "SUN" for o in scene.objects):
        return
    lamp = bpy.data.lights.new(SUN, "SUN")
    lamp.energy, lamp.angle, lamp.color = STRENGTH, math.radians(2 * RADIUS), (1.0, 0.93, 0.82)
    thing = bpy.data.objects.new(SUN, lamp)
    e, a = math.radians(ELEVATION), math.radians(AZIMUTH)
    to_sun = Vector((math.cos(e) * math.sin(a), math.cos(e) * math.cos(a), math.sin(e)))
    thing.rotation_euler = to_sun.to_track_quat("Z", "Y").to_euler()  # lamps shine along -z
    thing.location = 10.0 * to_sun
    # it shines straight through clear liquids (`materials`): light that is refracted on its way out of the bed and
    # happens to meet the sun would count twice, as a white speck
    thing.visible_transmission = False
    into.objects.link(thing)


def _blank(world: bpy.types.World | None) -> bool:
    if world is None or world.node_tree is None:
        return world is None
    shaders = [n for n in world.node_tree.nodes if n.bl_idname != "ShaderNodeOutputWorld"]
    if len(shaders) != 1 or shaders[0].bl_idname != "ShaderNodeBackground":
        return not shaders
    color, strength = shaders[0].inputs["Color"], shaders[0].inputs["Strength"]
    grey = all(abs(c - _FACTORY) < 1e-3 for c in tuple(color.default_value)[:3])
    return grey and abs(strength.default_value - 1.0) < 1e-6 and not color.is_linked


def _sky() -> bpy.types.World:
    world = bpy.data.worlds.new(SKY)
    if world.node_tree is None:  # later versions make it by themselves
        world.use_nodes = True
    nodes, links = world.node_tree.nodes, world.node_tree.links
    nodes.clear()
    kinds = ("TexCoord", "SeparateXYZ", "MapRange", "ValToRGB", "Background", "OutputWorld")
    where, apart, share, ramp, background, output = (nodes.new(f"ShaderNode{k}") for k in kinds)
    for k, node in enumerate((where, apart, share, ramp, background, output)):
        node.location = (220 * k - 900, 0)
    share.inputs["From Min"].default_value, share.inputs["From Max"].default_value = -1.0, 1.0
    stops = ramp.color_ramp.elements
    while len(stops) < len(COLORS):
        stops.new(1.0)
    for stop, (at, color) in zip(stops, COLORS):
        stop.position, stop.color = at, (*color, 1.0)
    links.new(where.outputs["Generated"], apart.inputs[0])
    links.new(apart.outputs["Z"], share.inputs["Value"])
    links.new(share.outputs[0], ramp.inputs[0])
    links.new(ramp.outputs["Color"], background.inputs["Color"])
    links.new(background.outputs[0], output.inputs["Surface"])
    return world
