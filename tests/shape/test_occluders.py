"""What stands before a fall, and what stands in it: by made flows whose truth is known."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from fluidlift.shape.occluders import PRIOR, SURE, HiddenFluid, OutlineFlow, near_occluders, occluders

QUIET = 2.0
"""px of the blur that stands for the smoothness of optical flow"""


@dataclass(frozen=True)
class Scene:
    """A fall over a pool, with something round in it or before it."""

    size: tuple[int, int] = (192, 256)
    """px, h w"""
    rim: int = 30
    foot: int = 160
    """rows between which it falls"""
    sides: tuple[int, int] = (30, 226)
    middle: tuple[float, float] = (92.0, 120.0)
    """row and column of what is round"""
    radius: float = 22.0
    """px"""
    lean: float = 0.0
    """tangent of the fall's lean to the right"""
    start: float = 2.0
    """px per frame over the rim"""
    gravity: float = 0.12
    """px per frame^2"""
    uneven: float = 0.1
    """part of its speed by which the sheet differs from place to place"""
    solid: bool = False

    def made(self, seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Fluid, fluid at some time, motion and trust; and the round thing is dry."""
        rng, (height, width) = np.random.default_rng(seed), self.size
        y, x = np.mgrid[0:height, 0:width] + 0.5
        falls = (y >= self.rim) & (y < self.foot)
        inside = (x - self.lean * (y - self.rim) > self.sides[0]) & (x - self.lean * (y - self.rim) < self.sides[1])
        speed = np.sqrt(self.start**2 + 2.0 * self.gravity * np.maximum(y - self.rim, 0.0)) * falls
        away = np.stack([x - self.middle[1], y - self.middle[0]], axis=-1)
        distance = np.maximum(np.linalg.norm(away, axis=-1), 1e-6)
        dry = distance < self.radius
        direction = np.array([self.lean, 1.0]) / np.hypot(self.lean, 1.0)
        motion = speed[..., None] * direction
        if self.solid:
            motion = speed[..., None] * around_a_cylinder(away, self.radius, direction)
        uneven = gaussian_filter(rng.normal(size=self.size), 8.0)
        motion = motion * (1.0 + self.uneven * uneven / uneven.std())[..., None]
        motion[dry] = 0.0
        motion = np.stack([gaussian_filter(motion[..., a], QUIET) for a in (0, 1)], axis=-1).astype(np.float32)
        fluid = inside & (falls | (y >= self.foot)) & ~dry
        return fluid, fluid, motion, np.where(fluid, 0.6, 0.0).astype(np.float32)

    def disc(self) -> np.ndarray:
        y, x = np.mgrid[0 : self.size[0], 0 : self.size[1]] + 0.5
        return (y - self.middle[0]) ** 2 + (x - self.middle[1]) ** 2 < self.radius**2


def around_a_cylinder(away: np.ndarray, radius: float, along: np.ndarray) -> np.ndarray:
    """Potential flow around a cylinder, of speed 1 far away, and a wake that closes within three widths."""
    across = np.array([along[1], -along[0]])
    s, n = away @ along, away @ across
    r2 = np.maximum(s**2 + n**2, radius**2)
    u, v = 1.0 - radius**2 * (s**2 - n**2) / r2**2, -2.0 * radius**2 * s * n / r2**2
    wake = (s > 0) & (np.abs(n) < radius)
    u = np.where(wake, u * (1.0 - 0.9 * np.exp(-s / (3.0 * radius))), u)
    return u[..., None] * along + v[..., None] * across


def overlap(a: np.ndarray, b: np.ndarray) -> float:
    return float((a & b).sum() / max((a | b).sum(), 1))


SCENES = [
    Scene(),
    Scene(radius=14.0, middle=(70.0, 150.0)),
    Scene(lean=0.3, middle=(100.0, 140.0)),
    Scene(start=1.0, gravity=0.25, uneven=0.2),
]


@pytest.mark.parametrize("scene", SCENES)
def test_a_disc_before_a_falling_sheet_is_found_whole_and_as_a_rock_in_it_is_not(scene):
    found = occluders(*scene.made(1))
    assert overlap(found, scene.disc()) > 0.85, "the truth is exact; the outline is turned and blurred"
    from dataclasses import replace

    assert not occluders(*replace(scene, solid=True).made(1)).any()


def test_what_hides_the_foot_of_a_fall_is_found_as_far_down_as_the_sheet_falls_beside_it():
    scene = Scene(middle=(165.0, 120.0), radius=45.0)
    found = occluders(*scene.made(2))
    falling = np.arange(scene.size[0])[:, None] < scene.foot - 5
    assert overlap(found & falling, scene.disc() & falling) > 0.8
    assert not found[scene.foot + 5 :].any(), "below, nothing says that the water goes on"


def test_a_rock_in_a_level_stream_stays_one():
    height, width = 160, 256
    y, x = np.mgrid[0:height, 0:width] + 0.5
    away = np.stack([x - 120.0, y - 80.0], axis=-1)
    for along in (np.array([1.0, 0.0]), np.array([0.0, 1.0]), np.array([0.6, 0.8])):
        motion = (3.0 * around_a_cylinder(away, 18.0, along)).astype(np.float32)
        fluid = (y > 20) & (y < 140) & (np.linalg.norm(away, axis=-1) >= 18.0)
        motion[~fluid] = 0.0
        assert not occluders(fluid, fluid, motion, np.where(fluid, 0.6, 0.0).astype(np.float32)).any()


def test_a_sheet_that_is_not_measured_or_does_not_fall_says_nothing():
    fluid, ever, motion, trust = Scene().made(3)
    assert not occluders(fluid, ever, motion, 0.2 * trust).any()
    assert not occluders(fluid, ever, -motion, trust).any()
    assert not occluders(fluid, ever, 0 * motion, trust).any()
    nothing = np.zeros_like(fluid)
    assert not occluders(nothing, nothing, motion, trust).any()


def test_ground_beside_a_sheet_is_not_looked_at():
    fluid, ever, motion, trust = Scene(middle=(92.0, 30.0)).made(4)  # half of the disc lies beside it
    assert not occluders(fluid, ever, motion, trust)[:, :28].any()


def test_odds_of_an_outline_are_those_of_the_two_models():
    before = OutlineFlow(1.0, 1.0, 0.0, narrow=0.6)
    within = OutlineFlow(0.4, 0.2, 0.38, narrow=0.6)
    assert before.probability > 0.999 and within.probability < 0.001
    assert OutlineFlow(1.0, 1.0, 0.0, narrow=0.07).probability < SURE, "the wake of a twig is short"
    alike = OutlineFlow(0.7, float("nan"), 0.3 / np.pi * 2.0, narrow=0.6)  # half way between both in what is seen
    assert alike.probability == pytest.approx(PRIOR / (1 + PRIOR), abs=0.01)
    assert OutlineFlow(float("nan"), 1.0, 0.0, narrow=0.6).probability == 0.0, "nothing goes in"
    slender = OutlineFlow(1.0, float("nan"), 0.0, narrow=0.05)
    assert slender.probability < SURE, "beside something slender water falls the same in both"


def test_hidden_fluid_looks_as_the_fluid_beside_it_at_the_same_height():
    scene = Scene()
    fluid, _, _, _ = scene.made(5)
    hidden = scene.disc()
    rows, columns = np.mgrid[0 : scene.size[0], 0 : scene.size[1]]
    frames = np.stack([rows, columns, columns], axis=-1)[None].repeat(2, axis=0).astype(np.uint8)
    behind = HiddenFluid.of(hidden, fluid)
    shown = behind.pictures(frames)
    assert len(shown) == 2 and len(list(shown)) == 2
    np.testing.assert_array_equal(shown[1][~hidden], frames[1][~hidden])
    lent = shown[1][hidden]
    np.testing.assert_array_equal(lent[:, 0], rows[hidden])
    y, x = rows[hidden], lent[:, 1].astype(int)
    assert fluid[y, x].all() and not near_occluders(hidden)[y, x].any()
    assert behind.pictures(fluid[None])[0][hidden].all()


def test_hidden_fluid_without_any_beside_it_looks_as_the_nearest():
    hidden, fluid = np.zeros((40, 60), bool), np.zeros((40, 60), bool)
    hidden[10:20], fluid[30:] = True, True
    behind = HiddenFluid.of(hidden, fluid)
    assert (behind.lent[0] == 30).all()
    bare = HiddenFluid.of(hidden, np.zeros_like(fluid))
    np.testing.assert_array_equal(bare.lent, np.stack(np.nonzero(hidden)))
