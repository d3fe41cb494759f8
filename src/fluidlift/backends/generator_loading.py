"""Third-party generators in this process: their packages late, their weights without running code, their memory."""

from __future__ import annotations

import os
import pickle
import sys
from abc import abstractmethod
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from jaxtyping import Bool, UInt8

from fluidlift.backends.generator_card import GeneratorCard
from fluidlift.backends.generator_view import require_picture
from fluidlift.backends.model_weights import Announce, say
from fluidlift.errors import FluidliftError, InputRejected, MissingPackage
from fluidlift.seams import Generator
from fluidlift.types import Gaussians, PinholeCamera

_FEWEST = 100
"""Gaussians: fewer are no body"""
_FAINT = 0.02
"""opacity: what is fainter is not seen"""


@dataclass(frozen=True)
class RunChoice:
    """How a generator runs, and what the user has agreed to."""

    weights: Path | str | None = None
    """file or folder; None: what the generator takes from the hub"""
    device: str = "cuda"
    """cuda, cuda:1 or cpu"""
    seed: int = 42
    """of its random numbers"""
    allow_download: bool = False
    """whether weights may be fetched from the hub"""
    isolated: bool = False
    """this process was started for the generator alone: what loads by running code from the hub may then be loaded"""
    field_of_view: float | None = None
    """degrees across the longer side of the original picture, where it is known"""
    announce: Announce = say
    """is told the licence before the weights are touched"""


class InProcessGenerator(Generator):
    """What the adapters share: checks before, the licence, the model loaded once, checks after.

    Args:
        choice: how to run.
    """

    card: ClassVar[GeneratorCard]
    knows_up: ClassVar[bool]
    """whether the z axis of its bodies is the vertical; else it is the picture's up, and the camera counts as level"""
    foreign_code: ClassVar[str] = ""
    """what of it cannot be loaded without running code that comes from the hub; empty: nothing"""

    def __init__(self, choice: RunChoice | None = None) -> None:
        self.choice = choice or RunChoice()
        self._model: Any = None

    def generate(
        self, image: UInt8[np.ndarray, "h w 3"], mask: Bool[np.ndarray, "h w"], frame: int
    ) -> tuple[Gaussians, PinholeCamera]:
        """A body, z up, in the generator's units, and the camera of the original picture that sees it as pictured.

        Raises:
            InputRejected: no fluid in the frame, or weights that cannot be loaded safely.
            MissingPackage: the generator is not installed here.
            FluidliftError: memory ran out, or an empty body came back.
        """
        require_picture(image, mask)
        with running(self.card):
            if self._model is None:
                if self.foreign_code and not self.choice.isolated:
                    raise InputRejected(
                        f"{self.card.title} loads {self.foreign_code}", "a process of its own for it",
                        "give it its own environment and name that with --generator-python",
                    )  # fmt: skip
                self.choice.announce(f"{self.card.title}: {self.card.licence}")
                with without_download(self.choice.allow_download), only_weights(self.card, self.choice.isolated):
                    self._model = self.load()
            gaussians, camera = self.run(self._model, image, mask)
        return require_body(gaussians, self.card, frame), camera

    @abstractmethod
    def load(self) -> Any:
        """The model with its weights."""

    @abstractmethod
    def run(self, model: Any, image: np.ndarray, mask: np.ndarray) -> tuple[Gaussians, PinholeCamera]:
        """The body that the model makes, and the camera of the original picture."""


def require_body(gaussians: Gaussians, card: GeneratorCard, frame: int) -> Gaussians:
    """The Gaussians that are finite and can be seen.

    Raises:
        FluidliftError: too few are left to be a body.
    """
    g = gaussians
    ok = np.isfinite(g.means).all(1) & np.isfinite(g.quats).all(1) & np.isfinite(g.scales).all(1)
    ok &= np.isfinite(g.opacities) & np.isfinite(g.sh).all((1, 2)) & (g.scales > 0).all(1)
    ok &= np.abs(g.quats).max(1, initial=0.0) > 1e-6
    seen = int((ok & (g.opacities > _FAINT)).sum())
    if seen < _FEWEST:
        raise FluidliftError(
            f"{card.title} made an empty body of frame {frame} ({seen} of {len(g)} Gaussians can be seen). "
            f"Needed: at least {_FEWEST}. Do: choose a frame in which the fluid is larger and stands out from its "
            "background, check the mask, try another seed, or use the built-in generator."
        )
    return g if ok.all() else g.select(ok)


