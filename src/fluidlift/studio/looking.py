"""What is found of the clip that is open: worked out in a thread, the newest wish first, told as it comes."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from fluidlift.config import JobConfig
from fluidlift.errors import FluidliftError
from fluidlift.pipeline import Inputs
from fluidlift.pipeline.models import NO_MODELS, ModelWish
from fluidlift.types.hints import ClipHints
from fluidlift.types.stages import Read, Segmentation

LOG = logging.getLogger(__name__)
LOOK_SIZE = 320
"""px, longer side of the pictures that are looked at"""
LOOK_FLOW = "dis"
"""flow of single pairs: the mask goes by it anyway, and kind, tilt and arrows come in a third of the time"""
LOOK_SECONDS = 3.0
"""of a clip without a trim: what is found there is mostly true of the rest"""
WORDS = {"window": "looking through the clip", "read": "reading the clip",
         "flow": "measuring the motion", "segment": "finding the fluid",
         "correct": "putting your regions in", "view": "kind, tilt and scale"}  # fmt: skip


class _Overtaken(FluidliftError):
    """There is a newer wish, or the work is to end."""


@dataclass(frozen=True)
class FindRequest:
    """What is to be looked at."""

    clip: Path
    hints: ClipHints
    room: Path
    """folder of what is kept between looks"""
    asked: float = 0.0
    """time of the clock at which it was wished"""
    learned: ModelWish = NO_MODELS
    """models; those for flow are left to the make, for the reason of `LOOK_FLOW`"""

    @property
    def slow_part(self) -> tuple[Any, ...]:
        """What the slow stages depend on."""
        h = self.hints
        return self.clip, h.start, h.duration, h.clicks, h.roi


@dataclass
class FindState:
    """How far it is, and what is known."""

    clip: Path | None = None
    words: str = ""
    """what is being done; empty: nothing"""
    share: float = 0.0
    """of the stage, 0 to 1"""
    error: str = ""
    read: Read | None = None
    segmentation: Segmentation | None = None
    facts: dict[str, Any] | None = None
    """all of them, of the last look that came to its end"""
    so_far: dict[str, Any] = field(default_factory=dict)
    """what the stages of a look have told before that: the camera's path, how much is fluid"""
    pictures: int = 0
    """changes with the frames"""
    masks: int = 0
    """changes with the masks"""
    waited: float = 0.0
    """s from the wish to its end"""
    warnings: list[str] = field(default_factory=list)


