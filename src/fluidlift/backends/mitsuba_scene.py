"""A finished frame as Mitsuba 3 takes it: liquid, solids, light and camera (axes and units: ours, see `types`)."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from jaxtyping import Float

from fluidlift.errors import require
from fluidlift.look.environment import Environment
from fluidlift.look.environment_lookup import grid_directions
from fluidlift.look.liquid import LUMINANCE, glow
from fluidlift.look.materials import Material
from fluidlift.look.optics import scattering_share
from fluidlift.look.vessel import INDEX, TINT
from fluidlift.numerics.mesh_normals import vertex_normals
from fluidlift.numerics.srgb import linear_from_srgb
from fluidlift.types import PinholeCamera, Terrain, TriangleMesh

OPAQUE_DEPTH = 8.0
"""scattering events on the mean chord of the body from which it is drawn as a painted surface: a random walk through
more of them takes minutes and ends in the same colour"""
SMOOTH = 0.01
"""width of slopes under which a surface is a mirror"""
CREASE = 0.8
"""cosine between a face and its smoothed normal under which an edge stays an edge"""
NEAR, SUNK, DOWN = 1.0, 0.3, -0.3
"""cells between a liquid and ground that count as touching; cells that it is drawn into the ground then; cosine between
its normal and the ground's from which it looks down"""
HEATS = 16
"""kinds of glow on one surface"""
SOFT_ROWS = 128
"""of a blurred environment"""
GROUND = (0.5, 0.5, 0.5)
"""sRGB of solids without colours"""


@dataclass(frozen=True)
class FinalScene:
    """All that one final frame shows."""

    surface: TriangleMesh
    """of the liquid, m: closed, and reaching into the ground that it lies on (a gap would be a film of air, which
    mirrors); colours (sRGB per vertex) where the material carries them"""
    material: Material
    camera: PinholeCamera
    environment: Float[np.ndarray, "h 2*h 3"]
    """linear radiance, equirectangular: first row up (+z), middle of the picture towards +y, +x to the right of it"""
    solids: tuple[TriangleMesh, ...] = ()
    """terrain and obstacles where they stand, with texture or vertex colours"""
    panes: tuple[TriangleMesh, ...] = ()
    """thin glass: sheets without thickness, each as a pane with two surfaces"""
    samples: int = 64
    """light paths per pixel"""
    depth: int = 12
    """turns of a light path, at most; water needs at least 6"""
    seed: int = 0
    softness: float = 0.35
    """roughness (as of a GGX mirror) by which the environment is blurred: paths into a liquid find a light by chance,
    and a sun of its true size by one in a thousand, as sparks. 0: as it is"""
    show_environment: bool = True
    """False: black with alpha 0 where the camera looks past everything, for compositing; it lights all the same"""
    denoise: bool = True
    """whether grain is taken out, of 16 samples and more: sparks are cut, which costs a few per cent of the light, and
    what is alike is averaged. False: the unbiased mean"""
    usual: float | None = None
    """luminance (linear) of the carried colour that is usual, for what glows (`look.liquid.glow`); None: the mean of
    the surface's"""
    opaque: bool | None = field(default=None)
    """whether the body is drawn as a painted surface; None: if light is scattered in it often (`OPAQUE_DEPTH`)"""

    def __post_init__(self) -> None:
        e = np.ascontiguousarray(self.environment, np.float32)
        good = e.ndim == 3 and e.shape[1:] == (2 * len(e), 3) and len(e) > 0
        require(good, f"an environment of shape {e.shape}", "[h,2h,3]")
        require(bool(np.isfinite(e).all()) and float(e.min()) >= 0, "an environment of negative or non-finite light")
        object.__setattr__(self, "environment", e)
        require(self.samples >= 1, f"{self.samples} samples", "at least one")
        require(self.depth >= 2, f"light paths of {self.depth} turns", "at least two")
        require(0.0 <= self.softness <= 1.0, f"softness {self.softness}", "0 to 1")
        require(self.seed >= 0, f"seed {self.seed}", "0 or more")
        for mesh in (self.surface, *self.solids, *self.panes):
            require(bool(np.isfinite(mesh.vertices).all()), "a mesh with vertices that are not finite")

    @property
    def painted(self) -> bool:
        """Whether the liquid is drawn as a surface with a colour instead of a body that light goes through."""
        if self.opaque is not None:
            return self.opaque
        return self.material.scattering * mean_chord(self.surface) > OPAQUE_DEPTH


