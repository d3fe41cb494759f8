"""Surfaces of the frames: that of the current one at once, the others beside Blender, which goes on meanwhile.

A file appears when it is whole. A frame whose file is not there yet shows the last one that was, and is put in as it
comes. Pictures that are rendered wait for all of them.
"""

from __future__ import annotations

from collections.abc import Callable

import bpy

from .command import EVERY, Call, share_done

Ended = Callable[[str], None]
"""takes what the command printed"""


class Meshing:
    """One command at a time that writes the surfaces."""

    def __init__(self) -> None:
        self.call: Call | None = None
        self._ended: Ended = lambda said: None
        self._look: Callable[[], None] = lambda: None

    def begin(self, words: list[str], look: Callable[[], None], ended: Ended) -> None:
        """Start it, in place of an earlier one.

        Args:
            words: the command.
            look: called now and then while it is at work: there may be new files.
            ended: called once it has done all.
        """
        self.stop()
        self.call, self._look, self._ended = Call(words), look, ended
        bpy.app.timers.register(self.tick, first_interval=EVERY)

    def tick(self) -> float | None:
        """Seconds until the next look; None: there is nothing to look at any more."""
        call = self.call
        if call is None:
            return None
        if call.running():
            share = share_done(call.last_line())
            if share is not None:
                bpy.context.scene.fluidlift.told = f"surfaces: {round(100 * share)} %"
            self._look()
            return EVERY
        self._finish(call)
        return None

    def wait(self) -> None:
        """Until all are there."""
        if self.call is not None:
            self.call.wait()
            self._finish(self.call)

    def stop(self) -> None:
        """End it; surfaces that are finished stay."""
        if self.call is not None:
            self.call.stop()
            self.call.wait()
            self.call = None

    def _finish(self, call: Call) -> None:
        self.call = None
        try:
            call.check()
        except RuntimeError as error:
            bpy.context.scene.fluidlift.told = str(error)
            return
        bpy.context.scene.fluidlift.told = "surfaces: done"
        self._look()
        self._ended(call.said())
