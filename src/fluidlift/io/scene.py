"""scene.yaml: the one file of an asset that a person edits."""

from __future__ import annotations

import copy
import re
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import yaml

from fluidlift.errors import InputRejected
from fluidlift.io.asset_paths import asset_file
from fluidlift.io.entries import Entries, line_numbers
from fluidlift.io.limits import require_file, require_size
from fluidlift.io.scene_look import Look, read_look
from fluidlift.io.yaml_reader import MAX_BYTES, parse_yaml
from fluidlift.physics.inflow_schedule import InflowSchedule
from fluidlift.types.parameter_table import PARAMETERS

if TYPE_CHECKING:  # what bodies and meshes need is loaded where a scene has some: reading a text takes no second
    from fluidlift.io.obstacles import Obstacle
    from fluidlift.physics.emitter import Emitter
    from fluidlift.physics.terrain_edit import TerrainEdit

SCENE_TEMPLATE = """\
# What to change when this fluid is simulated again. SI units, z up.
# Remove a '#', and nothing else, to use a line.

parameters:
#  density: 1000            # kg/m^3
#  kinematic_viscosity: 1e-6  # m^2/s
#  surface_tension: 0.072   # N/m; matters to drops and thin jets
#  gravity: [0, 0, -9.81]   # m/s^2
#  inflow_velocity: [1, 0, 0]  # m/s

obstacles:
#  - {shape: sphere, position: [0, 0, 0.2], radius: 0.1}                    # m; stands still
#  - {mesh: rock.obj, position: [0.5, 0, 0], rotation: [0, 0, 90], scale: 0.1}  # a file in this folder; degrees
#  - {shape: box, position: [0, 0, 0.3], size: [0.2, 0.2, 0.1], motion: free, density: 400}  # kg/m^3; floats

emitters:
#  - {shape: cylinder, radius: 0.05, height: 0.02, position: [0, 0, 1], velocity: [0, 0, -1], end: 2.5}  # m, m/s, s

terrain:
#  - {move: [0, 0, 0.1]}    # m
#  - {twist: 20}            # degrees per metre along the stream; also rotate (degrees), scale, mesh (a file)

inflow:
#  factor: 1.5              # times the inflow's velocity
#  fluctuation: 0.1         # share by which it comes and goes; with period: 1.0, in s

look:
#  style: surface           # splats, relit, transparent or surface
#  material: honey          # source, water, muddy_water, honey, lava, milk, oil or chocolate
#  environment: studio      # sky, studio, white, or an .hdr or .exr file in this folder

#duration: 4.0   # s
#extend_downstream: 2.0   # m by which the channel of a stream or a fall goes on
#loop: true   # the last frame leads into the first
"""


@dataclass(frozen=True)
class SceneEdits:
    """What a person changed for the next simulation."""

    parameters: dict[str, Any] = field(default_factory=dict)
    """values by the names of `FluidParameters`"""
    duration: float | None = None
    """s"""
    extend_downstream: float = 0.0
    """m"""
    obstacles: tuple[Obstacle, ...] = ()
    emitters: tuple[Emitter, ...] = ()
    terrain: tuple[TerrainEdit, ...] = ()
    """in the order in which they are done"""
    inflow: InflowSchedule = field(default_factory=InflowSchedule)
    look: Look = field(default_factory=Look)
    loop: bool = False
    """the last frame leads into the first"""
    whitewater: float = 0.0
    """times as much white water as the clip shows, 0 to `MOST_WHITEWATER`"""
    whitewater_everywhere: bool = False
    """also where the clip shows it, and not only where edits make more of it"""
    waves: float = 0.0
    """times as high as the clip shows them, 0 to `MOST_WAVES`, on meshes and in the looks transparent and surface"""


SECTIONS = (
    "parameters", "obstacles", "emitters", "terrain", "inflow", "look", "whitewater", "waves", "duration",
    "extend_downstream", "loop",
)  # fmt: skip

