"""What a person does on the page, as it was when they did it, and what controls show."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import viser

LOG = logging.getLogger(__name__)


def heard(handle: Any, act: Callable[[Any, Any], None]) -> None:
    """Have `act(event, value)` called with what a person chose.

    The value is taken where the message arrives: by the time a thread is free for `act`, an edit that ended meanwhile
    may have set the control back to what the scene holds.
    """

    async def arrived(event: Any) -> None:
        # not awaited: an edit that waits for another one would keep all other messages waiting
        asyncio.get_running_loop().run_in_executor(None, act, event, handle.value).add_done_callback(_surprised)

    handle.on_update(arrived)


def show(server: viser.ViserServer, handle: Any, value: Any) -> None:
    """Have a control show what the scene holds; soon, and only where it shows something else.

    It is set in the server's event loop, between two messages of the page: set from another thread in the midst of one,
    it would take the place of what a person has just chosen before `heard` has read it.
    """
    if handle.value != value:
        server.get_event_loop().call_soon_threadsafe(setattr, handle, "value", value)


def _surprised(done: asyncio.Future[None]) -> None:
    error = done.exception()
    if error is not None:
        LOG.error("a control of the page", exc_info=error)
