"""Tiers, and what many tests start from: the small clip of a stream and the asset that is made from it."""

from __future__ import annotations

import json
import re
import time
from collections import defaultdict
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import array_shapes
import hypothesis
import numpy as np
import pytest
from catalogue import QUICK, Job, asset, stream_pictures, write_clip

hypothesis.settings.register_profile("untimed", deadline=None)  # a machine that is busy is no failure
hypothesis.settings.load_profile("untimed")

HASTY = (
    "--set", "shape.cells=12", "--set", "shape.refine_iterations=0", "--set", "motion.targets=1",
    "--set", "fit.max_seconds=0.5", "--set", "simulate.frames=2", "--set", "show.usd=false",
)  # fmt: skip
"""for tests that only ask what is said on the way"""

FOREIGN = {"backends", "blender"}
"""folders whose tests run a large package of others"""

BROWSER = {"browser", "visitor"}
"""fixtures that run a browser"""

CLUSTER = {"ray"}
"""fixtures that begin the processes of Ray"""

ASSET = {"made", "catalogue_asset", "finished", "finished_tank", "tank_folder"}
"""fixtures that make an asset, which takes seconds"""

FAST = re.compile(r"(unit|whole)( or (unit|whole))*")
"""what `-m` says where the fast tier is asked for, or a part of it"""

COMMAND_LINE = re.compile(r"from fluidlift\.cli import (\([^)]*|[^\n]*)\bmain\b")

DURATIONS = Path(__file__).with_name("durations.json")
"""s of each test that took over a second, and of whole files whose shared fixtures did, on two cores with nothing
compiled but what jobs call: a newcomer waits for what only tests compile; written by `pytest --record-durations`"""

SLOW = 1.5
"""s; what takes longer is no unit test: the tests of a newcomer are 4500, and end within five minutes"""


def recorded() -> dict[str, float]:
    """What tests, and files, took when it was written down, s."""
    return json.loads(DURATIONS.read_text(encoding="utf-8")) if DURATIONS.is_file() else {}


def slow_tests() -> set[str]:
    """Tests, and files, that took longer than a unit test may."""
    return {name for name, seconds in recorded().items() if seconds > SLOW}


def tier_of(item: pytest.Item, slow: set[str]) -> str:
    """One of the markers in pyproject.toml, by the test's folder, its fixtures and what its module calls."""
    room = item.path.relative_to(Path(__file__).parent).parts[0]
    fixtures = set(item.fixturenames)
    if room == "test_whole_asset.py":
        return "whole"
    if room in FOREIGN or (BROWSER | CLUSTER) & fixtures:
        return "foreign"
    if room == "fuzz":
        return "ladder"
    if ASSET & fixtures or COMMAND_LINE.search(item.path.read_text(encoding="utf-8")):
        return "asset"
    return "ladder" if {item.nodeid, item.nodeid.split("::")[0]} & slow else "unit"


def pytest_addoption(parser: pytest.Parser) -> None:
    """--record-durations."""
    parser.addoption("--record-durations", action="store_true", help="write tests/durations.json anew")


def pytest_configure(config: pytest.Config) -> None:
    """The fast tier checks the shapes of arrays; the controller of a run watches how long tests take."""
    if FAST.fullmatch(config.getoption("markexpr")):
        array_shapes.install()
    if not hasattr(config, "workerinput"):
        config.pluginmanager.register(Stopwatch(config.getoption("--record-durations")))


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Every test gets its tier."""
    slow = slow_tests()
    for item in items:
        item.add_marker(tier_of(item, slow))


class Stopwatch:
    """Adds up what each test takes, and tells of unit tests that are none."""

    def __init__(self, record: bool) -> None:
        self.record = record
        self.seconds: dict[str, float] = defaultdict(float)
        self.slow_units: set[str] = set()

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        """One phase of a test is done."""
        # a fixture that a file shares is paid for by whichever test comes first
        shared = report.when == "setup" and report.duration > SLOW
        name = report.nodeid.split("::")[0] if shared else report.nodeid
        self.seconds[name] += report.duration
        if "unit" in report.keywords and self.seconds[name] > SLOW:
            self.slow_units.add(name)

    def pytest_terminal_summary(self, terminalreporter: pytest.TerminalReporter) -> None:
        """Unit tests that took too long, or the file of durations."""
        if self.record:
            long = {name: round(s, 1) for name, s in self.seconds.items() if s > 1.0}
            kept = {name: s for name, s in recorded().items() if name not in self.seconds}
            DURATIONS.write_text(json.dumps(dict(sorted({**kept, **long}.items())), indent=1) + "\n", encoding="utf-8")
        elif self.slow_units:
            terminalreporter.section(f"unit tests that took over {SLOW:g} s here")
            for name in sorted(self.slow_units):
                terminalreporter.line(f"{self.seconds[name]:6.1f} s  {name}")


@pytest.fixture
def pictures() -> Callable[..., np.ndarray]:
    """`stream_pictures`."""
    return stream_pictures


@pytest.fixture
def clip_file() -> Callable[[Path, np.ndarray], Path]:
    """`write_clip`."""
    return write_clip


@pytest.fixture
def quick() -> tuple[str, ...]:
    """Options under which the small clip takes seconds."""
    return QUICK


@pytest.fixture
def hasty() -> tuple[str, ...]:
    """Options under which the small clip takes no time, and the result is worth nothing."""
    return HASTY


@pytest.fixture(scope="session")
def stream_clip(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The small clip."""
    return write_clip(tmp_path_factory.mktemp("clip") / "stream.mp4", stream_pictures())


@pytest.fixture(scope="session")
def made() -> Job:
    """The small clip as an asset. Tests read it; those that change it work on a copy."""
    return asset("stream")


@pytest.fixture(scope="session")
def catalogue_asset() -> Callable[[str], Job]:
    """Any asset of the catalogue, by its name."""
    return asset


@pytest.fixture
def patience_ends(monkeypatch):
    """Lets the time that a generator may take pass once a file is there, however long it takes until then."""
    from fluidlift.backends import generator_process

    def end(when: Path) -> None:
        clock = SimpleNamespace(sleep=time.sleep, monotonic=lambda: time.monotonic() + 1e6 * when.exists())
        monkeypatch.setattr(generator_process, "time", clock)

    return end


@pytest.fixture(scope="module")
def single_thread():
    """Small arrays, torch and Numba in turn: their thread pools would only wait for each other."""
    import numba
    import torch

    before = numba.get_num_threads(), torch.get_num_threads()
    numba.set_num_threads(1)
    torch.set_num_threads(1)
    yield
    numba.set_num_threads(before[0])
    torch.set_num_threads(before[1])
