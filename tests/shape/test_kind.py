"""What kind of fluid it is and where up is, from moving masks whose truth is known."""

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from fluidlift.shape.kind import (
    FEWEST_PAIRS,
    KINDS,
    SHAKE,
    doubts,
    drawn_down,
    estimate_kind,
    estimate_up,
    level_camera,
    swinging,
)
from fluidlift.shape.view.roundness import Ellipse, fit_ellipse
from fluidlift.types import KindEvidence, PinholeCamera, UpEvidence, kind_of

H, W, T = 90, 160, 6
BLUE, GREY = (60, 110, 160), (150, 150, 150)
ROW, COL = np.mgrid[:H, :W]


def scene(masks, move, colour):
    """frames, masks, mean displacement and confidence of a fluid of one colour and one motion."""
    masks = np.broadcast_to(masks, (T, H, W)).copy()
    frames = np.full((T, H, W, 3), 90, np.uint8)
    frames[masks] = colour
    wet = masks.any(axis=0)
    displacement = np.where(wet[..., None], np.asarray(move, np.float32), 0.0)
    return frames, masks, displacement, np.where(wet, 1.0, 0.0)


def river(move=(3.0, 0.2)):
    return scene((ROW > 35) & (ROW < 75), move, BLUE)


def jet():
    return scene((np.abs(COL - 80) < 6) & (ROW < 80), (0.0, 4.0), BLUE)


def curtain():
    return scene((np.abs(COL - 80) < 45) & (ROW > 12) & (ROW < 75), (0.1, 4.0), BLUE)


def smoke():
    """A grey blob that grows upwards from its source near the foot of the picture and billows."""
    rng = np.random.default_rng(0)
    masks = []
    for t in range(T):
        top = 70 - 9 * (t + 1)
        edge = 10 + 6 * np.sin(ROW / 5.0 + 2.1 * t) + 0.15 * (80 - ROW) + rng.uniform(-2, 2)
        masks.append((np.abs(COL - 80) < edge) & (ROW > top) & (ROW < 80))
    return scene(np.stack(masks), (0.2, -2.5), GREY)


def dam(top=25, edge=0):
    """A block that becomes a layer of twice its width, `edge` px below the picture's upper border at most."""
    masks = []
    for t in range(T):
        height, right = round(50 * 60 / (60 + 15 * t)), 10 + 60 + 15 * t
        masks.append((ROW < top + 50) & (ROW >= max(top + 50 - height, edge)) & (COL > 10) & (COL < right))
    return scene(np.stack(masks), (2.0, 0.8), BLUE)


@pytest.mark.parametrize(
    ("clip", "kind"),
    [(river, "stream"), (jet, "pour"), (curtain, "fall"), (smoke, "plume"), (dam, "dam")],
)
def test_the_kind_is_what_the_fluid_does(clip, kind):
    found = estimate_kind(*clip())
    assert found.kind == kind, (found.scores, found.features)


@pytest.mark.parametrize("rising", [0.7, 1.0])
def test_what_hangs_from_above_is_no_pour_where_all_of_it_goes_up(rising):
    """Steam that leaves the picture at its top; of a jet that moves by more than its pattern only a part seems to."""
    frames, masks, displacement, trust = scene((np.abs(COL - 80) < 12) & (ROW < 55), (0.0, -3.0), (190, 130, 100))
    displacement[ROW < 55 * (1.0 - rising)] *= -1.0
    scores = estimate_kind(frames, masks, displacement, trust).scores
    assert (scores["pour"] < scores["plume"]) == (rising == 1.0), scores


def test_what_is_wider_below_is_no_smoke_though_bubbles_rise_in_it():
    """Water in a glass below its jet, and the same upside down: smoke from a stick that widens on its way up."""
    glass = (np.abs(COL - 80) < np.where(ROW < 50, 6, 24)) & (ROW < 84)
    below, above = (estimate_kind(*scene(m, (0.0, -3.0), GREY)) for m in (glass, (glass & (ROW > 6))[::-1]))
    assert below.features["wider below"] == 1.0
    assert above.features["wider below"] == 0.0
    assert above.kind == "plume"
    assert below.scores["plume"] < 0.5 * above.scores["plume"]


