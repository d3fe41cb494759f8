"""TriplaneGaussian (Zou et al. 2024; the paper's default G): one picture to 16 384 Gaussians with harmonics.

What it expects and returns was read in its code (infer.py, tgs/data.py, tgs/models/renderer.py, image_preprocess).
Its own PLY has the harmonics coefficient by coefficient where readers expect them channel by channel: the tensors are
taken instead, and a file of its own tool is read with `read_splats(path, coefficient_major=True)`.
"""

from __future__ import annotations

import importlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, UInt8

from fluidlift.backends.generator_card import GeneratorCard
from fluidlift.backends.generator_loading import InProcessGenerator, array, hub_file
from fluidlift.backends.generator_view import Crop, Prepared, box_of, square_camera
from fluidlift.backends.model_weights import read_state_dict
from fluidlift.errors import MissingPackage
from fluidlift.types import Gaussians, PinholeCamera

CARD = GeneratorCard(
    name="triplane-gaussian",
    title="TriplaneGaussian (Zou et al. 2024)",
    licence=(
        "Code and weights Apache-2.0 (VAST-AI-Research). Its rasteriser, diff-gaussian-rasterization, is Inria's and "
        "for non-commercial use only; its image encoder DINOv2 is Apache-2.0."
    ),
    licence_commercial=False,
    home="https://github.com/VAST-AI-Research/TriplaneGaussian",
    packages=("tgs", "infer", "pointnet2_ops", "torch_scatter", "pytorch3d", "diff_gaussian_rasterization", "einops"),
    hardware="an NVIDIA GPU with 8 GB (its point networks and its rasteriser are CUDA only)",
    weights=("VAST-AI/TriplaneGaussian/model_lvis_rel.ckpt", "facebook/dinov2-base"),
    notes=(
        "One fixed camera distance (1.9); raise it if bodies come out flat.",
        "Its vertical is the picture's, whatever the tilt of the camera.",
    ),
    install=(
        "git clone https://github.com/VAST-AI-Research/TriplaneGaussian",
        "pip install -r TriplaneGaussian/requirements.txt",
        "export PYTHONPATH=$PWD/TriplaneGaussian",
    ),
)

FOREGROUND = 0.75
"""longer side of the fluid's box over the side of the cut-out"""
FIRST_SIZE, CUT_SIZE, SEEN_SIZE = 512, 256, 252
"""px: longer side before the cut, the cut-out, and what the network sees (a multiple of 14)"""
FOV = 40.0
"""degrees, both ways"""
DISTANCE = 1.9
"""of the camera from the middle of the body"""


def preprocess(image: UInt8[np.ndarray, "h w 3"], mask: Bool[np.ndarray, "h w"]) -> Prepared:
    """252 x 252 px on white, float32: 512 px along the longer side first, then a square in which the fluid's box
    takes 0.75, Lanczos to 256, bicubic to 252."""
    from PIL import Image

    height, width = mask.shape
    ratio = FIRST_SIZE / max(width, height)
    first_size = (int(width * ratio), int(height * ratio))
    picture = np.asarray(Image.fromarray(image).resize(first_size, Image.Resampling.LANCZOS))
    shape = np.asarray(
        Image.fromarray(np.where(mask, 255, 0).astype(np.uint8)).resize(first_size, Image.Resampling.BOX)
    )
    inside = shape >= min(128, int(shape.max()))
    first = Crop((first_size[0] / width, first_size[1] / height), (0.0, 0.0), first_size)

    left, upper, right, lower = box_of(inside)
    w, h = right - left + 1, lower - upper + 1
    side = int(max(w, h) / FOREGROUND)
    x, y = side // 2 - w // 2, side // 2 - h // 2
    square = np.zeros((side, side, 4), np.uint8)
    window = (slice(upper, lower + 1), slice(left, right + 1))
    square[y : y + h, x : x + w] = np.dstack([picture, np.where(inside, 255, 0).astype(np.uint8)])[window]
    cut = Crop.of_box((left - x, upper - y, left - x + side, upper - y + side), (SEEN_SIZE, SEEN_SIZE))

    small = Image.fromarray(square).resize((CUT_SIZE, CUT_SIZE), Image.Resampling.LANCZOS)
    seen = np.asarray(small.resize((SEEN_SIZE, SEEN_SIZE)), np.float32) / 255.0
    alpha = seen[..., 3]
    return Prepared(seen[..., :3] * alpha[..., None] + (1.0 - alpha[..., None]), cut.after(first), alpha)


