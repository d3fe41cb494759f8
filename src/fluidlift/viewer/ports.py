"""The web server: on this machine alone unless asked for more, on the next free port, for who knows its address."""

from __future__ import annotations

import contextlib
import dataclasses
import gzip
import re
import secrets
from collections.abc import Callable, Iterator
from http import HTTPStatus
from typing import Any

from fluidlift.errors import MissingPackage
from fluidlift.served import FIRST_PORT, PAGE_HEADERS, free_port, is_local, knows, same_origin

__all__ = ["FIRST_PORT", "PAGE_HEADERS", "free_port", "is_local", "open_server", "require_viser", "same_origin"]


CONTROLS = 320
"""px, width of the controls; on a laptop's screen (1366 px) less than a quarter of it"""


def require_viser() -> Any:
    """The package viser.

    Raises:
        MissingPackage: it is not installed.
    """
    try:
        import viser
    except ImportError:
        raise MissingPackage("The viewer needs viser: pip install 'fluidlift[view]'") from None
    return viser


def open_server(host: str, port: int, label: str) -> tuple[Any, str]:
    """A viser server that answers only who knows its address, and lets nobody share it with the world.

    Other users of this machine, and web sites that are open in the same browser, can reach a server on 127.0.0.1 as
    well. Every request must name a secret, which is drawn here, as the first part of its path; a connection that a page
    of another origin opens is refused, other ports of this machine included; and no page may show this one in a frame.

    Returns:
        The server, and the secret.
    """
    viser, secret = require_viser(), secrets.token_urlsafe(16)
    with _guarded(secret), contextlib.redirect_stdout(None):
        server = viser.ViserServer(host=host, port=port, label=label, verbose=False)
    server.request_share_url = lambda *_, **__: None  # would open a tunnel through somebody else's machine
    server.gui.configure_theme(control_width="large", dark_mode=False, show_logo=False, show_share_button=False)
    server.gui.main_panel.dock_right()  # what floats over the scene hides new obstacles
    server.gui.main_panel.set_width(CONTROLS)
    return server, secret


@contextlib.contextmanager
def _guarded(secret: str) -> Iterator[None]:
    """While the server is made, what it serves is put behind `_guard`."""
    import websockets.asyncio.server as sockets

    plain = sockets.serve

    def guarded(*args: Any, **options: Any) -> Any:
        return plain(*args, **options | {"process_request": _guard(secret, options["process_request"])})

    sockets.serve = guarded
    try:
        yield
    finally:
        sockets.serve = plain


TITLE = "fluidlift"
ICON = (
    "data:image/svg+xml,%3Csvg xmlns='http://www.w3.org/2000/svg' viewBox='0 0 32 32'%3E%3Cpath fill='%231c7ed6' "
    "d='M16 2c6 9 9 13 9 18a9 9 0 0 1-18 0c0-5 3-9 9-18z'/%3E%3C/svg%3E"
)
"""a drop"""


FLAT = "new Float32Array([-2,-2,2,-2,2,2,-2,2]),2"
SOLID = "new Float32Array([-2,-2,0,2,-2,0,2,2,0,-2,2,0]),3"
"""the square that viser 1.1 draws for each splat, and the same with a third coordinate: without one its bounds are no
numbers, which three.js says in the console for each frame of splats"""
RUN = b"e.textContent=code;"
"""where viser's page runs its own program, which it has unpacked"""


def _retitle(response: Any) -> None:
    """The page of viser with our title and icon, and bounds for splats; as it is where it is not version 1.1's."""
    body = response.body
    packed = response.headers.get("Content-Encoding") == "gzip"
    text = gzip.decompress(body) if packed else bytes(body)
    text = re.sub(rb"<title>[^<]*</title>", f"<title>{TITLE}</title>".encode(), text, count=1)
    text = re.sub(rb'(rel="icon"\s+href=")[^"]*', rb"\g<1>" + ICON.encode(), text, count=1)
    text = text.replace(RUN, f'e.textContent=code.replace("{FLAT}","{SOLID}");'.encode(), 1)
    response.body = gzip.compress(text) if packed else text
    del response.headers["Content-Length"]
    response.headers["Content-Length"] = str(len(response.body))


def _guard(secret: str, answer: Callable[[Any, Any], Any]) -> Callable[[Any, Any], Any]:
    """`answer` (which takes a connection and a request) for requests under `/secret` that no foreign page makes."""

    def guarded(connection: Any, request: Any) -> Any:
        known, path = knows(request.path, secret)
        if not known:
            return connection.respond(HTTPStatus.FORBIDDEN, "Open the whole address that fluidlift view printed.\n")
        if not same_origin(request.headers.get("Origin"), request.headers.get("Host", "")):
            return connection.respond(HTTPStatus.FORBIDDEN, "A page of another origin is not let in.\n")
        response = answer(connection, dataclasses.replace(request, path=path))
        if response is not None and response.body and path.partition("?")[0] in ("", "/"):
            _retitle(response)
        if response is not None:
            for name, value in PAGE_HEADERS.items():
                response.headers[name] = value
        return response

    return guarded
