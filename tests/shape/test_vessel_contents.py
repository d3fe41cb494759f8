from dataclasses import replace

import numpy as np
import pytest

from fluidlift.evaluate.images import mask_iou, resample_nearest
from fluidlift.motion.optical_flow import DenseInverseSearch, flow_of_pair
from fluidlift.shape.evidence import gather_evidence
from fluidlift.shape.segment import clues_of, segment
from fluidlift.shape.vessel_contents import AROUND_IT, filled_vessels, with_contents
from fluidlift.synthetic.vessels import filmed_vessel
from fluidlift.types.clip import Label, VideoClip

FRAMES = 12
SIZE = (240, 180)


def filmed(seed, happening, **more):
    """A made clip with its flow, and the truth."""
    made = filmed_vessel(seed, happening, frames=FRAMES, size=SIZE, **more)
    estimator = DenseInverseSearch()
    pairs = [flow_of_pair(a, b, estimator) for a, b in zip(made.frames, made.frames[1:], strict=False)]
    return VideoClip(made.frames, np.arange(FRAMES) / 25.0, "made"), pairs.__getitem__, made


def fluid_of(clip, flow):
    return segment(clip, flow).labels == Label.FLUID


@pytest.fixture(scope="module")
def poured():
    return filmed(20, "fill")


def test_a_cup_that_fills_is_fluid_up_to_its_level_and_no_higher(poured):
    clip, flow, made = poured
    known = clues_of(clip, flow)
    assert len(known.vessels) == 1
    vessel = known.vessels[0]
    assert vessel.below[0] > vessel.below[-1] + 0.15, "the level rises"
    assert (np.diff(vessel.below) <= 1e-6).all()
    found = fluid_of(clip, flow)
    judged = [mask_iou(found[t] & ~spout(made, t), made.fluid[t]) for t in (2, 6, 9)]
    assert min(judged) > 0.8


def spout(made, t):
    """What is above the cup: the mask of a jet may begin within its spout."""
    return np.arange(made.fluid.shape[1])[:, None] < np.flatnonzero(made.fluid[t].any(axis=1))[0]


def test_quiet_parts_of_what_boils_are_fluid_too():
    clip, flow, made = filmed(21, "boil")
    found = fluid_of(clip, flow)
    assert mask_iou(found[6], made.contents[6]) > 0.9


@pytest.mark.parametrize("happening", ["empty", "beside"])
def test_an_empty_vessel_holds_nothing(happening):
    clip, flow, _ = filmed(3, happening)
    evidence = gather_evidence(clip, flow)
    assert filled_vessels(evidence, np.zeros(evidence.noise.shape, bool)) == ()


def test_what_a_person_said_is_kept(poured):
    clip, flow, _ = poured
    known = clues_of(clip, flow)
    shape = known.evidence.noise.shape
    held = np.zeros(shape, bool)
    held[: shape[0] // 2] = True
    dry = iter([(np.zeros(shape, np.uint8), np.zeros(shape, np.float32))])
    barred = np.zeros(shape, bool)
    labels, _ = next(with_contents(dry, known.vessels, known.evidence, barred, held, alone=False))
    assert not labels[held].any()
    assert (labels[~held] == Label.FLUID).any()


def test_what_drifts_within_the_rim_is_liquid_and_what_swings_in_hides_it(poured):
    clip, flow, _ = poured
    known = clues_of(clip, flow)
    shape = known.evidence.noise.shape
    vessel = known.vessels[0]
    level = vessel.surface(0, shape)
    x, y = vessel.disc.coordinates(shape)
    foam = level & (np.hypot(x, y - 0.6) < 0.15)
    spoon = (np.abs(x) < 0.1) & (y > 0.2)
    assert foam.any() and (spoon & level).any()
    for barred, hidden in ((foam, False), (spoon, True)):
        dry = iter([(np.zeros(shape, np.uint8), np.zeros(shape, np.float32))])
        labels, _ = next(with_contents(dry, known.vessels, known.evidence, barred, barred & False, alone=False))
        assert (labels[barred & level] != Label.FLUID).all() == hidden


@pytest.mark.parametrize(("alone", "fills"), [(True, False), (False, True), (False, False)])
def test_where_the_rest_is_a_guess_or_a_vessel_fills_what_is_apart_from_it_is_left_out(poured, alone, fills):
    clip, flow, _ = poured
    known = clues_of(clip, flow)
    shape = known.evidence.noise.shape
    vessel = known.vessels[0]
    if not fills:
        vessel = replace(vessel, below=np.full_like(vessel.below, vessel.below[0]))
    guessed, nothing = np.zeros(shape, np.uint8), np.zeros(shape, bool)
    guessed[-20:, :20] = Label.FLUID
    found = iter([(guessed, np.zeros(shape, np.float32))])
    labels, _ = next(with_contents(found, (vessel,), known.evidence, nothing, nothing, alone=alone))
    assert (labels[-20:, :20] == Label.FLUID).all() != (alone or fills)
    assert (labels == Label.FLUID).sum() > 400


def test_what_is_poured_from_is_left_out_and_its_jet_stays(poured):
    clip, flow, made = poured
    known = clues_of(clip, flow)
    shape = known.evidence.noise.shape
    nothing, jug = np.zeros(shape, bool), np.zeros(shape, bool)
    fluid = resample_nearest(made.fluid, shape[::-1])
    rows = np.flatnonzero(fluid[0].any(axis=1))[0]
    column = int(np.flatnonzero(fluid[0][rows]).mean())
    jug[: rows + 3, column - 45 : column + 46] = True
    found = iter([(np.where(f | jug, np.uint8(Label.FLUID), np.uint8(0)), np.ones(shape, np.float32)) for f in fluid])
    vessel = known.vessels
    for (labels, _), truth in zip(with_contents(found, vessel, known.evidence, nothing, nothing, alone=False), fluid):
        left = labels == Label.FLUID
        beyond_rim = jug & (np.hypot(*vessel[0].disc.coordinates(shape)) > AROUND_IT[0])
        assert left[beyond_rim].mean() < 0.01, "a jet is no wider above than it is below"
        assert left[truth & ~jug].mean() > 0.95
