"""A model comes into the cache whole and right, or not at all."""

from __future__ import annotations

import errno
import hashlib
import json
import os
import shutil
from collections import namedtuple
from dataclasses import replace

import numpy as np
import pytest
from file_server import file_server

from fluidlift.backends import model_download, model_get
from fluidlift.backends.model_cache import RECORD, all_kept, alone, begun_folder, kept, models_folder, remove
from fluidlift.backends.model_card import ModelCard, ModelFile
from fluidlift.backends.model_download import HTTPS, Transport, fetch
from fluidlift.backends.model_get import ModelRequest, get_model
from fluidlift.backends.model_table import MODELS, every_model, model_of
from fluidlift.backends.registry import BACK_ENDS
from fluidlift.errors import FluidliftError, InputRejected

LOCAL = Transport(plain_loopback=True, timeout=5.0, pause=0.0)
DATA = np.random.default_rng(0).bytes(3_000_000)
CONFIG = b'{"model_type": "tiny"}'


@pytest.fixture(autouse=True)
def cache(monkeypatch, tmp_path):
    monkeypatch.setenv("FLUIDLIFT_MODELS", str(tmp_path / "cache"))
    for name in ("http_proxy", "https_proxy", "HTTP_PROXY", "HTTPS_PROXY", "all_proxy", "ALL_PROXY"):
        monkeypatch.delenv(name, raising=False)
    return tmp_path / "cache"


@pytest.fixture
def server():
    with file_server() as files:
        files.contents = {"config.json": CONFIG, "weights": DATA}
        yield files


def at(file: ModelFile, address: str) -> ModelFile:
    """The file at an address of this machine, which a card would not take."""
    object.__setattr__(file, "address", address)
    return file


def card_of(server, *, known: bool = True, **changes) -> ModelCard:
    files = []
    for name, data in (("config.json", CONFIG), ("weights", DATA)):
        facts = (len(data), hashlib.sha256(data).hexdigest()) if known else (None, None)
        files.append(at(ModelFile(name, "https://x.y/z", *facts), f"{server.address}/{name}"))
    card = ModelCard(
        "tiny", "Tiny", ("depth",), ("depth model", "moge"), "MIT.", "allowed", "https://x.y", tuple(files)
    )
    return replace(card, **changes) if changes else card


def files_in(folder) -> list[str]:
    return sorted(str(p.relative_to(folder)) for p in folder.rglob("*") if p.is_file() and p.suffix != ".lock")


def test_a_model_is_fetched_checked_and_found_again(server, cache):
    told = []
    card = card_of(server)
    got = get_model(
        card, ModelRequest(transport=LOCAL, told=lambda file, done, total: told.append((file.name, done, total)))
    )
    assert got == kept("tiny") == all_kept((card,))[0]
    assert (cache / "tiny" / "weights").read_bytes() == DATA
    assert files_in(cache) == ["tiny/config.json", "tiny/model.json", "tiny/weights"]
    assert got.checked == "card" and got.path == cache / "tiny"  # several files: the folder
    assert told[-1] == ("weights", len(DATA), len(DATA)) and ("config.json", len(CONFIG), len(CONFIG)) in told
    got.require_whole()
    (cache / "tiny" / "config.json").write_bytes(CONFIG.replace(b"tiny", b"huge"))
    with pytest.raises(InputRejected, match="not what was fetched"):
        got.require_whole()
    assert remove("tiny") >= len(DATA) and kept("tiny") is None and files_in(cache) == []
    with pytest.raises(InputRejected, match="not in the cache"):
        remove("tiny")


def test_a_single_file_is_handed_over_by_itself(server):
    card = card_of(server)
    got = get_model(replace(card, files=card.files[1:]), ModelRequest(transport=LOCAL))
    assert got.path.name == "weights" and got.path.read_bytes() == DATA


def test_a_cut_connection_is_gone_on_with(server):
    server.cuts = [len(CONFIG), 1_200_000, 900_000]
    got = get_model(card_of(server), ModelRequest(transport=LOCAL))
    assert (got.folder / "weights").read_bytes() == DATA
    spans = [span for path, span in server.asked if path == "/weights"]
    assert spans == [None, "bytes=1200000-", "bytes=2100000-"]


