"""`fluidlift models`: what is listed, who is asked before something is fetched, and what is said."""

from __future__ import annotations

import hashlib
import io
import json
import sys

import pytest
from file_server import file_server

from fluidlift.backends import model_table
from fluidlift.backends.model_cache import kept
from fluidlift.backends.model_card import ModelCard, ModelFile
from fluidlift.backends.model_download import Transport
from fluidlift.cli import DONE, FAILED, REJECTED, main, models

DATA = bytes(range(256)) * 4000


@pytest.fixture
def server(monkeypatch, tmp_path):
    """A file server, and a table of two models on it: one for everybody, one for research only."""
    monkeypatch.setenv("FLUIDLIFT_MODELS", str(tmp_path / "cache"))
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "config"))
    monkeypatch.setattr(models, "TRANSPORT", Transport(plain_loopback=True, timeout=5.0, tries=1))
    with file_server() as files:
        files.contents = {"weights": DATA}
        cards = []
        for name, terms in (("free", "allowed"), ("bound", "research")):
            file = ModelFile("weights", "https://x.y/z", len(DATA), hashlib.sha256(DATA).hexdigest())
            object.__setattr__(file, "address", f"{files.address}/weights")
            needs = ("no_such_package",), "pip install no-such-package"
            facts = ("depth",), ("depth model", "moge"), "Its terms.", terms, "https://x.y", (file,), *needs
            cards.append(ModelCard(name, name.title(), *facts))
        monkeypatch.setattr(model_table, "MODELS", tuple(cards))
        yield files


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def typed(monkeypatch, text: str) -> None:
    """A person at a terminal who types this."""
    monkeypatch.setattr(sys, "stdin", Terminal(text))
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True, raising=False)


def test_the_list_is_for_people_and_for_programs(capsys, server):
    assert main(["models"]) == DONE
    said = capsys.readouterr().out
    assert "free" in said and "research only" in said and "lgm" in said and "own environment" in said
    assert main(["models", "get", "free", "--yes"]) == DONE
    capsys.readouterr()
    assert main(["models", "--json"]) == DONE
    rows = {row["name"]: row for row in json.loads(capsys.readouterr().out)}
    assert rows["free"]["cached"]["files"] == {"weights": hashlib.sha256(DATA).hexdigest()}
    assert rows["bound"]["cached"] is None and rows["bound"]["terms"] == "research"
    assert rows["free"]["lacking"] == ["no_such_package"] and rows["free"]["bytes"] == len(DATA)


def test_a_model_is_explained(capsys, server):
    assert main(["models", "show", "free"]) == DONE
    said = capsys.readouterr().out
    for part in ("Its terms.", hashlib.sha256(DATA).hexdigest(), server.address, "pip install no-such-package",
                 "fluidlift models get free"):  # fmt: skip
        assert part in said
    assert main(["models", "show", "free", "--json"]) == DONE
    assert json.loads(capsys.readouterr().out)["title"] == "Free"


def test_without_a_terminal_nothing_is_fetched_unasked(capsys, server):
    assert main(["models", "get", "free"]) == REJECTED
    said = capsys.readouterr().err
    assert "Its terms." in said and "1 MB" in said and "fluidlift models get free --yes" in said.splitlines()[-1]
    assert server.asked == [] and kept("free") is None


@pytest.mark.parametrize(("answer", "code"), [("yes\n", DONE), ("no\n", REJECTED), ("", REJECTED)])
def test_a_person_at_a_terminal_is_asked(capsys, monkeypatch, server, answer, code):
    typed(monkeypatch, answer)
    assert main(["models", "get", "free"]) == code
    assert (kept("free") is not None) == (code == DONE)
    assert "Type yes" in capsys.readouterr().err


def test_terms_for_research_only_are_accepted_by_name_and_remembered(capsys, server):
    assert main(["models", "get", "bound", "--yes"]) == REJECTED  # which agrees to the download alone
    assert "--yes --accept-licence" in capsys.readouterr().err and server.asked == []
    assert main(["models", "get", "bound", "--yes", "--accept-licence"]) == DONE
    assert main(["models", "remove", "bound"]) == DONE
    assert main(["models", "get", "bound", "--yes"]) == DONE  # remembered
    assert "is here" in capsys.readouterr().out


def test_what_came_is_told_with_its_hash_and_what_it_still_needs(capsys, server):
    assert main(["models", "get", "free", "--yes"]) == DONE
    said = capsys.readouterr()
    assert hashlib.sha256(DATA).hexdigest() in said.out and "make CLIP --models free" in said.out
    assert "pip install no-such-package" in said.out and "weights: 1 MB of 1 MB" in said.err


def test_from_a_folder(capsys, server, tmp_path):
    (tmp_path / "weights").write_bytes(DATA)
    assert main(["models", "get", "free", "--from", str(tmp_path), "--yes"]) == DONE
    assert server.asked == [] and kept("free") is not None
    assert main(["models", "remove", "free", "--json"]) == DONE
    assert json.loads(capsys.readouterr().out.splitlines()[-1])["removed"] == "free"
    assert main(["models", "remove", "free"]) == REJECTED


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (("get",), "without a name"), (("show", "fre"), "models get free"), (("list", "free"), "models show free"),
        (("get", "free", "--yes", "--trust", "abc"), "64 hexadecimal"), (("get", "lgm", "--yes"), "generators lgm"),
    ],
)  # fmt: skip
def test_what_makes_no_sense_is_refused_in_a_line(capsys, server, arguments, says):
    assert main(["models", *arguments]) == REJECTED
    said = capsys.readouterr().err.splitlines()[-1]
    assert said.startswith("fluidlift: ") and says in said
    assert server.asked == []


def test_a_server_that_is_gone_is_no_fault_of_the_input(capsys, server):
    server.status = 503
    assert main(["models", "get", "free", "--yes"]) == FAILED
    assert "--from" in capsys.readouterr().err.splitlines()[-1]


def test_doctor_tells_what_is_in_the_cache(server):
    from fluidlift.doctor import examine

    assert examine()["models in the cache"] == "none (fluidlift models)"
    assert main(["models", "get", "free", "--yes"]) == DONE
    assert examine()["models in the cache"] == "free (1 MB)"
