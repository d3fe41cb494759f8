"""A level that rises is where it is in each frame; what comes for good otherwise, or is never the same, is none."""

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from fluidlift.motion.optical_flow import DenseInverseSearch, flow_of_pair
from fluidlift.shape.change_points import arrivals, bare_before
from fluidlift.shape.evidence import Evidence, gather_evidence
from fluidlift.shape.min_cut import spread
from fluidlift.shape.segment import clues_of, segment
from fluidlift.types.clip import Label, VideoClip
from fluidlift.types.flow import PixelFlow

FRAMES, HEIGHT, WIDTH = 40, 160, 200
GLASS = slice(70, 130)
FLOOR = 140
"""row"""
WAVE = 2.0 * np.sin(np.arange(WIDTH) / 4.0)


def level(t: int) -> np.ndarray:
    """Row of the surface in each column."""
    return 130.0 - 50.0 * t / FRAMES + WAVE * np.sin(0.9 * t)


def filled(t: int) -> np.ndarray:
    v, u = np.mgrid[:HEIGHT, :WIDTH]
    return (v >= level(t)[None]) & (v < FLOOR) & (u >= GLASS.start) & (u < GLASS.stop)


def jet(t: int, sway: float = 4.0) -> np.ndarray:
    v, u = np.mgrid[:HEIGHT, :WIDTH]
    return (np.abs(u - 100 - sway * np.sin(0.4 * t)) < 3) & (v < level(t)[None])


def clip_of(
    *, full: bool = False, jug: bool = False, sideways: bool = False, sway: float | None = 4.0
) -> tuple[VideoClip, np.ndarray]:
    """A smooth liquid that rises in a glass below a jet whose pattern falls, before a textured room; what is fluid.

    Args:
        full: of water that streams, from first to last.
        jug: one comes to stand beside it.
        sideways: it comes from the left.
        sway: px to either side, of the jet; None: it comes in from below, and there is none.
    """
    rng = np.random.default_rng(4)
    room = 150.0 + 8.0 * gaussian_filter(rng.normal(size=(HEIGHT, WIDTH)), 2.0) / 0.14
    glitter = gaussian_filter(rng.normal(size=(HEIGHT + 6 * FRAMES, WIDTH)), (3.0, 1.0))
    glitter /= glitter.std()
    pictures, fluid = [], []
    for t in range(FRAMES):
        inside, falls = filled(FRAMES if full else t), jet(t, sway or 0.0) & (sway is not None)
        if sideways:
            inside = filled(FRAMES) & (np.arange(WIDTH) < GLASS.start + 60 * (t + 8) / FRAMES)[None]
        picture = np.where(inside, 70.0, room)
        picture[falls] = 70.0 + 10.0 * glitter[6 * (FRAMES - t) :][:HEIGHT][falls]
        if full:
            picture[inside] += 30.0 * gaussian_filter(rng.normal(size=(HEIGHT, WIDTH)), 2.0)[inside] / 0.14
        if jug and t > FRAMES // 2:
            picture[60:140, 150:190] = 40.0
        pictures.append(gaussian_filter(picture, 0.7) + rng.normal(size=picture.shape))
        fluid.append(inside | falls)
    frames = np.clip(pictures, 0, 255).round().astype(np.uint8)[..., None].repeat(3, axis=-1)
    return VideoClip(frames, np.arange(FRAMES) / 25.0), np.stack(fluid)


def evidence_of(clip: VideoClip) -> Evidence:
    still = PixelFlow(np.zeros((FRAMES - 1, HEIGHT, WIDTH, 2), np.float32), np.ones((FRAMES - 1, HEIGHT, WIDTH)))
    return gather_evidence(clip, still)


ALL = np.ones((HEIGHT, WIDTH), bool)


