"""What stands in the 3D view: splats, points, arrows, surface, ground, obstacles, the camera of the video."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from fluidlift.types import FluidAsset, PinholeCamera, TriangleMesh, quat_from_matrix
from fluidlift.viewer.frames import SplatFrame
from fluidlift.viewer.surfacing import Surfacer

ARROWS = 1200
"""at most"""
LONGEST_ARROW = 0.12
"""share of the size of the fluid: of the arrow of the fastest 1 %"""
RADIUS = 0.4
"""of a particle of the surface, cells"""
SLOW, FAST = np.array([40, 70, 190]), np.array([255, 210, 40])
"""colours of arrows, sRGB"""
GROUND, BODY, CHOSEN = (150, 140, 125), (190, 95, 55), (240, 150, 40)
Y_UP = (math.sqrt(0.5), math.sqrt(0.5), 0.0, 0.0)
"""turns glTF's axes into ours"""
SMALLEST = 1e-6
"""m, of a splat's standard deviation"""


@dataclass(frozen=True)
class Parts:
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
        self.top = float(high[2])
        """m, height that most of the fluid is below"""
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
        import tempfile

        from fluidlift.io.export_mesh import write_glb

        self._ground_mesh = mesh
        if self._ground is not None:
            self._ground.remove()
        if not len(mesh.faces):
            self._ground = None
            return
        with tempfile.TemporaryDirectory(prefix="fluidlift-view-") as place:
            body = write_glb(Path(place) / "ground.glb", mesh).read_bytes()
        self._ground = self._scene.add_glb("/ground", body, wxyz=Y_UP)

    def _place_camera(self, camera: PinholeCamera) -> Any:
        width, height = camera.size
        facing = quat_from_matrix(world_from_camera(camera)[None])[0]
        return self._scene.add_camera_frustum(
            "/input camera", fov=vertical_fov(camera), aspect=width / height, scale=0.12 * self.size,
            thickness=0.001 * self.size, color=(230, 120, 30), wxyz=facing,
            position=camera.position,
        )  # fmt: skip

    # the fluid

    def show(self, frame: SplatFrame, parts: Parts, spacing: float, color: np.ndarray | None = None) -> str:
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
        self._surfacer.ask(frame, frame.centers, RADIUS * spacing)
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
        ends, colors = found
        thick = 0.0015 * self.size
        self._scene.add_arrows(
            "/velocity", ends, colors, shaft_radius=thick, head_radius=2.5 * thick, head_length=6 * thick
        )

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

    def obstacles(self, found: Any, poses: np.ndarray | None, parts: Parts, chosen: str = "") -> None:
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
        known = poses is not None and len(poses) == len(names)
        for b, o in enumerate(found):
            look = (o.mesh, o.name == chosen)
            before = self._shown_bodies.get(o.name)
            if before is None or not _same(before, look):
                self._bodies[o.name] = self._scene.add_mesh_simple(
                    f"/obstacles/{o.name}", np.asarray(o.mesh.vertices, np.float32), np.asarray(o.mesh.faces),
                    color=CHOSEN if look[1] else BODY, flat_shading=len(o.mesh.faces) < 100,
                )  # fmt: skip
                self._shown_bodies[o.name] = look
            body = self._bodies[o.name]
            body.position = np.asarray(poses[b, :3] if known else o.position, float)
            body.wxyz = np.asarray(poses[b, 3:] if known else o.rotation, float)
            body.visible = parts.obstacles


def _same(before: tuple[Any, bool], look: tuple[Any, bool]) -> bool:
    a, b = before[0], look[0]
    alike = np.shape(a.vertices) == np.shape(b.vertices) and np.shape(a.faces) == np.shape(b.faces)
    return before[1] == look[1] and alike and np.array_equal(a.vertices, b.vertices)


def arrows(frame: SplatFrame, size: float) -> tuple[np.ndarray, np.ndarray] | None:
    """Ends [m,2,3] (m) and colours u8 [m,3] of velocity arrows of at most `ARROWS` splats; None where nothing moves."""
    fastest = frame.fastest
    if fastest <= 0:
        return None
    few = np.linspace(0, len(frame.centers) - 1, min(ARROWS, len(frame.centers))).astype(int)
    velocity = frame.velocities[few]
    speed = np.sqrt(np.square(velocity).sum(axis=1))
    share = np.clip(speed / fastest, 0, 1.5)
    scale = LONGEST_ARROW * size / fastest * (np.minimum(share, 1.5) / np.maximum(share, 1e-9))
    tips = frame.centers[few] + velocity * scale[:, None]
    mixed = np.clip(share, 0, 1)[:, None]
    return np.stack([frame.centers[few], tips], axis=1), np.round((1 - mixed) * SLOW + mixed * FAST).astype(np.uint8)


def vertical_fov(camera: PinholeCamera) -> float:
    """rad, from the upper to the lower edge of the picture."""
    return 2 * math.atan(0.5 * camera.size[1] / camera.focal[1])


def world_from_camera(camera: PinholeCamera) -> np.ndarray:
    """[3,3]: columns are the camera's x, y and z axis in the world."""
    return np.asarray(camera.camera_from_world.rotation, float).T
