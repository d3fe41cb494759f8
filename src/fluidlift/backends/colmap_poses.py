"""COLMAP's solvers (pycolmap, BSD): poses of a moving camera from tracks of what stands.

Incremental structure from motion (Schoenberger, Frahm 2016) with the order of a video: the pair of frames that is
farthest apart first, then the frame that sees most of what is known, and a bundle adjustment of all. COLMAP's own
pipeline is made for photographs from all sides: on clips, whose rays meet at a degree or two, it begins with a pair too
near each other and ends 4 to 9 degrees off.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import Float

from fluidlift.errors import MissingPackage
from fluidlift.seams import PoseSolver
from fluidlift.types import CameraPath

INSTALL = "pip install 'fluidlift[camera]'"
KEY_FRAMES = 24
"""frames of the bundle adjustment, at most; the others are placed by what these have found"""
LEAST_POINTS = 24
"""points that a frame must see, to be placed"""
PAIR_ERROR, POSE_ERROR, POINT_ERROR = 0.7, 3.0, 2.0
"""px: within which a corner agrees with a pair of frames, with a pose, and with its point in space. A corner is found
to 0.2 px; poses and points are rough before the adjustment"""
SOFT = 0.5
"""px, where the adjustment's loss begins to grow more slowly"""
WIDTHS = (0.75, 1.33)
"""of the focal length: where the loss is looked at to tell how well it is known"""


class ColmapPoses(PoseSolver):
    """Poses by pycolmap.

    Raises:
        MissingPackage: it is not installed.
    """

    def __init__(self) -> None:
        try:
            import pycolmap
        except ImportError as error:
            raise MissingPackage("pycolmap is not installed", "it, for a camera that moves", INSTALL) from error
        pycolmap.logging.minloglevel = int(pycolmap.logging.ERROR)
        self._colmap: Any = pycolmap

    def solve(
        self, places: Float[np.ndarray, "n t 2"], size: tuple[int, int], focal: float, *, told: bool = False
    ) -> CameraPath | None:
        """See the seam."""
        count = places.shape[1]
        keys = np.unique(np.linspace(0, count - 1, min(count, KEY_FRAMES)).round().astype(int))
        scene = _Scene(self._colmap, places, size, focal)
        if not scene.begin(keys) or not scene.grow(keys):
            return None
        scene.adjust(lens=False)
        error = 0.0
        if not told:
            error = scene.find_focal()
        return scene.whole(error) if scene.grow(np.arange(count)) else None


