"""What a person says of a clip, in px and seconds of that clip: so it holds at any working size and for any trim."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

from fluidlift.errors import InputRejected, require

Point = tuple[float, float]
"""(x, y), px of the clip's picture, from its upper left corner"""

What = Literal["fluid", "not fluid", "rock", "sky", "ledge", "pool"]
"""ledge and pool are fluid: what comes down steeply onto the fluid below, and what stands level"""
SHAPE = 0.02
"""relative difference between the width over height of pictures that are of one shape: whole pixels at 64 px"""


@dataclass(frozen=True)
class ClipIdentity:
    """Which clip hints were given for."""

    name: str
    """of the file, without its folder"""
    size: tuple[int, int]
    """width and height of its picture, px: what points are counted in"""
    frames: int | None = None
    sha256: str | None = None
    """of its content"""
    time: float | None = None
    """s into the clip: points lie in the picture of this frame, where the camera moves; None: in the picture that the
    frames in use are laid on"""


@dataclass(frozen=True)
class Region:
    """Part of the picture, and what is there."""

    what: What
    line: tuple[Point, ...]
    """corners of an area, or the way of a brush"""
    width: float | None = None
    """px, of the brush; None: an area"""
    time: float = 0.0
    """s into the clip: the frame that it was drawn on"""
    moves: bool = False
    """it goes with the fluid, by the optical flow, to the other frames; else it is there in all of them"""
    begins: float | None = None
    """s into the clip: the first frame that it is there in; None: that of the clip"""
    ends: float | None = None
    """s into the clip: it is there in the frames before; None: to the end"""

    def __post_init__(self) -> None:
        backwards = self.begins is not None and self.ends is not None and self.ends <= self.begins
        require(not backwards, f"a region from {self.begins} s until {self.ends} s", "an end after its beginning")
        least = 3 if self.width is None else 1
        require(len(self.line) >= least, f"a region of {len(self.line)} points", f"{least} or more")
        require(self.width is None or self.width > 0, f"a brush {self.width} px wide", "more than 0")


@dataclass(frozen=True)
class Ruler:
    """Something on the fluid's surface whose length is known."""

    begin: Point
    end: Point
    metres: float


@dataclass(frozen=True)
class Rim:
    """The rim of a vessel, which is round and lies level."""

    center: Point
    axes: tuple[float, float]
    """px, half its length and half its width"""
    turned: float = 0.0
    """degrees clockwise from the picture's horizontal to the longer axis"""


@dataclass(frozen=True)
class Click:
    """A pixel of fluid, or of something else; it speaks for what looks and moves like it around."""

    at: Point
    fluid: bool


@dataclass(frozen=True)
class Arrow:
    """Where the fluid runs at a place; its length says nothing."""

    at: Point
    to: Point

    @property
    def direction(self) -> Point:
        """Unit vector in the picture, x to the right and y down."""
        dx, dy = self.to[0] - self.at[0], self.to[1] - self.at[1]
        length = max((dx**2 + dy**2) ** 0.5, 1e-9)
        return dx / length, dy / length


