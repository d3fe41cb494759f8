"""Open exports in Blender and compare what arrives with what was written: upright, in metres, with velocities.

Two steps, because Blender brings its own Python:

    python benchmarks/check_blender.py export ASSET FOLDER         # with fluidlift
    blender -b --factory-startup --python-exit-code 1 --python benchmarks/check_blender.py -- read FOLDER

The second step prints a line for each format and exits with 1 when a position, a size, a velocity or a frame is off.
It needs nothing but Blender; formats that a version cannot open are named.
"""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

FRAMES = (1001, 1003)
FORMATS = {
    "mesh": (), "obj": ("--to", "obj"), "vdb": ("--to", "vdb"), "usd": ("--to", "usd"),
    "usd-y": ("--to", "usd", "--up-axis", "y", "--meters-per-unit", "0.01"), "clips": ("--to", "usd-clips"),
}  # fmt: skip
"""folders, and the options of the export that fills them"""
TOLERANCE = 1e-3
"""m; the files hold float32"""


def export(asset: Path, folder: Path) -> None:
    """Write every format, and the bounds that the surface must have in Blender (z up, metres)."""
    import numpy as np

    from fluidlift.io.ply import read_mesh

    for name, options in FORMATS.items():
        command = [sys.executable, "-m", "fluidlift", "export", str(asset), "-o", str(folder / name), *options]
        subprocess.run([*command, "--frames", f"{FRAMES[0]}-{FRAMES[1]}"], check=True, stdout=subprocess.DEVNULL)
    expected = {}
    for number in range(FRAMES[0], FRAMES[1] + 1):
        mesh = read_mesh(folder / "mesh" / f"{number}.ply")
        low, high = np.asarray(mesh.vertices).min(0), np.asarray(mesh.vertices).max(0)
        expected[number] = {"low": low.tolist(), "high": high.tolist(), "vertices": len(mesh.vertices)}
    spacing = json.loads((asset / "manifest.json").read_text(encoding="utf-8"))["grid"]["spacing"]
    (folder / "expected.json").write_text(json.dumps({"frames": expected, "spacing": spacing}), encoding="utf-8")


def bounds(bpy, thing) -> tuple[list[float], list[float]]:
    """Low and high corner of an object in the world, as it stands at the current frame."""
    shown = thing.evaluated_get(bpy.context.evaluated_depsgraph_get())
    points = [shown.matrix_world @ v.co for v in shown.data.vertices]
    return [min(p[a] for p in points) for a in range(3)], [max(p[a] for p in points) for a in range(3)]


def off(got, expected) -> float:
    """Largest difference between two boxes, m."""
    pairs = zip([*got[0], *got[1]], [*expected["low"], *expected["high"]])
    return max(abs(a - b) for a, b in pairs)


def imported(bpy, call) -> list:
    """Objects that an importer adds."""
    before = set(bpy.data.objects)
    call()
    return [o for o in bpy.data.objects if o not in before]


def read(folder: Path) -> int:
    """Open every format; the number of faults."""
    import bpy  # pyright: ignore[reportMissingImports]

    bpy.ops.wm.read_factory_settings(use_empty=True)
    facts = json.loads((folder / "expected.json").read_text(encoding="utf-8"))
    print(f"Blender {bpy.app.version_string}")
    faults = sum(check(bpy, folder, facts["frames"]) for check in (check_ply, check_obj, check_glb, check_bodies))
    for layout in ("usd", "usd-y", "clips"):
        faults += check_usd(bpy, folder, facts["frames"], layout)
    return faults + check_vdb(bpy, folder, facts["frames"], facts["spacing"])


def told(name: str, fault: str, found: str) -> int:
    """One line; 1 where it is a fault."""
    print(f"{name:5} {'FAILED: ' + fault if fault else 'ok: ' + found}")
    return int(bool(fault))


def check_ply(bpy, folder: Path, expected: dict) -> int:
    """Positions and number of vertices of each frame."""
    worst = 0.0
    for number, box in expected.items():
        file = str(folder / "mesh" / f"{number}.ply")
        new = bpy.app.version >= (4, 0)
        # both are told that the file is as Blender's own world: z up
        call = (lambda f=file: bpy.ops.wm.ply_import(filepath=f, forward_axis="Y", up_axis="Z")) if new else (
            lambda f=file: bpy.ops.import_mesh.ply(filepath=f))  # fmt: skip
        (thing,) = imported(bpy, call)
        if len(thing.data.vertices) != box["vertices"]:
            return told("PLY", f"{len(thing.data.vertices)} vertices for {box['vertices']} in frame {number}", "")
        worst = max(worst, off(bounds(bpy, thing), box))
        missing = {"vx", "vy", "vz"} - {a.name for a in thing.data.attributes}
        if new and missing:  # before version 4 Blender drops what it does not know
            return told("PLY", f"no attributes {sorted(missing)}", "")
    more = "with velocities, " if new else ""
    return told("PLY", "" if worst < TOLERANCE else f"{worst:.3g} m off", f"{more}upright, within {worst:.1e} m")


