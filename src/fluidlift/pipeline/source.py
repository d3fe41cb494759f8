"""A hash of the source that a module's results depend on, so that a change of the code invalidates what it changed.

The module's own text and that of all it imports inside the package, at the top and inside functions, one after the
other. The text is searched, neither run nor parsed: all files of the package together take some 40 ms, once per
process. A package that imports its own modules by name (`import_module(f"{__name__}...")`) uses all of them; other
modules that are chosen by name are not seen, and who does so has their hashes in its settings.
"""

from __future__ import annotations

import hashlib
import os
import re
import sys
from pathlib import Path

_BY_NAME = re.compile(rb"import_module\(f[\"']\{__name__\}\.")
"""a package that imports its own modules by name"""


class Sources:
    """The modules of a package, by their text.

    Args:
        root: folder of the package, whose name is the package's.
    """

    def __init__(self, root: Path) -> None:
        self.root, self.package = root, root.name
        name = self.package.encode()
        self._import = re.compile(
            rb"(?:from|import)[ \t]+(%b(?:\.\w+)*)(?:[ \t]+import[ \t]+(\([^)]*\)|[^\n#]*))?" % name
        )
        self._files = _modules(root)
        self._read: dict[str, tuple[str, frozenset[str]]] = {}
        self._hashes: dict[str, str] = {}

    def hash(self, module: str) -> str:
        """SHA-256 of a module's text, and of all that it imports inside the package, directly or not.

        The root's own `__init__`, which knows the version alone, never counts; that of an inner package counts where
        names are taken from it that are no modules. Of a module outside, the same; of one without a file, nothing.
        """
        if module not in self._hashes:
            text = "\0".join(f"{name}\0{self._text(name)[0]}" for name in sorted(self.closure(module)))
            self._hashes[module] = hashlib.sha256(text.encode()).hexdigest()
        return self._hashes[module]

    def closure(self, module: str) -> set[str]:
        """The module, and all of the package that it imports, directly or not."""
        found, todo = {module}, [module]
        while todo:
            for name in self.imports(todo.pop()) - found:
                found.add(name)
                todo.append(name)
        return found

    def imports(self, module: str) -> frozenset[str]:
        """Modules of the package that a module imports itself."""
        return self._text(module)[1]

    def _text(self, module: str) -> tuple[str, frozenset[str]]:
        """SHA-256 of a module's text, and the modules of the package that it imports."""
        if module not in self._read:
            path = self._file(module)
            data = b"" if path is None else path.read_bytes()
            found = self._imported(data)
            if _BY_NAME.search(data):
                found |= {name for name in self._files if name.startswith(f"{module}.")}
            self._read[module] = hashlib.sha256(data).hexdigest(), frozenset(found)
        return self._read[module]

    def _imported(self, text: bytes) -> set[str]:
        found: set[str] = set()
        for base, names in self._import.findall(text):
            for word in re.findall(rb"(\w+)(?:[ \t]+as[ \t]+\w+)?", re.sub(rb"#[^\n]*", b"", names)) or [b""]:
                inner = f"{base.decode()}.{word.decode()}"
                found.add(base.decode() if self._file(inner) is None else inner)
        return {name for name in found if name != self.package and self._file(name) is not None}

    def _file(self, module: str) -> Path | None:
        if module.partition(".")[0] == self.package:
            return self._files.get(module)
        known = getattr(sys.modules.get(module), "__file__", None)
        return None if known is None else Path(known)


def _modules(root: Path) -> dict[str, Path]:
    """Files of a package by the names of their modules."""
    found = {}
    for folder, _, names in os.walk(root):
        inside = ".".join((root.name, *Path(folder).relative_to(root).parts))
        for name in names:
            if name.endswith(".py"):
                stem = name.removesuffix(".py")
                found[inside if stem == "__init__" else f"{inside}.{stem}"] = Path(folder, name)
    return found


ROOT = Path(__file__).resolve().parents[1]
"""folder of this package"""
_OURS = Sources(ROOT)


def source_hash(module: str) -> str:
    """`Sources.hash` of this package, as its files were when first asked for."""
    return _OURS.hash(module)
