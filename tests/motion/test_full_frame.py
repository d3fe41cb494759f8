"""What a steadied frame does not see shows another time of the same place."""

import cv2
import numpy as np
import pytest

from fluidlift.motion.full_frame import FEWEST, UnseenEdges, donors, fill_unseen, seen_pixels
from fluidlift.motion.stabilize import stabilise
from fluidlift.types import VideoClip

FRAMES, HEIGHT, WIDTH = 60, 90, 160


def blind(rows: np.ndarray, height: int = 12) -> np.ndarray:
    """Cells of pictures whose lowest rows are not seen, by frame."""
    return np.broadcast_to((np.arange(height) >= height - rows[:, None])[..., None], (len(rows), height, 16)).copy()


def test_each_frame_is_lent_to_by_one_that_sees_what_it_does_not():
    cells = blind(np.repeat([0, 3], [25, 35]))
    found = donors(cells)
    assert (found[:25] == -1).all(), "they see all"
    lent = found[25:]
    assert ((lent >= 0) & (lent < 25)).all()
    steps = np.diff(lent)
    assert (steps[steps != 1] < 0).all() and (steps != 1).sum() == 1, (
        "25 frames in their order, and from the first again"
    )


def test_an_edge_that_goes_on_to_grow_is_lent_to_by_what_sees_all_of_it():
    rows = np.maximum(np.arange(60) // 6 - 3, 0)
    found = donors(blind(rows))
    assert (rows[found[rows > 0]] == 0).all()


def test_what_nobody_sees_for_long_enough_is_left():
    cells = blind(np.where(np.arange(40) < FEWEST - 2, 0, 3))
    assert (donors(cells)[:-FEWEST] == -1).all()
    assert (donors(blind(np.full(40, 3))) == -1).all(), "nor what nobody sees at all"


def test_a_cell_is_unseen_where_any_of_its_pixels_is():
    edges = UnseenEdges(2, (1280, 720))
    hidden = np.zeros((720, 1280), bool)
    hidden[719, 640] = True
    edges.put(1, hidden)
    assert edges.cells.shape == (2, 90, 160) and np.argwhere(edges.cells).tolist() == [[1, 89, 80]]
    seen = seen_pixels(edges.cells, (1280, 720))
    assert seen[0].all() and not seen[1][719, 640] and seen[1].mean() > 0.99


def test_the_fill_blends_in_and_leaves_what_was_seen():
    frames = np.zeros((40, 96, 128, 3), np.uint8)
    frames[:] = np.arange(40)[:, None, None, None]
    cells = blind(np.repeat([0, 3], [20, 20]))
    before = frames.copy()
    fill_unseen(frames, cells)
    assert np.array_equal(frames[:20], before[:20])
    assert np.array_equal(frames[:, :56], before[:, :56]), "more than a cell beside it"
    lent = donors(cells)[20:]
    assert (frames[20:, 74:] == lent[:, None, None, None]).all()
    across = frames[20, :, 0, 0].astype(int)
    assert (np.diff(across) <= 0).all() and len(np.unique(across)) > 4, "no seam"


@pytest.fixture(scope="module")
def hand_held() -> tuple[VideoClip, np.ndarray]:
    """A river below a still bank, from a camera that tilts up, and the river as it is; what lies beside the picture
    comes into it."""
    rng = np.random.default_rng(2)
    tall, wide = HEIGHT + 40, WIDTH + 2 * FRAMES + 40

    def grain(size: tuple[int, int]) -> np.ndarray:
        noise = cv2.GaussianBlur(rng.normal(0.0, 1.0, size), (0, 0), 1.5)
        return np.clip(127 + 60 * noise / noise.std(), 0, 255)

    bank, water = grain((tall, WIDTH + 40)), grain((tall, wide))
    world = np.stack([np.concatenate([bank[:60], water[60:, 2 * t : 2 * t + WIDTH + 40]]) for t in range(FRAMES)])
    up = np.clip(np.arange(FRAMES) - 20, 0, 20)
    frames = [world[t, 20 - n : 20 - n + HEIGHT, 20 : 20 + WIDTH] for t, n in enumerate(up)]
    clip = np.repeat(np.stack(frames).round().astype(np.uint8)[..., None], 3, axis=-1)
    return VideoClip(clip, np.arange(FRAMES) / 30.0, "made"), world


def test_water_at_an_edge_that_was_left_goes_on_to_move(hand_held):
    clip, _ = hand_held
    steady, report = stabilise(clip)
    assert report.stabilised and report.unseen is not None
    hidden = ~seen_pixels(report.unseen, clip.size)
    moves = np.abs(np.diff(steady.frames[..., 0].astype(float), axis=0))
    edge, water = hidden[1:] & hidden[:-1], np.zeros(moves.shape, bool)
    water[:, HEIGHT // 2 + 10 :] = True
    assert edge[40:].any(axis=(1, 2)).all()
    assert moves[edge & water].mean() > 0.8 * moves[~edge & water].mean(), "it stood still"
