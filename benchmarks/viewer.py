"""How quick the viewer is: from an edit to the first changed frame, live frames per second, opening, memory over play.

    python benchmarks/viewer.py ASSET [--browser] [--frames 100] [--splats 100000] [--changes 600] [--hour 90000]
    python benchmarks/viewer.py ASSET --minutes 60 --splats 2000        # only this: played as a person would

Measured up to the message that leaves for the browser; with --browser a headless Chromium looks on, and what its page
says is timed as well (its pictures are drawn by software, which takes its share of the cores: on an artist's machine
the graphics card does that). Warm kernels; wall-clock seconds, and seconds of processor time, which others on the
machine disturb less. An hour of play is 90 000 frames at 25 a second, played as fast as they go, with splats, points
and arrows of few splats: what could grow is kept per frame. With --minutes it plays by the clock, while a page looks
on: memory of this process, of the page's scripts after they were tidied up, and of all of the browser's processes.

It prints a table for docs/experiments/2026-11-looks.md. The asset of --frames x --splats is made in a temporary folder
(840 MB for 100 x 100 000), and deleted.
"""

from __future__ import annotations

import argparse
import contextlib
import gc
import os
import re
import shutil
import statistics
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from fluidlift.io.asset_folder import update_manifest
from fluidlift.pipeline.preview import PreviewRequest
from fluidlift.scene.splat_files import write_frame
from fluidlift.types import Gaussians
from fluidlift.viewer.app import Viewer, ViewRequest

GRAVITIES = (6.0, 12.0, 4.0, 15.0, 9.0)
"""m/s^2, one edit each"""
SMALL = (400, 320)
"""px of the page that looks on for as long as an hour: what is drawn by software leaves the machine to others"""


