"""LGM (Tang et al. 2024): four pictures around the body by ImageDream, then 65 536 Gaussians of plain colour.

What it expects and returns was read in its code (infer.py, core/gs.py, core/models.py, core/options.py) and in
`kiui.op.recenter`.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import Bool, Float, UInt8

from fluidlift.backends.generator_card import GeneratorCard
from fluidlift.backends.generator_loading import InProcessGenerator, array, hub_file
from fluidlift.backends.generator_view import Z_UP_FROM_Y_UP, Crop, Prepared, box_of, rgba, square_camera
from fluidlift.backends.model_weights import read_state_dict
from fluidlift.errors import require
from fluidlift.types import Gaussians, PinholeCamera, Similarity3, sh_from_rgb

CARD = GeneratorCard(
    name="lgm",
    title="LGM (Tang et al. 2024)",
    licence=(
        "Code and weights MIT (3DTopia). It draws its four views with ImageDream (CreativeML OpenRAIL-M, use-based "
        "restrictions); its rasteriser is a fork of Inria's, for non-commercial use only."
    ),
    licence_commercial=False,
    home="https://github.com/3DTopia/LGM",
    packages=("core", "mvdream", "kiui", "diffusers", "diff_gaussian_rasterization", "rembg", "xformers"),
    hardware="an NVIDIA GPU with 10 GB (its code names CUDA)",
    weights=("ashawkey/LGM/model_fp16_fixrot.safetensors", "ashawkey/imagedream-ipmv-diffusers"),
    notes=(
        "It makes up three further views: good for single bodies, poor for rivers.",
        "Its vertical is the picture's, whatever the tilt of the camera; colours do not depend on the view.",
    ),
    install=(
        "git clone https://github.com/3DTopia/LGM",
        "pip install -r LGM/requirements.txt",
        "export PYTHONPATH=$PWD/LGM",
    ),
)

BORDER = 0.2
"""of the square that is left around the fluid's box"""
SEEN_SIZE = 256
"""px of each of the four views"""
FOV, RADIUS = 49.1, 1.5
"""degrees both ways; distance of the camera from the middle of the body"""
FAINTEST = 0.005
"""opacity below which its own tool leaves a Gaussian out"""
MEAN, DEVIATION = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)
"""of ImageNet's colours"""


def preprocess(image: UInt8[np.ndarray, "h w 3"], mask: Bool[np.ndarray, "h w"]) -> Prepared:
    """A square as large as the longer side of the picture, on white, float32: the fluid's box takes 0.8 of it."""
    import cv2

    height, width = mask.shape
    size = max(height, width)
    left, upper, right, lower = box_of(mask)
    w, h = right - left, lower - upper  # the last row and column are left out, as its own tool does
    scale = int(size * (1 - BORDER)) / max(h, w)
    h2, w2 = int(h * scale), int(w * scale)
    x, y = (size - w2) // 2, (size - h2) // 2
    cut = rgba(image, mask)[upper:lower, left:right].astype(np.float32) / 255.0
    square = np.zeros((size, size, 4), np.float32)
    square[y : y + h2, x : x + w2] = cv2.resize(cut, (w2, h2), interpolation=cv2.INTER_AREA)
    square = (255.0 * square).astype(np.uint8).astype(np.float32) / 255.0
    alpha = square[..., 3]
    seen = square[..., :3] * alpha[..., None] + (1.0 - alpha[..., None])
    ratio = (w2 / w, h2 / h)
    crop = Crop(ratio, (x - left * ratio[0], y - upper * ratio[1]), (size, size))
    return Prepared(seen, crop, alpha)


def seen_camera(crop: Crop) -> PinholeCamera:
    """The camera of the cut-out, z up: at (0, -1.5, 0), looking along y (its own axes: at (0, 0, 1.5), y up)."""
    return square_camera(crop, FOV, Z_UP_FROM_Y_UP @ np.array([0.0, 0.0, RADIUS]))


def to_canonical(
    raw: Float[np.ndarray, "*b n 14"], crop: Crop, size: tuple[int, int]
) -> tuple[Gaussians, PinholeCamera]:
    """Body and camera of the original picture.

    Args:
        raw: what `forward_gaussians` returns, y up: position 3, opacity 1, scale 3, quaternion 4 (w x y z),
            colour 3 (RGB in [0, 1], no harmonics), all activated.
        crop: of `preprocess`.
        size: of the original picture, px.
    """
    table = array(raw)
    table = table[0] if table.ndim == 3 and len(table) == 1 else table
    require(table.ndim == 2 and table.shape[1] == 14, f"Gaussians of shape {np.shape(raw)}", "[n, 14] or [1, n, 14]")
    table = table[table[:, 3] >= FAINTEST]
    body = Gaussians(table[:, :3], table[:, 7:11], table[:, 4:7], table[:, 3], sh_from_rgb(table[:, 11:]))
    return body.transformed(Similarity3(rotation=Z_UP_FROM_Y_UP)), crop.camera(seen_camera(crop), size)


class LgmGenerator(InProcessGenerator):
    """The authors' networks. ImageDream's pipeline is code on the hub: it runs in a process of its own only."""

    card = CARD
    knows_up = False
    foreign_code = "ImageDream with trust_remote_code, which runs code from the hub"

    def load(self) -> Any:
        import importlib

        import torch

        options = importlib.import_module("core.options").config_defaults["big"]
        options.lambda_lpips = 0  # a loss, whose weights would be fetched for nothing
        model = importlib.import_module("core.models").LGM(options)
        path = hub_file("ashawkey/LGM", "model_fp16_fixrot.safetensors", self.choice)
        model.load_state_dict(read_state_dict(path, purpose=f"weights of {CARD.title}"), strict=False)
        model = model.half().to(self.choice.device).eval()
        pipe = importlib.import_module("mvdream.pipeline_mvdream").MVDreamPipeline.from_pretrained(
            "ashawkey/imagedream-ipmv-diffusers", torch_dtype=torch.float16, trust_remote_code=True,
            local_files_only=not self.choice.allow_download,
        )  # fmt: skip
        return model, pipe.to(self.choice.device)

    def run(self, model: Any, image: np.ndarray, mask: np.ndarray) -> tuple[Gaussians, PinholeCamera]:
        import torch
        from torch.nn.functional import interpolate

        network, pipe = model
        prepared, device = preprocess(image, mask), self.choice.device
        random = torch.Generator(device=device).manual_seed(self.choice.seed)
        views = pipe(
            "", prepared.image, guidance_scale=5.0, num_inference_steps=30, elevation=0, generator=random,
            device=torch.device(device),
        )  # fmt: skip
        around = np.stack([views[1], views[2], views[3], views[0]])  # azimuth 0, 90, 180, 270
        colour = torch.from_numpy(around).permute(0, 3, 1, 2).float().to(device)
        colour = interpolate(colour, size=(SEEN_SIZE, SEEN_SIZE), mode="bilinear", align_corners=False)
        mean, deviation = (torch.tensor(x, device=device)[:, None, None] for x in (MEAN, DEVIATION))
        rays = network.prepare_default_rays(device, elevation=0)
        seen = torch.cat([(colour - mean) / deviation, rays], dim=1)[None]
        with torch.inference_mode(), torch.autocast(device_type=device.partition(":")[0], dtype=torch.float16):
            raw = network.forward_gaussians(seen)
        return to_canonical(array(raw), prepared.crop, (mask.shape[1], mask.shape[0]))