@contextmanager
def running(card: GeneratorCard) -> Iterator[None]:
    """Turn what goes wrong inside a generator into what the user can do about it.

    Raises:
        MissingPackage: one of its packages is not there.
        FluidliftError: memory ran out. Other errors pass unchanged.
    """
    try:
        yield
    except ModuleNotFoundError as error:
        known = {name.partition(".")[0] for name in card.packages}
        missing = (error.name or "").partition(".")[0]
        if missing not in known:
            raise
        install = "; ".join(card.install) or f"see {card.home}"
        raise MissingPackage(
            f"{card.title} is not installed here (no module '{error.name}'). Needed: {', '.join(card.packages)}. "
            f"Do: {install}; where that is another environment, name its Python with --generator-python."
        ) from None
    except (MemoryError, RuntimeError) as error:
        text = str(error).lower()
        memory = ("out of memory", "can't allocate memory", "cannot allocate memory", "alloc_failed")
        if not isinstance(error, MemoryError) and not any(words in text for words in memory):
            raise
        raise FluidliftError(
            f"{card.title} ran out of memory. Needed: {card.hardware}. Do: close other programs on the device, take "
            "another device or a machine with more memory, or use the built-in generator."
        ) from None


@contextmanager
def only_weights(card: GeneratorCard, isolated: bool = False) -> Iterator[None]:
    """Within, every `torch.load` of third-party code reads tensors and nothing else.

    Raises:
        InputRejected: a checkpoint that holds more, which could run code.
    """
    if isolated:
        yield
        return
    import torch

    original = torch.load
    forced = os.environ.get("TORCH_FORCE_WEIGHTS_ONLY_LOAD")

    def load(*args: Any, **options: Any) -> Any:
        return original(*args, **{**options, "weights_only": True})

    torch.load = load
    os.environ["TORCH_FORCE_WEIGHTS_ONLY_LOAD"] = "1"  # for those who imported `load` by name
    try:
        yield
    except pickle.UnpicklingError as error:
        reason = str(error).partition("\n")[0].partition(". ")[0]
        raise InputRejected(
            f"the weights of {card.title} hold more than tensors, which could run code ({reason})",
            "a checkpoint of tensors alone",
            "take a .safetensors file, or run it in its own environment with --generator-python",
        ) from None
    finally:
        torch.load = original
        os.environ.pop("TORCH_FORCE_WEIGHTS_ONLY_LOAD", None)
        if forced is not None:
            os.environ["TORCH_FORCE_WEIGHTS_ONLY_LOAD"] = forced


@contextmanager
def without_download(allowed: bool) -> Iterator[None]:
    """Within, the hub's client serves what is on this machine already, unless downloads are allowed."""
    names = ("HF_HUB_OFFLINE", "TRANSFORMERS_OFFLINE")
    before = {name: os.environ.get(name) for name in names}
    hub = sys.modules.get("huggingface_hub.constants")  # which reads the environment once, when it is imported
    offline = getattr(hub, "HF_HUB_OFFLINE", False)
    if not allowed:
        os.environ.update(dict.fromkeys(names, "1"))
        if hub is not None:
            hub.HF_HUB_OFFLINE = True  # pyright: ignore[reportAttributeAccessIssue]
    try:
        yield
    finally:
        if hub is not None:
            hub.HF_HUB_OFFLINE = offline  # pyright: ignore[reportAttributeAccessIssue]
        for name, value in before.items():
            os.environ.pop(name, None)
            if value is not None:
                os.environ[name] = value


def hub_file(repository: str, name: str, choice: RunChoice) -> Path:
    """A file of the user's weights folder, or else of the hub (from its cache, or fetched where that is allowed).

    Raises:
        InputRejected: it is nowhere, and may not be fetched.
    """
    if choice.weights is not None:
        path = Path(choice.weights)
        found = path if path.is_file() else path / name
        if not found.is_file():
            raise InputRejected(f"no file '{found}'", f"{name} of {repository}", "name the folder that holds it")
        return found
    from huggingface_hub import hf_hub_download

    try:
        return Path(hf_hub_download(repository, name, local_files_only=not choice.allow_download))
    except (OSError, ValueError) as error:
        raise InputRejected(
            f"no weights: {name} of {repository} is not on this machine ({str(error).partition(chr(10))[0][:200]})",
            "the file, or leave to fetch it", "name the weights, or allow the download",
        ) from None  # fmt: skip


def array(tensor: Any) -> np.ndarray:
    """float32 of a torch tensor on any device, or of an array."""
    if hasattr(tensor, "detach"):
        tensor = tensor.detach().float().cpu().numpy()
    return np.asarray(tensor, np.float32)
