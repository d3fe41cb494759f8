"""A known body without any symmetry, written as each generator writes it, comes out upright, not mirrored, of the right
size and colours, and its camera shows it in the original picture where it was."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from fluidlift.backends import align_view, lgm, sharp, trellis, triplane_gaussian, triposplat
from fluidlift.backends.generator_view import tilted
from fluidlift.errors import FluidliftError
from fluidlift.io.ply import read_splats
from fluidlift.look.rasterize import render
from fluidlift.shape.external_body import canonical_from_given, near_and_far
from fluidlift.shape.registration import pose_up
from fluidlift.types import (
    SH_C0,
    Gaussians,
    PinholeCamera,
    RigidTransform,
    Similarity3,
    concatenate,
    matrix_from_quat,
    sh_from_rgb,
)

PICTURE = (360, 260)
RED, GREEN, BLUE, YELLOW = (0.85, 0.2, 0.1), (0.1, 0.65, 0.2), (0.15, 0.25, 0.85), (0.85, 0.75, 0.1)
PARTS = (  # colour, middle, half extent: a long bar to the right, an arm away, a tower on the left, a lump in front
    (RED, (0.0, 0.0, -0.2), (0.40, 0.08, 0.07)),
    (GREEN, (0.32, 0.18, -0.15), (0.07, 0.20, 0.10)),
    (BLUE, (-0.30, 0.0, 0.05), (0.07, 0.07, 0.25)),
    (YELLOW, (0.10, -0.14, -0.18), (0.06, 0.06, 0.05)),
)


def known_body(degree: int = 0) -> Gaussians:
    """Some 0.8 across about the origin: x right, y away from the viewer, z up."""
    rng, parts = np.random.default_rng(3), []
    for colour, middle, extent in PARTS:
        n = 300
        means = np.array(middle) + rng.uniform(-1, 1, (n, 3)) * extent
        quats = rng.normal(size=(n, 4))
        sh = np.zeros((n, (degree + 1) ** 2, 3), np.float32)
        sh[:, :1] = sh_from_rgb(np.clip(np.array(colour) + rng.normal(0, 0.05, (n, 3)), 0.02, 0.98))
        sh[:, 1:] = rng.normal(0, 0.1, sh[:, 1:].shape)
        quats /= np.linalg.norm(quats, axis=1, keepdims=True)
        parts.append(Gaussians(means, quats, rng.uniform(0.01, 0.035, (n, 3)), rng.uniform(0.6, 0.95, n), sh))
    return concatenate(parts)


def picture_of(body: Gaussians, camera: PinholeCamera) -> tuple[np.ndarray, np.ndarray]:
    """u8 picture before grey, and mask."""
    seen = render(body, camera, background=(0.5, 0.5, 0.5))
    return np.round(255 * np.clip(seen.image, 0, 1)).astype(np.uint8), seen.alpha > 0.5


def framed(body: Gaussians, camera: PinholeCamera, ratio: float) -> Gaussians:
    """Moved and scaled until its silhouette stands in the middle of a square picture and takes `ratio` of it."""
    right, down, forward = camera.camera_from_world.rotation
    for _ in range(8):
        rows, columns = np.nonzero(render(body, camera).alpha > 0.5)
        box = np.array([columns.min(), rows.min(), columns.max() + 1, rows.max() + 1])
        size, middle = (box[2:] - box[:2]).max(), (box[2:] + box[:2]) / 2
        distance = forward @ (body.means.mean(0) - camera.position)
        shift = (np.array(camera.center) - middle) * distance / camera.focal[0]
        scale = ratio * camera.size[0] / size
        about = body.means.mean(0).astype(float)
        body = body.transformed(Similarity3(scale, np.eye(3), (1 - scale) * about + shift @ np.stack([right, down])))
    return body


def original_camera(seen: PinholeCamera, scale: float = 0.45, offset: tuple[float, float] = (120.0, 20.0)):
    """The camera of a picture in which the generator's square lies small and away from the middle."""
    return replace(
        seen, focal=(seen.focal[0] * scale, seen.focal[1] * scale), size=PICTURE,
        center=(seen.center[0] * scale + offset[0], seen.center[1] * scale + offset[1]),
    )  # fmt: skip


