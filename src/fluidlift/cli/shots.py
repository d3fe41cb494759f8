"""`fluidlift make --shots auto`: a clip with cuts becomes an asset for each of its shots, one after the other."""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from fluidlift.cli.options import Make
from fluidlift.config import ReadConfig
from fluidlift.errors import FluidliftError, InputRejected
from fluidlift.messages import visible

if TYPE_CHECKING:
    from fluidlift.farm.shots import Shot

SUFFIX = ".fluid"
SPAN = ("read.start", "read.duration")
"""settings that count more than the options of these names; each shot has its own"""


def make_each(wanted: Make, out: Path, read: ReadConfig, make_one: Callable[[Make], int]) -> int:
    """Make every shot of a clip; the exit code: 0 all done, 4 some with warnings, 1 some failed or were refused.

    A shot that fails does not stop the others. What `farm.cuts` finds no cuts in is made as without the option.

    Args:
        wanted: what was asked for.
        out: asset folder of a clip of one shot; of several, the names are OUT_01.fluid, OUT_02.fluid, ...
        read: which part of the clip, as all options and settings say.
        make_one: makes one asset; gives the exit code.

    Raises:
        InputRejected: there are several shots, and something was given that is of one view alone; nothing was made.
    """
    from fluidlift.farm.cuts import parted
    from fluidlift.farm.shots import Shot

    def tell(text: str) -> None:
        print(text, file=sys.stderr if wanted.json else sys.stdout, flush=True)

    span = {"start": read.start, "duration": read.duration, "fps": read.fps}
    name = out.name.removesuffix(SUFFIX)
    shots = parted([Shot(wanted.clip, name, {k: v for k, v in span.items() if v is not None})], None, tell)
    if len(shots) == 1 and shots[0].name == name:
        return make_one(wanted)
    _require_no_view(wanted, len(shots))
    codes = [_code_of(one, wanted, out.with_name(f"{one.name}{SUFFIX}"), make_one, tell) for one in shots]
    made = sum(code in (0, 4) for code in codes)
    tell(f"{made} of {len(shots)} shots made")
    return 1 if made < len(shots) else max(codes)


def _code_of(shot: Shot, wanted: Make, out: Path, make_one: Callable[[Make], int], tell: Callable[[str], None]) -> int:
    """Exit code of the make of one shot; what is wrong with it is told."""
    begin, span = shot.options.get("start", 0.0), shot.options.get("duration")
    tell(f"{out.name}: from {begin:g} s" + (f" to {begin + span:g} s" if span is not None else " to the end"))
    part = replace(wanted.part, shots=None, start=begin, duration=span)
    rest = tuple(text for text in wanted.settings.set if text.partition("=")[0].strip() not in SPAN)
    try:
        return make_one(replace(wanted, out=out, part=part, settings=replace(wanted.settings, set=rest)))
    except FluidliftError as error:
        print(visible(f"fluidlift: {out.name}: {error}"), file=sys.stderr)
        return 3 if isinstance(error, InputRejected) else 1


def _require_no_view(wanted: Make, shots: int) -> None:
    """Raise `InputRejected` for what is of one view, where there are several: each shot has one of its own."""
    given = {
        "--hints": wanted.input.hints, "--camera": wanted.input.camera, "--depth": wanted.input.depth,
        "--geometry-from": wanted.body.geometry_from,
    }  # fmt: skip
    if named := [option for option, value in given.items() if value is not None]:
        raise InputRejected(
            f"{', '.join(named)} for a clip of {shots} shots", "one view for what is known of one",
            "make them one by one with --start and --duration, or by fluidlift batch from a list of shots that has a "
            "row for each",
        )  # fmt: skip
