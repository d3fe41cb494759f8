"""GeoCalib (Veicht et al. 2024, ETH Zurich and Microsoft): tilt and focal length from one picture.

Its network sees a perspective field, to which a camera is fitted (`perspective_field`). Network and fit are written
here, so that no package beside torch is needed (the authors' own brings another build of OpenCV, which takes the place
of the one that fluidlift uses); the weights are theirs.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from fluidlift.backends.depth_pictures import require_picture, to_tensor
from fluidlift.backends.model_weights import Announce, fill_network, read_state_dict, say
from fluidlift.backends.pair_network import memory_errors, torch_device
from fluidlift.backends.perspective_field import PerspectiveField, fitted_view
from fluidlift.backends.view_model import ViewGuess, ViewModel
from fluidlift.types import PinholeCamera

LICENCE = (
    "GeoCalib: the authors' code is Apache-2.0, their weights CC BY 4.0 (name them: Veicht, Sarlin, Lindenberger, "
    "Pollefeys, GeoCalib, ECCV 2024)."
)
FILE = "geocalib-pinhole.tar"
SHORTER, LONGEST = 320, 960
"""px of the shorter side, as in training, and of the longer one at most: what lies farther from the middle is cut"""
PITCH_ERROR, ROLL_ERROR, VIEW_ERROR = 4.5, 1.5, 8.0
"""degrees, standard errors of pitch, roll and vertical field of view where the model itself is sure. From the areas
under the recall curve up to 10 degrees that the authors publish: what such an area lacks of 1 is a tenth of the mean
error, cut at 10 degrees, and a Gaussian one has 0.8 of its standard deviation. The worst of their four benchmarks
(67.5, 89.8 and 47.6 %) gives 4.1, 1.3 and 7.3: a little more here, as none of them is of fluids. Nothing was measured
here"""
MOST_BYTES = 512 * 2**20
"""of a file of weights: the published one has 116 MB"""


class GeoCalib(ViewModel):
    """Tilt and focal length by GeoCalib.

    Args:
        weights: the authors' geocalib-pinhole.tar (a checkpoint of torch, whatever its name says), the same tensors as
            .safetensors, or a folder with the first.
        device: "cpu", "cuda", "cuda:1"...
        announce: is told the licence before the weights are touched.

    Raises:
        InputRejected: no such file, or weights of another network.
        FluidliftError: no such device.
    """

    def __init__(self, weights: Path | str, *, device: str = "cpu", announce: Announce = say) -> None:
        from fluidlift.backends.geocalib_network import GeoCalibNetwork, GeoCalibShape, completed_state

        self._device = torch_device(device)
        announce(LICENCE)
        path = Path(weights)
        path = path / FILE if path.is_dir() else path
        state = read_state_dict(path, purpose="weights of GeoCalib", max_bytes=MOST_BYTES)
        network = GeoCalibNetwork(GeoCalibShape.of(state, path.name))
        fill_network(network, completed_state(state, network), path.name, f"{FILE} of its authors")
        self._network = network.eval().to(self._device)

    def field(self, image: np.ndarray) -> tuple[PerspectiveField, float]:
        """The perspective field of a u8 [H,W,3] picture, and px of the field per px of the picture.

        The field is that of the middle of the picture: its sides are multiples of the network's stride.

        Raises:
            FluidliftError: memory ran out.
        """
        import torch

        from fluidlift.backends.geocalib_network import STRIDE

        require_picture(image)
        scale = SHORTER / min(image.shape[:2])
        most = int(LONGEST / scale)
        rows, columns = (slice(max(0, (n - most) // 2), max(0, (n - most) // 2) + most) for n in image.shape[:2])
        middle = image[rows, columns]
        height, width = (max(SHORTER, round(n * scale)) for n in middle.shape[:2])
        top, left = (height % STRIDE // 2, width % STRIDE // 2)
        with memory_errors(self._device), torch.inference_mode():
            picture = to_tensor(middle, (height, width), (0.0,) * 3, (1.0,) * 3, self._device, "bilinear")
            inside = picture[..., top : top + height // STRIDE * STRIDE, left : left + width // STRIDE * STRIDE]
            up, up_trust, latitude, latitude_trust = (p[0].float().cpu().numpy() for p in self._network(inside))
        return PerspectiveField(up.transpose(1, 2, 0), up_trust, latitude, latitude_trust), scale

    def guess(self, image: np.ndarray, camera: PinholeCamera | None) -> ViewGuess | None:
        """Tilt, and focal length where the camera is not known; None where the field says nothing.

        Its own standard errors (of the fit) are joined with those of its benchmarks.

        Raises:
            FluidliftError: memory ran out.
        """
        field, scale = self.field(image)
        known = None if camera is None else camera.focal[0] * image.shape[1] / camera.size[0]
        found = fitted_view(field, None if known is None else known * scale)
        if found is None:
            return None
        focal = found.focal / scale if known is None else known
        own = np.sqrt(np.diagonal(found.covariance))
        # focal length by field of view: d log f = d fov / sin(fov), of the side that the benchmarks measure
        view = 2.0 * np.arctan(0.5 * image.shape[0] / focal)
        benchmark = 0.0 if known is not None else np.radians(VIEW_ERROR) / np.sin(view)
        by_focal = 0.0 if known is not None else found.covariance[0, 2] / found.covariance[2, 2]
        return ViewGuess(
            found.pitch, found.roll, float(focal), float(np.hypot(own[0], PITCH_ERROR)),
            float(np.hypot(own[1], ROLL_ERROR)), float(np.hypot(own[2], benchmark)), float(by_focal),
        )  # fmt: skip
