"""The shapes and types in annotations of arrays, checked by jaxtyping and beartype while the fast tier runs.

`install` puts a hook on the import of modules. Once one of ours has run, its functions, methods and dataclasses whose
annotations name arrays are exchanged for checked ones. jaxtyping's own import hook puts its decorator below all others,
where Numba would have to compile it; here nothing but plain Python is exchanged, so that compiled functions, their
caches and the source stay what they are. Of a signature only the arrays are checked: the rest is pyright's, and what is
not checked costs nothing.

Arguments and result are checked together when a function is done: what refuses a wrong array itself does so in its own
words. Of a dataclass its fields are checked, as its `__post_init__` left them. An axis such as `nx+1` is checked where
`nx` is an earlier axis of the array or of an argument before it.
"""

from __future__ import annotations

import functools
import importlib.abc
import importlib.machinery
import inspect
import itertools
import re
import sys
from collections.abc import Callable, Mapping
from types import FunctionType, ModuleType
from typing import Any

from beartype import BeartypeConf
from beartype.door import is_bearable
from jaxtyping import AnnotationError, TypeCheckError, jaxtyped

CHECKED = ("evaluate", "fit", "io", "look", "motion", "numerics", "physics", "present", "scene", "shape", "synthetic",
           "types")  # fmt: skip
"""packages whose arrays are checked; backends take what their networks give"""

MOST = 200
"""calls of a function that are looked at in a process: what a simulation calls in every step would take 40 % longer"""

NUMBERS = BeartypeConf(is_pep484_tower=True)
"""takes whole numbers for real ones, as type checkers do"""

ARRAY = re.compile(r"\b(Float|Int|Bool|UInt8|UInt16)\[([\w.]+), *(['\"])([^'\"]*)\3\]")
"""an annotation of one array, as text: what it holds, its class, its axes"""

NAME = re.compile(r"[A-Za-z_]\w*")


def install(packages: tuple[str, ...] = CHECKED) -> None:
    """Check the arrays of all modules of these packages of fluidlift that are imported from now on."""
    sys.meta_path.insert(0, Finder(tuple(f"fluidlift.{name}" for name in packages)))


class Finder(importlib.abc.MetaPathFinder):
    """Finds modules as usual, and has those of some packages checked."""

    def __init__(self, packages: tuple[str, ...]) -> None:
        self.packages = packages

    def find_spec(self, fullname: str, path: Any = None, target: Any = None) -> importlib.machinery.ModuleSpec | None:
        """The usual spec with our loader; None for modules of others."""
        if ".".join(fullname.split(".")[:2]) not in self.packages:
            return None
        spec = importlib.machinery.PathFinder.find_spec(fullname, path, target)
        if spec is not None and isinstance(spec.loader, importlib.machinery.SourceFileLoader):
            spec.loader = Loader(spec.loader.name, spec.loader.path)
        return spec


class Loader(importlib.machinery.SourceFileLoader):
    """Runs a module as usual, then exchanges what it defines."""

    def exec_module(self, module: ModuleType) -> None:
        """Run it."""
        super().exec_module(module)
        for name, value in list(vars(module).items()):
            if getattr(value, "__module__", None) != module.__name__:
                continue
            if isinstance(value, FunctionType):
                setattr(module, name, checked(value))
            elif isinstance(value, type):
                check_class(value)


def check_class(cls: type) -> None:
    """Exchange the methods of a class, and what makes a dataclass."""
    for name, value in list(vars(cls).items()):
        if name == "__init__" and "__dataclass_fields__" in vars(cls):
            setattr(cls, name, _checked_fields(value))
        elif isinstance(value, FunctionType):
            setattr(cls, name, checked(value))
        elif isinstance(value, classmethod | staticmethod):
            setattr(cls, name, type(value)(checked(value.__func__)))
        elif isinstance(value, property) and isinstance(value.fget, FunctionType):
            setattr(cls, name, property(checked(value.fget), value.fset, value.fdel, value.__doc__))
        elif isinstance(value, functools.cached_property):
            value.func = checked(value.func)


def checked(function: Callable[..., Any]) -> Callable[..., Any]:
    """The function, which refuses arrays that its annotations do not allow; itself where they name none.

    Raises (when called):
        TypeCheckError: an array of another shape or type.
    """
    hints = arrays_of(function)
    if not hints or inspect.isgeneratorfunction(function):
        return function
    names, left = tuple(inspect.signature(function).parameters), itertools.count(MOST, -1)

    @functools.wraps(function)
    def found(*args: Any, **options: Any) -> Any:
        result = function(*args, **options)
        if next(left) > 0:
            require(function.__qualname__, {**dict(zip(names, args)), **options, "return": result}, hints)
        return result

    return found


def _checked_fields(make: Callable[..., None]) -> Callable[..., None]:
    """`__init__` of a dataclass."""
    hints, left = arrays_of(make), itertools.count(MOST, -1)
    if not hints:
        return make

    @functools.wraps(make)
    def found(self: Any, *args: Any, **options: Any) -> None:
        make(self, *args, **options)
        if next(left) > 0:
            require(
                type(self).__qualname__, {name: getattr(self, name) for name in hints if hasattr(self, name)}, hints
            )

    return found


def require(owner: str, values: Mapping[str, Any], hints: Mapping[str, Any]) -> None:
    """Raise `TypeCheckError` where values do not fit their annotations, which share the sizes of axes."""
    with jaxtyped("context"):
        for name, hint in hints.items():
            try:
                fits = name not in values or is_bearable(values[name], hint, conf=NUMBERS)
            except AnnotationError:  # reckoned from an axis of an array that was not given
                continue
            if not fits:
                seen = ", ".join(f"{k} {_shown(values[k])}" for k in hints if k in values)
                raise TypeCheckError(f"{owner}: {name} is no {hint}, or other arrays have other sizes: {seen}")


def _shown(value: Any) -> str:
    return f"{value.dtype}{list(value.shape)}" if hasattr(value, "dtype") else type(value).__name__


def arrays_of(function: Any) -> dict[str, Any]:
    """Those of a function's annotations that name arrays, and no class that is imported for type checkers only."""
    found: dict[str, Any] = {}
    known: set[str] = set()
    for name, text in getattr(function, "__annotations__", {}).items():
        if not isinstance(text, str) or not ARRAY.search(text):
            continue
        # of several alternatives one is taken, so that none of them gives the others a size
        readable = ARRAY.sub(lambda match, sizes=frozenset(known): _readable(match, sizes), text)
        try:
            found[name] = eval(readable, function.__globals__)
        except NameError:
            continue
        known |= {axis for match in ARRAY.finditer(text) for axis in match[4].split() if NAME.fullmatch(axis)}
    return found


def _readable(match: re.Match[str], known: frozenset[str]) -> str:
    """The annotation of one array; an axis that is reckoned from others may have any size while theirs are unknown."""
    axes, sizes = [], set(known)
    for axis in match[4].split():
        reckoned = NAME.fullmatch(axis) is None and bool(re.search(r"\w[+*-]", axis))
        axes.append("_" if reckoned and not sizes.issuperset(NAME.findall(axis)) else axis)
        sizes |= {axis} if NAME.fullmatch(axis) else set()
    return f'{match[1]}[{match[2]}, " {" ".join(axes)}"]'
