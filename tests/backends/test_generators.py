"""The generators that are known: each says its terms and needs, and what is there of it is found without fetching."""

import json

import numpy as np
import pytest

from fluidlift.backends import generators
from fluidlift.backends.generator_process import GeneratorFailed, Picture
from fluidlift.cli import DONE, REJECTED, main
from fluidlift.errors import InputRejected
from fluidlift.seams import Generator
from fluidlift.types import Gaussians, PinholeCamera


@pytest.fixture(autouse=True)
def empty_machine(tmp_path, monkeypatch):
    """No caches, no settings."""
    for name in ("XDG_CONFIG_HOME", "XDG_CACHE_HOME"):
        monkeypatch.setenv(name, str(tmp_path / name))
    for name in ("HF_HOME", "HF_HUB_CACHE", "TORCH_HOME"):
        monkeypatch.delenv(name, raising=False)
    return tmp_path


@pytest.mark.parametrize("name", generators.GENERATORS)
def test_every_generator_has_a_card_and_a_class_that_needs_none_of_its_packages(name):
    card = generators.card_of(name)
    assert card.name == name
    assert card.home.startswith("https://") and card.hardware and card.install and card.weights
    made = generators.generator_class(name)
    assert issubclass(made, Generator) and isinstance(made.knows_up, bool)


def test_an_unknown_generator_is_told_which_there_are():
    with pytest.raises(InputRejected, match="triposplat"):
        generators.card_of("dreamer")


def test_weights_are_found_in_the_hubs_cache_and_in_torchs(empty_machine, monkeypatch):
    hub = empty_machine / "XDG_CACHE_HOME" / "huggingface" / "hub" / "models--owner--name" / "snapshots" / "abc"
    assert not generators.weights_cached("owner/name/model.ckpt") and not generators.weights_cached("owner/name")
    hub.mkdir(parents=True)
    assert not generators.weights_cached("owner/name")  # a download that was broken off
    (hub / "model.ckpt").write_bytes(b"0")
    assert generators.weights_cached("owner/name/model.ckpt") and generators.weights_cached("owner/name")
    assert not generators.weights_cached("owner/name/other.ckpt")
    monkeypatch.setenv("HF_HOME", str(empty_machine / "elsewhere"))
    assert not generators.weights_cached("owner/name/model.ckpt")
    torch_hub = empty_machine / "XDG_CACHE_HOME" / "torch" / "hub" / "checkpoints"
    torch_hub.mkdir(parents=True)
    (torch_hub / "model.pt").write_bytes(b"0")
    assert generators.weights_cached("example.org/models/model.pt")


def test_what_lacks_is_said_in_the_order_in_which_it_has_to_be_mended():
    lacking = generators.Readiness("x", "here", missing=("spconv",), no_gpu="torch sees none", weights_missing=("w",))
    assert "spconv" in lacking.sentence() and not lacking.installed
    no_gpu = generators.Readiness("x", "here", no_gpu="torch sees none", weights_missing=("w",))
    assert "needs a GPU" in no_gpu.sentence() and no_gpu.installed and not no_gpu.ready
    no_weights = generators.Readiness("x", "here", gpu="a GPU", weights_missing=("w",))
    assert "weights" in no_weights.sentence() and not no_weights.ready
    assert generators.Readiness("x", "here", needs_gpu=False).ready
    assert generators.Readiness("x", "here", gpu="a GPU").sentence() == "ready"


def test_the_list_and_one_of_it_are_told_to_people_and_machines(capsys):
    assert main(["generators"]) == DONE
    shown = capsys.readouterr().out
    assert all(name in shown for name in generators.GENERATORS) and "not installed" in shown
    assert main(["generators", "--json"]) == DONE
    rows = json.loads(capsys.readouterr().out)
    assert [row["name"] for row in rows] == list(generators.GENERATORS)
    assert not any(row["accepted"] or row["check"]["ready"] for row in rows)
    assert main(["generators", "triposplat"]) == DONE
    shown = capsys.readouterr().out
    card = generators.card_of("triposplat")
    assert all(command in shown for command in card.install) and card.home in shown
    assert "--accept-licence triposplat" in shown
    assert main(["generators", "dreamer"]) == REJECTED


class Inside(Generator):
    """In this process; does as it is told."""

    def __init__(self, answer):
        self.answer = answer

    def generate(self, image, mask, frame):
        if isinstance(self.answer, Exception):
            raise self.answer
        return self.answer, PinholeCamera.looking(np.array([0.0, -2.0, 0.0]), np.zeros(3), 40.0, mask.shape[::-1])


def asked(answer, **choice):
    picture = Picture(4, np.zeros((32, 32, 3), np.uint8), np.ones((32, 32), bool))
    return list(generators.bodies(Inside(answer), generators.GeneratorChoice("trellis", **choice), [picture]))


def test_a_generator_in_this_process_is_looked_at_as_well():
    rng = np.random.default_rng(0)
    good = Gaussians.isotropic(rng.uniform(-0.7, 0.7, (3000, 3)), 0.03, np.full((3000, 3), 0.5))
    ((frame, body, _),) = asked(good)
    assert frame == 4 and len(body) == 3000
    with pytest.raises(GeneratorFailed, match="empty body of frame 4"):
        asked(Gaussians.empty())


def test_whatever_a_third_party_raises_becomes_a_message_with_a_remedy():
    with pytest.raises(GeneratorFailed, match=r"KeyError: 'gaussian'.*fluidlift generators trellis"):
        asked(KeyError("gaussian"))


def test_code_of_a_checkout_is_only_found_while_it_is_asked(tmp_path):
    import sys

    before = list(sys.path)
    asked_there = []

    class Looks(Inside):
        def generate(self, image, mask, frame):
            asked_there.extend(sys.path)
            raise KeyError("enough")

    picture = Picture(4, np.zeros((8, 8, 3), np.uint8), np.ones((8, 8), bool))
    choice = generators.GeneratorChoice("trellis", code=tmp_path)
    with pytest.raises(GeneratorFailed):
        list(generators.bodies(Looks(None), choice, [picture]))
    assert str(tmp_path) in asked_there and sys.path == before


@pytest.mark.parametrize("name", generators.GENERATORS)
def test_the_page_of_a_generator_says_what_its_card_says(name):
    from pathlib import Path

    card, folder = generators.card_of(name), Path(__file__).resolve().parents[2] / "docs" / "generators"
    page = " ".join((folder / f"{name}.md").read_text(encoding="utf-8").split())
    facts = [card.home, card.licence, card.hardware[1:], *card.install, *card.weights, *card.notes]
    assert [fact for fact in facts if " ".join(fact.split()) not in page] == []
    assert f"Commercial use: {'allowed' if card.licence_commercial else 'not allowed'}" in page
    assert f"({name}.md)" in (folder / "index.md").read_text(encoding="utf-8")