def seen_camera(crop: Crop) -> PinholeCamera:
    """The camera of the cut-out: on the x axis, looking along -x, y to the right, z up."""
    return square_camera(crop, FOV, np.array([DISTANCE, 0.0, 0.0]))


def to_canonical(raw: Mapping[str, Any], crop: Crop, size: tuple[int, int]) -> tuple[Gaussians, PinholeCamera]:
    """Body and camera of the original picture.

    Args:
        raw: xyz [n,3], opacity [n,1], rotation [n,4] (w x y z), scaling [n,3], shs [n,16,3]: activated, z up, as in
            its `GaussianModel`.
        crop: of `preprocess`.
        size: of the original picture, px.
    """
    xyz = array(raw["xyz"])
    n = len(xyz)
    shs = array(raw["shs"]).reshape(n, -1, 3)
    g = Gaussians(xyz, array(raw["rotation"]), array(raw["scaling"]), array(raw["opacity"]).reshape(n), shs)
    return g, crop.camera(seen_camera(crop), size)


def batch_of(prepared: Prepared) -> dict[str, Float[np.ndarray, "..."]]:
    """What its `_forward` takes, as arrays with the axes of batch and view in front."""
    camera = seen_camera(prepared.crop)
    (fx, fy), (cx, cy), (w, h) = camera.focal, camera.center, camera.size
    pose = np.eye(4, dtype=np.float32)
    pose[:3, :3], pose[:3, 3] = camera.camera_from_world.rotation.T, camera.position
    k = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]], np.float32)
    normed = k / np.array([[w], [h], [1]], np.float32)
    arrays = {
        "rgb_cond": prepared.image, "mask_cond": np.asarray(prepared.alpha)[..., None],
        "c2w_cond": pose, "intrinsic_cond": k, "intrinsic_normed_cond": normed,
        "c2w": pose, "intrinsic": k, "intrinsic_normed": normed,
    }  # fmt: skip
    return {name: np.asarray(value, np.float32)[None, None] for name, value in arrays.items()}


class TriplaneGaussianGenerator(InProcessGenerator):
    """The authors' network, with weights read as tensors alone (its own loader would unpickle anything)."""

    card = CARD
    knows_up = False

    def load(self) -> Any:
        infer = importlib.import_module("infer")
        if not hasattr(infer, "TGS"):
            raise MissingPackage(
                f"{CARD.title} is not installed here (another module is named 'infer'). "
                "Needed: its folder first on PYTHONPATH. Do: export PYTHONPATH=/path/to/TriplaneGaussian."
            )
        config = importlib.import_module("tgs.utils.config")
        path = Path(str(infer.__file__)).with_name("config.yaml")
        cfg = config.load_config(str(path), cli_args=[])
        cfg.system.weights = None
        state = read_state_dict(
            hub_file("VAST-AI/TriplaneGaussian", "model_lvis_rel.ckpt", self.choice), purpose=f"weights of {CARD.title}"
        )
        model = infer.TGS(cfg.system)
        model.load_state_dict(state, strict=False)
        return model.to(self.choice.device).eval()

    def run(self, model: Any, image: np.ndarray, mask: np.ndarray) -> tuple[Gaussians, PinholeCamera]:
        import torch

        prepared = preprocess(image, mask)
        batch: dict[str, Any] = {
            name: torch.from_numpy(value).to(self.choice.device) for name, value in batch_of(prepared).items()
        }
        batch |= {"height": SEEN_SIZE, "width": SEEN_SIZE, "background_color": torch.ones(1, 3).to(self.choice.device)}
        torch.manual_seed(self.choice.seed)
        with torch.inference_mode():
            body = model._forward(batch)["3dgs"][0]
        raw = {name: getattr(body, name) for name in ("xyz", "opacity", "rotation", "scaling", "shs")}
        return to_canonical(raw, prepared.crop, (mask.shape[1], mask.shape[0]))
