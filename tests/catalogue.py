"""The assets that tests look at, each made once for a state of the source.

Workers and runs share them: an asset lies in `.assets/`, under a name that holds a hash of everything that it depends
on, and is made under a lock by whoever asks first. Tests read it; those that change it work on a copy.

    python tests/catalogue.py --record        write what `test_same_bytes.py` compares with, after a change of results:
                                              for this machine alone, as what others have recorded is of before
    python tests/catalogue.py --add           the same, beside the others: no result has changed since they recorded
    python tests/catalogue.py --against REV   compare with the assets that the code of another commit makes here
"""

from __future__ import annotations

import argparse
import fcntl
import hashlib
import json
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
KEPT = ROOT / ".assets"
RECORDED = Path(__file__).with_name("same_bytes.json")

INTERVAL = 0.04
"""s between frames of the small clips"""

QUICK = (
    "--set", "shape.cells=24", "--set", "shape.refine_iterations=2", "--set", "motion.targets=2",
    "--set", "fit.max_seconds=60",
)  # fmt: skip
"""coarse; the fit may take the time that it needs (a few seconds), because one that is cut off by the clock depends on
how fast the machine is"""


@dataclass(frozen=True)
class Job:
    """What one run of the command line left."""

    clip: Path
    folder: Path
    code: int


def stream_pictures(count: int = 10, size: tuple[int, int] = (96, 64), step: int = 2, seed: int = 0) -> np.ndarray:
    """u8 [T,H,W,3]: blue texture that runs `step` px per frame to the right between still brown banks, round a rock."""
    import cv2

    width, height = size
    rng = np.random.default_rng(seed)

    def texture(shape: tuple[int, int], colour: tuple[int, int, int], contrast: float) -> np.ndarray:
        noise = cv2.GaussianBlur(rng.standard_normal(shape).astype(np.float32), (0, 0), 1.1)
        return np.clip(np.asarray(colour) + contrast * (noise / noise.std())[..., None], 0, 255)

    ground = texture((height, width), (120, 95, 60), 22)
    water = texture((height, width + step * count), (70, 105, 120), 25)
    u, v = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    # a trapezoid: a channel that is a little wider on the near side
    channel = (v > 0.28 * height) & (v < (0.78 + 0.04 * u / width) * height)
    rock = ((u - 0.6 * width) / 7) ** 2 + ((v - 0.55 * height) / 5) ** 2 < 1
    frames = []
    for t in range(count):
        moved = water[:, step * (count - t) : step * (count - t) + width]
        picture = np.where((channel & ~rock)[..., None], moved, ground)
        frames.append(np.where(rock[..., None], 0.7 * ground, picture))
    return np.stack(frames).astype(np.uint8)


def plume_pictures() -> np.ndarray:
    """u8 [T,H,W,3]: grey texture that rises 2 px per frame in a growing column before a dark wall."""
    rng = np.random.default_rng(0)
    texture = np.kron(rng.uniform(90, 230, (60, 32)), np.ones((2, 3)))
    row, col = np.mgrid[:64, :96]
    frames = []
    for t in range(12):
        smoke = (np.abs(col - 48) < 8 + 0.12 * (60 - row) + 2 * np.sin(row / 4 + t)) & (row > 40 - 3 * t) & (row < 60)
        picture = np.where(smoke, texture[2 * t : 2 * t + 64], 25)
        frames.append(np.repeat(picture[..., None], 3, axis=-1).astype(np.uint8))
    return np.stack(frames)


def write_clip(path: Path, frames: np.ndarray) -> Path:
    """Encode frames at 25 per second."""
    from fluidlift.io.video import write_video

    return write_video(path, frames, 1.0 / INTERVAL, repeatable=True)


# recipes: how an asset is made in an empty folder -----------------------------------------------------------------


def _stream(place: Path) -> Job:
    """The small stream that most tests look at."""
    from fluidlift.cli import main

    clip, folder = write_clip(place / "stream.mp4", stream_pictures()), place / "stream.fluid"
    return Job(clip, folder, main(["make", str(clip), "-o", str(folder), "--size", "2", *QUICK]))


def _dam(place: Path) -> Job:
    """A column of water that falls, simulated and filmed by the project itself."""
    from fluidlift.cli import main
    from fluidlift.synthetic.record import make_scene

    case = make_scene("dam", place / "case", size=(240, 180), frames=20, cells=28)
    camera = json.loads((case / "camera.json").read_text()) | {"ground_level_z": 0.05}
    (case / "surveyed.json").write_text(json.dumps(camera))
    clip, folder = case / "video.mp4", place / "dam.fluid"
    speed = ["--preset", "draft", "--set", "shape.cells=32", "--set", "shape.max_gaussians=6000",
             "--set", "shape.refine_iterations=0", "--set", "simulate.frames=8"]  # fmt: skip
    code = main(["make", str(clip), "-o", str(folder), "--camera", str(case / "surveyed.json"), *speed])
    return Job(clip, folder, code)


def _plume(place: Path) -> Job:
    """Smoke that rises before a wall."""
    from fluidlift.cli import main

    clip, folder = write_clip(place / "plume.mp4", plume_pictures()), place / "plume.fluid"
    quick = [*QUICK, "--set", "simulate.frames=6"]
    return Job(clip, folder, main(["make", str(clip), "-o", str(folder), "--size", "1", *quick]))


def _demo(place: Path) -> Job:
    """The clip that comes with the package, as `make demo` makes it."""
    from fluidlift.cli import main
    from fluidlift.synthetic.demo import demo_clip

    folder = place / "demo.fluid"
    return Job(demo_clip(), folder, main(["demo", "--out", str(folder)]))


