"""White water in Blender: a modifier that makes renderers draw the points of spray, foam and bubbles, each kind with a
material of its own. Where a person has changed modifier or materials, they stay.
"""

from __future__ import annotations

import bpy

from .ground import geometry_sockets, operation
from .materials import WHITEWATER, whitewater_material

MODIFIER = "fluidlift white water"
WIDTH = 1.5
"""times a splat's standard deviation, the radius that a point is drawn with: as much of the picture as the splat hides
where it is more than a third as opaque as in its middle"""


def drawn_as_points(thing: bpy.types.Object | None) -> None:
    """Give the points of white water the modifier, where they have none."""
    if thing is None or MODIFIER in thing.modifiers:
        return
    for kind in WHITEWATER:
        thing.data.materials.append(whitewater_material(kind))
    thing.modifiers.new(MODIFIER, "NODES").node_group = _tree()


def _tree() -> bpy.types.NodeTree:
    """Vertices to spheres with the attribute `radius`. A cloud of points has one material in Blender: those of each
    `kind` become a cloud of their own, and these are joined as instances."""
    tree = bpy.data.node_groups.new(MODIFIER, "GeometryNodeTree")
    geometry_sockets(tree)
    nodes, links = tree.nodes, tree.links
    begin, end, all_kinds = (nodes.new(n) for n in ("NodeGroupInput", "NodeGroupOutput", "GeometryNodeJoinGeometry"))
    wide = operation(tree, "ShaderNodeMath", "MULTIPLY")
    wide.inputs[1].default_value = WIDTH
    links.new(_attribute(tree, "radius", "FLOAT"), wide.inputs[0])
    kind = _attribute(tree, "kind", "INT")
    for number, name in enumerate(WHITEWATER):
        same, points = operation(tree, "ShaderNodeMath", "COMPARE"), nodes.new("GeometryNodeMeshToPoints")
        put, apart = nodes.new("GeometryNodeSetMaterial"), nodes.new("GeometryNodeGeometryToInstance")
        links.new(kind, same.inputs[0])
        same.inputs[1].default_value, same.inputs[2].default_value = float(number), 0.5
        links.new(begin.outputs[0], points.inputs["Mesh"])
        links.new(same.outputs[0], points.inputs["Selection"])
        links.new(wide.outputs[0], points.inputs["Radius"])
        put.inputs["Material"].default_value = whitewater_material(name)
        links.new(points.outputs[0], put.inputs["Geometry"])
        links.new(put.outputs[0], apart.inputs[0])
        links.new(apart.outputs[0], all_kinds.inputs[0])
    links.new(all_kinds.outputs[0], end.inputs[0])
    return tree


def _attribute(tree: bpy.types.NodeTree, name: str, kind: str) -> bpy.types.NodeSocket:
    """The values of an attribute; Blender 3.4 has a socket for each type, of which one is enabled."""
    node = tree.nodes.new("GeometryNodeInputNamedAttribute")
    node.data_type = kind
    node.inputs["Name"].default_value = name
    return next(s for s in node.outputs if s.enabled and s.name == "Attribute")
