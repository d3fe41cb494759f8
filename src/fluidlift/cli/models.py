"""The command `models`: what learned models there are and are good for; fetch one, with consent; remove it."""

from __future__ import annotations

import dataclasses
import json as json_module
import os
import sys
import textwrap
from dataclasses import field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from fluidlift.cli import quantities
from fluidlift.errors import InputRejected

if TYPE_CHECKING:
    from fluidlift.backends.model_card import ModelCard, ModelFile
    from fluidlift.backends.model_download import Transport

TRANSPORT: Transport | None = None
"""how files are fetched; None: by https"""
_WIDTH = 110
_USE = "fluidlift make CLIP --models "
_TERMS = {"allowed": "allowed", "conditions": "conditions", "research": "research only"}
_COMMERCIAL = {"allowed": "allowed", "conditions": "see these conditions", "research": "NOT allowed"}


@quantities.command
class Models:
    """List learned models and what each makes better; get one (asks first), explain one, remove one."""

    action: Annotated[
        Literal["list", "show", "get", "remove"], tyro.conf.Positional, tyro.conf.arg(metavar="ACTION")
    ] = "list"
    """list, show, get or remove"""
    name: Annotated[str | None, tyro.conf.Positional, tyro.conf.arg(metavar="NAME")] = None
    """model to show, get or remove"""
    from_: Annotated[Path | None, tyro.conf.arg(name="from")] = None
    """get: folder or file that was brought by hand, in place of the network; checked in the same way"""
    yes: bool = False
    """get: you agree to the download, its size and its licence; without a terminal nobody is asked"""
    accept_licence: bool = False
    """get: you have read the terms of a model for research only and keep to them; remembered"""
    trust: tyro.conf.UseAppendAction[tuple[str, ...]] = field(default_factory=tuple)
    """get: SHA-256 that you have from elsewhere, for a file whose hash is not known here; may be repeated"""
    accept_unverified: bool = False
    """get: take files whose hash is not known here as they come"""
    json: bool = False
    """print as JSON"""


def run(c: Models) -> int:
    """Do what the command says; the exit code is 0.

    Raises:
        InputRejected: no such model, no consent, or files that are not the right ones.
        FluidliftError: no network.
    """
    if c.action == "list":
        if c.name is not None:
            raise InputRejected(f"fluidlift models list {c.name}", "no name", f"fluidlift models show {c.name}")
        return _list(c)
    if c.name is None:
        raise InputRejected(f"fluidlift models {c.action} without a name", "a model", "fluidlift models lists them")
    from fluidlift.backends.model_table import model_of

    card = model_of(c.name)
    return {"show": _show, "get": _get, "remove": _remove}[c.action](card, c)


def row_of(card: ModelCard) -> dict[str, Any]:
    """Everything about a model and what is there of it, in JSON's own kinds."""
    from fluidlift.backends.generator_licence import is_accepted
    from fluidlift.backends.model_cache import kept
    from fluidlift.backends.model_table import lacking_packages

    there = kept(card.name)
    state = None if there is None else {"files": there.hashes, "checked": there.checked, "bytes": there.bytes}
    return dataclasses.asdict(card) | {
        "bytes": card.bytes, "accepted": is_accepted(card), "cached": state, "lacking": lacking_packages(card),
    }  # fmt: skip


def size_text(size: int | None) -> str:
    """Such as 141 MB."""
    if size is None:
        return "not known"
    return f"{size / 1e9:.1f} GB" if size >= 1e9 else f"{size / 1e6:.0f} MB"


def _list(c: Models) -> int:
    from fluidlift.backends.model_cache import kept
    from fluidlift.backends.model_table import every_model

    cards = every_model()
    if c.json:
        print(json_module.dumps([row_of(card) for card in cards], indent=1))
        return 0
    rows = [("model", "makes better", "licence", "size", "time on a CPU", "here")]
    for card in cards:
        here = "yes" if kept(card.name) else "-" if card.files else "own environment"
        size = size_text(card.bytes) if card.files else "-"
        rows.append((card.name, ", ".join(card.gains), _TERMS[card.terms], size, card.cpu, here))
    width = [max(len(row[k]) for row in rows) for k in range(len(rows[0]))]
    for row in rows:
        print("  ".join(cell.ljust(w) for cell, w in zip(row, width)).rstrip())
    print("\nfluidlift models show NAME tells its terms and files; fluidlift models get NAME fetches it (asks first).")
    print("fluidlift make CLIP --models auto uses what is here. Without any, nothing is needed.")
    return 0


def _show(card: ModelCard, c: Models) -> int:
    print(json_module.dumps(row_of(card), indent=1) if c.json else "\n".join(explained(card)))
    return 0


