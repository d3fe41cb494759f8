"""A job from presets, YAML files and single overrides, each value checked."""

from __future__ import annotations

import dataclasses
import re
import types
import typing
from pathlib import Path
from typing import Any, Literal

from fluidlift.config.presets import PRESETS, RANGES
from fluidlift.config.sections import JobConfig
from fluidlift.errors import InputRejected


def build_config(
    preset: str | None = None,
    file: Path | None = None,
    overrides: typing.Sequence[str] = (),
    flat: dict[str, Any] | None = None,
    *,
    base: dict[str, Any] | None = None,
) -> JobConfig:
    """Base, preset, then file, then flat options, then `section.name=value` overrides; later ones win.

    Args:
        preset: draft, standard, hero or paper; None: the file's, or draft.
        file: YAML with the sections of `JobConfig`.
        overrides: texts such as "fit.max_seconds=60".
        flat: values by dotted name, from command-line options; None values are left out.
        base: values by dotted name that a command starts from where others have another default.

    Raises:
        InputRejected: an unknown name or a value of the wrong type.
    """
    values: dict[str, Any] = {}
    if file is not None:
        values.update(_flatten(_read_yaml(file)))
    last: dict[str, Any] = {}
    for text in overrides:
        name, sign, value = text.partition("=")
        if not sign:
            raise InputRejected(f"override '{text}'", "section.name=value, such as fit.max_seconds=60")
        last[name.strip()] = _parse(value.strip())
    in_file = values.pop("preset", "draft")
    preset = str(last.pop("preset", preset or in_file))
    if preset not in PRESETS:
        raise InputRejected(f"unknown preset '{preset}'", "one of " + ", ".join(PRESETS))
    merged = (base or {}) | _flatten(PRESETS[preset]) | values
    merged |= {k: v for k, v in (flat or {}).items() if v is not None} | last
    config: Any = JobConfig(preset=typing.cast(Any, preset))
    for name, value in merged.items():
        config = _with(config, name.split("."), value, name)
    return config


def _read_yaml(path: Path) -> dict[str, Any]:
    from fluidlift.io.yaml_reader import read_yaml

    data = read_yaml(path, "config file")
    if not isinstance(data, dict):
        raise InputRejected(f"config file {path.name} holds no sections", "read:, shape:, motion:, fit:, ...")
    return data


def _flatten(data: dict[str, Any]) -> dict[str, Any]:
    flat: dict[str, Any] = {}
    for key, value in data.items():
        if isinstance(value, dict):
            flat |= {f"{key}.{k}": v for k, v in value.items()}
        else:
            flat[str(key)] = value
    return flat


def _parse(text: str) -> Any:
    import yaml

    from fluidlift.io.yaml_reader import parse_yaml

    try:
        return parse_yaml(text)
    except yaml.YAMLError:
        raise InputRejected(f"the value '{text}'", "a number, a word, true, false or null") from None


def _with(config: Any, path: list[str], value: Any, name: str) -> Any:
    fields = typing.get_type_hints(type(config))
    if path[0] not in fields:
        known = ", ".join(fields)
        raise InputRejected(f"unknown option '{name}'", f"one of {known}", "see --print-config for all names")
    if len(path) > 1:
        inner = getattr(config, path[0])
        if not dataclasses.is_dataclass(inner):
            raise InputRejected(f"unknown option '{name}'", f"{path[0]} has no parts")
        return dataclasses.replace(config, **{path[0]: _with(inner, path[1:], value, name)})
    return dataclasses.replace(config, **{path[0]: _checked(value, fields[path[0]], name)})


def _checked(value: Any, kind: Any, name: str) -> Any:
    several = isinstance(kind, types.UnionType) or typing.get_origin(kind) is typing.Union  # the latter with Literal
    options = typing.get_args(kind) if several else (kind,)
    for option in options:
        if option is type(None) and value is None:
            return None
        if typing.get_origin(option) is Literal and value in typing.get_args(option):
            return value
        if option is float and _is_number(value):
            return _in_range(float(value), name)
        if typing.get_origin(option) is tuple:
            return _words(value, name)
        if option in (int, bool, str) and type(value) is option:
            return _in_range(value, name) if option is int else value
    wanted = ", ".join(
        "/".join(map(str, typing.get_args(o))) if typing.get_origin(o) is Literal else getattr(o, "__name__", str(o))
        for o in options
    )
    raise InputRejected(f"option {name} = {value!r}", f"a value of type {wanted}")


def _words(value: Any, name: str) -> tuple[str, ...]:
    """A list of words, words between commas (those in brackets stay together), or names with values."""
    if isinstance(value, dict):
        value = [f"{k}={v}" for k, v in value.items()]
    parts = re.split(r",(?![^\[(]*[\])])", value) if isinstance(value, str) else value or ()
    if not isinstance(parts, list | tuple) or not all(isinstance(p, str) for p in parts):
        raise InputRejected(f"option {name} = {value!r}", "words with commas between them, or a list of words")
    return tuple(p.strip() for p in parts if p.strip())


def _is_number(value: Any) -> bool:
    """YAML takes 1e3 for a word: it is a number here."""
    if isinstance(value, str):
        try:
            float(value)
        except ValueError:
            return False
        return True
    return isinstance(value, int | float) and not isinstance(value, bool)


def _in_range(value: Any, name: str) -> Any:
    low, high = RANGES.get(name, (float("-inf"), float("inf")))
    if not low <= value <= high:
        raise InputRejected(f"option {name} = {value:g}", f"{low:g} to {high:g}")
    return value
