"""The tuned numbers of `fluidlift.shape` and `fluidlift.motion`: which there are, who reads them; one of them scaled.

A number that functions read when they run is scaled by setting the attribute in every module that holds it. One that
is read while modules are imported (a constant made of it, a default argument), or inside a compiled kernel, is scaled
in the source instead: all of fluidlift is imported afresh, through a finder that rewrites this one assignment.
"""

from __future__ import annotations

import ast
import dis
import importlib
import importlib.abc
import importlib.machinery
import importlib.util
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from types import CodeType, ModuleType
from typing import Any

import numpy as np

import fluidlift

ROOT = Path(fluidlift.__file__).parent
PACKAGES = ("shape", "motion")
BESIDE = ("types.flow", "types.kind")
"""modules with numbers that both packages read"""
LEFT_OUT = {
    "CELLS_MAX": "a limit of memory",
    "WORK_MAX": "a limit of work",
    "CHUNK": "memory at a time",
    "MOST_AT_ONCE": "memory at a time",
    "FIXED_POINT": "digits of a whole number",
    "_SHIFT": "digits of a whole number",
    "PLAIN_COLORS": "names of colours",
    "_NEIGHBOURS": "the eight neighbours of a pixel",
    "STEPS": "the neighbours of a pixel",
    "_LOGARITHM": "a table, made of DARK",
    "TURNS": "steps of a search",
    "TILTS": "steps of a search",
}
"""numbers that are not tuned, by name: why"""


@dataclass(frozen=True)
class Constant:
    """A module-level assignment of numbers."""

    module: str
    """below fluidlift, such as `shape.kind`"""
    name: str
    at_import: bool
    """read while some module is imported, or inside a compiled kernel"""

    @property
    def key(self) -> str:
        """Such as `shape.kind.SHARPNESS`."""
        return f"{self.module}.{self.name}"


def scaled(value: Any, factor: float) -> Any:
    """Numbers, and tuples, arrays and dictionaries of them, times a factor; whole numbers stay so, and at least 1."""
    if isinstance(value, dict):
        return {k: scaled(v, factor) for k, v in value.items()}
    if isinstance(value, tuple):
        return tuple(scaled(v, factor) for v in value)
    if isinstance(value, np.ndarray):
        return value * factor
    if isinstance(value, int) and value > 0:
        return max(1, round(value * factor))
    return value * factor


def is_number(value: Any) -> bool:
    """Whether `scaled` knows what to do with it."""
    if isinstance(value, dict):
        return bool(value) and all(is_number(v) for v in value.values())
    if isinstance(value, tuple):
        return bool(value) and all(is_number(v) for v in value)
    if isinstance(value, np.ndarray):
        return value.dtype.kind == "f"
    return isinstance(value, int | float) and not isinstance(value, bool) and type(value) in (int, float, np.float64)


