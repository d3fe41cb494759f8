"""The web server: on this machine alone unless asked for more, on the next free port, for who knows its address."""

from __future__ import annotations

import contextlib
import dataclasses
import ipaddress
import secrets
import socket
import sys
from collections.abc import Callable, Iterator
from http import HTTPStatus
from typing import Any
from urllib.parse import urlsplit

from fluidlift.errors import InputRejected, MissingPackage

FIRST_PORT = 8080
TRIED = 100
"""ports, from the one that was asked for"""

PAGE_HEADERS = {
    "Content-Security-Policy": "frame-ancestors 'none'",
    "X-Frame-Options": "DENY",
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
    "Cross-Origin-Resource-Policy": "same-origin",
}
"""of all that is served: in no frame, and the address, which is a secret, is told to nobody"""


def is_local(host: str) -> bool:
    """Whether only this machine can reach a host's address."""
    if host == "localhost":
        return True
    with contextlib.suppress(ValueError):
        return ipaddress.ip_address(host).is_loopback
    return False


def free_port(host: str, first: int = FIRST_PORT) -> int:
    """The first port from `first` on that nobody listens on.

    Raises:
        InputRejected: a port that does not exist, a host that is not this machine's, or none of `TRIED` ports is free.
    """
    if not 1 <= first <= 65535:
        raise InputRejected(f"port {first}", "1 to 65535, such as 8080")
    try:
        family, _, _, _, address = socket.getaddrinfo(host, None, type=socket.SOCK_STREAM)[0]
    except (OSError, UnicodeError):
        raise InputRejected(f"no host '{host}'", "an address of this machine, such as 127.0.0.1") from None
    for port in range(first, min(first + TRIED, 65536)):
        with socket.socket(family, socket.SOCK_STREAM) as probe:
            if sys.platform != "win32":  # as servers do: a port whose last connection has just ended is free
                probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            try:
                probe.bind((address[0], port))
                return port
            except OSError as error:
                last = error
    raise InputRejected(
        f"no free port from {first} to {port} on {host} ({last.strerror})", "a free one", "give another --port"
    )


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


def _guard(secret: str, answer: Callable[[Any, Any], Any]) -> Callable[[Any, Any], Any]:
    """`answer` (which takes a connection and a request) for requests under `/secret` that no foreign page makes."""

    def guarded(connection: Any, request: Any) -> Any:
        given, _, rest = request.path.partition("?")[0].removeprefix("/").partition("/")
        if not secrets.compare_digest(given.encode(), secret.encode()):
            return connection.respond(HTTPStatus.FORBIDDEN, "Open the whole address that fluidlift view printed.\n")
        if not same_origin(request.headers.get("Origin"), request.headers.get("Host", "")):
            return connection.respond(HTTPStatus.FORBIDDEN, "A page of another origin is not let in.\n")
        response = answer(connection, dataclasses.replace(request, path=f"/{rest}"))
        if response is not None:
            for name, value in PAGE_HEADERS.items():
                response.headers[name] = value
        return response

    return guarded


def same_origin(origin: str | None, host: str) -> bool:
    """Whether a request comes from a page of the address that it goes to, however a tunnel may have renamed both.

    Args:
        origin: of the page, as browsers tell it; None: no browser, or no page.
        host: that was asked for, with its port.
    """
    if origin is None:
        return True
    try:
        parts = urlsplit(origin)
    except ValueError:
        return False
    return parts.scheme in ("http", "https") and parts.netloc.lower() == host.lower() != ""
