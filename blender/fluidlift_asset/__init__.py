"""fluidlift assets in Blender: import a folder, change the fluid, simulate it again, refresh.

Files are read here; everything that computes is done by the command `fluidlift` in its own Python.
"""

from __future__ import annotations

import json
from pathlib import Path

import bpy
from bpy.app.handlers import persistent

from . import build
from .command import Call, find_command, run
from .edits import changes, panel_values, read_scene, read_settings
from .facts import EXPORTED, WHITEWATER, frames, read_facts, require_asset, up_to_date
from .ground import rest_on
from .light import SUN, light_up
from .materials import LIQUIDS, liquid_material, turns_in_volumes
from .meshing import Meshing
from .waiting import waiting
from .whitewater import drawn_as_points

bl_info = {
    "name": "fluidlift assets",
    "author": "The fluidlift authors",
    "version": (0, 1, 0),
    "blender": (3, 4, 0),
    "location": "3D View > Sidebar > fluidlift",
    "description": "Bring in, change and simulate fluids lifted out of videos",
    "category": "Import-Export",
}

WHITE = "fluid white water"
KEPT = ("fluid surface", "fluid splats", WHITE, build.TERRAIN, "clip camera", SUN)
"""objects that a refresh leaves, with what a person did to them; the sequences among them get the new frames"""
MESHING = Meshing()
"""of the surfaces that are not there yet"""


class Preferences(bpy.types.AddonPreferences):
    """Where the command is."""

    bl_idname = __package__ or "fluidlift_asset"
    command: bpy.props.StringProperty(  # pyright: ignore[reportInvalidTypeForm]
        name="fluidlift command",
        subtype="FILE_PATH",
        default="",
        description="Path of the program; empty: as found by the system",
    )

    def draw(self, context: bpy.types.Context) -> None:
        self.layout.prop(self, "command")


def show_material(settings: Settings, context: bpy.types.Context) -> None:
    """Put the chosen look on the surface, at once."""
    surface = next((o for o in build.objects() if o.name == "fluid surface"), None)
    if surface is not None:
        surface.data.materials.clear()
        surface.data.materials.append(liquid_material(settings.material, tuple(settings.tint)))
        turns_in_volumes(context.scene, settings.material)


class Settings(bpy.types.PropertyGroup):
    """The asset at hand, and what is changed about it."""

    asset: bpy.props.StringProperty(name="Asset", subtype="DIR_PATH", description="Folder that ends in .fluid")
    command: bpy.props.StringProperty(name="Command", subtype="FILE_PATH", description="Overrides the preferences")
    viscosity: bpy.props.FloatProperty(
        name="Viscosity", description="Kinematic, m²/s: water 1e-6, oil 1e-4, honey 5e-3",
        default=1e-6, min=0.0, max=10.0, precision=6,
    )  # fmt: skip
    density: bpy.props.FloatProperty(name="Density", description="kg/m³", default=1000.0, min=0.001, max=20000.0)
    gravity: bpy.props.FloatVectorProperty(
        name="Gravity", description="m/s²", subtype="ACCELERATION", size=3, default=(0.0, 0.0, -9.81)
    )
    inflow: bpy.props.FloatVectorProperty(
        name="Inflow", description="Velocity at the inlet, m/s", subtype="VELOCITY", size=3, default=(0.0, 0.0, 0.0)
    )
    duration: bpy.props.FloatProperty(
        name="Duration", description="Seconds; 0: as long as the clip", default=0.0, min=0.0
    )
    material: bpy.props.EnumProperty(
        name="Look", items=[(m, m.replace("_", " "), "") for m in LIQUIDS], default="source", update=show_material,
        description="Material of the surface; source: the clip's own colours. Viscosity and density stay",
    )  # fmt: skip
    tint: bpy.props.FloatVectorProperty(
        name="Tint", subtype="COLOR", size=3, default=(1.0, 1.0, 1.0), min=0.0, max=1.0, update=show_material
    )
    motion: bpy.props.EnumProperty(
        name="Obstacle",
        items=[("static", "stands still", ""), ("free", "moves with the fluid", "")],
    )
    body_density: bpy.props.FloatProperty(
        name="Its density", description="kg/m³; less than the fluid floats", default=400.0, min=1.0
    )
    told: bpy.props.StringProperty(name="Said")
    loaded: bpy.props.StringProperty(description="What the panel said when the asset was read, as JSON")


