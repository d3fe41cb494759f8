"""What a person does on the page, as it was when they did it."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable
from typing import Any

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


def _surprised(done: asyncio.Future[None]) -> None:
    error = done.exception()
    if error is not None:
        LOG.error("a control of the page", exc_info=error)
