"""TripoSplat (VAST 2026): one picture to up to 262 144 Gaussians, and the camera that saw it.

What it expects and returns was read in its code (triposplat.py) and in that of its training, which says what the five
numbers of the camera mean. `run()` throws the camera away; the stages are called one by one instead, without its own
background removal: the mask is known.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, UInt8
from scipy import ndimage

from fluidlift.backends.generator_card import GeneratorCard
from fluidlift.backends.generator_loading import InProcessGenerator, array, hub_file
from fluidlift.backends.generator_view import Crop, Prepared, box_of, rgba, square_camera
from fluidlift.backends.trellis import body_of, read_getters
from fluidlift.errors import FluidliftError, InputRejected, require
from fluidlift.types import Gaussians, PinholeCamera

CARD = GeneratorCard(
    name="triposplat",
    title="TripoSplat (VAST, 2026)",
    licence=(
        "Code and weights MIT (VAST). The weights come with those of DINOv3 (Meta's DINOv3 licence) and of the encoder "
        "of FLUX.2 (Black Forest Labs): read their terms before commercial use."
    ),
    licence_commercial=False,
    home="https://huggingface.co/VAST-AI/TripoSplat",
    packages=("triposplat", "model", "torchvision", "safetensors", "tqdm"),
    hardware="an NVIDIA GPU with 12 GB (a CPU build of others takes about an hour)",
    weights=(
        "VAST-AI/TripoSplat/diffusion_models/triposplat_fp16.safetensors",
        "VAST-AI/TripoSplat/vae/triposplat_vae_decoder_fp16.safetensors",
        "VAST-AI/TripoSplat/vae/flux2-vae.safetensors",
        "VAST-AI/TripoSplat/clip_vision/dino_v3_vit_h.safetensors",
    ),
    notes=("It says itself where the camera stood, and bodies are upright.",),
    install=(
        "git clone https://huggingface.co/VAST-AI/TripoSplat",
        "pip install torch torchvision safetensors tqdm",
        "export PYTHONPATH=$PWD/TripoSplat",
    ),
)

SEEN_SIZE = 1024
"""px"""
ENLARGED = 1.2
"""half the side of the cut-out over half the longer side of the fluid's box"""
ERODED = 1
"""px that the silhouette loses at its edge, at the size at which the box is found"""
STEPS, GUIDANCE, SHIFT = 20, 3.0, 3.0
"""of the sampler, as its own `run` has them"""
COUNT = 262_144
"""Gaussians"""
ORTHOGRAPHIC, FAR = 1e-3, 1000.0
"""inverse distance below which its camera counts as orthographic, and the distance that then stands for infinity"""


def preprocess(image: UInt8[np.ndarray, "h w 3"], mask: Bool[np.ndarray, "h w"]) -> Prepared:
    """1024 x 1024 px on black, u8: the shorter side to 1024 first, the silhouette one pixel less, then a square of 1.2
    times the fluid's box, Lanczos both times."""
    from PIL import Image

    height, width = mask.shape
    ratio = SEEN_SIZE / min(width, height)
    first_size = (max(1, round(width * ratio)), max(1, round(height * ratio)))
    first = Crop((first_size[0] / width, first_size[1] / height), (0.0, 0.0), first_size)
    large = np.array(Image.fromarray(rgba(image, mask)).resize(first_size, Image.Resampling.LANCZOS))
    large[..., 3] = ndimage.minimum_filter(large[..., 3], size=2 * ERODED + 1, mode="nearest")
    if not large[..., 3].any():
        raise InputRejected("fluid thinner than two pixels", "a wider body", "raise --max-size, or check the mask")
    left, upper, right, lower = box_of(large[..., 3] > 0)
    middle = (left + right) / 2, (upper + lower) / 2
    half = max(right - left, lower - upper) / 2 * ENLARGED
    box = [int(x) for x in (middle[0] - half, middle[1] - half, middle[0] + half, middle[1] + half)]
    cut = Image.fromarray(large).crop((box[0], box[1], box[2], box[3]))
    seen = cut.resize((SEEN_SIZE, SEEN_SIZE), Image.Resampling.LANCZOS)
    black = Image.new("RGB", seen.size, (0, 0, 0))
    black.paste(seen, mask=seen.getchannel(3))
    crop = Crop.of_box((box[0], box[1], box[2], box[3]), (SEEN_SIZE, SEEN_SIZE))
    return Prepared(np.asarray(black), crop.after(first), np.asarray(seen.getchannel(3), np.float32) / 255.0)