def test_a_level_is_told_in_every_frame_though_the_liquid_is_smooth():
    clip, fluid = clip_of()
    evidence, ever = evidence_of(clip), fluid.any(axis=0)
    region = ever.copy()
    region[:, GLASS.start : GLASS.start + 8] = False  # motion has not told all of it
    found = arrivals(evidence, region, ALL)
    assert found is not None
    came = filled(FRAMES - 1) & ~filled(0) & ~np.stack([jet(t) for t in range(FRAMES)]).any(axis=0)
    assert (found.where & came).sum() > 0.9 * came.sum() and not (found.where & ~spread(ever, 1.5)).any()
    for t, bare in enumerate(bare_before(evidence, found)):
        there = found.where & came
        wrong = (bare ^ ~filled(t)) & there
        assert wrong.sum() < 0.06 * there.sum()  # 2 of 50 rows at the wavy level


def test_what_lay_there_before_belongs_to_it():
    clip, fluid = clip_of()
    evidence = evidence_of(clip)
    region = fluid.any(axis=0) & ~filled(0)
    found = arrivals(evidence, region, ALL)
    assert found is not None
    score = np.where(region, 4.0, -2.0).astype(np.float32)
    risen = np.zeros_like(region)
    risen[100:120, GLASS.start - 3 : GLASS.start + 8] = True  # the level, held for something that is carried
    beside = np.zeros_like(region)
    beside[130:145, 60:75] = True
    whole = found.with_what_was_there(evidence, score, region & ~risen, ~risen & ~beside)
    under = filled(0) & ~beside
    assert (whole & under).sum() > 0.95 * under.sum() and (whole & risen & filled(FRAMES)).sum() > 100
    assert not (whole & ~spread(fluid.any(axis=0), 1.5)).any() and not (whole & beside & ~found.where).any()


@pytest.mark.parametrize("how", ["full", "sideways"])
def test_neither_streaming_water_nor_what_comes_from_the_side_is_a_level(how):
    clip, fluid = clip_of(**{how: True})
    assert arrivals(evidence_of(clip), fluid.any(axis=0), ALL) is None


def test_a_jug_that_is_put_down_beside_it_is_none():
    clip, fluid = clip_of(jug=True)
    found = arrivals(evidence_of(clip), fluid.any(axis=0), ALL)
    assert found is not None and not found.where[:, 150:].any()


def flow_of(clip: VideoClip) -> PixelFlow:
    finder = DenseInverseSearch()
    pairs = [flow_of_pair(clip.frames[t], clip.frames[t + 1], finder) for t in range(FRAMES - 1)]
    return PixelFlow(np.stack([p[0] for p in pairs]), np.stack([p[1] for p in pairs]))


@pytest.mark.parametrize("sway", [4.0, 0.0])
def test_a_glass_that_fills_is_fluid_up_to_its_level_in_every_frame(sway):
    clip, fluid = clip_of(sway=sway)
    labels = segment(clip, flow_of(clip)).labels
    overlaps = []
    for t in range(FRAMES):
        here = labels[t] == Label.FLUID
        overlaps.append((here & fluid[t]).sum() / (here | fluid[t]).sum())
    assert np.mean(overlaps) > 0.9 and min(overlaps) > 0.75  # a rim of 1 px is 0.15 of it at first


def test_what_rises_with_no_jet_above_it_is_told_as_smoke_is():
    clip, _ = clip_of(sway=None)
    clues = clues_of(clip, flow_of(clip))
    assert arrivals(clues.evidence, clues.bed.region, clues.inside) is not None
    assert clues.arrivals is None and clues.advances


def test_a_person_who_says_that_it_is_none_is_believed():
    clip, fluid = clip_of()
    flow, place = flow_of(clip), (115, 105)  # in the glass, beside the jet
    assert (segment(clip, flow).labels[-1] == Label.FLUID)[place[1], place[0]]
    labels = segment(clip, flow, points=[(*place, 0)]).labels
    assert not (labels[:, place[1] - 2 : place[1] + 3, place[0] - 2 : place[0] + 3] == Label.FLUID).any()
    assert ((labels[-1] == Label.FLUID) & fluid[-1])[:60].any()
