"""What the documents say exists, exists."""

import dataclasses
import importlib
import re
import typing
from pathlib import Path

import pytest

from fluidlift import cli
from fluidlift.cli.options import options_of
from fluidlift.config import build_config
from fluidlift.io.scene import SceneEdits
from fluidlift.io.scene_look import Look
from fluidlift.types import FluidParameters
from fluidlift.types.parameter_table import PARAMETERS

INFLOW = ("factor", "keyframes", "fluctuation", "period")
ROOT = Path(__file__).resolve().parent.parent
PAGES = [ROOT / name for name in ("README.md", "CONTRIBUTING.md", "CHANGELOG.md", "SECURITY.md")]
PAGES += sorted((ROOT / "docs").glob("**/*.md"))
HISTORY = {"CHANGELOG.md", "2026-11-changes.md"}
"""pages on what was once: names in them need not be there any more"""
COMMANDS = {c.__name__.lower(): c for c in typing.get_args(cli.Command)}


def code_of(text: str) -> str:
    """Code blocks and code spans of a page."""
    blocks = re.findall(r"^```.*?^```", text, flags=re.M | re.S)
    spans = re.findall(r"`([^`\n]+)`", re.sub(r"^```.*?^```", "", text, flags=re.M | re.S))
    return "\n".join(blocks + spans)


def paper_map() -> str:
    return (ROOT / "docs" / "paper_map.md").read_text(encoding="utf-8")


def resolve(name: str) -> object:
    """The thing with a dotted name: the longest importable module, then attributes."""
    parts = name.split(".")
    for n in range(len(parts), 0, -1):
        try:
            found: object = importlib.import_module(".".join(parts[:n]))
        except ModuleNotFoundError:
            continue
        for part in parts[n:]:
            found = getattr(found, part)
        return found
    raise AttributeError(name)


def test_every_function_in_the_paper_map_exists():
    names = sorted(set(re.findall(r"`(fluidlift(?:\.\w+)+)`", paper_map())))
    assert len(names) > 30
    missing = []
    for name in names:
        try:
            resolve(name)
        except AttributeError:
            missing.append(name)
    assert not missing


def test_every_test_in_the_paper_map_exists():
    files = sorted(set(re.findall(r"`(tests/[\w/]+\.py)`", paper_map())))
    assert len(files) > 15
    assert [f for f in files if not (ROOT / f).is_file()] == []


def test_a_function_of_the_paper_map_is_named_by_its_test():
    """A row whose test does not even mention the module it stands for points to the wrong file."""
    wrong = []
    for line in paper_map().splitlines():
        modules = {name.rsplit(".", 1)[0] for name in re.findall(r"`(fluidlift(?:\.\w+)+)`", line)}
        files = re.findall(r"`(tests/[\w/]+\.py)`", line)
        text = "".join((ROOT / f).read_text(encoding="utf-8") for f in files)
        for module in modules:
            package, _, last = module.rpartition(".")
            plain = re.search(rf"from {re.escape(module)} import|import {re.escape(module)}\b", text)
            inside = re.search(rf"from {re.escape(package)} import [^\n]*\b{last}\b", text)
            if files and not (plain or inside) and not package.endswith("pipeline"):
                wrong.append((module, files))
    assert wrong == []


@pytest.mark.parametrize("page", PAGES, ids=lambda p: p.name)
def test_relative_links_lead_to_files(page):
    text = page.read_text(encoding="utf-8")
    links = [link for link in re.findall(r"\]\(([^)\s]+)\)", text) if not re.match(r"https?:|#|mailto:", link)]
    assert [link for link in links if not (page.parent / link.split("#")[0]).exists()] == []


@pytest.mark.parametrize("page", PAGES, ids=lambda p: p.name)
def test_commands_and_settings_in_the_documents_exist(page):
    code = code_of(page.read_text(encoding="utf-8"))
    used = set(re.findall(r"(?:^|[\s/`])(?<!import )fluidlift ([a-z]+)\b", code))
    assert used <= set(COMMANDS)
    for setting in set(re.findall(r"--set ([\w.]+=[\w.-]+)", code)) - {"section.name=value", "PLACE=VALUE"}:
        if not is_scene_entry(setting.partition("=")[0]):  # `edit` sets those of scene.yaml by the same option
            build_config(overrides=[setting])  # raises on an unknown name or a wrong value


@pytest.mark.parametrize("page", ["README.md", "docs/cli.md", "docs/troubleshooting.md", "SECURITY.md"])
def test_options_in_the_documents_exist(page):
    known = {name.replace("_", "-") for c in COMMANDS.values() for name in options_of(c)} | {"help", "version"}
    code = code_of((ROOT / page).read_text(encoding="utf-8"))
    assert set(re.findall(r"(?<![\w-])--([a-z][a-z-]*)", code)) <= known


