"""What is installed and what this machine can do."""

from __future__ import annotations

import os
import platform
from importlib import metadata

from fluidlift import __version__

CORE = ("numpy", "scipy", "numba", "torch", "av", "opencv-python-headless", "usd-core", "trimesh")


def examine() -> dict[str, str]:
    """Facts by name, for people and for bug reports. Holds no paths and no names."""
    found = {
        "fluidlift": __version__,
        "python": platform.python_version(),
        "system": f"{platform.system()} {platform.machine()}",
        "cores": str(os.cpu_count()),
    }
    for name in CORE:
        try:
            found[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            found[name] = "MISSING: pip install fluidlift again"
    found["GPU"] = _gpu()
    return found


def _gpu() -> str:
    try:
        import torch
    except ImportError:
        return "unknown (torch is missing)"
    if torch.cuda.is_available():
        return torch.cuda.get_device_name(0)
    return "none seen; everything runs on the CPU"
