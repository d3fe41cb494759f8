"""A learned model into the cache, whole and right or not at all: fetched, or brought by hand."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

from fluidlift.backends.model_cache import (
    ELSEWHERE,
    RECORD,
    KeptModel,
    alone,
    begun_folder,
    kept,
    models_folder,
)
from fluidlift.backends.model_card import ModelCard, ModelFile
from fluidlift.backends.model_download import HTTPS, Transport, copy, fetch
from fluidlift.errors import FluidliftError, InputRejected

MARGIN = 2**26
"""bytes that stay free on the disk: a full one fails others too"""


@dataclass(frozen=True)
class ModelRequest:
    """How a model is to come, and what the user vouches for."""

    source: Path | None = None
    """folder or file that was brought by hand; None: it is fetched"""
    trust: tuple[str, ...] = ()
    """SHA-256 that the user has from elsewhere, for files whose hash is not known here"""
    accept_unverified: bool = False
    """take files whose hash nobody knows"""
    transport: Transport = HTTPS
    told: Callable[[ModelFile, int, int | None], None] = field(default=lambda file, done, total: None)
    """hears how far a file is"""


def get_model(card: ModelCard, wanted: ModelRequest) -> KeptModel:
    """Bring all files of a model into the cache. One that is there already is replaced when the new one is right.

    Raises:
        InputRejected: a file that is not the known one, one that nobody vouches for, a full disk, or a model that
            cannot be fetched.
        FluidliftError: no network; what came so far is kept.
    """
    _require_possible(card, wanted)
    with alone(card.name):
        begun, final = begun_folder(card.name), models_folder() / card.name
        _require_no_link(begun)
        begun.mkdir(exist_ok=True)
        _require_room(card, begun)
        hashes, checked = {}, "card"
        for file in card.files:
            hashes[file.name] = _brought(file, begun, wanted)
            how = _required_right(file, begun / file.name, hashes[file.name], card, wanted)
            checked = max(checked, how, key=("card", "trusted", "unverified").index)
        _finish(card, begun, final, hashes, checked)
    found = kept(card.name)
    if found is None:
        raise FluidliftError(f"'{final}' is not there after it was written. Do: try again.")
    return found


def _require_possible(card: ModelCard, wanted: ModelRequest) -> None:
    if not card.files:
        raise InputRejected(
            f"{card.name} is a generator, whose own environment fetches its weights", "a model with files of its own",
            f"fluidlift generators {card.name}",
        )  # fmt: skip
    if card.by_hand and wanted.source is None:
        raise InputRejected(
            f"{card.name} is handed out on request only", "its files: " + ", ".join(f.name for f in card.files),
            f"ask for it at {card.home}, then fluidlift models get {card.name} --from FOLDER",
        )  # fmt: skip
    if wanted.source is not None and not os.path.lexists(wanted.source):
        raise InputRejected(f"no file or folder '{wanted.source}'", "what was brought", "check --from")


def _require_no_link(folder: Path) -> None:
    if folder.is_symlink() or (os.path.lexists(folder) and not folder.is_dir()):
        raise InputRejected(f"'{folder}' is in the way", "a folder or nothing", "delete it")


def _require_room(card: ModelCard, begun: Path) -> None:
    there = sum(p.lstat().st_size for p in begun.iterdir())
    needed = (card.bytes or 0) - there + MARGIN
    free = shutil.disk_usage(begun).free
    if free < needed:
        raise InputRejected(
            f"{free / 1e6:.0f} MB free on the disk of '{models_folder()}'", f"about {needed / 1e6:.0f} MB",
            f"free some space, or {ELSEWHERE}",
        )  # fmt: skip


def _brought(file: ModelFile, begun: Path, wanted: ModelRequest) -> str:
    """The SHA-256 of a file that is now in `begun`."""
    target = begun / file.name

    def told(done: int, total: int | None) -> None:
        wanted.told(file, done, total)

    if wanted.source is None:
        waiting = _vouched(target, wanted.trust) if file.sha256 is None else None
        return waiting or fetch(file, target, wanted.transport, told)
    source = wanted.source / file.name if wanted.source.is_dir() else wanted.source
    return copy(file, source, target, told)


def _vouched(target: Path, trust: tuple[str, ...]) -> str | None:
    """The hash of a file that an earlier run fetched and could not vouch for, where the user does so now."""
    from fluidlift.io.hashes import digest

    if not trust or target.is_symlink() or not target.is_file():
        return None
    found = digest(target)
    return found if found in trust else None


def _required_right(file: ModelFile, path: Path, found: str, card: ModelCard, wanted: ModelRequest) -> str:
    """Against what a hash was checked: card, trusted, unverified."""
    if file.sha256 is not None:
        if found == file.sha256:
            return "card"
        path.unlink(missing_ok=True)  # no beginning of the right one
        raise InputRejected(
            f"'{file.name}' has the SHA-256 {found}", f"that of the known file, {file.sha256}",
            "get it again; if it stays so, the server or the way to it has changed the file: do not use it",
        )  # fmt: skip
    if found in wanted.trust:
        return "trusted"
    if wanted.accept_unverified:
        return "unverified"
    raise InputRejected(
        f"'{file.name}' of {card.name} came with SHA-256 {found}, and what it should be is not known here",
        f"somebody who vouches for it: {card.home} shows the hashes of large files",
        f"compare it, then add --trust {found}; or --accept-unverified",
    )  # fmt: skip


def _finish(card: ModelCard, begun: Path, final: Path, hashes: dict[str, str], checked: str) -> None:
    """The record, then the folder's own name: it is there with everything, or not at all."""
    from fluidlift.io.atomic import write_json

    for path in begun.iterdir():
        if path.name not in hashes:
            path.unlink()
    write_json(begun / RECORD, {"name": card.name, "files": hashes, "checked": checked, "terms": card.terms})
    _require_no_link(final)
    old = final.with_name(f"{card.name}.old")
    if os.path.lexists(final):
        shutil.rmtree(old, ignore_errors=True)
        os.rename(final, old)
    os.rename(begun, final)
    shutil.rmtree(old, ignore_errors=True)
