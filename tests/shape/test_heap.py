"""What is poured over something that stands: told by its silhouette, held by a solid below its film."""

import numpy as np
import pytest

from fluidlift.numerics.sampling import sample_nodes
from fluidlift.shape.airborne import FILM, airborne_setting
from fluidlift.shape.heap import THICKEST, Heap, find_heap
from fluidlift.shape.kind import level_camera
from fluidlift.shape.kinds.base import Observation
from fluidlift.shape.kinds.pour import BUILDER
from fluidlift.shape.slope import SlopePrior
from fluidlift.types import CellType, PinholeCamera, Similarity3, UpEvidence

AWAY = 2.0
"""m from the eye to the axis along the ground"""
LOW, TOP = -0.1, 0.12
"""z of the heap from the level of the eye, m"""


def camera_at(pitch: float) -> PinholeCamera:
    return level_camera(PinholeCamera.from_fov(40.0, (240, 240)), UpEvidence(pitch, 0.0, "", 0.0))


def made(at: float = 0.05) -> Heap:
    """0.22 m tall and 0.2 m in radius below its round top."""
    z = np.linspace(LOW, TOP, 60)
    return Heap((at, AWAY), z, 0.2 * np.sqrt(np.clip((TOP + 1e-3 - z) / 0.06, 0.0, 1.0)))


def silhouette(camera: PinholeCamera, heap: Heap, *, jet: float = 0.03, threads: float = 0.15) -> np.ndarray:
    """The heap, its jet of 0.5 m, and two threads that run down from it, in the vertical plane of its axis."""
    rays = camera.rays(camera.pixel_grid())
    points = camera.position + rays * (AWAY / rays[..., 1])[..., None]
    x, z = points[..., 0] - heap.axis[0], points[..., 2]
    wide = (np.abs(x) < heap.radius_at(z)) & (z > LOW)
    falls = (np.abs(x) < jet) & (z > TOP - 0.02) & (z < TOP + 0.5)
    runs = ((np.abs(x - 0.1) < 0.02) | (np.abs(x + 0.12) < 0.02)) & (z <= LOW) & (z > LOW - threads)
    return wide | falls | runs


@pytest.mark.parametrize("pitch", [0.0, 8.0])
def test_axis_and_radii_are_those_of_the_heap(pitch):
    camera, truth = camera_at(pitch), made()
    found = find_heap(camera, silhouette(camera, truth), AWAY)
    assert found is not None
    pixel = AWAY / camera.focal[0]
    assert found.axis == pytest.approx(truth.axis, abs=1.5 * pixel)
    # the row in which the jet is told from the top is as wide as half of the heap
    assert found.heights[0] == pytest.approx(LOW, abs=2 * pixel) and TOP - 0.05 < found.heights[-1] < TOP + 2 * pixel
    z = np.linspace(LOW + 0.02, TOP - 0.04, 9)
    assert found.radius_at(z) == pytest.approx(truth.radius_at(z), abs=2 * pixel)
    assert (np.diff(found.radii) <= 0).all()


def test_none_where_nothing_runs_down_nothing_falls_in_or_nothing_is_wide():
    camera, truth = camera_at(0.0), made()
    assert find_heap(camera, silhouette(camera, truth, threads=0.0), AWAY) is None  # it may stand in a vessel
    assert find_heap(camera, silhouette(camera, truth, jet=0.0), AWAY) is None  # what runs out of a jug
    assert find_heap(camera, silhouette(camera, truth, jet=0.15), AWAY) is None
    assert find_heap(camera, np.zeros((240, 240), bool), AWAY) is None


def test_what_it_covers_lies_a_film_below_its_outside_and_goes_down_to_the_ground():
    heap, film = made(0.0), 0.02

    def inside(x: float, z: float) -> float:
        return float(heap.core(np.array([[x, AWAY, z]]), film)[0])

    assert inside(0.2 - film, 0.0) == pytest.approx(0.0, abs=0.1 * film)
    assert inside(0.2, 0.0) == pytest.approx(film, rel=0.1) and inside(0.1, 0.0) < -film
    assert inside(0.1, -5.0) < 0 < inside(0.2, -5.0)
    assert inside(0.0, TOP - 2 * film) < 0 < inside(0.0, TOP - 0.5 * film)
    thick, radius = 0.19, 0.2 * (1.0 - THICKEST)
    inner, outer = (heap.core(np.array([[k * radius, AWAY, -0.5]]), thick)[0] for k in (0.9, 1.1))
    assert inner < 0 < outer, "of a film that is thicker than what it lies on"


