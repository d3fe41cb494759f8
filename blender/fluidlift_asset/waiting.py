"""What a person sees while Blender waits for a command: a share beside the pointer, and a line in the status bar."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator

import bpy

from .command import Told, share_done


@contextlib.contextmanager
def waiting(context: bpy.types.Context, doing: str) -> Iterator[Told]:
    """Gives what takes a command's last line; both are taken away at the end."""
    manager, workspace = context.window_manager, getattr(context, "workspace", None)

    def say(text: str | None) -> None:
        if workspace is not None:
            workspace.status_text_set(text)

    def told(line: str) -> None:
        share = share_done(line)
        if share is not None:
            manager.progress_update(100.0 * share)
        say(f"fluidlift: {doing}. {line}")
        if not bpy.app.background and context.window is not None:
            # nothing is drawn before an operator ends, unless it asks for it
            bpy.ops.wm.redraw_timer(type="DRAW_WIN_SWAP", iterations=1)

    manager.progress_begin(0, 100)
    try:
        told("")
        yield told
    finally:
        manager.progress_end()
        say(None)
