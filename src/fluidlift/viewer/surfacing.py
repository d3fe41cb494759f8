"""Meshes of the fluid's surface, made beside the thread that draws: the newest wish first."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable
from typing import Any

import numpy as np

from fluidlift.errors import FluidliftError
from fluidlift.types import TriangleMesh

LOG = logging.getLogger(__name__)
Maker = Callable[[np.ndarray, float], TriangleMesh]
"""(positions [n,3] m, radius m) -> the surface"""


def splashsurf() -> Maker:
    """The surface of particles by pysplashsurf; raises `MissingPackage` where it is not installed."""
    from fluidlift.backends.splashsurf import SplashsurfMesher

    mesher = SplashsurfMesher()
    return lambda positions, radius: mesher.surface(positions, radius, {})[0]


class Surfacer:
    """A thread that meshes the frame that was wanted last; it begins with the first wish.

    Args:
        told: is called, from that thread, when a mesh or an error is there.
        maker: gives what makes a mesh; it may raise `FluidliftError`.
    """

    def __init__(self, told: Callable[[], None], maker: Callable[[], Maker] = splashsurf) -> None:
        self._told, self._maker = told, maker
        self._news = threading.Condition()
        self._wish: tuple[Any, np.ndarray, float] | None = None
        self._asked: Any = None
        self._made: tuple[Any, TriangleMesh | None, str] | None = None
        self._thread: threading.Thread | None = None

    def ask(self, frame: Any, positions: np.ndarray, radius: float) -> None:
        """Want the surface of a frame; asking again for the same one changes nothing."""
        with self._news:
            if frame is self._asked:
                return
            self._asked, self._wish = frame, (frame, positions, radius)
            if self._thread is None:
                self._thread = threading.Thread(target=self._work, name="surface", daemon=True)
                self._thread.start()
            self._news.notify_all()

    def forget(self) -> None:
        """Want nothing."""
        with self._news:
            self._asked = self._wish = self._made = None

    @property
    def made(self) -> tuple[Any, TriangleMesh | None, str] | None:
        """The last frame whose surface was made, the mesh, and what went wrong, in words; None: nothing yet."""
        return self._made

    def _work(self) -> None:
        maker: Maker | None = None
        while True:
            with self._news:
                self._news.wait_for(lambda: self._wish is not None)
                assert self._wish is not None
                frame, positions, radius = self._wish
                self._wish = None
            mesh, problem = None, ""
            try:
                maker = maker or self._maker()
                mesh = maker(positions, radius)
                problem = "" if len(mesh.faces) else "This frame has no surface."
            except (FluidliftError, ValueError, RuntimeError) as error:
                problem = str(error)
            except Exception as error:
                LOG.exception("surface of a frame")
                problem = f"The surface could not be made: unexpected {type(error).__name__}: {error}"
            with self._news:
                if self._asked is not None:
                    self._made = (frame, mesh, problem)
            self._told()
