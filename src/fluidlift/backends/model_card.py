"""What has to be known of a learned model before its weights are fetched: use, terms, files with their hashes."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Literal

from fluidlift.errors import require

Gain = Literal["masks", "depth", "tilt", "focal length", "flow", "bodies"]
"""what of an asset a model makes better, or can"""
Terms = Literal["allowed", "conditions", "research"]
"""every use is allowed; it depends (a licence of its own, or a question that nobody has answered); research only"""

MOST_BYTES = 8 * 2**30
"""of a file whose size is not known: no model that is listed comes near that"""
_NAME = re.compile(r"[a-z0-9][a-z0-9.-]*")
_FILE = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]*")
_HASH = re.compile(r"[0-9a-f]{64}")


@dataclass(frozen=True)
class ModelFile:
    """One file of a model."""

    name: str
    """as it is kept, without a folder"""
    address: str
    """https address of a pinned revision; empty: it is handed out by hand"""
    bytes: int | None = None
    """size; None: not known"""
    sha256: str | None = None
    """64 hexadecimal digits; None: not known here, so that the user has to vouch for what comes"""

    def __post_init__(self) -> None:
        require(bool(_FILE.fullmatch(self.name)), f"file name {self.name!r}", "a plain name")
        require(not self.address or self.address.startswith("https://"), f"address {self.address!r}", "https")
        require(self.sha256 is None or bool(_HASH.fullmatch(self.sha256)), f"hash {self.sha256!r}", "64 hex digits")

    @property
    def most(self) -> int:
        """Bytes that are taken in at most."""
        return MOST_BYTES if self.bytes is None else self.bytes


@dataclass(frozen=True)
class ModelCard:
    """Facts about one model. None of them needs its packages or its files."""

    name: str
    """as the command line has it: lower case, such as moge-2-vits-normal"""
    title: str
    """as its authors call it, with the year"""
    gains: tuple[Gain, ...]
    """what it makes better"""
    back_end: tuple[str, str]
    """purpose and name in the registry, such as ("depth model", "moge")"""
    licence: str
    """one paragraph: the licence of the code, that of the weights, and what of it is not sure"""
    terms: Terms
    """what that means"""
    home: str
    """address of its page"""
    files: tuple[ModelFile, ...] = ()
    """what it consists of; none: its own environment fetches them (generators)"""
    packages: tuple[str, ...] = ()
    """Python modules that it needs beside fluidlift's own"""
    install: str = ""
    """the command that brings them"""
    cpu: str = "not measured"
    """time on a CPU of two cores, where it was measured"""
    notes: tuple[str, ...] = ()
    """what else a user should know"""

    def __post_init__(self) -> None:
        require(bool(_NAME.fullmatch(self.name)), f"model name {self.name!r}", "lower case, digits, hyphens, points")
        require(bool(self.licence.strip()), f"no licence on the card of {self.name}", "its terms, in words")
        require(bool(self.gains), f"{self.name} makes nothing better", "what it is for")
        require(len({f.name for f in self.files}) == len(self.files), f"files of {self.name}", "different names")

    @property
    def licence_commercial(self) -> bool:
        """Whether the terms do not forbid commercial use outright."""
        return self.terms != "research"

    @property
    def by_hand(self) -> bool:
        """Whether its files are handed out to those who ask, and so cannot be fetched."""
        return any(not f.address for f in self.files)

    @property
    def bytes(self) -> int | None:
        """Size of all files; None: not known, or there are none."""
        sizes = [f.bytes for f in self.files]
        return None if not sizes or None in sizes else sum(s for s in sizes if s is not None)