@pytest.mark.parametrize("top", [0, 20])
def test_what_is_wide_is_no_stream_where_all_of_it_goes_up_and_out_at_the_top(top):
    """Steam over a cup, in warm light; water that recedes does so below the sky and the far bank."""
    clip = scene((np.abs(COL - 80) < 55) & (ROW >= top) & (ROW < top + 45), (0.0, -3.0), (190, 130, 100))
    scores = estimate_kind(*clip).scores
    assert (scores["plume"] > scores["stream"]) == (top == 0), scores


def rippled(clip, down, across):
    """The clip with a pattern that changes all over, of ripples some px long down and across the picture."""
    frames, masks, *flow = clip
    noise = gaussian_filter(np.random.default_rng(0).normal(size=(T, H, W)), (0.0, down, across), mode="wrap")
    shown = np.clip(frames + (20.0 / noise.std() * noise)[..., None], 0, 255).astype(np.uint8)
    return np.where(masks[..., None], shown, frames), masks, *flow


@pytest.mark.parametrize(("down", "across", "low", "high"), [(1, 3, -3, -1), (3, 1, 1, 3), (2, 2, -0.2, 0.2)])
def test_a_pattern_is_drawn_out_the_way_it_is_longer(down, across, low, high):
    frames, masks, *_ = rippled(curtain(), down, across)
    assert low < drawn_down(frames, masks) < high
    # what stands still counts for nothing: a bed, a mirrored bank
    bed = gaussian_filter(np.random.default_rng(1).normal(size=(H, W)), (across, down))
    with_bed = np.clip(frames.astype(float) + (10.0 / bed.std() * bed)[..., None], 0, 255).astype(np.uint8)
    assert drawn_down(with_bed, masks) == pytest.approx(drawn_down(frames, masks), abs=0.2)
    still = np.broadcast_to(with_bed[0], frames.shape)
    assert drawn_down(still, masks) == 0.0


def test_ripples_across_the_picture_lie_and_do_not_fall():
    lying, plain, falling = (estimate_kind(*c) for c in (rippled(curtain(), 1, 3), curtain(), rippled(curtain(), 3, 1)))
    assert lying.scores["fall"] < plain.scores["fall"] < falling.scores["fall"]
    assert lying.scores["stream"] > 3.0 * plain.scores["stream"]


def towards_the_viewer(near=4.0, far=0.2, length=None):
    """A curtain's outline and motion, with a pattern that moves by `far` px per frame at its top and `near` below;
    where it recedes, seen at a slant, it is foreshortened. `length` of the pattern down the picture over 2 px across,
    in px; None: as it is seen."""
    frames, masks, *flow = curtain()
    length = length or (2.0 if far >= near else 1.0)
    pattern = gaussian_filter(np.random.default_rng(0).normal(size=(H, W)), (length, 2.0), mode="wrap")
    pattern *= 30.0 / pattern.std()
    step = np.interp(np.arange(H), [12, 75], [far, near])
    for t in range(T):
        moved = [np.interp(np.arange(W) - step[y] * t, np.arange(W), pattern[y], period=W) for y in range(H)]
        frames[t] = np.where(masks[t][..., None], np.clip(frames[t] + np.stack(moved)[..., None], 0, 255), frames[t])
    return frames, masks, *flow


def test_what_recedes_comes_towards_the_viewer_and_does_not_fall():
    lying, upright = (estimate_kind(*towards_the_viewer(far=far)) for far in (0.2, 4.0))
    assert lying.features["receding"] > 0.8
    assert upright.features["receding"] == 0.0
    assert upright.kind == "fall"
    assert lying.scores["fall"] < 0.5 * upright.scores["fall"]
    assert lying.scores["stream"] > 2.0 * upright.scores["stream"]


def test_what_draws_its_pattern_out_downwards_falls_though_it_seems_to_recede():
    """A curtain that breaks up on its way down has the finer pattern above, as what is farther away has."""
    threads = estimate_kind(*towards_the_viewer(length=6.0))
    assert threads.features["receding"] > 0.8
    assert threads.features["falling"] > 0.5
    assert threads.kind == "fall"


