"""fluidlift: a fluid in a single-view video becomes an editable, simulation-ready 3D asset.

The names of `__all__` are the public face; each is imported when it is first used, so that `import fluidlift` is quick.
"""

import os as _os
from importlib import import_module as _import_module
from typing import Any as _Any

# Thread pools of torch and Numba spin against each other on small machines, and Numba's TBB layer grows slower with
# every launch (so OpenMP comes first, and its absence is no error). OpenBLAS, under NumPy and SciPy, wakes its threads
# for the smallest product, and they spin for a while after it: turning 90 000 points 100 times takes 1.1 s of processor
# time with two of them and 0.4 s with one. All are read when those packages are first imported, so they must be set
# before.
_os.environ.setdefault("NUMBA_THREADING_LAYER_PRIORITY", "omp workqueue tbb")
_os.environ.setdefault("OMP_WAIT_POLICY", "passive")
_os.environ.setdefault("GOMP_SPINCOUNT", "1000")
_os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

__version__ = "0.1.0"

_FACE = {
    # from a clip to an asset, and on from there
    "scene": ("EditSession", "SimulationRequest"),
    "pipeline": ("Inputs", "RenderRequest", "find_masks", "make", "measure_motion", "refit", "render_asset",
                 "resimulate"),
    "export": ("ExportRequest", "export_asset"),
    "config": ("build_config",),
    "io.asset_folder": ("load_asset", "save_asset"),
    "validate": ("validate_asset",),
    "evaluate": ("evaluate_asset",),
    # motion
    "io.video": ("read_clip",),
    "motion.optical_flow": ("estimate_flow",),
    "motion.lift": ("lift_flow",),
    "motion.volume": ("volume_velocity",),
    # simulators, the differentiable rollout, the fit
    "physics.apic": ("LiquidSimulator", "SimulationSettings"),
    "physics.gas": ("GasSimulator",),
    "physics.pressure": ("build_system",),
    "physics.rollout_domain": ("prepare_domain",),
    "physics.rollout": ("RolloutParameters", "rollout"),
    "fit.optimize": ("FitOptions", "fit_parameters"),
    # splats
    "look.rasterize": ("render",),
    # values
    "types": ("CellType", "FaceVelocity", "FluidAsset", "FluidParameters", "Gaussians", "Grid", "Particles",
              "PinholeCamera", "Terrain", "TriangleMesh"),
}  # fmt: skip
_MODULE_OF = {name: f"fluidlift.{module}" for module, names in _FACE.items() for name in names}

__all__ = sorted(["__version__", *_MODULE_OF])


def __getattr__(name: str) -> _Any:
    """The name of the face, imported now (PEP 562).

    Raises:
        AttributeError: the face has no such name.
    """
    if name not in _MODULE_OF:
        raise AttributeError(f"module 'fluidlift' has no attribute '{name}'; it has {', '.join(__all__)}")
    value = globals()[name] = getattr(_import_module(_MODULE_OF[name]), name)
    return value


def __dir__() -> list[str]:
    """What is there already, and the face."""
    return sorted({*globals(), *__all__})
