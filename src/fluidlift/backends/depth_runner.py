"""Runs a learned model of depth in another Python: pictures in, depth out, over two pipes. Started as a script.

    python depth_runner.py PACKAGE

PACKAGE is the folder of fluidlift, whose adapter is imported from there, as `generator_runner` does; that Python need
not have fluidlift. What is written here runs on Python 3.8, and says so where the adapter needs a newer one.

The protocol, version 1. Each message is a line of JSON, then bytes whose number the line tells by its sizes. In, first:
`protocol`, `model`, `weights` (path), `device`, `allow_download`, `memory` (bytes of address space, or null). Then, for
each picture: `width`, `height`, `focal` (px, or null), and height x width x 3 bytes of sRGB. Out, first: `state`
"ready"; before that, and at any time, "says" with a `line` for the user. Then, for each picture: `state` "answer",
`holds`, `field_of_view` (degrees, or null), `normals` (true or false), and height x width float32, little-endian, and
where there are normals height x width x 3 more. Or `state` "failed" with `kind` ("memory", "missing", "rejected",
"failed") and `message`, after which it ends. It ends as well when no more comes in. What the model prints goes to
standard error, whatever it prints to.
"""

from __future__ import annotations

import importlib.util
import json
import os
import sys
import traceback

PROTOCOL = 1


def main(arguments: list) -> int:
    """Answer until no more is asked; the exit code is 0 where all went well."""
    here = os.path.realpath(os.path.dirname(os.path.abspath(__file__)))
    sys.path[:] = [p for p in sys.path if os.path.realpath(p or os.getcwd()) != here]
    out = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # packages that print do not spoil the messages
    given = sys.stdin.buffer
    shared = sibling(here, "generator_runner")
    try:
        answer_all(given, out, shared, arguments[0])
    except BaseException as error:  # whatever it is, the other side is to hear of it
        traceback.print_exc()
        say(out, {"state": "failed", "kind": shared.kind_of(error), "message": shared.message_of(error)})
        return 1
    return 0


def answer_all(given, out, shared, package: str) -> None:
    """Load the model, then one picture after the other."""
    job = json.loads(given.readline())
    if job.get("protocol") != PROTOCOL:
        raise ValueError(f"protocol {job.get('protocol')!r} instead of {PROTOCOL}")
    if sys.version_info < (3, 10):  # noqa: UP036 - another Python than that of fluidlift
        raise ImportError("its Python is {}.{}, the adapters need 3.10 or newer".format(*sys.version_info))
    if job["memory"] is not None:
        limit_memory(int(job["memory"]))
    shared.lend_package(package)
    import numpy as np

    from fluidlift.backends.monocular_depth import make_depth_estimator
    from fluidlift.backends.registry import ModelChoice
    from fluidlift.types import PinholeCamera

    def announce(line: str) -> None:
        say(out, {"state": "says", "line": line})

    choice = ModelChoice(job["weights"], job["device"], job["allow_download"], announce=announce)
    model = make_depth_estimator(job["model"], choice)
    say(out, {"state": "ready"})
    while True:
        line = given.readline()
        if not line:
            return
        asked = json.loads(line)
        width, height, focal = int(asked["width"]), int(asked["height"]), asked["focal"]
        data = given.read(width * height * 3)
        image = np.frombuffer(data, np.uint8).reshape(height, width, 3)
        camera = None
        if focal is not None:
            camera = PinholeCamera((focal, focal), (0.5 * width, 0.5 * height), (width, height))
        found = model.guess(image, camera)
        with_normals = found.normals is not None
        parts = [found.values] + ([found.normals] if with_normals else [])
        bytes_of = [np.ascontiguousarray(p, "<f4").tobytes() for p in parts]
        facts = {"state": "answer", "holds": found.holds, "field_of_view": found.field_of_view, "normals": with_normals}
        say(out, facts, *bytes_of)


def say(out, facts: dict, *parts: bytes) -> None:
    """One message."""
    out.write(json.dumps(facts).encode() + b"\n")
    for part in parts:
        out.write(part)
    out.flush()


def limit_memory(most: int) -> None:
    """Address space of this process, so that what runs wild ends before the machine does."""
    import resource

    _, hard = resource.getrlimit(resource.RLIMIT_AS)
    most = most if hard == resource.RLIM_INFINITY else min(most, hard)
    resource.setrlimit(resource.RLIMIT_AS, (most, hard))


def sibling(folder: str, name: str):
    """A module of this folder, which is not on the path."""
    found = importlib.util.spec_from_file_location(f"_fluidlift_{name}", os.path.join(folder, name + ".py"))
    assert found is not None and found.loader is not None
    module = importlib.util.module_from_spec(found)
    found.loader.exec_module(module)
    return module


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
