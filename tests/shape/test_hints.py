"""What the user says about a mask is read in px of the clip."""

from fluidlift.shape.hints import clicks_at


def test_points_are_read_in_px_of_the_clip_and_used_at_working_size():
    clicks = clicks_at([(511.9, 0.0, 1), (256, 144, 0)], (512, 288), (216, 384))
    assert clicks.fluid.tolist() == [[383, 0]] and clicks.other.tolist() == [[192, 108]]
    assert not clicks_at([], (512, 288), (216, 384))
