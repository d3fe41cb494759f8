"""The face of a package: the names and modules of its `__all__`, which alone other packages import.

A module of a face has a line in the docstring of the package: its own first sentence. `python tests/test_faces.py`
writes these lists anew, after a module came or went or says something else about itself.
"""

from __future__ import annotations

import ast
import functools
import importlib
import re
import sys
import textwrap
from pathlib import Path

import pytest

SOURCE = Path(__file__).resolve().parents[1] / "src/fluidlift"
PACKAGES = sorted(path.parent.name for path in SOURCE.glob("*/__init__.py"))
HEAD = "Modules of the face:"


def tree_of(file: Path) -> ast.Module:
    """A module, read and not run."""
    return ast.parse(file.read_text(encoding="utf-8"))


def face_of(package: str) -> list[str]:
    """`__all__` of a package, read and not run."""
    for node in tree_of(SOURCE / package / "__init__.py").body:
        if isinstance(node, ast.Assign) and [t.id for t in node.targets if isinstance(t, ast.Name)] == ["__all__"]:
            return ast.literal_eval(node.value)
    return []


def is_module(package: str, name: str) -> bool:
    """Whether a name of a face is a module or a package of modules, and not a function that is called like its own."""
    given = (a.asname or a.name for n in tree_of(SOURCE / package / "__init__.py").body
             if isinstance(n, ast.ImportFrom) for a in n.names)  # fmt: skip
    if name in given:
        return False
    return (SOURCE / package / f"{name}.py").is_file() or (SOURCE / package / name / "__init__.py").is_file()


def first_sentence(package: str, module: str) -> str:
    """What a module says of itself."""
    file = SOURCE / package / f"{module}.py"
    text = ast.get_docstring(tree_of(file if file.is_file() else SOURCE / package / module / "__init__.py")) or ""
    return re.split(r"(?<!et al)\.\s", " ".join(text.split("\n\n")[0].split()))[0].rstrip(".")


def listed(package: str) -> str:
    """What the docstring of a package says of the modules of its face."""
    modules = [name for name in face_of(package) if is_module(package, name)]
    width = max(map(len, modules), default=0) + 2
    rows = (
        textwrap.fill(
            first_sentence(package, name),
            116,
            initial_indent=f"    {name:{width}}",
            subsequent_indent=" " * (width + 4),
        )
        for name in modules
    )
    return "\n".join([HEAD, "", *rows])


@functools.cache
def imports() -> list[tuple[str, str, str, str]]:
    """Each import over a package's border: file, package, module below it ("" for none), name."""
    found = []
    for file in sorted(SOURCE.rglob("*.py")):
        place = file.relative_to(SOURCE)
        for node in ast.walk(tree_of(file)):
            if isinstance(node, ast.Import):
                assert not any(a.name.startswith("fluidlift.") for a in node.names), f"{place}: import by whole name"
            if not isinstance(node, ast.ImportFrom) or not (node.module or "").startswith("fluidlift."):
                continue
            _, package, *below = node.module.split(".")
            if package in PACKAGES and place.parts[0] != package:
                found += [(str(place), package, ".".join(below), a.name) for a in node.names]
    return found


@pytest.mark.parametrize("package", PACKAGES)
def test_other_packages_import_nothing_but_the_face(package):
    face = set(face_of(package))
    for place, owner, module, name in imports():
        if owner == package:
            asked = module.partition(".")[0] or name
            assert asked in face, f"{place} imports {asked} of {package}, which is not in its __all__"
            assert not name.startswith("_"), f"{place} imports {name} of {package}.{module}, which is private"


@pytest.mark.parametrize("package", PACKAGES)
def test_a_face_has_what_it_names_and_says_what_its_modules_are_for(package):
    loaded, text = (
        importlib.import_module(f"fluidlift.{package}"),
        ast.get_docstring(tree_of(SOURCE / package / "__init__.py")),
    )
    assert text, f"{package} does not say what it is"
    for name in face_of(package):
        assert is_module(package, name) or hasattr(loaded, name), f"{package} names {name}, which is not there"
    if any(is_module(package, name) for name in face_of(package)):
        assert text.endswith(listed(package)), f"python {Path(__file__).name} writes the list in {package} anew"


def test_a_name_that_is_in_no_face_is_seen(monkeypatch):
    strange = ("fit/minimise.py", "physics", "stress_kernels", "dot")
    monkeypatch.setitem(globals(), "imports", lambda: [strange])
    with pytest.raises(AssertionError, match="imports stress_kernels of physics"):
        test_other_packages_import_nothing_but_the_face("physics")


def write(package: str) -> None:
    """Write the list of a package's modules anew."""
    file = SOURCE / package / "__init__.py"
    text = file.read_text(encoding="utf-8")
    if any(is_module(package, name) for name in face_of(package)):
        end = text.index('"""', 3)
        head = text[3:end].partition(HEAD)[0].rstrip()
        file.write_text(f'"""{head}\n\n{listed(package)}\n"""' + text[end + 3 :], encoding="utf-8")


if __name__ == "__main__":
    for each in sys.argv[1:] or PACKAGES:
        write(each)
