"""What a person chooses is heard, whatever the page's tick shows meanwhile."""

from __future__ import annotations

import asyncio
import threading
import time
from types import SimpleNamespace

import pytest

from fluidlift.viewer.callbacks import heard, show


class Control:
    """A dropdown of the page, as viser has it: its value is set, and its callback called, within one message."""

    def __init__(self, value):
        self.value = value

    def on_update(self, act):
        self._act = act

    async def message(self, value, meanwhile):
        self.value = value
        thread = threading.Thread(target=meanwhile)
        thread.start()
        thread.join()  # the tick of another thread comes between the two
        await self._act(SimpleNamespace(client="a browser", target=self))


@pytest.fixture
def server():
    loop = asyncio.new_event_loop()
    thread = threading.Thread(target=loop.run_forever)
    thread.start()
    yield SimpleNamespace(get_event_loop=lambda: loop)
    loop.call_soon_threadsafe(loop.stop)
    thread.join()
    loop.close()


def test_a_choice_is_heard_though_the_control_is_set_back_meanwhile(server):
    control, done = Control("saved"), threading.Event()
    chosen = []

    def act(event, value):
        chosen.append((event.client, value))
        done.set()

    heard(control, act)
    message = control.message("live", lambda: show(server, control, "saved"))
    asyncio.run_coroutine_threadsafe(message, server.get_event_loop()).result(10.0)
    assert done.wait(10.0)
    assert chosen == [("a browser", "live")]
    until = time.monotonic() + 10.0
    while control.value != "saved" and time.monotonic() < until:
        time.sleep(0.01)
    assert control.value == "saved"  # shown afterwards: the scene holds it still