def command_of(context: bpy.types.Context) -> str:
    """Path of the command; raises RuntimeError where there is none."""
    own = context.scene.fluidlift.command
    addon = context.preferences.addons.get(__package__ or "")
    return find_command(own or (addon.preferences.command if addon is not None and addon.preferences else ""))


def asset_of(context: bpy.types.Context) -> Path:
    """Folder of the asset; raises RuntimeError where it is none."""
    text = context.scene.fluidlift.asset.strip()
    return require_asset(Path(bpy.path.abspath(text)) if text else None)


class Guarded:
    """Errors are told in one sentence instead of a traceback."""

    bl_options = {"REGISTER", "UNDO"}  # noqa: RUF012  (Blender reads it from the class)

    def execute(self, context: bpy.types.Context) -> set[str]:
        try:
            return self.work(context)
        except (RuntimeError, OSError, ValueError) as error:
            context.scene.fluidlift.told = str(error)
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}

    def warn(self, context: bpy.types.Context, warnings: list[str]) -> None:
        """What is missing, such as obstacles whose motion is not at hand: said, and kept in the panel."""
        if warnings:
            context.scene.fluidlift.told = " ".join(warnings)
            self.report({"WARNING"}, " ".join(warnings))


class ImportAsset(Guarded, bpy.types.Operator):
    """Bring an asset in: surface with velocities, splats as points, terrain, camera, volumes, obstacles"""

    bl_idname, bl_label = "fluidlift.import_asset", "Import fluid asset"
    directory: bpy.props.StringProperty(subtype="DIR_PATH")  # pyright: ignore[reportInvalidTypeForm]
    volumes: bpy.props.BoolProperty(
        name="Volumes", default=False, description="OpenVDB velocity, density and level set"
    )
    splats: bpy.props.BoolProperty(name="Splats as points", default=True)
    light: bpy.props.BoolProperty(
        name="Light", default=True, description="Sun and sky, where the scene has only what Blender starts with"
    )

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        context.window_manager.fileselect_add(self)
        return {"RUNNING_MODAL"}

    def work(self, context: bpy.types.Context) -> set[str]:
        if self.directory:
            context.scene.fluidlift.asset = self.directory
        folder, settings = asset_of(context), context.scene.fluidlift
        facts = read_facts(folder)
        warnings = export(context, folder, self.volumes)
        into = build.collection()
        assemble(context, folder, into, self.splats)
        build.camera_of(into, folder / "rest" / "camera.json")
        if self.light:
            light_up(context.scene, into)
        settings.tint, settings.material = facts.tint, facts.material
        read_settings(settings, facts)
        settings.told = f"{folder.name}: {', '.join(o.name for o in into.objects)}"
        self.report({"INFO"}, settings.told)
        self.warn(context, warnings)
        return {"FINISHED"}