def viewer(distance: float, fov: float, size: int = 512) -> PinholeCamera:
    """Level, looking along y at the origin."""
    return PinholeCamera.looking(np.array([0.0, -distance, 0.0]), np.zeros(3), fov, (size, size))


def assert_seen_again(gaussians, camera: PinholeCamera, image: np.ndarray, mask: np.ndarray, overlap=0.94) -> None:
    """The adapter's body from the adapter's camera is the original picture."""
    assert camera.size == (mask.shape[1], mask.shape[0])
    again, seen = picture_of(gaussians, camera)
    both, either = (seen & mask).sum(), (seen | mask).sum()
    assert both / either > overlap  # the crop is rounded to pixels: half a pixel around some 150 px is 2 to 4 %
    inside = seen & mask
    difference = np.abs(again.astype(float) - image)[inside].mean()
    assert difference < 8  # of 255, of a picture with steps of 100 and more, moved by less than a pixel
    mirrored = np.abs(again[:, ::-1].astype(float) - image)[inside & seen[:, ::-1]].mean()
    upside_down = np.abs(again[::-1].astype(float) - image)[inside & seen[::-1]].mean()
    assert min(mirrored, upside_down) > 2 * difference  # the test can tell


def assert_upright(gaussians: Gaussians) -> None:
    """The blue tower is the highest, the yellow lump and the red bar lie below it; a rotation, no mirror image."""
    means, rgb = gaussians.means, gaussians.rgb
    height = {c: np.median(means[np.abs(rgb - np.array(c)).sum(1) < 0.35, 2]) for c in (RED, BLUE, YELLOW)}
    size = np.ptp(means, axis=0).max()
    assert height[BLUE] - height[RED] > 0.15 * size
    assert abs(height[YELLOW] - height[RED]) < 0.1 * size


# TriplaneGaussian ------------------------------------------------------------------------------------------------

TGS_FROM_VIEW = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
"""x towards the viewer, y right, z up"""


def triplane_case():
    seen = viewer(1.9, 40.0)
    body = framed(known_body(3), seen, 0.75)
    image, mask = picture_of(body, original_camera(seen))
    theirs = body.transformed(Similarity3(rotation=TGS_FROM_VIEW))
    raw = {
        "xyz": torch.from_numpy(theirs.means), "opacity": torch.from_numpy(theirs.opacities[:, None]),
        "rotation": torch.from_numpy(theirs.quats), "scaling": torch.from_numpy(theirs.scales),
        "shs": torch.from_numpy(theirs.sh),
    }  # fmt: skip
    return raw, image, mask, body


def test_triplane_gaussian():
    raw, image, mask, body = triplane_case()
    gaussians, camera = triplane_gaussian.to_canonical(raw, triplane_gaussian.preprocess(image, mask).crop, PICTURE)
    assert_upright(gaussians)
    assert_seen_again(gaussians, camera, image, mask)
    assert np.ptp(gaussians.means[:, 2]) == pytest.approx(np.ptp(body.means[:, 2]), rel=1e-5)
    np.testing.assert_allclose(camera.position, [1.9, 0, 0], atol=1e-12)


def test_the_ply_of_triplane_gaussian_has_its_harmonics_in_another_order(tmp_path):
    raw, image, mask, _ = triplane_case()
    n = len(raw["xyz"])
    names = ["x", "y", "z", "nx", "ny", "nz", *(f"f_dc_{i}" for i in range(3)), *(f"f_rest_{i}" for i in range(45))]
    names += ["opacity", *(f"scale_{i}" for i in range(3)), *(f"rot_{i}" for i in range(4))]
    shs, p = raw["shs"].numpy(), np.clip(raw["opacity"].numpy(), 1e-3, 1 - 1e-3)
    table = np.concatenate(
        [raw["xyz"], np.zeros((n, 3)), shs[:, 0], shs[:, 1:].reshape(n, 45), np.log(p / (1 - p)),
         np.log(raw["scaling"].numpy()), raw["rotation"]], axis=1,
    )  # fmt: skip
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {n}"]
    header += [f"property float {name}" for name in names] + ["end_header\n"]
    (tmp_path / "0.ply").write_bytes("\n".join(header).encode() + table.astype("<f4").tobytes())
    camera = triplane_gaussian.preprocess(image, mask).crop.camera(
        triplane_gaussian.seen_camera(triplane_gaussian.preprocess(image, mask).crop), PICTURE
    )
    assert_seen_again(read_splats(tmp_path / "0.ply", coefficient_major=True).gaussians, camera, image, mask)
    wrong = picture_of(read_splats(tmp_path / "0.ply").gaussians, camera)[0]
    assert np.abs(wrong[mask].astype(float) - image[mask]).mean() > 12  # as every other reader takes it


