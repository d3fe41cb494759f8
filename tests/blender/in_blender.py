"""Runs inside Blender: import an asset, change it in the panel, simulate, refresh. Arguments after --: folder of the
extension, asset, command. Prints one JSON line."""

import json
import shutil
import struct
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import bpy
import numpy as np

extension, asset, command = sys.argv[sys.argv.index("--") + 1 :][:3]
sys.path.insert(0, str(Path(extension).parent))

import fluidlift_asset  # noqa: E402  # pyright: ignore[reportMissingImports]

bpy.ops.wm.read_factory_settings(use_empty=True)
fluidlift_asset.register()
scene = bpy.context.scene
settings = scene.fluidlift
settings.command = command


def look() -> dict:
    """The surface and the splats as they are at the current frame."""
    surface, splats = bpy.data.objects["fluid surface"], bpy.data.objects["fluid splats"]
    found = {}
    for name, thing in (("surface", surface), ("splats", splats)):
        mesh = thing.data
        points = [tuple(thing.matrix_world @ v.co) for v in mesh.vertices]
        speed = [tuple(v.vector) for v in mesh.attributes["velocity"].data]
        found[name] = {
            "vertices": len(points), "faces": len(mesh.polygons),
            "low": [min(p[a] for p in points) for a in range(3)], "high": [max(p[a] for p in points) for a in range(3)],
            "velocity": [sum(v[a] for v in speed) / len(speed) for a in range(3)],
        }  # fmt: skip
    return found


def values() -> list:
    """Of the panel, what the test changes."""
    return [settings.viscosity, settings.material, settings.duration]


def refused(call) -> str:
    """What an operator says that cannot do its work; in the background its report is raised."""
    try:
        call()
    except RuntimeError as error:
        return str(error)
    return "not refused"


def picture() -> np.ndarray:
    """A small one by Cycles from the clip's camera, with motion blur."""
    render = scene.render
    render.engine, render.resolution_percentage, render.use_motion_blur, render.motion_blur_shutter = (
        "CYCLES",
        50,
        True,
        1,
    )
    scene.cycles.samples, scene.cycles.use_denoising, scene.cycles.use_adaptive_sampling = 4, False, False
    render.filepath = str(Path(asset).with_name("picture.png"))
    bpy.ops.render.render(write_still=True)
    found = bpy.data.images.load(render.filepath)
    pixels = np.array(found.pixels[:]).reshape(-1, 4)[:, :3]
    bpy.data.images.remove(found)
    return pixels


def blurred_by_velocity() -> list[float]:
    """Mean differences to a picture with the surface at rest: of one with its velocities, and of one more at rest."""
    scene.world = bpy.data.worlds.new("light")
    if scene.world.node_tree is None:  # later versions make it by themselves
        scene.world.use_nodes = True
    scene.world.node_tree.nodes["Background"].inputs["Color"].default_value = (1.0, 1.0, 1.0, 1.0)
    moving, mesh = picture(), bpy.data.objects["fluid surface"].data
    mesh.attributes["velocity"].data.foreach_set("vector", np.zeros(3 * len(mesh.vertices), np.float32))
    still, again = picture(), picture()
    del bpy.data.objects["fluid surface"]["fluidlift_shown"]
    return [float(np.abs(p - still).mean()) for p in (moving, again)]


def shows_its_colors() -> bool:
    """Whether a picture of the surface in the clip's colours turns red with the vertices, where it did not before."""
    settings.material, mesh = "source", bpy.data.objects["fluid surface"].data
    red = np.tile(np.float32([1, 0, 0, 1]), len(mesh.vertices))
    before = picture()
    mesh.attributes["Color"].data.foreach_set("color", red)
    after = picture()
    del bpy.data.objects["fluid surface"]["fluidlift_shown"]
    changed = np.abs(after - before).max(axis=1) > 0.1
    redder = (after[:, 0] - after[:, 1])[changed] - (before[:, 0] - before[:, 1])[changed]
    return bool(changed.mean() > 0.02 and redder.mean() > 0.1)


def surface_material() -> str:
    return bpy.data.objects["fluid surface"].data.materials[0].name


class Layout:
    """Takes what a panel draws, and wants every property and operator to be there."""

    def __init__(self) -> None:
        self.drawn: list[str] = []

    def prop(self, data, name: str) -> None:
        self.drawn.append(data.bl_rna.properties[name].name)

    def operator(self, name: str, text: str = ""):
        group, short = name.split(".")
        self.drawn.append(text or getattr(getattr(bpy.ops, group), short).get_rna_type().name)
        return SimpleNamespace()

    def label(self, text: str = "") -> None:
        self.drawn.append(text)

    def box(self) -> "Layout":
        return self

    def row(self, align: bool = False) -> "Layout":
        return self


def panel() -> list[str]:
    """What the sidebar and the menu draw."""
    layout = Layout()
    fluidlift_asset.Panel.draw(SimpleNamespace(layout=layout), bpy.context)
    fluidlift_asset.menu(SimpleNamespace(layout=layout), bpy.context)
    return layout.drawn


