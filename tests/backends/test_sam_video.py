"""SAM 2 is shown what the first guess is surest of, and follows it as transformers' own code would."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from fluidlift.backends.mask_prompts import CLICKS, PointPrompts, clicks_from, labels_of_frame, ordered_from
from fluidlift.errors import InputRejected, MissingPackage
from fluidlift.types import Label, PixelFlow, PixelLabels, VideoClip

SIDE = 128
SHAPE = (9, 48, 72)
"""frames, rows, columns of the small clip"""


def quiet(line: str) -> None:
    """Nobody listens."""


def disc_labels(sure_frame: int = 4) -> PixelLabels:
    """A disc of fluid; its left half is sure, and most of all in one frame."""
    rows, columns = np.mgrid[: SHAPE[1], : SHAPE[2]]
    disc = (rows - 24) ** 2 + (columns - 36) ** 2 < 18**2
    labels = np.where(disc, np.uint8(Label.FLUID), np.uint8(0))[None].repeat(SHAPE[0], axis=0)
    confidence = np.where(columns <= 36, 0.9, 0.2)[None].repeat(SHAPE[0], axis=0).astype(np.float16)
    confidence[np.arange(SHAPE[0]) != sure_frame] *= np.float16(0.5)
    return PixelLabels(labels, confidence)


def some_clip(seed: int = 0) -> VideoClip:
    frames = np.random.default_rng(seed).integers(0, 256, (*SHAPE, 3), dtype=np.uint8)
    return VideoClip(frames, np.arange(SHAPE[0]) / 25.0)


def no_flow() -> PixelFlow:
    pairs = (SHAPE[0] - 1, *SHAPE[1:])
    return PixelFlow(np.zeros((*pairs, 2), np.float32), np.zeros(pairs, np.float16))


@pytest.fixture(scope="module")
def tiny(transformers, tmp_path_factory):
    """SAM 2 with random weights and few channels, and the folder that it was saved to."""
    vision = {
        "model_type": "sam2_vision_model", "backbone_channel_list": [96, 48, 24, 12],
        "backbone_feature_sizes": [[32, 32], [16, 16], [8, 8]], "fpn_hidden_size": 128,
        "backbone_config": {
            "model_type": "sam2_hiera_det_model", "hidden_size": 12, "num_attention_heads": 1,
            "image_size": [SIDE, SIDE], "blocks_per_stage": [1, 2, 2, 1], "embed_dim_per_stage": [12, 24, 48, 96],
            "num_attention_heads_per_stage": [1, 2, 4, 8], "window_size_per_stage": [8, 4, 4, 2],
            "global_attention_blocks": [4],
        },
    }  # fmt: skip
    torch.manual_seed(0)
    config = transformers.Sam2VideoConfig(
        vision_config=vision,
        prompt_encoder_config={"hidden_size": 128, "image_size": SIDE, "patch_size": 16},
        mask_decoder_config={"hidden_size": 128, "mlp_dim": 32, "num_attention_heads": 4, "iou_head_hidden_dim": 32},
        image_size=SIDE, num_maskmem=3, max_object_pointers_in_encoder=4,
        memory_attention_hidden_size=128, memory_attention_num_layers=1,
        memory_attention_feed_forward_hidden_size=32, memory_attention_rope_feat_sizes=[8, 8],
        memory_encoder_hidden_size=128, memory_encoder_output_channels=64, mask_downsampler_embed_dim=128,
        memory_fuser_embed_dim=128, memory_fuser_intermediate_dim=32,
    )  # fmt: skip
    model = transformers.Sam2VideoModel(config).eval()
    for parameter in model.parameters():  # as drawn, they are so small that a mask hardly depends on the picture
        parameter.data *= 2.0
    folder = tmp_path_factory.mktemp("sam2")
    model.save_pretrained(folder)
    return model, folder


def segmenter(folder, **options):
    from fluidlift.backends.sam2_video import Sam2Video

    return Sam2Video(folder, **({"guess": lambda clip, flow: disc_labels(), "announce": quiet} | options))


def test_clicks_lie_deep_in_the_surer_half_and_away_from_each_other():
    clicks = clicks_from(disc_labels(sure_frame=6))
    assert clicks.frame == 6 and len(clicks.points) == 2 * CLICKS
    fluid = disc_labels().fluid[0]
    for (column, row), on in zip(clicks.points.astype(int), clicks.fluid):
        assert fluid[row, column] == on and (column <= 36 or not on)
    apart = [np.hypot(*(p - q)) for i, p in enumerate(clicks.points) for q in clicks.points[:i]]
    assert min(apart) >= 4.0, "in a half disc of 18 px, four points can be further apart than that"
    column, row = clicks.points[0]
    inside = min(36.5 - column, 18 - np.hypot(column - 36, row - 24))
    assert inside >= 8.0, "the largest circle in the half disc has a radius of 9; one pixel of rounding"


def test_fluid_everywhere_needs_no_click_beside_it_and_none_cannot_be_shown():
    everywhere = PixelLabels(np.full(SHAPE, Label.FLUID, np.uint8), np.ones(SHAPE, np.float16))
    assert clicks_from(everywhere).fluid.all()
    with pytest.raises(InputRejected, match="no fluid"):
        clicks_from(PixelLabels(np.zeros(SHAPE, np.uint8), np.ones(SHAPE, np.float16)))


def test_what_the_fluid_encloses_is_solid_and_a_bay_is_not():
    fluid = np.zeros((60, 80), bool)
    fluid[10:50, 10:70] = True
    fluid[20:30, 20:30] = False  # a rock
    fluid[40, 60] = False  # one pixel of noise
    fluid[25:35, 60:70] = False  # a bay that opens to the right
    labels = labels_of_frame(fluid)
    assert (labels[20:30, 20:30] == Label.SOLID).all() and (labels == Label.SOLID).sum() == 100
    assert labels[40, 60] == Label.FLUID
    assert (labels[25:35, 60:70] == Label.BACKGROUND).all() and (labels[fluid] == Label.FLUID).all()


def test_every_frame_is_visited_once_from_the_clicked_one_outwards():
    onward, back = ordered_from(3, 6)
    assert onward.tolist() == [3, 4, 5] and back.tolist() == [2, 1, 0]


@pytest.mark.parametrize("clicked", [0, SHAPE[0] - 1], ids=["onward", "back"])
def test_the_masks_are_those_of_transformers_own_propagation(tiny, clicked):
    """The twin holds the whole clip at once and forgets nothing; ours forgets what is no longer looked at."""
    from transformers.models.sam2_video.modeling_sam2_video import Sam2VideoInferenceSession

    from fluidlift.backends.sam2_video import MEAN, SPREAD, normalised, probability

    model, folder = tiny
    frames = some_clip().frames
    clicks = PointPrompts(clicked, np.array([[20, 24], [30, 20], [60, 5]], np.float32), np.array([True, True, False]))
    found = dict(segmenter(folder).chances(frames, clicks))
    assert sorted(found) == list(range(SHAPE[0]))

    device = torch.device("cpu")
    video = torch.cat([normalised(f, SIDE, MEAN, SPREAD, device) for f in frames])
    session = Sam2VideoInferenceSession(video=video, video_height=SHAPE[1], video_width=SHAPE[2], dtype=torch.float32)
    points = torch.from_numpy(clicks.points * np.array([SIDE / SHAPE[2], SIDE / SHAPE[1]], np.float32))[None, None]
    inputs = {"point_coords": points, "point_labels": torch.tensor([[[1, 1, 0]]], dtype=torch.int32)}
    session.add_point_inputs(session.obj_id_to_idx(1), clicked, inputs)
    session.obj_with_new_inputs = [1]
    expected = {
        out.frame_idx: probability(out.pred_masks[0], SHAPE[1:])
        for out in model.propagate_in_video_iterator(session, start_frame_idx=clicked, reverse=clicked > 0)
    }
    for t in range(SHAPE[0]):
        np.testing.assert_allclose(found[t], expected[t], atol=1e-5)  # float32, other shapes of matrix products
    spread = np.ptp([found[t].mean() for t in found])
    assert spread > 1e-4, "all frames alike: the test would not notice a wrong order"


def test_memory_does_not_grow_with_the_clip(tiny, monkeypatch):
    from fluidlift.backends.sam2_video import Sam2Video

    held = []
    forget = Sam2Video._forget

    def counting(self, session, t):
        forget(self, session, t)
        held.append((len(session.processed_frames), len(session.output_dict_per_obj[0]["non_cond_frame_outputs"])))

    monkeypatch.setattr(Sam2Video, "_forget", counting)
    network = segmenter(tiny[1])
    frames = np.concatenate([some_clip().frames] * 3)
    for _ in network.chances(frames, PointPrompts(9, np.array([[20, 24]], np.float32), np.array([True]))):
        pass
    assert len(held) == 27
    assert max(pictures for pictures, _ in held) == 0
    assert max(outputs for _, outputs in held) == 5  # the longer memory of the tiny model reaches back 4 frames


def test_labels_come_from_the_masks_with_their_certainty(tiny, monkeypatch):
    from fluidlift.backends import sam2_video

    network, told = segmenter(tiny[1], progress=lambda done, of: told.append((done, of))), []
    chance = np.full(SHAPE[1:], 0.1, np.float32)
    chance[10:30, 10:40] = 0.95
    chance[15:20, 15:25] = 0.4
    nothing = np.zeros_like(chance)
    asked = []

    def chances(self, frames, clicks):
        asked.append(clicks.frame)
        return ((t, nothing if t == 7 else chance) for t in range(len(frames)))

    monkeypatch.setattr(sam2_video.Sam2Video, "chances", chances)
    out = np.ones(SHAPE, np.uint8), np.ones(SHAPE, np.float16)
    labels = network.segment(some_clip(), no_flow(), out=out)
    assert labels.labels is out[0] and labels.confidence is out[1]
    assert asked == [4] and told == [(t + 1, 9) for t in range(9)]
    assert (labels.labels[0, 15:20, 15:25] == Label.SOLID).all() and labels.labels[0, 12, 12] == Label.FLUID
    np.testing.assert_allclose(
        labels.confidence[0, [12, 17, 0], [12, 17, 0]], [0.9, 0.2, 0.8], atol=1e-3
    )  # half floats
    assert labels.warnings == ("SAM 2 lost the fluid in 1 frame(s), first in frame 7",)
    monkeypatch.setattr(sam2_video.Sam2Video, "chances", lambda self, f, c: ((t, nothing) for t in range(len(f))))
    with pytest.raises(InputRejected, match="no fluid in any frame"):
        network.segment(some_clip(), no_flow())


def test_a_segmentation_runs_from_the_clip_to_labels_by_way_of_our_own_guess(tiny, monkeypatch):
    """Random weights answer about one half everywhere: the median of a frame parts it into fluid and the rest."""
    from fluidlift.backends import sam2_video

    def halved(logits, size):
        chance = probability(logits, size)
        return np.where(chance > np.median(chance), 0.9, 0.1).astype(np.float32)

    probability = sam2_video.probability
    monkeypatch.setattr(sam2_video, "probability", halved)
    rng = np.random.default_rng(5)
    frames = np.full((*SHAPE, 3), 90, np.uint8) + rng.integers(0, 4, (*SHAPE, 3), dtype=np.uint8)
    frames[:, 16:36, 20:56] = rng.integers(0, 256, (SHAPE[0], 20, 36, 3), dtype=np.uint8)  # what changes is fluid
    labels = segmenter(tiny[1], guess=None).segment(VideoClip(frames, np.arange(SHAPE[0]) / 25.0), no_flow())
    assert labels.labels.shape == SHAPE and labels.confidence.dtype == np.float16
    share = labels.fluid.mean(axis=(1, 2))
    assert (share > 0.4).all() and (share < 0.75).all(), "half of each frame, and its small holes"


def test_only_whole_safetensors_of_the_right_model_are_taken(tiny, transformers, tmp_path):
    import json
    import shutil

    from safetensors.torch import load_file, save_file

    state = load_file(tiny[1] / "model.safetensors")

    def folder(name: str):
        shutil.copytree(tiny[1], tmp_path / name)
        return tmp_path / name

    pickled = folder("pickled")
    (pickled / "model.safetensors").unlink()
    torch.save(state, pickled / "pytorch_model.bin")
    lacking = folder("lacking")
    gone = next(k for k in state if k.startswith("mask_decoder."))
    save_file({k: v for k, v in state.items() if k != gone}, lacking / "model.safetensors", {"format": "pt"})
    other = folder("other")
    config = json.loads((other / "config.json").read_text())
    (other / "config.json").write_text(json.dumps(config | {"model_type": "vit"}))
    cut = folder("cut")
    (cut / "model.safetensors").write_bytes((tiny[1] / "model.safetensors").read_bytes()[:500])
    for name, reason in {
        "pickled": "safetensors", "lacking": "lacks 1 tensors", "other": "type vit", "cut": "cannot be loaded",
        "nowhere": "allow the download",
    }.items():  # fmt: skip
        with pytest.raises(InputRejected, match=reason):
            segmenter(tmp_path / name)


def test_the_licence_is_named_before_the_weights_are_read(transformers, tmp_path):
    from fluidlift.backends.sam2_video import LICENCE

    said = []
    with pytest.raises(InputRejected):
        segmenter(tmp_path / "nowhere", announce=said.append)
    assert said == [LICENCE] and "Apache-2.0" in LICENCE


def test_without_transformers_the_message_says_how_to_get_it(monkeypatch, tmp_path):
    import sys

    monkeypatch.setitem(sys.modules, "transformers", None)
    with pytest.raises(MissingPackage, match=r"fluidlift\[learned\]"):
        segmenter(tmp_path)
