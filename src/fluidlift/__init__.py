"""fluidlift: a fluid in a single-view video becomes an editable, simulation-ready 3D asset."""

import os as _os

# Thread pools of torch and Numba spin against each other on small machines, and Numba's TBB layer grows slower with
# every launch (so OpenMP comes first, and its absence is no error); all three are read when those packages are first
# imported, so they must be set before.
_os.environ.setdefault("NUMBA_THREADING_LAYER_PRIORITY", "omp workqueue tbb")
_os.environ.setdefault("OMP_WAIT_POLICY", "passive")
_os.environ.setdefault("GOMP_SPINCOUNT", "1000")

__version__ = "0.1.0"
