"""The steps of `blender_cases.py` that run in Blender: baking a fluid, and drawing it.

blender -b --factory-startup --python-exit-code 1 -P benchmarks/blender_inside.py -- bake dam_pillar FOLDER
"""

from __future__ import annotations

import gzip
import math
import sys
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parent))

from blender_cases import (
    CASES,
    EXTINCTION,
    FPS,
    SOLVER_TIME,
    Spec,
    box_mesh,
    camera_of,
    grid_of,
    key_frames,
    solids_of,
)


def add_mesh(bpy: Any, name: str, vertices: np.ndarray, faces: np.ndarray) -> Any:
    """An object from triangles."""
    mesh = bpy.data.meshes.new(name)
    mesh.from_pydata(vertices.tolist(), [], faces.tolist())
    thing = bpy.data.objects.new(name, mesh)
    bpy.context.scene.collection.objects.link(thing)
    return thing


def fluid_scene(bpy: Any, spec: Spec, cache: str) -> Any:
    """The domain, what is in it and what flows; the domain's object."""
    h, (low, cells) = spec["spacing"], grid_of(spec)
    domain = add_mesh(bpy, "domain", *box_mesh(low, low + h * cells))
    modifier = domain.modifiers.new("fluid", "FLUID")
    modifier.fluid_type = "DOMAIN"
    s = modifier.domain_settings
    liquid = spec["kind"] == "liquid"
    s.domain_type = "LIQUID" if liquid else "GAS"
    s.resolution_max = int(max(cells))
    s.cache_type, s.cache_data_format, s.cache_directory = "REPLAY", "UNI", cache
    s.cache_frame_end = bpy.context.scene.frame_end = spec["frames"] + spec.get("first", 1) + 1
    bpy.context.scene.render.fps = FPS
    s.use_collision_border_top = False
    if "bed" in spec:
        s.use_mesh, s.mesh_scale, s.cache_mesh_format = True, 2, "BOBJECT"
        s.use_collision_border_right = False
        if "viscosity" in spec:
            s.use_viscosity, s.viscosity_value, s.simulation_method = True, spec["viscosity"], "APIC"
        else:
            s.use_fractions, s.fractions_distance = True, 0.2
        source = add_mesh(bpy, "inflow", *box_mesh(*spec["inflow"]))
        for name, (v, f, _) in solids_of(spec).items():
            add_mesh(bpy, name + "_inside", v, f).modifiers.new("fluid", "FLUID").fluid_type = "EFFECTOR"
        (x, y, _), top = spec["high"], low + h * cells
        end = add_mesh(bpy, "drain", *box_mesh([x - 4 * h, -y - h, 0.0], top.tolist()))
        drain = end.modifiers.new("fluid", "FLUID")
        drain.fluid_type = "FLOW"
        drain.flow_settings.flow_type, drain.flow_settings.flow_behavior = "LIQUID", "OUTFLOW"
    elif liquid:
        s.use_mesh, s.mesh_scale, s.cache_mesh_format = True, 2, "BOBJECT"
        a, b = (np.array(x) for x in spec["body"])
        # beyond the walls where it touches them
        source = add_mesh(
            bpy, "body", *box_mesh(np.where(a <= spec["low"], a - h, a), np.where(b >= spec["high"], b + h, b))
        )
    else:
        for side in ("left", "right", "front", "back"):
            setattr(s, f"use_collision_border_{side}", False)
        s.alpha, s.beta, s.vorticity = 0.2, spec["heat"], 0.0
        center, radius, height = spec["source"]
        bpy.ops.mesh.primitive_cylinder_add(radius=radius, depth=height, location=center)
        source = bpy.context.object
        source.hide_render = True
    modifier = source.modifiers.new("fluid", "FLUID")
    modifier.fluid_type = "FLOW"
    flow = modifier.flow_settings
    flow.flow_type, flow.flow_behavior = "LIQUID" if liquid else "SMOKE", "GEOMETRY" if "body" in spec else "INFLOW"
    if "jet" in spec:
        flow.use_initial_velocity, flow.velocity_coord = True, spec["jet"]
    for k, (a, b) in enumerate([] if "bed" in spec else spec.get("pillars", [])):
        modifier = add_mesh(bpy, f"obstacle{k}", *box_mesh(a, b)).modifiers.new("fluid", "FLUID")
        modifier.fluid_type = "EFFECTOR"
    return domain


