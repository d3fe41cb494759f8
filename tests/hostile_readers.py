"""Readers that do what a decoder may do with a file that was made to harm; the child of `io.confined` runs them."""

from __future__ import annotations

import os
import signal
import time
from pathlib import Path

import numpy as np

from fluidlift.errors import InputRejected
from fluidlift.io.limits import ReadLimits
from fluidlift.types import TriangleMesh


def hungry(path: Path, limits: ReadLimits) -> np.ndarray:
    """Takes memory until there is no more."""
    held = []
    while True:
        held.append(np.ones(2**22))


def sparse(path: Path, limits: ReadLimits) -> np.ndarray:
    """Asks for more memory than there is, and touches none of it."""
    return np.empty(2**40, np.uint8)


def endless(path: Path, limits: ReadLimits) -> np.ndarray:
    """Computes without an end, deaf to interrupts."""
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    while True:
        pass


def asleep(path: Path, limits: ReadLimits) -> np.ndarray:
    """Waits for what does not come."""
    time.sleep(1000)
    return np.zeros(1)


def aborting(path: Path, limits: ReadLimits) -> np.ndarray:
    """As a library that finds its heap damaged."""
    os.abort()


def leaving(path: Path, limits: ReadLimits) -> np.ndarray:
    """Ends the process in good order."""
    os._exit(0)


def refusing(path: Path, limits: ReadLimits) -> np.ndarray:
    """Says no, as readers do."""
    raise InputRejected(f"'{path.name}' is blue", "red", "paint it")


def failing(path: Path, limits: ReadLimits) -> np.ndarray:
    """Has a fault of its own."""
    raise ZeroDivisionError("by nothing")


def talking(path: Path, limits: ReadLimits) -> np.ndarray:
    """Prints to where the answer goes."""
    os.write(1, b"\xff" * 100)
    print("a note")
    return np.arange(3)


def objects(path: Path, limits: ReadLimits) -> np.ndarray:
    """Arrays of pointers."""
    return np.array([[1], None], dtype=object)


def limited(path: Path, limits: ReadLimits) -> np.ndarray:
    """The limits that were handed on."""
    return np.array([limits.max_pixels, limits.max_frames])


def named(path: Path, limits: ReadLimits) -> dict[str, np.ndarray]:
    """Arrays of several types, one of them empty and one in another order."""
    return {"a b": np.arange(6.0).reshape(2, 3).T, "é": np.zeros((0, 3), np.float32), "n": np.array([True, False])}


def mesh(path: Path, limits: ReadLimits) -> TriangleMesh:
    """A triangle with a texture."""
    corners = np.eye(3)
    uv, texture = np.zeros((1, 3, 2), np.float32), np.full((4, 5, 3), 7, np.uint8)
    return TriangleMesh(corners, np.array([[0, 1, 2]]), None, uv, texture)


def whoami(path: Path, limits: ReadLimits) -> np.ndarray:
    """The number of the process that reads."""
    return np.array([os.getpid()])


def busy(path: Path, limits: ReadLimits) -> np.ndarray:
    """Computes for a tenth of a second."""
    until = time.process_time() + 0.1
    while time.process_time() < until:
        pass
    return np.zeros(1)
