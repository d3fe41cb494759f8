"""What is parsed, edited and simulated: an asset with its scene.yaml becomes a scene and its simulator.

Modules of the face:

    build               What is simulated: an asset's body in its terrain, with what a person changed
    coarse_copy         An asset on wider cells and with fewer Gaussians, for a simulation that follows a hand
    edit_history        The history of an asset's scene.yaml: every edit as the lines it took away and put in,
                        undone or not
    edits               Edits of an asset: one model behind scene.yaml, the command line, Python and the viewer
    filmed_cells        Cells in which the clip shows no fluid at any time, and those in which it shows some at all
                        times
    filmed_inlet        Where an inlet stood in each frame of a clip: what pours out of a jug comes from where a
                        hand holds that
    filmed_numbers      What a film says of its foam and waves, as numbers with intervals, for the parameters of an
                        asset
    footage             The clip that an asset comes from, where it is still at hand
    force_weight        How far a scene keeps the force that holds the filmed flow: where a person changed it, the
                        flow finds its own way
    forecast            What the next simulation will meet, said when an edit is made: from the files alone, without
                        building the scene
    open_water          Where on a fluid there is room for something new: not in the ground, the inlet, or what was
                        put there before
    recall              Values of an asset's earlier runs, where they are still in its folder work/
    reshaping           Edits of the world around a fluid, before it is simulated: terrain, emitters, and what was
                        changed in words
    simulated_history   Figures of each simulated frame, as they come
    simulation          A scene played frame by frame, with a checkpoint every few frames that another run goes on
                        from
    simulator           The simulator of a scene, at its first instant
    smoke_appearance    What the splats of simulated smoke look like in each frame: as thin as its film shows it, or
                        as it was carried
    splat_files         Where an asset keeps the frames of its simulation, and what goes on from them
    surface_appearance  What the splats of a simulated fluid look like in each frame
    waves               Waves of a scene: what its film says of them, and how they are played on its simulated
                        surface
    whitewater          The white water of a scene: how much of it its clip asks for, and its splats, frame by frame
    whitewater_law      How much white water a flow makes for the foam of its film: three limits and a rate, with
                        how sure each is
"""

from importlib import import_module as _import_module
from typing import TYPE_CHECKING as _TYPE_CHECKING
from typing import Any as _Any

if _TYPE_CHECKING:
    from fluidlift.scene.build import Scene, SimulationRequest, edited_scene, scene_of
    from fluidlift.scene.edits import Add, Change, EditSession, Remove, Set
    from fluidlift.scene.simulator import simulator_of

_FACE = {
    "build": ("Scene", "SimulationRequest", "edited_scene", "scene_of"),
    "edits": ("Add", "Change", "EditSession", "Remove", "Set"),
    "simulator": ("simulator_of",),
}
"""names by module: each is imported when it is first used, since an edit of a text needs no simulator"""
_HOMES = {name: module for module, names in _FACE.items() for name in names}


def __getattr__(name: str) -> _Any:
    """A name of the face, imported now."""
    if name not in _HOMES:
        raise AttributeError(f"module '{__name__}' has no attribute '{name}'")
    return getattr(_import_module(f"{__name__}.{_HOMES[name]}"), name)


__all__ = [
    "Add", "Change", "EditSession", "Remove", "Scene", "Set", "SimulationRequest", "build", "coarse_copy",
    "edit_history", "edited_scene", "edits", "filmed_cells", "filmed_inlet", "filmed_numbers", "footage",
    "force_weight", "forecast", "open_water", "recall", "reshaping", "scene_of", "simulated_history", "simulation",
    "simulator", "simulator_of", "smoke_appearance", "splat_files", "surface_appearance", "waves", "whitewater",
    "whitewater_law",
]  # fmt: skip