def read_uni(path: Path, cells: np.ndarray) -> np.ndarray:
    """A grid of Mantaflow's cache, [nx,ny,nz] or [nx,ny,nz,3]: x runs fastest; its values end the file."""
    raw = gzip.decompress(path.read_bytes())
    count = int(np.prod(cells))
    parts = 3 if len(raw) > 12 * count else 1
    values = np.frombuffer(raw[len(raw) - 4 * parts * count :], "<f4").reshape(*cells[::-1], parts)
    return np.ascontiguousarray(values.transpose(2, 1, 0, 3)[..., 0] if parts == 1 else values.transpose(2, 1, 0, 3))


def bake(bpy: Any, spec: Spec, folder: Path) -> None:
    """Simulates; writes surface or density, and velocity (m/s, at cell centres), of each frame. A gas is drawn too."""
    cache = folder / "cache"
    domain = fluid_scene(bpy, spec, str(cache))
    _, cells = grid_of(spec)
    first = spec.get("first", 1)
    if spec["kind"] == "gas":
        furnish(bpy, spec, smoke=domain)
    for frame in range(1, first + spec["frames"] - spec.get("hold", 0)):
        bpy.context.scene.frame_set(frame)
        if frame < first:
            continue
        at = f"{frame:04d}.uni"
        faces = read_uni(cache / "data" / f"vel_{at}", cells) * spec["spacing"] * SOLVER_TIME * FPS
        velocity = faces.copy()  # of the lower face of each cell along each axis; where there is no upper one, that
        for a in range(3):
            inner = [slice(None)] * 3
            inner[a] = slice(0, -1)
            velocity[(*inner, a)] = 0.5 * (faces[(*inner, a)] + np.roll(faces, -1, a)[(*inner, a)])
        arrays = {"velocity": velocity.astype(np.float32)}
        if spec["kind"] == "gas":
            arrays["density"] = read_uni(cache / "data" / f"density_{at}", cells)
            draw(bpy, folder / "pictures" / f"{frame - first:04d}.png")
        else:
            mesh = domain.evaluated_get(bpy.context.evaluated_depsgraph_get()).data
            mesh.calc_loop_triangles()
            v, f = np.empty(3 * len(mesh.vertices), np.float32), np.empty(3 * len(mesh.loop_triangles), np.int32)
            mesh.vertices.foreach_get("co", v)
            mesh.loop_triangles.foreach_get("vertices", f)
            arrays |= {"v": v.reshape(-1, 3), "f": f.reshape(-1, 3)}
        np.savez_compressed(folder / "states" / f"{frame - first:04d}.npz", **arrays)
        print("baked", frame, flush=True)


def material(bpy: Any, name: str, rgb: list[float] | None) -> Any:
    """A rough solid with grain of that colour; None: a glossy liquid with the colours of its vertices."""
    made = bpy.data.materials.new(name)
    made.use_nodes = True
    nodes, links = made.node_tree.nodes, made.node_tree.links
    shader = nodes["Principled BSDF"]
    if rgb is None:
        color = nodes.new("ShaderNodeAttribute")
        color.attribute_name = "Col"
        links.new(color.outputs["Color"], shader.inputs["Base Color"])
        shader.inputs["Roughness"].default_value = 0.25
        return made
    where, noise, ramp = (nodes.new(f"ShaderNode{k}") for k in ("TexCoord", "TexNoise", "ValToRGB"))
    noise.inputs["Scale"].default_value, noise.inputs["Detail"].default_value = 9.0, 6.0
    for k, gain in ((0, 0.35), (1, 1.5)):
        ramp.color_ramp.elements[k].color = (*[min(gain * c, 1.0) for c in rgb], 1.0)
        ramp.color_ramp.elements[k].position = (0.3, 0.7)[k]
    links.new(where.outputs["Object"], noise.inputs["Vector"])
    links.new(noise.outputs["Fac"], ramp.inputs["Fac"])
    links.new(ramp.outputs["Color"], shader.inputs["Base Color"])
    shader.inputs["Roughness"].default_value = 0.9
    return made


