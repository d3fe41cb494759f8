"""A folder with the small clip, a desk over it, and a browser that looks at its page."""

import secrets
import shutil
import threading
import time
from pathlib import Path

import pytest

CHROMIUM = Path("/usr/bin/chromium")
FLAGS = ["--headless=new", "--no-sandbox"]
PATIENCE = 120.0
"""s that anything may take: some ten times what the longest takes on a machine that does nothing else"""


@pytest.fixture(scope="module")
def folder(stream_clip, tmp_path_factory):
    """Holds the small clip."""
    made = tmp_path_factory.mktemp("studio")
    shutil.copy(stream_clip, made / "stream.mp4")
    return made


@pytest.fixture
def desk(stream_clip, tmp_path):
    """A desk over a folder of its own."""
    from fluidlift.studio.desk import Desk

    shutil.copy(stream_clip, tmp_path / "stream.mp4")
    made = Desk(tmp_path)
    yield made
    made.close()


@pytest.fixture(scope="session")
def until():
    """Waits for what other threads do."""

    def wait(condition, what="it", seconds=PATIENCE):
        end = time.monotonic() + seconds
        while not condition():
            assert time.monotonic() < end, f"{what} did not happen"
            time.sleep(0.02)

    return wait


class Served:
    """The page of a desk, on a free port."""

    def __init__(self, desk):
        import uvicorn

        from fluidlift.served import free_port
        from fluidlift.studio.app import app_of

        self.desk, secret = desk, secrets.token_urlsafe(16)
        port = free_port("127.0.0.1", 18280)
        self.address = f"http://127.0.0.1:{port}/{secret}/"
        config = uvicorn.Config(
            app_of(desk, secret), host="127.0.0.1", port=port, log_level="error", timeout_graceful_shutdown=1
        )
        self.server = uvicorn.Server(config)
        self.thread = threading.Thread(target=self.server.run, daemon=True)
        self.thread.start()
        while not self.server.started:
            time.sleep(0.02)

    def close(self):
        self.server.should_exit = True
        self.thread.join(10)


class Window:
    """One window of the browser."""

    def __init__(self, browser, served):
        self.served, self.desk, self.complaints, self.strangers = served, served.desk, [], []
        self.page = browser.new_page(viewport={"width": 1280, "height": 720})
        self.page.set_default_timeout(1000 * PATIENCE)
        self.page.on("console", lambda m: self.complaints.append(m.text) if m.type == "error" else None)
        self.page.on("pageerror", lambda e: self.complaints.append(str(e)))
        self.page.on("request", self._requested)
        self.page.goto(served.address)
        self.page.wait_for_selector("html[data-version]")

    def _requested(self, request):
        if not request.url.startswith((self.served.address, "data:", "blob:")):
            self.strangers.append(request.url)

    def until(self, condition, what="it", patience=PATIENCE):
        end = time.monotonic() + patience
        while not condition():
            assert time.monotonic() < end, f"{what} did not happen; the page says: {self.page.inner_text('body')[:600]}"
            self.page.wait_for_timeout(30)

    def says(self, text):
        self.page.get_by_text(text).locator("visible=true").first.wait_for()

    def press(self, name):
        self.page.get_by_role("button", name=name, exact=True).first.click()

    def tab(self, name):
        self.page.get_by_role("tab", name=name).click()

    def at(self, x, y):
        """px of the window of a place in the clip's picture, both as parts of its size."""
        return self.page.evaluate(
            """([x, y]) => { const c = document.getElementById("picture").getBoundingClientRect();
            const [w, h] = window.studio.size, part = window.studio.tool === "horizon" ? 0.4 : 1;
            const k = part * Math.min(c.width / w, c.height / h);
            return [c.left + (c.width - k * w) / 2 + k * w * x, c.top + (c.height - k * h) / 2 + k * h * y]; }""",
            [x, y],
        )

    def drag(self, *places):
        """The mouse pressed at the first place and let go at the last."""
        mouse = self.page.mouse
        first, *rest = [self.at(*p) for p in places]
        mouse.move(*first)
        mouse.down()
        for point in rest:
            mouse.move(*point, steps=6)
        mouse.up()

    def area(self, what, *corners):
        """An area with corners at these places, and what is there."""
        self.page.keyboard.press("a")
        self.page.get_by_label("what is there").select_option(what)
        for place in corners:
            self.page.mouse.click(*self.at(*place))
        self.page.keyboard.press("Enter")

    def looked(self):
        """Wait until all is found for the hints there are."""
        with self.desk.lock:  # hints that change meanwhile are asked for under it: before, an older look is the last
            pass
        self.until(lambda: self.desk.looking.look.facts is not None and not self.desk.looking.look.words, "the look")
        self.until(lambda: self.desk.looking.idle, "the look at the last hints")

    def shown(self):
        """Wait until the page has taken over what the desk knows."""
        version = self.desk.version
        self.until(lambda: int(self.page.evaluate("document.documentElement.dataset.version")) >= version, "the page")


@pytest.fixture(scope="module")
def visitor():
    """Opens windows in one browser."""
    from playwright.sync_api import sync_playwright

    with sync_playwright() as p:
        started = p.chromium.launch(executable_path=str(CHROMIUM), args=FLAGS)
        yield lambda served: Window(started, served)
        started.close()


@pytest.fixture(scope="session")
def serve():
    """Serves the page of a desk."""
    return Served
