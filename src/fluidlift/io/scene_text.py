"""Changes of scene.yaml's text that leave the rest as a person wrote it: comments, order, spacing.

The text is cut at the places where its YAML nodes begin and end. Each result is read back and compared with what was
wanted; where they differ (odd but valid YAML), the section is written anew, and at last the whole file.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import yaml

from fluidlift.errors import InputRejected
from fluidlift.io.scene import plain_scene
from fluidlift.io.yaml_reader import as_numbers, composed

Path = tuple[str | int, ...]
"""names and list indices from the top of the file"""

_INDENT = 2


def with_value(text: str, path: Path, value: Any) -> str:
    """The text with another value at a path; missing sections and names are added.

    Raises:
        InputRejected: broken YAML, or a path through something that is no section.
    """
    value = as_numbers(value)

    def change(data: dict[str, Any]) -> None:
        place = _parent(data, path, make=True)
        place[path[-1]] = value

    return _changed(text, path, change, lambda root: _set(text, root, path, value))


def without(text: str, path: Path) -> str:
    """The text without the entry or list item at a path.

    Raises:
        InputRejected: broken YAML, or nothing at the path.
    """

    def change(data: dict[str, Any]) -> None:
        place = _parent(data, path)
        del place[path[-1]]
        if len(path) == 2 and not place:  # the name alone: lines below it can be used again
            data[str(path[0])] = None

    return _changed(text, path, change, lambda root: _remove(text, root, path))


def with_item(text: str, path: Path, item: Any) -> str:
    """The text with one more item at the end of the list at a path, which is made where there is none.

    Raises:
        InputRejected: broken YAML, or something else than a list at the path.
    """
    item = as_numbers(item)

    def change(data: dict[str, Any]) -> None:
        place = _parent(data, path, make=True)
        if place.get(path[-1]) in (None, {}, ""):
            place[path[-1]] = []
        if not isinstance(place[path[-1]], list):
            raise InputRejected(f"{path[-1]} of scene.yaml is {place[path[-1]]!r}", "a list")
        place[path[-1]].append(item)

    return _changed(text, path, change, lambda root: _append(text, root, path, item))


def _parent(data: Any, path: Path, *, make: bool = False) -> Any:
    """What holds the last part of a path."""
    for i, part in enumerate(path[:-1]):
        if make and isinstance(data, dict) and data.get(part) in (None, []):
            data[part] = {}
        try:
            data = data[part]
        except (KeyError, IndexError, TypeError):
            raise InputRejected(f"there is no '{'.'.join(map(str, path[: i + 1]))}' in scene.yaml") from None
    fits = isinstance(data, dict) if isinstance(path[-1], str) else isinstance(data, list)
    if not fits:
        raise InputRejected(f"'{'.'.join(map(str, path[:-1]))}' of scene.yaml is {data!r}", "entries with names")
    return data


def _changed(text: str, path: Path, change: Callable[[dict], None], cut: Callable[[yaml.Node | None], str]) -> str:
    """The text that reads as the changed data, by the gentlest way."""
    wanted = plain_scene(text)
    try:
        change(wanted)
    except (KeyError, IndexError):
        raise InputRejected(f"there is no '{'.'.join(map(str, path))}' in scene.yaml") from None
    if _reads_as(text, wanted):
        return text
    root = composed(text)
    ways: tuple[Callable[[], str], ...] = (
        lambda: cut(root),
        lambda: _section_anew(text, root, str(path[0]), wanted),
        lambda: _all_anew(text, wanted),
    )
    for way in ways:
        try:
            found = way()
        except _NotHere:
            continue
        if _reads_as(found, wanted):
            return found
    raise InputRejected(f"'{'.'.join(map(str, path))}' cannot be written as YAML", "plain names, numbers and lists")


def _reads_as(text: str, wanted: dict[str, Any]) -> bool:
    try:
        return repr(plain_scene(text)) == repr(wanted)  # 1, 1.0 and true are equal, and not the same
    except InputRejected:
        return False


class _NotHere(Exception):
    """The text is not of the form that this way of changing it knows."""


def _set(text: str, root: yaml.Node | None, path: Path, value: Any) -> str:
    """The value at the deepest node of the path that is there."""
    node, depth = root, 0
    while depth < len(path):
        child = _child(node, path[depth])
        if child is None:
            break
        node, depth = child, depth + 1
    if depth < len(path):
        for part in reversed(path[depth + 1 :]):
            value = {part: value}
        if depth and (not isinstance(node, yaml.MappingNode) or not node.value):  # `parameters: {}`, or nothing
            return _replaced(text, root, path[:depth], {path[depth]: value})
        return _inserted(text, node, str(path[depth]), value)
    return _replaced(text, root, path, value)


def _append(text: str, root: yaml.Node | None, path: Path, item: Any) -> str:
    node = _at(root, path)
    if node is None or not isinstance(node, yaml.SequenceNode) or not node.value:
        return _set(text, root, path, [item])
    end = _end(text, node.value[-1])
    if node.flow_style:
        return text[:end] + ", " + one_line(item) + text[end:]
    return _line_after(text, end, " " * node.start_mark.column + "- " + one_line(item))


def _remove(text: str, root: yaml.Node | None, path: Path) -> str:
    parent, node = _at(root, path[:-1]), _at(root, path)
    if not isinstance(parent, yaml.CollectionNode) or node is None:
        raise _NotHere
    if len(parent.value) == 1 and len(path) > 1:
        empty = None if len(path) == 2 else {} if isinstance(parent, yaml.MappingNode) else []
        return _replaced(text, root, path[:-1], empty)
    spans = [(k.start_mark.index, _end(text, v)) for k, v in _pairs(parent)]
    number = next(i for i, (_, v) in enumerate(_pairs(parent)) if v is node)
    start, end = spans[number]
    if parent.flow_style:
        if number + 1 < len(spans):
            return text[:start] + text[spans[number + 1][0] :]
        return text[: spans[number - 1][1]] + text[end:]
    line = text.rfind("\n", 0, start) + 1
    if text[line:start].strip() in ("", "-" if isinstance(parent, yaml.SequenceNode) else ""):
        return text[:line] + text[_line_end(text, end) :].removeprefix("\r").removeprefix("\n")
    if number + 1 == len(spans):
        raise _NotHere
    return text[:start] + text[spans[number + 1][0] :]


def _replaced(text: str, root: yaml.Node | None, path: Path, value: Any) -> str:
    parent, node = _at(root, path[:-1]), _at(root, path)
    if parent is None or node is None:
        raise _NotHere
    start, end = node.start_mark.index, _end(text, node)
    if not isinstance(parent, yaml.MappingNode) or parent.flow_style:
        return text[:start] + " " * (start == end) + one_line(value) + text[end:]
    key = next(k for k, v in _pairs(parent) if v is node)
    between = text[key.end_mark.index : start]
    colon = key.end_mark.index + between.find(":") + 1
    new = _pretty(value, parent.start_mark.column + _INDENT, _newline(text))
    if value is None and len(path) == 1 and ":" in between:
        return text[:start].rstrip() + text[end:]
    if "#" in between or ":" not in between:
        return text[:start] + one_line(value) + text[end:]
    if new.startswith(("\n", "\r")):  # what stands behind the old value on its line goes with the name: a comment
        rest = text[end : _line_end(text, end)]
        return text[:colon] + rest + new + text[end + len(rest) :]
    return text[:colon] + new + text[end:]


def _inserted(text: str, node: yaml.Node | None, name: str, value: Any) -> str:
    """One more name at the end of a mapping, or of the file."""
    new = one_line(name) + ":"
    if node is None or node.start_mark.index == 0 or node.start_mark.column == 0:
        if node is not None and (not isinstance(node, yaml.MappingNode) or node.flow_style):
            raise _NotHere
        end = "" if not text or text.endswith("\n") else _newline(text)
        return text + end + new + _pretty(value, _INDENT, _newline(text)) + _newline(text)
    if not isinstance(node, yaml.MappingNode) or not node.value:
        raise _NotHere
    end = _end(text, node.value[-1][1])
    if node.flow_style:
        return text[:end] + ", " + new + " " + one_line(value) + text[end:]
    column = node.start_mark.column
    return _line_after(text, end, " " * column + new + _pretty(value, column + _INDENT, _newline(text)))


def _section_anew(text: str, root: yaml.Node | None, name: str, wanted: dict[str, Any]) -> str:
    """Only this section written anew, at its place."""
    if not isinstance(root, yaml.MappingNode) or root.flow_style:
        raise _NotHere
    new = "" if name not in wanted else one_line(name) + ":" + _pretty(wanted[name], _INDENT, _newline(text))
    for key, value in _pairs(root):
        if key.value == name:
            return text[: key.start_mark.index] + new + text[_end(text, value) :]
    return text + ("" if text.endswith("\n") else _newline(text)) + new + _newline(text)


def _all_anew(text: str, wanted: dict[str, Any]) -> str:
    """The whole file written anew, under the comments that it began with."""
    head = []
    for line in text.removeprefix("\ufeff").split("\n"):
        if line.strip() and not line.lstrip().startswith("#"):
            break
        head.append(line)
    body = "".join(f"{one_line(k)}:{_pretty(v, _INDENT, chr(10))}\n" for k, v in wanted.items())
    return "\n".join(head) + ("\n" if head and head[-1] else "") + body


def _pairs(node: yaml.Node) -> Iterator[tuple[yaml.Node, yaml.Node]]:
    """Keys and values; of a list each item twice."""
    for entry in node.value:
        yield entry if isinstance(entry, tuple) else (entry, entry)


def _child(node: yaml.Node | None, part: str | int) -> yaml.Node | None:
    if isinstance(node, yaml.MappingNode):
        return next((v for k, v in node.value if isinstance(k, yaml.ScalarNode) and k.value == str(part)), None)
    if isinstance(node, yaml.SequenceNode) and isinstance(part, int) and 0 <= part < len(node.value):
        return node.value[part]
    return None


def _at(root: yaml.Node | None, path: Path) -> yaml.Node | None:
    for part in path:
        root = _child(root, part)
    return root


def _end(text: str, node: yaml.Node) -> int:
    """Behind the node's last character; a block ends with its last entry, not with the comments that follow."""
    if isinstance(node, yaml.CollectionNode) and not node.flow_style and node.value:
        return _end(text, list(_pairs(node))[-1][1])
    start, end = node.start_mark.index, node.end_mark.index
    return start + len(text[start:end].rstrip())


def _line_end(text: str, at: int) -> int:
    """Before the line break that follows."""
    end = text.find("\n", at)
    end = len(text) if end < 0 else end
    return end - (end > at and text[end - 1] == "\r")


def _line_after(text: str, at: int, line: str) -> str:
    end = _line_end(text, at)
    return text[:end] + _newline(text) + line + text[end:]


def _newline(text: str) -> str:
    return "\r\n" if "\r\n" in text else "\n"


def one_line(value: Any) -> str:
    """On one line."""
    dumped = yaml.safe_dump(
        value, default_flow_style=True, sort_keys=False, allow_unicode=True, width=float("inf")
    )  # fmt: skip
    return dumped.removesuffix("...\n").strip()


def _pretty(value: Any, indent: int, newline: str) -> str:
    """Behind a colon: one line for each entry of a mapping and each mapping of a list, else on the same line."""
    if isinstance(value, dict) and value:
        lines = [f"{one_line(k)}: {one_line(v)}" for k, v in value.items()]
    elif isinstance(value, list) and value and all(isinstance(v, dict) for v in value):
        lines = [f"- {one_line(v)}" for v in value]
    else:
        return " " + one_line(value)
    return "".join(newline + " " * indent + line for line in lines)