def contact() -> dict:
    """How far the modifier moves points, m, and whether those that it moves end inside the ground."""
    surface, ground = bpy.data.objects["fluid surface"], bpy.data.objects["terrain"]
    shown = surface.evaluated_get(bpy.context.evaluated_depsgraph_get()).data
    ways = [(a.co - b.co).length for a, b in zip(shown.vertices, surface.data.vertices)]
    moved = [v.co for v, way in zip(shown.vertices, ways) if way > 1e-7]
    into = ground.matrix_world.inverted()
    inside = []
    for place in moved:
        _, at, normal, _ = ground.closest_point_on_mesh(into @ place)
        inside.append((into @ place - at).dot(normal) < 0)
    return {"points": len(ways), "moved": len(moved), "farthest": max(ways), "inside": sum(inside)}


def painted_body() -> list:
    """Material and first colour of an obstacle whose file has colours, sRGB (255, 204, 26)."""
    folder = Path(asset).with_name("painted")
    (folder / "bodies").mkdir(parents=True)
    fields = [f"property float {a}" for a in "xyz"] + [f"property uchar {c}" for c in ("red", "green", "blue")]
    header = ["ply", "format binary_little_endian 1.0", "element vertex 3", *fields, "element face 1",
              "property list uchar int vertex_indices", "end_header\n"]  # fmt: skip
    corners = b"".join(struct.pack("<fffBBB", x, y, 0, 255, 204, 26) for x, y in ((0, 0), (1, 0), (0, 1)))
    file = folder / "bodies" / "01_duck.ply"
    file.write_bytes("\n".join(header).encode() + corners + struct.pack("<Biii", 3, 0, 1, 2))
    told = {"name": "painted", "mesh": "bodies/01_duck.ply", "first": 1001, "poses": [[0, 0, 0, 1, 0, 0, 0]]}
    (folder / "bodies.json").write_text(json.dumps({"bodies": [told]}))
    (thing,) = fluidlift_asset.build.bodies_of(scene.collection, folder)
    found = [thing.data.materials[0].name, list(thing.data.attributes["Color"].data[0].color)[:3]]
    bpy.data.objects.remove(thing)
    return found


def white_water() -> dict:
    """What becomes of three frames of white water: none, one particle of each kind, and none asked for any more."""
    folder, kinds = Path(asset).with_name("white") / "whitewater", [0, 1, 2]
    folder.mkdir(parents=True)
    fields = [f"property float {a}" for a in ("x", "y", "z", "vx", "vy", "vz", "radius", "opacity")]
    fields += [f"property uchar {c}" for c in ("red", "green", "blue")] + [f"property int {a}" for a in ("kind", "id")]
    for number, own in ((1001, []), (1002, kinds)):
        header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(own)}", *fields, "end_header\n"]
        rows = (struct.pack("<8f3B2i", k, 0, 1, 0, k, 0, 0.25, 0.5, 255, 255, 255, k, 2**29 + k) for k in own)
        (folder / f"{number}.ply").write_bytes("\n".join(header).encode() + b"".join(rows))
    into = fluidlift_asset.build.collection(tuple(o.name for o in fluidlift_asset.build.objects()))
    fluidlift_asset.show_whitewater(into, folder, range(1001, 1003))
    thing = bpy.data.objects[fluidlift_asset.WHITE]
    found = {"materials": [m.name for m in thing.data.materials], "points": []}
    for number in (1001, 1002):
        fluidlift_asset.build.show_frame(thing, number)
        found["points"].append(len(thing.data.vertices))
    values = {n: a.data for n, a in thing.data.attributes.items()}
    found["told"] = {n: [v.value for v in values[n]] for n in ("kind", "id", "radius", "opacity")}
    found["velocity"] = [list(v.vector) for v in values["velocity"]]
    bpy.context.view_layer.update()
    found["drawn"] = []
    for one in bpy.context.evaluated_depsgraph_get().object_instances:  # an instance is there for its own turn only
        if one.object.type == "POINTCLOUD":
            cloud = one.object.data
            places, radii = [list(p.co) for p in cloud.points], [p.radius for p in cloud.points]
            found["drawn"].append([cloud.materials[0].name, places, radii, "velocity" in cloud.attributes])
    mine = thing.data.materials[1]
    mine.diffuse_color = (1.0, 0.0, 0.0, 1.0)
    fluidlift_asset.show_whitewater(into, folder, range(1001, 1003))  # a refresh: nothing is added or put back
    found["kept"] = [len(thing.modifiers), len(thing.data.materials), list(mine.diffuse_color)]
    fluidlift_asset.show_whitewater(into, folder, range(0))
    found["gone"] = fluidlift_asset.WHITE not in bpy.data.objects
    return found