def resident() -> float:
    """MB of this process."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 2**20


def synthetic(source: Path, out: Path, frames: int, splats: int) -> Path:
    """A copy of an asset with so many frames of so many splats."""
    shutil.copytree(source, out, ignore=shutil.ignore_patterns("work", "*.usda", "*.usdc", "splats", "preview.mp4"))
    rng = np.random.default_rng(0)
    quats = rng.normal(size=(splats, 4))
    quats /= np.linalg.norm(quats, axis=1, keepdims=True)
    means = rng.uniform((-0.8, -0.5, 0.0), (0.8, 0.5, 0.3), (splats, 3))
    body = (quats, rng.uniform(0.003, 0.01, (splats, 3)), np.full(splats, 0.8), rng.normal(0, 0.5, (splats, 1, 3)))
    velocities = np.tile((0.5, 0.0, 0.0), (splats, 1))
    for k in range(frames):
        write_frame(out, 1001 + k, Gaussians(means + 0.01 * k, *body), ids=np.arange(splats), velocities=velocities)
    update_manifest(out, simulation={"frames": frames})
    return out


class Rows(list):
    """Lines of a table, printed as they come."""

    def append(self, row: str) -> None:
        """One more."""
        super().append(row)
        print(row, flush=True)


@contextlib.contextmanager
def watched(viewer: Viewer, wanted: bool, size: tuple[int, int] = (800, 600)) -> Iterator[object]:
    """A page of so many px that looks on, or None."""
    if not wanted:
        yield None
        return
    from playwright.sync_api import sync_playwright

    flags = ["--headless=new", "--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
    with sync_playwright() as p:
        browser = p.chromium.launch(executable_path="/usr/bin/chromium", args=flags)
        page = browser.new_page(viewport={"width": size[0], "height": size[1]})
        page.set_default_timeout(600_000)
        page.goto(f"{viewer.address}/?fixedDpr=0.5")
        page.locator("strong", has_text="frames").first.wait_for()
        yield page
        browser.close()


def live(folder: Path, rows: Rows, *, browser: bool) -> None:
    """Edits of gravity, as a slider makes them, while the one before is still simulated."""
    viewer = Viewer(folder, ViewRequest(port=18100))
    began = time.perf_counter()
    while viewer.preview.phase == "warming up":
        time.sleep(0.01)
    print(f"warming up: {time.perf_counter() - began:.2f} s; {viewer.preview.particles:,} particles", flush=True)
    sent, show = [], viewer.stage.show

    def counted(*parts, **more):
        sent.append(time.perf_counter())
        return show(*parts, **more)

    viewer.stage.show = counted
    with watched(viewer, browser) as page:
        found = [_edit(viewer, strength, page, sent) for strength in GRAVITIES]
    firsts, spent, seen, rates, shown, costs = (list(x) for x in zip(*found))
    who = "a headless browser looking on" if browser else "no browser"
    said = f"median {statistics.median(firsts):.2f} s, most {max(firsts):.2f} s; "
    said += f"{statistics.median(spent):.2f} s of processor time, all threads"
    rows.append(f"| from an edit to the first changed frame, {who} | {said} |")
    if browser:
        rows.append(f"| ... until the page says so | median {statistics.median(seen):.2f} s, most {max(seen):.2f} s |")
        rows.append(f"| frames sent to it, per second | median {statistics.median(shown):.1f} |")
    said = f"median {statistics.median(rates):.1f}, least {min(rates):.1f}"
    cost = f"{1e3 * statistics.median(costs):.0f} ms of processor time each, all threads"
    rows.append(f"| live frames per second then, {who} | {said}; {cost} |")
    viewer.close()


def _edit(viewer: Viewer, strength: float, page, sent: list[float]) -> tuple[float, ...]:
    """s to the first changed frame (wall, processor), s until the page says it, frames/s (made, sent), s each."""
    wish = PreviewRequest({"parameters": {"gravity": [0.0, 0.0, -strength]}}, f"gravity {strength:g}")
    began, spent = time.perf_counter(), time.process_time()
    viewer.preview.ask(wish)
    while viewer.preview.shown is None or viewer.preview.shown.wish is not wish:
        time.sleep(0.001)
    first = said = time.perf_counter() - began
    spent = time.process_time() - spent
    take = viewer.preview.shown
    if page is not None:
        while viewer.take is not take:
            time.sleep(0.001)
        page.wait_for_function("/Live preview/.test(document.body.innerText)")
        said = time.perf_counter() - began
    started, busy, before, shown = time.perf_counter(), time.process_time(), len(take.frames), len(sent)
    while time.perf_counter() - started < 3.0 and not take.complete:
        time.sleep(0.01)
    took, made = time.perf_counter() - started, len(take.frames) - before
    return first, spent, said, made / took, (len(sent) - shown) / took, (time.process_time() - busy) / max(made, 1)


def opened(folder: Path, rows: Rows, changes: int) -> None:
    """Opening, then frame changes through the cache and the server's buffer."""
    began, busy = time.perf_counter(), time.process_time()
    viewer = Viewer(folder, ViewRequest(port=18100))
    viewer._draw(0)
    took, spent = time.perf_counter() - began, time.process_time() - busy
    splats, count = len(viewer.cache.get(0).centers), viewer.saved.count
    rows.append(f"| open {count} frames of {splats:,} splats, to the first frame sent | {took:.2f} s; "
                f"{spent:.2f} s of processor time |")  # fmt: skip
    while viewer.preview.phase == "warming up":
        time.sleep(0.1)
    began, busy = time.perf_counter(), time.process_time()
    for k in range(changes):
        viewer._draw(k % count)
    took, cost = time.perf_counter() - began, time.process_time() - busy
    rows.append(f"| frames of it read and sent, one after the other | {changes / took:.1f} per second; "
                f"{1e3 * cost / changes:.0f} ms of processor time each |")  # fmt: skip
    viewer.close()