def mean_chord(mesh: TriangleMesh) -> float:
    """Mean length of the straight lines through a closed body, 4 V / S (Cauchy), m; 0 of no triangles."""
    if len(mesh.faces) == 0:
        return 0.0
    a, b, c = (np.asarray(mesh.vertices, np.float64)[mesh.faces[:, k]] for k in range(3))
    area = 0.5 * float(np.linalg.norm(np.cross(b - a, c - a), axis=1).sum())
    origin = a.mean(axis=0)
    volume = abs(float(((a - origin) * np.cross(b - origin, c - origin)).sum())) / 6.0
    return 4.0 * volume / max(area, 1e-30)


def resting(mesh: TriangleMesh, terrain: Terrain) -> TriangleMesh:
    """The surface of a liquid with its underside in the ground wherever that is nearly touched.

    A surface of particles rests on the bed here and stands off it by a part of a cell there, and each gap would be a
    film of air, which mirrors. What looks down at ground less than `NEAR` cells away is moved `SUNK` cells into it.
    """
    from fluidlift.numerics.sampling import gradient_nodes, sample_nodes

    vertices = np.array(mesh.vertices, np.float32)
    cell, grid = terrain.grid.spacing, terrain.grid
    distance = sample_nodes(terrain.signed_distance, grid, vertices)
    normals = vertex_normals(mesh)
    up = gradient_nodes(terrain.signed_distance, grid, vertices)
    up /= np.maximum(np.linalg.norm(up, axis=1, keepdims=True), 1e-6)
    down = (normals * up).sum(axis=1) < DOWN
    moved = down & (distance < NEAR * cell) & (distance > -SUNK * cell) & grid.contains(vertices)
    vertices[moved] -= (distance[moved, None] + SUNK * cell) * up[moved]
    return TriangleMesh(vertices, mesh.faces, mesh.colors)


def medium(material: Material, carried: Float[np.ndarray, "3"]) -> tuple[np.ndarray, np.ndarray] | None:
    """Extinction (1/m) and share of it that goes on in another direction, per channel; None of a clear body.

    A deep body shows the material's colour under its surface, which is how materials define it; a thin one takes from
    the light behind it what the screen-space picture takes. Without scattering a body only absorbs. Where the colour is
    `optics.deep_color` of the other two, that is the material's own absorption and scattering.

    Args:
        material: of the body.
        carried: linear colour of the splats in the mean.
    """
    extinction = np.asarray(material.absorption) + material.scattering
    if extinction.max() <= 0:
        return None
    if material.scattering == 0:
        return extinction, np.zeros(3)
    color = (1 - material.carried) * np.asarray(material.albedo) + material.carried * carried
    return extinction, scattering_share(color, material.refractive_index)


def cut_out(mi: Any, scene: FinalScene, camera: PinholeCamera) -> tuple[dict[str, Any], dict[str, Any]] | None:
    """For a liquid that glows and stands before black (`show_environment`): the scene whose alpha is what is covered,
    and the environment alone. None otherwise.

    An integrator that hides emitters from the camera hides the glowing liquid with them, all of it. So the environment
    is shown, and taken away where nothing stands before it.
    """
    if scene.show_environment or max(scene.material.emission) <= 0 or not len(scene.surface.faces):
        return None
    covered = described(mi, replace(scene, show_environment=True), camera)
    bare = {k: covered[k] for k in ("type", "sensor", "light")}
    del covered["light"]
    # one turn for what does not glow: where a path ends at once only emitters count as covering
    covered["integrator"], bare["integrator"] = ({"type": "path", "max_depth": k} for k in (2, 1))
    return covered, bare