def test_triplane_gaussian_is_told_the_camera_in_its_own_words():
    _, image, mask, _ = triplane_case()
    batch = triplane_gaussian.batch_of(triplane_gaussian.preprocess(image, mask))
    assert batch["rgb_cond"].shape == (1, 1, 252, 252, 3)
    assert batch["mask_cond"].shape == (1, 1, 252, 252, 1)
    # columns right, down, forward, place; the square of 252 px spans 40 degrees
    expected = [[0, 0, -1, 1.9], [1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1]]
    np.testing.assert_allclose(batch["c2w_cond"][0, 0], expected, atol=1e-7)
    f = 126 / math.tan(math.radians(20))
    np.testing.assert_allclose(batch["intrinsic_cond"][0, 0], [[f, 0, 126], [0, f, 126], [0, 0, 1]], rtol=1e-6)
    np.testing.assert_allclose(batch["intrinsic_normed_cond"][0, 0, :2, 2], 0.5)


# LGM -------------------------------------------------------------------------------------------------------------

LGM_FROM_VIEW = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
"""x right, y up, z towards the viewer"""


def lgm_case():
    seen = viewer(1.5, 49.1)
    body = framed(known_body(), seen, 0.8)
    image, mask = picture_of(body, original_camera(seen))
    theirs = body.transformed(Similarity3(rotation=LGM_FROM_VIEW))
    faint = np.zeros((50, 14), np.float32)  # its network leaves many that nobody sees
    faint[:, 3], faint[:, 4:7], faint[:, 7], faint[:, 11:] = 0.004, 0.3, 1.0, 1.0
    table = [theirs.means, theirs.opacities[:, None], theirs.scales, theirs.quats, 0.5 + SH_C0 * theirs.sh[:, 0]]
    return torch.from_numpy(np.concatenate([np.concatenate(table, axis=1), faint]))[None], image, mask, body


def test_lgm():
    raw, image, mask, body = lgm_case()
    gaussians, camera = lgm.to_canonical(raw.numpy(), lgm.preprocess(image, mask).crop, PICTURE)
    assert len(gaussians) == len(body)
    np.testing.assert_allclose(gaussians.means, body.means, atol=1e-6)
    assert_upright(gaussians)
    assert_seen_again(gaussians, camera, image, mask)


# TRELLIS and TripoSplat --------------------------------------------------------------------------------------------


class Theirs:
    """What the two of them return: raw numbers with biases, and getters that activate them."""

    def __init__(self, body: Gaussians, getters: bool) -> None:
        def softplus_inverse(x):
            return x + torch.log(-torch.expm1(-x))

        self.rots_bias = torch.tensor([1.0, 0, 0, 0])
        self.least, self.scale_bias = 9e-4, softplus_inverse(torch.tensor(0.004))
        self.opacity_bias = torch.logit(torch.tensor(0.1))
        self._xyz = torch.from_numpy(body.means) + 0.5
        self._features_dc = torch.from_numpy(body.sh)
        scales = torch.sqrt(torch.from_numpy(body.scales).double() ** 2 - self.least**2)
        self._scaling = (softplus_inverse(scales) - self.scale_bias).float()
        self._rotation = 1.7 * torch.from_numpy(body.quats) - self.rots_bias  # of any length
        self._opacity = torch.logit(torch.from_numpy(body.opacities)[:, None]) - self.opacity_bias
        if getters:
            self.get_rotation = torch.nn.functional.normalize(self._rotation + self.rots_bias)
            self.get_features = self._features_dc
        self.get_xyz = self._xyz - 0.5
        self.get_scaling = torch.sqrt(
            torch.nn.functional.softplus(self._scaling + self.scale_bias) ** 2 + self.least**2
        )
        self.get_opacity = torch.sigmoid(self._opacity + self.opacity_bias)


