"""The web server: on this machine alone unless asked for more, on the next free port, for pages of its own only."""

from __future__ import annotations

import contextlib
import ipaddress
import re
import socket
import sys
from collections.abc import Iterator
from typing import Any

from fluidlift.errors import InputRejected, MissingPackage

FIRST_PORT = 8080
TRIED = 100
"""ports, from the one that was asked for"""

LOCAL_PAGES = re.compile(r"https?://(localhost|127\.0\.0\.1|\[::1\])(:\d+)?")
"""origins of pages on this machine"""


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


def open_server(host: str, port: int, label: str) -> Any:
    """A viser server that answers pages of this machine alone, and lets nobody share it with the world.

    Other web sites open in the same browser could reach a server on 127.0.0.1 as well: a connection that names a page
    of theirs as its origin is refused, unless the host was opened to the network on purpose.
    """
    viser = require_viser()
    with _checked_origins(host), contextlib.redirect_stdout(None):
        server = viser.ViserServer(host=host, port=port, label=label, verbose=False)
    server.request_share_url = lambda *_, **__: None  # would open a tunnel through somebody else's machine
    server.gui.configure_theme(control_width="large", dark_mode=False, show_logo=False, show_share_button=False)
    server.gui.main_panel.dock_right()  # what floats over the scene hides new obstacles
    return server


@contextlib.contextmanager
def _checked_origins(host: str) -> Iterator[None]:
    """While the server is made, web sockets are opened with a check of where a page comes from."""
    import websockets.asyncio.server as sockets

    plain = sockets.serve

    def checked(*args: Any, **options: Any) -> Any:
        if is_local(host):
            options.setdefault("origins", [LOCAL_PAGES, None])
        return plain(*args, **options)

    sockets.serve = checked
    try:
        yield
    finally:
        sockets.serve = plain
