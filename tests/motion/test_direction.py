"""The direction of the bulk flow on masks where it is known."""

from __future__ import annotations

import numpy as np
import pytest

from fluidlift.motion.direction import bank_direction, mainstream_direction, screen_downhill, through_direction
from fluidlift.types import PinholeCamera, RigidTransform

H, W = 72, 96
V, U = np.mgrid[:H, :W].astype(float)
NOTHING = np.zeros((H, W, 2), np.float32), np.zeros((H, W), np.float32)


def band(angle: float, half_width: float = 16.0) -> np.ndarray:
    """A straight river through the picture."""
    v, u = np.mgrid[:H, :W]
    return np.abs(-(u - W / 2) * np.sin(angle) + (v - H / 2) * np.cos(angle)) < half_width


@pytest.mark.parametrize("angle", [0.0, 0.5, -1.0])
def test_without_flow_nearby_the_fluid_follows_its_banks(angle: float) -> None:
    mask = band(angle)
    along = np.array([np.cos(angle), np.sin(angle)])
    axis, elongation = bank_direction(mask, sigma=6.0)
    # at the border the mask is continued straight outwards, which bends an oblique river there; not so in the middle
    assert np.abs((axis * along).sum(-1))[mask].mean() > 0.95
    assert np.abs((axis * along).sum(-1))[H // 2 - 8 : H // 2 + 8, W // 2 - 8 : W // 2 + 8].min() > 0.99
    assert elongation[mask].mean() > 0.6
    # flow is known in one small place, and askew there: it gives the sign, the banks give the direction
    d = np.zeros((H, W, 2), np.float32)
    c = np.zeros((H, W), np.float32)
    v, u = np.mgrid[:H, :W]
    patch = np.hypot(u - W / 2, v - H / 2) < 4
    d[patch] = -2 * along + 0.8 * np.array([-along[1], along[0]])
    c[patch] = 1.0
    n = mainstream_direction(d, c, mask)
    assert np.allclose(np.linalg.norm(n, axis=-1), 1.0, atol=1e-5)
    far = mask & (np.hypot(u - W / 2, v - H / 2) > 30)
    assert (n[far] @ -along).mean() > 0.95


def test_confident_flow_decides_the_direction_where_it_is() -> None:
    d = np.zeros((H, W, 2), np.float32)
    d[..., 0], d[..., 1] = 1.0, 1.0
    n = mainstream_direction(d, np.ones((H, W), np.float32), band(0.0))
    assert np.abs(n[band(0.0)] - np.sqrt(0.5)).max() < 0.08


def test_without_any_flow_the_direction_is_the_long_axis_downwards() -> None:
    n = mainstream_direction(np.zeros((H, W, 2), np.float32), np.zeros((H, W), np.float32), band(1.2))
    assert (n[band(1.2)] @ [np.cos(1.2), np.sin(1.2)]).mean() > 0.95


def seen_at(direction: np.ndarray, row: int, column: int, radius: float = 5.0) -> tuple[np.ndarray, np.ndarray]:
    """Flow of 2 px/frame with noise, known in one place only."""
    patch = np.hypot(U - column, V - row) < radius
    noise = 0.6 * np.random.default_rng(2).standard_normal((H, W, 2))
    d = np.where(patch[..., None], 2 * direction + noise, 0.0).astype(np.float32)
    return d, np.where(patch, 0.9, 0.0).astype(np.float32)


def test_a_river_that_turns_back_flows_one_way_all_along() -> None:
    # both arms leave through the left border; flow is seen in the upper arm only
    r = np.hypot(U - 60, V - H / 2)
    upper, lower = np.abs(V - 16) < 8, np.abs(V - 56) < 8
    mask = (U < 60) & (upper | lower) | (U >= 60) & (np.abs(r - 20) < 8)
    bend = np.stack([-(V - H / 2), U - 60], axis=-1) / np.maximum(r, 1)[..., None]
    true = np.where((U < 60)[..., None], np.where(V < H / 2, 1.0, -1.0)[..., None] * [1.0, 0.0], bend)
    n = mainstream_direction(*seen_at(true, 16, 20), mask)
    cosine = (n * true).sum(-1)[mask]
    # 0.9 is 26 degrees: the smoothing rounds the corners of the mask; the flow at large would give -1 on one arm
    assert cosine.mean() > 0.98 and np.quantile(cosine, 0.05) > 0.9
    n = mainstream_direction(*seen_at(-true, 16, 20), mask)
    assert (n * true).sum(-1)[mask].mean() < -0.98


def test_the_flow_parts_around_a_rock() -> None:
    # potential flow round a cylinder, in a channel wide enough that its walls change little
    x, y, radius = U - W / 2, V - H / 2, 9.0
    square = np.maximum(x**2 + y**2, 1.0)
    true = np.stack([1 - radius**2 * (x**2 - y**2) / square**2, -2 * radius**2 * x * y / square**2], axis=-1)
    true /= np.maximum(np.linalg.norm(true, axis=-1, keepdims=True), 1e-6)
    mask = (np.abs(y) < 34) & (square > radius**2)
    through = through_direction(mask, np.tile([1.0, 0.0], (H, W, 1)), np.tile([1.0, 0.0], (H, W, 1)))
    assert through is not None
    near = mask & (square < (2.5 * radius) ** 2)
    straight = true[near][:, 0].mean()
    # the picture's steps on the rock's rim cost some degrees; straight on would be worse than the potential by far
    assert (through * true).sum(-1)[near].mean() > 0.5 * (1 + straight) + 0.25 * (1 - straight)
    assert np.quantile((through * true).sum(-1)[near], 0.05) > 0.95


def test_both_arms_of_a_fork_lead_downstream() -> None:
    mask, true = (np.abs(V - H / 2) < 9) & (U < 44), np.tile([1.0, 0.0], (H, W, 1))
    for sign in (1, -1):
        n = np.array([np.cos(0.5), sign * np.sin(0.5)])
        along, across = (U - 38) * n[0] + (V - H / 2) * n[1], -(U - 38) * n[1] + (V - H / 2) * n[0]
        arm = (np.abs(across) < 6) & (along > 0) & ~mask
        true[arm] = n
        mask = mask | arm
    n = mainstream_direction(*seen_at(true, H // 2, 12), mask)
    assert (n * true).sum(-1)[mask].mean() > 0.98
    assert (n * true).sum(-1)[mask & (U > 60)].min() > 0.9  # past the parting nothing bends


def test_downhill_decides_where_neither_flow_nor_banks_say_anything() -> None:
    every = np.ones((H, W), bool)
    slope = np.tile([-3.0, 4.0], (H, W, 1))
    n = mainstream_direction(*NOTHING, every, downhill=slope)
    assert np.abs(n - [-0.6, 0.8]).max() < 0.35  # the picture's borders draw the flow straight through them
    assert (n @ [-0.6, 0.8]).mean() > 0.97
    # flow that is seen everywhere knows better
    d = np.tile(np.array([2.0, 0.0], np.float32), (H, W, 1))
    n = mainstream_direction(d, np.ones((H, W), np.float32), every, downhill=slope)
    assert (n[..., 0] > 0.99).all()
    with pytest.raises(ValueError, match="downhill"):
        mainstream_direction(*NOTHING, every, downhill=np.zeros((H, W)))


def test_a_mask_without_two_open_ends_has_no_flow_through_it() -> None:
    guide = np.tile([0.0, -1.0], (H, W, 1))
    island = np.hypot(U - W / 2, V - H / 2) < 20
    assert through_direction(island, guide, guide) is None
    plume = (np.abs(U - W / 2) < 10) & (V > 20)  # rises from below the picture and ends inside
    assert through_direction(plume, guide, guide) is None
    n = mainstream_direction(np.where(plume[..., None], guide, 0.0), plume.astype(np.float32), plume)
    assert (n[plume] @ [0.0, -1.0]).min() > 0.95


def test_downhill_on_the_screen_is_where_a_ball_would_roll() -> None:
    # a camera 2 m above the origin that looks level along y, over a plane that falls towards the right and away
    turned = np.array([[1.0, 0, 0], [0, 0, -1.0], [0, 1.0, 0]])  # camera from world: x right, z up is -y, y forward
    plain = PinholeCamera.from_fov(60.0, (W, H))
    eye = np.array([0.0, 0.0, 2.0])
    camera = PinholeCamera(plain.focal, plain.center, plain.size, RigidTransform(turned, -turned @ eye))
    slope = np.array([-0.3, -0.1])  # z = slope . (x, y)
    rays = camera.unproject(camera.pixel_grid(), np.ones((H, W))) - eye
    falls = rays[..., 2] - rays[..., :2] @ slope
    mask = falls < -0.15
    depth = np.where(mask, -eye[2] / np.where(mask, falls, -1.0), 0.0)
    found = screen_downhill(depth, mask, camera, smoothing=1.0)
    here = camera.unproject(camera.pixel_grid(), np.where(mask, depth, 1.0))
    there = here + 1e-3 * np.concatenate([-slope, [-(slope @ slope)]])
    seen = camera.project(there)[0] - camera.project(here)[0]
    true = seen / np.linalg.norm(seen, axis=-1, keepdims=True)
    inner = mask & np.roll(mask, 4, 0) & np.roll(mask, -4, 0) & (np.abs(V - H / 2) < H / 2 - 4)
    assert (found * true).sum(-1)[inner].min() > 0.99  # 8 degrees: differences over 2 px, smoothed at the rim
    assert (found[~mask] == 0).all()
    level = np.where(rays[..., 2] < -0.15, -eye[2] / np.minimum(rays[..., 2], -0.15), 0.0)
    assert (screen_downhill(level, level > 0, camera) == 0).all()