def described(mi: Any, scene: FinalScene, camera: PinholeCamera) -> dict[str, Any]:
    """The scene as `mitsuba.load_dict` takes it.

    Args:
        mi: the package, its variant chosen.
        scene: what is shown.
        camera: of square pixels.
    """
    out: dict[str, Any] = {"type": "scene", "sensor": _sensor(mi, camera), "light": _environment(mi, scene)}
    # with distances drawn for one channel alone, as volpath does, liquids that absorb one colour most turn to confetti
    out["integrator"] = {
        "type": "volpathmis", "max_depth": scene.depth, "rr_depth": max(scene.depth // 2, 5),
        "hide_emitters": not scene.show_environment and max(scene.material.emission) <= 0,
    }  # fmt: skip
    if len(scene.surface.faces):
        for k, (faces, emission) in enumerate(_glowing(scene)):
            out[f"liquid{k}"] = _liquid(mi, scene, faces, emission)
    for k, mesh in enumerate(scene.solids):
        if len(mesh.faces):
            out[f"solid{k}"] = _solid(mi, mesh)
    for k, mesh in enumerate(scene.panes):
        if len(mesh.faces):
            out[f"pane{k}"] = _sheet(mi, mesh)
    return out


def _sensor(mi: Any, camera: PinholeCamera) -> dict[str, Any]:
    (w, h), focal = camera.size, camera.focal[0]
    pose = np.eye(4)
    # its camera has x to the left and y up
    pose[:3, :3] = camera.camera_from_world.rotation.T @ np.diag([-1.0, -1.0, 1.0])
    pose[:3, 3] = camera.position
    film = {
        "type": "hdrfilm", "width": w, "height": h, "pixel_format": "rgba", "component_format": "float32",
        "rfilter": {"type": "box"},
    }  # fmt: skip
    return {
        "type": "perspective", "fov": math.degrees(2 * math.atan(0.5 * w / focal)), "fov_axis": "x",
        "near_clip": 1e-3, "far_clip": 1e5, "to_world": mi.ScalarTransform4f(pose),
        "principal_point_offset_x": 0.5 - camera.center[0] / w,
        "principal_point_offset_y": 0.5 - camera.center[1] / h,
        "film": film, "sampler": {"type": "multijitter"},
    }  # fmt: skip


def _environment(mi: Any, scene: FinalScene) -> dict[str, Any]:
    """Its map has rows from pole to pole, ours have their centres half a row inside."""
    e = scene.environment
    if scene.softness > 0:
        e = Environment(e).blurred(grid_directions(SOFT_ROWS), scene.softness)
    height = len(e)
    at = np.clip(np.arange(2 * height + 1) * 0.5 - 0.5, 0, height - 1)
    first = np.minimum(at.astype(int), max(height - 2, 0))
    share = (at - first)[:, None, None].astype(np.float32)
    rows = (1 - share) * e[first] + share * e[np.minimum(first + 1, height - 1)]
    # a pole lies between a column and the one opposite
    rows[0], rows[-1] = (0.5 * (e[k] + np.roll(e[k], height, axis=0)) for k in (0, -1))
    # its y is up, its z in the middle of the picture and its -x to the right of that
    world = np.eye(4)
    world[:3, :3] = np.stack([[-1.0, 0, 0], [0, 0, 1.0], [0, 1.0, 0]], axis=1)
    bitmap = mi.Bitmap(np.ascontiguousarray(rows, np.float32))
    return {"type": "envmap", "bitmap": bitmap, "to_world": mi.ScalarTransform4f(world)}


def _glowing(scene: FinalScene) -> list[tuple[np.ndarray, np.ndarray]]:
    """Faces of the liquid and their emission: one emitter of Mitsuba has one radiance, so that a surface of bright and
    dark parts is cut into `HEATS` kinds of them. A body that light goes through stays whole."""
    mesh, emission = scene.surface, np.asarray(scene.material.emission, np.float64)
    whole = np.asarray(mesh.faces)
    if emission.max() <= 0 or mesh.colors is None:
        return [(whole, emission)]
    carried = linear_from_srgb(mesh.colors)
    usual = float((carried @ LUMINANCE).mean()) if scene.usual is None else scene.usual
    hot = glow(carried, usual)[whole].mean(axis=1)
    if not scene.painted:
        return [(whole, emission * hot.mean(axis=0))]
    kind = (np.argsort(np.argsort(hot[:, 0], kind="stable")) * HEATS) // len(hot)
    return [(whole[kind == k], emission * hot[kind == k].mean(axis=0)) for k in range(HEATS) if (kind == k).any()]


def _liquid(mi: Any, scene: FinalScene, faces: np.ndarray, emission: np.ndarray) -> Any:
    mesh, material = scene.surface, scene.material
    colors = linear_from_srgb(np.broadcast_to(0.5, mesh.vertices.shape) if mesh.colors is None else mesh.colors)
    properties, attributes = mi.Properties(), {}
    if scene.painted:
        carried = 0.0 if mesh.colors is None else material.carried
        attributes["vertex_color"] = (1 - carried) * np.asarray(material.albedo, np.float32) + carried * colors
        paint = {"type": "mesh_attribute", "name": "vertex_color"}
        properties["bsdf"] = mi.load_dict(_paint(paint, material))
    else:
        properties["bsdf"] = mi.load_dict(_glass(material.refractive_index, material.roughness**2))
        body = medium(material, colors.mean(axis=0) if mesh.colors is not None else np.asarray(material.albedo))
        if body is not None:
            properties["interior"] = mi.load_dict(_medium(*body))
    if max(emission) > 0:
        light = {"type": "area", "radiance": {"type": "rgb", "value": emission.tolist()}}
        properties["emitter"] = mi.load_dict(light)
    return _mesh(mi, properties, (mesh.vertices, faces, vertex_normals(mesh), None), attributes)


def _paint(color: dict[str, Any], material: Material) -> dict[str, Any]:
    """Burley's principled surface (2012): the plug-ins for plastic take no colours per vertex."""
    if material.refractive_index <= 1.0:
        return {"type": "diffuse", "reflectance": color}
    rough = max(material.roughness, SMOOTH)
    return {"type": "principled", "base_color": color, "roughness": rough, "eta": material.refractive_index}


def _glass(index: float, alpha: float) -> dict[str, Any]:
    if index <= 1.0:
        return {"type": "null"}
    rough = {"type": "roughdielectric", "distribution": "ggx", "alpha": alpha}
    return (rough if alpha > SMOOTH else {"type": "dielectric"}) | {"int_ior": index, "ext_ior": 1.0}


def _medium(extinction: np.ndarray, albedo: np.ndarray) -> dict[str, Any]:
    scale = float(extinction.max())  # its colours are of 0 to 1
    extinction = np.maximum(extinction, 1e-6 * scale)  # it samples distances per channel, and 0 would be 0 / 0
    return {
        "type": "homogeneous", "scale": scale, "sigma_t": {"type": "rgb", "value": (extinction / scale).tolist()},
        "albedo": {"type": "rgb", "value": np.asarray(albedo).tolist()}, "phase": {"type": "isotropic"},
    }  # fmt: skip


def _solid(mi: Any, mesh: TriangleMesh) -> Any:
    """Corners of its own for each face, so that textures may jump and edges stay sharp."""
    corner = np.asarray(mesh.faces).ravel()
    points = np.asarray(mesh.vertices, np.float64)[corner].reshape(-1, 3, 3)
    cross = np.cross(points[:, 1] - points[:, 0], points[:, 2] - points[:, 0])
    flat = np.repeat(cross / np.maximum(np.linalg.norm(cross, axis=1, keepdims=True), 1e-30), 3, axis=0)
    smooth = vertex_normals(mesh)[corner]
    normals = np.where(((smooth * flat).sum(axis=1) > CREASE)[:, None], smooth, flat)
    uv, attributes, paint = None, {}, {}
    if mesh.texture is not None and mesh.uv is not None:
        texture = mi.Bitmap(linear_from_srgb(mesh.texture.astype(np.float32) / 255.0))
        paint, uv = {"type": "bitmap", "bitmap": texture, "raw": True, "wrap_mode": "clamp"}, mesh.uv.reshape(-1, 2)
    else:
        colors = np.broadcast_to(GROUND, mesh.vertices.shape) if mesh.colors is None else mesh.colors
        attributes["vertex_color"] = linear_from_srgb(colors)[corner]
        paint = {"type": "mesh_attribute", "name": "vertex_color"}
    properties = mi.Properties()
    # the ground is seen from either side: nobody closes it below
    properties["bsdf"] = mi.load_dict({"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": paint}})
    faces = np.arange(len(corner)).reshape(-1, 3)
    return _mesh(mi, properties, (points.reshape(-1, 3), faces, normals, uv), attributes)