def explained(card: ModelCard) -> list[str]:
    """Everything about one model, line by line."""
    from fluidlift.backends.model_cache import kept
    from fluidlift.backends.model_table import lacking_packages

    def part(head: str, text: str) -> list[str]:
        return textwrap.wrap(text, _WIDTH, initial_indent=f"{head:14}", subsequent_indent=" " * 14)

    there, lacking = kept(card.name), lacking_packages(card)
    lines = [card.title, card.home, "", *part("makes better", ", ".join(card.gains))]
    lines += part("licence", card.licence) + part("", f"Commercial use: {_COMMERCIAL[card.terms]}.")
    for file in card.files:
        where = file.address or "on request"
        hashed = f"SHA-256 {file.sha256}" if file.sha256 else "hash not known here"
        lines += [f"{'file':14}{file.name}, size {size_text(file.bytes)}, {hashed}", " " * 14 + where]
    lines += part("time on a CPU", card.cpu)
    for note in card.notes:
        lines += part("note", note)
    if lacking:
        lines += part("needs", f"{', '.join(lacking)}: {card.install}")
    if there is None:
        return lines + (part("here", f"no: fluidlift models get {card.name}") if card.files else [])
    checked = {"card": "as known here", "trusted": "as you vouched for"}.get(there.checked, "vouched for by nobody")
    return lines + part("here", f"yes, {size_text(there.bytes)}, hashes {checked}") + part("use", _USE + card.name)


def _get(card: ModelCard, c: Models) -> int:
    from fluidlift.backends.model_download import HTTPS
    from fluidlift.backends.model_get import ModelRequest, get_model
    from fluidlift.backends.model_table import lacking_packages

    source = None if c.from_ is None else Path(os.path.expanduser(c.from_))
    if card.files and (source is not None or not card.by_hand):
        _require_consent(card, c, source)
    if any(len(t) != 64 or set(t.lower()) - set("0123456789abcdef") for t in c.trust):
        raise InputRejected(f"--trust {' '.join(c.trust)}", "a SHA-256 of 64 hexadecimal digits")
    trust = tuple(t.lower() for t in c.trust)
    got = get_model(card, ModelRequest(source, trust, c.accept_unverified, TRANSPORT or HTTPS, _Shown()))
    if c.json:
        print(json_module.dumps(row_of(card), indent=1))
        return 0
    for name, sha256 in got.hashes.items():
        print(f"{name}: SHA-256 {sha256}")
    print(f"{card.name} is here ({size_text(got.bytes)})")
    if lacking := lacking_packages(card):
        print(f"it needs {', '.join(lacking)}: {card.install}")
    print(f"use it: {_USE}{card.name}")
    return 0


def _remove(card: ModelCard, c: Models) -> int:
    from fluidlift.backends.model_cache import remove

    freed = remove(card.name)
    print(json_module.dumps({"removed": card.name, "bytes": freed}) if c.json
          else f"{card.name} was removed ({size_text(freed)})")  # fmt: skip
    return 0


def _require_consent(card: ModelCard, c: Models, source: Path | None) -> None:
    """Tell size, licence and origin, and see that the user agrees: by options, or by typing yes.

    Raises:
        InputRejected: no consent.
    """
    from fluidlift.backends.generator_licence import is_accepted, remember

    bound = card.terms == "research" and not is_accepted(card)
    agreed = c.yes and (c.accept_licence or not bound)
    whence = source or ", ".join(sorted({f.address.split("/")[2] for f in card.files if f.address}))
    size = "of a size that is not known" if card.bytes is None else size_text(card.bytes)
    told = [f"{card.title}, {size} from {whence}. {card.licence}",
            f"Commercial use: {_COMMERCIAL[card.terms]}. {card.home}"]  # fmt: skip
    if not c.json or not agreed:
        print(textwrap.fill(" ".join(told), _WIDTH), file=sys.stderr)
    if not agreed:
        if not (sys.stdin.isatty() and sys.stderr.isatty()):
            options = "--yes" + (" --accept-licence" if bound else "")
            raise InputRejected(
                f"{card.name} was not fetched: nobody is at a terminal to agree"
                + (" to terms for research only" if bound else ""),
                "that you have read its terms and keep to them", f"fluidlift models get {card.name} {options}",
            )  # fmt: skip
        for_what = " for research only" if bound else ""
        print(f"Do you accept these terms{for_what}, and fetch it? Type yes to go on: ", end="", file=sys.stderr)
        sys.stderr.flush()
        if sys.stdin.readline().strip().lower() not in ("yes", "y"):
            raise InputRejected(f"{card.name} was not fetched: you did not agree", "yes")
    if bound:
        remember(card)


class _Shown:
    """How far a download is, on standard error: one line that is written over at a terminal, a few lines elsewhere."""

    def __init__(self) -> None:
        self._tenth = -1

    def __call__(self, file: ModelFile, done: int, total: int | None) -> None:
        live = sys.stderr.isatty()
        tenth = int(10 * done / total) if total else int(done / 1e8)
        if not live and tenth == self._tenth:
            return
        self._tenth = tenth
        text = f"{file.name}: {size_text(done)}" + ("" if total is None else f" of {size_text(total)}")
        end = "\n" if not live or done == total else ""
        print(("\r" if live else "") + text + " " * 4 * live, end=end, file=sys.stderr, flush=True)
