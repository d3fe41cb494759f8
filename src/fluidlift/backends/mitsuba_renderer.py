"""Final frames by Mitsuba 3 (BSD-3-Clause; Jakob et al. 2022): path-traced liquids over terrain and obstacles.

Light that passes the liquid's surface is found by its own paths only: a small, strong sun gives caustics, and grain.
"""

from __future__ import annotations

import importlib
import math
import subprocess
import sys
from functools import lru_cache
from typing import Any, final

import numpy as np
from jaxtyping import Float

from fluidlift.backends.mitsuba_denoise import denoised, without_sparks
from fluidlift.backends.mitsuba_scene import FinalScene, cut_out, described
from fluidlift.errors import FluidliftError, MissingPackage, require
from fluidlift.types import PinholeCamera

VARIANTS = ("auto", "scalar_rgb", "llvm_ad_rgb", "cuda_ad_rgb")
PATHS_AT_ONCE = 16_000_000
"""light paths that a compiled variant keeps in memory together, about 4 GB"""
PARTS = 8
"""of a picture, each of light paths of its own: where they differ there is grain"""
EDGE_SAMPLES = 16
"""at least, of what a glowing liquid covers"""
PROBE_SECONDS = 120.0
_INSTALL = "pip install 'fluidlift[mitsuba]'"
_PROBE = """
import sys, mitsuba as mi
mi.set_variant(sys.argv[1])
scene = mi.cornell_box()
scene["sensor"]["film"]["width"] = scene["sensor"]["film"]["height"] = 4
scene["glass"] = {"type": "sphere", "radius": 0.2, "bsdf": {"type": "dielectric"},
                  "interior": {"type": "homogeneous"}}
scene["integrator"] = {"type": "volpathmis"}
image = mi.render(mi.load_dict(scene), spp=1)
assert float(sum(image.array)) >= 0
"""