def waited() -> dict:
    """What stands in the status bar and beside the pointer while a command is at work."""
    bar, pointer = [], []
    manager = SimpleNamespace(
        progress_begin=lambda low, high: pointer.append([low, high]), progress_update=pointer.append,
        progress_end=lambda: pointer.append("end"),
    )  # fmt: skip
    context = SimpleNamespace(
        window=None, window_manager=manager, workspace=SimpleNamespace(status_text_set=bar.append)
    )
    with fluidlift_asset.waiting(context, "simulating") as told:
        told("[1/2] re-simulating: 10 of 40, about 3 min left")
        told("[2/2] rendering and writing ...")
    return {"bar": bar, "pointer": pointer}


out: dict = {"version": bpy.app.version_string, "refused": {}}
settings.command = "/no/such/command"
out["refused"]["command"] = refused(lambda: bpy.ops.fluidlift.import_asset(directory=asset))
out["refused"]["folder"] = refused(lambda: bpy.ops.fluidlift.import_asset(directory=str(Path(extension))))
settings.command = command
bpy.ops.fluidlift.import_asset(directory=asset)
out["objects"] = sorted(o.name for o in scene.objects)
out["range"] = [scene.frame_start, scene.frame_end]
out["rate"] = scene.render.fps / scene.render.fps_base
out["viscosity"] = settings.viscosity
out["material"] = [surface_material()]
out["first"] = look()
scene.frame_set(scene.frame_end)
out["last"] = look()
camera = scene.camera
out["camera"] = {"matrix": [list(row) for row in camera.matrix_world], "lens": camera.data.lens}
out["light"] = [scene.world.name, sum(o.type == "LIGHT" for o in scene.objects)]
out["sun refracted"] = [o.visible_transmission for o in scene.objects if o.type == "LIGHT"]
out["panel"] = panel()
out["waited"] = waited()
out["contact"] = contact()
out["painted"] = painted_body()
out["white"] = white_water()
out["blur"] = blurred_by_velocity()
out["colors"] = shows_its_colors()

bpy.data.objects["fluid surface"].modifiers.new("mine", "SMOOTH")
low, high = out["first"]["surface"]["low"], out["first"]["surface"]["high"]
bpy.ops.mesh.primitive_uv_sphere_add(
    radius=0.06, location=(0.5 * (low[0] + high[0]), 0.5 * (low[1] + high[1]), high[2] + 0.05)
)
bpy.context.active_object.name = "ball"
settings.motion = "free"
out["panel"] += panel()
bpy.ops.fluidlift.add_obstacle()
out["refused"]["twice"] = refused(bpy.ops.fluidlift.add_obstacle)
settings.material = "honey"
out["material"].append(surface_material())
nodes = bpy.data.objects["fluid surface"].data.materials[0].node_tree.nodes
out["honey"] = {
    n.bl_idname: [n.inputs["Density"].default_value, *n.inputs["Color"].default_value]
    for n in nodes
    if "Volume" in n.bl_idname
}
settings.viscosity = 0.01
settings.duration = 3 / out["rate"]
bpy.ops.fluidlift.simulate(wait=True)
out["told"] = settings.told
out["after"] = [scene.frame_start, scene.frame_end]
body = next((o for o in scene.objects if o.get("fluidlift_body") == "ball"), None)
out["ball"] = []
for number in out["after"]:
    scene.frame_set(number)
    out["ball"].append(None if body is None else list(body.matrix_world.translation))
out["changed"] = look()
out["material"].append(surface_material())
out["modifiers"] = [m.name for m in bpy.data.objects["fluid surface"].modifiers]
finished, aside = Path(asset, "work"), Path(asset).with_name("work aside")
for move in ((finished, aside), (aside, finished)):  # an asset as it is handed on, without its work/; then whole again
    move[0].rename(move[1])
    shutil.rmtree(Path(asset, "blender"))
    bpy.ops.fluidlift.refresh()
    out.setdefault("warned", settings.told)
shutil.rmtree(Path(asset, "blender"))
scene.frame_set(scene.frame_start + 1)
fluidlift_asset.export(bpy.context, Path(asset), False, wait=False)
out["one at once"] = sorted(p.name for p in Path(asset, "blender", "surface").glob("*.ply"))
fluidlift_asset.surfaces_first()  # what a picture waits for
out["all before a picture"] = len(list(Path(asset, "blender", "surface").glob("1*.ply")))
body = next(o for o in scene.objects if o.get("fluidlift_body") == "ball")
bpy.context.view_layer.objects.active = body
bpy.ops.fluidlift.remove_obstacle()
bpy.ops.fluidlift.undo()
out["undone"] = [values()]
bpy.ops.fluidlift.undo()  # of what the panel changed: it goes back with it
out["undone"].append(values())
out["material"].append(surface_material())
subprocess.run([command, "edit", asset, "--redo"], capture_output=True)
settings.command = "/no/such/command"
out["refused"]["simulate"] = refused(lambda: bpy.ops.fluidlift.simulate(wait=True))
fluidlift_asset.unregister()
print("RESULT " + json.dumps(out))