def export(context: bpy.types.Context, folder: Path, volumes: bool, *, wait: bool | None = None) -> list[str]:
    """Have the command write what Blender reads, where that is older than the frames; what it warns about.

    wait: for the surfaces of all frames; else for that of the current one, and the others come later. None: where
    nobody looks at a window.
    """
    into, source = folder / EXPORTED, folder / "frames" / "splats"
    said, scene, wait = "", context.scene, bpy.app.background if wait is None else wait
    MESHING.stop()
    wanted = [("surface", "mesh", ".ply")] + ([("volume", "vdb", ".vdb")] if volumes else [])
    white = read_facts(folder).whitewater
    for name, form, suffix in wanted:
        made = [into / name] + ([into / name / WHITEWATER] if white and name == "surface" else [])
        if not all(up_to_date(m, source, suffix) for m in made):
            words = [command_of(context), "export", str(folder), "-o", str(into / name), "--to", form]
            later, numbers = name == "surface" and not wait, frames(source)
            one: list[str] = []
            if later and numbers:
                number = min(max(scene.frame_current, numbers[0]), numbers[-1])
                one = ["--frames", f"{number}-{number}"]
            with waiting(context, f"writing the {name} of {'this' if one else 'each'} frame") as told:
                said += run([*words, *one], told)
            if one:
                MESHING.begin(words, lambda: follow_timeline(scene), lambda said: surfaces_came(scene, folder))
    return [line.strip() for line in said.splitlines() if line.strip().startswith("warning:")]


def surfaces_came(scene: bpy.types.Scene, folder: Path) -> None:
    """Obstacles were brought in where they are in one frame: now with their motion."""
    bodies = [thing for thing in build.objects() if build.BODY in thing]
    if bodies:
        into = bodies[0].users_collection[0]
        for thing in bodies:
            bpy.data.objects.remove(thing, do_unlink=True)
        build.bodies_of(into, folder / EXPORTED / "surface")
        scene.frame_set(scene.frame_current)


def assemble(context: bpy.types.Context, folder: Path, into: bpy.types.Collection, splats: bool) -> None:
    """What a simulation changes: the sequences, obstacles, volumes and the timeline."""
    numbers = frames(folder / "frames" / "splats")
    surface = build.sequence(into, "fluid surface", "surface", folder / EXPORTED / "surface", numbers)
    if surface is None:
        raise RuntimeError(f"{folder.name} has no simulated frames: run fluidlift sim")
    if splats:
        first = "fluid splats" not in into.objects
        points = build.sequence(into, "fluid splats", "splats", folder / "frames" / "splats")
        if points is not None and first:
            points.hide_render = True
            points.hide_set(True)  # as dots they would cover the surface in every view
    facts = read_facts(folder)
    show_whitewater(into, folder / EXPORTED / "surface" / WHITEWATER, numbers if facts.whitewater else range(0))
    ground = build.terrain_of(into, folder / EXPORTED / "surface" / "terrain.glb")
    rest_on(surface, ground, facts.cell)
    build.bodies_of(into, folder / EXPORTED / "surface")
    build.volume_of(into, folder / EXPORTED / "volume")
    scene, rate = context.scene, 1.0 / facts.interval
    scene.render.fps = max(1, round(rate))
    scene.render.fps_base = scene.render.fps / rate
    scene.frame_start, scene.frame_end = surface["fluidlift_frames"]
    scene.render.use_lock_interface = True  # the sequences change meshes while Blender draws pictures
    scene.frame_set(min(max(scene.frame_current, scene.frame_start), scene.frame_end))
    follow_timeline(scene)


def show_whitewater(into: bpy.types.Collection, folder: Path, numbers: range) -> None:
    """Points of spray, foam and bubbles, with a material each; without numbers, none."""
    if numbers:
        drawn_as_points(build.sequence(into, WHITE, "whitewater", folder, numbers))
    elif WHITE in into.objects:
        thing = into.objects[WHITE]
        mesh = thing.data
        bpy.data.objects.remove(thing, do_unlink=True)
        if mesh.users == 0:
            bpy.data.meshes.remove(mesh)