def test_it_moves_with_its_frame():
    moved = made(0.0).transformed(Similarity3(2.0, np.eye(3), np.array([1.0, 0.0, 3.0])))
    assert moved.axis == pytest.approx((1.0, 2 * AWAY)) and moved.heights[-1] == pytest.approx(2 * TOP + 3.0)
    assert moved.radius_at(np.array([3.0])) == pytest.approx([0.4])


def observed(camera: PinholeCamera, mask: np.ndarray, ever: np.ndarray | None = None) -> Observation:
    shape = mask.shape
    return Observation(camera, mask, np.zeros((*shape, 2)), np.zeros(shape), 1 / 30, None, False,
                       SlopePrior(0.0, 1.0), 0.0, None, ever=ever)  # fmt: skip


def test_what_runs_down_later_tells_a_heap_from_what_stands_in_a_vessel():
    camera, truth = camera_at(0.0), made()
    mask, ever = silhouette(camera, truth, threads=0.0), silhouette(camera, truth)
    later = BUILDER.front_surface(observed(camera, mask, ever))
    assert later.heap is not None and later.vessel is None
    (x, ahead), (x_true, away) = later.heap.axis, truth.axis
    assert x / ahead == pytest.approx(x_true / away, abs=0.01)
    never = BUILDER.front_surface(observed(camera, mask))
    assert never.heap is None and never.vessel is not None


def test_a_pour_that_covers_something_lies_around_it_and_is_fed_from_above():
    camera, truth = camera_at(0.0), made()
    mask = silhouette(camera, truth)
    front = BUILDER.front_surface(observed(camera, mask))
    assert front.vessel is None and front.heap is not None
    depth, back = front.depth.astype(float), (front.depth + 2 * front.half_thickness).astype(float)
    grid = camera.pixel_grid()
    body = np.concatenate([camera.unproject(grid[mask], d[mask]) for d in (depth, back)])
    setting = airborne_setting(
        depth, back, mask, camera, body, np.array([0.0, 0.0, -1.0]), kind="pour", longest=64, cell_limit=120_000,
        heap=front.heap,
    )  # fmt: skip
    h, (x, y) = setting.terrain.grid.spacing, front.heap.axis
    z, radius = 0.5 * (front.heap.heights[0] + front.heap.heights[-1]), front.heap.radii[0]

    def cell(*point: float) -> int:
        return int(setting.cell_types[tuple(setting.terrain.grid.cell_of(np.array([point]))[0])])

    film = FILM * h
    assert cell(x, y, z) == CellType.SOLID and cell(x, y, front.heap.heights[0] - 4 * h) == CellType.SOLID
    for aside, ahead in ((1.0, 0.0), (-1.0, 0.0), (0.0, -1.0), (0.0, 1.0)):
        way = radius - 0.5 * film
        assert cell(x + aside * way, y + ahead * way, z) == CellType.FLUID
    phi = setting.terrain.signed_distance
    assert sample_nodes(phi, setting.terrain.grid, np.array([[x, y - radius, z]]))[0] == pytest.approx(film, rel=0.3)
    inlet = setting.terrain.grid.centers()[setting.cell_types == CellType.INFLOW]
    assert len(inlet) and inlet[:, 2].min() > front.heap.heights[-1]
    assert setting.coat is not None and setting.held_below == setting.coat.top == pytest.approx(front.heap.heights[-1])
    assert setting.coat.thickness == pytest.approx(film) and setting.coat.radius == pytest.approx(radius)
    # threads run down on its near side, not through its middle
    rows = (setting.terrain.grid.centers()[..., 2] < front.heap.heights[0] - 2 * h) & (
        setting.cell_types == CellType.FLUID
    )
    runs = setting.terrain.grid.centers()[rows]
    assert len(runs) and (np.hypot(runs[:, 0] - x, runs[:, 1] - y) > radius - 2 * film).all() and (runs[:, 1] < y).all()