class _Scene:
    """What is known so far. Frame t is COLMAP's image t + 1, track i the point of that number."""

    def __init__(self, colmap: Any, places: np.ndarray, size: tuple[int, int], focal: float) -> None:
        self.colmap, self.places, self.seen, self.size = colmap, places, np.isfinite(places[..., 0]), size
        self.focal = focal
        self.poses: dict[int, np.ndarray] = {}
        """[3,4], camera from world"""
        self.points = np.full((len(places), 3), np.nan)

    @property
    def camera(self) -> Any:
        width, height = self.size
        return self.colmap.Camera(
            camera_id=1, model="SIMPLE_PINHOLE", width=width, height=height, params=[self.focal, width / 2, height / 2]
        )

    def rays(self, t: int, tracks: np.ndarray) -> np.ndarray:
        """[n,2] at unit depth."""
        return (self.places[tracks, t] - 0.5 * np.asarray(self.size, float)) / self.focal

    def begin(self, keys: np.ndarray) -> bool:
        """The first pair: the two frames farthest apart that share enough."""
        for gap in range(len(keys) - 1, 0, -1):
            pairs = [(keys[k], keys[k + gap]) for k in range(len(keys) - gap)]
            first, last = max(pairs, key=lambda pair: int((self.seen[:, pair[0]] & self.seen[:, pair[1]]).sum()))
            both = np.flatnonzero(self.seen[:, first] & self.seen[:, last])
            if len(both) < 2 * LEAST_POINTS:
                continue
            options = self.colmap.TwoViewGeometryOptions()
            options.compute_relative_pose = True
            options.ransac.random_seed, options.ransac.max_error = 0, PAIR_ERROR
            pairs = np.stack([np.arange(len(both))] * 2, axis=1).astype(np.uint32)
            found = self.colmap.estimate_calibrated_two_view_geometry(
                self.camera, self.places[both, first], self.camera, self.places[both, last], pairs, options
            )
            if len(found.inlier_matches) < LEAST_POINTS or found.cam2_from_cam1 is None:
                continue
            self.poses = {int(first): np.eye(3, 4), int(last): found.cam2_from_cam1.matrix()}
            self.triangulate()
            return int(np.isfinite(self.points[:, 0]).sum()) >= LEAST_POINTS
        return False

    def grow(self, frames: np.ndarray) -> bool:
        """Place all of the frames, each time the one that sees most; False where one cannot be."""
        left = [int(t) for t in frames if int(t) not in self.poses]
        fixed = len(frames) > KEY_FRAMES
        while left:
            known = np.isfinite(self.points[:, 0])
            t = max(left, key=lambda t: int((self.seen[:, t] & known).sum()))
            tracks = np.flatnonzero(self.seen[:, t] & known)
            if len(tracks) < LEAST_POINTS:
                return False
            options = self.colmap.AbsolutePoseEstimationOptions()
            options.ransac.max_error, options.ransac.random_seed = POSE_ERROR, 0
            found = self.colmap.estimate_and_refine_absolute_pose(
                self.places[tracks, t], self.points[tracks], self.camera, options
            )
            if found is None or found["num_inliers"] < LEAST_POINTS:
                return False
            self.poses[t] = found["cam_from_world"].matrix()
            left.remove(t)
            if not fixed:
                self.triangulate()
        return True

    def triangulate(self) -> None:
        """Points of tracks that have none yet, from all frames that are placed (linear, Hartley and Zisserman 12.2)."""
        frames = sorted(self.poses)
        lacking = np.flatnonzero(~np.isfinite(self.points[:, 0]) & (self.seen[:, frames].sum(axis=1) > 1))
        for i in lacking:
            shown = [t for t in frames if self.seen[i, t]]
            poses = np.stack([self.poses[t] for t in shown])
            rays = np.stack([self.rays(t, np.array([i]))[0] for t in shown])
            rows = rays[:, :, None] * poses[:, 2:3] - poses[:, :2]
            point = np.linalg.svd(rows.reshape(-1, 4))[2][-1]
            if abs(point[3]) < 1e-9:
                continue
            at = np.einsum("tij,j->ti", poses, point / point[3])
            miss = self.focal * np.linalg.norm(at[:, :2] / np.where(at[:, 2:] > 0, at[:, 2:], np.nan) - rays, axis=1)
            if np.isfinite(miss).all() and miss.max() < POINT_ERROR:
                self.points[i] = point[:3] / point[3]

    def adjust(self, *, lens: bool) -> float:
        """Bundle adjustment; the sum of the soft losses after it, px^2."""
        colmap, known = self.colmap, np.isfinite(self.points[:, 0])
        scene = colmap.Reconstruction()
        scene.add_camera_with_trivial_rig(self.camera)
        numbers = {}
        for t in sorted(self.poses):
            shown = np.flatnonzero(self.seen[:, t] & known)
            numbers[t] = dict(zip(shown.tolist(), range(len(shown))))
            image = colmap.Image(name=f"{t:06d}", camera_id=1, image_id=t + 1)
            image.points2D = colmap.Point2DList([colmap.Point2D(self.places[i, t]) for i in shown])
            scene.add_image_with_trivial_frame(image, colmap.Rigid3d(self.poses[t]))
        tracks = np.flatnonzero(known)
        added = []
        for i in tracks:
            track = colmap.Track()
            for t in sorted(self.poses):
                if self.seen[i, t]:
                    track.add_element(t + 1, numbers[t][int(i)])
            added.append(scene.add_point3D(self.points[i], track))
        options = colmap.BundleAdjustmentOptions()
        options.refine_focal_length, options.refine_extra_params, options.print_summary = lens, False, False
        options.ceres.loss_function_type = colmap.LossFunctionType.SOFT_L1
        options.ceres.loss_function_scale = SOFT
        options.ceres.solver_options.num_threads = 1
        config = colmap.BundleAdjustmentConfig()
        for t in self.poses:
            config.add_image(t + 1)
        config.fix_gauge(colmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
        # `bundle_adjustment` does the same, and writes to the terminal whatever its log's level is
        colmap.create_default_bundle_adjuster(options, config, scene).solve()
        for t in self.poses:
            self.poses[t] = scene.image(t + 1).cam_from_world().matrix()
        self.focal = float(scene.camera(1).params[0])
        for i, number in zip(tracks, added):
            self.points[i] = scene.point3D(number).xyz
        return self.clean()

    def clean(self) -> float:
        """Points that do not agree with where they are seen are dropped; the sum of the soft losses of the others."""
        total = 0.0
        for t in sorted(self.poses):
            tracks = np.flatnonzero(self.seen[:, t] & np.isfinite(self.points[:, 0]))
            miss = self.miss(t, tracks)
            good = miss < POINT_ERROR  # false where the point lies behind the camera
            self.points[tracks[~good]] = np.nan
            total += float((2.0 * SOFT**2 * (np.sqrt(1.0 + (miss[good] / SOFT) ** 2) - 1.0)).sum())
        return total

    def miss(self, t: int, tracks: np.ndarray) -> np.ndarray:
        """px [n] between where a frame shows points and where it should; not a number behind the camera."""
        at = self.points[tracks] @ self.poses[t][:, :3].T + self.poses[t][:, 3]
        depth = np.where(at[:, 2:] > 0, at[:, 2:], np.nan)
        return self.focal * np.linalg.norm(at[:, :2] / depth - self.rays(t, tracks), axis=1)

    def find_focal(self) -> float:
        """The focal length that fits best, and its standard deviation as a part of it, from how the loss grows."""
        kept = self.focal, dict(self.poses), self.points.copy()
        least = self.adjust(lens=True)
        best = self.focal, dict(self.poses), self.points.copy()
        losses = []
        for width in WIDTHS:
            self.focal, self.poses, self.points = best[0] * width, dict(best[1]), best[2].copy()
            losses.append(self.adjust(lens=False))
        self.focal, self.poses, self.points = best
        medians = [self.miss(t, np.flatnonzero(self.seen[:, t] & np.isfinite(self.points[:, 0]))) for t in self.poses]
        spread = float(np.median(np.concatenate(medians))) / 1.18  # of a Rayleigh distribution
        # corners of a track err alike, as all are found in one picture: a track counts once and not in every frame
        each = float(self.seen[np.isfinite(self.points[:, 0])][:, sorted(self.poses)].sum(axis=1).mean())
        rise = min((loss - least) / max(spread**2 * each, 1e-12) / np.log(w) ** 2 for loss, w in zip(losses, WIDTHS))
        error = float("inf") if rise <= 0 else float(1.0 / np.sqrt(rise))
        if error > LEAST_KNOWN or not kept[0] / FAR_OFF < self.focal < kept[0] * FAR_OFF:
            self.focal, self.poses, self.points = kept
            return float("inf")
        return error

    def whole(self, focal_error: float) -> CameraPath:
        """The path through all frames."""
        poses = np.stack([self.poses[t] for t in range(self.places.shape[1])])
        tracks = np.flatnonzero(np.isfinite(self.points[:, 0]))
        miss = np.concatenate([self.miss(t, tracks[self.seen[tracks, t]]) for t in range(len(poses))])
        return CameraPath(
            poses[:, :, :3], poses[:, :, 3], self.focal, focal_error, self.points[tracks], tracks,
            float(np.nanmedian(miss)),
        )  # fmt: skip


LEAST_KNOWN = 0.15
"""part of the focal length: where it is not known better than this, what was assumed stays"""
FAR_OFF = 2.0
"""times the assumed focal length, or part of it, beyond which no lens is believed: 50 degrees would become 25 or 86"""