def poured_into_a_tray():
    """A pool that fills half the picture; from the foot of a jet at its far side it spreads downwards as 1 / r."""
    pool = ((ROW - 50) / 36.0) ** 2 + ((COL - 80) / 60.0) ** 2 < 1
    frames, masks, _, trust = scene(pool, (0.0, 1.0), (190, 130, 60))
    r = np.stack([COL - 80.0, ROW - 18.0], axis=-1)
    away = np.maximum(np.linalg.norm(r, axis=-1, keepdims=True), 4.0)
    outward = np.where((ROW > 18)[..., None] & (np.abs(r[..., :1]) < 0.5 * r[..., 1:]), 20.0 * r / away**2, 0.0)
    return frames, masks, np.where(masks[0][..., None], outward, 0.0), trust


def test_what_spreads_in_its_pool_and_slows_down_does_not_fall(monkeypatch):
    found = estimate_kind(*rippled(poured_into_a_tray(), 1, 2))
    assert found.features["spreading"] > 0.9
    assert found.kind == "stream" and found.scores["stream"] > 0.6, found.scores
    assert estimate_kind(*curtain()).features["spreading"] == 0.0
    monkeypatch.setattr("fluidlift.shape.kind.spreading", lambda *_: 0.0)
    assert estimate_kind(*poured_into_a_tray()).kind == "fall", "its speed is what tells them apart"


def to_and_fro(pairs=30, mean=0.0, swing=1.0):
    """Bulk motion, px per frame, of water and ground: a wave over a current, seen for a period and a half."""
    time = np.linspace(0.0, 3.0 * np.pi, pairs)
    return np.stack([0.2 * np.cos(time), mean + swing * np.sin(time)], axis=-1), np.zeros((pairs, 2))


def pot():
    """Water in an upright round vessel, looked down on."""
    return scene(np.hypot(ROW - 45, (COL - 80) / 1.5) < 25, (1.0, 0.2), BLUE)


@pytest.mark.parametrize("clip", [river, pot])
def test_water_that_moves_to_and_fro_stays(clip):
    wavy, steady = estimate_kind(*clip(), bulk=to_and_fro()), estimate_kind(*clip(), bulk=to_and_fro(mean=3.0))
    assert wavy.kind == "basin" and wavy.scores["basin"] > 0.6, wavy.scores
    assert steady.kind == "stream" and steady.scores["basin"] < 0.15, steady.scores
    assert estimate_kind(*clip()).kind == "stream", "nothing is known of how it changes"


@pytest.mark.parametrize("clip", [jet, curtain, smoke, dam])
def test_what_falls_rises_or_collapses_does_not_stay_however_it_swings(clip):
    plain, wavy = estimate_kind(*clip()), estimate_kind(*clip(), bulk=to_and_fro())
    assert wavy.kind == plain.kind, wavy.scores


def test_what_is_stirred_in_a_vessel_stays_and_a_bend_of_a_river_does_not():
    frames, masks, _, trust = pot()
    whirl = np.where(masks[0][..., None], np.stack([-(ROW - 45.0) * 1.5, (COL - 80.0) / 1.5], axis=-1) / 12.0, 0.0)
    stirred = estimate_kind(frames, masks, whirl, trust, bulk=to_and_fro(swing=0.0))
    assert stirred.features["circling"] > 0.9 and stirred.kind == "basin", stirred.scores
    assert estimate_kind(*pot()).features["circling"] == 0.0
    frames, masks, _, trust = river()
    bend = np.where(masks[0][..., None], np.stack([np.full((H, W), 3.0), (COL - 80.0) / 40.0], axis=-1), 0.0)
    assert estimate_kind(frames, masks, bend, trust, bulk=to_and_fro(mean=3.0, swing=0.0)).kind == "stream"


