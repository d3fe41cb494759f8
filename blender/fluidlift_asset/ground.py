"""Where the liquid lies on its ground: a modifier that puts its underside into bed and banks.

The surface around particles rests on the bed here and stands off it by a part of a cell there. Each gap is a film of
air, from which light that comes through clear water is thrown back: a dark or silver blot on the ground.
"""

from __future__ import annotations

import bpy

MODIFIER = "fluidlift rests on the ground"
NEAR, SUNK, DOWN = 1.0, 0.3, -0.3
"""cells: as near to the ground, what looks at it (cosine of its normal with the ground's) is put so deep into it"""


def rest_on(surface: bpy.types.Object, ground: bpy.types.Object | None, cell: float) -> None:
    """Give the surface the modifier, first of its modifiers, or take it away where there is no ground.

    Args:
        surface: of the liquid.
        ground: a mesh object; it may be moved afterwards.
        cell: of the simulation, m.
    """
    had = surface.modifiers.get(MODIFIER)
    if ground is None or ground.type != "MESH":
        if had is not None:
            surface.modifiers.remove(had)
        return
    tree = _tree(ground, cell)
    if had is None:
        had = surface.modifiers.new(MODIFIER, "NODES")
        if len(surface.modifiers) > 1 and hasattr(surface.modifiers, "move"):  # Blender 3.4 has it for a person only
            surface.modifiers.move(len(surface.modifiers) - 1, 0)
    old, had.node_group = had.node_group, tree
    if old is not None and old != tree and old.users == 0:
        bpy.data.node_groups.remove(old)


def _tree(ground: bpy.types.Object, cell: float) -> bpy.types.NodeTree:
    """Points whose normal is against that of the ground beside them, moved to beneath it."""
    tree = bpy.data.node_groups.new(MODIFIER, "GeometryNodeTree")
    geometry_sockets(tree)
    nodes, links = tree.nodes, tree.links
    kinds = {"in": "NodeGroupInput", "out": "NodeGroupOutput", "ground": "GeometryNodeObjectInfo",
             "nearest": "GeometryNodeProximity", "above": "GeometryNodeSampleNearestSurface",
             "normal": "GeometryNodeInputNormal", "move": "GeometryNodeSetPosition"}  # fmt: skip
    made = {name: nodes.new(kind) for name, kind in kinds.items()}
    made["ground"].inputs["Object"].default_value = ground
    made["ground"].transform_space = "RELATIVE"
    made["nearest"].target_element = "FACES"
    made["above"].data_type = "FLOAT_VECTOR"
    solid = made["ground"].outputs["Geometry"]
    links.new(solid, made["nearest"].inputs[0])
    links.new(solid, made["above"].inputs["Mesh"])
    links.new(made["normal"].outputs[0], _enabled(made["above"].inputs, "Value"))
    up = _enabled(made["above"].outputs, "Value")

    facing, downward = (
        operation(tree, "ShaderNodeVectorMath", "DOT_PRODUCT"),
        operation(tree, "ShaderNodeMath", "LESS_THAN"),
    )
    links.new(made["normal"].outputs[0], facing.inputs[0])
    links.new(up, facing.inputs[1])
    links.new(facing.outputs["Value"], downward.inputs[0])
    downward.inputs[1].default_value = DOWN
    close, both = operation(tree, "ShaderNodeMath", "LESS_THAN"), operation(tree, "ShaderNodeMath", "MULTIPLY")
    links.new(made["nearest"].outputs["Distance"], close.inputs[0])
    close.inputs[1].default_value = NEAR * cell
    links.new(downward.outputs[0], both.inputs[0])
    links.new(close.outputs[0], both.inputs[1])

    below, place = operation(tree, "ShaderNodeVectorMath", "SCALE"), operation(tree, "ShaderNodeVectorMath", "ADD")
    links.new(up, below.inputs[0])
    below.inputs["Scale"].default_value = -SUNK * cell
    links.new(made["nearest"].outputs["Position"], place.inputs[0])
    links.new(below.outputs[0], place.inputs[1])
    links.new(made["in"].outputs[0], made["move"].inputs["Geometry"])
    links.new(both.outputs[0], made["move"].inputs["Selection"])
    links.new(place.outputs[0], made["move"].inputs["Position"])
    links.new(made["move"].outputs[0], made["out"].inputs[0])
    return tree


def geometry_sockets(tree: bpy.types.NodeTree) -> None:
    """One geometry in, one out; Blender 4 has another way to say so."""
    if hasattr(tree, "interface"):
        for way in ("INPUT", "OUTPUT"):
            tree.interface.new_socket("Geometry", in_out=way, socket_type="NodeSocketGeometry")
    else:
        tree.inputs.new("NodeSocketGeometry", "Geometry")
        tree.outputs.new("NodeSocketGeometry", "Geometry")


def operation(tree: bpy.types.NodeTree, kind: str, name: str) -> bpy.types.Node:
    """A node that can do several things, set to one of them."""
    node = tree.nodes.new(kind)
    node.operation = name
    return node


def _enabled(sockets, name: str):
    """The socket of a name for the type that a node is set to; Blender 3.4 has one for each type."""
    return next(s for s in sockets if s.name == name and s.enabled)
