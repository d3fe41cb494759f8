"""What is installed and what this machine can do."""

from __future__ import annotations

import os
import platform
import shutil
import tempfile
from importlib import metadata
from importlib.util import find_spec

from fluidlift import __version__
from fluidlift.machine import available_memory, cores

CORE = ("numpy", "scipy", "numba", "torch", "av", "opencv-python-headless", "usd-core", "trimesh")
EXTRAS = {
    "viewer": ("viser", "pip install 'fluidlift[view]'"),
    "Mitsuba": ("mitsuba", "pip install 'fluidlift[mitsuba]'"),
    "gsplat": ("gsplat", "pip install 'fluidlift[gsplat]', with a GPU"),
    "Warp": ("warp", "pip install 'fluidlift[cuda]'"),
    "learned models": ("transformers", "pip install 'fluidlift[learned]'"),
    "paths of moving cameras": ("pycolmap", "pip install 'fluidlift[camera]'"),
    "data sets": ("pyarrow", "pip install 'fluidlift[dataset]'"),
    "splashsurf": ("pysplashsurf", "pip install pysplashsurf"),
}
"""what is not needed, by the module that it brings, and how to get it"""
PROGRAMS = {"FFmpeg": ("ffmpeg", "not needed: PyAV brings its own libraries"), "Blender": ("blender", "blender.org")}
"""programs of others, by the command that starts them"""


def examine() -> dict[str, str]:
    """Facts by name, for people and for bug reports. Holds no paths and no names."""
    found = {
        "fluidlift": __version__,
        "python": platform.python_version(),
        "system": f"{platform.system()} {platform.machine()}",
        "cores": str(cores()),
        "memory": f"{available_memory() / 1e9:.1f} GB free",
        "disk": f"{shutil.disk_usage(os.curdir).free / 1e9:.1f} GB free in this folder, "
        f"{shutil.disk_usage(tempfile.gettempdir()).free / 1e9:.1f} GB for temporary files",
    }
    for name in CORE:
        try:
            found[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            found[name] = "MISSING: pip install fluidlift again"
    for name, (module, remedy) in EXTRAS.items():
        found[name] = "installed" if find_spec(module) else f"not installed, an extra: {remedy}"
    for name, (program, remedy) in PROGRAMS.items():
        found[name] = "installed" if shutil.which(program) else f"not found ({remedy})"
    found["models in the cache"] = _models()
    found["GPU"] = _gpu()
    return found


def _models() -> str:
    from fluidlift.backends.model_cache import all_kept
    from fluidlift.backends.model_table import MODELS

    return ", ".join(f"{m.name} ({m.bytes / 1e6:.0f} MB)" for m in all_kept(MODELS)) or "none (fluidlift models)"


def _gpu() -> str:
    try:
        import torch
    except ImportError:
        return "unknown (torch is missing)"
    if torch.cuda.is_available():
        return torch.cuda.get_device_name(0)
    return "none seen; everything runs on the CPU"