def test_what_swings_is_not_a_shake_nor_a_few_frames():
    rng = np.random.default_rng(0)
    water, ground = to_and_fro()
    assert swinging(water, ground) > 0.9
    assert swinging(rng.normal(0.0, SHAKE, (30, 2)) + [0.05, 0.0], ground) < 0.5
    assert swinging(rng.normal(0.0, SHAKE, (30, 2)) + [1.0, 0.0], ground) < 0.01
    jumps = np.where(np.arange(60)[:, None] % 20 == 5, [0.0, 4.0], [0.1, 0.1])  # frames left out of a slow stream
    assert swinging(jumps, np.zeros((60, 2))) < 0.01
    assert swinging(*to_and_fro(FEWEST_PAIRS - 1)) == 0.0
    assert swinging(water + [0.3, 0.0], water) < 0.01, "all of the picture does, and the water runs on"
    assert swinging(ground + [0.3, 0.0], water) < 0.01, "only the ground does"
    gaps = water.copy()
    gaps[::3] = np.nan
    assert swinging(gaps, ground * np.nan) == pytest.approx(swinging(water, ground), abs=0.05)


def test_what_falls_so_slowly_that_it_is_followed_is_no_pour():
    """A strand three times as tall as wide that comes in above: metres high if optical flow follows it, else a jet."""
    strand = (np.abs(COL - 80) < 13) & (ROW < 80)
    frames, masks, move, _ = scene(strand, (0.0, 3.0), BLUE)
    seen = [estimate_kind(frames, masks, move, np.where(strand, trust, 0.0)) for trust in (0.8, 0.1)]
    assert [s.kind for s in seen] == ["fall", "pour"], [s.scores for s in seen]
    assert [s.features["followed"] for s in seen] == [1.0, 0.0]
    assert estimate_kind(*jet()).features["followed"] == 1.0, "a slender one stays a pour all the same"


def test_what_is_fed_from_the_upper_border_is_no_dam():
    block = dam(top=-2)
    assert block[1][:, 0].any()
    assert estimate_kind(*block).features["collapsing"] == 0.0
    assert estimate_kind(*dam()).features["collapsing"] > 0.8
    backwards = [x[::-1] if x.ndim == 4 or x.shape[0] == T else x for x in dam()]
    assert estimate_kind(*backwards).features["collapsing"] == 0.0  # a body that rises out of a layer


def test_a_body_comes_down_where_it_stood_whatever_is_seen_higher_elsewhere():
    away = dam()
    spread = ~away[1][0] & (COL > 68) & (ROW < 75)
    for t, top in enumerate((50, 40, 30, 22, 18, 18)):  # ground further away, and a wave at the wall behind it
        away[1][t] |= spread & (COL < 70 + 15 * t) & (ROW >= top)
    away[0][away[1]] = BLUE
    assert away[1][-1][:25].any() and not away[1][0][:25].any()
    assert estimate_kind(*away).kind == "dam"


def test_a_body_that_moves_on_has_not_collapsed():
    masks = np.stack([(ROW > 25) & (ROW < 75) & (COL > 10 + 14 * t) & (COL < 60 + 14 * t) for t in range(T)])
    assert estimate_kind(*scene(masks, (5.0, 0.5), BLUE)).features["collapsing"] == 0.0


def test_a_kind_that_is_unsure_is_told_with_the_next_one():
    sure = KindEvidence("fall", {"fall": 0.8, "stream": 0.15, "pour": 0.05}, {})
    torn = KindEvidence("fall", {"stream": 0.4, "fall": 0.5, "pour": 0.1}, {})
    assert doubts(sure, "fall") == ()
    (told,) = doubts(torn, "stream")
    assert "fall (0.50) or stream (0.40)" in told and "built as stream, and --kind decides" in told


def test_beliefs_are_shares_and_the_kind_has_the_largest():
    found = estimate_kind(*river())
    assert set(found.scores) == set(KINDS)
    assert sum(found.scores.values()) == pytest.approx(1.0)
    assert found.kind == max(found.scores, key=found.scores.get)


@pytest.mark.parametrize(
    ("clip", "feature"),
    [(river, "sideways"), (jet, "slender"), (jet, "hanging"), (curtain, "falling"), (smoke, "rising")],
)
def test_the_evidence_names_what_is_seen(clip, feature):
    assert estimate_kind(*clip()).features[feature] > 0.8


