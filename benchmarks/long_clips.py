"""How time and memory of `make` grow with the length of a clip, of which a part of one length is made.

    python benchmarks/long_clips.py [--seconds 3 30 300] [--record]     and the table in docs/farms.md

The clips are made: a stream between still banks at 25 frames per second, whose light drifts over a minute.
"""

from __future__ import annotations

import argparse
import datetime
import os
import platform
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from page_section import replace_section
from report import number, put

PAGE = Path(__file__).resolve().parent.parent / "docs" / "farms.md"
BEGIN, END = "<!-- long:begin -->", "<!-- long:end -->"
RATE = 25.0
"""frames per second"""
SIZE = (160, 96)
"""px"""
TAKEN = 75
"""frames that are made: all of the shortest clip"""
SETTINGS = ("shape.cells=24", "shape.refine_iterations=2", "motion.targets=2", "show.usd=false", "simulate.frames=25",
            f"read.max_frames={TAKEN}")  # fmt: skip
"""coarse: what grows is asked for, not what is the same for all"""


def pictures(count: int) -> Iterator[np.ndarray]:
    """u8 [H,W,3]: water whose texture comes round, 2 px per frame, and whose light drifts by a tenth in a minute."""
    import cv2

    width, height = SIZE
    rng = np.random.default_rng(0)

    def texture(columns: int, colour: tuple[int, int, int], contrast: float) -> np.ndarray:
        noise = cv2.GaussianBlur(rng.standard_normal((height, columns)).astype(np.float32), (0, 0), 1.1)
        return np.clip(np.asarray(colour) + contrast * (noise / noise.std())[..., None], 0, 255)

    ground, water = texture(width, (120, 95, 60), 22), texture(4 * width, (70, 105, 120), 25)
    row = np.arange(height)[:, None, None]
    channel = (row > 0.28 * height) & (row < 0.8 * height)
    for t in range(count):
        light = 1.0 + 0.1 * np.sin(2.0 * np.pi * t / (60.0 * RATE))
        picture = np.where(channel, np.roll(water, 2 * t, axis=1)[:, :width], ground)
        yield np.clip(light * picture, 0, 255).astype(np.uint8)


def measured(seconds: float, room: Path) -> dict[str, float]:
    """Time and memory of looking through a clip of so many seconds and making its part."""
    from fluidlift.io.video import write_video

    clip = write_video(room / f"{seconds:g}.mp4", pictures(int(seconds * RATE)), RATE)
    words = [sys.executable, "-m", "fluidlift", "make", str(clip), "--out", str(room / f"{seconds:g}.fluid")]
    words += ["--size", "3", *(word for text in SETTINGS for word in ("--set", text))]
    began = time.monotonic()
    process = subprocess.Popen(words, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    _, status, used = os.wait4(process.pid, 0)
    if (code := os.waitstatus_to_exitcode(status)) not in (0, 4):
        raise SystemExit(f"{' '.join(words)} ended with {code}")
    return {
        "processor time": round(used.ru_utime + used.ru_stime, 1), "time": round(time.monotonic() - began, 1),
        "peak memory": round(used.ru_maxrss / 1024),
    }  # fmt: skip


def main(argv: list[str] | None = None) -> int:
    """Measure, and print or record."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--seconds", type=float, nargs="+", default=[3.0, 30.0, 300.0])
    parser.add_argument("--record", action="store_true")
    args = parser.parse_args(argv)
    found = {}
    with tempfile.TemporaryDirectory() as room:
        for seconds in args.seconds:
            found[seconds] = measured(seconds, Path(room))
            print(seconds, found[seconds], flush=True)
    if args.record:
        units = {"peak memory": "MB"}
        put(
            "farm",
            [{"subject": f"stream of {s:g} s, of which {TAKEN} frames are made", "figure": f, "value": v}
             | {"unit": units.get(f, "s"), "better": "less"} for s, row in found.items() for f, v in row.items()],
            command="python benchmarks/long_clips.py --record", date=datetime.date.today().isoformat(),
            machine=f"{os.cpu_count()} cores, load {os.getloadavg()[0]:.1f} at the end, {platform.system()}, "
                    f"Python {platform.python_version()}",
        )  # fmt: skip
        rows = ["| clip, s | processor time, s | peak memory, MB |", "| --- | --- | --- |"]
        rows += [f"| {s:g} | {number(r['processor time'])} | {number(r['peak memory'])} |" for s, r in found.items()]
        told = f"A stream of {SIZE[0]} x {SIZE[1]} px, of which {TAKEN} frames are made (`benchmarks/long_clips.py`):"
        replace_section(PAGE, told + "\n\n" + "\n".join(rows), BEGIN, END)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