def check_obj(bpy, folder: Path, expected: dict) -> int:
    """Positions of the first frame, read as z up."""
    number, box = next(iter(expected.items()))
    file = str(folder / "obj" / f"{number}.obj")
    things = imported(bpy, lambda: bpy.ops.wm.obj_import(filepath=file, forward_axis="Y", up_axis="Z"))
    worst = off(bounds(bpy, things[0]), box)
    return told("OBJ", "" if worst < TOLERANCE else f"{worst:.3g} m off", f"upright, within {worst:.1e} m")


def check_usd(bpy, folder: Path, expected: dict, layout: str) -> int:
    """The surface at every frame of the timeline, whatever the file's axes and units are."""
    name, file = {"usd": "USD", "usd-y": "USDy", "clips": "USDc"}[layout], str(folder / layout / "fluid.usda")
    try:
        things = imported(bpy, lambda: bpy.ops.wm.usd_import(filepath=file, scale=1.0))
    except AttributeError:
        print(f"{name:5} not checked: this Blender is built without it")
        return 0
    moving = [t for t in things if t.type == "MESH" and any(m.type == "MESH_SEQUENCE_CACHE" for m in t.modifiers)]
    if len(moving) != 1:
        return told(name, f"{len(moving)} meshes that move among {[t.name for t in things]}", "")
    worst = 0.0
    for number, box in expected.items():
        bpy.context.scene.frame_set(int(number))
        worst = max(worst, off(bounds(bpy, moving[0]), box))
    kinds = sorted({t.type for t in things})
    return told(name, "" if worst < TOLERANCE else f"{worst:.3g} m off", f"{kinds}, every frame within {worst:.1e} m")


def check_bodies(bpy, folder: Path, expected: dict) -> int:
    """Every obstacle has a mesh around its origin and a pose in every frame; as the extension brings them in."""
    import numpy as np

    listed = folder / "mesh" / "bodies.json"
    if not listed.is_file():
        print("BODY  not checked: this asset has no obstacles")
        return 0
    sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "blender"))
    from fluidlift_asset import build  # pyright: ignore[reportMissingImports]

    into, worst = build.collection(), 0.0
    things = build.bodies_of(into, folder / "mesh")
    told_of = json.loads(listed.read_text(encoding="utf-8"))["bodies"]
    for thing, body in zip(things, told_of):
        if len(body["poses"]) != len(expected):
            return told("BODY", f"{len(body['poses'])} poses of {body['name']} for {len(expected)} frames", "")
        for number, pose in zip(expected, body["poses"]):
            bpy.context.scene.frame_set(int(number))
            matrix = np.array(thing.matrix_world)
            worst = max(worst, float(np.abs(matrix[:3, 3] - pose[:3]).max()))
    faults = "" if worst < TOLERANCE and len(things) == len(told_of) else f"{worst:.3g} m off"
    return told("BODY", faults, f"{[t.name for t in things]}, every frame within {worst:.1e} m")


def check_vdb(bpy, folder: Path, expected: dict, spacing: float) -> int:
    """Names of the grids, and where they lie: around the surface, by no more than a block of eight cells."""
    number, box = next(iter(expected.items()))
    file = str(folder / "vdb" / f"{number}.vdb")
    things = imported(bpy, lambda: bpy.ops.object.volume_import(filepath=file))
    volume = things[0].data
    volume.grids.load()
    names = sorted(g.name for g in volume.grids)
    if names != ["density", "surface", "vel"]:
        return told("VDB", f"grids {names}", "")
    at, corners = things[0].matrix_world, things[0].bound_box
    points = [at @ type(at.translation)(c) for c in corners]
    low, high = ([f(p[a] for p in points) for a in range(3)] for f in (min, max))
    wider = [a - b for a, b in zip(box["low"], low)] + [b - a for a, b in zip(box["high"], high)]
    fine = all(-spacing < w < 10 * spacing for w in wider)
    return told("VDB", "" if fine else f"by {wider} m wider than the surface", f"{names}, around the surface")


def check_glb(bpy, folder: Path, expected: dict) -> int:
    """The terrain below the surface: Blender turns glTF's y up back."""
    import numpy as np

    if "bool" not in vars(np):
        np.bool = bool  # Blender 3.4's importer names an alias that later NumPy has dropped
    things = imported(bpy, lambda: bpy.ops.import_scene.gltf(filepath=str(folder / "mesh" / "terrain.glb")))
    low, high = bounds(bpy, next(t for t in things if t.type == "MESH"))
    box = next(iter(expected.values()))
    around = all(low[a] < box["low"][a] + 0.05 and high[a] > box["high"][a] - 0.3 for a in (0, 1))
    return told("GLB", "" if around and low[2] < box["high"][2] else f"box {low} {high}", "terrain under the fluid")


def main() -> int:
    """One of the two steps."""
    words = sys.argv[sys.argv.index("--") + 1 :] if "--" in sys.argv else sys.argv[1:]
    if words[:1] == ["export"] and len(words) == 3:
        export(Path(words[1]), Path(words[2]))
        return 0
    if words[:1] == ["read"] and len(words) == 2:
        return min(read(Path(words[1])), 1)
    print(__doc__, file=sys.stderr)
    return 2


if __name__ == "__main__":
    sys.exit(main())
