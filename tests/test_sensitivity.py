"""The tuned numbers are all found, one of them is scaled wherever it is held, and trials are judged by their bounds."""

import importlib
import inspect
import sys
from pathlib import Path

import numpy as np
import pytest

FOLDER = Path(__file__).resolve().parent.parent / "benchmarks"


@pytest.fixture(scope="module")
def tuned():
    sys.path.insert(0, str(FOLDER))
    yield importlib.import_module("sensitivity_constants")
    sys.path.remove(str(FOLDER))


@pytest.fixture(scope="module")
def numbers(tuned):
    return tuned.constants()


@pytest.fixture(scope="module")
def page(tuned):
    return importlib.import_module("sensitivity_page")


def test_whole_numbers_stay_whole_and_collections_keep_their_form(tuned):
    assert tuned.scaled(3, 0.5) == 2 and isinstance(tuned.scaled(3, 0.5), int)
    assert tuned.scaled(1, 0.5) == 1
    assert tuned.scaled((1.0, (4, -2.0)), 2.0) == (2.0, (8, -4.0))
    assert tuned.scaled({"a": 0.25}, 2.0) == {"a": 0.5}
    np.testing.assert_array_equal(tuned.scaled(np.array([1.0, 3.0]), 0.5), [0.5, 1.5])


def test_numbers_are_found_also_where_several_share_a_line_and_limits_of_memory_are_left_out(numbers):
    found, left_out = numbers
    keys = {c.key for c in found}
    assert {"shape.kind.LEAST_SURE", "shape.view.habit.OPEN_OVER", "shape.view.habit.OPEN_DOWN"} <= keys
    assert "shape.fill.CELLS_MAX" in left_out and not keys & set(left_out)
    early = {c.key for c in found if c.at_import}
    # a default argument; a constant made of another; a compiled kernel that holds it
    assert {"shape.depth_surface.SLOPES", "shape.generate.SHORE", "motion.multiframe.TRIM"} <= early
    assert "shape.kind.LEAST_SURE" not in early


def test_a_number_is_scaled_in_every_module_that_imports_it(tuned, monkeypatch):
    names = ("view.habit", "kind", "slope", "jets", "depth_surface", "drawn_flow")
    holders = [importlib.import_module(f"fluidlift.shape.{name}") for name in names]
    before = holders[0].ROLL
    for module in holders:
        monkeypatch.setattr(module, "ROLL", before)  # put back afterwards
    tuned.set_in_place(tuned.Constant("shape.view.habit", "ROLL", False), 2.0)
    assert [module.ROLL for module in holders] == [2.0 * before] * len(holders)


def test_a_number_counts_as_read_on_lines_that_were_run_alone(tuned, numbers):
    jets = importlib.import_module("fluidlift.shape.jets")
    found = [c for c in numbers[0] if c.name == "ROLL"]
    code = inspect.unwrap(jets.roll_of).__code__
    lines = {(code, line) for *_, line in code.co_lines() if line is not None}
    assert "shape.view.habit.ROLL" in tuned.reads(lines, found)
    assert tuned.reads({(code, code.co_firstlineno)}, found) == set()


def test_a_trial_matters_beyond_the_spread_of_other_seeds(page):
    seeds = {f"pour-{k}": {"mask": 0.90 + 0.01 * k, "up": 2.0} for k in range(3)}
    bound = page.bounds(seeds)
    assert bound == pytest.approx({"mask": 0.01})  # a figure that no seed changes has no bound
    rows = [{"scene": "pour", "constant": "", "factor": 1.0, "changed": [], "figures": {"mask": 0.9, "up": 2.0}}]
    for key, mask in (("a", 0.8), ("b", 0.895), ("c", 0.9)):
        changed = ["segment"] if mask != 0.9 else []
        rows.append({"scene": "pour", "constant": key, "factor": 2.0, "changed": changed,
                     "figures": {"mask": mask} if changed else {}})  # fmt: skip
    rows.append({"scene": "pour", "constant": "d", "factor": 2.0, "failed": "ValueError"})
    found = page.judged(rows, bound)
    assert [found[k]["class"] for k in "abcd"] == ["matters", "little", "nothing", "ends the run"]
    assert found["a"]["size"] == pytest.approx(10.0) and found["a"]["change"] == pytest.approx(-0.1)
