"""What a steadied frame does not see shows another time of the same place."""

import cv2
import numpy as np
import pytest

from fluidlift.config import JobConfig
from fluidlift.motion.full_frame import FEWEST, UnseenEdges, donors, lent, seen_pixels
from fluidlift.motion.stabilize import stabilise
from fluidlift.pipeline.hints import NO_HINTS
from fluidlift.pipeline.inputs import GivenFile
from fluidlift.pipeline.settings import GivenMask, SegmentSettings
from fluidlift.pipeline.stages.segment import segment
from fluidlift.pipeline.work import Work
from fluidlift.types import Label, PixelFlow, PixelLabels, VideoClip
from fluidlift.types.stages import Flow, Read

FRAMES, HEIGHT, WIDTH = 60, 90, 160


def blind(rows: np.ndarray, height: int = 12) -> np.ndarray:
    """Cells of pictures whose lowest rows are not seen, by frame."""
    return np.broadcast_to((np.arange(height) >= height - rows[:, None])[..., None], (len(rows), height, 16)).copy()


def test_each_frame_is_lent_to_by_one_that_sees_what_it_does_not():
    cells = blind(np.repeat([0, 3], [25, 35]))
    found = donors(cells)
    assert (found[:25] == -1).all(), "they see all"
    lenders = found[25:]
    assert ((lenders >= 0) & (lenders < 25)).all()
    steps = np.diff(lenders)
    assert (steps[steps != 1] < 0).all() and (steps != 1).sum() == 1, "in their order, and from the first again"


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


def test_what_is_lent_blends_in_and_leaves_what_was_seen():
    cells = blind(np.repeat([0, 3], [20, 20]))
    lending = list(lent(cells, (128, 96)))
    receivers, lenders = ([pair[k] for pair in lending] for k in range(2))
    assert receivers == list(range(20, 40)) and lenders == donors(cells)[20:].tolist()
    for _, _, share in lending:
        assert (share[74:] == 1).all() and (share[:56] == 0).all(), "within its cells, and more than a cell beside them"
        across = share[:, 0]
        assert (np.diff(across) >= 0).all() and len(np.unique(across)) > 4, "no seam"


def test_no_frame_lends_what_it_does_not_see_itself():
    cells = blind(np.repeat([3, 0, 1], [10, 20, 10]))
    for _, donor, share in lent(cells, (128, 96)):
        assert (share[~seen_pixels(cells[donor][None], (128, 96))[0]] < 0.5).all()


@pytest.fixture(scope="module")
def hand_held() -> VideoClip:
    """A river below a still bank, from a camera that tilts up."""
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
    return VideoClip(clip, np.arange(FRAMES) / 30.0, "made")


@pytest.mark.parametrize("drawn", [False, True])
def test_water_at_an_edge_that_was_left_goes_on_to_move(hand_held, tmp_path, monkeypatch, drawn):
    """The mask of what stands still there says that it is none; one that a person drew is left as it is."""
    steady, report = stabilise(hand_held)
    assert report.stabilised and report.unseen is not None
    hidden = ~seen_pixels(report.unseen, hand_held.size)
    water = np.zeros(hidden.shape, bool)
    water[:, HEIGHT // 2 + 10 :] = True
    labels = np.where(water & ~hidden, Label.FLUID, Label.BACKGROUND).astype(np.uint8)
    found = PixelLabels(labels.copy(), np.full(labels.shape, 0.5, np.float16))
    monkeypatch.setattr("fluidlift.shape.segment.segment", lambda *_, **__: found)
    read = Read(steady, np.arange(FRAMES), FRAMES, 0.5, True, unseen=report.unseen)
    none = np.zeros((FRAMES - 1, *steady.frames.shape[1:3]), np.float32)
    flow = Flow(PixelFlow(np.stack([none, none], axis=-1), np.ones_like(none)), "dis")
    mask = GivenMask(GivenFile(tmp_path, ""), None, 0.0, None) if drawn else None
    monkeypatch.setattr("fluidlift.pipeline.stages.segment.drawn_mask", lambda *_: labels == Label.FLUID)
    made = segment(read, flow, mask, SegmentSettings.of(JobConfig()), NO_HINTS, work=Work.alone(tmp_path))
    assert made.whole is not None
    moves = np.abs(np.diff(made.whole[..., 0].astype(float), axis=0))
    still = np.abs(np.diff(steady.frames[..., 0].astype(float), axis=0))
    edge = hidden[1:] & hidden[:-1] & water[1:]
    assert edge[40:].any(axis=(1, 2)).all()
    seen = water[1:] & ~hidden[1:] & ~hidden[:-1]
    assert moves[edge].mean() > 0.7 * moves[seen].mean() > 3 * still[edge].mean()
    ground = hidden & ~water
    ground[:, HEIGHT // 2 - 5 :] = False
    np.testing.assert_array_equal(made.whole[ground], steady.frames[ground])
    fluid = made.labels.labels == Label.FLUID
    assert (fluid == (labels == Label.FLUID)).all() if drawn else fluid[hidden & water].mean() > 0.9
    assert not fluid[~water].any()
