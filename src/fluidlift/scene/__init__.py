"""What is parsed, edited and simulated: an asset with its scene.yaml becomes a scene and its simulator."""

from fluidlift.scene.build import Scene, SimulationRequest, edited_scene, scene_of
from fluidlift.scene.edits import Add, Change, EditSession, Remove, Set
from fluidlift.scene.simulator import simulator_of

__all__ = [
    "Add",
    "Change",
    "EditSession",
    "Remove",
    "Scene",
    "Set",
    "SimulationRequest",
    "edited_scene",
    "scene_of",
    "simulator_of",
]