def hour(folder: Path, rows: Rows, changes: int) -> None:
    """Memory while frames are played, with splats, points and arrows."""
    viewer = Viewer(folder, ViewRequest(port=18100))
    viewer.set_parts(points=True, arrows=True)
    while viewer.preview.phase == "warming up":
        time.sleep(0.1)
    sizes, began = [], time.perf_counter()
    for k in range(changes + 1):
        viewer._draw(k % viewer.saved.count)
        viewer.panels.tick()
        if k >= 0.05 * changes and k % max(changes // 10, 1) == 0:  # the first twentieth fills the cache
            gc.collect()
            sizes.append(resident())
    first, middle, last = sizes[0], sizes[len(sizes) // 2], sizes[-1]
    rows.append(f"| resident memory over {changes:,} frames played ({changes / 90_000:.2g} hours at 25 per second) | "
                f"{first:.0f} MB at a tenth, {middle:.0f} half-way, {last:.0f} at the end |")  # fmt: skip
    print(f"hour: {time.perf_counter() - began:.0f} s; MB each tenth: {[round(s) for s in sizes]}", flush=True)
    viewer.close()


def played(folder: Path, rows: Rows, minutes: float) -> None:
    """Memory of both sides while the page plays by the clock, with splats, points and arrows."""
    viewer = Viewer(folder, ViewRequest(port=18100))
    viewer.set_parts(points=True, arrows=True)
    while viewer.preview.phase == "warming up":
        time.sleep(0.1)
    sent, show = [0], viewer.stage.show

    def counted(*parts, **more):
        sent[0] += 1
        return show(*parts, **more)

    viewer.stage.show = counted
    found = []
    with watched(viewer, True, SMALL) as page:
        tools = page.context.new_cdp_session(page)
        time.sleep(30.0)  # the page comes up
        began = time.perf_counter()
        viewer.timeline.play(time.monotonic())
        for k in range(11):
            while time.perf_counter() - began < 60.0 * minutes * k / 10:
                time.sleep(0.5)
                page.evaluate("1")  # keeps its messages flowing
            gc.collect()
            tools.send("HeapProfiler.collectGarbage")
            heap = tools.send("Runtime.getHeapUsage")["usedSize"] / 2**20
            found.append((resident(), heap, browser_memory(os.getpid())))
            told = "MB: viewer {:.0f}, scripts of the page {:.1f}, browser {:.0f}".format(*found[-1])
            print(f"{(time.perf_counter() - began) / 60:.1f} min, {sent[0]:,} frames; {told}", flush=True)
    hours = minutes / 60
    for what, sizes in zip(("viewer", "scripts of its page", "browser, all processes"), zip(*found)):
        slope = float(np.polyfit(np.linspace(0.1, 1, 10) * hours, sizes[1:], 1)[0])
        rows.append(
            f"| memory of the {what} over {minutes:g} minutes played ({sent[0]:,} frames shown) | "
            f"{sizes[1]:.0f} MB at a tenth, {sizes[5]:.0f} half-way, {sizes[-1]:.0f} at the end; {slope:+.1f} MB/h |"
        )
    viewer.close()


def browser_memory(process: int) -> float:
    """MB that the browser's processes took, of those that this one started: without files that are mapped, whose share
    depends on what other browsers run, and without the driver, which keeps each line of the page's console."""
    total = 0.0
    with contextlib.suppress(OSError):  # ended meanwhile
        if Path(f"/proc/{process}/comm").read_text().startswith("chrom"):
            told = Path(f"/proc/{process}/smaps_rollup").read_text()
            total += sum(int(kb) / 1024 for kb in re.findall(r"^Pss_(?:Anon|Shmem): *([0-9]+)", told, re.MULTILINE))
        for task in Path(f"/proc/{process}/task").iterdir():
            total += sum(browser_memory(int(child)) for child in (task / "children").read_text().split())
    return total


def main() -> None:
    """Run all on an asset."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("asset", type=Path)
    parser.add_argument("--browser", action="store_true")
    parser.add_argument("--frames", type=int, default=100)
    parser.add_argument("--splats", type=int, default=100_000)
    parser.add_argument("--changes", type=int, default=300)
    parser.add_argument("--hour", type=int, default=90_000)
    parser.add_argument("--minutes", type=float, default=0.0)
    options = parser.parse_args()
    rows = Rows()
    print("load average", os.getloadavg(), "cores", os.cpu_count(), flush=True)
    if options.minutes:
        with tempfile.TemporaryDirectory() as place:
            asset = synthetic(options.asset, Path(place) / "small.fluid", options.frames, options.splats)
            played(asset, rows, options.minutes)
        print("\n".join(["", "| viewer | measured |", "|---|---|", *rows]))
        return
    live(options.asset, rows, browser=False)
    if options.browser:
        live(options.asset, rows, browser=True)
    with tempfile.TemporaryDirectory() as place:
        if options.changes:
            big = synthetic(options.asset, Path(place) / "big.fluid", options.frames, options.splats)
            opened(big, rows, options.changes)
            shutil.rmtree(big)
        if options.hour:
            hour(synthetic(options.asset, Path(place) / "small.fluid", options.frames, 500), rows, options.hour)
    print("load average", os.getloadavg())
    print("\n".join(["", "| viewer | measured |", "|---|---|", *rows]))


if __name__ == "__main__":
    main()