def smoke_material(bpy: Any) -> Any:
    """Scatters by its density."""
    made = bpy.data.materials.new("smoke")
    made.use_nodes = True
    nodes, links = made.node_tree.nodes, made.node_tree.links
    nodes.remove(nodes["Principled BSDF"])
    shader = nodes.new("ShaderNodeVolumePrincipled")
    shader.inputs["Density"].default_value = EXTINCTION
    shader.inputs["Color"].default_value = (0.8, 0.8, 0.8, 1.0)
    links.new(shader.outputs["Volume"], nodes["Material Output"].inputs["Volume"])
    return made


def furnish(bpy: Any, spec: Spec, smoke: Any = None) -> None:
    """Solids, light, camera and renderer."""
    from mathutils import Matrix  # pyright: ignore[reportMissingImports]

    scene = bpy.context.scene
    for name, (v, f, rgb) in solids_of(spec).items():
        add_mesh(bpy, name, v, f).data.materials.append(material(bpy, name, rgb))
    if smoke is not None:
        smoke.data.materials.append(smoke_material(bpy))
    sun = bpy.data.objects.new("sun", bpy.data.lights.new("sun", "SUN"))
    sun.data.energy, sun.data.angle, sun.rotation_euler = 2.5, 0.1, (0.6, 0.35, 0.4)
    scene.collection.objects.link(sun)
    world = scene.world = bpy.data.worlds.new("world")
    world.use_nodes = True
    world.node_tree.nodes["Background"].inputs["Color"].default_value = (0.35, 0.42, 0.5, 1.0)
    data, seen = bpy.data.cameras.new("camera"), camera_of(spec)
    data.sensor_fit, data.angle = "HORIZONTAL", math.radians(spec["fov"])
    camera = bpy.data.objects.new("camera", data)
    turned = np.array(seen["R"]).T * [1.0, -1.0, -1.0]  # Blender looks along -z with y up
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = turned, spec["eye"]
    camera.matrix_world = Matrix(pose.tolist())
    scene.collection.objects.link(camera)
    scene.camera, scene.render.engine = camera, "CYCLES"
    scene.render.resolution_x, scene.render.resolution_y = spec["size"]
    scene.render.threads_mode, scene.render.threads = "FIXED", 2
    cycles = scene.cycles
    cycles.samples, cycles.use_denoising, cycles.max_bounces, cycles.volume_bounces = 16, False, 3, 1
    scene.view_settings.view_transform = "Standard"


def draw(bpy: Any, path: Path) -> None:
    """The current frame."""
    bpy.context.scene.render.filepath = str(path)
    bpy.ops.render.render(write_still=True)


