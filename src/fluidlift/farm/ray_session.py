"""A connection to Ray with its doors shut: no dashboard, no statistics sent, nothing beyond this machine's loopback."""

from __future__ import annotations

import os
import signal
import socket
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from fluidlift.errors import InputRejected, MissingPackage
from fluidlift.machine import cores

STORE = 100_000_000
"""bytes of shared memory of Ray on this machine: what travels are some kilobytes per shot, and Ray takes 30 % else"""
_DOOR = 10.0
"""s that the head of a cluster has to answer"""
_OURS = {"RAY_USAGE_STATS_ENABLED": "0"}
"""of every session"""
_LOOPBACK = {"RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER": "0"}
"""of one of this machine alone: Ray's only way to listen on 127.0.0.1, which it does on these systems by default"""


@contextmanager
def session(address: str | None) -> Iterator[Any]:
    """Ray, connected while the block runs; one that is connected already is used and left as it is.

    Args:
        address: of the head of a cluster, HOST:PORT, or "auto"; None: processes of this machine alone.

    Raises:
        MissingPackage: it is not installed.
        InputRejected: no cluster at the address, or another version of Ray or Python there.
    """
    if address is not None:
        _require_door(address)
    for name, value in (_OURS if address else _OURS | _LOOPBACK).items():
        os.environ.setdefault(name, value)
    try:
        import ray
    except ImportError:
        raise MissingPackage("--engine ray needs Ray: pip install 'fluidlift[ray]'") from None
    if ray.is_initialized():
        yield ray
        return
    _connect(ray, address)
    try:
        if address is None and not ray.util.get_node_ip_address().startswith("127."):
            name, value = next(iter(_LOOPBACK.items()))
            raise InputRejected("Ray was imported before it could be told to keep to this machine",
                                f"{name}={value} in the environment before that")  # fmt: skip
        yield ray
    finally:
        ray.shutdown()


def _require_door(address: str) -> None:
    """Raise `InputRejected` where nothing listens at HOST:PORT: Ray itself would try for minutes."""
    host, _, port = address.rpartition(":")
    if not host or not port.isdecimal():  # "auto", or a name of Ray's own
        return
    try:
        socket.create_connection((host.strip("[]"), int(port)), timeout=_DOOR).close()
    except (OSError, OverflowError) as error:
        raise InputRejected(f"nothing answers at {address} ({error})", "the head of a Ray cluster",
                            "ray start --head there, and --address HOST:6379 here") from None  # fmt: skip


def _connect(ray: Any, address: str | None) -> None:
    main = threading.current_thread() is threading.main_thread()
    handlers = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)} if main else {}
    own = {"address": "local", "num_cpus": cores(), "object_store_memory": STORE, "include_dashboard": False}
    try:
        ray.init(**({"address": address} if address else own), log_to_driver=False, logging_level="error")
    except (ConnectionError, ValueError, RuntimeError, AssertionError, ray.exceptions.RayError) as error:
        told = " ".join(str(error).split())[:300] or type(error).__name__
        raise InputRejected(
            f"Ray at {address or 'this machine'}: {told}", "a cluster with the same versions of Python and Ray",
            "see ray status there, and --address HOST:6379",
        ) from None  # fmt: skip
    finally:
        for number, handler in handlers.items():
            signal.signal(number, handler)
