"""Pours: a jet that is round about its middle line, and the vessel that it may fill."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy import ndimage

from fluidlift.shape import depth_surface, surface
from fluidlift.shape.filled_vessel import distance_ahead, in_vessel, pool_depths, vessel_of
from fluidlift.shape.heap import Heap, find_heap
from fluidlift.shape.kinds.base import Observation
from fluidlift.shape.looked_into import jet_rows
from fluidlift.shape.surface import FrontSurface
from fluidlift.types.kind import POUR

LAYERS = 2.0
"""cells that the inlet is tall"""
UPPER = 3
"""of the body's layers, the upper third says how wide its jet is, by its upper quartile: its end is narrower, and its
foot spreads"""


class _Pour:
    side, above = 0.35, 0.1

    def front_surface(self, seen):
        return _with_pool(surface.inflated_surface(seen.camera, seen.mask, POUR, seen.roll), seen)

    def depth_surface(self, scene, seen, slopes, usual):
        front = depth_surface.airborne_surface(scene, seen.camera, seen.mask, POUR)
        return _with_pool(front, seen), None

    def mainstream(self, bulk):
        """Down, with the lean that is seen: how fast it comes nearer is read from a surface that was made round."""
        bulk = bulk / max(np.linalg.norm(bulk), 1e-12)
        return np.array([bulk[0], 0.0, -max(-bulk[2], 1.0)])

    def inlet(self, fluid, z, spacing):
        """The upper end of the jet, over all of its section: a jet that leans, or that the picture's edge cuts on a
        slant, does not begin in one layer. Fed by its tip alone it would run dry within its own length."""
        layers = np.flatnonzero(fluid.any(axis=(0, 1)))
        count = fluid.sum(axis=(0, 1))
        section = float(np.percentile(count[layers[-max(len(layers) // UPPER, 1) :]], 75.0))
        slant = 2.0 * np.sqrt(section / np.pi)  # as high as it is wide: an end at 45 degrees
        top = np.where(fluid, z, -np.inf).max(axis=2, keepdims=True)
        starts = top > z[fluid].max() - (slant + LAYERS) * spacing
        return fluid & starts & (z > top - LAYERS * spacing)

    def outlet(self, shape):
        """What pours leaves sideways over the floor."""
        sides = np.ones(shape, bool)
        sides[2:-2, 2:-2] = False
        sides[:, :, -2:] = False
        return sides


def _with_pool(front: FrontSurface, seen: Observation) -> FrontSurface:
    """The surface of a pour, with what stands in a vessel below its jet, or lies on something, as a solid of
    revolution."""
    camera, mask = seen.camera, seen.mask
    ahead, ever = distance_ahead(camera, mask, front.depth + front.half_thickness), seen.ever
    ever = mask if ever is None else ever
    if not in_vessel(seen.rims, mask & ~jet_rows(mask)):
        heap = find_heap(camera, mask, ahead) or find_heap(camera, ever, ahead)  # it may begin to run down later
        if heap is not None:
            return _over_heap(front, seen, heap)
    vessel = vessel_of(camera, mask, ever, ahead, seen.rims)
    if vessel is None:
        return front
    near, far = pool_depths(camera, mask, vessel)
    held = np.isfinite(near)
    depth, half = np.where(held, near, front.depth), np.where(held, 0.5 * (far - near), front.half_thickness)
    if vessel.mouth is not None and held.any():  # waves and drops at its edge lie on it, and not as far away as the jet
        edge = mask & ~held & ~jet_rows(mask)
        nearest = ndimage.distance_transform_edt(~held, return_distances=False, return_indices=True)
        depth, half = (np.where(edge, values[tuple(nearest)], values) for values in (depth, half))
    return replace(front, depth=depth.astype(np.float32), half_thickness=half.astype(np.float32), vessel=vessel)


def _over_heap(front: FrontSurface, seen: Observation, heap: Heap) -> FrontSurface:
    """The surface of a pour, with what lies on something below its jet as a solid of revolution, and what runs down
    from that on its near side."""
    near, far = heap.seen(seen.camera)
    held = seen.mask & np.isfinite(near)
    low = seen.camera.position[2] + near * seen.camera.rays(seen.camera.pixel_grid())[..., 2] < heap.heights[0]
    half = np.where(low, front.half_thickness, 0.5 * (far - near))
    depth, half = np.where(held, near, front.depth), np.where(held, half, front.half_thickness)
    return replace(front, depth=depth.astype(np.float32), half_thickness=half.astype(np.float32), heap=heap)


BUILDER = _Pour()
