"""YAML from strangers: scene.yaml, settings, lists of shots and values on the command line are all read here.

A part of YAML 1.2: mappings with plain keys, lists, texts, numbers of the core schema (`1e-6` is a number, `1:30` and
`1_000` are words, and `010` is ten), true and false (also yes, no, on and off). Aliases and tags are refused, dates and
merge keys are words: a few lines of nested aliases can describe more data than any machine holds.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator
from functools import lru_cache
from pathlib import Path
from typing import Any

import yaml

from fluidlift.errors import InputRejected
from fluidlift.io.limits import require_file, require_size

MAX_BYTES = 2**20
"""of a file; read in half a second"""
MAX_DEPTH = 32
"""mappings and lists inside each other"""
MAX_NODES = 50_000
"""keys and values of a text"""
MAX_SCALAR = 2**16
"""characters of one text"""
MAX_NUMBER = 64
"""characters of one number"""

_LOADER = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
"""libyaml's parser is ten times faster; PyYAML from PyPI has it"""
_NULL = frozenset({"", "~", "null", "Null", "NULL"})
_TRUE = frozenset(f(w) for w in ("true", "yes", "on") for f in (str.lower, str.upper, str.capitalize))
_FALSE = frozenset(f(w) for w in ("false", "no", "off") for f in (str.lower, str.upper, str.capitalize))
_INTEGER = re.compile(r"[-+]?[0-9]+")
_OTHER_BASE = re.compile(r"0o[0-7]+|0x[0-9a-fA-F]+")
_FLOAT = re.compile(r"[-+]?(\.[0-9]+|[0-9]+(\.[0-9]*)?)([eE][-+]?[0-9]+)?")
_INFINITE = re.compile(r"[-+]?\.(inf|Inf|INF)")
_NAN = frozenset({".nan", ".NaN", ".NAN"})


def read_yaml(path: Path | str, what: str) -> Any:
    """Plain data of a YAML file.

    Args:
        path: of the file.
        what: what it is, in words: "config file".

    Raises:
        InputRejected: no such file, more than `MAX_BYTES`, no text, or as `parse_yaml`.
    """
    path = require_file(path, what)
    require_size(path, MAX_BYTES, what)
    try:
        return parse_yaml(path.read_bytes().decode("utf-8"))
    except UnicodeDecodeError as error:
        raise InputRejected(f"{what} {path.name} cannot be read: it is no text ({error})", "UTF-8") from None
    except yaml.YAMLError as error:
        mark, why = getattr(error, "problem_mark", None), getattr(error, "problem", None) or error
        place = "" if mark is None else f"line {mark.line + 1}: "
        reason = " ".join(str(why).split())[:200]
        raise InputRejected(f"{what} {path.name} cannot be read: {place}{reason}", "YAML") from None


def parse_yaml(text: str) -> Any:
    """Plain data of a YAML text: dictionaries, lists, texts, numbers, true, false and None.

    Raises:
        yaml.YAMLError: broken YAML, what this reader does not take (see above), or more than its bounds.
    """
    return _plain(composed(text))


@lru_cache(maxsize=4)
def composed(text: str) -> yaml.Node | None:
    """The nodes of a YAML text, with the places where they stand; not to be changed.

    Raises:
        yaml.YAMLError: as `parse_yaml`.
    """
    if len(text) > MAX_BYTES:
        raise yaml.YAMLError(f"{len(text)} characters; at most {MAX_BYTES} are read")
    try:
        return _Composer(text).document()
    except UnicodeEncodeError:
        raise yaml.YAMLError("half a character (a lone surrogate)") from None


def as_numbers(data: Any) -> Any:
    """The same data with texts such as `1e-6` as numbers: what a person types is meant as one."""
    if isinstance(data, dict):
        return {k: as_numbers(v) for k, v in data.items()}
    if isinstance(data, list):
        return [as_numbers(v) for v in data]
    if isinstance(data, str) and data[:1] in "+-.0123456789" and "e" in data.lower():
        try:
            return float(data)
        except ValueError:
            return data
    return data