def test_the_motion_decides_not_its_direction_across_the_picture():
    assert estimate_kind(*river((-3.0, 0.2))).kind == "stream"


def test_a_steep_view_speaks_for_a_stream_and_a_level_one_against_it():
    share = {p: estimate_kind(*curtain(), pitch=p).scores["stream"] for p in (None, 5.0, 60.0)}
    assert share[5.0] < share[None] < share[60.0]


def test_a_fluid_that_no_flow_was_found_on_still_gets_a_kind():
    frames, masks, displacement, _ = river()
    found = estimate_kind(frames, masks, 0 * displacement, np.zeros((H, W)))
    assert found.kind in KINDS
    assert np.isfinite(list(found.scores.values())).all()


def test_masks_belong_to_their_frames():
    frames, masks, displacement, confidence = river()
    with pytest.raises(ValueError, match="masks"):
        estimate_kind(frames, masks[1:], displacement, confidence)


# up -------------------------------------------------------------------------------------------------------------

CAMERA = PinholeCamera.from_fov(50.0, (W, H))


def plane_flow(pitch, velocity=(0.02, 0.01), rows=(20, 90)):
    """Exact image motion of a level plane one unit below a camera of known pitch: mask, displacement."""
    camera = level_camera(CAMERA, UpEvidence(pitch, 0.0, "", 1.0))
    grid = camera.pixel_grid()
    down = -camera.rays(grid)[..., 2]
    mask = (down > 0.05) & (ROW >= rows[0]) & (ROW < rows[1])
    depth = 1.0 / np.where(mask, down, 1.0)
    later, _ = camera.project(camera.unproject(grid, depth) + [*velocity, 0.0])
    return mask, np.where(mask[..., None], later - grid, 0.0)


@pytest.mark.parametrize("pitch", [20.0, 35.0, 50.0])
@pytest.mark.parametrize("velocity", [(0.02, 0.0), (0.015, -0.015)], ids=["across", "towards"])
def test_the_perspective_of_the_flow_gives_the_tilt(pitch, velocity):
    mask, displacement = plane_flow(pitch, velocity)
    up = estimate_up("stream", mask, displacement, np.ones((H, W)), CAMERA)
    # tilts are tried in steps of 2 degrees, and the prior (35 +- 15) pulls by a few degrees even on exact flow
    assert up.pitch == pytest.approx(pitch, abs=5.0)
    assert up.confidence > 0.1
    assert "perspective" in up.source


def test_without_flow_the_usual_view_remains():
    mask, displacement = plane_flow(20.0)
    up = estimate_up("stream", mask, displacement, np.zeros((H, W)), CAMERA)
    habits = kind_of("stream").pitch_habits
    assert habits[0][1] < up.pitch < habits[1][1]  # between those who look over a landscape and those who look down
    assert up.error > 15.0
    assert up.confidence < 0.2


def test_what_the_user_says_wins():
    mask, displacement = plane_flow(20.0)
    up = estimate_up("stream", mask, displacement, np.ones((H, W)), CAMERA, given=(61.5, -3.0))
    assert (up.pitch, up.roll, up.source, up.confidence) == (61.5, -3.0, "user", 1.0)
    only_roll = estimate_up("stream", mask, displacement, np.ones((H, W)), CAMERA, given=(None, 4.0))
    free = estimate_up("stream", mask, displacement, np.ones((H, W)), CAMERA)
    assert only_roll.roll == 4.0 and only_roll.pitch == free.pitch and "user" in only_roll.source


def seen_down(roll):
    """Direction of the vertical, downwards, in the picture of a level camera with this roll."""
    camera = level_camera(CAMERA, UpEvidence(0.0, roll, "", 1.0))
    middle = camera.unproject(np.array([80.0, 45.0]), 3.0)
    uv, _ = camera.project(middle[None] - [[0, 0, 0.1]])
    return (uv[0] - [80, 45]) / np.linalg.norm(uv[0] - [80, 45])


def test_in_a_picture_turned_clockwise_things_fall_to_the_lower_left():
    np.testing.assert_allclose(seen_down(0.0), [0, 1], atol=1e-12)
    np.testing.assert_allclose(seen_down(6.0), [-np.sin(np.radians(6)), np.cos(np.radians(6))], atol=1e-12)


