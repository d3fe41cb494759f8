"""Segmentation by SAM 3 (Meta 2025) through transformers: it is told in words what to look for, and tracks that."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from fluidlift.backends.mask_prompts import labels_of_frame
from fluidlift.backends.model_weights import Announce, missing, say
from fluidlift.backends.pair_network import memory_errors, torch_device
from fluidlift.backends.sam2_video import Progress, checked_labels, empty_labels, loaded_model, normalised, probability
from fluidlift.errors import InputRejected, MissingPackage, require
from fluidlift.seams import Segmenter
from fluidlift.types import PixelFlow, PixelLabels, VideoClip

LICENCE = (
    "SAM 3: code and weights are under Meta's own SAM License, and the weights are handed out on request. Read that "
    "licence before you use them."
)
WORDS = ("water",)
"""what is looked for"""
MEAN = SPREAD = (0.5, 0.5, 0.5)
"""of sRGB from 0 to 1, by which the model's input is normalised"""
LONGEST = 32
"""tokens of a prompt, to which all are filled up"""


class Sam3Video(Segmenter):
    """Everything that SAM 3 takes for one of `words`.

    Args:
        weights: folder of the model (config.json, .safetensors, tokenizer), or its name on the hub where downloads are
            allowed.
        words: such as "water", "waterfall", "smoke", "honey".
        device: "cpu", "cuda", "cuda:1"... The model is large: a GPU is advised.
        allow_download: whether files that are not there may be fetched.
        announce: is told the licence before the weights are touched.
        progress: called after each frame.

    Raises:
        MissingPackage: transformers or torchvision is missing.
        InputRejected: no such folder, no .safetensors or tokenizer in it, or weights of another model.
        FluidliftError: no such device.
    """

    def __init__(
        self,
        weights: Path | str,
        *,
        words: Sequence[str] = WORDS,
        device: str = "cpu",
        allow_download: bool = False,
        announce: Announce = say,
        progress: Progress | None = None,
    ) -> None:
        require(
            not isinstance(words, str) and all(w.strip() for w in words) and bool(words), f"words {words!r}", "words"
        )
        self._device, self._words = torch_device(device), tuple(words)
        announce(LICENCE)
        _require_torchvision()
        self._model = loaded_model(weights, "sam3_video", "Sam3VideoModel", allow_download).to(self._device)
        self._tokens = _tokenizer(weights, self._words, allow_download)
        self._progress = progress

    def segment(
        self, clip: VideoClip, flow: PixelFlow, *, out: tuple[np.ndarray, np.ndarray] | None = None
    ) -> PixelLabels:
        """Labels of every frame: fluid where the model finds one of the words, solid where that encloses something.

        Raises:
            InputRejected: the model finds nothing in any frame.
            FluidliftError: memory ran out.
        """
        labels, confidence = out or empty_labels(clip)
        with memory_errors(self._device):
            for t, chance in self.chances(clip.frames):
                labels[t] = labels_of_frame(chance > 0.5)
                confidence[t] = np.abs(2 * chance - 1)
                if self._progress is not None:
                    self._progress(t + 1, len(clip))
        return checked_labels(labels, confidence, f"SAM 3, asked for {', '.join(self._words)},")

    def chances(self, frames: np.ndarray) -> Iterable[tuple[int, np.ndarray]]:
        """Frame number and probability of fluid (float32 [H,W]), in order."""
        import torch
        from transformers.models.sam3_video import modeling_sam3_video as library

        library.cv_utils_kernel = False  # it would fetch compiled code from the hub; transformers does without as well
        height, width = frames.shape[1:3]
        session = library.Sam3VideoInferenceSession(
            video_height=height,
            video_width=width,
            inference_device=self._device,
            inference_state_device=self._device,
            video_storage_device=self._device,
            dtype=torch.float32,
        )
        for word in self._words:
            number = session.add_prompt(word)
            coded = self._tokens(word, return_tensors="pt", padding="max_length", max_length=LONGEST, truncation=True)
            session.prompt_input_ids[number] = coded["input_ids"].to(self._device)
            session.prompt_attention_masks[number] = coded["attention_mask"].to(self._device)
        side = int(self._model.config.image_size)
        for t, frame in enumerate(frames):
            with torch.inference_mode():
                out = self._model(session, frame=normalised(frame, side, MEAN, SPREAD, self._device), frame_idx=t)
                hidden = set(out.suppressed_obj_ids or ()) | set(out.removed_obj_ids or ())
                shown = [mask for key, mask in (out.obj_id_to_mask or {}).items() if key not in hidden]
                chance = (
                    probability(torch.cat(shown), (height, width)) if shown else np.zeros((height, width), np.float32)
                )
            self._forget(session, t)
            yield t, chance

    def _forget(self, session: Any, t: int) -> None:
        """Drop what no later frame looks at. The tracker counts the frames: an empty one stays in the place of each."""
        session.processed_frames[t] = session.processed_frames[t].new_empty(0)
        tracker = self._model.config.tracker_config
        reach = max(tracker.num_maskmem, tracker.max_object_pointers_in_encoder)
        for outputs in session.output_dict_per_obj.values():
            kept = outputs["non_cond_frame_outputs"]
            for old in [k for k in kept if t - k > reach]:
                del kept[old]


def _require_torchvision() -> None:
    try:
        import torchvision  # noqa: F401  # pyright: ignore[reportMissingImports]
    except ModuleNotFoundError:
        raise missing("torchvision", "by SAM 3 in transformers") from None
    except (ImportError, RuntimeError, OSError) as error:
        reason = str(error).partition("\n")[0]
        raise MissingPackage(
            f"torchvision does not fit the installed torch ({reason}). Needed: the build of the same version and kind. "
            "Do: install both from the same place, or choose sam2."
        ) from None


def _tokenizer(weights: Path | str, words: Sequence[str], allow_download: bool) -> Any:
    from transformers import AutoTokenizer

    try:
        tokens = AutoTokenizer.from_pretrained(weights, local_files_only=not allow_download)
    except (OSError, ValueError, KeyError) as error:
        reason = " ".join(str(error).split())[:200]
        raise InputRejected(f"'{Path(weights).name}' holds no tokenizer ({reason})", "tokenizer.json") from None
    for word in words:  # without its files, transformers makes a tokenizer that knows no words
        known = set(tokens(word, add_special_tokens=False)["input_ids"]) - {tokens.unk_token_id}
        if not known:
            raise InputRejected(
                f"the tokenizer of '{Path(weights).name}' does not know '{word}'",
                "tokenizer.json, and a word that it knows",
            )
    return tokens
