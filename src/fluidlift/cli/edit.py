"""The command `edit`: change an asset's scene.yaml, undo, redo, look at what changed."""

from __future__ import annotations

import json as json_module
from dataclasses import field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from fluidlift.cli import quantities
from fluidlift.errors import FluidliftError, InputRejected
from fluidlift.messages import as_plain, from_plain

if TYPE_CHECKING:
    from fluidlift.messages import Notice
    from fluidlift.scene.edit_history import EditRecord as Done
    from fluidlift.scene.edits import Change, EditSession

_DONE, _WITH_WARNINGS = 0, 4


@quantities.command
class Edit:
    """Change a finished asset: parameters, inflow, terrain, obstacles, emitters, look. Every edit can be undone."""

    asset: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="ASSET")]
    """asset folder; without further options its edits are shown"""
    material: Literal["source", "water", "muddy_water", "honey", "lava", "milk", "oil", "chocolate"] | None = None
    """make it that liquid: density, viscosity and look; --set look.material=honey changes the look alone"""
    remove: tyro.conf.UseAppendAction[tuple[str, ...]] = field(default_factory=tuple)
    """take something away, such as --remove obstacles.sphere1; may be repeated"""
    add: tyro.conf.UseAppendAction[tuple[str, ...]] = field(default_factory=tuple)
    """one more of obstacles, emitters or terrain, such as --add obstacles='{shape: sphere, radius: 0.1}'; may be
    repeated"""
    set: tyro.conf.UseAppendAction[tuple[str, ...]] = field(default_factory=tuple)
    """another value, such as --set parameters.kinematic_viscosity=1e-3; may be repeated: all are one edit"""
    undo: bool = False
    """take the last edit back"""
    redo: bool = False
    """bring back what was undone last"""
    reset: bool = False
    """back to the fluid as lifted; this can be undone as well"""
    diff: bool = False
    """show what differs from the fluid as lifted"""
    history: bool = False
    """list all edits"""
    meshes: Path | None = None
    """folder of the mesh files that scene.yaml names; by default the asset"""
    simulate: bool = False
    """then do what the edit makes necessary: simulate, or only draw again"""
    json: bool = False
    """print the outcome as JSON"""


def run(command: Edit) -> int:
    """Do what the command says; the exit code.

    Raises:
        InputRejected: an edit that does not fit; nothing was changed.
        FluidliftError: the simulation after the edit broke down; the edit stands.
    """
    from fluidlift.scene.edits import EditSession

    session = EditSession.open(command.asset, meshes=command.meshes)
    wanted, look = _wanted(command), _look(session)
    edit = _done(session, command) if wanted else None
    if edit is not None and not command.json:  # before a simulation takes its time
        print(f"{edit.what}\n{edit.diff()}", end="", flush=True)
    if command.simulate:
        _simulate(session, command)
    told = _outcome(session, command, edit)
    if told["warnings"] and (edit is None or _look(session) == look):  # said once, of the edit that does it
        idle = session.edits.look.warning()
        told |= as_plain(w for w in from_plain(told) if w != idle)
    if command.json:
        print(json_module.dumps(told, indent=1))
    else:
        print("\n".join(_lines(session, command, told, bool(wanted) and edit is None)))
    return _WITH_WARNINGS if told["warnings"] else _DONE


def changes_of(session: EditSession, command: Edit) -> list[Change]:
    """What `--material`, `--remove`, `--add` and `--set` ask for, in this order.

    Raises:
        InputRejected: an option that is not of the form path=value, or a value that is no YAML.
    """
    from fluidlift.scene.edits import Add, Remove, Set

    changes: list[Change] = [] if command.material is None else session.made_of(command.material)
    changes += [Remove(path) for path in command.remove]
    for text in command.add:
        section, value = _pair(text, "--add", "obstacles='{shape: sphere, radius: 0.1}'")
        changes.append(Add(section, value))
    for text in command.set:
        place, value = _pair(text, "--set", "parameters.gravity='[0, 0, -9.81]'")
        changes.append(Set(place, _with_unit(session, changes, place, value) if isinstance(value, str) else value))
    return changes


def _with_unit(session: EditSession, before: list[Change], place: str, value: str) -> Any:
    """A parameter that is written with its unit, such as "2 cSt" or "5 Pa s", in the unit of scene.yaml."""
    from fluidlift.scene.edits import Set
    from fluidlift.types.parameter_table import PARAMETERS
    from fluidlift.types.quantity import DYNAMIC, parameter

    row = PARAMETERS.get(place.removeprefix("parameters."))
    if row is None or not place.startswith("parameters.") or row.is_vector:
        return value
    density = None
    if value.lstrip("+-.0123456789eE ").strip() in DYNAMIC:
        told = [c.value for c in before if isinstance(c, Set) and c.path == "parameters.density"]
        density = told[-1] if told and told[-1] else session.density
    try:
        return parameter(value, row.unit, density=density)
    except ValueError as error:
        raise InputRejected(f"--set {place}: {error}", f"a number of {row.sign or 'no unit'}") from None


