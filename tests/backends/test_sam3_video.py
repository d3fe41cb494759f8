"""SAM 3 is asked in words, hides what it has withdrawn, and forgets what it no longer looks at."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
import torch

from fluidlift.errors import InputRejected, MissingPackage
from fluidlift.types import Label, PixelFlow, VideoClip

SHAPE = (7, 48, 72)
"""frames, rows, columns of the small clip"""


def quiet(line: str) -> None:
    """Nobody listens."""


@pytest.fixture(scope="module")
def torchvision():
    try:
        import torchvision
    except (ImportError, RuntimeError, OSError) as error:
        pytest.skip(f"torchvision is not installed, or does not fit torch ({str(error).splitlines()[0]})")
    return torchvision


@pytest.fixture(scope="module")
def tiny(transformers, torchvision, tmp_path_factory):
    """SAM 3 with random weights and few channels, and the folder that it and its words were saved to."""
    from tokenizers import Tokenizer, models, pre_tokenizers

    side, width = 112, {"hidden_size": 128, "num_layers": 1, "intermediate_size": 32}
    vision = {
        "model_type": "sam3_vision_model", "fpn_hidden_size": 128,
        "backbone_feature_sizes": [[32, 32], [16, 16], [8, 8]],
        "backbone_config": {
            "model_type": "sam3_vit_model", "hidden_size": 32, "intermediate_size": 32, "num_hidden_layers": 2,
            "num_attention_heads": 2, "image_size": side, "patch_size": 14, "window_size": 4,
            "global_attn_indexes": [1], "pretrain_image_size": 56,
        },
    }  # fmt: skip
    text = {
        "model_type": "clip_text_model", "vocab_size": 8, "hidden_size": 32, "intermediate_size": 32,
        "projection_dim": 32, "num_hidden_layers": 1, "num_attention_heads": 2, "max_position_embeddings": 32,
        "bos_token_id": 1, "eos_token_id": 2, "pad_token_id": 0,
    }  # fmt: skip
    detector = {
        "model_type": "sam3", "vision_config": vision, "text_config": text, "geometry_encoder_config": width,
        "detr_encoder_config": width, "detr_decoder_config": width | {"num_queries": 1},
        "mask_decoder_config": {"hidden_size": 128},
    }  # fmt: skip
    tracker = {
        "model_type": "sam3_tracker_video", "vision_config": vision, "image_size": side,
        "prompt_encoder_config": {"hidden_size": 128, "image_size": side, "patch_size": 14},
        "mask_decoder_config": {
            "hidden_size": 128, "mlp_dim": 32, "num_attention_heads": 4, "iou_head_hidden_dim": 32,
        },
        "num_maskmem": 3, "max_object_pointers_in_encoder": 3, "memory_attention_hidden_size": 128,
        "memory_attention_num_layers": 1, "memory_attention_feed_forward_hidden_size": 32,
        "memory_attention_rope_feat_sizes": [8, 8], "memory_encoder_hidden_size": 128,
        "mask_downsampler_embed_dim": 128, "memory_fuser_embed_dim": 128, "memory_fuser_intermediate_dim": 32,
    }  # fmt: skip
    torch.manual_seed(0)
    config = transformers.Sam3VideoConfig(
        detector_config=detector, tracker_config=tracker, low_res_mask_size=32,
        score_threshold_detection=0.0, new_det_thresh=0.0,
    )  # fmt: skip
    model = transformers.Sam3VideoModel(config).eval()
    folder = tmp_path_factory.mktemp("sam3")
    model.save_pretrained(folder)
    words = Tokenizer(
        models.WordLevel({"<pad>": 0, "<s>": 1, "</s>": 2, "water": 3, "smoke": 4, "?": 5}, unk_token="?")
    )
    words.pre_tokenizer = pre_tokenizers.Whitespace()
    transformers.PreTrainedTokenizerFast(tokenizer_object=words, pad_token="<pad>", unk_token="?").save_pretrained(
        folder
    )
    return model, folder


def some_frames() -> np.ndarray:
    return np.random.default_rng(0).integers(0, 256, (*SHAPE, 3), dtype=np.uint8)


def test_forgetting_does_not_change_what_is_found(tiny, monkeypatch):
    from fluidlift.backends.sam3_video import Sam3Video

    network = Sam3Video(tiny[1], words=("water", "smoke"), announce=quiet)
    held = []
    forget = Sam3Video._forget

    def counting(self, session, t):
        forget(self, session, t)
        kept = [len(o["non_cond_frame_outputs"]) for o in session.output_dict_per_obj.values()]
        pictures = sum(frame.numel() > 0 for frame in session.processed_frames.values())
        held.append((pictures, max(kept, default=0)))

    monkeypatch.setattr(Sam3Video, "_forget", counting)
    found = [chance for _, chance in network.chances(some_frames())]
    assert len(found) == SHAPE[0] and max(h[0] for h in held) == 0 and max(h[1] for h in held) <= 4
    monkeypatch.setattr(Sam3Video, "_forget", lambda self, session, t: None)
    for mine, whole in zip(found, network.chances(some_frames())):
        np.testing.assert_array_equal(mine, whole[1])
    assert any(chance.max() > 0 for chance in found), "nothing was found: the test compares nothing"


def test_the_words_matter(tiny):
    from fluidlift.backends.sam3_video import Sam3Video

    one, other = (
        next(iter(Sam3Video(tiny[1], words=(word,), announce=quiet).chances(some_frames())))[1]
        for word in ("water", "smoke")
    )
    assert np.abs(one - other).max() > 1e-6


def test_words_that_are_not_known_and_a_folder_without_words_are_refused(tiny, tmp_path):
    import shutil

    from fluidlift.backends.sam3_video import Sam3Video

    with pytest.raises(InputRejected, match="does not know 'honey'"):
        Sam3Video(tiny[1], words=("water", "honey"), announce=quiet)
    shutil.copytree(tiny[1], tmp_path / "mute")
    for file in (tmp_path / "mute").glob("tokenizer*"):
        file.unlink()
    with pytest.raises(InputRejected, match="tokenizer"):
        Sam3Video(tmp_path / "mute", announce=quiet)


class FakeModel:
    """Answers with masks that are known: one object that is found, one that was withdrawn."""

    config = SimpleNamespace(
        image_size=32, tracker_config=SimpleNamespace(num_maskmem=2, max_object_pointers_in_encoder=3)
    )

    def __init__(self):
        self.asked = []

    def to(self, device):
        return self

    def __call__(self, session, *, frame, frame_idx):
        self.asked.append((dict(session.prompts), tuple(session.prompt_input_ids[0].shape), tuple(frame.shape)))
        session.add_new_frame(frame, frame_idx)
        mask = torch.full((1, 12, 18), -6.0)
        mask[:, 3:9, 3:15] = 6.0
        return SimpleNamespace(
            suppressed_obj_ids={2}, removed_obj_ids=set(), obj_id_to_mask={1: mask, 2: torch.full((1, 12, 18), 6.0)}
        )


@pytest.fixture
def faked(transformers, monkeypatch):
    """A segmenter round a `FakeModel`: what surrounds the model is tested without torchvision too."""
    from fluidlift.backends import sam3_video

    model = FakeModel()
    coded = {"input_ids": torch.zeros((1, 32), dtype=torch.long), "attention_mask": torch.ones((1, 32))}
    monkeypatch.setattr(sam3_video, "_require_torchvision", lambda: None)
    monkeypatch.setattr(sam3_video, "loaded_model", lambda *a: model)
    monkeypatch.setattr(sam3_video, "_tokenizer", lambda *a: lambda word, **options: coded)
    return model, sam3_video.Sam3Video("any", words=("water", "waterfall"), announce=quiet)


def test_labels_leave_out_what_the_model_has_withdrawn(faked):
    model, network = faked
    clip = VideoClip(some_frames(), np.arange(SHAPE[0]) / 25.0)
    pairs = (SHAPE[0] - 1, *SHAPE[1:])
    labels = network.segment(clip, PixelFlow(np.zeros((*pairs, 2), np.float32), np.zeros(pairs, np.float16)))
    assert model.asked[0] == ({0: "water", 1: "waterfall"}, (1, 32), (1, 3, 32, 32)) and len(model.asked) == SHAPE[0]
    assert labels.labels[3, 24, 36] == Label.FLUID and labels.labels[3, 2, 2] == Label.BACKGROUND
    assert labels.confidence[3, 24, 36] > 0.98 and not labels.warnings


def test_no_code_is_fetched_from_the_hub(faked):
    from transformers.models.sam3_video import modeling_sam3_video as library

    library.cv_utils_kernel = None  # "not tried yet": the library would now ask the hub for a compiled kernel
    next(iter(faked[1].chances(some_frames())))
    assert library.cv_utils_kernel is False


def test_the_licence_is_named_first_and_words_are_needed(transformers, tmp_path):
    from fluidlift.backends.sam3_video import LICENCE, Sam3Video

    said = []
    with pytest.raises((InputRejected, MissingPackage)):
        Sam3Video(tmp_path / "nowhere", announce=said.append)
    assert said == [LICENCE] and "SAM License" in LICENCE
    for words in ("water", (), (" ",)):
        with pytest.raises(ValueError, match="words"):
            Sam3Video(tmp_path, words=words, announce=quiet)
