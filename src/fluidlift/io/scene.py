"""scene.yaml: the one file of an asset that a person edits."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import yaml

from fluidlift.errors import InputRejected
from fluidlift.io.limits import require_file, require_size

SCENE_TEMPLATE = """\
# What to change when this fluid is simulated again. SI units, z up. Remove a '#' to use a line.

parameters: {}
#  density: 1000            # kg/m^3
#  kinematic_viscosity: 1e-6  # m^2/s
#  gravity: [0, 0, -9.81]   # m/s^2
#  inflow_velocity: [1, 0, 0]  # m/s

obstacles: []
#  - {shape: sphere, center: [0, 0, 0.2], radius: 0.1}           # m
#  - {shape: box, center: [0, 0, 0.2], size: [0.2, 0.2, 0.2]}    # m

emitters: []
terrain: []
look: {}

# duration: 4.0   # s
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


def read_scene(folder: Path | str) -> dict[str, Any]:
    """The content of an asset's scene.yaml; empty where there is no such file.

    Raises:
        InputRejected: a link, a file of more than a megabyte, or broken YAML.
    """
    path = Path(folder) / "scene.yaml"
    if path.is_symlink():
        raise InputRejected("scene.yaml is a link", "a plain file", "do not trust this asset")
    if not path.exists():
        return {}
    require_size(require_file(path, "scene file"), _MAX_BYTES, "scene file")
    try:
        data = parse_yaml(path.read_text(encoding="utf-8"))
    except (yaml.YAMLError, UnicodeDecodeError, RecursionError) as error:
        raise InputRejected(f"scene.yaml is not valid YAML ({' '.join(str(error).split())})", "YAML") from None
    if data is None:
        return {}
    if not isinstance(data, dict):
        raise InputRejected("scene.yaml holds no sections", "parameters, obstacles, emitters, ...")
    return data
