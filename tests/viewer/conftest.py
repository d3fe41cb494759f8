"""A tank of water with a few frames, as an asset on disk: small enough for a browser without a graphics card."""

import math
import re
import time
from pathlib import Path

import numpy as np
import pytest

from fluidlift.types import (
    CellType,
    FaceVelocity,
    FluidAsset,
    FluidParameters,
    Gaussians,
    Grid,
    PinholeCamera,
    Similarity3,
    Terrain,
    TriangleMesh,
)

FRAMES, INTERVAL = 8, 0.04
CHROMIUM = Path("/usr/bin/chromium")
FLAGS = ["--headless=new", "--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
HARMLESS = ("THREE.Clock", "WebGL", "GPU stall", "GL Driver Message")
"""what the renderer itself says of its software"""
PATIENCE = 240.0
"""s that anything may take: a hundred times what it takes on a machine that does nothing else"""


def tank(cells=(12, 8, 8), spacing=0.05) -> FluidAsset:
    """A block of water that is let go at one end of a tank."""
    grid = Grid(cells, spacing)
    centers = grid.centers()
    wet = (centers[..., 0] < 0.25) & (centers[..., 2] < 0.3)
    at = centers[wet][:, None, :] + spacing * np.array(
        [[x, y, z] for x in (-0.25, 0.25) for y in (-0.25, 0.25) for z in (-0.25, 0.25)]
    )
    means = at.reshape(-1, 3)
    rest = Gaussians.isotropic(means, 0.42 * spacing, np.full((len(means), 3), (0.1, 0.4, 0.8)))
    low, high = grid.low, grid.high
    floor = np.array([[low[0], low[1], 0], [high[0], low[1], 0], [high[0], high[1], 0], [low[0], high[1], 0]])
    terrain = Terrain(
        grid, (grid.nodes()[..., 2] + 0.5 * spacing).astype(np.float32), np.array([1.0, 0.0, 0.0]),
        TriangleMesh(floor, np.array([[0, 1, 2], [0, 2, 3]]), np.full((4, 3), 0.5)),
    )  # fmt: skip
    middle = 0.5 * (low + high)
    camera = PinholeCamera.looking(middle + np.array([0.1, -1.2, 0.6]), middle, 50.0, (96, 64))
    types = np.where(wet, CellType.FLUID, CellType.EMPTY).astype(np.uint8)
    parameters = FluidParameters(time_step=0.01)
    return FluidAsset(
        "pour", rest, terrain, grid, types, FaceVelocity.zeros(grid), parameters, {}, camera, Similarity3(), INTERVAL,
        FRAMES,
    )  # fmt: skip


def write_tank(folder: Path) -> Path:
    """The tank as a finished asset."""
    from fluidlift.io.asset_folder import save_asset, update_manifest
    from fluidlift.pipeline.preview import PreviewSize, coarse_asset, preview_frames, preview_scene
    from fluidlift.scene.splat_files import write_frame

    asset = tank()
    save_asset(folder, asset)
    scene = preview_scene(coarse_asset(asset, PreviewSize()), folder, {}, FRAMES)
    for frame in preview_frames(scene):
        ids = np.arange(len(frame.gaussians))
        write_frame(folder, 1001 + frame.number, frame.gaussians, ids=ids, velocities=frame.velocities)
    update_manifest(folder, simulation={"frames": FRAMES, "frame_interval": INTERVAL})
    return folder


@pytest.fixture(scope="session")
def finished_tank(tmp_path_factory) -> Path:
    """Written once; tests that change it work on a copy."""
    return write_tank(tmp_path_factory.mktemp("tank") / "tank.fluid")


@pytest.fixture
def tank_folder(finished_tank, tmp_path) -> Path:
    """A copy to work with."""
    import shutil

    return shutil.copytree(finished_tank, tmp_path / "tank.fluid")


@pytest.fixture(scope="session")
def opened_viewer():
    """Opens the viewer of a folder on the first free port from one on; its preview is as coarse on any machine."""
    from fluidlift.pipeline.preview import PreviewSize
    from fluidlift.viewer.app import Viewer, ViewRequest
    from fluidlift.viewer.ports import free_port

    def begin(folder, port):
        return Viewer(folder, ViewRequest(port=free_port("127.0.0.1", port)), size=PreviewSize(seconds=None))

    return begin


@pytest.fixture(scope="session")
def until():
    """Waits for what other threads do."""

    def wait(condition, seconds=PATIENCE):
        end = time.monotonic() + seconds
        while not condition():
            assert time.monotonic() < end, "it did not happen"
            time.sleep(0.01)

    return wait


@pytest.fixture(scope="module")
def visitor():
    """Opens pages of viewers, in one browser."""
    from playwright.sync_api import sync_playwright

    with sync_playwright() as p:
        started = p.chromium.launch(executable_path=str(CHROMIUM), args=FLAGS)
        yield lambda viewer: Visit(started, viewer)
        started.close()


class Visit:
    """One browser that looks at a viewer."""

    def __init__(self, browser, viewer, size=(1144, 640)):
        self.browser, self.viewer, self.complaints, self.strangers = browser, viewer, [], []
        self.page = browser.new_page(viewport={"width": size[0], "height": size[1]})
        self.page.set_default_timeout(1000 * PATIENCE)
        self.page.on("console", lambda m: self.complaints.append(m.text) if m.type == "error" else None)
        self.page.on("pageerror", lambda e: self.complaints.append(str(e)))
        self.page.on("request", self._requested)
        self.page.goto(f"{viewer.address}/?fixedDpr=0.5")
        self.page.locator("strong", has_text="frames").first.wait_for()

    def _requested(self, request):
        if not request.url.startswith((self.viewer.address, "data:", "blob:", "ws://127.0.0.1")):
            self.strangers.append(request.url)

    def worries(self):
        return [c for c in self.complaints if not any(h in c for h in HARMLESS)]

    def picture(self):
        """u8 [h,w,3] of the page left of the controls and below the input video."""
        import cv2

        data = np.frombuffer(self.page.screenshot(timeout=1000 * PATIENCE), np.uint8)
        return cv2.imdecode(data, cv2.IMREAD_COLOR)[200:, :360]

    def until(self, condition, what="it"):
        end = time.monotonic() + PATIENCE
        while not condition():
            assert time.monotonic() < end, f"{what} did not happen; the page says: {self.page.inner_text('body')[:600]}"
            self.page.wait_for_timeout(30)

    def drawn(self, after=0.0):
        """Wait, s, and then until the page has drawn what it knows, however slowly it draws."""
        self.page.wait_for_timeout(1000 * after)
        self.page.evaluate("() => new Promise(done => requestAnimationFrame(() => requestAnimationFrame(done)))")

    def close_notices(self):
        """Put away what the page's library lays over the scene: its note that the browser draws without a GPU."""
        for close in self.page.locator(".mantine-Notification-closeButton").all():
            close.click()

    def says(self, text):
        self.page.get_by_text(text).locator("visible=true").first.wait_for()

    def tab(self, name):
        self.page.get_by_role("tab", name=name).click()

    def press(self, name):
        self.page.get_by_role("button", name=name, exact=True).click()

    def unfold(self, folder, inside):
        """Open a folder unless it is open: a button inside it tells."""
        button = self.page.get_by_role("button", name=inside, exact=True)
        if not button.is_visible():
            self.page.get_by_text(folder, exact=True).first.click()
        button.wait_for()

    def field(self, label):
        """The last input of the line with a label: a slider's is its box."""
        found = self.page.locator("label", has_text=re.compile(rf"^{re.escape(label)}"))
        line = found.locator("visible=true").first.locator("xpath=ancestor::*[contains(@class,'mantine-Flex-root')][1]")
        return line.locator("input:not([type=hidden])").last

    def choose(self, label, option):
        self.field(label).click()
        self.page.get_by_role("option", name=option, exact=True).click()

    def label(self):
        """Number of the frame that the page tells."""
        return int(self.page.locator("strong", has_text="·").first.inner_text().split("·")[0])

    def live(self, told):
        """Wait until the page has taken over all frames of a live simulation of an edit."""
        viewer = self.viewer
        self.until(lambda: not viewer.draft.pending, "taking over the edit")
        self.until(lambda: viewer.take is not None and told in viewer.take.wish.told, f"live frames of {told}")
        # the drawing thread follows the simulation a tick later
        self.until(lambda: viewer.take.complete and viewer.timeline.count == len(viewer.take.frames), "the whole take")

    def another(self, size):
        """A second browser's page."""
        return Visit(self.browser, self.viewer, size)

    def on_screen(self, point):
        """px of a place in the world; the scene begins at the left edge of the window and ends at the controls."""
        from scipy.spatial.transform import Rotation

        view, height = self.client().camera, self.page.viewport_size["height"]
        eye = Rotation.from_quat(view.wxyz, scalar_first=True).inv().apply(np.subtract(point, view.position))
        focal = 0.5 * height / math.tan(0.5 * view.fov)
        return 0.5 * view.aspect * height + focal * eye[0] / eye[2], 0.5 * height + focal * eye[1] / eye[2]

    def client(self):
        return next(iter(self.viewer.server.get_clients().values()))