def turned_case(azimuth: float, elevation: float, distance: float, fov: float):
    """The body, a camera of a square that sees it from somewhere, the original picture and mask."""
    a, e = math.radians(azimuth), math.radians(elevation)
    eye = distance * np.array([math.cos(e) * math.cos(a), math.cos(e) * math.sin(a), math.sin(e)])
    seen = PinholeCamera.looking(eye, np.zeros(3), fov, (512, 512))
    body = framed(known_body(), seen, 1 / 1.2)
    return body, eye, *picture_of(body, original_camera(seen))


@pytest.mark.parametrize(("azimuth", "elevation"), [(-90.0, 0.0), (35.0, 30.0), (170.0, 55.0)])
def test_triposplat(azimuth, elevation):
    body, eye, image, mask = turned_case(azimuth, elevation, 2.0, 40.0)
    token = [*(0.93 * eye / 2.0), 1 / 2.0, 2.0 * math.tan(math.radians(20))]  # its direction is only nearly a unit one
    raw = trellis.read_getters(Theirs(body, getters=False))
    gaussians, camera = triposplat.to_canonical(
        raw, np.array(token)[None, None], triposplat.preprocess(image, mask).crop, PICTURE
    )
    np.testing.assert_allclose(gaussians.covariances(), body.covariances(), atol=1e-7)  # float32 through softplus
    assert_upright(gaussians)
    assert_seen_again(gaussians, camera, image, mask)


def test_a_camera_of_triposplat_at_infinity_sees_parallel_rays():
    _, _, image, mask = turned_case(35.0, 30.0, 2.0, 40.0)
    crop = triposplat.preprocess(image, mask).crop
    camera = triposplat.seen_camera(crop, np.array([1.0, 0, 0, 0.0, 0.6]))
    uv, _ = camera.project(np.array([[-0.5, 0.6, 0], [0.5, 0.6, 0]]))
    np.testing.assert_allclose(uv[:, 0], 1024, atol=0.3)  # half the width at the origin, whatever the depth
    with pytest.raises(FluidliftError, match="no camera"):
        triposplat.seen_camera(crop, np.array([0, 0, 0, np.nan, 1]))


@pytest.mark.parametrize(("azimuth", "elevation", "known"), [(-60.0, 12.0, True), (100.0, 48.0, False)])
def test_trellis_is_aligned_to_within_few_degrees(azimuth, elevation, known):
    a, e = math.radians(azimuth), math.radians(elevation)
    eye = 2.2 * np.array([math.cos(e) * math.cos(a), math.cos(e) * math.sin(a), math.sin(e)])
    image, mask = picture_of(known_body(), PinholeCamera.looking(eye, np.array([0.3, 0.2, 0.1]), 45.0, PICTURE))
    # upright, in another place, of another size, turned about the vertical
    turn = Similarity3(0.9, matrix_from_quat(np.array([0.8, 0, 0, 0.6])), np.array([0.05, -0.03, 0.02]))
    theirs = trellis.read_getters(Theirs(known_body().transformed(turn), getters=True))
    gaussians, camera, aligned = trellis.to_canonical(theirs, image, mask, field_of_view=45.0 if known else None)
    assert_upright(gaussians)
    assert_seen_again(gaussians, camera, image, mask)
    middle = turn.points(np.zeros(3))
    truth, found = turn.points(eye) - middle, camera.position - middle
    cosine = truth @ found / np.linalg.norm(truth) / np.linalg.norm(found)
    assert math.degrees(math.acos(min(1.0, cosine))) < 2.0  # 0.5 and less over other bodies and views; "a few"
    # nobody knows the focal length: it may take 10 % that belong to the distance
    assert np.linalg.norm(found) == pytest.approx(np.linalg.norm(truth), rel=0.03 if known else 0.15)
    assert aligned.overlap > 0.94
    assert aligned.margin > 1.5  # no other side looks like it


def test_a_body_that_is_cut_by_the_edge_of_the_picture_is_aligned_by_what_is_seen():
    eye = np.array([-1.2, -1.3, 0.9])
    camera = PinholeCamera.looking(eye, np.array([0.25, 0.05, 0.0]), 30.0, (200, 130))
    image, mask = picture_of(known_body(), camera)
    assert mask[0].any() or mask[:, 0].any()
    found = align_view.align_view(known_body(), image, mask, field_of_view=30.0).camera.position
    assert math.degrees(math.acos(eye @ found / np.linalg.norm(eye) / np.linalg.norm(found))) < 3.0


