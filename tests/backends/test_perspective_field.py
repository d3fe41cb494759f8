"""A camera is found from its perspective field, whatever a part of the picture says."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from fluidlift.backends.perspective_field import PerspectiveField, field_of_camera, fitted_view
from fluidlift.shape.kind import level_camera
from fluidlift.types import PinholeCamera, UpEvidence

SIZE = (160, 96)


def camera(pitch: float, roll: float, fov: float) -> PinholeCamera:
    return level_camera(PinholeCamera.from_fov(fov, SIZE), UpEvidence(pitch, roll, "", 1.0))


@pytest.mark.parametrize(("pitch", "roll"), [(0.0, 0.0), (25.0, 0.0), (-10.0, 6.0), (60.0, -8.0)])
def test_the_field_is_what_our_own_camera_sees(pitch, roll):
    """Up is where a point's image goes when the point rises; the latitude is the angle of its ray above the level."""
    ours = camera(pitch, roll, 55.0)
    field = field_of_camera(pitch, roll, ours.focal[0], SIZE)
    for row, column in ((3, 5), (48, 80), (90, 150)):
        at = np.array([[column + 0.5, row + 0.5]])
        point = ours.unproject(at, np.array([2.0]))
        moved = ours.project(point + np.array([[0.0, 0.0, 1e-4]]))[0] - at
        way = (moved / np.linalg.norm(moved))[0]
        np.testing.assert_allclose(field.up[row, column], way, atol=1e-3)  # a finite step
        assert field.latitude[row, column] == pytest.approx(point[0, 2] / np.linalg.norm(point), abs=1e-9)


@pytest.mark.parametrize("pitch", [-30.0, 0.0, 12.0, 45.0, 80.0])
@pytest.mark.parametrize("roll", [-15.0, 0.0, 5.0])
@pytest.mark.parametrize("fov", [30.0, 55.0, 100.0])
def test_tilt_and_focal_length_are_found(pitch, roll, fov):
    focal = camera(pitch, roll, fov).focal[0]
    found = fitted_view(field_of_camera(pitch, roll, focal, SIZE))
    assert found is not None
    assert (found.pitch, found.roll) == pytest.approx((pitch, roll), abs=0.02)  # the search ends at 1e-9 of its cost
    assert found.focal == pytest.approx(focal, rel=1e-3)


def test_noise_and_a_third_of_nonsense_are_outvoted():
    """The network trusts least where it sees least; what it trusts by mistake counts by its length, not its square."""
    rng = np.random.default_rng(0)
    field = field_of_camera(20.0, 4.0, 150.0, SIZE)
    up = field.up + rng.normal(0, 0.1, field.up.shape)
    other = field_of_camera(-20.0, -30.0, 80.0, SIZE)
    up[:, :50], latitude = other.up[:, :50], field.latitude + rng.normal(0, 0.05, field.latitude.shape)
    latitude[:, :50] = other.latitude[:, :50]
    trust = np.ones_like(latitude)
    trust[:, :50] = 0.2
    seen = PerspectiveField(up / np.linalg.norm(up, axis=-1, keepdims=True), trust, latitude.clip(-1, 1), trust)
    found = fitted_view(seen)
    assert found is not None
    assert (found.pitch, found.roll) == pytest.approx((20.0, 4.0), abs=1.0)
    assert found.focal == pytest.approx(150.0, rel=0.05)


def test_a_known_focal_length_is_kept():
    found = fitted_view(field_of_camera(30.0, 0.0, 150.0, SIZE), focal=120.0)
    assert found is not None and found.focal == pytest.approx(120.0)
    assert (found.covariance[2] == 0).all() and (np.diagonal(found.covariance)[:2] > 0).all()
    assert found.pitch == pytest.approx(30.0, abs=6.0)  # the middle of the picture says it whatever the lens


def test_less_trust_is_a_larger_error_and_none_is_no_answer():
    field = field_of_camera(10.0, 0.0, 150.0, SIZE)
    errors = []
    for trust in (1.0, 0.01):
        least = np.full_like(field.latitude, trust)
        found = fitted_view(replace(field, up_trust=least, latitude_trust=least))
        assert found is not None
        errors.append(np.sqrt(found.covariance[0, 0]))
    assert errors[1] == pytest.approx(10.0 * errors[0], rel=1e-3)  # a hundredth of the weight
    nothing = np.zeros_like(field.latitude)
    assert fitted_view(replace(field, up_trust=nothing, latitude_trust=nothing)) is None
    assert fitted_view(replace(field, latitude=np.full_like(field.latitude, np.nan))) is None


def test_a_wider_lens_raises_the_pitch_that_a_low_horizon_means():
    """The horizon's row fixes pitch and focal length together: the covariance says by how much."""
    field = field_of_camera(20.0, 0.0, 150.0, SIZE)
    found = fitted_view(field)
    assert found is not None
    rows = np.abs(field.latitude) < 0.15  # only near the horizon is anything seen
    trust = rows.astype(float)
    near = fitted_view(replace(field, up_trust=1e-6 * np.ones_like(trust), latitude_trust=trust))
    assert near is not None
    by_focal = near.covariance[0, 2] / near.covariance[2, 2]
    # tan(pitch) = row / f: d pitch / d log f = - sin(2 pitch) / 2
    assert by_focal == pytest.approx(-np.degrees(0.5 * np.sin(np.radians(40.0))), rel=0.3)  # rays beside it count too