def test_what_a_stopped_run_left_is_gone_on_with_by_the_next(server):
    server.cuts = [len(CONFIG), 1_000_000]
    with pytest.raises(FluidliftError, match="same command goes on"):
        get_model(card_of(server), ModelRequest(transport=replace(LOCAL, tries=1)))
    assert kept("tiny") is None and (begun_folder("tiny") / "weights").stat().st_size == 1_000_000
    server.asked.clear()
    get_model(card_of(server), ModelRequest(transport=LOCAL))
    assert server.asked == [("/weights", "bytes=1000000-")]  # the other file is there and right


@pytest.mark.parametrize("left", [DATA[:1000][::-1], DATA + b"more"], ids=["other", "longer"])
def test_what_is_no_beginning_of_the_file_does_not_stay(server, left):
    begun_folder("tiny").mkdir(parents=True)
    (begun_folder("tiny") / "weights").write_bytes(left)
    wanted = ModelRequest(transport=LOCAL)
    if len(left) < len(DATA):  # only the hash can tell: it is refused once, and gone
        with pytest.raises(InputRejected, match="SHA-256"):
            get_model(card_of(server), wanted)
    assert (get_model(card_of(server), wanted).folder / "weights").read_bytes() == DATA


def test_a_server_without_ranges_begins_anew(server):
    server.knows_ranges, server.cuts = False, [len(CONFIG), 1_000_000]
    assert (get_model(card_of(server), ModelRequest(transport=LOCAL)).folder / "weights").read_bytes() == DATA


def test_another_content_is_refused_and_deleted(server, cache):
    server.contents["weights"] = DATA[:-1] + bytes([DATA[-1] ^ 1])
    with pytest.raises(InputRejected, match="SHA-256") as told:
        get_model(
            card_of(server), ModelRequest(transport=LOCAL, accept_unverified=True)
        )  # which is for unknown hashes only
    assert hashlib.sha256(DATA).hexdigest() in str(told.value)
    assert kept("tiny") is None and files_in(cache) == ["tiny.begun/config.json"]


@pytest.mark.parametrize("tells_length", [True, False])
def test_more_than_the_file_has_is_not_taken_in(server, cache, tells_length):
    server.contents["weights"], server.tells_length = DATA + bytes(10_000_000), tells_length
    with pytest.raises(InputRejected, match=r"has 13000000 bytes|has more than"):
        get_model(card_of(server), ModelRequest(transport=LOCAL))
    assert all(p.stat().st_size <= len(DATA) for p in cache.rglob("*"))


def test_a_file_of_unknown_size_has_a_bound_too(server, cache, monkeypatch):
    monkeypatch.setattr("fluidlift.backends.model_card.MOST_BYTES", 1_000_000)
    with pytest.raises(InputRejected, match="1000000 bytes"):
        get_model(card_of(server, known=False), ModelRequest(transport=LOCAL, accept_unverified=True))
    assert all(p.stat().st_size <= 1_000_000 for p in cache.rglob("*"))


def test_where_no_hash_is_known_somebody_has_to_vouch(server):
    card = card_of(server, known=False)
    with pytest.raises(InputRejected, match="--trust") as told:
        get_model(card, ModelRequest(transport=LOCAL))
    assert hashlib.sha256(CONFIG).hexdigest() in str(told.value) and kept("tiny") is None
    hashes = tuple(hashlib.sha256(d).hexdigest() for d in (CONFIG, DATA))
    with pytest.raises(InputRejected, match="'weights' of tiny"):
        get_model(card, ModelRequest(transport=LOCAL, trust=hashes[:1]))
    server.asked.clear()
    got = get_model(card, ModelRequest(transport=LOCAL, trust=hashes))
    assert got.checked == "trusted" and server.asked == []  # both came before, and are vouched for now
    remove("tiny")
    assert get_model(card, ModelRequest(transport=LOCAL, accept_unverified=True)).checked == "unverified"


def test_an_unverified_download_is_never_pieced_together(server):
    """Nothing would tell whether the parts belong to the same file."""
    server.cuts = [len(CONFIG), 1_000_000]
    get_model(card_of(server, known=False), ModelRequest(transport=LOCAL, accept_unverified=True))
    assert [span for _, span in server.asked] == [None, None, None]


@pytest.mark.parametrize("there", ["http://example.org/weights", "file:///etc/hostname", "ftp://example.org/w"])
def test_a_server_that_leads_to_something_insecure_is_not_followed(server, there):
    server.redirect = there
    with pytest.raises((InputRejected, FluidliftError), match=r"not secure|302"):
        get_model(card_of(server), ModelRequest(transport=LOCAL))
    assert kept("tiny") is None


