"""The velocities that the fit gets, and what was seen of them."""

import numpy as np

from fluidlift.config import build_config
from fluidlift.motion.sequence import MotionOptions
from fluidlift.pipeline.settings import MotionSettings
from fluidlift.pipeline.volume_motion import motion_options, motion_scene, motion_warnings, seen_cells
from fluidlift.types import Grid, SurfaceMotion

GRID = Grid((4, 3, 2), 0.5, (0.0, 0.0, 0.0))


def options(*overrides):
    """Of a job with these settings."""
    return motion_options(MotionSettings.of(build_config(overrides=overrides)))


def test_the_settings_say_what_the_motion_does_by_itself():
    assert options() == MotionOptions()


def test_the_settings_reach_the_motion():
    found = options("motion.wall=log", "motion.half_window=9", "motion.divergence=paper")
    assert (found.wall, found.half_window, found.divergence) == ("log", 9, "paper")
    assert found.reach >= found.half_window


def test_cells_with_an_observed_point_are_seen():
    points = np.array([[0.1, 0.1, 0.1], [1.6, 1.2, 0.9], [9.0, 0.0, 0.0], [0.6, 0.6, 0.6]])
    surface = SurfaceMotion(points, np.zeros((4, 3)), np.array([True, True, True, False]))
    assert np.argwhere(seen_cells(surface, GRID)).tolist() == [[0, 0, 0], [3, 2, 1]]


def test_every_target_says_which_cells_were_seen(finished):
    targets = finished.lift.motion.targets
    assert len(targets) == 2
    for target in targets:
        assert target.seen.shape == target.velocity.shape and 0 < target.seen.sum() < target.seen.size


def test_completed_flow_is_kept_for_the_wanted_frames_alone(finished):
    completed = finished.lift.motion.completed
    known = np.isfinite(np.asarray(completed, np.float32)).all(axis=(1, 2, 3))
    assert set(finished.lift.motion.frames) <= set(np.flatnonzero(known)) != set(range(len(completed)))


def test_a_fluid_that_was_hardly_measured_is_told():
    rows = [{"frame": t, "observed_share": share} for t, share in enumerate((0.04, 0.03, 0.9))]
    (told,) = motion_warnings(rows, "stream", 0.0)
    assert "4 % of the fluid only" in told
    assert not motion_warnings([{"frame": 0, "observed_share": 0.3}, {"frame": 1, "observed_share": None}], "fall", 0.0)


def test_every_target_says_how_much_of_the_fluid_was_measured(finished):
    shares = [t.observed_share for t in finished.lift.motion.targets]
    assert len(shares) == 2 and all(0.0 < share <= 1.0 for share in shares)


def test_frames_whose_solve_failed_are_named():
    reports = [{"frame": t, "solve": {"converged": t != 3}} for t in range(5)]
    (said,) = motion_warnings(reports, "stream", 0.0)
    assert "1 of 5, the first is 3" in said
    assert motion_warnings(reports[:3], "stream", 0.0) == []
    assert "free fall" in motion_warnings([], "fall", 0.5)[0]


def test_a_surface_that_the_volume_contradicts_is_said():
    def said(*changes):
        return motion_warnings([{"frame": 0, "change_observed": c} for c in changes], "stream", 0.0)

    assert "do not agree on one discharge" in said(0.4, 0.6, 0.9)[0]
    assert said(0.4, 0.2, 0.9) == [] == said()  # the median counts


def test_the_mean_motion_of_the_clip_stands_by(finished):
    scene = motion_scene(finished.lift.clip, finished.lift.geometry)
    assert scene.prior is not None
    np.testing.assert_array_equal(scene.prior[0], finished.lift.geometry.mean_flow)


def test_the_film_is_a_wall_that_can_be_chosen():
    assert options("motion.wall=film").wall == "film"


def test_what_is_taken_for_waves_is_said_of_a_fountain_as_of_its_pool():
    reports = [{"frame": 0, "observed_share": 0.5, "circulating": 0.1}]
    (sea,), (fountain,) = (motion_warnings(reports, kind, 0.0) for kind in ("basin", "fountain"))
    assert "over the basin is taken for waves" in sea and "calm but for that, and" in sea
    assert "over the pool of the fountain is" in fountain and "but for that and what falls into it, and" in fountain
