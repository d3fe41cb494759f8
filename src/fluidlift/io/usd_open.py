"""USD files of strangers: a stage is opened only after its layers, each alone, were asked what they would open.

Composition opens every sublayer, reference and payload, wherever they are, and its complaints quote what it found
there. A layer by itself opens nothing.
"""

from __future__ import annotations

import re
from pathlib import Path

from pxr import Sdf, Tf, Usd, UsdUtils

from fluidlift.errors import InputRejected
from fluidlift.io.asset_paths import asset_file
from fluidlift.io.limits import require_file, require_size

MAX_BYTES = 16 * 2**30
"""of a layer: splats of a long sequence in one file"""
MAX_TEXT_BYTES = 256 * 2**20
"""of a layer of text, which takes ten times as much memory"""
MAX_LAYERS = 1000

_TROUBLE = (Tf.ErrorException, UnicodeDecodeError, RuntimeError)
"""what OpenUSD raises; its complaints need not be text"""
_PLAIN = re.compile(r"[^\[\]`@:]{1,1000}")
"""a name without a scheme, a package's inside, an expression or arguments"""


def open_stage(path: Path | str) -> Usd.Stage:
    """The stage of a USD file that names only files of its own folder.

    Raises:
        InputRejected: no such file, no USD, damaged, or a file that leads outside (sublayers, references, payloads,
            value clips, textures and volumes alike).
    """
    path = require_file(path, "USD file")
    foreign = foreign_files(path)
    if foreign:
        raise InputRejected(
            f"'{path.name}' names files outside the folder that it is in ({', '.join(foreign[:3])[:200]})",
            "files in the folder of the USD file, by relative names", "do not trust this file",
        )  # fmt: skip
    try:
        stage = Usd.Stage.Open(str(path))
    except _TROUBLE as error:
        raise _unreadable(path, error) from None
    return stage


def foreign_files(path: Path) -> list[str]:
    """Names in a USD file, and in the layers that it would open, that are not below its folder; in their order.

    Raises:
        InputRejected: a layer that cannot be read, or too many of them.
    """
    folder, faults = path.parent, []
    waiting, seen = [path], {path}
    while waiting:
        layer = waiting.pop()
        composed, others = _names_in(layer)
        for name in [*composed, *others]:
            inside = _below(folder, layer, name)
            if inside is None:
                faults.append(name)
            elif name in composed and inside.is_file() and inside not in seen:
                seen.add(inside)
                waiting.append(inside)
        if len(seen) > MAX_LAYERS:
            raise InputRejected(f"'{path.name}' opens more than {MAX_LAYERS} layers", "fewer")
    return list(dict.fromkeys(faults))


def _names_in(layer: Path) -> tuple[list[str], list[str]]:
    """What one layer names: layers that are composed, and other files."""
    with layer.open("rb") as file:
        text = not file.read(8).startswith((b"PXR-USDC", b"PK"))
    require_size(layer, MAX_TEXT_BYTES if text else MAX_BYTES, "USD layer")
    heard = UsdUtils.CoalescingDiagnosticDelegate()  # without warnings on stderr
    try:
        composed = Sdf.Layer.OpenAsAnonymous(str(layer)).GetCompositionAssetDependencies()
        named = UsdUtils.ExtractExternalReferences(str(layer))
    except _TROUBLE as error:
        raise _unreadable(layer, error) from None
    finally:
        heard.TakeUncoalescedDiagnostics()
    return list(composed), [name for names in named for name in names if name not in composed]


def _below(folder: Path, layer: Path, name: str) -> Path | None:
    """The file that a layer names, if it is below a folder and no link leads to it; `#` stand for a clip's number."""
    if not name:
        return folder
    if not _PLAIN.fullmatch(name):
        return None
    try:
        beside = layer.parent.relative_to(folder)
        inside = asset_file(folder, (beside / name).as_posix())
    except (InputRejected, ValueError):
        return None
    if not name.startswith("./") and not inside.exists() and Path(name).exists():
        return None  # a bare name that is not beside its layer is looked for in the current folder
    return inside


def _unreadable(path: Path, error: BaseException) -> InputRejected:
    try:
        why = " ".join(str(error).split())[:300] if isinstance(error, Tf.ErrorException) else ""
    except UnicodeDecodeError:  # the complaint quotes the file
        why = ""
    why = why or "its text is damaged"
    return InputRejected(f"'{path.name}' cannot be read ({why})", "an OpenUSD file", "export it again")