def test_a_redirect_to_storage_is_followed(server):
    with file_server() as storage:
        storage.contents = {"weights": DATA}
        server.redirect = f"{storage.address}/weights"
        card = card_of(server)
        got = get_model(replace(card, files=card.files[1:]), ModelRequest(transport=LOCAL))
        assert got.path.read_bytes() == DATA and storage.asked == [("/weights", None)]


def test_only_https_is_asked():
    assert HTTPS.allows("https://huggingface.co/x") and not HTTPS.allows("http://127.0.0.1/x")
    assert not LOCAL.allows("http://192.168.0.1/x") and not LOCAL.allows("file:///etc/passwd")
    with pytest.raises(ValueError, match="https"):
        ModelFile("weights", "http://example.org/weights")
    with pytest.raises(ValueError, match="plain name"):
        ModelFile("../weights", "https://example.org/weights")


@pytest.mark.parametrize(("status", "says"), [(401, "asked for it"), (404, "not there any more"), (503, "later")])
def test_a_server_that_refuses_is_understood(server, status, says):
    server.status = status
    with pytest.raises(FluidliftError, match=rf"{status}.*{says}.*--from"):
        get_model(card_of(server), ModelRequest(transport=LOCAL))


def test_without_a_network_the_way_out_is_told(server, tmp_path):
    file = at(ModelFile("weights", "https://x.y/z", 3, "0" * 64), "http://127.0.0.1:9/weights")
    with pytest.raises(FluidliftError, match=r"could not be fetched.*--from"):
        fetch(file, tmp_path / "weights", replace(LOCAL, tries=2))


def test_the_proxy_of_the_environment_is_used(server, monkeypatch, tmp_path):
    monkeypatch.setenv("http_proxy", server.address)
    monkeypatch.setenv("no_proxy", "")
    file = at(ModelFile("weights", "https://x.y/z"), "http://localhost:9/weights")
    server.contents["http://localhost:9/weights"] = DATA
    assert fetch(file, tmp_path / "weights", LOCAL) == hashlib.sha256(DATA).hexdigest()
    assert server.asked == [("http://localhost:9/weights", None)]  # as a proxy is asked


def test_a_full_disk_is_said_before_and_while_it_fills(server, monkeypatch):
    usage = namedtuple("usage", "total used free")(10**9, 10**9, 10**6)
    with monkeypatch.context() as patched:
        patched.setattr(model_get.shutil, "disk_usage", lambda path: usage)
        with pytest.raises(InputRejected, match=r"1 MB free.*FLUIDLIFT_MODELS"):
            get_model(card_of(server), ModelRequest(transport=LOCAL))

    def full(number):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(model_download.os, "fsync", full)
    with pytest.raises(InputRejected, match=r"disk full.*FLUIDLIFT_MODELS"):
        get_model(card_of(server), ModelRequest(transport=LOCAL))


# brought by hand ---------------------------------------------------------------------------------------------------


@pytest.fixture
def brought(tmp_path):
    folder = tmp_path / "stick"
    folder.mkdir()
    (folder / "config.json").write_bytes(CONFIG)
    (folder / "weights").write_bytes(DATA)
    return folder


def test_files_brought_by_hand_are_checked_alike(server, brought):
    got = get_model(card_of(server), ModelRequest(brought))
    assert (got.folder / "weights").read_bytes() == DATA and server.asked == []
    (brought / "weights").write_bytes(DATA[:-1] + b"?")
    with pytest.raises(InputRejected, match="SHA-256"):
        get_model(card_of(server), ModelRequest(brought))
    assert (got.folder / "weights").read_bytes() == DATA  # what was right before stays
    (brought / "weights").write_bytes(DATA[:-1])
    with pytest.raises(InputRejected, match="has 2999999 bytes"):
        get_model(card_of(server), ModelRequest(brought))
    (brought / "weights").unlink()
    with pytest.raises(InputRejected, match="cannot be read"):
        get_model(card_of(server), ModelRequest(brought))
    with pytest.raises(InputRejected, match="no file or folder"):
        get_model(card_of(server), ModelRequest(brought / "nothing"))


def test_one_file_may_have_any_name(server, brought):
    os.rename(brought / "weights", brought / "download (1)")
    card = card_of(server)
    got = get_model(replace(card, files=card.files[1:]), ModelRequest(brought / "download (1)"))
    assert got.path.name == "weights"