class Simulate(Guarded, bpy.types.Operator):
    """Write the changes into scene.yaml and simulate again, in the background; Esc stops"""

    bl_idname, bl_label = "fluidlift.simulate", "Simulate again"
    wait: bpy.props.BoolProperty(default=False, options={"SKIP_SAVE"}, description="Hold Blender until it is done")

    def work(self, context: bpy.types.Context) -> set[str]:
        folder, program, s = asset_of(context), command_of(context), context.scene.fluidlift
        options = changes(s)
        if options:
            run([program, "edit", str(folder), *options])
            s.loaded = json.dumps(panel_values(s))
        self.call = Call([program, "sim", str(folder), "--set", "show.usd=false"])
        if self.wait or bpy.app.background:
            with waiting(context, "simulating") as told:
                self.call.wait(told)
            return self.finish(context)
        self.timer = context.window_manager.event_timer_add(0.5, window=context.window)
        context.window_manager.modal_handler_add(self)
        return {"RUNNING_MODAL"}

    def modal(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        if event.type == "ESC":
            self.call.stop()
            self.call.wait()
            context.scene.fluidlift.told = "stopped; the frames that were there are kept"
            context.window_manager.event_timer_remove(self.timer)
            return {"CANCELLED"}
        if event.type != "TIMER":
            return {"PASS_THROUGH"}
        if self.call.running():
            context.scene.fluidlift.told = self.call.last_line()[:80]
            for area in context.screen.areas:
                area.tag_redraw()
            return {"PASS_THROUGH"}
        context.window_manager.event_timer_remove(self.timer)
        try:
            return self.finish(context)
        except (RuntimeError, OSError, ValueError) as error:
            context.scene.fluidlift.told = str(error)
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}

    def finish(self, context: bpy.types.Context) -> set[str]:
        self.call.check()
        warnings = refresh(context)
        context.scene.fluidlift.told = "done"
        self.warn(context, warnings)
        return {"FINISHED"}


def refresh(context: bpy.types.Context) -> list[str]:
    """Export the frames again and show them, with the camera and the materials as they are by now; warnings."""
    folder, had = asset_of(context), {o.name for o in build.objects()}
    facts = read_facts(folder)
    warnings = export(context, folder, "fluid volume" in had)
    assemble(context, folder, build.collection(KEPT), "fluid splats" in had or not had)
    if not had:
        show_material(context.scene.fluidlift, context)
    read_settings(context.scene.fluidlift, facts)
    return warnings


class Refresh(Guarded, bpy.types.Operator):
    """Read the asset again, after it was simulated elsewhere"""

    bl_idname, bl_label = "fluidlift.refresh", "Refresh"

    def work(self, context: bpy.types.Context) -> set[str]:
        self.warn(context, refresh(context))
        return {"FINISHED"}


class AddObstacle(Guarded, bpy.types.Operator):
    """Give the active mesh object to the fluid as an obstacle, where it stands"""

    bl_idname, bl_label = "fluidlift.add_obstacle", "Add active object"

    def work(self, context: bpy.types.Context) -> set[str]:
        folder, thing, s = asset_of(context), context.active_object, context.scene.fluidlift
        if thing is None or thing.type != "MESH":
            raise RuntimeError("Select a mesh object first.")
        if build.BODY in thing:
            raise RuntimeError(f"{thing[build.BODY]} is an obstacle already: remove it first.")
        name = "".join(c if c.isascii() and c.isalnum() else "_" for c in thing.name)
        file = folder / f"{name}.obj"
        if file.exists():  # perhaps of an obstacle that an undo brings back
            raise RuntimeError(f"{file.name} is in the asset already: give the object another name.")
        build.write_obj(file, thing)
        where = ", ".join(f"{v:.6g}" for v in thing.matrix_world.translation)
        entry = f"{{name: {name}, mesh: {name}.obj, position: [{where}], motion: {s.motion}"
        entry += f", density: {s.body_density:.6g}}}" if s.motion == "free" else "}"
        try:
            run([command_of(context), "edit", str(folder), "--add", f"obstacles={entry}"])
        except RuntimeError:
            file.unlink()
            raise
        thing.hide_set(True)  # the imported one takes its place after the simulation
        s.told = f"{name} is in scene.yaml: simulate again"
        return {"FINISHED"}


