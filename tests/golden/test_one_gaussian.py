"""Pictures that are known in closed form."""

import numpy as np

from fluidlift.look.rasterize import render
from fluidlift.numerics.splatting_kernels import ALPHA_MIN, BLUR
from fluidlift.types.camera import PinholeCamera
from fluidlift.types.gaussians import Gaussians

CAMERA = PinholeCamera((200.0, 160.0), (32.0, 24.0), (64, 48))


def falloff(camera: PinholeCamera, center: tuple[float, float], covariance: np.ndarray) -> np.ndarray:
    """exp(-d^T covariance^-1 d / 2) at every pixel centre."""
    d = camera.pixel_grid() - center
    return np.exp(-0.5 * np.einsum("hwi,ij,hwj->hw", d, np.linalg.inv(covariance), d))


def test_one_round_gaussian_on_the_axis_is_an_ellipse_of_known_width():
    sigma, depth, opacity = 0.04, 2.0, 0.8
    color = np.float32([[0.9, 0.4, 0.1]])
    rendered = render(Gaussians.isotropic(np.float32([[0, 0, depth]]), sigma, color, opacity), CAMERA)
    covariance = np.diag([(200 * sigma / depth) ** 2 + BLUR, (160 * sigma / depth) ** 2 + BLUR])
    alpha = opacity * falloff(CAMERA, (32, 24), covariance)
    alpha = np.where(alpha < ALPHA_MIN, 0, alpha)
    # exponential good to 1e-6
    np.testing.assert_allclose(rendered.alpha, alpha, atol=3e-6)
    np.testing.assert_allclose(rendered.image, alpha[..., None] * color[0], atol=3e-6)
    np.testing.assert_allclose(rendered.depth[alpha > 0.1], depth, rtol=1e-5)
    assert (rendered.depth[alpha == 0] == 0).all()


def test_a_turned_needle_lies_along_its_axis():
    angle = np.radians(30.0)
    quat = np.float32(
        [[np.cos(angle / 2), 0, 0, np.sin(angle / 2)]]
    )  # about z: from x towards y, downwards in the picture
    g = Gaussians(
        np.float32([[0, 0, 2]]), quat, np.float32([[0.1, 0.01, 0.01]]), np.float32([0.5]), np.zeros((1, 1, 3))
    )
    c, s = np.cos(angle), np.sin(angle)
    turn = np.array([[c, -s], [s, c]])
    covariance = turn @ np.diag([0.1**2, 0.01**2]) @ turn.T
    scale = np.diag([200 / 2, 160 / 2])
    expected = 0.5 * falloff(CAMERA, (32, 24), scale @ covariance @ scale + BLUR * np.eye(2))
    expected[expected < ALPHA_MIN] = 0
    # the cut makes a jump of 1/255 where the two round differently
    assert np.mean(np.abs(render(g, CAMERA).alpha - expected) > 3e-6) < 2e-3


def test_two_layers_over_a_background_mix_as_paint_does():
    means = np.float32([[0, 0, 3], [0, 0, 2]])  # the far one comes first in the list
    colors = np.float32([[0, 1, 0], [1, 0, 0]])
    g = Gaussians.isotropic(means, 10.0, colors, np.float32([0.5, 0.25]))
    at = render(g, CAMERA, background=(0.2, 0.4, 0.6))
    near, far, behind = 0.25, 0.75 * 0.5, 0.75 * 0.5
    # pixel (24, 32) is half a pixel off the axis: the falloff of a quarter of the picture is 5e-4 there
    np.testing.assert_allclose(
        at.image[24, 32], near * colors[1] + far * colors[0] + behind * np.float32([0.2, 0.4, 0.6]), atol=1.5e-3
    )
    np.testing.assert_allclose(at.depth[24, 32], (near * 2 + far * 3) / (near + far), atol=3e-3)
