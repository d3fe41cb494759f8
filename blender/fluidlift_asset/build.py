"""Objects in Blender for the parts of an asset. All are in metres with z up, as the asset is."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path

import bpy
import numpy as np
from mathutils import Matrix

from .facts import frame_of, frames, read_bodies
from .packed import SUFFIX, read_packed
from .ply import columns, read_ply, whole_numbers

COLLECTION = "fluid asset"
TERRAIN = "terrain"
BODY = "fluidlift_body"
"""property of obstacles: their name in scene.yaml"""


def collection(keep: tuple[str, ...] = ()) -> bpy.types.Collection:
    """The collection of the asset in the scene; what an earlier import put there is removed but for those names."""
    found = bpy.data.collections.get(COLLECTION)
    if found is None:
        found = bpy.data.collections.new(COLLECTION)
    if found.name not in bpy.context.scene.collection.children:
        bpy.context.scene.collection.children.link(found)
    for thing in list(found.objects):
        if thing.name in keep:
            continue
        data = thing.data
        bpy.data.objects.remove(thing, do_unlink=True)
        if isinstance(data, bpy.types.Mesh) and data.users == 0:
            bpy.data.meshes.remove(data)
    return found


def objects() -> list[bpy.types.Object]:
    """What an import made; nothing where there was none."""
    found = bpy.data.collections.get(COLLECTION)
    return [] if found is None else list(found.objects)


COLOR = "Color"
"""attribute of the vertices' colours; Cycles takes `color` for that of a volume, and finds none: black"""


def fill_surface(mesh: bpy.types.Mesh, file: Path) -> None:
    """The mesh of one frame, with `velocity` (m/s, as Cycles takes it for motion blur) and its colour."""
    vertices, faces = read_ply(file)
    material = mesh.materials[0] if mesh.materials else None
    mesh.clear_geometry()
    points = columns(vertices, "x", "y", "z")
    if points is None or len(faces) == 0:
        return
    mesh.vertices.add(len(points))
    mesh.vertices.foreach_set("co", points.ravel())
    mesh.loops.add(3 * len(faces))
    mesh.loops.foreach_set("vertex_index", faces.astype(np.int32).ravel())
    mesh.polygons.add(len(faces))
    mesh.polygons.foreach_set("loop_start", np.arange(0, 3 * len(faces), 3, dtype=np.int32))
    if bpy.app.version < (4, 1):  # later versions take the length from the next start
        mesh.polygons.foreach_set("loop_total", np.full(len(faces), 3, np.int32))
    mesh.polygons.foreach_set("use_smooth", np.ones(len(faces), bool))
    attributes(mesh, vertices)
    if material is not None and not mesh.materials:
        mesh.materials.append(material)
    mesh.update(calc_edges=True)


def attributes(mesh: bpy.types.Mesh, table: np.ndarray) -> None:
    """What the vertices carry: velocity, colour, of splats size, opacity and id, of white water kind as well."""
    velocity = columns(table, "vx", "vy", "vz")
    if velocity is not None:
        _attribute(mesh, "velocity", "FLOAT_VECTOR").data.foreach_set("vector", velocity.ravel())
    color = columns(table, "red", "green", "blue")
    if color is not None:
        color = color / 255.0
    else:
        harmonic = columns(table, "f_dc_0", "f_dc_1", "f_dc_2")
        color = None if harmonic is None else np.clip(0.5 + 0.28209479 * harmonic, 0.0, 1.0)
    if color is not None:
        linear = np.where(color <= 0.04045, color / 12.92, ((color + 0.055) / 1.055) ** 2.4)
        full = np.concatenate([linear, np.ones((len(linear), 1))], axis=1).astype(np.float32)
        _attribute(mesh, COLOR, "FLOAT_COLOR").data.foreach_set("color", full.ravel())
    for name, values in sizes(table).items():
        _attribute(mesh, name, "FLOAT").data.foreach_set("value", values)
    for name in ("id", "kind"):
        number = whole_numbers(table, name)
        if number is not None:
            _attribute(mesh, name, "INT").data.foreach_set("value", number)