def _wanted(command: Edit) -> str:
    """Which kind of edit is asked for; "" for none."""
    changes = bool(command.material or command.remove or command.add or command.set)
    asked = [n for n in ("undo", "redo", "reset") if getattr(command, n)] + ["changes"] * changes
    if len(asked) > 1:
        options = " and ".join("--material, --remove, --add or --set" if n == "changes" else f"--{n}" for n in asked)
        raise InputRejected(f"{options} at once", "one of them", "use one command for each")
    return asked[0] if asked else ""


def _done(session: EditSession, command: Edit) -> Done | None:
    if command.undo:
        return session.undo()
    if command.redo:
        return session.redo()
    return session.reset() if command.reset else session.apply(changes_of(session, command))


def _pair(text: str, option: str, example: str) -> tuple[str, Any]:
    """The place and the YAML value of `place=value`."""
    import yaml

    from fluidlift.io.yaml_reader import parse_yaml

    place, mark, value = text.partition("=")
    if not mark or not place.strip():
        raise InputRejected(f"{option} {text}", f"place=value, such as {option} {example}")
    try:
        return place.strip(), parse_yaml(value)
    except yaml.YAMLError as error:
        why = getattr(error, "problem", None) or error
        raise InputRejected(
            f"{option} {text}: '{value}' is no value ({why})", "a number, a text, [a list] or {name: value}",
            f"put it into quotes for the shell: {option} {example}",
        ) from None  # fmt: skip


def _simulate(session: EditSession, command: Edit) -> None:
    from fluidlift.pipeline import resimulate
    from fluidlift.progress import shown_progress
    from fluidlift.scene import SimulationRequest

    try:
        with shown_progress() as progress:
            resimulate(session.folder, request=SimulationRequest(meshes=command.meshes), progress=progress)
    except FluidliftError as error:  # most likely by the last edit
        done = [e for e in session.history() if not e.undone]
        if not done:
            raise
        undo = f"fluidlift edit {_quoted(session.folder)} --undo"
        raise type(error)(f"{error} The last edit was: {done[-1].what}. It stands; to take it back: {undo}") from None


def _outcome(session: EditSession, command: Edit, edit: Done | None) -> dict[str, Any]:
    """All that is to be told, as plain values."""
    stale, warnings = _standing(session, command)
    told = {
        "asset": str(session.folder),
        "edit": None if edit is None else edit.to_dict(),
        "stale": None if stale is None else sorted(stale),
        **as_plain(warnings),
        "can_undo": session.can_undo,
        "can_redo": session.can_redo,
        "scene": session.scene,
    }
    if command.diff:
        told["diff"] = session.diff()
    if command.history:
        told["history"] = [e.to_dict() | {"undone": e.undone} for e in session.history()]
    return told


def _standing(session: EditSession, command: Edit) -> tuple[set[str] | None, list[Notice]]:
    """What the frames do not show, and what is odd. What is only looked at, or was there before, is not built for that:
    None where the answer is not in memory."""
    shown = command.diff or command.history or command.undo or command.redo
    asks = command.simulate or command.reset or bool(command.material or command.remove or command.add or command.set)
    return (session.known_standing(), []) if shown and not asks else session.standing()


def _lines(session: EditSession, command: Edit, told: dict[str, Any], nothing: bool) -> list[str]:
    lines = ["nothing to change: scene.yaml says so already"] * nothing
    if command.history:
        edits = session.history()
        lines += [f"{n:4}  {e.time[:19]:19}  {e.what}{'  (undone)' * e.undone}" for n, e in enumerate(edits, start=1)]
        lines += ["no edits yet"] * (not edits)
    if command.diff or not (told["edit"] or nothing or command.history or command.simulate):
        lines.append(session.diff().rstrip("\n") or "nothing differs from the fluid as lifted")
    lines += [f"warning: {text}" for text in told["warnings"]]
    return lines + _next(session.folder, told["stale"], told["edit"])


def _next(folder: Path, stale: list[str] | None, edit: Any) -> list[str]:
    """What has become stale, by an edit or before it, and what to run."""
    if stale is None:
        return [f"whether the frames on disk show this scene: fluidlift edit {_quoted(folder)}"]
    if "simulate" in stale:
        other = "" if edit else ", or another version of fluidlift simulated them"
        return [f"the frames on disk show another scene{other}; next:", f"  fluidlift sim {_quoted(folder)}"]
    if "look" in stale:
        film = _quoted(Path(folder.stem + ".mp4"))
        return ["only the look is another one, and nothing has to be simulated again; next:",
                f"  fluidlift render {_quoted(folder)} -o {film}"]  # fmt: skip
    return ["the frames on disk show this scene"]


def _look(session: EditSession) -> Any:
    """The section look as it is now; None where scene.yaml is broken."""
    try:
        return session.scene.get("look") or None
    except InputRejected:
        return None


def _quoted(folder: Path) -> str:
    import shlex

    return shlex.quote(str(folder))
