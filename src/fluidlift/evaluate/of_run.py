"""The arrays of a run that are compared with a truth, from the values of its stages that are kept in the asset."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from fluidlift.evaluate.case import read_arrays
from fluidlift.io.asset_paths import asset_file
from fluidlift.io.kept_values import OF_CLIP, last_value, recalled
from fluidlift.types.stages import Shown, Simulation


def arrays_of_run(folder: Path, manifest: dict[str, Any]) -> dict[str, np.ndarray]:
    """What `evaluate_arrays` takes; nothing where the work folder is gone, or the frames have no counterparts in the
    clip.

    Args:
        folder: of the asset.
        manifest: of the asset.

    Raises:
        InputRejected: the file in which earlier versions kept these arrays is damaged.
    """
    stored = asset_file(folder, "work/evaluation.npz")
    if stored.is_file():
        return read_arrays(stored)
    of_clip = {name: recalled(folder, manifest, name) for name in OF_CLIP if name in _NEEDED}
    shown, simulation = last_value(folder, "show", Shown), last_value(folder, "simulate", Simulation)
    if shown is None or simulation is None or any(value is None for value in of_clip.values()):
        return {}
    if shown.pictures is None or shown.coverage is None or shown.flow is None:
        return {}
    g, m = of_clip["geometry"], of_clip["motion"]
    return {
        "labels": of_clip["segment"].labels.labels,
        "front_depth": g.sighted_depth * g.mask,
        "flow_raw": of_clip["flow"].flow.displacement,
        "flow_completed": m.completed,
        "flow_observed": m.observed().view(np.uint8),
        "resim_flow": shown.flow[:-1],
        "resim_mask": shown.coverage,
        "resim_frames": shown.pictures,
        "clip_frames": of_clip["read"].clip.frames,
        "first_frame": np.array(g.rest_frame, np.int64),
        "fit_frames": np.array([m.frames[0], m.frames[-1] + 1] if m.frames else [0, 0]),
        "particle_volume": simulation.volume,
        "leak_share": simulation.leak,
    }


_NEEDED = ("read", "flow", "segment", "geometry", "motion")