def modules() -> list[str]:
    """Names of all modules of the two packages, below fluidlift."""
    files = sorted(p for package in PACKAGES for p in (ROOT / package).rglob("*.py"))
    return [*(".".join(p.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__") for p in files), *BESIDE]


def source_of(module: str) -> Path:
    """Its file."""
    path = ROOT.joinpath(*module.split("."))
    return path / "__init__.py" if path.is_dir() else path.with_suffix(".py")


def assigned(tree: ast.Module) -> Iterator[tuple[str, ast.stmt]]:
    """Names in capitals that a module gives values, with the statements; several names may share one."""
    for statement in tree.body:
        if isinstance(statement, ast.Assign) and len(statement.targets) == 1:
            target: ast.expr = statement.targets[0]
        elif isinstance(statement, ast.AnnAssign) and statement.value is not None:
            target = statement.target
        else:
            continue
        for name in target.elts if isinstance(target, ast.Tuple) else [target]:
            if isinstance(name, ast.Name) and name.id.isupper():
                yield name.id, statement


def constants() -> tuple[list[Constant], dict[str, str]]:
    """All that are tuned; and why others are not tried, by key."""
    found, left = [], {}
    early = _read_at_import()
    for module in modules():
        loaded = importlib.import_module(f"fluidlift.{module}")
        for name, _ in assigned(ast.parse(source_of(module).read_text(encoding="utf-8"))):
            if not is_number(getattr(loaded, name)):
                continue
            why = LEFT_OUT.get(name)
            if why is not None:
                left[f"{module}.{name}"] = why
                continue
            found.append(Constant(module, name, (module, name) in early))
    return found, left


def _read_at_import() -> set[tuple[str, str]]:
    """(module, name) of what is read outside function bodies, or in a compiled kernel, somewhere in fluidlift."""
    read = set()
    for file in sorted(ROOT.rglob("*.py")):
        module = ".".join(file.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")
        text = file.read_text(encoding="utf-8")
        if module.split(".")[0] not in (*PACKAGES, "types") and not any(f"fluidlift.{p}" in text for p in PACKAGES):
            continue
        tree = ast.parse(text)
        home = {
            alias.asname or alias.name: (statement.module.removeprefix("fluidlift."), alias.name)
            for statement in tree.body
            if isinstance(statement, ast.ImportFrom) and (statement.module or "").startswith("fluidlift.")
            for alias in statement.names
        }
        for node in _early_nodes(tree):
            if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Load):
                read.add(home.get(node.id, (module, node.id)))
            elif isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id in home:
                place, name = home[node.value.id]
                read.add((f"{place}.{name}", node.attr))
    return read


def _early_nodes(tree: ast.Module) -> Iterator[ast.AST]:
    """Nodes outside function bodies, and those of functions with a decorator that compiles."""
    waiting: list[ast.AST] = list(tree.body)
    while waiting:
        node = waiting.pop()
        yield node
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            if any("njit" in ast.unparse(d) or "jit(" in ast.unparse(d) for d in node.decorator_list):
                waiting += node.body
            waiting += [node.args, *node.decorator_list]
        elif isinstance(node, ast.Lambda):
            waiting.append(node.args)
        else:
            waiting += ast.iter_child_nodes(node)


def reads(lines: set[tuple[CodeType, int]], everything: list[Constant]) -> set[str]:
    """Keys of the constants named on lines of code that were run: the module's own, what it imports, `module.NAME`."""
    home: dict[tuple[str | None, str], str] = {}
    by_name: dict[str, list[Constant]] = {}
    for constant in everything:
        value = getattr(sys.modules[f"fluidlift.{constant.module}"], constant.name)
        home |= {(m.__file__, constant.name): constant.key for m in _holders(constant, value)}
        by_name.setdefault(constant.name, []).append(constant)
    files = {getattr(m, "__file__", None): m for m in list(sys.modules.values())}
    found = set()
    for code in {code for code, _ in lines}:
        module = files.get(code.co_filename)
        for step in dis.get_instructions(code):
            at = step.positions.lineno if step.positions else None
            if not isinstance(step.argval, str) or step.argval not in by_name:
                continue
            if at is None or (code, at) not in lines:
                continue
            if step.opname == "LOAD_GLOBAL" and (code.co_filename, step.argval) in home:
                found.add(home[code.co_filename, step.argval])
            elif step.opname in ("LOAD_ATTR", "LOAD_METHOD"):
                held = {id(getattr(module, n, None)) for n in code.co_names}
                found |= {c.key for c in by_name[step.argval] if id(sys.modules[f"fluidlift.{c.module}"]) in held}
    return found


def early_reads(files: set[str], everything: list[Constant]) -> set[str]:
    """Keys of the constants read at import that may count in code of some files: of modules that hold them."""
    found = set()
    for constant in everything:
        own = sys.modules[f"fluidlift.{constant.module}"]
        holders = _holders(constant, getattr(own, constant.name)) if constant.at_import else []
        users = (
            m for n, m in list(sys.modules.items()) if holders and n.startswith("fluidlift.") and own in _modules(m)
        )
        if any(m.__file__ in files for m in [*holders, *users]):
            found.add(constant.key)
    return found


def _modules(module: ModuleType) -> list[ModuleType]:
    """That a module holds by name."""
    return [value for value in vars(module).values() if isinstance(value, ModuleType)]


def _holders(constant: Constant, value: Any) -> list[ModuleType]:
    """Modules of fluidlift in which the name stands for this very value because they import it by name."""
    found = []
    for name, module in list(sys.modules.items()):
        if name == f"fluidlift.{constant.module}":
            found.append(module)
        elif name.startswith("fluidlift.") and module.__dict__.get(constant.name) is value:
            found += [module] * (constant.module in _imported_from(module, constant.name))
    return found


def _imported_from(module: ModuleType, name: str) -> set[str]:
    """Modules, below fluidlift, from which a module imports a name."""
    if not module.__file__ or not module.__file__.endswith(".py"):
        return set()
    tree = ast.parse(Path(module.__file__).read_text(encoding="utf-8"))
    return {
        (statement.module or "").removeprefix("fluidlift.")
        for statement in ast.walk(tree)
        if isinstance(statement, ast.ImportFrom)
        for alias in statement.names
        if alias.name == name and alias.asname in (None, name)
    }


def set_in_place(constant: Constant, factor: float) -> None:
    """Scale it in every module that holds it."""
    value = getattr(sys.modules[f"fluidlift.{constant.module}"], constant.name)
    for module in _holders(constant, value):
        setattr(module, constant.name, scaled(value, factor))


class Rewriting(importlib.abc.MetaPathFinder):
    """Imports one module with one number scaled, and its kernels compiled anew: a kept kernel holds the old value."""

    def __init__(self, constant: Constant, factor: float) -> None:
        self.constant, self.factor = constant, factor

    def find_spec(self, fullname: str, path: Any, target: Any = None) -> importlib.machinery.ModuleSpec | None:
        """Of the module with the constant alone."""
        if fullname != f"fluidlift.{self.constant.module}":
            return None
        file = source_of(self.constant.module)
        loader = _RewritingLoader(fullname, str(file), self.constant.name, self.factor)
        return importlib.util.spec_from_file_location(
            fullname,
            file,
            loader=loader,
            submodule_search_locations=[str(file.parent)] if file.stem == "__init__" else None,
        )


class _RewritingLoader(importlib.machinery.SourceFileLoader):
    def __init__(self, fullname: str, path: str, name: str, factor: float) -> None:
        super().__init__(fullname, path)
        self.name_scaled, self.factor = name, factor

    def get_code(self, fullname: str) -> CodeType:
        tree = ast.parse(Path(self.path).read_text(encoding="utf-8"))
        statement = next(s for name, s in assigned(tree) if name == self.name_scaled)
        after = ast.parse(f"{self.name_scaled} = __scaled__({self.name_scaled}, {self.factor!r})")
        place = tree.body.index(statement) + 1
        tree.body[place:place] = after.body
        for node in ast.walk(tree):
            if isinstance(node, ast.keyword) and node.arg == "cache":
                node.value = ast.Constant(False)
        return compile(ast.fix_missing_locations(tree), self.path, "exec")

    def exec_module(self, module: ModuleType) -> None:
        module.__dict__["__scaled__"] = scaled
        super().exec_module(module)


def import_afresh(constant: Constant, factor: float) -> None:
    """Forget all of fluidlift, and import it from now on with the constant scaled."""
    for name in [n for n in sys.modules if n == "fluidlift" or n.startswith("fluidlift.")]:
        del sys.modules[name]
    sys.meta_path.insert(0, Rewriting(constant, factor))
