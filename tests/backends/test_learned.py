"""The learned options are reached by the names that a job's settings use."""

from __future__ import annotations

import pytest
import torch

from fluidlift.backends.learned import FLOW_METHODS, MASK_METHODS, make_estimator, make_segmenter
from fluidlift.backends.registry import ModelChoice
from fluidlift.backends.sea_raft import SeaRaft
from fluidlift.backends.sea_raft_network import SeaRaftNetwork, SeaRaftShape
from fluidlift.errors import InputRejected, MissingPackage


def quiet(line: str) -> None:
    """Nobody listens."""


def test_a_checkpoint_becomes_the_estimator_that_was_named(tmp_path):
    network = SeaRaftNetwork(SeaRaftShape(blocks=(2, 2, 2), stem=8, stages=(8, 8, 8), width=8, radius=1))
    torch.save(network.state_dict(), tmp_path / "w.pth")
    said = []
    choice = ModelChoice(weights=tmp_path / "w.pth", announce=said.append)
    assert isinstance(make_estimator("sea-raft", choice), SeaRaft) and len(said) == 1


@pytest.mark.parametrize("name", [*FLOW_METHODS, *MASK_METHODS])
def test_without_weights_every_method_says_what_it_needs(name):
    make = make_estimator if name in FLOW_METHODS else make_segmenter
    with pytest.raises((InputRejected, MissingPackage), match=r"no weights|not installed|does not fit"):
        make(name, ModelChoice(announce=quiet))


def test_other_names_are_a_mistake():
    with pytest.raises(ValueError, match="raft, sea-raft"):
        make_estimator("gmflow", ModelChoice())
    with pytest.raises(ValueError, match="sam2, sam3"):
        make_segmenter("sam1", ModelChoice())


def test_a_segmenter_gets_the_users_hints_words_and_consent(monkeypatch):
    from fluidlift.backends import sam2_video, sam3_video

    def guess(clip, flow):
        raise NotImplementedError

    got = {}
    for module, name in ((sam2_video, "Sam2Video"), (sam3_video, "Sam3Video")):
        monkeypatch.setattr(module, name, lambda weights, **options: got.update(options, weights=weights))
    choice = ModelChoice("folder", "cuda:1", True, quiet)
    agreed = {"weights": "folder", "device": "cuda:1", "allow_download": True, "announce": quiet, "progress": print}
    make_segmenter("sam2", choice, guess=guess, progress=print)
    assert got == agreed | {"guess": guess}
    got.clear()
    make_segmenter("sam3", choice, words=("smoke",), progress=print)
    assert got == agreed | {"words": ("smoke",)}
