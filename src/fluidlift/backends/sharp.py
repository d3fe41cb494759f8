"""SHARP (Apple 2025): a whole picture to about a million Gaussians of the scene in front of the camera, in metres.

What it expects and returns was read in its code (sharp/cli/predict.py, sharp/utils/{gaussians,io,color_space}.py). It
sees the scene, not one body: of the result, what the picture shows as fluid is kept.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, UInt8
from scipy import ndimage

from fluidlift.backends.generator_card import GeneratorCard
from fluidlift.backends.generator_loading import InProcessGenerator, array
from fluidlift.backends.generator_view import Z_UP_FROM_OPENCV, Crop, Prepared
from fluidlift.backends.model_weights import read_state_dict
from fluidlift.errors import InputRejected
from fluidlift.types import Gaussians, PinholeCamera, RigidTransform, Similarity3, sh_from_rgb

CARD = GeneratorCard(
    name="sharp",
    title="SHARP (Apple, 2025)",
    licence=(
        "Code under Apple's own licence (LICENSE in its repository); the weights are for research only "
        "(LICENSE_MODEL): no commercial use."
    ),
    licence_commercial=False,
    home="https://github.com/apple/ml-sharp",
    packages=("sharp",),
    hardware="a GPU with 12 GB, an Apple chip, or a CPU with 16 GB (slower)",
    weights=("ml-site.cdn-apple.com/models/sharp/sharp_2572gikvuh.pt",),
    notes=(
        "Scene level: for rivers, falls and other things that do not stand alone. It makes the seen side only.",
        "Distances in metres. Its vertical is the picture's, whatever the tilt of the camera.",
        "It blends in linear light; colours are turned to sRGB one by one, so that soft edges differ a little.",
    ),
    install=("git clone https://github.com/apple/ml-sharp", "pip install ./ml-sharp"),
    needs_gpu=False,
    metric=True,
)

USUAL_FOCAL = 30.0
"""mm on 36 x 24 mm film, where nobody knows better, as in its own tool"""
BEHIND = 0.05
"""of the distance: what is farther behind the nearest layer belongs to something else"""


def focal_length(size: tuple[int, int], field_of_view: float | None = None) -> float:
    """px: of a field of view (degrees across the longer side), or of a 30 mm lens on film by the diagonal."""
    if field_of_view is None:
        return USUAL_FOCAL * math.hypot(*size) / math.hypot(36.0, 24.0)
    return 0.5 * max(size) / math.tan(math.radians(field_of_view) / 2)


def preprocess(image: UInt8[np.ndarray, "h w 3"], mask: Bool[np.ndarray, "h w"]) -> Prepared:
    """The whole picture as it is: its own code stretches it to 1536 x 1536 and back. The mask is for afterwards."""
    height, width = mask.shape
    return Prepared(image, Crop((1.0, 1.0), (0.0, 0.0), (width, height)), mask.astype(np.float32))


def srgb_from_linear(linear: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n 3"]:
    """Colours for the screen from those proportional to light (IEC 61966-2-1)."""
    x = np.maximum(linear, 0.0)
    return np.where(x <= 0.0031308, 12.92 * x, 1.055 * np.maximum(x, 0.0031308) ** (1 / 2.4) - 0.055)


def to_canonical(
    raw: Mapping[str, Any], crop: Crop, size: tuple[int, int], focal: float
) -> tuple[Gaussians, PinholeCamera]:
    """The scene and the camera of the picture, at the origin and level, looking along y.

    Args:
        raw: mean_vectors [1,n,3], singular_values [1,n,3], quaternions [1,n,4] (w x y z), colors [1,n,3] (linear
            RGB), opacities [1,n], as in its `Gaussians3D`: activated, metres, OpenCV axes.
        crop: of `preprocess`.
        size: of the original picture, px.
        focal: px, as the model was told it.
    """
    means = array(raw["mean_vectors"]).reshape(-1, 3)
    n = len(means)
    colours = sh_from_rgb(srgb_from_linear(array(raw["colors"]).reshape(n, 3)))
    scales, quats = array(raw["singular_values"]).reshape(n, 3), array(raw["quaternions"]).reshape(n, 4)
    body = Gaussians(means, quats, scales, array(raw["opacities"]).reshape(n), colours)
    pose = RigidTransform(Z_UP_FROM_OPENCV.T)
    (w, h) = crop.size
    camera = PinholeCamera((focal, focal), (w / 2, h / 2), (w, h), pose)
    return body.transformed(Similarity3(rotation=Z_UP_FROM_OPENCV)), crop.camera(camera, size)


def fluid_of(gaussians: Gaussians, camera: PinholeCamera, mask: Bool[np.ndarray, "h w"]) -> Gaussians:
    """Those whose centre appears on the fluid and is not behind it: SHARP makes a second layer of what is hidden."""
    uv, z = camera.project(gaussians.means)
    height, width = mask.shape
    row, col, _ = camera.nearest_pixels(gaussians.means)
    inside = (z > 0) & (uv >= 0).all(1) & (uv[:, 0] < width) & (uv[:, 1] < height) & mask[row, col]
    solid = inside & (gaussians.opacities > 0.1)
    near = np.full(mask.shape, np.inf)
    np.minimum.at(near, (row[solid], col[solid]), z[solid])
    radius = np.median(gaussians.scales[solid].max(axis=1) / z[solid]) * camera.focal[0] if solid.any() else 1.0
    near = ndimage.minimum_filter(near, size=2 * int(np.clip(np.ceil(radius), 1, 8)) + 1)  # each covers its neighbours
    return gaussians.select(inside & (z <= (1.0 + BEHIND) * near[row, col]))


class SharpGenerator(InProcessGenerator):
    """The authors' network, in process on any device, with weights read as tensors alone."""

    card = CARD
    knows_up = False

    def load(self) -> Any:
        import importlib

        models = importlib.import_module("sharp.models")
        network = models.create_predictor(models.PredictorParams())
        network.load_state_dict(self._state())
        return network.eval().to(self.choice.device)

    def run(self, model: Any, image: np.ndarray, mask: np.ndarray) -> tuple[Gaussians, PinholeCamera]:
        import importlib

        import torch

        predict = importlib.import_module("sharp.cli.predict").predict_image
        prepared, size = preprocess(image, mask), (mask.shape[1], mask.shape[0])
        focal = focal_length(size, self.choice.field_of_view)
        torch.manual_seed(self.choice.seed)
        scene = predict(model, prepared.image, focal, torch.device(self.choice.device))
        names = ("mean_vectors", "singular_values", "quaternions", "colors", "opacities")
        body, camera = to_canonical({name: getattr(scene, name) for name in names}, prepared.crop, size, focal)
        return fluid_of(body, camera, mask), camera

    def _state(self) -> dict[str, Any]:
        purpose = f"weights of {CARD.title}"
        if self.choice.weights is not None:
            path = Path(self.choice.weights)
            return read_state_dict(path / "sharp_2572gikvuh.pt" if path.is_dir() else path, purpose=purpose)
        import torch

        name = CARD.weights[0]
        cached = Path(torch.hub.get_dir()) / "checkpoints" / name.rpartition("/")[2]
        if not cached.is_file() and not self.choice.allow_download:
            raise InputRejected(
                f"no weights: '{cached.name}' is not on this machine", "the file, or leave to fetch it",
                "name the weights, or allow the download",
            )  # fmt: skip
        if not cached.is_file():
            cached.parent.mkdir(parents=True, exist_ok=True)
            torch.hub.download_url_to_file(f"https://{name}", str(cached), progress=True)
        return read_state_dict(cached, purpose=purpose)