def test_the_readme_names_every_command():
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    assert [c for c in COMMANDS if f"`fluidlift {c}" not in text] == []


def test_the_python_example_of_the_readme_uses_what_there_is():
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    (example,) = re.findall(r"^```python\n(.*?)^```", text, flags=re.M | re.S)
    compile(example, "README.md", "exec")
    beginning = example.split("made = ")[0]  # what follows takes minutes
    names: dict[str, object] = {}
    exec(beginning, names)
    assert names["config"] == build_config("draft", overrides=["fit.max_work=2e8"])
    face = set(re.findall(r"\bfl\.(\w+)", example))
    assert len(face) >= 4 and all(callable(getattr(names["fl"], name)) for name in face)


SECTIONS = (
    "shape",
    "motion",
    "fit",
    "look",
    "io",
    "numerics",
    "physics",
    "scene",
    "present",
    "export",
    "pipeline",
    "backends",
    "evaluate",
    "segment",
)


def is_scene_entry(name: str) -> bool:
    """Whether scene.yaml has such an entry; of lists, whether there is such a list."""
    section, _, field = name.partition(".")
    known = {f.name for f in dataclasses.fields(SceneEdits)}
    parts = {"parameters": FluidParameters(), "look": Look(), "inflow": None}
    if section not in parts or not field:
        return section in known
    return field in INFLOW if section == "inflow" else hasattr(parts[section], field)


def is_setting(name: str) -> bool:
    section, _, field = name.partition(".")
    return hasattr(getattr(build_config(), section, None), field)


@pytest.mark.parametrize("page", [p for p in PAGES if p.name not in HISTORY], ids=lambda p: p.name)
def test_dotted_names_in_the_documents_are_modules_functions_or_settings(page):
    """Such as `shape.slope`, `motion.optical_flow.estimate_flow` and `fit.method`."""
    spans = set(
        re.findall(rf"`(?!scene\.yaml)((?:{'|'.join(SECTIONS)})\.[a-z_][\w.]*)`", page.read_text(encoding="utf-8"))
    )
    missing = []
    for name in sorted(n for n in spans if not n.endswith(".json") and not (is_setting(n) or is_scene_entry(n))):
        try:
            resolve(f"fluidlift.{name}")
        except AttributeError:
            missing.append(name)
    assert missing == []


@pytest.mark.parametrize("package", ["shape", "motion", "fit", "look", "scene", "present", "export", "pipeline"])
def test_the_drawing_of_the_house_names_every_module(package):
    text = (ROOT / "docs" / "design.md").read_text(encoding="utf-8")
    (drawing,) = re.findall(r"^```\nsrc/fluidlift/\n.*?^```", text, flags=re.M | re.S)
    (room,) = re.findall(rf"^  {package}/ .*?(?=^  \w+/ |^```)", drawing, flags=re.M | re.S)
    modules = {p.stem for p in (ROOT / "src" / "fluidlift" / package).glob("*.py")} - {"__init__"}
    assert modules - set(re.findall(r"\w+", room)) == set()


def test_sections_that_programs_fill_have_both_markers_in_order():
    pages = sorted((ROOT / "docs" / "experiments").glob("*.md"))
    found = [re.findall(r"^<!-- ([\w-]+):(begin|end) -->$", p.read_text(encoding="utf-8"), flags=re.M) for p in pages]
    assert sum(map(len, found)) >= 10
    for markers in found:
        assert all(a == (b[0], "begin") and b[1] == "end" for a, b in zip(markers[::2], markers[1::2], strict=True))


def test_the_table_of_parameters_in_editing_md_is_the_one_that_the_software_goes_by():
    text = (ROOT / "docs" / "editing.md").read_text(encoding="utf-8")
    section = text.split("### parameters\n")[1].split("\n### ")[0]
    raised, found = str.maketrans("⁻⁰¹²³⁴⁵⁶⁷⁸⁹−", "-0123456789-"), {}
    for names, unit, limits in re.findall(r"^\| (`.*?`) \| ?(.*?) \| (.*?) \|$", section, flags=re.M):
        ends = [
            re.sub(r"^10(?=[⁰-⁹⁻¹²³])", "1e", word).translate(raised) for word in limits.split(" each")[0].split(" to ")
        ]
        for name in re.findall(r"`(\w+)`", names):
            found[name] = unit.split(",")[0], tuple(map(float, ends)), "three numbers" in unit
    assert found == {name: (p.sign, p.limits, p.is_vector) for name, p in PARAMETERS.items()}