def test_links_and_pipes_are_not_read(server, brought, tmp_path):
    os.rename(brought / "weights", tmp_path / "elsewhere")
    (brought / "weights").symlink_to(tmp_path / "elsewhere")
    with pytest.raises(InputRejected, match=r"is a link.*cp -L"):
        get_model(card_of(server), ModelRequest(brought))
    (brought / "weights").unlink()
    os.mkfifo(brought / "weights")
    with pytest.raises(InputRejected, match="no plain file"):
        get_model(card_of(server), ModelRequest(brought))


@pytest.mark.parametrize("place", ["tiny.begun", "tiny"])
def test_nothing_is_written_through_a_link(server, cache, tmp_path, place):
    outside = tmp_path / "outside"
    outside.mkdir()
    cache.mkdir()
    (cache / place).symlink_to(outside)
    assert kept("tiny") is None
    with pytest.raises(InputRejected, match="in the way"):
        get_model(card_of(server), ModelRequest(transport=LOCAL))
    assert list(outside.iterdir()) == []
    remove("tiny")
    assert outside.is_dir() and not (cache / place).is_symlink()


def test_a_link_in_the_place_of_a_file_that_was_begun_is_not_followed(server, tmp_path):
    begun_folder("tiny").mkdir(parents=True)
    secret = tmp_path / "secret"
    secret.write_bytes(b"mine")
    (begun_folder("tiny") / "weights").symlink_to(secret)
    with pytest.raises(InputRejected, match="in the way"):
        get_model(card_of(server), ModelRequest(transport=LOCAL))
    assert secret.read_bytes() == b"mine"


def test_one_process_at_a_time(server):
    with alone("tiny"), pytest.raises(InputRejected, match="another process"):
        get_model(card_of(server), ModelRequest(transport=LOCAL))


@pytest.mark.parametrize(
    "record", ["", "[]", '{"name": "tiny"}', '{"name": "tiny", "files": {"../x": "0"}}', "{" * 9999]
)
def test_a_cache_that_somebody_else_wrote_counts_as_empty(server, cache, record):
    get_model(card_of(server), ModelRequest(transport=LOCAL))
    (cache / "tiny" / RECORD).write_text(record)
    assert kept("tiny") is None


# the table ---------------------------------------------------------------------------------------------------------


def test_every_model_of_the_table_has_a_back_end_and_terms():
    cards = every_model()
    assert len({card.name for card in cards}) == len(cards)
    for card in cards:
        assert card.back_end[1] in BACK_ENDS[card.back_end[0]]
        assert card.title and card.home.startswith("https://")
        assert (card.back_end[0] == "generator") == (not card.files)
    for card in MODELS:
        for file in card.files:
            pinned = "/resolve/main/" not in file.address
            assert file.sha256 is None or pinned  # a hash of something that may change says nothing
            assert (file.bytes is None) == (file.sha256 is None)
    # the first of each kind is the one that is advised, and advised is what everybody may use
    first = {gain: card for card in reversed(MODELS) for gain in card.gains}
    assert first["depth"].name == "moge-2-vits-normal" and first["masks"].terms == "allowed"


def test_a_name_that_is_mistyped_is_understood():
    with pytest.raises(InputRejected, match=r"get sam2\.1-hiera-tiny"):
        model_of("sam2-hiera-tiny")


def test_generators_and_models_on_request_say_where_they_are(brought):
    with pytest.raises(InputRejected, match="fluidlift generators lgm"):
        get_model(model_of("lgm"), ModelRequest())
    with pytest.raises(InputRejected, match=r"on request only.*--from FOLDER"):
        get_model(model_of("sam3"), ModelRequest())


def test_the_cache_lies_where_it_is_said_to(monkeypatch, tmp_path):
    assert models_folder() == tmp_path / "cache"
    monkeypatch.delenv("FLUIDLIFT_MODELS")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "xdg"))
    assert models_folder() == tmp_path / "xdg" / "fluidlift" / "models"


def test_a_record_names_no_user_and_no_folder(server, cache):
    get_model(card_of(server), ModelRequest(transport=LOCAL))
    text = (cache / "tiny" / RECORD).read_text()
    assert str(cache) not in text and set(json.loads(text)) == {"name", "files", "checked", "terms"}
    shutil.rmtree(cache)
