"""Segmentation by SAM 2 (Ravi et al. 2024) through transformers: it is shown a few points and follows them in time.

Frames are prepared here, one by one, with the sizes and means that the model was trained with: transformers' own
preparation needs torchvision, and holds the whole clip in memory.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import numpy as np

from fluidlift.backends.mask_prompts import PointPrompts, clicks_from, labels_of_frame, ordered_from
from fluidlift.backends.model_weights import Announce, missing, say
from fluidlift.backends.pair_network import memory_errors, torch_device
from fluidlift.errors import InputRejected, MissingPackage
from fluidlift.messages import Notice
from fluidlift.seams import Segmenter
from fluidlift.types import Label, PixelFlow, PixelLabels, VideoClip

Guess = Callable[[VideoClip, PixelFlow], PixelLabels]
"""a first guess of where the fluid is"""
Progress = Callable[[int, int], None]
"""called with (frames done, frames in all)"""

LICENCE = "SAM 2: code and weights are Apache-2.0 (Meta). Repackaged weights may carry another licence: see their page."
MEAN, SPREAD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)
"""of sRGB from 0 to 1, by which the model's input is normalised (those of ImageNet)"""


class Sam2Video(Segmenter):
    """Fluid by SAM 2, started from the surest part of a first guess.

    Args:
        weights: folder of the model (config.json and .safetensors), or its name on the hub where downloads are allowed.
        guess: what is fluid, roughly; None: `shape.segment`.
        device: "cpu", "cuda", "cuda:1"...
        allow_download: whether files that are not there may be fetched.
        announce: is told the licence before the weights are touched.
        progress: called after each frame.

    Raises:
        MissingPackage: transformers is missing.
        InputRejected: no such folder, no .safetensors in it, or weights of another model.
        FluidliftError: no such device.
    """

    def __init__(
        self,
        weights: Path | str,
        *,
        guess: Guess | None = None,
        device: str = "cpu",
        allow_download: bool = False,
        announce: Announce = say,
        progress: Progress | None = None,
    ) -> None:
        self._device = torch_device(device)
        announce(LICENCE)
        self._model = loaded_model(weights, "sam2_video", "Sam2VideoModel", allow_download).to(self._device)
        self._guess, self._progress = guess or first_guess, progress

    def segment(
        self, clip: VideoClip, flow: PixelFlow, *, out: tuple[np.ndarray, np.ndarray] | None = None
    ) -> PixelLabels:
        """Labels of every frame: fluid where the model says so, solid where that encloses something.

        Beyond the result (`out` where given) and the first guess, memory is that of some twenty frames of features,
        whatever the length of the clip.

        Raises:
            InputRejected: the first guess finds no fluid, or the model loses it in every frame.
            FluidliftError: memory ran out.
        """
        clicks = clicks_from(self._guess(clip, flow))
        labels, confidence = out or empty_labels(clip)
        done = 0
        with memory_errors(self._device):
            for t, chance in self.chances(clip.frames, clicks):
                labels[t] = labels_of_frame(chance > 0.5)
                confidence[t] = np.abs(2 * chance - 1)
                done += 1
                if self._progress is not None:
                    self._progress(done, len(clip))
        return checked_labels(labels, confidence, "SAM 2")

    def chances(self, frames: np.ndarray, clicks: PointPrompts) -> Iterable[tuple[int, np.ndarray]]:
        """Frame number and probability of fluid (float32 [H,W]), from the clicked frame on, then back from it."""
        import torch
        from transformers.models.sam2_video.modeling_sam2_video import Sam2VideoInferenceSession

        height, width = frames.shape[1:3]
        side = int(self._model.config.image_size)
        session = Sam2VideoInferenceSession(
            video_height=height,
            video_width=width,
            inference_device=self._device,
            inference_state_device=self._device,
            video_storage_device=self._device,
            dtype=torch.float32,
        )
        scale = torch.tensor([side / width, side / height])
        session.add_point_inputs(
            session.obj_id_to_idx(1),
            clicks.frame,
            {
                "point_coords": (torch.from_numpy(clicks.points) * scale)[None, None],
                "point_labels": torch.from_numpy(clicks.fluid.astype(np.int32))[None, None],
            },
        )
        session.obj_with_new_inputs = [1]
        for reverse, order in enumerate(ordered_from(clicks.frame, len(frames))):
            session.output_dict_per_obj[0]["non_cond_frame_outputs"].clear()  # each direction remembers its own past
            for t in map(int, order):
                with torch.inference_mode():
                    picture = normalised(frames[t], side, MEAN, SPREAD, self._device)
                    out = self._model(session, frame=picture, frame_idx=t, reverse=bool(reverse))
                    chance = probability(out.pred_masks[0], (height, width))
                self._forget(session, t)
                yield t, chance

    def _forget(self, session: Any, t: int) -> None:
        """Drop what no later frame looks at."""
        session.processed_frames.pop(t, None)
        reach = max(self._model.config.num_maskmem, self._model.config.max_object_pointers_in_encoder)
        kept = session.output_dict_per_obj[0]["non_cond_frame_outputs"]
        for old in [k for k in kept if abs(k - t) > reach]:
            del kept[old]


