"""Runs a generator in another Python: a job folder in, a body and a camera per frame out. Started as a script.

    python generator_runner.py FOLDER PACKAGE            do the job in FOLDER
    python generator_runner.py --check PACKAGE NAME...   tell which of the Python packages NAME are there

PACKAGE is the folder of fluidlift. That Python need not have fluidlift: the adapter's module is imported from there,
and nothing else of the other environment comes with it. What is written here runs on Python 3.8, and says so where the
adapter needs a newer one.

The protocol, version 1. In: `job.json` with `protocol`, `generator`, `device`, `seed`, `weights` (path or null),
`allow_download`, `field_of_view` (degrees across the longer side, or null) and `frames`, a list of {`frame`, `image`,
`mask`} with PNG files of the folder (white is fluid). Out, for frame 7: `0007.ply`, a splat PLY with z up, and then
`0007.json`, its camera (width, height, K, R, t; x_cam = R x + t, of the whole picture, same size as the image). Last,
and whenever it likes before: `status.json` with `protocol`, `state` ("running", "done", "failed") and on failure
`kind` ("memory", "missing", "rejected", "failed") and `message`. Standard output and error are free for logs.
"""

from __future__ import annotations

import importlib
import importlib.util
import json
import os
import sys
import traceback
import types

PROTOCOL = 1


def main(arguments: list) -> int:
    """One job, or a check; the exit code is 0 where all went well."""
    # beside this script lie modules with the generators' names, which must not hide the generators
    here = os.path.realpath(os.path.dirname(os.path.abspath(__file__)))
    sys.path[:] = [p for p in sys.path if os.path.realpath(p or os.getcwd()) != here]
    if arguments[0] == "--check":
        print(json.dumps(checked(arguments[2:])))
        return 0
    folder, package = arguments
    try:
        with open(os.path.join(folder, "job.json"), encoding="utf-8") as file:
            job = json.load(file)
        if job.get("protocol") != PROTOCOL:
            raise ValueError(f"protocol {job.get('protocol')!r} instead of {PROTOCOL}")
        write_status(folder, "running")
        work(folder, package, job)
    except BaseException as error:  # whatever it is, the other side is to hear of it
        traceback.print_exc()
        write_status(folder, "failed", kind=kind_of(error), message=message_of(error))
        return 1
    write_status(folder, "done")
    return 0


def work(folder: str, package: str, job: dict) -> None:
    """Make every frame of a job."""
    if sys.version_info < (3, 10):  # noqa: UP036 - another Python than that of fluidlift
        raise ImportError("its Python is {}.{}, the adapters need 3.10 or newer".format(*sys.version_info))
    lend_package(package)
    from fluidlift.backends.generator_loading import RunChoice
    from fluidlift.backends.generators import generator_class
    from fluidlift.io.ply import write_gaussians

    names = ("device", "seed", "weights", "allow_download", "field_of_view")
    choice = RunChoice(isolated=True, announce=lambda line: None, **{k: job[k] for k in names})
    generator = generator_class(job["generator"])(choice)
    for item in job["frames"]:
        image, mask = picture(os.path.join(folder, item["image"])), picture(os.path.join(folder, item["mask"]))
        gaussians, camera = generator.generate(image, mask[..., 0] > 127, item["frame"])
        name = os.path.join(folder, f"{item['frame']:04d}")
        write_gaussians(name + ".ply", gaussians)
        write_json(name + ".json", camera.to_dict())


def picture(path: str):
    """uint8 [h, w, 3], sRGB."""
    import numpy as np
    from PIL import Image  # pyright: ignore[reportMissingImports]

    with Image.open(path) as image:
        return np.ascontiguousarray(image.convert("RGB"))


def lend_package(folder: str) -> None:
    """Make `import fluidlift` find `folder`, and nothing that lies beside it (it may be for another Python)."""
    if "fluidlift" in sys.modules:
        return
    try:
        importlib.import_module("jaxtyping")
    except ImportError:  # array shapes in annotations, which nothing evaluates
        stand_in = types.ModuleType("jaxtyping")
        names = ("Array", "Bool", "Float", "Float32", "Int", "Shaped", "UInt8", "Integer", "Num", "Real")
        for name in names:
            setattr(stand_in, name, type(name, (), {"__class_getitem__": classmethod(lambda cls, shape: cls)}))
        sys.modules["jaxtyping"] = stand_in
    found = importlib.util.spec_from_file_location(
        "fluidlift", os.path.join(folder, "__init__.py"), submodule_search_locations=[folder]
    )
    if found is None or found.loader is None:
        raise ImportError(f"no package in '{folder}'")
    module = importlib.util.module_from_spec(found)
    sys.modules["fluidlift"] = module
    found.loader.exec_module(module)


def checked(names: list) -> dict:
    """Version of Python, packages that are missing here, and the GPU that torch sees."""
    missing = []
    for name in names:
        try:
            known = importlib.util.find_spec(name) is not None
        except (ImportError, ValueError):
            known = False
        if not known:
            missing.append(name)
    gpu, why = None, "torch is not installed"
    try:
        import torch

        why = "torch sees none"
        if torch.cuda.is_available():
            total = torch.cuda.get_device_properties(0).total_memory
            gpu = f"{torch.cuda.get_device_name(0)}, {total / 2**30:.0f} GB"
    except Exception as error:  # a torch that does not start is a finding
        why = why if isinstance(error, ModuleNotFoundError) else f"torch does not start: {message_of(error)}"
    version = "{}.{}.{}".format(*sys.version_info)
    return {"protocol": PROTOCOL, "python": version, "missing": missing, "gpu": gpu, "no_gpu": "" if gpu else why}


def kind_of(error: BaseException) -> str:
    """What went wrong, in the words of the protocol."""
    text = str(error).lower()
    if isinstance(error, MemoryError) or "OutOfMemory" in type(error).__name__ or "out of memory" in text:
        return "memory"
    if "alloc" in text and "memory" in text:
        return "memory"
    names = {c.__name__ for c in type(error).__mro__}
    if isinstance(error, ImportError) or "MissingPackage" in names:
        return "missing"
    return "rejected" if "InputRejected" in names else "failed"


def message_of(error: BaseException) -> str:
    """One line."""
    text = " ".join(str(error).split())[:600]
    ours = any(c.__name__ == "FluidliftError" for c in type(error).__mro__)
    return text if ours and text else f"{type(error).__name__}: {text}".rstrip(": ")


def write_status(folder: str, state: str, **more: str) -> None:
    """What the other side reads."""
    write_json(os.path.join(folder, "status.json"), dict(more, protocol=PROTOCOL, state=state))


def write_json(path: str, data: dict) -> None:
    """All of it or nothing."""
    with open(path + ".part", "w", encoding="utf-8") as file:
        json.dump(data, file)
    os.replace(path + ".part", path)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
