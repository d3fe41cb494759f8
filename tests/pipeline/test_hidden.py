"""A fall with a disc before it, through the stages: the body goes on behind it, and the disc stays in the picture."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest

from fluidlift.config import JobConfig
from fluidlift.pipeline.inputs import GivenFile
from fluidlift.pipeline.settings import GeometrySettings, GivenView, taken
from fluidlift.pipeline.stages.geometry import geometry
from fluidlift.pipeline.volume_motion import motion_scene, seen_beside
from fluidlift.pipeline.work import Work
from fluidlift.present.front_view import before_ground
from fluidlift.scene.footage import footage_of
from fluidlift.shape.occluders import near_occluders
from fluidlift.types import CellType, Gaussians, Label, PixelFlow, PixelLabels, VideoClip
from fluidlift.types.fluid_masks import FluidMasks
from fluidlift.types.stages import Flow, Geometry, Read, Segmentation

HEIGHT, WIDTH, FRAMES = 96, 128, 6
RIM, FOOT, SIDES = 16, 84, (20, 108)
GREEN = np.array([30, 160, 40])


def disc() -> np.ndarray:
    """Of 13 px, in the middle of the sheet."""
    y, x = np.mgrid[0:HEIGHT, 0:WIDTH] + 0.5
    return (y - 50) ** 2 + (x - 62) ** 2 < 13**2


@dataclass(frozen=True)
class Seen:
    """The stages before the geometry, and it."""

    read: Read
    segmentation: Segmentation
    flow: PixelFlow
    geometry: Geometry


@pytest.fixture(scope="module")
def seen(tmp_path_factory) -> Seen:
    y, x = np.mgrid[0:HEIGHT, 0:WIDTH] + 0.5
    rng = np.random.default_rng(2)
    fluid = (y >= RIM) & (y < FOOT) & (x >= SIDES[0]) & (x < SIDES[1]) & ~disc()
    speed = np.where(fluid, np.sqrt(1.5**2 + 0.1 * np.maximum(y - RIM, 0.0)), 0.0)
    frames = np.full((FRAMES, HEIGHT, WIDTH, 3), 90, np.uint8)
    frames[:, fluid] = rng.integers(170, 240, (FRAMES, int(fluid.sum()), 1))
    frames[:, disc()] = GREEN
    clip = VideoClip(frames, 0.04 * np.arange(FRAMES), "fall")
    motion = np.zeros((FRAMES - 1, HEIGHT, WIDTH, 2), np.float16)
    motion[..., 1] = speed
    flow = PixelFlow(motion, np.where(fluid, 0.7, 0.05).astype(np.float16)[None].repeat(FRAMES - 1, axis=0))
    labels = np.where(fluid, Label.FLUID, Label.BACKGROUND).astype(np.uint8)[None].repeat(FRAMES, axis=0)
    read = Read(clip, np.arange(FRAMES), FRAMES, 0.0, False)
    found = Segmentation(PixelLabels(labels, np.ones(labels.shape, np.float16)), 0.4, 1.0, 1.0, True)
    shape = replace(JobConfig().shape, kind="fall", fov=50.0, pitch=5.0, size=2.0, cells=40)
    config = taken(GeometrySettings, shape, drawn=None)
    folder = tmp_path_factory.mktemp("fall")
    made = geometry(
        read, Flow(flow, "dis"), found, GivenView(GivenFile(folder / "fall.mp4", "0")), config, work=Work.alone(folder)
    )
    return Seen(read, found, flow, made)


def test_the_geometry_knows_what_is_hidden_and_leaves_the_mask_as_filmed(seen):
    g = seen.geometry
    assert g.hidden is not None and (g.hidden & disc()).sum() > 0.8 * disc().sum()
    assert not (g.mask & g.hidden).any()


def test_the_body_goes_on_behind_the_disc_and_no_ground_stands_in_the_sheet(seen):
    g, grid = seen.geometry, seen.geometry.grid
    rows, columns = np.nonzero(disc())
    uv = np.stack([columns + 0.5, rows + 0.5], axis=-1)
    # half a cell behind the surface along the ray
    depth = g.depth[rows, columns]
    assert (depth > 0).all()
    inside = g.camera.unproject(uv, depth * (1.0 + 0.7 * grid.spacing / depth))
    types = g.setting.cell_types[tuple(grid.cell_of(inside).T)]
    assert np.isin(types, (CellType.FLUID, CellType.INFLOW)).mean() > 0.9
    beside = np.nonzero(g.mask & ~near_occluders(disc()))
    assert np.median(g.depth[beside]) == pytest.approx(np.median(depth), rel=0.2)


def test_the_disc_is_in_the_picture_and_not_on_the_ground(seen):
    g = seen.geometry
    core = np.linalg.norm(np.mgrid[0:HEIGHT, 0:WIDTH].T + 0.5 - [50, 62], axis=-1).T < 10
    assert np.abs(g.plate[core].astype(int) - GREEN).max() <= 2
    texture = g.setting.terrain.mesh.texture
    green = (texture[..., 1].astype(int) - texture[..., 0].astype(int)) > 60
    assert not green.any(), "no ground is painted with what stands before the water"


def test_no_splat_behind_the_disc_is_seen_by_the_camera_of_the_clip(seen, channel):
    g = seen.geometry
    footage = footage_of(seen.read, seen.segmentation, g)
    scene = replace(channel(2), kind="fall", terrain=g.setting.terrain, camera=g.camera)
    visible = before_ground(scene, footage)
    uv = np.array([[62.5, 50.5], [62.5, 24.5], [30.5, 50.5]])
    depth = g.depth[uv[:, 1].astype(int), uv[:, 0].astype(int)]
    splats = Gaussians.isotropic(g.camera.unproject(uv, depth), 0.01, np.full((3, 3), 0.5), 0.9)
    assert visible is not None
    assert visible(splats).tolist() == [False, True, True]


def test_the_flow_of_the_disc_counts_for_nothing_and_that_of_the_sheet_as_before(seen):
    near = near_occluders(seen.geometry.hidden)
    scene = motion_scene(seen.read.clip, seen.geometry)
    assert not scene.prior[1][near].any()
    np.testing.assert_array_equal(scene.prior[1][~near], seen.geometry.mean_confidence[~near])
    read = seen_beside(lambda a, b: PixelFlow(seen.flow.displacement[a:b], seen.flow.confidence[a:b]), seen.geometry)
    found = read(1, 3)
    assert len(found) == 2 and not found.confidence[:, near].any()
    np.testing.assert_array_equal(found.confidence[:, ~near], seen.flow.confidence[1:3][:, ~near])
    flow = seen.flow
    assert seen_beside(flow, replace(seen.geometry, hidden=None)) is flow


def test_masks_with_what_is_hidden_hold_it_in_every_frame_however_they_are_read(seen):
    labels, hidden = seen.segmentation.labels.labels, seen.geometry.hidden
    masks, plain = FluidMasks(labels, hidden), FluidMasks(labels)
    np.testing.assert_array_equal(masks[2], plain[2] | hidden)
    np.testing.assert_array_equal(masks[1:3], plain[1:3] | hidden)
    np.testing.assert_array_equal(masks[1:3, 40:60], plain[1:3, 40:60] | hidden[40:60])
    np.testing.assert_array_equal(masks.any_frame(), plain.any_frame() | hidden)
