"""OpenUSD files by the validators of others, and what writing them costs.

python benchmarks/check_usd.py check FOLDER ...      # every .usda in them: OpenUSD's validators, NVIDIA's rule, ours
python benchmarks/check_usd.py measure [SPLATS]      # time, size and peak memory of 10 and 40 synthetic frames
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np

COUNTS = (10, 40)
"""frames; memory that is flat is the same for both"""
INTERVAL = 0.04
"""s"""


def check(folders: list[Path]) -> int:
    """A table of every file; the number of those with faults."""
    from fluidlift.io.validate_usd import has_splat_rule, splat_rule_faults, validate_usd

    files = [f for folder in folders for f in ([folder] if folder.is_file() else sorted(folder.rglob("*.usda")))]
    files = [f for f in files if not f.name.endswith(".manifest.usda")]  # of clips: attributes without values
    bad = 0
    print("| file | frames | OpenUSD and ours | NVIDIA's splat rule | s |\n|---|---|---|---|---|")
    for file in files:
        began = time.perf_counter()
        own = validate_usd(file)
        theirs = splat_rule_faults(file) if has_splat_rule() else ["not installed"]
        frames = _frames(file)
        cells = [f"{len(found)}: {found[0]}" if found else "no faults" for found in (own, theirs)]
        seconds = time.perf_counter() - began
        print(f"| {file.parent.name}/{file.name} | {frames} | {cells[0]} | {cells[1]} | {seconds:.1f} |")
        bad += bool(own or theirs)
    print(f"{len(files)} files, {bad} with faults")
    return bad


def _frames(file: Path) -> str:
    from fluidlift.io.validate_usd import frame_range

    first, last = frame_range(file)
    return f"{first} to {last}"


def frames_of(splats: int, count: int) -> Iterator[tuple]:
    """Splats that drift, with harmonics of degree 1; of every frame all numbers are new."""
    from fluidlift.types import Gaussians

    rng = np.random.default_rng(0)
    quats = rng.normal(size=(splats, 4))
    quats /= np.linalg.norm(quats, axis=1, keepdims=True)
    means, speed = rng.uniform(-1, 1, (splats, 3)), rng.normal(size=(splats, 3))
    scales, sh = rng.uniform(0.004, 0.02, (splats, 3)), 0.3 * rng.normal(size=(splats, 4, 3))
    opacities = rng.uniform(0.3, 0.9, splats)
    for k in range(count):
        wobble = np.float32(1 + 0.01 * np.sin(k))
        moved = Gaussians(means + speed * INTERVAL * k, quats, scales * wobble, opacities * wobble, sh * wobble)
        yield moved, np.arange(splats), np.asarray(speed * wobble, np.float32)


def write(layout: str, splats: int, count: int, folder: Path) -> None:
    """One run, in a process of its own, whose peak memory is its own."""
    import resource

    from fluidlift.io.export_usd import UsdSettings, write_usd

    def peak() -> float:
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024

    for _ in frames_of(splats, 2):  # imports and the frames themselves
        pass
    before, began = peak(), (time.perf_counter(), time.process_time())
    write_usd(
        folder / "fluid.usda", frames=frames_of(splats, count), interval=INTERVAL, settings=UsdSettings(layout=layout)
    )
    seconds, busy = time.perf_counter() - began[0], time.process_time() - began[1]
    size = sum(f.stat().st_size for f in folder.rglob("*") if f.is_file())
    print(f"{seconds:.2f} {busy:.2f} {size / 1e6:.1f} {before:.0f} {peak():.0f}")


def measure(splats: int) -> None:
    """A table of both layouts."""
    print(f"{splats} splats of degree 1, full precision, without surface")
    print("| layout | frames | s | CPU s per frame | MB | MB a frame | peak memory, MB | before, MB |\n|" + "---|" * 8)
    for layout in ("file", "clips"):
        for count in COUNTS:
            with tempfile.TemporaryDirectory() as place:
                command = [sys.executable, __file__, "write", layout, str(splats), str(count), place]
                out = subprocess.run(command, check=True, capture_output=True, text=True).stdout
            seconds, busy, size, before, peak = map(float, out.split()[-5:])
            print(f"| {layout} | {count} | {seconds:.1f} | {busy / count:.3f} | {size:.0f} | {size / count:.1f} "
                  f"| {peak:.0f} | {before:.0f} |", flush=True)  # fmt: skip


def main() -> int:
    """One of the jobs."""
    words = sys.argv[1:]
    if words[:1] == ["check"] and len(words) > 1:
        return min(check([Path(w) for w in words[1:]]), 1)
    if words[:1] == ["measure"] and len(words) < 3:
        measure(int(words[1]) if len(words) == 2 else 100_000)
        return 0
    if words[:1] == ["write"] and len(words) == 5:
        write(words[1], int(words[2]), int(words[3]), Path(words[4]))
        return 0
    print(__doc__, file=sys.stderr)
    return 2


if __name__ == "__main__":
    sys.exit(main())
