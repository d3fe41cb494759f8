"""Waves on the surface of a frame: as height of its mesh, and as slope of its pictures."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from fluidlift.io.scene import SceneEdits
from fluidlift.look.liquid import SurfaceBuffer
from fluidlift.look.smoothstep import smoothstep
from fluidlift.look.wave_relief import WaveRelief
from fluidlift.messages import Notice
from fluidlift.numerics.sampling import sample_nodes
from fluidlift.scene.build import Scene, edited_scene, film_of
from fluidlift.scene.waves import played_waves, some_frames
from fluidlift.types import FluidAsset, PinholeCamera, Terrain, TriangleMesh

LEVEL = (0.5, 0.85)
"""upward part of normals from which on a surface has waves, in part and whole: no fall has, nor the face of an end"""
SHORE = 1.5
"""cells from the ground up to which waves grow from nothing at the waterline"""
TRIANGLE = 0.2
"""cells, standard deviation by which a mesh blurs: its edges are about half as long as the particles' radius"""
PIXEL = 0.5
"""px, standard deviation by which a picture does"""
GRAZING = 0.05
"""cosine between normal and line of sight at least: less would be a surface that is seen from below"""


@dataclass(frozen=True)
class SurfaceWaves:
    """Waves of one scene."""

    relief: WaveRelief
    terrain: Terrain
    interval: float
    """s between simulated frames"""

    @property
    def facts(self) -> dict[str, Any]:
        """What the film shows of them, for programs: wavelength (m), standard deviation of the slope with the least and
        the most that it may be, the share of its variance that stands, and whether the current carries them."""
        filmed = self.relief.filmed
        slope, low, high = (round(value, 5) for value in filmed.slope)
        stands = float(filmed.variance[filmed.standing].sum()) / max(filmed.slope_variance, 1e-12)
        return {"wavelength": round(filmed.wavelength(), 4), "slope": slope, "slope_range": [low, high],
                "standing": round(stands, 3), "carried": filmed.carried}  # fmt: skip

    @property
    def told(self) -> str:
        """The same in words."""
        slope, low, high = self.relief.filmed.slope
        length = self.relief.filmed.wavelength()
        return f"waves as filmed: {length:.2g} m long, of slope {slope:.2g} ({low:.2g} to {high:.2g})"

    def raised(
        self,
        mesh: TriangleMesh,
        normals: Float[np.ndarray, "v 3"],
        velocities: Float[np.ndarray, "v 3"] | None,
        time: float,
    ) -> tuple[TriangleMesh, np.ndarray | None]:
        """A mesh of the surface with the waves that its triangles can hold, and its velocities (m/s) with theirs.

        Args:
            mesh: without waves.
            normals: of it.
            velocities: of its vertices; None: nobody asks.
            time: s from the first frame.
        """
        points = np.asarray(mesh.vertices, np.float64)
        share, up = self._share(points, normals), np.zeros(len(points))
        some = np.flatnonzero(share > 0)
        found = self.relief.at(points[some, :2], time, blur=TRIANGLE * self.terrain.grid.spacing)
        up[some] = share[some] * found.height
        moved = np.array(mesh.vertices, np.float32)
        moved[:, 2] += up
        if velocities is not None:
            velocities = np.array(velocities, np.float32)
            velocities[some, 2] += share[some] * found.rate
        return TriangleMesh(moved, mesh.faces, mesh.colors), velocities

    def tilted(self, surface: SurfaceBuffer, camera: PinholeCamera, time: float) -> SurfaceBuffer:
        """A surface as a camera sees it, with normals that lean as the waves slope.

        Args:
            surface: without waves, or with waves in its depth alone.
            camera: that sees it.
            time: s from the first frame.
        """
        there = (surface.depth > 0) & (surface.covered > 0)
        if not there.any():
            return surface
        uv, z = camera.pixel_grid()[there], surface.depth[there].astype(np.float64)
        points, normals = camera.unproject(uv, z), surface.normal[there].astype(np.float64)
        share = self._share(points, normals)
        away = points - camera.position
        away /= np.linalg.norm(away, axis=1, keepdims=True)
        # a pixel is long where it lies at a slant
        slant = np.maximum(np.abs((away * normals).sum(axis=1)), GRAZING)
        found = self.relief.at(points[:, :2], time, blur=PIXEL * z / (camera.focal[0] * slant))
        leaning = normals.copy()
        # the normal (-h_x, -h_y, 1) of a height h, with slopes that add up
        leaning[:, :2] -= (share * np.maximum(normals[:, 2], 0.0))[:, None] * found.slope
        leaning /= np.linalg.norm(leaning, axis=1, keepdims=True)
        behind = (leaning * away).sum(axis=1) + GRAZING
        leaning -= np.maximum(behind, 0.0)[:, None] * away
        leaning /= np.linalg.norm(leaning, axis=1, keepdims=True)
        normal = surface.normal.copy()
        normal[there] = np.where(share[:, None] > 0, leaning, normals)
        return replace(surface, normal=normal)

    def _share(self, points: np.ndarray, normals: np.ndarray) -> np.ndarray:
        """[n], 0 to 1: how much of the waves there is at points of the surface."""
        cell = self.terrain.grid.spacing
        away = sample_nodes(self.terrain.signed_distance, self.terrain.grid, points.astype(np.float32))
        return smoothstep(np.asarray(normals)[:, 2], *LEVEL) * smoothstep(np.asarray(away, float) / cell, 0.0, SHORE)


def waves_of(scene: Scene, asset: FluidAsset, folder: Path, numbers: range, amount: float) -> SurfaceWaves | Notice:
    """Waves for the simulated frames of an asset, or why there are none.

    Args:
        scene: whose frames lie in the folder.
        asset: as it was lifted.
        folder: of the asset.
        numbers: its frames, from 0: all of them, so that a part of them has the waves of the whole.
        amount: times as high as filmed.

    Raises:
        InputRejected: a frame is missing or damaged.
    """
    lifted = edited_scene(asset, SceneEdits(), film=film_of(folder))
    found = played_waves(scene, lifted, some_frames(folder, numbers, scene.terrain.grid.spacing), amount)
    return found if isinstance(found, Notice) else SurfaceWaves(found, scene.terrain, scene.interval)
