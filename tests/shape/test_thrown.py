"""What rises out of its pool, on made clips of fountains, and of falls and spouts that are none."""

import numpy as np
import pytest

from fluidlift.shape.kind import estimate_kind, thrown_up
from fluidlift.shape.thrown import Thrown, thrown
from fluidlift.synthetic.fountain import SCENES, AirborneScene, Source, filmed_airborne
from fluidlift.types import GRAVITY

UP = float(np.sqrt(2 * GRAVITY * 2.0))
OTHERS = {
    "fan": AirborneScene(
        tuple(
            Source((0.0, 0.0, 0.05), (0.03, 0.03), (x, 0.1, 1.1 * UP), (0.15, 0.15, 0.05 * UP), 350.0)
            for x in (-1.2, -0.4, 0.4, 1.2)
        ),
        (3.2, 2.0), 11.0, 8.0, 1.2, "trees", drop=0.014,
    ),
    "gusher": AirborneScene(
        (Source((0.4, 0.0, 0.05), (0.15, 0.15), (0.1, 0.0, UP), (0.3, 0.3, 0.15 * UP), 900.0),),
        (2.4, 1.8), 12.0, 14.0, 1.3, "wall", drop=0.015,
    ),
}  # fmt: skip
"""fountains that no bound was chosen on"""


def ways(scene: str | AirborneScene, seed: int = 3) -> Thrown:
    clip = filmed_airborne(scene, seed, frames=20, size=(240, 180))
    return thrown(clip.frames, (clip.air.mean(axis=0) > 0.25) | clip.pool)


@pytest.mark.parametrize("name", ["single", "row", "inclined", "windy", *OTHERS])
def test_a_fountain_is_seen_to_rise_and_to_fall(name):
    found = ways(OTHERS.get(name, name))
    assert thrown_up(found) > 0.7, found


@pytest.mark.parametrize("name", [name for name, make in SCENES.items() if not make().fountain])
def test_what_comes_over_a_brink_or_out_of_a_spout_is_none(name):
    found = ways(name)
    assert found.rises < 0.02 and thrown_up(found) < 0.05, found


def test_the_other_way_round_in_time_a_fountain_stays_one_and_a_fall_rises_all_over():
    """What rises near its top is not told by the sign of the rows alone."""
    fall = filmed_airborne("fall", 3, frames=20, size=(240, 180))
    back = thrown(fall.frames[::-1], (fall.air.mean(axis=0) > 0.25) | fall.pool)
    assert back.rises > 0.9 and back.falls < 0.05 and thrown_up(back) == 0.0


def test_nothing_is_said_of_a_still_picture_or_of_no_fluid():
    still = np.full((8, 60, 80, 3), 90, np.uint8)
    assert thrown_up(thrown(still, np.ones((60, 80), bool))) == 0.0
    assert thrown(still, np.zeros((60, 80), bool)) == Thrown(0.0, 0.0, 0.0)


def test_what_is_thrown_up_is_a_fountain_and_no_fall():
    """A curtain, with and without the evidence that it rises too."""
    rows, columns = np.mgrid[:90, :160]
    mask = np.broadcast_to((np.abs(columns - 80) < 45) & (rows > 12) & (rows < 75), (6, 90, 160))
    frames = np.where(mask[..., None], np.uint8(200), np.uint8(90)) * np.ones(3, np.uint8)
    motion = np.where(mask[0][..., None], np.array([0.1, 4.0], np.float32), 0.0)
    args = frames, mask, motion, mask[0].astype(float)
    assert estimate_kind(*args).kind == "fall"
    assert estimate_kind(*args, ways=Thrown(0.01, 0.5, 1.0)).kind == "fall"
    assert estimate_kind(*args, ways=Thrown(0.3, 0.5, 0.0)).kind == "fall"
    found = estimate_kind(*args, ways=Thrown(0.3, 0.4, 1.0))
    assert found.kind == "fountain" and 0.8 < found.scores["fountain"] < 0.99
