"""How quick the studio is: from dropping a clip to what is found of it, and from a correction to the changed picture.

    python benchmarks/studio.py [--record]

The clip is the demo at 512 px, played to and fro for 3 s. A headless Chromium drops it on the page, draws a rock with
the brush, clicks, turns an arrow and chooses a kind; times end where the page has drawn it. Seconds of the clock, and
of processor time of the studio itself, which others on the machine disturb less. --record writes
benchmarks/results/cost.json.
"""

from __future__ import annotations

import argparse
import os
import platform
import tempfile
import threading
import time
from collections.abc import Callable
from datetime import date
from importlib import resources
from pathlib import Path

import cv2
import numpy as np

from fluidlift.io.video import read_clip, write_video
from fluidlift.studio.app import app_of
from fluidlift.studio.desk import Desk

CHROMIUM = Path("/usr/bin/chromium")
FRAMES, WIDTH = 75, 512
PATIENCE = 600.0


def long_demo(file: Path) -> Path:
    """The demo clip to and fro, 3 s at 512 px."""
    demo = resources.files("fluidlift.synthetic") / "data" / "demo.mp4"
    with resources.as_file(demo) as path:
        frames = read_clip(path).frames
    there = np.concatenate([frames, frames[-2:0:-1]])
    height = round(WIDTH * frames.shape[1] / frames.shape[2] / 2) * 2
    chosen = [there[t % len(there)] for t in range(FRAMES)]
    write_video(file, np.stack([cv2.resize(f, (WIDTH, height), interpolation=cv2.INTER_CUBIC) for f in chosen]), 25.0)
    return file


class Clock:
    """Seconds since the last start, of the clock and of this process's processors."""

    def __init__(self, page) -> None:
        self.page, self.begun = page, (0.0, 0.0)

    def start(self) -> None:
        """Count from now."""
        self.begun = time.perf_counter(), time.process_time()

    def until(self, condition: Callable[[], bool]) -> tuple[float, float]:
        """Wait for something; the seconds until then."""
        while not condition():
            if time.perf_counter() - self.begun[0] > PATIENCE:
                raise SystemExit(f"nothing for {PATIENCE:.0f} s; the page says: {self.page.inner_text('body')[:400]}")
            self.page.wait_for_timeout(20)
        return time.perf_counter() - self.begun[0], time.process_time() - self.begun[1]


def measured(folder: Path) -> dict[str, tuple[float, float]]:
    """Seconds of the clock and of the processors, by what was waited for."""
    import uvicorn
    from playwright.sync_api import sync_playwright

    desk, found = Desk(folder), {}
    config = uvicorn.Config(app_of(desk, "here"), host="127.0.0.1", port=18390, log_level="error")
    server = uvicorn.Server(config)
    threading.Thread(target=server.run, daemon=True).start()
    clip = long_demo(Path(tempfile.mkdtemp()) / "river.mp4")
    with sync_playwright() as p:
        browser = p.chromium.launch(executable_path=str(CHROMIUM), args=["--headless=new", "--no-sandbox"])
        page = browser.new_page(viewport={"width": 1280, "height": 720})
        page.goto("http://127.0.0.1:18390/here/")
        page.wait_for_selector("html[data-version]")
        page.wait_for_timeout(8000)  # a person takes longer to find the file, and packages are loaded meanwhile
        look, clock = desk.looking, Clock(page)

        def drawn() -> dict[str, int]:
            return page.evaluate("window.studio.drawn()")

        clock.start()
        page.set_input_files("#file", str(clip))
        found["drop to the first picture"] = clock.until(lambda: drawn()["first"] > 0)
        found["drop to the frames"] = clock.until(lambda: drawn()["frames"] > 0)
        found["drop to the mask"] = clock.until(lambda: drawn()["masks"] > 0)
        found["drop to all findings"] = clock.until(lambda: look.look.facts is not None and look.idle)
        page.keyboard.press("b")
        page.get_by_label("what is there").select_option("rock")
        box, before = page.locator("#picture").bounding_box(), look.look.masks
        page.mouse.move(box["x"] + 0.4 * box["width"], box["y"] + 0.5 * box["height"])
        page.mouse.down()
        page.mouse.move(box["x"] + 0.5 * box["width"], box["y"] + 0.52 * box["height"], steps=5)
        clock.start()
        page.mouse.up()
        found["stroke to the changed mask"] = clock.until(lambda: drawn()["masks"] > before)
        found["stroke to all findings"] = clock.until(lambda: look.idle)
        page.keyboard.press("c")
        before = look.look.masks
        clock.start()
        page.mouse.click(box["x"] + 0.45 * box["width"], box["y"] + 0.3 * box["height"])
        found["click to the changed mask"] = clock.until(lambda: look.look.masks > before and drawn()["masks"] > before)
        found["click to all findings"] = clock.until(lambda: look.idle)
        arrow = {"at": [150, 150], "to": [150, 110]}
        clock.start()
        page.evaluate("(item) => window.studio.change({ add: 'flow', item })", arrow)
        clock.until(lambda: desk.history is not None and len(desk.history.hints.flow) == 1)
        found["arrow to the changed findings"] = clock.until(lambda: look.idle)
        page.get_by_label("kind", exact=True).select_option("fall")
        clock.start()
        found["kind to the changed findings"] = clock.until(lambda: look.idle and look.look.facts["kind"] == "fall")
        browser.close()
    server.should_exit = True
    desk.close()
    return found


def main() -> int:
    """Measure and tell."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--record", action="store_true", help="write benchmarks/results/cost.json")
    wanted = parser.parse_args()
    load = os.getloadavg()[0]
    with tempfile.TemporaryDirectory() as folder:
        found = measured(Path(folder))
    for name, (clock, processors) in found.items():
        print(f"{name:32} {clock:6.1f} s, {processors:6.1f} s of processors")
    if wanted.record:
        write(found, load)
    return 0


SHOWN = {
    ("drop to the first picture", "time"), ("drop to all findings", "processor time"),
    ("stroke to the changed mask", "time"), ("click to the changed mask", "time"),
}  # fmt: skip
"""what stands in docs/results.md; the rest is in the file"""
GOALS = {("drop to all findings", "time"): 20.0, ("stroke to the changed mask", "time"): 2.0,
         ("click to the changed mask", "time"): 2.0}  # fmt: skip


def write(found: dict[str, tuple[float, float]], load: float) -> None:
    """The figures among those of speed, with the load of the machine beforehand."""
    from report import put

    records = []
    for name, both in found.items():
        for figure, value in zip(("time", "processor time"), both, strict=True):
            goal = {"goal": GOALS[name, figure]} if (name, figure) in GOALS else {}
            records.append(
                {"subject": f"studio, clip of 3 s: {name}", "figure": figure, "value": round(value, 2), "unit": "s",
                 "better": "less", "shown": (name, figure) in SHOWN, **goal}
            )  # fmt: skip
    put(
        "cost", records, command="python benchmarks/studio.py --record", date=date.today().isoformat(),
        machine=f"2 cores, load {load:.1f} beforehand, {platform.system()}, Python {platform.python_version()}",
    )  # fmt: skip


if __name__ == "__main__":
    raise SystemExit(main())
