"""`fluidlift generators`, and the question about a generator's licence before its first use."""

from __future__ import annotations

import dataclasses
import json
import os
import sys
import textwrap
from pathlib import Path
from typing import TYPE_CHECKING, Any

from fluidlift.backends import generators as registry
from fluidlift.backends.generator_licence import is_accepted, terms_of

if TYPE_CHECKING:
    from fluidlift.backends.generator_card import GeneratorCard
    from fluidlift.cli.options import Generators
    from fluidlift.config import JobConfig


def show(c: Generators) -> int:
    """List the generators, or explain one; the exit code is 0, whatever is installed."""
    names = registry.GENERATORS if c.name is None else (registry.require_known(c.name),)
    facts = []
    for name in names:
        card = registry.card_of(name)
        choice = registry.GeneratorChoice(name, python=_plain(c.python), code=_plain(c.code))
        facts.append((card, registry.check(name, choice)))
    if c.json:
        rows = [_row(card, found) for card, found in facts]
        print(json.dumps(rows if c.name is None else rows[0], indent=1))
    elif c.name is None:
        _list(facts)
    else:
        print("\n".join(explained(*facts[0])))
    return 0


def _plain(path: Any) -> Any:
    return None if path is None else Path(os.path.expanduser(path))


def _row(card: GeneratorCard, found: registry.Readiness) -> dict[str, Any]:
    return dataclasses.asdict(card) | {"accepted": is_accepted(card), "check": found.to_dict()}


def _list(facts: list[tuple[GeneratorCard, registry.Readiness]]) -> None:
    for card, found in facts:
        commercial = "commercial use allowed" if card.licence_commercial else "no commercial use"
        print(f"{card.name:18} {card.title}; {commercial}")
        print(textwrap.fill(found.sentence(), 110, initial_indent=" " * 19, subsequent_indent=" " * 19))
    print("\nfluidlift generators NAME tells what one is good for, its terms, and how to install it.")
    print("fluidlift make CLIP --generator NAME [--generator-python PATH] uses it. Without it, nothing is needed.")


def explained(card: GeneratorCard, found: registry.Readiness) -> list[str]:
    """Everything about one generator, line by line."""

    def part(head: str, text: str) -> list[str]:
        return textwrap.wrap(text, 110, initial_indent=f"{head:11}", subsequent_indent=" " * 11)

    lines = [card.title, card.home, ""]
    lines += part("licence", card.licence)
    lines += part("", "Commercial use: " + ("allowed." if card.licence_commercial else "NOT allowed."))
    lines += part("accepted", "yes" if is_accepted(card) else f"no: --accept-licence {card.name} once")
    lines += part("hardware", card.hardware)
    lines += part("weights", ", ".join(card.weights))
    for note in card.notes:
        lines += part("note", note)
    foreign = getattr(registry.generator_class(card.name), "foreign_code", "")
    if foreign:
        lines += part("note", f"It loads {foreign}: it runs in a process of its own only (--generator-python).")
    lines += ["", "install, in an environment of its own:", *(f"    {command}" for command in card.install)]
    lines += [f"    fluidlift make CLIP --generator {card.name} --generator-python PATH/bin/python", ""]
    where = found.where + (f" (Python {found.python})" if found.python else "")
    lines += part("checked", f"{where}: {found.sentence()}")
    lines += part("GPU", found.gpu or f"none ({found.no_gpu or 'not looked at'})")
    return lines


def accepted_by_asking(config: JobConfig) -> JobConfig:
    """The job with the licence accepted, where a person at a terminal says yes; unchanged elsewhere, where the job says
    itself what it lacks."""
    name = registry.require_known(str(config.generate.name))
    card = registry.card_of(name)
    if name in config.generate.accept_licence or is_accepted(card):
        return config
    if not (sys.stdin.isatty() and sys.stderr.isatty()):
        return config
    print(textwrap.fill(terms_of(card), 110), file=sys.stderr)
    print(f"Do you accept these terms for {card.title}? Type yes to go on: ", end="", file=sys.stderr, flush=True)
    if sys.stdin.readline().strip().lower() not in ("yes", "y"):
        return config
    accepted = (*config.generate.accept_licence, name)
    return dataclasses.replace(config, generate=dataclasses.replace(config.generate, accept_licence=accepted))
