"""Which frame is shown when."""

from __future__ import annotations

from dataclasses import dataclass

from fluidlift.errors import require
from fluidlift.io.frames import FIRST_FRAME

SPEEDS = {"1/8": 0.125, "1/4": 0.25, "1/2": 0.5, "1": 1.0, "2": 2.0, "4": 4.0}
"""times the real speed"""


@dataclass
class Timeline:
    """A playhead over a number of frames that may change while it runs. Times are those of any steady clock, s."""

    count: int
    interval: float
    """s between frames"""
    speed: float = 1.0
    playing: bool = False
    growing: bool = False
    """more frames will come: the end waits for them"""
    _position: float = 0.0
    """frames, from 0"""
    _since: float = 0.0

    def __post_init__(self) -> None:
        require(self.interval > 0, f"an interval of {self.interval} s", "positive seconds")

    @property
    def frame(self) -> int:
        """Shown now, counted from 0."""
        return min(max(int(self._position), 0), max(self.count - 1, 0))

    @property
    def label(self) -> str:
        """Number from 1001 and seconds."""
        return f"{FIRST_FRAME + self.frame}  ·  {self.frame * self.interval:.2f} s"

    def play(self, now: float) -> None:
        """Go on from where it stands; from the beginning where that is the end."""
        if self.frame >= self.count - 1 and not self.growing:
            self._position = 0.0
        self.playing, self._since = True, now

    def pause(self) -> None:
        """Stay where it stands."""
        self.playing = False

    def seek(self, frame: int, now: float = 0.0) -> None:
        """Go to a frame, from 0; beyond the ends is the end."""
        self._position = float(min(max(frame, 0), max(self.count - 1, 0)))
        self._since = now

    def step(self, frames: int) -> None:
        """Some frames on or back, round the ends, and stay there."""
        self.playing = False
        self._position = float((self.frame + frames) % max(self.count, 1))

    def resize(self, count: int, interval: float | None = None) -> None:
        """Another number of frames; a frame that is no longer there becomes the last one."""
        self.count = count
        self.interval = interval or self.interval
        self._position = min(self._position, max(count - 1, 0))

    def tick(self, now: float) -> int:
        """The frame to show at a time. Frames are left out rather than shown late; the end goes on at the beginning."""
        if self.playing and self.count > 0:
            passed = max(now - self._since, 0.0) * self.speed / self.interval
            ahead = self._position + passed
            self._position = min(ahead, self.count - 1.0) if self.growing else ahead % self.count
        self._since = now
        return self.frame