@dataclass(frozen=True)
class ClipHints:
    """All that a person says of one clip."""

    clip: ClipIdentity | None = None
    """which clip it was; None: whichever they are used with, in px of its picture"""
    start: float | None = None
    """s into the clip"""
    duration: float | None = None
    """s to use"""
    kind: str | None = None
    fov: float | None = None
    """degrees across the longer side"""
    pitch: float | None = None
    """degrees by which the camera looks below the horizon; 90: straight down, where no horizon can be drawn"""
    horizon: tuple[Point, Point] | None = None
    """two points of it, left and right; outside the picture where it is not in it"""
    ruler: Ruler | None = None
    rims: tuple[Rim, ...] = ()
    regions: tuple[Region, ...] = ()
    """later ones lie over earlier ones"""
    clicks: tuple[Click, ...] = ()
    roi: tuple[float, float, float, float] | None = None
    """x, y, width, height: fluid is looked for inside only"""
    flow: tuple[Arrow, ...] = ()
    level: tuple[Point, Point] | None = None
    """along the edge of still water that lies square to the view, left and right"""

    @property
    def settings(self) -> dict[str, float | str]:
        """Those that are settings of a job, by dotted name."""
        found = {
            "read.start": self.start, "read.duration": self.duration, "shape.kind": self.kind, "shape.fov": self.fov,
            "shape.pitch": self.pitch,
        }  # fmt: skip
        return {name: value for name, value in found.items() if value is not None}

    def at(self, size: tuple[int, int]) -> ClipHints:
        """The same in px of a picture of another size.

        Raises:
            InputRejected: a picture of another shape.
        """
        if self.clip is None or self.clip.size == tuple(size):
            return self
        (w, h), (width, height) = self.clip.size, size
        if abs((w * height) / (h * width) - 1.0) > SHAPE:
            raise InputRejected(
                f"hints drawn on a {w} x {h} picture for a clip of {width} x {height} px",
                "hints and a clip of one shape", "draw them again on this clip (fluidlift studio)",
            )  # fmt: skip
        return replace(self._mapped((width / w, height / h), (0.0, 0.0)), clip=replace(self.clip, size=(width, height)))

    def moved(self, by: Point) -> ClipHints:
        """The same with all points moved by this, px."""
        return self if by == (0.0, 0.0) else self._mapped((1.0, 1.0), by)

    @property
    def has_points(self) -> bool:
        """Whether anything of it lies somewhere in the picture."""
        whole = (self.horizon, self.ruler, self.roi, self.level)
        return any(w is not None for w in whole) or any((self.rims, self.regions, self.clicks, self.flow))

    def _mapped(self, k: Point, by: Point) -> ClipHints:
        mean = (k[0] * k[1]) ** 0.5

        def to(p: Point) -> Point:
            return p[0] * k[0] + by[0], p[1] * k[1] + by[1]

        def line(ends: tuple[Point, Point] | None) -> tuple[Point, Point] | None:
            return None if ends is None else (to(ends[0]), to(ends[1]))

        ruler, roi = self.ruler, self.roi
        return replace(
            self,
            horizon=line(self.horizon),
            ruler=None if ruler is None else replace(ruler, begin=to(ruler.begin), end=to(ruler.end)),
            rims=tuple(replace(r, center=to(r.center), axes=(r.axes[0] * mean, r.axes[1] * mean)) for r in self.rims),
            regions=tuple(
                replace(r, line=tuple(to(p) for p in r.line), width=None if r.width is None else r.width * mean)
                for r in self.regions
            ),
            clicks=tuple(replace(c, at=to(c.at)) for c in self.clicks),
            roi=None if roi is None else (*to((roi[0], roi[1])), roi[2] * k[0], roi[3] * k[1]),
            flow=tuple(Arrow(to(a.at), to(a.to)) for a in self.flow),
            level=line(self.level),
        )  # fmt: skip

    @property
    def view(self) -> DrawnView | None:
        """What of it says how the camera stands and how large things are; None: nothing of it does."""
        sky, ledges = (tuple(r for r in self.regions if r.what == what) for what in ("sky", "ledge"))
        level = self.level is not None or any(r.what == "pool" for r in self.regions)
        if self.horizon is None and self.ruler is None and not (self.rims or sky or ledges or level or self.flow):
            return None
        return DrawnView(self.horizon, self.ruler, self.rims, sky, ledges, level, self.flow, self.level)


@dataclass(frozen=True)
class DrawnView:
    """What a person drew of the camera's tilt, of size and of the surface, in px of the working picture."""

    horizon: tuple[Point, Point] | None = None
    ruler: Ruler | None = None
    rims: tuple[Rim, ...] = ()
    sky: tuple[Region, ...] = ()
    ledges: tuple[Region, ...] = ()
    level: bool = False
    """what does not come down a ledge is level"""
    flow: tuple[Arrow, ...] = ()
    level_line: tuple[Point, Point] | None = None


NOTHING_SAID = ClipHints()
