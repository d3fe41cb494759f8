"""MoGe-2 (Wang et al. 2025, Microsoft) as an ONNX file, by ONNX Runtime: the same network without its authors' package.

The authors' export is the bare network. It gives points that are right up to a shift along the view (an affine point
map), in units of its own; focal length and shift are found here, by which the points fall onto the pixels where they
are seen: least squares of f x / (z + s) - u over both axes, as in section 3 of MoGe's paper (Wang et al. 2024).
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from fluidlift.backends.depth_model import DepthModel, Guess
from fluidlift.backends.depth_pictures import longer_field_of_view, require_answer, require_picture
from fluidlift.backends.model_weights import Announce, say
from fluidlift.backends.onnx_file import read_onnx
from fluidlift.errors import FluidliftError, InputRejected, MissingPackage
from fluidlift.types import PinholeCamera

LICENCE = "MoGe: weights are MIT (Microsoft), its encoder DINOv2 Apache-2.0 (Meta)."
INSTALL = "pip install 'fluidlift[onnx]'"
FILE = "model.onnx"
TOKENS = 2500
"""patches of 14 px that the network looks at: the upper end of what its authors advise (1200 to 2500)"""
SEEN = 0.5
"""probability that a pixel has a depth, from which on it is believed to have one: the authors'"""
FLAT = 1e-6
"""of the squared places of the pixels, by which two fits differ that are alike: a thousandth of each place"""
FEWEST, MOST_POINTS = 16, 4096
"""points that focal length and shift are found from, at least and at most (the authors take 64 x 64)"""
SCALES = ("scale", "metric_scale")
"""names of the output that makes metres: that of the published files, and that of the authors' script"""


class MogeOnnx(DepthModel):
    """Depth by MoGe-2's ONNX export.

    Args:
        weights: the authors' `model.onnx` (the one for any size of picture), or a folder with it.
        device: "cpu", "cuda", "cuda:1"...
        allow_download: not used: nothing is fetched.
        announce: is told the licence before the file is opened.

    Raises:
        MissingPackage: ONNX Runtime is missing.
        InputRejected: no such file, or not MoGe's.
        FluidliftError: no such device.
        ValueError: another name of a device.
    """

    def __init__(
        self, weights: Path | str, *, device: str = "cpu", allow_download: bool = False, announce: Announce = say
    ) -> None:
        runtime = _runtime()
        providers = _providers(runtime, device)
        announce(LICENCE)
        path = Path(weights)
        path = path / FILE if path.is_dir() else path
        data = read_onnx(path, "MoGe-2's export")
        options = runtime.SessionOptions()
        options.log_severity_level = 3  # errors, which are raised as well
        try:
            self._session = runtime.InferenceSession(data, options, providers=providers)
        except _errors(runtime) as error:
            reason = " ".join(str(error).split())[:200]
            raise InputRejected(
                f"'{path.name}' cannot be loaded ({reason})", "MoGe-2's export", "copy it again"
            ) from None
        self._errors = _errors(runtime)
        self._outputs, self._scale = _named(self._session, path.name)

    @property
    def metric(self) -> bool:
        """Whether it gives metres."""
        return self._scale is not None

    def guess(self, image: np.ndarray, camera: PinholeCamera | None) -> Guess:
        """Depth (metres where the file has a scale, else up to a factor), field of view, and normals if it has them.

        Raises:
            InputRejected: it finds no depth at all, or its answer has not the shape of the picture.
            FluidliftError: it broke down, such as for lack of memory.
        """
        require_picture(image)
        height, width = image.shape[:2]
        found = self._answers(image)
        points, seen = found["points"], found["mask"] > SEEN
        seen &= np.isfinite(points).all(axis=-1)
        diagonal = float(np.hypot(width, height))
        known = None if camera is None else camera.focal[0] * width / camera.size[0] / (0.5 * diagonal)
        solved = focal_and_shift(points, seen, known)
        if solved is None:
            require_answer(np.zeros((height, width), np.float32), "MoGe")
            raise AssertionError  # the line above does not return
        focal, shift = solved
        scale = 1.0 if self._scale is None else float(found[self._scale].reshape(-1)[0])
        depth = require_answer(np.where(seen, (points[..., 2] + shift) * scale, np.nan), "MoGe")
        horizontal = float(2.0 * np.degrees(np.arctan(width / (focal * diagonal))))
        normals = found.get("normal")
        return Guess(
            depth, "metres" if self.metric else "relative", longer_field_of_view(horizontal, (height, width)),
            None if normals is None else _unit(normals, np.isfinite(depth)),
        )  # fmt: skip

    def _answers(self, image: np.ndarray) -> dict[str, np.ndarray]:
        """What the network says, by name: points [h,w,3], mask [h,w]; normal [h,w,3] and the scale if it has them."""
        height, width = image.shape[:2]
        fed = {
            "image": np.ascontiguousarray(image.transpose(2, 0, 1)[None], np.float32) / np.float32(255.0),
            "num_tokens": np.array(TOKENS, np.int64),
        }
        try:
            raw = self._session.run(list(self._outputs), fed)
        except self._errors as error:
            reason = " ".join(str(error).split())[:200]
            raise FluidliftError(
                f"MoGe broke down ({reason}). Needed: memory for pictures of {width} x {height} px. Do: lower "
                "read.max_size, or check that the file is MoGe-2's export."
            ) from None
        found = {}
        wanted = {"points": (1, height, width, 3), "normal": (1, height, width, 3), "mask": (1, height, width)}
        for name, value in zip(self._outputs, raw, strict=True):
            value = np.asarray(value, np.float32)
            if not value.size or (name in wanted and value.shape != wanted[name]):
                raise InputRejected(
                    f"MoGe's export gives '{name}' of {list(value.shape)}", str(list(wanted.get(name, (1,)))),
                    "take the authors' file for any size of picture",
                )  # fmt: skip
            found[name] = value[0] if name in wanted else value
        return found