@pytest.mark.parametrize("kind", ["pour", "fall"])
def test_the_direction_of_the_fall_gives_the_roll(kind):
    displacement = np.broadcast_to(3.0 * seen_down(6.0), (H, W, 2))
    up = estimate_up(kind, np.abs(COL - 80) < 10, displacement, np.ones((H, W)), CAMERA)
    assert up.roll == pytest.approx(3.0, abs=1e-6)  # half of the lean is believed: the other half may be the fluid's
    assert up.pitch == pytest.approx(usual_view(kind), abs=0.01)  # which says nothing of how far down it looks


def usual_view(kind):
    """Pitch without any motion."""
    nothing = np.zeros((H, W))
    return estimate_up(kind, nothing > 0, np.zeros((H, W, 2)), nothing, CAMERA).pitch


def test_smoke_that_leans_does_not_turn_the_camera():
    up = estimate_up("plume", np.abs(COL - 80) < 10, np.broadcast_to([0.3, -3.0], (H, W, 2)), np.ones((H, W)), CAMERA)
    assert (up.roll, up.pitch) == pytest.approx((0.0, usual_view("plume")), abs=0.01)


def test_a_thrown_jet_does_not_turn_the_camera():
    up = estimate_up("pour", np.abs(COL - 80) < 10, np.broadcast_to([2.0, 3.0], (H, W, 2)), np.ones((H, W)), CAMERA)
    assert up.roll == pytest.approx(0.0, abs=1e-9)


def test_a_level_camera_sees_the_vertical_upright_and_the_horizon_at_its_pitch():
    camera = level_camera(CAMERA, UpEvidence(30.0, 0.0, "", 1.0))
    np.testing.assert_array_equal(camera.position, np.zeros(3))
    forward = camera.camera_from_world.rotation[2]
    assert np.degrees(np.arcsin(-forward[2])) == pytest.approx(30.0)
    horizon, _ = camera.project(np.array([[0.0, 1.0, 0.0]]))  # straight ahead at eye level
    np.testing.assert_allclose(horizon[0], [W / 2, H / 2 - CAMERA.focal[1] * np.tan(np.radians(30.0))])
    rolled = level_camera(CAMERA, UpEvidence(30.0, 10.0, "", 1.0)).camera_from_world.rotation
    np.testing.assert_allclose(rolled @ rolled.T, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(rolled[2], forward, atol=1e-12)  # turned about the line of sight


def test_what_lies_in_a_vessel_is_hardly_a_stream():
    frames, masks, *flow = pot()
    rim = fit_ellipse(masks[0])
    seen, plain = (estimate_kind(frames, masks, *flow, rims=rims).scores for rims in ((rim,), ()))
    odds = [scores["stream"] / (scores["basin"] + scores["pour"]) for scores in (plain, seen)]
    assert odds[0] > 8.0 * odds[1] and plain["basin"] < seen["basin"] > seen["fall"], (plain, seen)
    beside = Ellipse((20.0, 20.0), rim.covariance / 16.0, 1.0)
    assert estimate_kind(frames, masks, *flow, rims=(beside,)).scores == plain


def test_what_rises_as_a_whole_has_edges_where_it_is_a_liquid_and_none_where_it_is_smoke():
    """A jet whose pattern moves by more than itself between two frames seems to go up."""
    rng = np.random.default_rng(0)
    frames, *rest = scene((np.abs(COL - 80) < 9) & (ROW < 70), (0.0, -3.0), GREY)
    scores = []
    for grain in (0.7, 8.0):  # px
        pattern = gaussian_filter(rng.normal(size=(T, H, W)), (0.0, grain, grain))
        drawn = np.clip(frames + 30.0 * (pattern / pattern.std() * rest[0])[..., None], 0, 255).astype(np.uint8)
        found = estimate_kind(drawn, *rest)
        scores.append((round(found.features["sharp"]), found.scores["pour"] > found.scores["plume"]))
    assert scores == [(1, True), (0, False)]