def test_a_ball_of_one_colour_has_no_side_and_the_margin_says_so():
    rng = np.random.default_rng(0)
    points = rng.normal(size=(1500, 3))
    points *= 0.3 / np.linalg.norm(points, axis=1, keepdims=True)
    ball = Gaussians.isotropic(points, 0.03, np.full((1500, 3), 0.6), 0.9)
    image, mask = picture_of(ball, PinholeCamera.looking(np.array([0.0, -2, 0.5]), np.zeros(3), 40.0, (160, 120)))
    aligned = align_view.align_view(ball, image, mask, field_of_view=40.0)
    assert aligned.overlap > 0.9
    assert aligned.margin < 1.5


def test_a_body_that_is_something_else_is_refused():
    _, _, image, mask = turned_case(35.0, 30.0, 2.2, 40.0)
    plate = np.random.default_rng(1).uniform(-1, 1, (800, 3)) * (0.01, 0.01, 0.5)
    thin = Gaussians.isotropic(plate, 0.004, np.full((800, 3), 0.5), 0.9)
    with pytest.raises(FluidliftError, match="another seed"):
        trellis.to_canonical(trellis.read_getters(Theirs(thin, getters=True)), image, mask, field_of_view=40.0)


# SHARP -----------------------------------------------------------------------------------------------------------


def sharp_case():
    """The body 3 m in front of a wall's worth of other things, as the camera at the origin sees it."""
    focal = 300.0
    camera = PinholeCamera(
        (focal, focal), (PICTURE[0] / 2, PICTURE[1] / 2), PICTURE,
        RigidTransform(np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])),
    )  # fmt: skip
    body = known_body().transformed(Similarity3(2.0, np.eye(3), np.array([0.2, 3.0, 0.1])))
    image, mask = picture_of(body, camera)
    wall = np.random.default_rng(2).uniform((-3, 6, -2), (3, 6.2, 2), (4000, 3))
    scene = concatenate([body, Gaussians.isotropic(wall, 0.05, np.full((4000, 3), 0.5))])
    theirs = scene.transformed(Similarity3(rotation=np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])))
    rgb = 0.5 + SH_C0 * theirs.sh[:, 0]
    linear = np.where(rgb <= 0.04045, rgb / 12.92, ((rgb + 0.055) / 1.055) ** 2.4)
    raw = {
        "mean_vectors": theirs.means, "singular_values": theirs.scales, "quaternions": theirs.quats,
        "colors": linear, "opacities": theirs.opacities,
    }  # fmt: skip
    return {k: torch.from_numpy(np.asarray(v, np.float32))[None] for k, v in raw.items()}, image, mask, body, focal


def test_sharp():
    raw, image, mask, body, focal = sharp_case()
    scene, camera = sharp.to_canonical(raw, sharp.preprocess(image, mask).crop, PICTURE, focal)
    np.testing.assert_allclose(scene.means[: len(body)], body.means, atol=1e-5)  # metres stay metres
    np.testing.assert_allclose(scene.rgb[: len(body)], body.rgb, atol=1e-5)  # linear light and back
    assert_upright(scene.select(np.arange(len(body))))
    assert_seen_again(scene.select(np.arange(len(body))), camera, image, mask)
    kept = sharp.fluid_of(scene, camera, mask)
    assert_seen_again(kept, camera, image, mask, overlap=0.9)  # a little of the wall shows along the edge
    assert len(kept) < 0.6 * len(scene)  # most of the wall is gone
    near, _ = near_and_far(kept, camera, mask)
    assert np.median(near[mask]) == pytest.approx(3.0, abs=0.3)


def test_the_focal_length_of_sharp_is_that_of_a_30_mm_lens_unless_it_is_known():
    assert sharp.focal_length((1920, 1080)) == pytest.approx(30 * math.hypot(1920, 1080) / math.hypot(36, 24))
    assert sharp.focal_length((1920, 1080), 90.0) == pytest.approx(960)


# all of them -----------------------------------------------------------------------------------------------------


def test_what_a_generator_returns_is_what_the_pipeline_takes_in():
    raw, image, mask, _ = lgm_case()
    gaussians, camera = lgm.to_canonical(raw.numpy(), lgm.preprocess(image, mask).crop, PICTURE)
    to_canonical = canonical_from_given(camera, gaussians)
    moved = gaussians.transformed(to_canonical)
    assert np.median(moved.means[:, 1]) == pytest.approx(1.0, abs=0.02)  # in front of the viewer, at depth 1
    assert_upright(moved)


