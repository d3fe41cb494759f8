"""Runs inside Blender: import an asset, change it in the panel, simulate, refresh. Arguments after --: folder of the
extension, asset, command. Prints one JSON line."""

import json
import sys
from pathlib import Path

import bpy

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


out: dict = {"version": bpy.app.version_string}
bpy.ops.fluidlift.import_asset(directory=asset)
out["objects"] = sorted(o.name for o in scene.objects)
out["range"] = [scene.frame_start, scene.frame_end]
out["rate"] = scene.render.fps / scene.render.fps_base
out["viscosity"] = settings.viscosity
out["first"] = look()
scene.frame_set(scene.frame_end)
out["last"] = look()
camera = scene.camera
out["camera"] = {"matrix": [list(row) for row in camera.matrix_world], "lens": camera.data.lens}

bpy.ops.mesh.primitive_uv_sphere_add(radius=0.02, location=tuple(out["first"]["surface"]["high"]))
bpy.context.active_object.name = "ball"
bpy.ops.fluidlift.add_obstacle()
settings.viscosity = 0.01
settings.duration = 3 / out["rate"]
bpy.ops.fluidlift.simulate(wait=True)
out["told"] = settings.told
out["after"] = [scene.frame_start, scene.frame_end]
scene.frame_set(scene.frame_end)
out["changed"] = look()
out["bodies"] = sorted(o.name for o in scene.objects)
settings.command = "/no/such/command"
try:
    bpy.ops.fluidlift.simulate(wait=True)
except RuntimeError as error:  # in the background an operator's report is raised
    out["refused"] = str(error)
fluidlift_asset.unregister()
print("RESULT " + json.dumps(out))
