"""Speaks the protocol of `generator_runner` without being a generator: a script for tests, told by STAND_IN what to do.

Its bodies are what the mask shows, bulged towards a level camera of 40 degrees, two units away, like those of
generators with a camera of their own. Every frame that it is asked for is added to the file STAND_IN_ASKED.
"""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import cv2
import numpy as np

from fluidlift.io.ply import write_gaussians
from fluidlift.types import Gaussians, PinholeCamera


def camera_of(size):
    """Looks along +y at the origin."""
    return PinholeCamera.looking(np.array([0.0, -2.0, 0.0]), np.zeros(3), 40.0, size)


def body_of(mask, image, camera):
    inside = cv2.distanceTransform(mask.astype(np.uint8), cv2.DIST_L2, 5) / max(mask.shape)
    rows, cols = np.nonzero(mask)
    depth = 2.0 - 0.5 * inside[rows, cols]
    front = camera.unproject(np.stack([cols + 0.5, rows + 0.5], -1), depth)
    back = camera.unproject(np.stack([cols + 0.5, rows + 0.5], -1), 4.0 - depth)
    colours = np.tile(image[rows, cols] / 255.0, (2, 1))
    return Gaussians.isotropic(np.concatenate([front, back]), 1.0 / camera.focal[0], colours, 0.9)


def hand_over(folder, item, what):
    image = cv2.imread(str(folder / item["image"]))[..., ::-1]
    mask = cv2.imread(str(folder / item["mask"]))[..., 0] > 127
    camera = camera_of(mask.shape[::-1])
    body = body_of(mask, image, camera)
    name = folder / f"{item['frame']:04d}"
    if what == "empty":
        body = body.select(slice(0, 0))
    if what == "faint":
        body = Gaussians(body.means, body.quats, body.scales, np.full(len(body), 1e-3), body.sh)
    if what == "elsewhere":
        body = Gaussians(body.means + [9.0, 0, 0], body.quats, body.scales, body.opacities, body.sh)
    if what == "behind":
        body = Gaussians(body.means - [0, 9.0, 0], body.quats, body.scales, body.opacities, body.sh)
    write_gaussians(f"{name}.ply", body)
    data = Path(f"{name}.ply").read_bytes()
    if what == "nan":
        start = data.index(b"end_header\n") + len(b"end_header\n")
        data = data[:start] + np.float32(np.nan).tobytes() + data[start + 4 :]
    if what == "garbage":
        data = bytes(range(256)) * 40
    if what == "half a file":
        data = data[: len(data) // 2]
    Path(f"{name}.ply").write_bytes(data)
    text = json.dumps(camera.to_dict()) if what != "no camera" else "[1, 2"
    Path(f"{name}.json.part").write_text(text)
    os.replace(f"{name}.json.part", f"{name}.json")


def misbehave(folder, what):
    if what == "crash":
        print("loading the network", file=sys.stderr)
        raise ValueError("tensors of different size")
    if what == "memory":
        raise RuntimeError("CUDA out of memory. Tried to allocate 20.00 GiB")
    if what == "killed":
        os.kill(os.getpid(), signal.SIGKILL)
    if what == "hang":
        child = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(600)"])
        told = Path(os.environ["STAND_IN_ASKED"]).with_suffix(".child")
        told.with_suffix(".part").write_text(str(child.pid))
        told.with_suffix(".part").replace(told)  # who waits for the file finds the number in it
        time.sleep(600)
    if what == "nothing":
        (folder / "status.json").write_text(json.dumps({"protocol": 1, "state": "done"}))
        sys.exit(0)
    if what in ("missing", "rejected"):
        status = {"protocol": 1, "state": "failed", "kind": what, "message": "No module named 'spconv'"}
        (folder / "status.json").write_text(json.dumps(status))
        sys.exit(1)


def main():
    folder, what = Path(sys.argv[1]), os.environ.get("STAND_IN", "success")
    job = json.loads((folder / "job.json").read_text())
    for number, item in enumerate(job["frames"]):
        with open(os.environ["STAND_IN_ASKED"], "a") as asked:
            asked.write(f"{item['frame']}\n")
        if what.startswith("second: "):
            if number == 0:
                hand_over(folder, item, "success")
                continue
            what = what.removeprefix("second: ")
        misbehave(folder, what)
        hand_over(folder, item, what)


if __name__ == "__main__":
    main()
