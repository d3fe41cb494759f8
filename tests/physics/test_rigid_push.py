"""No particle ends inside a rigid body."""

import numpy as np
import pytest
from boxes import walls_of

from fluidlift.numerics.sampling import sample_nodes
from fluidlift.physics.rigid import RigidBodies, RigidBody

H = 0.05
SHAPE = (20, 20, 20)
TURN = (0.8, 0.3, -0.4, 0.2)


def rigid(bodies, distance=None, open_top=True):
    walls = walls_of(SHAPE, distance, open_top)
    return RigidBodies(bodies, walls, density=1000.0, gravity=(0, 0, -9.81)), walls


def scattered(count, seed=0):
    rng = np.random.default_rng(seed)
    positions = rng.uniform(0.01, 0.99, (count, 3)).astype(np.float32)
    return positions, rng.normal(size=(count, 3)).astype(np.float32)


def test_particles_leave_a_body_by_its_nearest_side_and_others_stay():
    bodies, _ = rigid([RigidBody.sphere("ball", 0.2, motion="static", position=(0.5, 0.5, 0.5))])
    positions, velocities = scattered(4000)
    before, speeds = positions.copy(), velocities.copy()
    within = bodies.inside(positions)
    assert within.sum() > 80
    assert not bodies.push_out(positions, velocities).any()
    assert not bodies.inside(positions).any()
    radius = np.sqrt(((before - 0.5) ** 2).sum(axis=1))
    away = radius > 0.2 + 0.1 * H
    np.testing.assert_array_equal(positions[away], before[away])
    np.testing.assert_array_equal(velocities[away], speeds[away])
    # along the radius, to two hundredths of a cell outside; the direction is noisy farther inside
    moved = within & (radius > 0.14)
    end = 0.5 + (before[moved] - 0.5) * ((0.2 + 0.02 * H) / radius[moved])[:, None]
    # up to 1.2 H on the way, by normals of a field in cells of a sixteenth of the radius: a few hundredths of a rad off
    np.testing.assert_allclose(positions[moved], end, atol=0.1 * H)


def test_the_velocity_of_a_particle_does_not_point_into_a_moving_body():
    motion = {"velocity": (1.0, 0.5, -0.5), "angular_velocity": (1.0, 2.0, 3.0)}
    bodies, _ = rigid([RigidBody.sphere("ball", 0.2, position=(0.5, 0.5, 0.5), **motion)])
    positions, velocities = scattered(4000)
    within = bodies.inside(positions)
    before = velocities.copy()
    bodies.push_out(positions, velocities)
    arm = positions[within] - 0.5
    solid = np.array([1.0, 0.5, -0.5]) + np.cross([1.0, 2.0, 3.0], arm)
    normal = arm / np.sqrt((arm**2).sum(axis=1, keepdims=True))
    # normals of the distance field and of the sphere differ by up to 0.03 rad, relative velocities reach 6 m/s
    assert ((velocities[within] - solid) * normal).sum(axis=1).min() > -0.2
    approaching = ((before[within] - solid) * normal).sum(axis=1) < -2.0
    assert approaching.any()
    change = velocities[within] - before[within]
    along = change - (change * normal).sum(axis=1, keepdims=True) * normal
    assert np.abs(along).max() < 0.2  # free slip, but for the same


def test_damping_takes_its_share_of_the_velocity_along_a_body():
    bodies, _ = rigid([RigidBody.box("plate", (0.6, 0.6, 0.2), position=(0.5, 0.5, 0.4), velocity=(0.4, 0, 0))])
    positions = np.array([[0.5, 0.5, z] for z in (0.5 + 0.001 * H, 0.5 + 0.5 * H, 0.5 + 1.5 * H)], np.float32)
    velocities = np.tile(np.float32([1.4, 0, 0]), (3, 1))
    bodies.push_out(positions, velocities, tangential_share=0.6)
    # all of the damping at the surface (put a fiftieth of a cell away), half of it half a cell away
    np.testing.assert_allclose(velocities[:, 0] - 0.4, [0.6, 0.8, 1.0], atol=0.02)


@pytest.mark.parametrize("gap", [0.5, 0.1, 0.0])
def test_particles_between_a_body_and_the_bed_end_outside_of_both(gap):
    def slope(x):
        return (x[..., 2] - 0.3 - 0.2 * x[..., 0]) / np.sqrt(1.04)

    angle = np.arctan(0.2)
    height = 0.3 + 0.2 * 0.5 + (0.1 + gap * H) / np.cos(angle)
    plate = RigidBody.box(
        "plate", (0.4, 0.4, 0.2), motion="static", position=(0.5, 0.5, height),
        orientation=(np.cos(angle / 2), 0, -np.sin(angle / 2), 0),
    )  # fmt: skip
    bodies, walls = rigid([plate], slope)
    positions, velocities = scattered(6000)
    under = (np.abs(slope(positions)) < 1.5 * H) & (np.abs(positions[:, :2] - 0.5).max(axis=1) < 0.18)
    positions, velocities = positions[under], velocities[under]
    positions[:, 2] += np.maximum(0.001 - slope(positions), 0.0).astype(np.float32) * 1.1  # outside the terrain
    assert bodies.inside(positions).any() or gap == 0.5
    lost = bodies.push_out(positions, velocities)
    assert not lost.any()
    assert not bodies.inside(positions).any()
    assert sample_nodes(walls.signed_distance, walls.grid, positions).min() > 0.0
    assert walls.grid.contains(positions).all()


def test_particles_between_two_bodies_and_a_side_find_a_place():
    bodies, walls = rigid(
        [
            RigidBody.box("a", (0.2, 0.4, 0.4), motion="static", position=(0.1, 0.5, 0.5)),
            RigidBody.box("b", (0.2, 0.4, 0.4), motion="static", position=(0.3 + 0.02 * H, 0.5, 0.5)),
        ]
    )
    positions, velocities = scattered(6000)
    positions, velocities = positions[bodies.inside(positions)], velocities[bodies.inside(positions)]
    assert not bodies.push_out(positions, velocities).any()
    assert not bodies.inside(positions).any() and walls.grid.contains(positions).all()


def test_a_particle_without_any_place_is_marked_and_counted():
    # a block that fills the whole box
    block = RigidBody.box("block", (1.2, 1.2, 2.4), motion="static", position=(0.5, 0.5, 0.5))
    bodies, _ = rigid([block], open_top=False)
    positions, velocities = scattered(50)
    lost = bodies.push_out(positions, velocities)
    assert lost.all() and bodies.removed == 50
