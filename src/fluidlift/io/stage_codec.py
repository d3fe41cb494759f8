"""Values as arrays and JSON: frozen dataclasses are packed and unpacked by the types of their fields.

The one place that does so. Fields may be arrays (`np.ndarray`, or with a shape by jaxtyping), numbers, texts, enums,
optional ones, tuples, lists, dictionaries by name, other dataclasses, and `Any` for plain values. Nothing is pickled,
and nothing is believed: what does not have the type that a field says is `Mistyped`.
"""

from __future__ import annotations

import math
import types
import typing
from collections.abc import Mapping
from dataclasses import MISSING, fields, is_dataclass
from enum import Enum
from functools import cache
from typing import Any, TypeVar

import numpy as np

from fluidlift.errors import FluidliftError
from fluidlift.io.atomic import plain
from fluidlift.messages import Notice, code_of

T = TypeVar("T")
Arrays = Mapping[str, np.ndarray]

STORED = "fiubcU"
"""kinds of numbers in arrays"""
NO_NUMBERS = {"inf": math.inf, "-inf": -math.inf, "nan": math.nan}
"""JSON has none of them"""


class Mistyped(ValueError):
    """A value is not of the type that it should be; says which."""


def packed(value: Any) -> tuple[dict[str, np.ndarray], Any]:
    """The arrays of a dataclass, by name, and all else of it as JSON.

    Raises:
        Mistyped: a field that holds something else than its type says, or a type that cannot be stored.
    """
    arrays: dict[str, np.ndarray] = {}
    return arrays, _packed(type(value), value, "", arrays)


def unpacked(kind: type[T], arrays: Arrays, data: Any, *, exact: bool = True) -> T:
    """The reverse of `packed`.

    Args:
        kind: type of the value.
        arrays, data: as `packed` gives them.
        exact: with all fields and no other. Else fields that are gone by now are left out, and those that a version
            before did without take their default.

    Raises:
        Mistyped: arrays or data that are not those of such a value.
    """
    try:
        return _unpacked(kind, data, "", arrays, exact)
    except Mistyped:
        raise
    except (FluidliftError, ValueError, TypeError, KeyError, AttributeError, OverflowError, RecursionError) as error:
        raise Mistyped(f"no {kind.__name__}: {error}") from error


@cache
def field_types(kind: type) -> dict[str, Any]:
    """Types of the fields of a dataclass, by name."""
    hints = typing.get_type_hints(kind)
    return {f.name: hints[f.name] for f in fields(kind)}


@cache
def _needed(kind: type) -> frozenset[str]:
    """Names of the fields of a dataclass that have no default."""
    return frozenset(f.name for f in fields(kind) if f.default is MISSING and f.default_factory is MISSING)


def _packed(hint: Any, value: Any, path: str, arrays: dict[str, np.ndarray]) -> Any:
    origin, inner = typing.get_origin(hint), typing.get_args(hint)
    if hint is Any:
        return plain(value)
    if origin in (typing.Union, types.UnionType):
        return None if value is None else _packed(_only(inner, path), value, path, arrays)
    if _is_array(hint):
        arrays[path] = _checked(hint, value, path)
        return path
    if isinstance(hint, type) and is_dataclass(hint):
        _require(isinstance(value, hint), path, value, hint)
        return {n: _packed(t, getattr(value, n), _at(path, n), arrays) for n, t in field_types(hint).items()}
    if origin in (tuple, list):
        _require(isinstance(value, tuple | list), path, value, hint)
        parts = _parts(origin, inner, len(value), path)
        return [_packed(t, v, _at(path, i), arrays) for i, (t, v) in enumerate(zip(parts, value, strict=True))]
    if origin is dict:
        _require(isinstance(value, dict) and all(isinstance(k, str) for k in value), path, value, hint)
        return {k: _packed(inner[1], v, _at(path, i), arrays) for i, (k, v) in enumerate(value.items())}
    if origin is typing.Literal:
        _require(value in inner, path, value, hint)
        return value
    if isinstance(hint, type) and issubclass(hint, Enum):
        _require(isinstance(value, hint), path, value, hint)
        return value.value
    return _scalar(hint, value.item() if isinstance(value, np.generic) else value, path, as_text=True)


