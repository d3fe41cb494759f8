"""Weights of third-party models: read without running their code, and never used before their licence was named."""

from __future__ import annotations

import pickle
import sys
import zipfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from fluidlift.errors import InputRejected, MissingPackage

if TYPE_CHECKING:
    import torch

Announce = Callable[[str], None]
"""shows a line to the user"""

LEARNED = "pip install 'fluidlift[learned]'"
"""what brings the optional packages"""


def say(line: str) -> None:
    """To standard error: standard output belongs to the caller."""
    print(line, file=sys.stderr)


def missing(package: str, purpose: str) -> MissingPackage:
    """The error for a package that is not installed."""
    return MissingPackage(f"{package} is not installed. Needed: {purpose}. Do: {LEARNED}.")


def read_state_dict(path: Path | str, *, purpose: str, max_bytes: int = 4 * 2**30) -> dict[str, torch.Tensor]:
    """Named tensors of a .safetensors file, or of a torch checkpoint that holds nothing but tensors.

    A checkpoint is opened with `weights_only=True` and never in any other way: a file that asks for more (a pickle can
    run anything) is refused. Wrappers of training scripts are taken off: a dictionary `state_dict` or `model`, and the
    prefix `module.`.

    Args:
        path: of the file.
        purpose: which weights these are, for messages.
        max_bytes: largest file that is read.

    Raises:
        InputRejected: no such file, too large, damaged, or more than tensors in it.
        MissingPackage: a .safetensors file without safetensors.
    """
    path = Path(path)
    if not path.is_file():
        raise InputRejected(f"no file '{path}'", f"{purpose}: a .safetensors or .pth file", "check the name")
    if path.stat().st_size > max_bytes:
        raise InputRejected(f"'{path.name}' has {path.stat().st_size} bytes", f"at most {max_bytes} bytes of weights")
    loaded = _safetensors(path) if path.suffix.lower() == ".safetensors" else _checkpoint(path, purpose)
    for wrapper in ("state_dict", "model"):
        if isinstance(loaded, Mapping) and isinstance(loaded.get(wrapper), Mapping):
            loaded = loaded[wrapper]
    import torch

    if not isinstance(loaded, Mapping) or not loaded or not all(isinstance(v, torch.Tensor) for v in loaded.values()):
        raise InputRejected(
            f"'{path.name}' holds no named tensors", f"{purpose}: a state dict", "take the weights alone"
        )
    return {str(name).removeprefix("module."): tensor for name, tensor in loaded.items()}


def _safetensors(path: Path) -> dict[str, torch.Tensor]:
    try:
        from safetensors import SafetensorError
        from safetensors.torch import load_file
    except ImportError:
        raise missing("safetensors", "to read .safetensors weights") from None
    try:
        return load_file(path)
    except (SafetensorError, OSError, ValueError) as error:
        raise InputRejected(
            f"'{path.name}' is damaged ({error})", "a whole .safetensors file", "copy it again"
        ) from None


def _checkpoint(path: Path, purpose: str) -> Any:
    import torch

    try:
        return torch.load(path, map_location="cpu", weights_only=True)
    except pickle.UnpicklingError as error:
        reason = str(error).partition("\n")[0].partition(". ")[0]
        raise InputRejected(
            f"'{path.name}' holds more than tensors, which could run code ({reason})",
            f"{purpose}: a checkpoint of tensors alone",
            "take a .safetensors file, or save the state dict alone",
        ) from None
    except (RuntimeError, ValueError, EOFError, OSError, KeyError, zipfile.BadZipFile) as error:
        reason = str(error).partition("\n")[0]
        raise InputRejected(
            f"'{path.name}' is damaged ({reason})", f"{purpose}: a whole file", "copy it again"
        ) from None


def require_all_tensors(network: torch.nn.Module, path: Path) -> None:
    """See that a .safetensors file has every tensor of a network that a loader of others filled from it.

    Loaders that let some lack leave them as noise.

    Raises:
        InputRejected: a tensor lacks, or the file is damaged.
        MissingPackage: safetensors is missing.
    """
    try:
        from safetensors import SafetensorError, safe_open
    except ImportError:
        raise missing("safetensors", "to read .safetensors weights") from None
    try:
        with safe_open(path, framework="pt") as file:
            there = set(file.keys())
    except (SafetensorError, OSError, ValueError) as error:
        raise InputRejected(
            f"'{path.name}' is damaged ({error})", "a whole .safetensors file", "copy it again"
        ) from None
    state = network.state_dict()
    shared = {state[name].data_ptr() for name in there & state.keys()}  # a tensor with two names is stored once
    lacking = [k for k, v in state.items() if k not in there and v.numel() and v.data_ptr() not in shared]
    if lacking:
        raise InputRejected(f"'{path.name}' lacks {len(lacking)} tensors, such as {lacking[0]}", "whole weights")


def fill_network(network: torch.nn.Module, state: Mapping[str, torch.Tensor], name: str, hint: str = "") -> None:
    """Load every tensor of `state` into its place.

    Raises:
        InputRejected: a tensor too few, too many, or of another shape, with the first of them.
    """
    wanted = network.state_dict()
    lacking = [k for k in wanted if k not in state]
    unknown = [k for k in state if k not in wanted]
    shaped = [k for k in wanted if k in state and state[k].shape != wanted[k].shape]
    if lacking or unknown or shaped:
        first = (
            f"'{shaped[0]}' is {list(state[shaped[0]].shape)} instead of {list(wanted[shaped[0]].shape)}" if shaped
            else f"'{lacking[0]}' lacks" if lacking else f"'{unknown[0]}' is unknown"
        )  # fmt: skip
        raise InputRejected(
            f"'{name}' does not fit the network: {len(lacking)} tensors lack, {len(unknown)} are unknown, "
            f"{len(shaped)} have another shape ({first})",
            "weights of this network" + (f": {hint}" if hint else ""),
        )
    network.load_state_dict(dict(state))
