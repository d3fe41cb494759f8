"""Pictures of the studio for its page: the demo clip as found, put right, and on the shelf.

    python benchmarks/studio_pictures.py [--out docs/pictures] [--no-shelf]

A headless Chromium of 1280 x 720 px does what a person would: it opens the clip, paints a rock larger, takes a shadow
out, lays a ruler, presses Make. Look at what it writes: studio_found.jpg, studio_corrected.jpg, studio_shelf.jpg.
"""

from __future__ import annotations

import argparse
import tempfile
import threading
import time
from importlib import resources
from pathlib import Path

from studio import CHROMIUM

from fluidlift.studio.app import app_of
from fluidlift.studio.desk import Desk

SIZE = {"width": 1280, "height": 720}
PORT = 18395
PATIENCE = 1800.0
"""s that a make may take"""
ROCK, SHADOW = ((0.42, 0.46), (0.47, 0.52), (0.53, 0.57)), ((0.99, 0.39), (0.99, 0.42))
"""ways of the brush, parts of the picture's size"""
RULER = ((0.26, 0.80), (0.63, 0.73))


class Visit:
    """One window on a desk."""

    def __init__(self, page, desk: Desk, out: Path) -> None:
        self.page, self.desk, self.out = page, desk, out

    def until(self, condition, seconds: float = 300.0) -> None:
        """Wait for something that the desk does."""
        end = time.monotonic() + seconds
        while not condition():
            if time.monotonic() > end:
                raise SystemExit(f"nothing for {seconds:.0f} s; the page says: {self.page.inner_text('body')[:400]}")
            self.page.wait_for_timeout(50)

    def at_rest(self) -> None:
        """Wait until all is found and drawn."""
        look = self.desk.looking
        self.page.wait_for_timeout(500)  # what was done is on its way
        self.until(lambda: look.idle and look.look.facts is not None)
        self.page.wait_for_timeout(800)

    def drag(self, line: tuple[tuple[float, float], ...]) -> None:
        """Along a line, parts of the clip's picture."""
        box = self.page.locator("#picture").bounding_box()
        w, h = self.desk.info["size"]
        k = min(box["width"] / w, box["height"] / h)
        left, top = box["x"] + 0.5 * (box["width"] - k * w), box["y"] + 0.5 * (box["height"] - k * h)
        first, *rest = [(left + k * w * x, top + k * h * y) for x, y in line]
        self.page.mouse.move(*first)
        self.page.mouse.down()
        for place in rest:
            self.page.mouse.move(*place, steps=6)
        self.page.mouse.up()
        self.at_rest()

    def taken(self, name: str) -> None:
        """Write what is shown."""
        self.page.mouse.move(1270, 710)
        self.page.wait_for_timeout(300)
        self.page.screenshot(path=self.out / f"studio_{name}.jpg", type="jpeg", quality=88)


def put_right(visit: Visit) -> None:
    """A rock painted larger, a shadow taken out, a ruler along the bank."""
    page = visit.page
    page.keyboard.press("b")
    for what, width, line in (("not fluid", 40, SHADOW), ("rock", 24, ROCK)):
        page.get_by_label("what is there").select_option(what)
        page.get_by_label("width of the brush").fill(str(width))
        visit.drag(line)
    page.keyboard.press("r")
    page.fill("#metres", "0.6")
    visit.drag(RULER)


def main() -> int:
    """Serve, act, write."""
    import uvicorn
    from playwright.sync_api import sync_playwright

    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("docs/pictures"))
    parser.add_argument("--no-shelf", action="store_true", help="make no asset")
    wanted = parser.parse_args()
    demo = resources.files("fluidlift.synthetic") / "data" / "demo.mp4"
    with tempfile.TemporaryDirectory() as room, sync_playwright() as p:
        folder = Path(room) / "clips"
        folder.mkdir()
        (folder / "demo.mp4").write_bytes(demo.read_bytes())
        desk = Desk(folder)
        config = uvicorn.Config(app_of(desk, "here"), host="127.0.0.1", port=PORT, log_level="error")
        server = uvicorn.Server(config)
        threading.Thread(target=server.run, daemon=True).start()
        browser = p.chromium.launch(executable_path=str(CHROMIUM), args=["--headless=new", "--no-sandbox"])
        visit = Visit(browser.new_page(viewport=SIZE), desk, wanted.out)
        visit.page.goto(f"http://127.0.0.1:{PORT}/here/")
        visit.page.get_by_label("clip", exact=True).select_option("demo.mp4")
        visit.at_rest()
        visit.taken("found")
        put_right(visit)
        visit.taken("corrected")
        if not wanted.no_shelf:
            visit.page.get_by_role("tab", name="Make").click()
            visit.page.get_by_role("button", name="Make", exact=True).last.click()
            visit.until(lambda: desk.making.state.running, 60.0)
            visit.until(lambda: not desk.making.state.running, PATIENCE)
            visit.page.get_by_role("tab", name="Shelf").click()
            visit.page.wait_for_timeout(2000)
            visit.taken("shelf")
        browser.close()
        server.should_exit = True
        desk.close()
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