@final
class MitsubaRenderer:
    """Path tracing of `FinalScene`.

    Args:
        variant: "scalar_rgb" runs everywhere; "llvm_ad_rgb" is about twice as fast where LLVM 17 or newer is found
            (set DRJIT_LIBLLVM_PATH to another one); "cuda_ad_rgb" needs an NVIDIA GPU; "auto": llvm_ad_rgb if a trial
            in a process of its own succeeds, else scalar_rgb. Some versions of LLVM end the whole process at the
            first picture, which is why nothing compiled runs here untried.

    Raises:
        MissingPackage: Mitsuba is not installed.
        FluidliftError: the variant that was asked for does not run here.
        ValueError: another variant.
    """

    def __init__(self, variant: str = "auto") -> None:
        require(variant in VARIANTS, f"Mitsuba variant '{variant}'", ", ".join(VARIANTS))
        try:
            self._mi: Any = importlib.import_module("mitsuba")
        except ImportError:
            raise MissingPackage(
                f"Mitsuba is not installed. Needed: for final frames. Do: {_INSTALL}, or use the screen-space surface."
            ) from None
        if variant == "auto":
            variant = "llvm_ad_rgb" if trial("llvm_ad_rgb") == "" else "scalar_rgb"
        elif variant != "scalar_rgb":
            problem = trial(variant)
            if problem:
                raise FluidliftError(
                    f"Mitsuba's variant {variant} does not run here ({problem}). Needed: LLVM 17 or newer for "
                    "llvm_ad_rgb, an NVIDIA driver for cuda_ad_rgb. Do: set DRJIT_LIBLLVM_PATH, or take scalar_rgb."
                )
        self.variant = variant

    def picture(self, scene: FinalScene) -> Float[np.ndarray, "h w 3"]:
        """Linear light, float32; the same for the same scene, seed and variant."""
        return self.picture_and_alpha(scene)[0]

    def picture_and_alpha(self, scene: FinalScene) -> tuple[Float[np.ndarray, "h w 3"], Float[np.ndarray, "h w"]]:
        """Linear light, float32, and the share of each pixel in which the camera meets liquid or solids.

        Light is premultiplied: without `show_environment` it is black where alpha is 0.

        Raises:
            FluidliftError: more than one pixel in a thousand is no number.
        """
        self._mi.set_variant(self.variant)
        self._mi.set_log_level(self._mi.LogLevel.Error)  # else it tells of every number of samples that it rounds up
        camera, across, down = square_pixels(scene.camera)
        world = self._mi.load_dict(described(self._mi, scene, camera))
        most = max(1, PATHS_AT_ONCE // (camera.size[0] * camera.size[1]))
        counts = _parts(scene.samples, most)
        parts = []
        for k, count in enumerate(counts):
            # seeds of the parts of one picture must not be those of the next picture
            part = np.asarray(self._mi.render(world, spp=count, seed=(scene.seed * 7919 + k) % 2**31))
            parts.append(_finite(part))
            if len(parts) > PARTS:  # of a long row of them, as many as tell the grain are kept
                parts[k % PARTS] = parts[k % PARTS] + parts.pop()
        # glass mirrors a path or lets it pass, by chance: what it covers has grain as well
        mean = _together(np.stack(parts), counts, denoise=scene.denoise, covered=bool(scene.panes))
        apart = cut_out(self._mi, scene, camera)
        if apart is not None:
            count, seed = min(max(scene.samples, EDGE_SAMPLES), most), (scene.seed * 7919) % 2**31
            covered, bare = (
                _finite(np.asarray(self._mi.render(self._mi.load_dict(s), spp=count, seed=seed))) for s in apart
            )
            mean[..., 3] = np.clip(covered[..., 3], 0.0, 1.0)
            light = np.maximum(mean[..., :3] - (1.0 - mean[..., 3:]) * bare[..., :3], 0.0)
            mean[..., :3] = np.where(mean[..., 3:] > 0, light, 0.0)
        if across is not None and down is not None:
            mean = np.einsum("hi,wj,ijc->hwc", down, across, mean, optimize=True)
        mean = mean.astype(np.float32)
        return np.ascontiguousarray(mean[..., :3]), np.clip(mean[..., 3], 0.0, 1.0)


@lru_cache
def trial(variant: str) -> str:
    """What goes wrong with a variant in a process of its own; nothing if it draws a small picture."""
    try:
        ran = subprocess.run(
            [sys.executable, "-c", _PROBE, variant], capture_output=True, timeout=PROBE_SECONDS, text=True, check=False
        )
    except (OSError, subprocess.TimeoutExpired) as error:
        return type(error).__name__
    if ran.returncode == 0:
        return ""
    lines = [x.strip() for x in ran.stderr.splitlines() if x.strip()]
    told = [x for x in lines if "error" in x.lower()] or lines[-1:] or [f"exit code {ran.returncode}"]
    return told[0][:200]


def _parts(samples: int, most: int) -> list[int]:
    """Paths per pixel of each part of a picture, `most` at once: alike, and a multiple of `PARTS` where there are
    enough to tell grain."""
    if samples < 2 * PARTS:
        return [min(most, samples - k) for k in range(0, samples, most)]
    rounds = math.ceil(samples / (PARTS * most))
    count = rounds * PARTS
    return [samples // count + (k < samples % count) for k in range(count)]


def _together(
    parts: Float[np.ndarray, "k h w 4"], counts: list[int], *, denoise: bool, covered: bool = False
) -> Float[np.ndarray, "h w 4"]:
    """One picture of its parts (sums of those `counts` of paths that fell to them); `covered`: grain is taken out of
    the alpha too."""
    shares = np.zeros((len(parts), 2))
    for k, count in enumerate(counts):
        shares[k % len(parts)] += (count, 1)
    parts = parts / shares[:, 1, None, None, None]
    mean = np.average(parts, axis=0, weights=shares[:, 0])
    if denoise and len(counts) >= PARTS:
        mean[..., :3] = denoised(without_sparks(parts[..., :3]))
        if covered:
            mean[..., 3:] = denoised(parts[..., 3:])
    return mean


def _finite(part: np.ndarray) -> np.ndarray:
    """A path or two in a million may come out as no number; more of them mean a scene that Mitsuba cannot draw."""
    broken = ~np.all(np.isfinite(part), axis=-1)
    if broken.mean() > 1e-3:
        raise FluidliftError(
            f"Mitsuba drew {100 * broken.mean():.1f} % of the pixels as no number. Needed: a closed mesh of the liquid "
            "and a material with finite numbers. Do: look at the mesh, or draw the screen-space surface."
        )
    return np.where(broken[..., None], 0.0, part)


def square_pixels(camera: PinholeCamera) -> tuple[PinholeCamera, np.ndarray | None, np.ndarray | None]:
    """A camera of the same view whose pixels are square, as Mitsuba needs them, and how its columns [w,w'] and rows
    [h,h'] make up those of the first; None where nothing changes."""
    focal = max(camera.focal)
    if np.ptp(camera.focal) <= 1e-6 * focal:
        return camera, None, None
    finer = [focal / f for f in camera.focal]
    size = [math.ceil(n * r) for n, r in zip(camera.size, finer, strict=True)]
    center = tuple(c * r for c, r in zip(camera.center, finer, strict=True))
    shares = [_overlap(n, m, r) for n, m, r in zip(camera.size, size, finer, strict=True)]
    drawn = PinholeCamera((focal, focal), (center[0], center[1]), (size[0], size[1]), camera.camera_from_world)
    return drawn, shares[0], shares[1]


def _overlap(count: int, finer: int, ratio: float) -> Float[np.ndarray, "n m"]:
    """Share of each of `count` pixels, `ratio` wide, that lies in each of `finer` pixels of width 1."""
    left = np.arange(count)[:, None] * ratio
    at = np.arange(finer)[None, :]
    shared = np.clip(np.minimum(left + ratio, at + 1) - np.maximum(left, at), 0.0, None)
    return shared / shared.sum(axis=1, keepdims=True)