class _Composer:
    """Nodes out of the parser's events, counted as they come: nothing is built beyond the bounds."""

    def __init__(self, text: str) -> None:
        self.events: Iterator[Any] = iter(yaml.parse(text, Loader=_LOADER))
        self.shift = int(text.startswith("\ufeff") and _LOADER is not yaml.SafeLoader)  # libyaml does not count it
        self.count = 0

    def document(self) -> yaml.Node | None:
        """The root of the only document."""
        root = None
        for event in self.events:
            if isinstance(event, yaml.DocumentStartEvent):
                if root is not None:
                    raise _refused("a second document", event)
                root = self.node(next(self.events), 0)
        return root

    def node(self, event: Any, depth: int) -> yaml.Node:
        """The node that begins with an event."""
        self.count += 1
        if isinstance(event, yaml.AliasEvent):
            raise _refused("aliases (*name) are not used here", event)
        if self.count > MAX_NODES:
            raise _refused(f"more than {MAX_NODES} keys and values", event)
        if depth > MAX_DEPTH:
            raise _refused(f"more than {MAX_DEPTH} lists and mappings inside each other", event)
        if event.tag is not None and event.tag != "!":
            raise _refused("tags (!name) are not used here", event)
        begin = self.mark(event.start_mark)
        if isinstance(event, yaml.ScalarEvent):
            if len(event.value) > MAX_SCALAR:
                raise _refused(f"a text of {len(event.value)} characters; at most {MAX_SCALAR} are read", event)
            word = event.style in (None, "") and event.tag is None
            kind = "plain" if word else "text"
            return yaml.ScalarNode(kind, event.value, begin, self.mark(event.end_mark), event.style)
        mapping = isinstance(event, yaml.MappingStartEvent)
        node = (yaml.MappingNode if mapping else yaml.SequenceNode)("", [], begin, None, event.flow_style)
        end = yaml.MappingEndEvent if mapping else yaml.SequenceEndEvent
        while not isinstance(event := next(self.events), end):
            child = self.node(event, depth + 1)
            if mapping and not isinstance(child, yaml.ScalarNode):
                raise _refused("a list or a mapping as a key", event)
            node.value.append((child, self.node(next(self.events), depth + 1)) if mapping else child)
        node.end_mark = self.mark(event.end_mark)
        return node

    def mark(self, mark: Any) -> Any:
        """Where it is in the text itself."""
        if not self.shift:
            return mark
        return yaml.Mark(mark.name, mark.index + self.shift, mark.line, mark.column, None, 0)


def _refused(why: str, event: Any) -> yaml.MarkedYAMLError:
    return yaml.MarkedYAMLError(None, None, why, event.start_mark)


def _plain(node: yaml.Node | None) -> Any:
    """What a node stands for."""
    if node is None:
        return None
    if isinstance(node, yaml.ScalarNode):
        return _value(node) if node.tag == "plain" else node.value
    if isinstance(node, yaml.SequenceNode):
        return [_plain(item) for item in node.value]
    found: dict[Any, Any] = {}
    for key, value in node.value:
        name = _plain(key)
        if name in found:  # of two values, one would be ignored in silence
            raise yaml.MarkedYAMLError(None, None, f"'{key.value[:40]}' twice", key.start_mark)
        found[name] = _plain(value)
    return found


def _value(node: yaml.ScalarNode) -> Any:
    """A word of the core schema."""
    word = node.value
    if word in _NULL:
        return None
    if word in _TRUE or word in _FALSE:
        return word in _TRUE
    if word in _NAN:
        return math.nan
    if _INFINITE.fullmatch(word):
        return -math.inf if word[0] == "-" else math.inf
    number = word[0] in "+-.0123456789" and (_FLOAT.fullmatch(word) or _OTHER_BASE.fullmatch(word))
    if not number:
        return word
    if len(word) > MAX_NUMBER:
        raise yaml.MarkedYAMLError(None, None, f"a number of {len(word)} characters", node.start_mark)
    if _INTEGER.fullmatch(word):
        return int(word)
    if _OTHER_BASE.fullmatch(word):
        return int(word, 0)
    value = float(word)
    if math.isinf(value):
        raise yaml.MarkedYAMLError(None, None, f"the number {word}, which is too large", node.start_mark)
    return value