@pytest.mark.parametrize(("pitch", "roll"), [(35.0, 0.0), (-10.0, 7.0)])
def test_a_body_whose_vertical_is_the_pictures_is_tilted_with_its_camera_and_looks_the_same(pitch, roll):
    raw, image, mask, _ = triplane_case()
    gaussians, camera = triplane_gaussian.to_canonical(raw, triplane_gaussian.preprocess(image, mask).crop, PICTURE)
    body, looking = tilted(gaussians, camera, pitch=pitch, roll=roll)
    assert_seen_again(body, looking, image, mask)
    up, heading = pose_up(looking)
    assert (up.pitch, up.roll, heading) == pytest.approx((pitch, roll, 0.0), abs=1e-9)


def test_a_turned_body_with_view_dependent_colours_looks_the_same_from_a_turned_camera():
    body, camera = known_body(3), viewer(2.0, 40.0, 200)
    move = Similarity3(1.7, matrix_from_quat(np.array([0.6, -0.3, 0.5, 0.4])), np.array([0.3, -1.0, 2.0]))
    rotation = camera.camera_from_world.rotation @ move.rotation.T
    pose = RigidTransform(rotation, -rotation @ move.points(camera.position))
    here, there = (
        picture_of(body, camera)[0],
        picture_of(body.transformed(move), replace(camera, camera_from_world=pose))[0],
    )
    assert np.abs(here.astype(int) - there).max() <= 2  # float32 and rounding to 8 bits


SEEN = {  # module, size, share of the fluid's longer side, background, kind
    "triplane-gaussian": (triplane_gaussian, (252, 252), 0.75, 1.0, np.float32),
    "lgm": (lgm, (360, 360), 0.8, 1.0, np.float32),
    "trellis": (trellis, (518, 518), 1 / 1.2, 0, np.uint8),
    "triposplat": (triposplat, (1024, 1024), 1 / 1.2, 0, np.uint8),
}


@pytest.mark.parametrize("name", list(SEEN))
@pytest.mark.parametrize("box", [(60, 40, 200, 130), (250, 10, 300, 220), (0, 100, 359, 180)])
def test_the_picture_that_a_generator_sees_is_as_it_wants_it(name, box):
    module, size, share, background, kind = SEEN[name]
    left, upper, right, lower = box
    image = np.full((PICTURE[1], PICTURE[0], 3), (30, 90, 200), np.uint8)
    mask = np.zeros(PICTURE[::-1], bool)
    mask[upper : lower + 1, left : right + 1] = True
    image[~mask] = (0, 255, 0)  # what nobody may see
    image[upper + 12 : upper + 18, right - 17 : right - 11] = (255, 0, 0)
    prepared = module.preprocess(image, mask)
    assert prepared.image.shape == (*size[::-1], 3)
    assert prepared.image.dtype == kind
    colour = prepared.image.astype(float) / (255 if kind == np.uint8 else 1)
    np.testing.assert_allclose(colour[[0, 0, -1, -1], [0, -1, 0, -1]], background)
    inside = prepared.alpha > 0.5
    rows, columns = np.flatnonzero(inside.any(1)), np.flatnonzero(inside.any(0))
    extent = max(np.ptp(rows), np.ptp(columns)) + 1
    # one pixel of a box 141 px wide is 0.7 %; TripoSplat enlarges first and counts the soft edge in, 3 px on each side
    assert extent / size[0] == pytest.approx(share, abs=0.04 if name == "triposplat" else 0.02)
    assert (rows[0] + rows[-1] + 1) / 2 == pytest.approx(size[1] / 2, abs=0.02 * size[1])
    assert (columns[0] + columns[-1] + 1) / 2 == pytest.approx(size[0] / 2, abs=0.02 * size[0])
    assert colour[inside][:, 1].mean() < 0.42  # the green around it stayed outside
    marked = (colour[..., 0] > 0.5) & (colour[..., 2] < 0.5)
    v, u = np.argwhere(marked).mean(0) + 0.5
    (sx, sy), (ox, oy) = prepared.crop.scale, prepared.crop.offset
    assert (u, v) == pytest.approx((sx * (right - 14) + ox, sy * (upper + 15) + oy), abs=1.5 * max(1.0, sx / 2))