def focal_and_shift(
    points: Float[np.ndarray, "h w 3"], seen: Bool[np.ndarray, "h w"], focal: float | None = None
) -> tuple[float, float] | None:
    """Focal length, in halves of the picture's diagonal, and what is to be added to z; None where too little is seen.

    Args:
        points: of each pixel, in camera axes up to factor and shift.
        seen: pixels whose points count.
        focal: where it is known.
    """
    from scipy.optimize import minimize_scalar

    height, width = seen.shape
    rows, columns = np.nonzero(seen)
    if len(rows) < FEWEST:
        return None
    pick = np.unique(np.linspace(0, len(rows) - 1, MOST_POINTS).astype(int))
    rows, columns = rows[pick], columns[pick]
    half = 0.5 * np.hypot(width, height)
    uv = np.stack([columns + 0.5 - 0.5 * width, rows + 0.5 - 0.5 * height], axis=-1) / half
    xy, z = (np.asarray(a, np.float64) for a in (points[rows, columns, :2], points[rows, columns, 2]))

    def best(shift: float) -> tuple[float, float]:
        seen_at = xy / (z + shift)[:, None]
        f = float((seen_at * uv).sum() / max((seen_at**2).sum(), 1e-30)) if focal is None else focal
        return f, float(((f * seen_at - uv) ** 2).sum())

    # all points lie before the camera: z + s > 0; of s, the distance of the nearest one, only the magnitude is open
    deep = max(float(np.ptp(z)), float(np.abs(xy).max()), 1e-9)
    nearest = np.geomspace(1e-3, 1e3, 61) * deep
    k = int(np.argmin([best(n - z.min())[1] for n in nearest]))
    around = np.log(nearest[[max(k - 1, 0), min(k + 1, len(nearest) - 1)]])
    found = minimize_scalar(
        lambda n: best(float(np.exp(n)) - z.min())[1], bounds=tuple(around), method="bounded", options={"xatol": 1e-7}
    )
    shift = float(np.exp(found.x)) - float(z.min())
    # of a wall that is seen straight on every shift is as good: then none
    if z.min() > 0.0 and best(0.0)[1] <= best(shift)[1] + FLAT * float((uv**2).sum()):
        shift = 0.0
    f = best(shift)[0]
    return (f, shift) if np.isfinite(f) and f > 0.0 else None


def _unit(normals: np.ndarray, known: np.ndarray) -> np.ndarray:
    """float32 [h,w,3], nan where there is no depth or no direction."""
    length = np.linalg.norm(normals, axis=-1, keepdims=True)
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.where(known[..., None] & (length > 0.5), normals / length, np.nan).astype(np.float32)


def _runtime() -> Any:
    try:
        import onnxruntime  # pyright: ignore[reportMissingImports]
    except ImportError as error:
        reason = str(error).partition("\n")[0]
        raise MissingPackage(
            f"onnxruntime is not installed, or does not start ({reason}). Needed: for MoGe's ONNX file. Do: {INSTALL}."
        ) from None
    return onnxruntime


def _providers(runtime: Any, device: str) -> list[Any]:
    from fluidlift.errors import require

    known = device in ("cpu", "cuda") or (device.startswith("cuda:") and device[5:].isdecimal())
    require(known, f"device '{device}'", "cpu, cuda or cuda:0, cuda:1...")
    if device == "cpu":
        return ["CPUExecutionProvider"]
    if "CUDAExecutionProvider" not in runtime.get_available_providers():
        raise FluidliftError(
            f"Device '{device}' is not there: this ONNX Runtime has no CUDA. Needed: an NVIDIA GPU and onnxruntime-gpu "
            "in place of onnxruntime. Do: install it, or choose the CPU."
        )
    return [("CUDAExecutionProvider", {"device_id": int(device[5:] or 0)}), "CPUExecutionProvider"]


def _errors(runtime: Any) -> tuple[type[BaseException], ...]:
    """What ONNX Runtime raises: its own classes have no common one but Exception."""
    state = runtime.capi.onnxruntime_pybind11_state
    kinds = [v for v in vars(state).values() if isinstance(v, type) and issubclass(v, Exception)]
    return (*kinds, RuntimeError, ValueError, MemoryError)


def _named(session: Any, name: str) -> tuple[tuple[str, ...], str | None]:
    """Names of the outputs that are asked for, and of the one that makes metres.

    Raises:
        InputRejected: other inputs or outputs than MoGe's.
    """
    inputs, outputs = {i.name: i for i in session.get_inputs()}, {o.name: o for o in session.get_outputs()}
    kinds = {k: v.type for k, v in inputs.items()}
    if kinds != {"image": "tensor(float)", "num_tokens": "tensor(int64)"}:
        raise InputRejected(
            f"'{name}' takes {kinds or 'nothing'}", "image (float) and num_tokens (int64)",
            "take the authors' export for any size of picture",
        )  # fmt: skip
    shape = inputs["image"].shape
    if len(shape) != 4 or any(isinstance(side, int) for side in shape[2:]):
        raise InputRejected(f"'{name}' takes pictures of {list(shape)} alone", "an export for any size of picture")
    if not {"points", "mask"} <= outputs.keys():
        raise InputRejected(f"'{name}' gives {', '.join(outputs)}", "points and mask", "take MoGe-2's export")
    scale = next((s for s in SCALES if s in outputs), None)
    asked = ["points", "mask", *(["normal"] if "normal" in outputs else []), *([scale] if scale else [])]
    return tuple(asked), scale
