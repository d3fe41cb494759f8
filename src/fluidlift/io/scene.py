"""scene.yaml: the one file of an asset that a person edits."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import yaml

from fluidlift.errors import InputRejected
from fluidlift.io.entries import Entries, line_numbers
from fluidlift.io.limits import require_file, require_size
from fluidlift.io.obstacles import Obstacle, read_obstacles
from fluidlift.types import FluidParameters

SCENE_TEMPLATE = """\
# What to change when this fluid is simulated again. SI units, z up. Remove a '#' to use a line.

parameters: {}
#  density: 1000            # kg/m^3
#  kinematic_viscosity: 1e-6  # m^2/s
#  surface_tension: 0.072   # N/m; matters to drops and thin jets
#  gravity: [0, 0, -9.81]   # m/s^2
#  inflow_velocity: [1, 0, 0]  # m/s

obstacles: []
#  - {shape: sphere, position: [0, 0, 0.2], radius: 0.1}                    # m; stands still
#  - {mesh: rock.obj, position: [0.5, 0, 0], rotation: [0, 0, 90], scale: 0.1}  # a file in this folder; degrees
#  - {shape: box, position: [0, 0, 1], size: [0.2, 0.2, 0.1], motion: free, density: 400}  # kg/m^3; floats

emitters: []
terrain: []
look: {}

# duration: 4.0   # s
# extend_downstream: 2.0   # m by which the channel of a stream or a fall goes on
"""

_MAX_BYTES = 2**20


class _PlainLoader(yaml.SafeLoader):
    """YAML without aliases: a few lines of nested ones can describe more data than any machine holds."""

    def compose_node(self, parent: Any, index: Any) -> Any:
        if self.check_event(yaml.AliasEvent):
            raise yaml.YAMLError("aliases (*name) are not used here")
        return super().compose_node(parent, index)


def parse_yaml(text: str) -> Any:
    """Plain data of a YAML text: no objects, no aliases. `1e-6` is a number, as everyone expects.

    Raises:
        yaml.YAMLError: broken YAML or an alias.
    """
    return _numbers(yaml.load(text, Loader=_PlainLoader))


def _numbers(data: Any) -> Any:
    """YAML 1.1 takes 1e-6 for a word, because it has no point."""
    if isinstance(data, dict):
        return {k: _numbers(v) for k, v in data.items()}
    if isinstance(data, list):
        return [_numbers(v) for v in data]
    if isinstance(data, str) and data[:1] in "+-.0123456789" and "e" in data.lower():
        try:
            return float(data)
        except ValueError:
            return data
    return data


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


SIMULATED = ("parameters", "obstacles", "duration", "extend_downstream")
_NOT_YET = ("emitters", "terrain", "look")


def read_edits(folder: Path | str, *, meshes: Path | None = None) -> SceneEdits:
    """What an asset's scene.yaml changes, checked.

    Args:
        folder: of the asset.
        meshes: folder of the obstacles' mesh files; None: the asset.

    Raises:
        InputRejected: as `read_scene`, and entries that are unknown, out of range, or beyond what this version
            simulates (nothing is ignored in silence); the message names the line and the nearest valid name.
    """
    text = _scene_text(Path(folder))
    scene = Entries(_plain_scene(text), "the scene", file="scene.yaml", lines=line_numbers(text))
    scene.only((*SIMULATED, *_NOT_YET))
    for name in _NOT_YET:
        if scene.data.get(name) not in (None, {}, [], ""):
            raise scene.wrong(
                name,
                f"{name}, which this version cannot simulate",
                ", ".join(SIMULATED),
                "remove the entry, or empty it",
            )
    changes = scene.part("parameters", "parameters")
    changes.only(asdict(FluidParameters()))
    duration = scene.number("duration", None, low=1e-6, high=1e9, unit="s") if scene.given("duration") else None
    try:
        FluidParameters().updated(changes.data)
    except InputRejected as error:
        raise scene.wrong("parameters", error.got, error.needed, error.do) from None
    return SceneEdits(
        changes.data,
        duration,
        scene.number("extend_downstream", 0.0, low=0.0, high=1e6, unit="m"),
        read_obstacles(scene, Path(folder) if meshes is None else meshes),
    )


def read_scene(folder: Path | str) -> dict[str, Any]:
    """The content of an asset's scene.yaml; empty where there is no such file.

    Raises:
        InputRejected: a link, a file of more than a megabyte, or broken YAML.
    """
    return _plain_scene(_scene_text(Path(folder)))


def _scene_text(folder: Path) -> str:
    path = folder / "scene.yaml"
    if path.is_symlink():
        raise InputRejected("scene.yaml is a link", "a plain file", "do not trust this asset")
    if not path.exists():
        return ""
    require_size(require_file(path, "scene file"), _MAX_BYTES, "scene file")
    try:
        return path.read_text(encoding="utf-8")
    except UnicodeDecodeError as error:
        raise InputRejected(f"scene.yaml is not text ({error})", "UTF-8") from None


def _plain_scene(text: str) -> dict[str, Any]:
    try:
        data = parse_yaml(text)
    except (yaml.YAMLError, RecursionError) as error:
        raise InputRejected(f"scene.yaml is not valid YAML ({' '.join(str(error).split())})", "YAML") from None
    if data is None:
        return {}
    if not isinstance(data, dict):
        raise InputRejected("scene.yaml holds no sections", "parameters, obstacles, emitters, ...")
    return data