RECIPES: dict[str, Callable[[Path], Job]] = {"stream": _stream, "dam": _dam, "plume": _plume, "demo": _demo}


# the shelf ----------------------------------------------------------------------------------------------------------


def source_hash(package: Path) -> str:
    """Of all files of the package, of the recipes, and of the versions that compute."""
    digest = hashlib.sha256(Path(__file__).read_bytes() + fingerprint().encode())
    for file in sorted(p for p in package.rglob("*") if p.is_file() and "__pycache__" not in p.parts):
        digest.update(str(file.relative_to(package)).encode() + b"\0" + file.read_bytes())
    return digest.hexdigest()[:20]


def fingerprint() -> str:
    """What the last bits of a result depend on beside the source: the processor and the versions that compute."""
    from llvmlite.binding import get_host_cpu_features, get_host_cpu_name

    features = hashlib.sha256(get_host_cpu_features().flatten().encode()).hexdigest()[:8]
    names = ("numpy", "scipy", "numba", "torch", "opencv-python-headless", "av", "usd-core")
    versions = (f"{name} {metadata.version(name)}" for name in names)
    return ", ".join([f"{get_host_cpu_name()} with features {features}", *versions])


def asset(name: str, shelf: Path | None = None) -> Job:
    """An asset of the catalogue, made if it is not there.

    Args:
        name: of the recipe.
        shelf: folder that holds the assets; by default `.assets/` of the repository.
    """
    import fluidlift

    shelf = shelf or KEPT
    shelf.mkdir(exist_ok=True)
    place = shelf / f"{name}-{source_hash(Path(fluidlift.__file__).parent)}"
    with (shelf / f"{name}.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not (place / "job.json").is_file():
            for old in shelf.glob(f"{name}-*"):
                shutil.rmtree(old)
            place.mkdir()
            job = RECIPES[name](place)
            kept = {"clip": os.path.relpath(job.clip, place), "folder": job.folder.name, "code": job.code}
            (place / "job.json").write_text(json.dumps(kept))
    kept = json.loads((place / "job.json").read_text())
    return Job((place / kept["clip"]).resolve(), place / kept["folder"], kept["code"])


# bytes ----------------------------------------------------------------------------------------------------------------


def digests(folder: Path) -> dict[str, str]:
    """SHA-256 of what an asset holds, by file, and by folder for its frames.

    Left out: `work/`, which is the cache; times, keys of the cache, figures of the machine and codes of warnings in the
    manifest, whose texts stay; and the report, which shows them.
    """
    found: dict[str, "hashlib._Hash"] = {}
    for file in sorted(p for p in folder.rglob("*") if p.is_file()):
        path = file.relative_to(folder)
        if path.parts[0] == "work" or path.name == "report.html":
            continue
        data = file.read_bytes()
        if path.name == "manifest.json":
            manifest = json.loads(data)
            del manifest["timings"], manifest["provenance"]["stages"], manifest["provenance"]["versions"]
            del manifest["metrics"]["stages"], manifest["metrics"]["peak_memory_mb"]
            manifest["metrics"].get("fit_extra", {}).pop("seconds", None)
            manifest["hashes"].pop("report.html", None)
            data = json.dumps(manifest, sort_keys=True).encode()
        name = str(path.parent if path.parts[0] == "frames" else path)
        found.setdefault(name, hashlib.sha256()).update(path.name.encode() + b"\0" + data)
    return {name: digest.hexdigest() for name, digest in found.items()}


def _all_digests(shelf: Path | None = None) -> dict[str, dict[str, str]]:
    return {name: digests(asset(name, shelf).folder) for name in RECIPES}


def _digests_of_revision(revision: str) -> dict[str, dict[str, str]]:
    """Those of the assets that the code of another commit makes on this machine."""
    with tempfile.TemporaryDirectory() as scratch:
        tree = Path(scratch) / "tree"
        subprocess.run(["git", "worktree", "add", "--quiet", "--detach", str(tree), revision], cwd=ROOT, check=True)
        try:
            command = [sys.executable, __file__, "--shelf", str(Path(scratch) / "assets")]
            environment = os.environ | {"PYTHONPATH": str(tree / "src")}
            done = subprocess.run(command, env=environment, check=True, stdout=subprocess.PIPE, text=True)
        finally:
            subprocess.run(["git", "worktree", "remove", "--force", str(tree)], cwd=ROOT, check=True)
    return json.loads(done.stdout.splitlines()[-1])


def main() -> int:
    """The commands above; without any, the digests as the last line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--record", action="store_true")
    parser.add_argument("--add", action="store_true")
    parser.add_argument("--against", metavar="REV")
    parser.add_argument("--shelf", type=Path)
    options = parser.parse_args()
    now = _all_digests(options.shelf)
    if options.record or options.add:
        known = json.loads(RECORDED.read_text()) if options.add and RECORDED.is_file() else {}
        RECORDED.write_text(json.dumps(known | {fingerprint(): now}, indent=1, sort_keys=True) + "\n")
        return 0
    if options.against:
        then = _digests_of_revision(options.against)
        changed = [f"{a}: {f}" for a in then for f in then[a].keys() | now[a].keys() if then[a].get(f) != now[a].get(f)]
        print("\n".join(sorted(changed)) or f"the same bytes as {options.against}: {', '.join(now)}")
        return int(bool(changed))
    print(json.dumps(now))
    return 0


if __name__ == "__main__":
    sys.exit(main())