class Looking:
    """A thread that looks at what was wished last.

    Args:
        changed: called from that thread whenever something new is known.
        found: called from that thread with a wish and the facts that were found for it.
    """

    def __init__(self, changed: Callable[[], None], found: Callable[[FindRequest, dict[str, Any]], None]) -> None:
        self._changed, self._found = changed, found
        self._wake = threading.Condition()
        self._wish: FindRequest | None = None
        self._ended = False
        self._done: FindRequest | None = None
        self._memory: dict[str, tuple[str, Any]] = {}
        """what a click does not change, of the last clip"""
        self.look = FindState()
        self._thread = threading.Thread(target=self._run, name="looking", daemon=True)
        self._thread.start()

    def ask(self, wish: FindRequest | None) -> None:
        """Look at this; what is worked on gives way where it would be of no use."""
        with self._wake:
            if wish is None or wish.clip != self.look.clip:
                self.look = FindState(
                    None if wish is None else wish.clip, pictures=self.look.pictures + 1, masks=self.look.masks + 1
                )
            self._wish = wish
            self._wake.notify_all()

    @property
    def idle(self) -> bool:
        """Whether what was wished last is done."""
        return self._wish is None or self._wish is self._done

    def close(self) -> None:
        """End the thread."""
        with self._wake:
            self._ended = True
            self._wake.notify_all()
        self._thread.join(10.0)

    def overtaken(self, wish: FindRequest, *, between: bool) -> bool:
        """Whether there is something newer; within a stage, only what that stage depends on counts."""
        now = self._wish
        if self._ended or now is None:
            return True
        return now is not wish and (between or now.slow_part != wish.slow_part)

    def _run(self) -> None:
        while True:
            with self._wake:
                while not self._ended and self.idle:
                    self._wake.wait()
                if self._ended:
                    return
                wish = self._wish
            assert wish is not None
            try:
                self._work(wish)
                self._done = wish
            except _Overtaken:
                continue
            except FluidliftError as error:
                self._say(wish, error=str(error))
                self._done = wish
            except Exception as error:
                LOG.exception("looking at %s", wish.clip.name)
                self._say(wish, error=f"unexpected {type(error).__name__}: {error}")
                self._done = wish

    def _say(self, wish: FindRequest, *, error: str = "") -> None:
        with self._wake:
            if self._wish is wish:
                self.look.words, self.look.error, self.look.share = "", error, 0.0
                self.look.waited = time.monotonic() - wish.asked
        self._changed()

    def _work(self, wish: FindRequest) -> None:
        from fluidlift.pipeline.find import find_hints

        with self._wake:
            self.look.so_far = {}
        found = find_hints(
            Inputs(wish.clip), wish.room, look_config(wish.hints, wish.learned), wish.hints,
            progress=_LookProgress(self, wish), told=lambda name, value: self.told(wish, name, value),
            memory=self._memory,
        )  # fmt: skip
        facts = found.facts()
        with self._wake:
            if self._wish is wish:
                self.look.facts, self.look.warnings = facts, list(found.warnings)
        self._say(wish)
        self._found(wish, facts)

    def told(self, wish: FindRequest, name: str, value: Any) -> None:
        """A stage has ended."""
        from fluidlift.pipeline.find import camera_facts, fluid_facts

        if name == "segment" and wish.hints.regions:
            return  # the mask without the regions would flicker by
        clip = wish.hints.clip
        with self._wake:
            look = self.look
            if look.clip != wish.clip:
                raise _Overtaken("another clip")
            if isinstance(value, Read):
                look.so_far = look.so_far | {"camera": camera_facts(value, clip.size if clip else value.clip.size)}
                if not _same(look.read, value):
                    look.read, look.pictures = value, look.pictures + 1
            elif isinstance(value, Segmentation):
                look.segmentation, look.masks = value, look.masks + 1
                look.so_far = look.so_far | fluid_facts(value)
        self._changed()

    def progress(self, wish: FindRequest, **what: Any) -> None:
        """Tell how far it is."""
        with self._wake:
            for name, value in what.items():
                setattr(self.look, name, value)
        self._changed()


def _same(a: Read | None, b: Read) -> bool:
    """Whether both hold the same frames."""
    if a is None or a.clip.frames.shape != b.clip.frames.shape:
        return False
    return np.array_equal(a.clip.times, b.clip.times) and np.array_equal(a.clip.frames[0], b.clip.frames[0])


def look_config(hints: ClipHints, learned: ModelWish = NO_MODELS) -> JobConfig:
    """Settings of a look: small pictures, flow of pairs, and a few seconds where nothing says which.

    Args:
        hints: of a person.
        learned: models, of which those for masks and depth count.

    Raises:
        InputRejected: models that cannot be taken.
        MissingPackage: a named one lacks its packages.
    """
    from fluidlift.config import build_config

    base = {"read.max_size": LOOK_SIZE, "read.duration": LOOK_SECONDS}
    config = build_config(None, None, (), None, base=base | dict(hints.settings))
    taken = learned.on(config, Inputs(Path())).config
    return replace(taken, motion=replace(config.motion, method=LOOK_FLOW))


class _LookProgress:
    """Where the stages tell how far they are, and give way."""

    def __init__(self, looking: Looking, wish: FindRequest) -> None:
        self._looking, self._wish, self._told = looking, wish, 0.0

    def stage(self, name: str, number: int, count: int) -> None:
        """A stage begins."""
        if self._looking.overtaken(self._wish, between=True):
            raise _Overtaken("newer")
        self._looking.progress(self._wish, words=WORDS.get(name, name), share=0.0, error="")

    def update(self, done: int, total: int) -> None:
        """Part of it is done."""
        if self._looking.overtaken(self._wish, between=False):
            raise _Overtaken("newer")
        if time.monotonic() - self._told > 0.25:
            self._told = time.monotonic()
            self._looking.progress(self._wish, share=done / max(total, 1))

    def finished(self, name: str, seconds: float, cached: bool) -> None:
        """A stage ended."""

    def warn(self, text: str) -> None:
        """They are told with what was found."""

    def say(self, text: str) -> None:
        """Nothing is simulated here."""


def wished_at(wish: FindRequest) -> FindRequest:
    """The wish with the time of now."""
    return replace(wish, asked=time.monotonic())
