"""How fine each preset is, and between which values a number has a meaning."""

from __future__ import annotations

from typing import Any

PRESETS: dict[str, dict[str, dict[str, Any]]] = {
    "draft": {},
    "standard": {
        "shape": {"cells": 96, "cell_limit": 300_000, "stride": 1, "refine_iterations": 100, "max_gaussians": 250_000},
        "motion": {"targets": 12, "complete_every": 3},
        "fit": {"max_work": 4e9, "max_seconds": 900.0},
        "simulate": {"max_particles": 300_000},
    },
    "hero": {
        "read": {"max_size": 768},
        "shape": {"cells": 128, "cell_limit": 900_000, "stride": 1, "refine_iterations": 300, "max_gaussians": 600_000},
        "motion": {"targets": 16, "complete_every": 2},
        "fit": {"max_work": 2e10, "max_seconds": 3600.0},
        "simulate": {"max_particles": 900_000},
        "show": {"width": 768},
    },
    # as fine as draft, by the paper's method (docs/paper_map.md says where it still differs)
    "paper": {
        "motion": {
            "method": "farneback", "half_window": 0, "reach": 0, "along_paths": False, "filling": "sum",
            "divergence": "paper", "constraint": "hard", "wall": "cubic",
        },
        "fit": {
            "method": "adam", "pressure": "recurrent", "advection_gradient": "upwind", "compare": "last",
            "start_rounds": 0, "free": ("all",), "max_seconds": 900.0,
        },
        "simulate": {"follow": 0.0, "skin": False},
    },
}  # fmt: skip

RANGES: dict[str, tuple[float, float]] = {
    "seed": (0, 2**63 - 1),
    "read.start": (0, 1e9),
    "read.duration": (1e-6, 1e9),
    "read.max_size": (16, 16384),
    "read.fps": (1e-3, 1e5),
    "read.max_pixels": (256, 1e12),
    "read.max_frames": (2, 1e9),
    "shape.fov": (2, 165),
    "shape.pitch": (-90, 90),
    "shape.roll": (-180, 180),
    "shape.size": (1e-4, 1e5),
    "shape.depth_ratio": (0.01, 10),
    "shape.cells": (4, 2048),
    "shape.cell_limit": (500, 1e9),
    "shape.stride": (1, 64),
    "shape.refine_iterations": (0, 1e6),
    "shape.max_gaussians": (100, 1e9),
    "shape.rays": (1, 1001),
    "shape.longest_union": (1, 1000),
    "depth.frames": (1, 1000),
    "depth.scale": (1e-9, 1e9),
    "depth.seconds": (0.01, 1e7),
    "view.frames": (1, 1000),
    "generate.frame_seconds": (0.01, 1e7),
    "motion.flow_scale": (-1e9, 1e9),
    "motion.half_window": (0, 50),
    "motion.reach": (0, 200),
    "motion.targets": (1, 1e6),
    "motion.complete_every": (1, 1e6),
    "fit.max_work": (0, 1e18),
    "fit.max_seconds": (0, 1e9),
    "fit.restarts": (0, 4),
    "fit.start_rounds": (0, 10),
    "simulate.frames": (1, 1e6),
    "simulate.max_particles": (100, 1e9),
    "simulate.follow": (0, 1),
    "simulate.guide": (0, 1),
    "simulate.checkpoint_every": (1, 1e6),
    "show.width": (16, 16384),
}
"""least and greatest value of each number that has a meaning: wider than what is wise"""