def sizes(table: np.ndarray) -> dict[str, np.ndarray]:
    """Radius (m) and opacity of points: as white water has them, or of the logarithms and logits of splats."""
    scale, radius = columns(table, "scale_0", "scale_1", "scale_2"), columns(table, "radius")
    opacity, found = columns(table, "opacity"), {}
    if radius is not None:
        found["radius"] = np.ascontiguousarray(radius[:, 0])
    elif scale is not None:
        found["radius"] = np.exp(scale).mean(axis=1).astype(np.float32)
    if opacity is not None:
        straight = opacity[:, 0] if radius is not None else 1 / (1 + np.exp(-opacity[:, 0]))
        found["opacity"] = np.ascontiguousarray(straight, np.float32)
    return found


def _attribute(mesh: bpy.types.Mesh, name: str, kind: str):
    found = mesh.attributes.get(name)
    return mesh.attributes.new(name, kind, "POINT") if found is None else found


def fill_points(mesh: bpy.types.Mesh, file: Path) -> None:
    """The splats or the white water of one frame as points with attributes."""
    table = read_packed(file) if file.suffix == SUFFIX else read_ply(file)[0]
    if len(table) > MOST_POINTS:
        raise ValueError(f"{file}: {len(table)} points, at most {MOST_POINTS} are shown")
    mesh.clear_geometry()
    points = columns(table, "x", "y", "z")
    if points is None:
        return
    mesh.vertices.add(len(points))
    mesh.vertices.foreach_set("co", points.ravel())
    attributes(mesh, table)
    mesh.update()


MOST_POINTS = 5_000_000
"""of a frame: as many splats as a packed one holds"""
FILLERS = {"surface": fill_surface, "splats": fill_points, "whitewater": fill_points}
"""how the sequences that follow the timeline are read"""


def sequence(
    into: bpy.types.Collection, name: str, kind: str, folder: Path, numbers: range | None = None
) -> bpy.types.Object | None:
    """An object whose mesh follows the timeline: that of an earlier import with its materials and modifiers, or a new
    one. None where there are no files. numbers: of its frames, where files are still to come; None: of the files."""
    numbers = frames(folder) if numbers is None else numbers
    if not numbers:
        return None
    thing = into.objects.get(name)
    if thing is None:
        thing = bpy.data.objects.new(name, bpy.data.meshes.new(name))
        into.objects.link(thing)
    thing["fluidlift_folder"], thing["fluidlift_kind"] = str(folder), kind
    thing["fluidlift_frames"] = [numbers[0], numbers[-1]]
    return thing


def show_frame(thing: bpy.types.Object, number: int) -> None:
    """Put the frame's file into an object of a sequence; before the first and after the last, these stay.

    Raises:
        OSError, ValueError: the file has gone, or is none; what was shown stays.
    """
    first, last = thing["fluidlift_frames"]
    file = frame_of(Path(thing["fluidlift_folder"]), min(max(number, first), last))
    shown = f"{file} {file.stat().st_mtime_ns}"
    if thing.get("fluidlift_shown") == shown:
        return
    FILLERS[thing["fluidlift_kind"]](thing.data, file)
    thing["fluidlift_shown"] = shown


def camera_of(into: bpy.types.Collection, file: Path) -> bpy.types.Object:
    """The clip's camera: focal length, principal point and pose."""
    facts = json.loads(Path(file).read_text(encoding="utf-8"))
    width, height, k = facts["width"], facts["height"], facts["K"]
    data = bpy.data.cameras.new("clip camera")
    data.sensor_fit, data.sensor_width = "HORIZONTAL", 36.0
    data.lens = k[0][0] * 36.0 / width
    # shifts are counted in the longer side of the picture, which is the width here whatever its shape
    data.shift_x = (0.5 * width - k[0][2]) / width
    data.shift_y = (k[1][2] - 0.5 * height) / width
    data.clip_start = 0.01
    thing = bpy.data.objects.new("clip camera", data)
    rotation, translation = np.array(facts["R"]), np.array(facts["t"])
    pose = np.eye(4)
    pose[:3, :3] = rotation.T @ np.diag([1.0, -1.0, -1.0])  # Blender's cameras look along -z with y up
    pose[:3, 3] = -rotation.T @ translation
    thing.matrix_world = Matrix(pose.tolist())
    into.objects.link(thing)
    render = bpy.context.scene.render
    render.resolution_x, render.resolution_y = width, height
    render.pixel_aspect_x, render.pixel_aspect_y = 1.0, k[0][0] / k[1][1]
    bpy.context.scene.camera = thing
    return thing