MOST_WHITEWATER = 100.0
"""times what the clip shows: more hides the water altogether"""
MOST_WAVES = 100.0
"""times as high as the clip shows them: most break before"""

NAMES = {
    "parameters": tuple(PARAMETERS), "look": tuple(Look().to_dict()),
    "inflow": ("factor", "keyframes", "fluctuation", "period"), "whitewater": ("amount", "everywhere"),
    "waves": ("amount",),
}  # fmt: skip
"""what can stand in the sections whose entries have names of their own"""


def home_of(name: Any) -> str:
    """Where a name that stands in a wrong place belongs, in words; "" where it is known nowhere."""
    sections = [section for section, names in NAMES.items() if name in names]
    return f"write it under {' or '.join(sections)}" if sections else "write it at the left margin" * (name in SECTIONS)


def read_edits(folder: Path | str, *, meshes: Path | None = None) -> SceneEdits:
    """What an asset's scene.yaml changes, checked.

    Args:
        folder: of the asset.
        meshes: folder of the mesh files of obstacles, emitters and terrain; None: the asset.

    Raises:
        InputRejected: as `read_scene`, and entries that are unknown or out of range (nothing is ignored in silence);
            the message names the line and the nearest valid name.
    """
    return edits_of(scene_text(folder), folder, meshes=meshes)


def edits_of(text: str, folder: Path | str, *, meshes: Path | None = None) -> SceneEdits:
    """What a text changes, were it the scene.yaml of an asset.

    Raises:
        InputRejected: as `read_edits`.
    """
    scene = Entries(plain_scene(text), "the scene", file="scene.yaml", lines=line_numbers(text))
    scene.only(SECTIONS, {n: home_of(n) for n in scene.data})
    place = Path(folder) if meshes is None else meshes
    return SceneEdits(
        _parameters(scene.part("parameters", "parameters")),
        scene.number("duration", None, low=1e-6, high=1e9, unit="s") if scene.given("duration") else None,
        scene.number("extend_downstream", 0.0, low=0.0, high=1e6, unit="m"),
        _obstacles(scene, place),
        _emitters(scene, place),
        _terrain(scene, place),
        _inflow(scene),
        read_look(scene, Path(folder)),
        scene.flag("loop", False),
        *_whitewater(scene.part("whitewater", "whitewater")),
        _waves(scene.part("waves", "waves")),
    )


def _whitewater(given: Entries) -> tuple[float, bool]:
    given.only(NAMES["whitewater"])
    amount = given.number("amount", 0.0, low=0.0, high=MOST_WHITEWATER, unit="times what the clip shows")
    return amount, given.flag("everywhere", False)


def _waves(given: Entries) -> float:
    given.only(NAMES["waves"])
    return given.number("amount", 0.0, low=0.0, high=MOST_WAVES, unit="times as high as the clip shows them")


def _obstacles(scene: Entries, meshes: Path) -> tuple[Obstacle, ...]:
    if scene.data.get("obstacles") is None:
        return ()
    from fluidlift.io.obstacles import read_obstacles

    return read_obstacles(scene, meshes)


def _emitters(scene: Entries, meshes: Path) -> tuple[Emitter, ...]:
    if scene.data.get("emitters") is None:
        return ()
    from fluidlift.io.scene_emitters import read_emitters

    return read_emitters(scene, meshes)


def _terrain(scene: Entries, meshes: Path) -> tuple[TerrainEdit, ...]:
    if scene.data.get("terrain") is None:
        return ()
    from fluidlift.io.scene_terrain import read_terrain

    return read_terrain(scene, meshes)


def _inflow(scene: Entries) -> InflowSchedule:
    if scene.data.get("inflow") is None:
        return InflowSchedule()
    from fluidlift.io.scene_emitters import read_inflow

    return read_inflow(scene)