def _unpacked(hint: Any, data: Any, path: str, arrays: Arrays, exact: bool) -> Any:
    origin, inner = typing.get_origin(hint), typing.get_args(hint)
    if hint is Any:
        return data
    if origin in (typing.Union, types.UnionType):
        return None if data is None else _unpacked(_only(inner, path), data, path, arrays, exact)
    if _is_array(hint):
        _require(data == path and path in arrays, path, data, "an array")
        return _checked(hint, arrays[path], path)
    if isinstance(hint, type) and is_dataclass(hint):
        known = field_types(hint)
        _require(isinstance(data, dict) and _needed(hint) <= data.keys(), path, data, hint)
        _require(not exact or data.keys() == known.keys(), path, data, hint)
        return hint(**{n: _unpacked(t, data[n], _at(path, n), arrays, exact) for n, t in known.items() if n in data})
    if origin in (tuple, list):
        _require(isinstance(data, list), path, data, hint)
        parts = _parts(origin, inner, len(data), path)
        return origin(
            _unpacked(t, v, _at(path, i), arrays, exact) for i, (t, v) in enumerate(zip(parts, data, strict=True))
        )
    if origin is dict:
        _require(isinstance(data, dict), path, data, hint)
        return {k: _unpacked(inner[1], v, _at(path, i), arrays, exact) for i, (k, v) in enumerate(data.items())}
    if origin is typing.Literal:
        _require(data in inner, path, data, hint)
        return data
    if isinstance(hint, type) and issubclass(hint, Enum):
        return hint(data)
    if hint is Notice and isinstance(data, dict) and data.keys() == {"code", "text"}:
        return Notice(_scalar(str, data["code"], path), _scalar(str, data["text"], path))
    return _scalar(hint, NO_NUMBERS.get(data, data) if hint is float and isinstance(data, str) else data, path)


def _at(path: str, part: str | int) -> str:
    """Path of a part; file names of arrays are made of it."""
    return f"{path}-{part}" if path else str(part)


def _only(choices: tuple[Any, ...], path: str) -> Any:
    """The type of an optional field; others than None and one more cannot be told apart in JSON."""
    found = [c for c in choices if c is not type(None)]
    if len(found) != 1:
        raise Mistyped(f"{path}: a choice of {len(found)} types cannot be stored")
    return found[0]


def _parts(origin: type, inner: tuple[Any, ...], count: int, path: str) -> tuple[Any, ...]:
    """Types of the items of a tuple or list of `count`."""
    if origin is list or (len(inner) == 2 and inner[1] is Ellipsis):
        return (inner[0],) * count
    if len(inner) != count:
        raise Mistyped(f"{path}: {count} items where {len(inner)} are needed")
    return inner


def _is_array(hint: Any) -> bool:
    return hint is np.ndarray or hasattr(hint, "array_type")


def _checked(hint: Any, array: Any, path: str) -> np.ndarray:
    """The array, where its numbers are of the kind that is wanted."""
    _require(isinstance(array, np.ndarray) and array.dtype.kind in STORED, path, type(array), hint)
    if hint is not np.ndarray:
        _require(hint.dtypes is Any or str(array.dtype) in hint.dtypes, path, array.dtype, hint)
        dims = len(hint.dims)
        _require(array.ndim == dims, path, f"{array.ndim} dimensions", f"{dims}")
    return array


def _scalar(hint: Any, value: Any, path: str, *, as_text: bool = False) -> Any:
    """A number, text or truth value; `as_text`: inf and nan as JSON can hold them."""
    if hint is Notice:
        _require(isinstance(value, str), path, value, str)
        return {"code": code_of(value), "text": str(value)} if as_text else Notice("", value)
    if hint is bool or hint is str or hint is type(None):
        _require(isinstance(value, hint), path, value, hint)
        return value
    if hint is int:
        _require(isinstance(value, int) and not isinstance(value, bool), path, value, hint)
        return value
    if hint is float:
        _require(isinstance(value, int | float) and not isinstance(value, bool), path, value, hint)
        number = float(value)
        return str(number) if as_text and not math.isfinite(number) else number
    raise Mistyped(f"{path}: {hint} cannot be stored")


def _require(good: bool, path: str, got: Any, needed: Any) -> None:
    if not good:
        raise Mistyped(f"{path or 'the value'}: {str(got)[:80]} where {getattr(needed, '__name__', needed)} is needed")
