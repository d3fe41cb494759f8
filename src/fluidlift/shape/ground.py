"""What a fluid rests in: cells and terrain from its surface, and the ground's texture or colours."""

from __future__ import annotations

from dataclasses import replace
from typing import cast

import numpy as np
from jaxtyping import UInt8

from fluidlift.shape import airborne, channel, generate, ground_mesh, ground_texture, plan, registration
from fluidlift.shape.filled_vessel import FilledVessel, look_of_vertices, seen_higher
from fluidlift.shape.jets import lying_pixels
from fluidlift.types import Label, PinholeCamera, Setting, kind_of
from fluidlift.types.fluid_masks import parts_of


def setting_around(
    kind,
    front,
    fluid,
    start,
    united,
    camera,
    to_world,
    depth,
    half,
    bulk,
    c,
    falls,
    *,
    in_metres=False,
    pool=None,
    bowl=None,
    **known,
) -> Setting:
    """Terrain and cells around a surface, whose size is known `in_metres` or assumed; `pool`, pixels that lie
    whether they are seen to or not; `bowl`, in which it stands; what is known beside it goes to
    `plan.PlanEvidence`."""
    ever = fluid.any_frame()
    if bowl is not None:  # its near wall hides water
        pool = bowl.pool(camera)
        ever = ever | pool
    mask = generate.united_mask(fluid[start : start + united])
    mask = mask if pool is None else mask | pool
    visible = mask & (depth > 0)
    grid = camera.pixel_grid()
    near = camera.unproject(grid[visible & ~falls], depth[visible & ~falls])
    if front.height is not None:
        labels = seen_labels(fluid, start, united, falls)
        labels = labels if pool is None else np.where(pool, Label.FLUID, labels).astype(np.uint8)
        height = registration.PlacedHeight(front.height, to_world)
        seen = plan.PlanEvidence(height, labels, near, camera, bulk, ever=ever, bowl=bowl, **known)
        return channel.channel_setting(
            seen, channel.ChannelConfig(kind, c.cells, c.cell_limit, c.depth_ratio, in_metres)
        )
    back = depth + 2 * half
    far = camera.unproject(grid[visible], back[visible])
    # the box holds what the clip shows later, in the same vertical plane
    later = fluid.any_frame()
    middle = np.median((depth + half)[visible])
    reach = camera.unproject(grid[later], np.full(int(later.sum()), middle))
    vessel = front.vessel
    return airborne.airborne_setting(
        depth, back, visible, camera, np.concatenate([near, far, reach]), bulk,
        # smoke needs the whole box, and is cheap per cell: no free surface, few particles
        kind=kind, longest=c.cells, cell_limit=c.cell_limit * (2 if kind_of(kind).is_gas else 1),
        vessel=None if vessel is None else seen_higher(vessel.transformed(to_world), camera, later),
        heap=None if front.heap is None else front.heap.transformed(to_world),
    )  # fmt: skip


def seen_labels(fluid, start: int, united: int, falls: np.ndarray) -> np.ndarray:
    """`Label` of each pixel over the united frames; a rock is one though waves wash over it in some."""
    window = slice(start, start + united)
    solid, lying = solid_share(fluid.labels[window]) > 0.5, lying_pixels(generate.united_mask(fluid[window]), falls)
    if fluid.hidden is not None:
        solid = solid & ~fluid.hidden
    return np.where(solid, Label.SOLID, np.where(lying, Label.FLUID, Label.BACKGROUND)).astype(np.uint8)


def textured(setting: Setting, view: ground_texture.GroundView) -> Setting:
    """The setting, its terrain with the picture on it."""
    solid = setting.terrain
    mesh = ground_texture.textured(solid.mesh, solid.grid, cast(np.ndarray, setting.surface_height), view)
    return replace(setting, terrain=replace(solid, mesh=mesh))


def solid_share(labels: np.ndarray) -> np.ndarray:
    """float [H,W]: share of the frames, u8 [T,H,W], in which a pixel shows something solid."""
    parts = (labels[part] == Label.SOLID for part in parts_of(labels))
    return np.sum([part.sum(axis=0) for part in parts], axis=0) / len(labels)


def finished(
    setting: Setting, plate: UInt8[np.ndarray, "h w 3"], camera: PinholeCamera, vessel: FilledVessel | None = None
) -> Setting:
    """The setting in float32, its ground in the colours of the plate where it has no texture.

    Args:
        setting: with its cells.
        plate: the picture without the fluid, sRGB.
        camera: in the world.
        vessel: that stands on the ground, m.
    """
    mesh, read = setting.terrain.mesh, None
    if len(mesh.faces) and mesh.texture is None:
        if vessel is not None and vessel.mouth is not None:
            thickness = airborne.WALL * setting.terrain.grid.spacing
            read = look_of_vertices(vessel, camera, mesh.vertices.astype(np.float64), thickness)
        mesh = replace(mesh, colors=ground_mesh.ground_colours(mesh, plate, camera, read))
    height = None if setting.surface_height is None else setting.surface_height.astype(np.float32)
    return replace(
        setting, terrain=replace(setting.terrain, mesh=mesh), surface_height=height,
        bed_height=setting.bed_height.astype(np.float32),
    )  # fmt: skip
