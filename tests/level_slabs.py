"""Level slabs of a liquid on matt ground, seen from straight above in a white world."""

import numpy as np

from fluidlift.look.environment import Environment
from fluidlift.look.ground_picture import GroundMeshes
from fluidlift.look.liquid import shaded
from fluidlift.look.materials import Material
from fluidlift.look.screen_space import mesh_surface
from fluidlift.look.wet_ground import wetted
from fluidlift.numerics.srgb import srgb_from_linear
from fluidlift.types import PinholeCamera, TriangleMesh

INDEX = 1.49
ABSORBS = (3.0, 16.0, 70.0)
CAMERA = PinholeCamera.looking(np.array([0.0, -0.02, 1.2]), np.zeros(3), 4.0, (16, 16))


def slab(depth: float, sunk: float = 0.0, half: float = 0.25) -> TriangleMesh:
    sides = [(x, y, z) for z in (-sunk, depth) for y in (-half, half) for x in (-half, half)]
    faces = [[0, 2, 1], [1, 2, 3], [4, 5, 6], [5, 7, 6], [0, 1, 4], [1, 5, 4], [2, 6, 3], [3, 6, 7], [0, 4, 2],
             [2, 4, 6], [1, 3, 5], [3, 7, 5]]  # fmt: skip
    return TriangleMesh(np.array(sides), np.array(faces), np.full((8, 3), 0.5))


def floor(albedo: float, half: float = 0.3) -> TriangleMesh:
    corners = half * np.array([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])
    color = float(srgb_from_linear(np.array([albedo]))[0])
    return TriangleMesh(corners, np.array([[0, 1, 2], [0, 2, 3]]), np.full((4, 3), color))


def drawn(depth: float, albedo: float, material: Material, *, casts: bool = True) -> np.ndarray:
    world = Environment.white()
    ground = GroundMeshes([floor(albedo)], world)
    surface = mesh_surface(slab(depth), CAMERA)
    dry = ground.picture(CAMERA, None, slab(depth) if casts else None, material=material)
    there = ground.albedo(CAMERA), ground.depth(CAMERA)
    behind = wetted(dry, surface, CAMERA, material, there, shaded=casts)
    return shaded(surface, behind, CAMERA, material, world).mean(axis=(0, 1))