def moved_in(into: bpy.types.Collection, importer) -> list[bpy.types.Object]:
    """Objects that an importer adds, moved into a collection."""
    before = set(bpy.data.objects)
    importer()
    added = [o for o in bpy.data.objects if o not in before]
    for thing in added:
        for old in list(thing.users_collection):
            old.objects.unlink(thing)
        into.objects.link(thing)
    return added


def terrain_of(into: bpy.types.Collection, file: Path) -> bpy.types.Object | None:
    """Bed and banks, None where the fluid has none. What an earlier import made stays, with what a person did to it,
    as long as the ground is the same; another one takes its place, and stands where it was put."""
    had = into.objects.get(TERRAIN)
    told = hashlib.sha256(file.read_bytes()).hexdigest() if file.is_file() else ""
    if had is not None and had.get("fluidlift_file") == told:
        return had
    place = None if had is None else had.matrix_world.copy()
    if had is not None:
        bpy.data.objects.remove(had, do_unlink=True)
    if not told:
        return None
    if "bool" not in vars(np):  # the importer of Blender 3.4 still asks for the name that NumPy 1.24 has dropped
        np.bool = bool
    added = moved_in(into, lambda: bpy.ops.import_scene.gltf(filepath=str(file)))
    ground = next((o for o in added if o.type == "MESH"), None)
    if ground is not None:
        ground.name = TERRAIN
        ground["fluidlift_file"] = told
        if place is not None:
            ground.matrix_world = place
    return ground


def volume_of(into: bpy.types.Collection, folder: Path) -> bpy.types.Object | None:
    """The OpenVDB sequence, hidden in pictures: what it is for are forces and further work."""
    numbers = frames(folder, ".vdb")
    if not numbers:
        return None
    data = bpy.data.volumes.new("fluid volume")
    data.filepath = str(folder / f"{numbers[0]}.vdb")
    data.is_sequence = len(numbers) > 1
    data.frame_duration, data.frame_start, data.frame_offset = len(numbers), numbers[0], numbers[0] - 1
    thing = bpy.data.objects.new("fluid volume", data)
    thing.hide_render = True
    into.objects.link(thing)
    return thing


def bodies_of(into: bpy.types.Collection, folder: Path) -> list[bpy.types.Object]:
    """Obstacles, with a key on every frame where they move.

    Raises:
        RuntimeError: bodies.json is damaged, or names files elsewhere.
        OSError, ValueError: a mesh that is not there, or is none.
    """
    from .materials import body_material  # takes names from here

    made = []
    for body in read_bodies(folder):
        vertices, faces = read_ply(body.mesh)
        mesh = bpy.data.meshes.new(body.name)
        points = columns(vertices, "x", "y", "z")
        mesh.from_pydata([] if points is None else points.tolist(), [], faces.tolist())
        attributes(mesh, vertices)
        if COLOR in mesh.attributes:
            mesh.materials.append(body_material())
        thing = bpy.data.objects.new(body.name, mesh)
        thing[BODY] = body.name
        thing.rotation_mode = "QUATERNION"
        into.objects.link(thing)
        still = all(p == body.poses[0] for p in body.poses)
        for number, pose in enumerate(body.poses, body.first):
            thing.location, thing.rotation_quaternion = pose[:3], pose[3:]
            if still:
                break
            thing.keyframe_insert("location", frame=number)
            thing.keyframe_insert("rotation_quaternion", frame=number)
        made.append(thing)
    return made


def write_obj(path: Path, thing: bpy.types.Object) -> None:
    """The mesh of an object as it is seen, with its scale and rotation, around its own origin."""
    shown = thing.evaluated_get(bpy.context.evaluated_depsgraph_get())
    mesh = shown.to_mesh()
    try:
        mesh.calc_loop_triangles()
        turn = thing.matrix_world.to_3x3()
        lines = ["v {:.7g} {:.7g} {:.7g}".format(*(turn @ v.co)) for v in mesh.vertices]
        flip = turn.determinant() < 0  # a mirrored object would be inside out
        for triangle in mesh.loop_triangles:
            corners = [i + 1 for i in triangle.vertices]
            lines.append("f {} {} {}".format(*(reversed(corners) if flip else corners)))
    finally:
        shown.to_mesh_clear()
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
