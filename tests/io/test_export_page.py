"""The page to share: its frames decode to the splats, and a browser shows what our own rasteriser draws."""

import io
import json
import re
import shutil
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from fluidlift.io.export_page import PageScene, write_page
from fluidlift.io.frames import MovingMesh
from fluidlift.io.page_frames import FrameEncoder, Quantization, decoded
from fluidlift.look.rasterize import render
from fluidlift.numerics.solid_mesh import box_mesh
from fluidlift.types import Gaussians, PinholeCamera, TriangleMesh

CAMERA = PinholeCamera.looking(np.array([0.3, -2.2, 1.0]), np.zeros(3), 45, (320, 200))
ABOVE = PinholeCamera.looking(np.array([0.0, -0.01, 3.0]), np.zeros(3), 45, (320, 200))
FLAGS = ["--headless=new", "--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
GROUND = (0.2, 0.25, 0.3)


def moving(count: int = 6, n: int = 400) -> list[tuple[Gaussians, np.ndarray]]:
    """Splats that fly, turn, and in part are born and die; ids are stable."""
    rng = np.random.default_rng(3)
    start, speed = rng.uniform(-0.5, 0.5, (n, 3)), rng.normal(0, 0.1, (n, 3))
    quats, scales = rng.normal(size=(n, 4)), rng.uniform(0.01, 0.06, (n, 3))
    rgb, opacity = rng.uniform(0, 1, (n, 3)), rng.uniform(0.2, 0.95, n)
    frames = []
    for k in range(count):
        alive = (np.arange(n) >= 15 * k) & (np.arange(n) < n - 100 + 20 * k)
        g = Gaussians.isotropic(start + 0.2 * k * speed, 1.0, rgb, opacity)
        turned = quats + 0.05 * k
        g = replace(g, quats=turned / np.linalg.norm(turned, axis=1, keepdims=True), scales=scales)
        order = rng.permutation(np.flatnonzero(alive))  # files need not keep an order
        frames.append((g.select(order), order.astype(np.int32) + 7))
    return frames


def page_of(path: Path, frames, terrain=None, **changes) -> Path:
    held = Quantization.of(g for g, _ in frames)
    numbers = tuple(range(1001, 1001 + len(frames)))
    scene = PageScene(
        "a <river> & more", CAMERA, (0.0, 0.0, 0.0), 0.04, numbers, np.zeros((4, 6, 3), np.uint8), terrain
    )
    return write_page(path, iter(frames), held, replace(scene, **changes))[0]


def square(z: float) -> TriangleMesh:
    corners = np.array([[-2, -2, z], [2, -2, z], [2, 2, z], [-2, 2, z]], np.float32)
    return TriangleMesh(corners, np.array([[0, 1, 2], [0, 2, 3]]), np.tile(np.float32([[0.9, 0.1, 0.1]]), (4, 1)))


def psnr(a: np.ndarray, b: np.ndarray) -> float:
    return float(-10 * np.log10(((np.clip(a, 0, 1) - np.clip(b, 0, 1)) ** 2).mean()))


def test_frames_come_back_as_near_as_their_bytes_allow():
    frames = moving()
    held = Quantization.of(g for g, _ in frames)
    encoder = FrameEncoder(held)
    packed = [encoder.encode(*f) for f in frames]
    for (g, _), records in zip(frames, decoded(packed, held.slots), strict=True):
        back = held.gaussians(records)
        assert len(back) == len(g)
        place = {tuple(p) for p in np.round((g.means.astype(float) - held.low) / held.step).astype(int).tolist()}
        assert {tuple(p) for p in np.round((back.means - held.low) / held.step).astype(int).tolist()} == place
        assert held.step <= 0.03 * np.median(g.scales) * 1.5  # far below what can be seen
        # orientation in 7 bits, and shapes that may lag by two steps: some 3 degrees and 4 %
        assert psnr(render(back, CAMERA).image, render(g, CAMERA).image) > 38


def test_what_stays_the_same_costs_next_to_nothing():
    g, ids = moving(1)[0]
    encoder = FrameEncoder(Quantization.of([g]))
    sizes = [len(encoder.encode(g, ids)) for _ in range(3)]
    # the second frame takes back the motion that the first one seemed to have
    assert sizes[2] < 0.02 * sizes[0]


def test_frames_without_splats_are_frames():
    full, ids = moving(1)[0]
    encoder = FrameEncoder(Quantization.of([full]))
    packed = [encoder.encode(Gaussians.empty(), ids[:0]), encoder.encode(full, ids),
              encoder.encode(Gaussians.empty(), ids[:0])]  # fmt: skip
    alive = [int((r[:, 15] > 0).sum()) for r in decoded(packed, len(full))]
    assert alive == [0, len(full), 0]


def test_the_page_names_no_other_file_and_says_its_size(tmp_path):
    path = page_of(tmp_path / "page.html", moving(), square(-0.6), warnings=("2 of 4 frames <dropped>",))
    text = path.read_text(encoding="utf-8")
    assert not re.findall(r"""(?:src|href)\s*=\s*["'](?!data:)""", text)
    assert "http" not in text.replace("http-equiv", "")
    assert "default-src 'none'" in text  # the browser itself would refuse to fetch anything
    assert "a &lt;river&gt; &amp; more" in text and "2 of 4 frames &lt;dropped&gt;" in text and "@" not in text[:600]
    told = re.search(r'id="size">"[^"]*?([\d.]+) MB"', text)
    assert told and float(told[1]) == pytest.approx(path.stat().st_size / 1e6, abs=0.051)
    about = json.loads(re.search(r'id="page">(.*?)</script>', text, re.S)[1])
    assert about["frames"] == 6 == text.count('class="frame"')


def test_a_title_that_reads_like_a_part_of_the_page_stays_a_title(tmp_path):
    text = page_of(tmp_path / "page.html", moving(2), title="@PAGE@ @FACTS@", facts=("3 splats",)).read_text()
    assert "<title>@PAGE@ @FACTS@</title>" in text and text.count("3 splats") == 1


def test_a_page_with_another_number_of_frames_is_not_left_behind(tmp_path):
    frames = moving()
    with pytest.raises(ValueError, match="6 frames"):
        page_of(tmp_path / "page.html", frames, numbers=(1001,))
    assert list(tmp_path.iterdir()) == []


@pytest.fixture(scope="module")
def chromium():
    """Headless; draws on the CPU."""
    program = shutil.which("chromium")
    playwright = pytest.importorskip("playwright.sync_api", reason="needs playwright")
    if program is None:
        pytest.skip("needs chromium (Debian: apt install chromium)")
    with playwright.sync_playwright() as p:
        found = p.chromium.launch(executable_path=program, args=FLAGS)
        yield found
        found.close()


@pytest.fixture
def browser(chromium):
    """A window of its own, which closes with the test: a page that stays open draws on, on the processor."""
    window = chromium.new_context(viewport={"width": CAMERA.size[0], "height": CAMERA.size[1]})
    yield window
    window.close()


class Visit:
    """An open page, with all that it said and asked for."""

    def __init__(self, browser, path: Path, script: str = "") -> None:
        self.said: list[str] = []
        self.page = browser.new_page()
        if script:
            self.page.add_init_script(script)
        self.page.on("console", lambda m: self.said.append(m.text))
        self.page.on("pageerror", lambda e: self.said.append(str(e)))
        self.page.on("request", lambda r: self.said.append(r.url) if r.url != path.as_uri() else None)
        self.page.goto(path.as_uri())
        self.run("fluidlift.ready")

    def run(self, script: str):
        return self.page.evaluate(script)

    def settled(self) -> None:
        """Waits until what was asked for is drawn, and the first picture, which lies above it, has faded."""
        end = time.monotonic() + 30
        faded = "getComputedStyle(document.getElementById('poster')).opacity === '0'"
        while (self.run("fluidlift.state.dirty") or not self.run(faded)) and time.monotonic() < end:
            time.sleep(0.02)
        self.run("new Promise(f => requestAnimationFrame(() => requestAnimationFrame(f)))")

    def picture(self) -> np.ndarray:
        """What is seen, without the controls: float [h,w,3]."""
        self.run("document.body.classList.add('bare')")
        self.settled()
        return np.asarray(Image.open(io.BytesIO(self.page.screenshot())).convert("RGB")) / 255.0

    def bare(self) -> None:
        rgb = [round(255 * c) for c in GROUND]
        self.run(f"fluidlift.background({rgb}); fluidlift.terrain(false)")


def test_the_browser_shows_what_our_rasteriser_draws(browser, tmp_path):
    frames = moving()
    visit = Visit(browser, page_of(tmp_path / "page.html", frames, square(-0.6)))
    visit.bare()
    for k in (0, 5):
        visit.run(f"fluidlift.show({k})")
        ours = render(frames[k][0], CAMERA, background=GROUND).image
        # 8-bit blending and the packed shapes; the same frame unpacked and drawn by ourselves has 40 dB
        assert psnr(visit.picture(), ours) > 36
    other = PinholeCamera.looking(np.array([2.0, 0.6, 0.2]), np.zeros(3), 45, CAMERA.size)
    visit.run(f"fluidlift.camera({json.dumps(other.to_dict())})")
    assert psnr(visit.picture(), render(frames[5][0], other, background=GROUND).image) > 36
    assert [s for s in visit.said if not s.startswith("data:")] == []


def test_it_plays_turns_and_is_hidden_by_the_ground(browser, tmp_path):
    visit = Visit(browser, page_of(tmp_path / "page.html", moving(), square(0.3)))
    visit.run("fluidlift.play(true)")
    began, end = visit.run("fluidlift.state.drawn"), time.monotonic() + 20
    seen = set()
    while len(seen) < 3 and time.monotonic() < end:
        seen.add(visit.run("fluidlift.state.frame"))
        time.sleep(0.02)
    assert len(seen) >= 3 and visit.run("fluidlift.state.drawn") > began
    visit.run("fluidlift.show(2)")
    ground = visit.picture()
    assert np.abs(ground - ground[0, 0]).max() > 0.2  # not blank
    visit.run("fluidlift.terrain(false)")
    open_ = visit.picture()
    assert np.abs(open_ - ground).mean() > 0.02  # the square above the splats hid them
    mouse = visit.page.mouse
    mouse.move(160, 100), mouse.down(), mouse.move(230, 120, steps=3), mouse.up()
    turned = visit.picture()
    assert np.abs(turned - open_).mean() > 0.01
    visit.run("fluidlift.zoom(0.5)")
    assert np.abs(visit.picture() - turned).mean() > 0.01
    assert [s for s in visit.said if not s.startswith("data:")] == []


def test_a_vessel_does_not_hide_what_it_holds(browser, tmp_path):
    frames = moving(2)
    visit = Visit(browser, page_of(tmp_path / "page.html", frames, square(0.6), terrain_opacity=0.25))
    visit.bare()
    visit.run("fluidlift.show(1); fluidlift.camera(" + json.dumps(ABOVE.to_dict()) + ")")
    alone = visit.picture()
    visit.run("fluidlift.terrain(true)")
    # the red square (0.9, 0.1, 0.1) stands half as dense behind the splats and a quarter before them
    red = np.array([0.9, 0.1, 0.1])
    alpha = render(frames[1][0], ABOVE).alpha[..., None]
    expected = alone + (1 - alpha) * 0.5 * (red - GROUND)
    expected = 0.25 * red + 0.75 * expected
    assert psnr(visit.picture(), expected) > 34  # three roundings to 8 bits, and the packed shapes


def block(frames: int) -> MovingMesh:
    """A blue box of 0.4 m that goes half a metre along x over the frames and ends on its side."""
    box = box_mesh((0.4, 0.4, 0.1))
    box = TriangleMesh(box.vertices, box.faces, np.tile(np.float32([[0.1, 0.2, 0.9]]), (len(box.vertices), 1)))
    along = np.linspace(0, 0.5, frames)
    turn = np.linspace(0, np.pi / 4, frames)
    poses = np.stack([along, 0 * along, 0 * along], 1), np.stack([np.cos(turn), 0 * turn, np.sin(turn), 0 * turn], 1)
    return MovingMesh("block", box, *poses)


def test_solid_bodies_stand_where_they_are_in_each_frame(browser, tmp_path):
    inside = [Gaussians.isotropic(p[None], 0.005, np.ones((1, 3)), np.ones(1)) for p in block(6).positions]
    frames = [(g, np.zeros(1, int)) for g in inside]  # a spark within the body, which hides it
    visit = Visit(browser, page_of(tmp_path / "page.html", frames, square(-0.6), bodies=(block(6),)))
    visit.bare()
    visit.run("fluidlift.camera(" + json.dumps(ABOVE.to_dict()) + ")")
    for k, width in ((0, 0.4), (5, 0.1)):
        visit.run(f"fluidlift.show({k})")
        seen = np.argwhere(np.abs(visit.picture() - GROUND).max(axis=2) > 0.2)[:, ::-1] + 0.5
        size = np.array([width, 0.4, 0.5 - width])  # on its side, its height lies along x
        corners = block(6).positions[k] + 0.5 * size * [[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]
        pixels = ABOVE.project(corners)[0]
        np.testing.assert_allclose(seen.min(axis=0), pixels.min(axis=0), atol=1.5)  # whole pixels
        np.testing.assert_allclose(seen.max(axis=0), pixels.max(axis=0), atol=1.5)
    visit.run("fluidlift.bodies(false)")
    assert (np.abs(visit.picture() - GROUND).max(axis=2) > 0.2).sum() < 10  # the spark alone
    assert [s for s in visit.said if not s.startswith("data:")] == []


def test_splats_before_a_body_cover_it_and_those_behind_do_not(browser, tmp_path):
    frames = moving(2)
    pictures = {}
    for z in (-0.9, 0.9):
        still = MovingMesh("plate", square(z), np.zeros((2, 3)), np.tile([1.0, 0, 0, 0], (2, 1)))
        visit = Visit(browser, page_of(tmp_path / f"{z}.html", frames, bodies=(still,)))
        visit.bare()
        visit.run("fluidlift.show(1); fluidlift.camera(" + json.dumps(ABOVE.to_dict()) + ")")
        pictures[z] = visit.picture()
    middle = np.s_[90:110, 150:170]
    assert pictures[0.9][middle].std(axis=(0, 1)).max() < 0.01  # the plate alone, in one colour
    alpha = render(frames[1][0], ABOVE).alpha[..., None]
    assert np.abs(pictures[-0.9] - pictures[0.9])[alpha[..., 0] > 0.5].mean() > 0.1


def test_bodies_with_other_frames_are_refused(tmp_path):
    with pytest.raises(ValueError, match="one for each frame"):
        page_of(tmp_path / "page.html", moving(), bodies=(block(5),))
    assert list(tmp_path.iterdir()) == []


def test_the_controls_do_what_they_say(browser, tmp_path):
    visit = Visit(browser, page_of(tmp_path / "page.html", moving(), square(-0.6)))
    page = visit.page
    page.set_viewport_size({"width": 800, "height": 500})
    visit.run("fluidlift.play(false)")
    page.locator("#scrub").fill("4")
    assert visit.run("fluidlift.state.frame") == 4 and "1005" in page.locator("#time").inner_text()
    light = visit.run("document.documentElement.classList.contains('light')")
    page.locator("#theme").click()
    assert visit.run("document.documentElement.classList.contains('light')") != light
    page.locator("#ground").click()
    assert page.locator("#ground").get_attribute("aria-pressed") == "false"
    page.locator("#play").click()
    assert visit.run("fluidlift.state.playing")
    page.keyboard.press("ArrowLeft")
    assert not visit.run("fluidlift.state.playing")
    assert [s for s in visit.said if not s.startswith("data:")] == []


def test_it_swings_until_somebody_touches_it(browser, tmp_path):
    visit = Visit(browser, page_of(tmp_path / "page.html", moving(), square(-0.6)))
    visit.run("fluidlift.play(true)")
    end = time.monotonic() + 20
    while not abs(visit.run("fluidlift.state.yaw")) > 0.02 and time.monotonic() < end:
        time.sleep(0.05)
    assert visit.run("fluidlift.state.swinging") and 0.02 < abs(visit.run("fluidlift.state.yaw")) <= 0.2
    visit.page.mouse.click(150, 100)
    at = visit.run("fluidlift.state.yaw")
    assert not visit.run("fluidlift.state.swinging")
    time.sleep(0.3)
    assert visit.run("fluidlift.state.yaw") == at


def test_a_slow_machine_leaves_frames_out_and_goes_on(browser, tmp_path):
    """Each picture takes longer than the whole film: what is shown are other frames each time, not the first."""
    path = page_of(tmp_path / "page.html", moving())
    slow = """window.requestAnimationFrame = (f) => {
      window.late = (window.late || 0) + 710; return setTimeout(() => f(window.late), 5); };"""
    visit = Visit(browser, path, slow)
    visit.run("fluidlift.play(true)")
    seen, end = set(), time.monotonic() + 20
    while len(seen) < 3 and time.monotonic() < end:
        seen.add(visit.run("fluidlift.state.frame"))
        time.sleep(0.02)
    assert len(seen) >= 3


def test_two_fingers_come_nearer(browser, tmp_path):
    path = page_of(tmp_path / "page.html", moving())
    visit = Visit(browser, path)
    visit.bare()
    visit.run("fluidlift.show(1)")
    before = visit.picture()
    touch = """(at) => { const c = document.getElementById('stage'); c.setPointerCapture = () => {};
      const send = (kind, id, x, y) => c.dispatchEvent(new PointerEvent(kind, {pointerId: id, clientX: x, clientY: y,
        pointerType: 'touch', buttons: 1, bubbles: true}));
      send('pointerdown', 11, 140, 100); send('pointerdown', 12, 180, 100);
      for (let k = 1; k <= 5; k++) {
        send('pointermove', 11, 140 - 8 * k, 100); send('pointermove', 12, 180 + 8 * k, 100); }
      send('pointerup', 11, 100, 100); send('pointerup', 12, 220, 100); }"""
    visit.page.evaluate(touch, None)
    back = np.float32(GROUND)
    covered = [(np.abs(p - back).max(axis=-1) > 0.1).mean() for p in (before, visit.picture())]
    assert covered[1] > 1.3 * covered[0]