def first_guess(clip: VideoClip, flow: PixelFlow) -> PixelLabels:
    """What `shape.segment` says."""
    from fluidlift.shape.segment import segment

    return segment(clip, flow)


def normalised(picture: np.ndarray, side: int, mean: tuple, spread: tuple, device: Any) -> Any:
    """float32 [1,3,side,side] of a u8 [H,W,3] picture, stretched to a square as the models expect."""
    import torch

    values = torch.from_numpy(np.ascontiguousarray(picture)).to(device).permute(2, 0, 1)[None].float() / 255.0
    values = torch.nn.functional.interpolate(values, (side, side), mode="bilinear", antialias=True)
    shape = (1, 3, 1, 1)
    return (values - values.new_tensor(mean).view(shape)) / values.new_tensor(spread).view(shape)


def probability(logits: Any, size: tuple[int, int]) -> np.ndarray:
    """float32 [H,W]: chance that a pixel belongs to any of the objects of `logits` [n,1,h,w] or [n,h,w]."""
    import torch

    stacked = logits.reshape(-1, 1, *logits.shape[-2:]).float()
    fine = torch.nn.functional.interpolate(stacked, size, mode="bilinear", align_corners=False)
    return fine.amax(dim=0)[0].sigmoid().cpu().numpy()


def empty_labels(clip: VideoClip) -> tuple[np.ndarray, np.ndarray]:
    """Labels u8 [T,H,W] and confidence float16 [T,H,W] to be filled."""
    return np.zeros(clip.frames.shape[:3], np.uint8), np.zeros(clip.frames.shape[:3], np.float16)


def checked_labels(labels: np.ndarray, confidence: np.ndarray, model: str) -> PixelLabels:
    """The labels, with a warning about frames in which the model lost the fluid.

    Raises:
        InputRejected: in all of them.
    """
    lost = [t for t, frame in enumerate(labels) if not (frame == Label.FLUID).any()]
    if len(lost) == len(labels):
        raise InputRejected(
            f"{model} found no fluid in any frame", "a fluid that it knows", "draw a mask, or leave it out"
        )
    warnings = (
        ()
        if not lost
        else (Notice("model-lost-fluid", f"{model} lost the fluid in {len(lost)} frame(s), first in frame {lost[0]}"),)
    )
    return PixelLabels(labels, confidence, warnings)


def unfit(error: BaseException) -> MissingPackage:
    """transformers is there and does not start: mostly because of a torchvision that was built for another torch."""
    reason = str(error).partition("\n")[0]
    return MissingPackage(
        f"transformers does not start ({reason}). Needed: packages that fit each other. Do: install torchvision from "
        "where torch came from, or remove it (SAM 2 does without)."
    )


def loaded_model(weights: Path | str, kind: str, name: str, allow_download: bool) -> Any:
    """A transformers model in evaluation mode, from .safetensors alone.

    Args:
        weights: its folder, or its name on the hub.
        kind: `model_type` that its config.json must say.
        name: class in transformers.
        allow_download: whether the hub may be asked.

    Raises:
        MissingPackage: no transformers, or one that lacks the class.
        InputRejected: as the classes that call this say.
    """
    if not allow_download and not Path(weights).is_dir():
        raise InputRejected(
            f"no folder '{weights}'",
            "a folder with config.json and model.safetensors",
            "check it, or allow the download",
        )
    try:
        import transformers
        from safetensors import SafetensorError

        network = getattr(transformers, name)
    except ModuleNotFoundError as error:
        if error.name not in ("transformers", "safetensors"):
            raise unfit(error) from None
        raise missing(error.name, f"for {name}") from None
    except AttributeError:
        raise missing(f"a transformers with {name}", "a newer one") from None
    except (ImportError, RuntimeError, OSError) as error:
        raise unfit(error) from None
    offline = not allow_download
    try:
        found = transformers.AutoConfig.from_pretrained(weights, local_files_only=offline).model_type
        if found != kind:
            raise InputRejected(f"'{Path(weights).name}' is a model of type {found}", f"one of type {kind}")
        model, report = network.from_pretrained(
            weights, local_files_only=offline, use_safetensors=True, output_loading_info=True
        )
    except (OSError, ValueError, KeyError, RuntimeError, SafetensorError) as error:
        reason = " ".join(str(error).split())[:300]
        raise InputRejected(
            f"'{Path(weights).name}' cannot be loaded ({reason})", f"a {kind} model with .safetensors weights"
        ) from None
    lacking = sorted(report["missing_keys"]) + sorted(str(m) for m in report["mismatched_keys"])
    if lacking:  # transformers would fill them with noise
        raise InputRejected(
            f"'{Path(weights).name}' lacks {len(lacking)} tensors of {name}, such as {lacking[0]}", "whole weights"
        )
    return model.eval()