def _sheet(mi: Any, mesh: TriangleMesh) -> Any:
    """Glass that light goes straight through."""
    properties = mi.Properties()
    tint = {"type": "rgb", "value": list(TINT)}
    properties["bsdf"] = mi.load_dict(
        {"type": "thindielectric", "int_ior": INDEX, "ext_ior": 1.0, "specular_transmittance": tint}
    )
    return _mesh(mi, properties, (mesh.vertices, np.asarray(mesh.faces), vertex_normals(mesh), None), {})


def _mesh(mi: Any, properties: Any, shape: tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray | None], attributes):
    """A mesh of vertices, faces, normals and texture coordinates (ours: the first row of a picture is v = 0)."""
    vertices, faces, normals, uv = shape
    mesh = mi.Mesh(
        "mesh", len(vertices), len(faces), has_vertex_normals=True, has_vertex_texcoords=uv is not None,
        props=properties,
    )  # fmt: skip
    values = mi.traverse(mesh)
    values["vertex_positions"] = np.ascontiguousarray(vertices, np.float32).ravel()
    values["vertex_normals"] = np.ascontiguousarray(normals, np.float32).ravel()
    values["faces"] = np.ascontiguousarray(faces, np.uint32).ravel()
    if uv is not None:
        values["vertex_texcoords"] = np.ascontiguousarray(uv, np.float32).ravel()
    for name, numbers in attributes.items():
        mesh.add_attribute(name, 3, np.ascontiguousarray(numbers, np.float32).ravel())
    values.update()
    return mesh