class RemoveObstacle(Guarded, bpy.types.Operator):
    """Take the active obstacle out of the fluid"""

    bl_idname, bl_label = "fluidlift.remove_obstacle", "Remove active obstacle"

    def work(self, context: bpy.types.Context) -> set[str]:
        folder, thing = asset_of(context), context.active_object
        if thing is None or build.BODY not in thing:
            raise RuntimeError("Select an obstacle of the fluid first.")
        name = thing[build.BODY]
        run([command_of(context), "edit", str(folder), "--remove", f"obstacles.{name}"])
        bpy.data.objects.remove(thing, do_unlink=True)
        context.scene.fluidlift.told = f"{name} is out of scene.yaml: simulate again"
        return {"FINISHED"}


class Undo(Guarded, bpy.types.Operator):
    """Take the last change of the asset back; Blender's own undo does not reach it"""

    bl_idname, bl_label = "fluidlift.undo", "Undo change of asset"

    def work(self, context: bpy.types.Context) -> set[str]:
        folder, s = asset_of(context), context.scene.fluidlift
        said = run([command_of(context), "edit", str(folder), "--undo", "--json"])
        read_scene(s, read_facts(folder), said)
        s.told = "undone in scene.yaml: simulate again"
        return {"FINISHED"}


class Panel(bpy.types.Panel):
    """The sidebar."""

    bl_idname, bl_label = "FLUIDLIFT_PT_asset", "fluidlift"
    bl_space_type, bl_region_type, bl_category = "VIEW_3D", "UI", "fluidlift"

    def draw(self, context: bpy.types.Context) -> None:
        layout, s = self.layout, context.scene.fluidlift
        layout.prop(s, "asset")
        layout.operator(ImportAsset.bl_idname).directory = s.asset
        box = layout.box()
        box.label(text="Fluid")
        for name in ("viscosity", "density", "gravity", "inflow", "duration", "material", "tint"):
            box.prop(s, name)
        box = layout.box()
        box.label(text="Obstacles")
        box.prop(s, "motion")
        if s.motion == "free":
            box.prop(s, "body_density")
        box.operator(AddObstacle.bl_idname)
        box.operator(RemoveObstacle.bl_idname)
        row = layout.row(align=True)
        row.operator(Simulate.bl_idname)
        row.operator(Refresh.bl_idname)
        layout.operator(Undo.bl_idname)
        if s.told:
            layout.label(text=s.told)


@persistent
def follow_timeline(scene: bpy.types.Scene, *_) -> None:
    """Put the current frame's files into the sequences."""
    if scene.frame_subframe:  # Cycles looks between frames for motion blur; `velocity` tells it, the mesh stays
        return
    for thing in scene.objects:
        if "fluidlift_folder" in thing:
            try:
                build.show_frame(thing, scene.frame_current)
            except (OSError, ValueError) as error:  # a frame that is just being written: the last one stays
                if MESHING.call is None:
                    print(f"fluidlift: {error}")


@persistent
def surfaces_first(*_) -> None:
    """Pictures show the surfaces of their own frames."""
    MESHING.wait()


def menu(self, context: bpy.types.Context) -> None:
    self.layout.operator(ImportAsset.bl_idname, text="Fluid asset (.fluid folder)")


CLASSES = (Preferences, Settings, ImportAsset, Simulate, Refresh, AddObstacle, RemoveObstacle, Undo, Panel)


def register() -> None:
    for cls in CLASSES:
        bpy.utils.register_class(cls)
    bpy.types.Scene.fluidlift = bpy.props.PointerProperty(type=Settings)
    bpy.types.TOPBAR_MT_file_import.append(menu)
    bpy.app.handlers.frame_change_pre.append(follow_timeline)
    bpy.app.handlers.render_init.append(surfaces_first)


def unregister() -> None:
    MESHING.stop()
    bpy.app.handlers.render_init.remove(surfaces_first)
    bpy.app.handlers.frame_change_pre.remove(follow_timeline)
    bpy.types.TOPBAR_MT_file_import.remove(menu)
    del bpy.types.Scene.fluidlift
    for cls in reversed(CLASSES):
        bpy.utils.unregister_class(cls)