def render(bpy: Any, spec: Spec, folder: Path) -> None:
    """Draws a liquid frame by frame; writes the depth of its surface and of the solids, and its level set."""
    from mathutils import Vector  # pyright: ignore[reportMissingImports]
    from mathutils.bvhtree import BVHTree  # pyright: ignore[reportMissingImports]

    furnish(bpy, spec)
    seen, (w, h) = camera_of(spec), spec["size"]
    f, R = seen["K"][0][0], np.array(seen["R"])
    u, v = np.meshgrid(np.arange(w) + 0.5, np.arange(h) + 0.5)
    rays = np.stack([(u - w / 2) / f, (v - h / 2) / f, np.ones_like(u)], -1).reshape(-1, 3)
    ways, along = [Vector(r) for r in rays @ R], np.linalg.norm(rays, axis=1)
    eye = Vector(spec["eye"])

    def depth_of(vertices: np.ndarray, tree: Any) -> np.ndarray:
        at = (vertices - np.array(spec["eye"])) @ R.T
        # Blender's rays are slow: only those that may meet it, unless some of it lies behind the camera
        low, high = (k(f * at[:, :2] / at[:, 2:], axis=0) + [w / 2, h / 2] for k in (np.min, np.max))
        near = np.ones(u.shape, bool)
        if (at[:, 2] > 0).all():
            near = (u > low[0] - 1) & (u < high[0] + 1) & (v > low[1] - 1) & (v < high[1] + 1)
        far = np.full(u.size, np.inf)
        for k in np.flatnonzero(near):
            far[k] = tree.ray_cast(eye, ways[k])[3] or np.inf
        return (far / along).reshape(h, w).astype(np.float32)

    solids = list(solids_of(spec).values())
    ground = np.min([depth_of(v, BVHTree.FromPolygons(v.tolist(), f.tolist())) for v, f, _ in solids], axis=0)
    glossy = material(bpy, "liquid", None)
    for path in sorted((folder / "states").glob("*.npz")):
        if (folder / "seen" / path.name).is_file():  # of a run that was broken off
            continue
        with np.load(path) as state:
            vertices, faces = state["v"], state["f"]
        colors = np.load(folder / "colors" / f"{path.stem}.npy")
        thing = add_mesh(bpy, "liquid", vertices, faces)
        thing.data.polygons.foreach_set("use_smooth", np.ones(len(faces), bool))
        thing.data.attributes.new("Col", "FLOAT_COLOR", "POINT").data.foreach_set("color", colors.ravel())
        thing.data.materials.append(glossy)
        draw(bpy, folder / "pictures" / f"{path.stem}.png")
        bpy.data.meshes.remove(thing.data)
        tree = BVHTree.FromPolygons(vertices.tolist(), faces.tolist())
        arrays = {"depth": depth_of(vertices, tree), "ground": ground}
        if int(path.stem) in key_frames(spec):
            arrays["phi"] = level_set(tree, spec)
        np.savez_compressed(folder / "seen" / f"{path.stem}.npz", **arrays)
        print("drawn", path.stem, flush=True)


def level_set(tree: Any, spec: Spec) -> np.ndarray:
    """Distance to the surface in cells at cell centres, up to 3, negative where a ray upwards leaves the liquid."""
    from mathutils import Vector  # pyright: ignore[reportMissingImports]

    h, (low, cells) = spec["spacing"], grid_of(spec)
    phi, up = np.full(cells, 3.0, np.float32), Vector((0.0, 0.0, 1.0))
    for i, j in np.ndindex(*cells[:2]):
        x, y = low[:2] + (np.array([i, j]) + 0.5) * h
        crossed, z = [], low[2] - h
        while (hit := tree.ray_cast(Vector((x, y, z)), up)[3]) is not None:
            z += hit + 1e-5
            crossed.append(z)
        for k in range(cells[2]):
            z = low[2] + (k + 0.5) * h
            near = tree.find_nearest(Vector((x, y, z)), 3.0 * h)[3]
            inside = sum(c < z for c in crossed) % 2
            phi[i, j, k] = (-1 if inside else 1) * (3.0 if near is None else near / h)
    return phi


if __name__ == "__main__":
    import bpy  # pyright: ignore[reportMissingImports]

    step, name, place = sys.argv[sys.argv.index("--") + 1 :]
    bpy.ops.wm.read_factory_settings(use_empty=True)
    {"bake": bake, "render": render}[step](bpy, CASES[name], Path(place))