def seen_camera(crop: Crop, token: Float[np.ndarray, "5"]) -> PinholeCamera:
    """The camera of the cut-out, looking at the origin, z up.

    Args:
        crop: of `preprocess`.
        token: direction from the origin to the camera (3), inverse distance, half the width seen at the origin.

    Raises:
        FluidliftError: numbers that mean no camera.
    """
    token = np.asarray(token, np.float64).ravel()
    require(token.shape == (5,), f"a camera of {token.size} numbers", "5")
    norm, inverse, half = float(np.linalg.norm(token[:3])), float(token[3]), float(token[4])
    if not np.isfinite(token).all() or norm < 1e-6 or half <= 0:
        raise FluidliftError(
            f"{CARD.title} returned no camera ({np.array2string(token, precision=3)}). Do: try another seed."
        )
    distance = FAR if inverse < ORTHOGRAPHIC else 1.0 / inverse
    fov = 2.0 * math.degrees(math.atan(half / distance))
    if not 0.01 < fov < 170.0:
        raise FluidliftError(f"{CARD.title} returned a field of view of {fov:.3g} degrees. Do: try another seed.")
    eye = distance * token[:3] / norm
    wide = square_camera(crop, 60.0, eye)  # the field of view is set below: it may be less than cameras are made with
    f = 0.5 / math.tan(math.radians(fov) / 2)
    return PinholeCamera((f * crop.size[0], f * crop.size[1]), wide.center, wide.size, wide.camera_from_world)


def to_canonical(
    raw: Mapping[str, Any], token: Float[np.ndarray, "*b 5"], crop: Crop, size: tuple[int, int]
) -> tuple[Gaussians, PinholeCamera]:
    """Body and camera of the original picture.

    Args:
        raw: as for `trellis.body_of`: its class of Gaussians is the same.
        token: the camera that `sample_latent` returns, [1,1,5] or [5].
        crop: of `preprocess`.
        size: of the original picture, px.
    """
    return body_of(raw), crop.camera(seen_camera(crop, array(token).ravel()), size)


class TripoSplatGenerator(InProcessGenerator):
    """The authors' networks, all of them safetensors."""

    card = CARD
    knows_up = True

    def load(self) -> Any:
        import importlib

        import torch

        splat = importlib.import_module("triposplat")
        device = torch.device(self.choice.device)
        flow, decoder, vae, eyes = (
            str(hub_file("VAST-AI/TripoSplat", name.removeprefix("VAST-AI/TripoSplat/"), self.choice))
            for name in CARD.weights
        )
        half = torch.float16 if device.type == "cuda" else torch.float32
        wide = torch.bfloat16 if device.type == "cuda" else torch.float32
        return (
            splat,
            splat.load_dinov3(eyes, device=device, dtype=wide),
            splat.load_vae_encoder(vae, device=device, dtype=wide),
            splat.load_flow_model(flow, device=device, dtype=half),
            splat.load_decoder(decoder, device=device, dtype=half),
        )

    def run(self, model: Any, image: np.ndarray, mask: np.ndarray) -> tuple[Gaussians, PinholeCamera]:
        import torch
        from PIL import Image

        splat, eyes, vae, flow, decoder = model
        prepared = preprocess(image, mask)
        random = torch.Generator(device=torch.device(self.choice.device)).manual_seed(self.choice.seed)
        with torch.inference_mode():
            seen = splat.encode_image(Image.fromarray(prepared.image), eyes, vae, generator=random)
            out = splat.sample_latent(flow, seen, steps=STEPS, guidance_scale=GUIDANCE, shift=SHIFT, generator=random)
            if "camera" not in out:
                raise FluidliftError(f"these weights of {CARD.title} return no camera. Do: take its newest weights.")
            body = decoder.decode(out["latent"], num_gaussians=COUNT)
        size = (mask.shape[1], mask.shape[0])
        return to_canonical(read_getters(body), array(out["camera"]), prepared.crop, size)
