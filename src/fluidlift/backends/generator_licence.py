"""The terms of third-party models: shown before the first use, accepted by the user, remembered by their text."""

from __future__ import annotations

import hashlib
import json
import os
from contextlib import suppress
from pathlib import Path
from typing import Literal, Protocol

from fluidlift.backends.generator_card import GeneratorCard
from fluidlift.errors import InputRejected
from fluidlift.messages import NONE, Notice

Use = Literal["research", "commercial"]


class Terms(Protocol):
    """What a card says of its terms: that of a generator, or of a model whose weights are fetched."""

    @property
    def name(self) -> str:
        """By which they are remembered."""
        ...

    @property
    def title(self) -> str:
        """For people."""
        ...

    @property
    def licence(self) -> str:
        """In words."""
        ...

    @property
    def licence_commercial(self) -> bool:
        """Whether commercial use is not forbidden."""
        ...

    @property
    def home(self) -> str:
        """Address."""
        ...


def terms_of(card: Terms) -> str:
    """What a user has to read."""
    allowed = "allowed" if card.licence_commercial else "NOT allowed"
    return f"{card.title}: {card.licence} Commercial use: {allowed}. {card.home}"


def memory_file() -> Path:
    """Where accepted licences are remembered: fluidlift/licences.json below the user's configuration folder."""
    base = os.environ.get("XDG_CONFIG_HOME") or Path.home() / ".config"
    return Path(base) / "fluidlift" / "licences.json"


def is_accepted(card: Terms) -> bool:
    """Whether the user has accepted these very terms before; other terms under the same name count as new."""
    return _remembered().get(card.name) == _digest(card)


def remember(card: Terms) -> None:
    """Note that the user has accepted the terms; a folder that cannot be written only means to be asked again."""
    path = memory_file()
    with suppress(OSError):
        from fluidlift.io.atomic import write_json

        path.parent.mkdir(parents=True, exist_ok=True)
        write_json(path, _remembered() | {card.name: _digest(card)})


def require_accepted(card: GeneratorCard, accepted: tuple[str, ...]) -> None:
    """Let pass a generator whose terms were accepted now (its name in `accepted`, remembered from then on) or before.

    Raises:
        InputRejected: they were not; the message holds the terms.
    """
    if card.name in accepted:
        if not is_accepted(card):
            remember(card)
        return
    if not is_accepted(card):
        raise InputRejected(
            f"the licence of the generator '{card.name}' was not accepted. {terms_of(card)}",
            "that you have read its terms and may use it under them",
            f"--accept-licence {card.name}, or leave out --generator",
        )


def require_use(card: GeneratorCard, use: Use | None, others: tuple[GeneratorCard, ...] = ()) -> Notice:
    """A warning where the terms forbid commercial use and nothing was said about the use; else an empty text.

    Args:
        card: of the generator.
        use: what the user said that the asset is for.
        others: cards of all generators, from which a remedy is named.

    Raises:
        InputRejected: the use that was stated is forbidden.
    """
    if card.licence_commercial or use == "research":
        return NONE
    if use is None:
        return Notice(
            "generator-not-commercial",
            f"{card.title} may not be used commercially: nor may this asset, as far as it is made of its body. Say "
            "what it is for with --use research or --use commercial",
        )
    free = ", ".join(c.name for c in others if c.licence_commercial)
    raise InputRejected(
        f"--use commercial with {card.title}, whose terms forbid it. {card.licence}",
        "a generator whose terms allow the use" + (f": {free}" if free else ""),
        "choose such a one, or leave out --generator: the built-in one is free of terms",
    )


def _digest(card: Terms) -> str:
    return hashlib.sha256(terms_of(card).encode()).hexdigest()


def _remembered() -> dict[str, str]:
    try:
        found = json.loads(memory_file().read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    return found if isinstance(found, dict) else {}
