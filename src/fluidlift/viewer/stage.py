"""What stands in the 3D view: splats, points, arrows, surface, ground, obstacles, the camera of the video."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from fluidlift.numerics.srgb import linear_from_srgb
from fluidlift.physics.rotation import product
from fluidlift.types import FluidAsset, PinholeCamera, TriangleMesh, quat_from_matrix
from fluidlift.viewer.arrows import HEAD, THICK, arrows, barbed
from fluidlift.viewer.frames import SplatFrame
from fluidlift.viewer.surfacing import Surfacer

RADIUS = 0.4
"""of a particle of the surface, cells"""
GROUND, BODY, CHOSEN = (150, 140, 125), (190, 95, 55), (240, 150, 40)
"""sRGB of what has no colours of its own; of obstacles, those that are not edited and the one that is"""
Y_UP = (math.sqrt(0.5), math.sqrt(0.5), 0.0, 0.0)
"""turns glTF's axes into ours"""
SMALLEST = 1e-6
"""m, of a splat's standard deviation"""


@dataclass(frozen=True)
class VisibleLayers:
    """What is on."""

    splats: bool = True
    points: bool = False
    arrows: bool = False
    surface: bool = False
    ground: bool = True
    obstacles: bool = True
    camera: bool = False


class Stage:
    """The nodes of the scene. Only one thread may call it.

    Args:
        server: of viser.
        folder: of the asset.
        asset: as lifted.
        told: is called, from another thread, when something has become ready to be shown.
    """

    def __init__(self, server: Any, folder: Path, asset: FluidAsset, told: Callable[[], None] = lambda: None) -> None:
        self._scene, self._asset = server.scene, asset
        self._splats: Any = None
        self._unit = 1.0
        self._surfacer = Surfacer(told)
        self._shown_surface: TriangleMesh | None = None
        self._bodies: dict[str, Any] = {}
        self._shown_bodies: dict[str, tuple[Any, bool]] = {}
        self._ground: Any = None
        self._ground_mesh: TriangleMesh | None = None
        low, high = np.percentile(asset.rest.means, [2, 98], axis=0) if len(asset.rest) else np.zeros((2, 3))
        self.middle = 0.5 * (low + high)
        self.size = max(float(np.linalg.norm(high - low)), 1e-3)
        """m, of the fluid"""
        self._place_ground(folder)
        self._frustum = self._place_camera(asset.camera)

    # ground and camera

    def _place_ground(self, folder: Path) -> None:
        glb, mesh = folder / "rest" / "terrain.glb", self._asset.terrain.mesh
        self._ground_mesh = mesh
        if glb.is_file() and not glb.is_symlink():
            self._ground = self._scene.add_glb("/ground", glb.read_bytes(), wxyz=Y_UP)
        else:
            self._plain_ground(mesh)

    def _plain_ground(self, mesh: TriangleMesh) -> None:
        if not len(mesh.faces):
            self._ground = None
            return
        color = GROUND if mesh.colors is None else tuple(int(255 * c) for c in np.mean(mesh.colors, axis=0))
        self._ground = self._scene.add_mesh_simple(
            "/ground", np.asarray(mesh.vertices), np.asarray(mesh.faces), color=color, side="double"
        )

    def ground(self, mesh: TriangleMesh | None) -> None:
        """Another ground, such as one that edits made longer; None or the same: nothing changes."""
        if mesh is None or mesh is self._ground_mesh:
            return
        self._ground_mesh = mesh
        if self._ground is not None:
            self._ground.remove()
        if not len(mesh.faces):
            self._ground = None
            return
        self._ground = self._scene.add_glb("/ground", glb_of(mesh), wxyz=Y_UP)

    def _place_camera(self, camera: PinholeCamera) -> Any:
        width, height = camera.size
        facing = quat_from_matrix(world_from_camera(camera)[None])[0]
        return self._scene.add_camera_frustum(
            "/input camera", fov=vertical_fov(camera), aspect=width / height, scale=0.12 * self.size,
            thickness=0.001 * self.size, color=(230, 120, 30), wxyz=facing,
            position=camera.position,
        )  # fmt: skip

    def distance(self) -> float:
        """m along the axis of the video's camera to the middle of the fluid."""
        camera = self._asset.camera
        return max(float((self.middle - camera.position) @ world_from_camera(camera)[:, 2]), 0.1 * self.size)

    def look_from_input(self, view: Any) -> None:
        """Put a camera of viser where that of the video stood."""
        camera = self._asset.camera
        view.position = np.asarray(camera.position, float)
        view.look_at = np.asarray(camera.position + self.distance() * world_from_camera(camera)[:, 2], float)
        view.fov = vertical_fov(camera)
        view.near, view.far = 2e-3 * self.size, 200.0 * self.size

    def keep_whole(self, client: Any) -> None:
        """While a page looks from where the video's camera stood, it shows the whole picture, however wide it is."""
        camera, fitted = self._asset.camera, [0.0]

        def fit(view: Any) -> None:
            if view.aspect != fitted[0] and np.allclose(view.position, camera.position, atol=1e-4 * self.size):
                fitted[0] = view.aspect
                view.fov = whole_fov(camera, view.aspect)

        client.camera.on_update(fit)
        fit(client.camera)

    # the fluid

    def show(self, frame: SplatFrame, parts: VisibleLayers, spacing: float, color: np.ndarray | None = None) -> str:
        """One frame; what could not be shown, in words.

        Args:
            frame: to show.
            parts: what is on.
            spacing: m, of the simulation's cells.
            color: u8 [n,3] sRGB; None: the splats' own.
        """
        rgb = frame.rgb if color is None else color
        self._show_splats(frame, rgb, parts.splats)
        self._show_points(frame, rgb, parts.points, spacing)
        self._show_arrows(frame, parts.arrows)
        if self._ground is not None:
            self._ground.visible = parts.ground
        self._frustum.visible = parts.camera
        if not parts.surface:
            self._take_away("/surface")
            self._surfacer.forget()
            self._shown_surface = None
            return ""
        self._surfacer.ask(frame, frame.liquid, RADIUS * spacing)
        return self._show_surface(rgb)

    def _take_away(self, name: str) -> None:
        found = self._scene.get_handle_by_name(name)
        if found is not None:
            found.remove()

    def _show_splats(self, frame: SplatFrame, rgb: np.ndarray, on: bool) -> None:
        if not on or not len(frame.centers):
            if self._splats is not None:
                self._splats.visible = False
            return
        if self._splats is None:
            # covariances travel as half floats, whose least step is 6e-8: lengths are told in splats, not in metres
            typical = float(np.median(np.sqrt(np.trace(frame.covariances, axis1=1, axis2=2) / 3)))
            self._unit = max(typical, SMALLEST)
        u = np.float32(self._unit)
        parts = (frame.centers / u, frame.covariances / u**2, rgb, frame.opacities)
        if self._splats is None:
            self._splats = self._scene.add_gaussian_splats("/fluid", *parts, scale=float(u))
        else:
            self._splats.set_gaussians(*parts)
            self._splats.visible = True

    def _show_points(self, frame: SplatFrame, rgb: np.ndarray, on: bool, spacing: float) -> None:
        if not on or not len(frame.centers):
            self._take_away("/points")
            return
        self._scene.add_point_cloud(
            "/points", frame.centers, rgb, point_size=0.3 * spacing, point_shape="circle", precision="float32"
        )

    def _show_arrows(self, frame: SplatFrame, on: bool) -> None:
        found = arrows(frame, self.size) if on else None
        if found is None:
            self._take_away("/velocity")
            return
        lines, colors = barbed(*found, HEAD * self.size)
        # the browser takes colours of lines for linear ones: as sRGB they would arrive pale
        colors = np.round(255 * linear_from_srgb(colors / np.float32(255))).astype(np.uint8)
        self._scene.add_line_segments("/velocity", lines, colors, thickness=THICK, thickness_units="screen")

    def _show_surface(self, rgb: np.ndarray) -> str:
        """The surface that was made last: while frames pass, it is some frames late."""
        made = self._surfacer.made
        if made is None:
            return ""
        _, mesh, problem = made
        if mesh is None or problem:
            self._take_away("/surface")
            self._shown_surface = None
            return problem
        if mesh is not self._shown_surface:
            self._shown_surface = mesh
            color = tuple(int(c) for c in rgb.mean(axis=0))
            self._scene.add_mesh_simple("/surface", mesh.vertices, mesh.faces, color=color, side="double")
        return ""

    # obstacles

    def obstacles(self, found: Any, poses: np.ndarray | None, parts: VisibleLayers, chosen: str = "") -> None:
        """Solids in their poses.

        Args:
            found: obstacles of the scene.
            poses: [b,7] at this frame, position (m) and orientation (w, x, y, z); None: where they begin.
            parts: what is on.
            chosen: name of the one that is being edited.
        """
        names = [o.name for o in found]
        for name in [n for n in self._bodies if n not in names]:
            self._bodies.pop(name).remove()
            self._shown_bodies.pop(name)
        known = poses if poses is not None and len(poses) == len(names) else None
        for b, o in enumerate(found):
            look = (o.mesh, o.name == chosen)
            before = self._shown_bodies.get(o.name)
            if before is None or not _same(before, look):
                if before is not None:
                    self._bodies[o.name].remove()
                self._bodies[o.name] = self._add_body(o.name, *look)
                self._shown_bodies[o.name] = look
            body = self._bodies[o.name]
            body.position = np.asarray(o.position if known is None else known[b, :3], float)
            turn = np.asarray(o.rotation if known is None else known[b, 3:], float)
            body.wxyz = product(turn, np.array(Y_UP)) if is_painted(o.mesh) else turn
            body.visible = parts.obstacles

    def _add_body(self, name: str, mesh: TriangleMesh, chosen: bool) -> Any:
        if is_painted(mesh):
            return self._scene.add_glb(f"/obstacles/{name}", glb_of(mesh))
        color = CHOSEN if chosen else BODY
        if mesh.colors is not None and len(mesh.colors):
            color = tuple(int(c) for c in np.round(255 * np.clip(mesh.colors[0], 0, 1)))
        return self._scene.add_mesh_simple(
            f"/obstacles/{name}", np.asarray(mesh.vertices, np.float32), np.asarray(mesh.faces), color=color,
            flat_shading=len(mesh.faces) < 100,
        )  # fmt: skip


