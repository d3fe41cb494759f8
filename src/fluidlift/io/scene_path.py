"""Places in a scene by their names, as a person writes them: `parameters.gravity`, `obstacles.duck.position`."""

from __future__ import annotations

from typing import Any

from fluidlift.errors import InputRejected
from fluidlift.io.entries import TERRAIN_EDITS, nearest
from fluidlift.io.scene import NAMES, SECTIONS
from fluidlift.io.scene_text import Path

LISTS = ("obstacles", "emitters", "terrain")
PLAIN = ("duration", "extend_downstream", "loop")


def place_of(scene: dict[str, Any], dotted: str, *, new: bool = True) -> Path:
    """The path of a dotted name.

    An obstacle or emitter goes by its name, an edit of the terrain by its kind (`terrain.twist`) where there is one of
    it, anything in a list also by its number, from 1.

    Args:
        scene: as `read_scene` gives it.
        dotted: such as "look.material".
        new: the place may be one that is not there yet.

    Raises:
        InputRejected: a name that is not known, with the nearest one; or something that is not there.
    """
    section, _, rest = dotted.strip().partition(".")
    if section not in SECTIONS:
        known = [f"{s}.{n}" for s, names in NAMES.items() for n in names if n == section]
        do = f"write '{known[0]}'" if known else nearest(section, SECTIONS)
        raise InputRejected(
            f"there is no section '{section}'", "one of " + ", ".join(SECTIONS), do.replace("remove it", "")
        )  # fmt: skip
    if not rest:
        _require_there(scene, (section,), dotted, new)
        return (section,)
    if section in PLAIN:
        raise InputRejected(f"'{dotted}', but {section} has no entries of its own", f"{section}=value")
    if section in NAMES:
        known = NAMES[section]
        first = rest.partition(".")[0]
        if first not in known:
            do = nearest(first, known)
            do = f"write '{section}.{do[7:]}" if do.startswith("write '") else ""
            raise InputRejected(f"there is no '{first}' among {section}", "one of " + ", ".join(known), do)
        path: Path = (section, *_parts(rest))
    else:
        path = _in_list(scene.get(section) or [], section, rest, new=new)
    _require_there(scene, path, dotted, new)
    return path


def default_name(item: dict[str, Any], number: int) -> str:
    """The name of an obstacle or emitter that has none of its own; `number` counts from 1."""
    return f"{'mesh' if item.get('mesh') else item.get('shape')}{number}"


def names_of(items: list[Any]) -> list[str]:
    """The names of obstacles or emitters, given or not."""
    plain = [i if isinstance(i, dict) else {} for i in items]
    return [str(item.get("name") or default_name(item, n)) for n, item in enumerate(plain, start=1)]


def free_name(items: list[Any], item: dict[str, Any]) -> str:
    """A name for a new obstacle or emitter that no other one has."""
    taken, number = set(names_of(items)), len(items) + 1
    while default_name(item, number) in taken:
        number += 1
    return default_name(item, number)


def _in_list(items: list[Any], section: str, rest: str, *, new: bool) -> Path:
    words = rest.split(".")
    if section == "terrain" and words[0] in TERRAIN_EDITS:
        return _terrain(items, words, new=new)
    names = [] if section == "terrain" else names_of(items)
    for count in range(len(words), 0, -1):  # a name may have dots of its own
        if ".".join(words[:count]) in names:
            return (section, names.index(".".join(words[:count])), *_parts(".".join(words[count:])))
    if words[0].isdecimal() and 1 <= int(words[0]) <= len(items):
        return (section, int(words[0]) - 1, *_parts(".".join(words[1:])))
    known = names if section != "terrain" else [*TERRAIN_EDITS, *map(str, range(1, len(items) + 1))]
    do = f"add it: --add {section}='{{...}}'"
    if known:
        do = nearest(words[0], known)
        do = f"write '{section}.{do[7:]}" if do.startswith("write '") else ""
    raise InputRejected(f"there is no '{words[0]}' in {section}", ("one of " + ", ".join(known)) if known else "", do)


def _terrain(items: list[Any], words: list[str], *, new: bool) -> Path:
    """An edit of the terrain by its kind: that one where there is one, else a new one at the end."""
    kind = words[0]
    having = [i for i, item in enumerate(items) if isinstance(item, dict) and kind in item]
    if kind != "mesh":  # a mesh has a scale too, which is none of the terrain
        having = [i for i in having if "mesh" not in items[i]]
    if len(having) > 1:
        numbers = ", ".join(f"terrain.{i + 1}" for i in having)
        raise InputRejected(f"{len(having)} edits of the terrain are a {kind}", f"one of {numbers}")
    if not having and not new:
        raise InputRejected(f"there is no {kind} in terrain", "", "see what there is with --diff")
    where = having[0] if having else len(items)
    if len(words) == 1 and not new:
        return ("terrain", where)
    return ("terrain", where, *_parts(".".join(words)))


def _parts(text: str) -> Path:
    return tuple(text.split(".")) if text else ()


def _require_there(scene: dict[str, Any], path: Path, dotted: str, new: bool) -> None:
    data: Any = scene
    for part in path:
        try:
            data = data[part]
        except (KeyError, IndexError, TypeError):
            if new:
                return
            raise InputRejected(f"'{dotted}' is not in scene.yaml", "an entry that is there") from None
