"""TRELLIS (Xiang et al. 2024): one picture to Gaussians that stand upright, but not as the picture saw them.

What it expects and returns was read in its code (trellis/pipelines/trellis_image_to_3d.py,
trellis/representations/gaussian/gaussian_model.py). The pose is found afterwards by `align_view`.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Bool, Float, UInt8

from fluidlift.backends.generator_card import GeneratorCard
from fluidlift.backends.generator_loading import InProcessGenerator, array
from fluidlift.backends.generator_view import Crop, Prepared, box_of, rgba
from fluidlift.errors import FluidliftError, require
from fluidlift.types import Gaussians, PinholeCamera

if TYPE_CHECKING:
    from fluidlift.backends.align_view import Aligned

CARD = GeneratorCard(
    name="trellis",
    title="TRELLIS (Xiang et al. 2024)",
    licence=(
        "Code and weights MIT (Microsoft). Its image encoder DINOv2 is Apache-2.0. The rasterisers that its repository "
        "installs (mip-splatting, diffoctreerast) are of non-commercial lineage; they only draw, and are not used here."
    ),
    licence_commercial=True,
    home="https://github.com/microsoft/TRELLIS",
    packages=("trellis", "spconv", "xformers", "rembg", "easydict", "utils3d", "plyfile", "numba"),
    hardware="an NVIDIA GPU with 16 GB",
    weights=("microsoft/TRELLIS-image-large",),
    notes=(
        "The pose is found by comparing silhouette and colours; a body of round shape and one colour has none.",
        "Bodies are shells: filling comes afterwards.",
    ),
    install=(
        "git clone --recurse-submodules https://github.com/microsoft/TRELLIS",
        "cd TRELLIS && . ./setup.sh --new-env --basic --xformers --spconv",
        "pip install numba scipy opencv-python-headless",
        "export PYTHONPATH=$PWD",
    ),
    environment=(("ATTN_BACKEND", "xformers"), ("SPCONV_ALGO", "native")),
)

ENLARGED = 1.2
"""side of the cut-out over the longer side of the fluid's box"""
SEEN_SIZE = 518
"""px"""
LEAST_OVERLAP = 0.5
"""of the silhouettes: below it, the body is not taken for what the picture shows"""


def preprocess(image: UInt8[np.ndarray, "h w 3"], mask: Bool[np.ndarray, "h w"]) -> Prepared:
    """518 x 518 px on black, u8: a square of 1.2 times the fluid's box, Lanczos."""
    from PIL import Image

    left, upper, right, lower = box_of(mask)
    middle = (left + right) / 2, (upper + lower) / 2
    half = int(max(right - left, lower - upper) * ENLARGED) // 2
    box = [round(x) for x in (middle[0] - half, middle[1] - half, middle[0] + half, middle[1] + half)]
    cut = Image.fromarray(rgba(image, mask)).crop((box[0], box[1], box[2], box[3]))
    seen = np.asarray(cut.resize((SEEN_SIZE, SEEN_SIZE), Image.Resampling.LANCZOS), np.float32) / 255.0
    on_black = (seen[..., :3] * seen[..., 3:] * 255.0).astype(np.uint8)
    crop = Crop.of_box((box[0], box[1], box[2], box[3]), (SEEN_SIZE, SEEN_SIZE))
    return Prepared(on_black, crop, seen[..., 3])


def body_of(raw: Mapping[str, Any]) -> Gaussians:
    """Its body, in a unit cube about the origin, z up.

    Args:
        raw: xyz [n,3], scaling [n,3], rotation [n,4] (w x y z), opacity [n,1] and features [n,k,3], as its getters
            (`get_xyz`, ...) return them: activated.
    """
    xyz = array(raw["xyz"])
    n = len(xyz)
    features = array(raw["features"]).reshape(n, -1, 3)
    return Gaussians(xyz, array(raw["rotation"]), array(raw["scaling"]), array(raw["opacity"]).reshape(n), features)


def to_canonical(
    raw: Mapping[str, Any],
    image: UInt8[np.ndarray, "h w 3"],
    mask: Bool[np.ndarray, "h w"],
    *,
    field_of_view: float | None = None,
) -> tuple[Gaussians, PinholeCamera, Aligned]:
    """Body, camera of the original picture, and how well they fit.

    Args:
        raw: as for `body_of`.
        image: the original picture, u8, sRGB.
        mask: the fluid in it.
        field_of_view: degrees across the longer side of the picture, where known.

    Raises:
        FluidliftError: from no side does the body look like the fluid.
    """
    from fluidlift.backends.align_view import align_view  # numba and SciPy, which another environment may lack

    body = body_of(raw)
    aligned = align_view(body, image, mask, field_of_view=field_of_view)
    if aligned.overlap < LEAST_OVERLAP:
        raise FluidliftError(
            f"The body of {CARD.title} fits the fluid in the picture to {100 * aligned.overlap:.0f} % only. "
            f"Needed: {100 * LEAST_OVERLAP:.0f} %. Do: try another seed or frame, or another generator."
        )
    return body, aligned.camera, aligned


def read_getters(gaussian: Any) -> dict[str, np.ndarray]:
    """The activated numbers of its `Gaussian`, or of the like class of TripoSplat, which lacks two of the getters."""
    if hasattr(gaussian, "get_rotation"):
        rotation, features = array(gaussian.get_rotation), array(gaussian.get_features)
    else:
        rotation = array(gaussian._rotation) + array(gaussian.rots_bias)
        features = array(gaussian._features_dc)
    require(rotation.ndim == 2 and rotation.shape[1] == 4, f"rotations of shape {rotation.shape}", "[n, 4]")
    rotation = rotation / np.maximum(np.linalg.norm(rotation, axis=1, keepdims=True), 1e-12)
    out: dict[str, Float[np.ndarray, "..."]] = {"rotation": rotation, "features": features}
    return out | {name: array(getattr(gaussian, f"get_{name}")) for name in ("xyz", "scaling", "opacity")}


class TrellisGenerator(InProcessGenerator):
    """The authors' pipeline. Its image encoder is code and a pickle on the hub: in a process of its own only."""

    card = CARD
    knows_up = True
    foreign_code = "DINOv2 through torch.hub, which runs code from GitHub"

    def load(self) -> Any:
        import importlib
        import os

        for name, value in CARD.environment:
            os.environ.setdefault(name, value)
        pipelines = importlib.import_module("trellis.pipelines")
        where = str(self.choice.weights or CARD.weights[0])
        pipeline = pipelines.TrellisImageTo3DPipeline.from_pretrained(where)
        pipeline.to(self.choice.device)
        return pipeline

    def run(self, model: Any, image: np.ndarray, mask: np.ndarray) -> tuple[Gaussians, PinholeCamera]:
        from PIL import Image

        prepared = preprocess(image, mask)
        out = model.run(
            Image.fromarray(prepared.image), seed=self.choice.seed, formats=["gaussian"], preprocess_image=False,
            sparse_structure_sampler_params={"steps": 12, "cfg_strength": 7.5},
            slat_sampler_params={"steps": 12, "cfg_strength": 3.0},
        )  # fmt: skip
        raw = read_getters(out["gaussian"][0])
        body, camera, _ = to_canonical(raw, image, mask, field_of_view=self.choice.field_of_view)
        return body, camera