def _same(before: tuple[Any, bool], look: tuple[Any, bool]) -> bool:
    a, b = before[0], look[0]
    alike = np.shape(a.vertices) == np.shape(b.vertices) and np.shape(a.faces) == np.shape(b.faces)
    same_colors = a.colors is b.colors or np.array_equal(a.colors, b.colors)
    return before[1] == look[1] and alike and np.array_equal(a.vertices, b.vertices) and same_colors


def is_painted(mesh: TriangleMesh) -> bool:
    """Whether a mesh has more than one colour: a texture, or vertices of different colours."""
    if not len(mesh.faces):
        return False
    return mesh.texture is not None or (mesh.colors is not None and bool(np.ptp(mesh.colors, axis=0).max() > 1 / 255))


def glb_of(mesh: TriangleMesh) -> bytes:
    """A mesh with its colours, as a binary glTF."""
    import tempfile

    from fluidlift.io.export_mesh import write_glb

    with tempfile.TemporaryDirectory(prefix="fluidlift-view-") as place:
        return write_glb(Path(place) / "mesh.glb", mesh).read_bytes()


def vertical_fov(camera: PinholeCamera) -> float:
    """rad, from the upper to the lower edge of the picture."""
    return 2 * math.atan(0.5 * camera.size[1] / camera.focal[1])


def whole_fov(camera: PinholeCamera, aspect: float) -> float:
    """rad, from the upper to the lower edge of a window of that width over height which the whole picture fits into."""
    across = 0.5 * camera.size[0] / camera.focal[0]
    return max(vertical_fov(camera), 2 * math.atan(across / aspect))


def world_from_camera(camera: PinholeCamera) -> np.ndarray:
    """[3,3]: columns are the camera's x, y and z axis in the world."""
    return np.asarray(camera.camera_from_world.rotation, float).T
