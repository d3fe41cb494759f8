"""A change of the source is seen where it is used, and nowhere else."""

import time

import pytest

from fluidlift.source import ROOT, Sources

FILES = {
    "__init__.py": '__version__ = "1"\n',
    "stage.py": "from house import __version__\nfrom house.room import lamp, door as gate\nfrom house.tools import x\n",
    "room/__init__.py": "from house.room import unused\n",
    "room/lamp.py": "def light():\n    from house.room.bulb import glow\n    return glow\n",
    "room/door.py": "import house.lock\n",
    "room/bulb.py": "glow = 1\n",
    "room/unused.py": "",
    "lock.py": "from house.room import (\n    lamp,  # in rings, too\n)\n",
    "tools/__init__.py": "from house.tools.steel import saw\n",
    "tools/steel.py": "saw = 2\n",
    "garden.py": "",
    "kinds/__init__.py": 'def of(kind):\n    return import_module(f"{__name__}.{kind}").BUILDER\n',
    "kinds/roof.py": "",
    "choice.py": "from house.kinds import of\n",
}


@pytest.fixture
def house(tmp_path):
    """A small package; `hash(module)` looks at its files anew."""
    root = tmp_path / "house"
    for name, text in FILES.items():
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).write_text(text)
    return root


def test_imports_are_found_at_the_top_and_inside_functions_by_module_and_by_name(house):
    sources = Sources(house)
    assert sources.imports("house.stage") == {"house.room.lamp", "house.room.door", "house.tools"}
    assert sources.imports("house.room.lamp") == {"house.room.bulb"}
    assert sources.imports("house.room.door") == {"house.lock"}
    assert sources.imports("house.lock") == {"house.room.lamp"}
    assert sources.imports("house.tools") == {"house.tools.steel"}


@pytest.mark.parametrize(
    "name", ["stage", "room/lamp", "room/door", "room/bulb", "lock", "tools/__init__", "tools/steel"]
)
def test_a_change_of_what_a_module_uses_changes_its_hash(house, name):
    before = Sources(house).hash("house.stage")
    file = house / f"{name}.py"
    file.write_text(file.read_text() + "# changed\n")
    assert Sources(house).hash("house.stage") != before


@pytest.mark.parametrize("name", ["__init__", "garden", "room/__init__", "room/unused"])
def test_a_change_of_anything_else_does_not(house, name):
    before = Sources(house).hash("house.stage")
    file = house / f"{name}.py"
    file.write_text(file.read_text() + "# changed\n")
    assert Sources(house).hash("house.stage") == before


def test_a_package_that_finds_its_modules_by_name_uses_all_of_them(house):
    assert Sources(house).closure("house.choice") == {"house.choice", "house.kinds", "house.kinds.roof"}


def test_a_module_that_moves_changes_the_hash(house):
    before = Sources(house).hash("house.stage")
    (house / "tools" / "steel.py").rename(house / "tools" / "iron.py")
    (house / "tools" / "__init__.py").write_text("from house.tools.iron import saw\n")
    assert Sources(house).hash("house.stage") != before


def test_a_module_without_a_file_is_no_reason_to_stop(house):
    assert Sources(house).hash("elsewhere") == Sources(house).hash("elsewhere") != Sources(house).hash("house.stage")


def test_each_stage_knows_what_it_uses_and_no_other_stage():
    sources = Sources(ROOT)
    stages = sorted(p.stem for p in (ROOT / "pipeline" / "stages").glob("*.py") if p.stem != "__init__")
    assert stages == [
        "calibrate", "correct", "elsewhere", "fit", "flow", "generate", "geometry", "motion", "read", "refine",
        "segment", "show", "simulate", "window",
    ]  # fmt: skip
    for name in stages:
        used = sources.closure(f"fluidlift.pipeline.stages.{name}")
        assert "fluidlift.types.stages" in used
        others = {m for m in used if m.startswith("fluidlift.pipeline.stages.")}
        assert others == {f"fluidlift.pipeline.stages.{name}"}
        assert not {"fluidlift.pipeline.runner", "fluidlift.pipeline.make", "fluidlift.cli"} & used


def test_all_of_the_package_takes_less_time_than_a_person_notices():
    best = 1.0
    for _ in range(3):
        began = time.perf_counter()
        Sources(ROOT).hash("fluidlift.pipeline.make")
        best = min(best, time.perf_counter() - began)
    assert best < 0.2  # s; 0.02 to 0.05 on an idle machine
