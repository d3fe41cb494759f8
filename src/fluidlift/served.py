"""Pages that are served to this machine alone: ports, addresses with a secret, and who is let in."""

from __future__ import annotations

import contextlib
import ipaddress
import secrets
import socket
import sys
from urllib.parse import urlsplit

from fluidlift.errors import InputRejected

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


def knows(path: str, secret: str) -> tuple[bool, str]:
    """Whether the first part of a path is the secret, and what comes behind it, with a slash before it."""
    given, _, rest = path.partition("?")[0].removeprefix("/").partition("/")
    return secrets.compare_digest(given.encode(), secret.encode()), f"/{rest}"


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