def _parameters(changes: Entries) -> dict[str, Any]:
    """Those that are given: numbers, and tuples of three."""
    changes.only(PARAMETERS, {n: home_of(n) for n in changes.data})
    found: dict[str, Any] = {}
    for name in changes.data:
        known, (low, high) = PARAMETERS[name], PARAMETERS[name].limits
        if known.is_vector:
            found[name] = changes.vector(name, None, limit=high, unit=known.unit, example=known.example)
        else:
            found[name] = changes.number(name, None, low=low, high=high, unit=known.unit)
    return found


def read_scene(folder: Path | str) -> dict[str, Any]:
    """The content of an asset's scene.yaml, nothing where there is no such file; a section without entries is empty.

    Raises:
        InputRejected: a link, a file of more than a megabyte, or broken YAML.
    """
    scene = plain_scene(scene_text(folder))
    empty = {name: {} for name in NAMES} | {name: [] for name in ("obstacles", "emitters", "terrain")}
    return {name: empty.get(name) if value is None else value for name, value in scene.items()}


def scene_text(folder: Path | str) -> str:
    """The text of an asset's scene.yaml, its line ends as they are; "" where there is no such file.

    Raises:
        InputRejected: a link, a file of more than a megabyte, or one that is no text.
    """
    path = asset_file(folder, "scene.yaml")
    if not path.exists() or (path.is_file() and path.stat().st_size == 0):
        return ""
    require_size(require_file(path, "scene file"), MAX_BYTES, "scene file")
    try:
        return path.read_bytes().decode("utf-8")
    except UnicodeDecodeError as error:
        raise InputRejected(f"scene.yaml is not text ({error})", "UTF-8") from None


@lru_cache(maxsize=4)
def _parsed(text: str) -> Any:
    """`parse_yaml`, once for each of the last texts: an edit looks at the same one many times."""
    return parse_yaml(text)


def _mending(error: BaseException, text: str) -> str:
    """What to do about a text that is no YAML."""
    why, mark = str(getattr(error, "problem", "") or ""), getattr(error, "problem_mark", None)
    lines = text.splitlines()
    line = lines[mark.line] if mark is not None and mark.line < len(lines) else ""
    if "'\\t'" in why or "\t" in line[: len(line) - len(line.lstrip())]:
        return "indent with spaces: YAML takes no tabs"
    opened = getattr(error, "context_mark", None)
    context = str(getattr(error, "context", ""))
    if opened is not None and "flow" in context:
        pair = "[]" if "sequence" in context else "{}"
        return f"close the '{pair[0]}' of line {opened.line + 1} with a '{pair[1]}'"
    above = [x for x in lines[: mark.line if mark is not None else 0] if x.strip() and not x.lstrip().startswith("#")]
    empty = re.match(r"(\w+): *(\{\}|\[\])", above[-1]) if above else None
    if empty is not None and line[:1] in " -":
        return f"write '{empty[1]}:' without the {empty[2]}: entries follow it"
    if mark is None or "twice" in why:
        return ""
    return "check this line and the one above it: the entries of a section begin in the same column"


def plain_scene(text: str) -> dict[str, Any]:
    """The sections of a scene.yaml's text, not checked.

    Raises:
        InputRejected: broken YAML, or no sections.
    """
    try:
        data = copy.deepcopy(_parsed(text))
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        place = "scene.yaml" if mark is None else f"scene.yaml, line {mark.line + 1}"
        why = getattr(error, "problem", None) or error
        got = f"{place}: not valid YAML ({' '.join(str(why).split())[:200]})"
        raise InputRejected(got, "YAML", _mending(error, text)) from None
    if data is None:
        return {}
    if not isinstance(data, dict):
        kind = "a list" if isinstance(data, list) else f"{str(data)[:40]!r}"
        raise InputRejected(
            f"scene.yaml is {kind}, where sections with names should stand", "one of " + ", ".join(SECTIONS),
            "write each name with a colon at the left margin, and its entries below it",
        )  # fmt: skip
    return data
