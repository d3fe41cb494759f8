"""The fast tier refuses arrays that the annotations do not allow, and leaves compiled functions as they are."""

import os
import subprocess
import sys
from pathlib import Path

import array_shapes
import numpy as np
import pytest
from conftest import FAST
from jaxtyping import Float

import fluidlift

WRONG = """
import numpy as np
import array_shapes
array_shapes.install()
from fluidlift.types.gaussians import Gaussians, sh_from_rgb
from jaxtyping import TypeCheckError
assert sh_from_rgb(np.zeros((5, 3))).shape == (5, 1, 3)
for wrong in (np.zeros((5, 4)), np.zeros((5, 3), int)):
    try:
        sh_from_rgb(wrong)
    except TypeCheckError as error:
        print(error)
    else:
        raise SystemExit(f"taken: {wrong.shape}")
"""

COMPILED = """
import sys
import numpy as np
import array_shapes
if "checked" in sys.argv:
    array_shapes.install()
from fluidlift.numerics import sampling, components
assert hasattr(sampling.sample_faces, "__wrapped__") == ("checked" in sys.argv)
components._root(np.zeros(4, np.int64), 2)
print(sum(components._root.stats.cache_hits.values()), sum(components._root.stats.cache_misses.values()))
"""


def said_by(code, *arguments, **environment):
    """Standard output of a program that knows the tests' modules."""
    found = subprocess.run(
        [sys.executable, "-c", code, *arguments], cwd=Path(__file__).parent, capture_output=True, text=True,
        env=os.environ | {"PYTHONPATH": str(Path(fluidlift.__file__).parents[1])} | environment,
    )  # fmt: skip
    assert found.returncode == 0, found.stderr
    return found.stdout


def test_a_function_that_would_take_a_wrong_shape_or_type_refuses_it():
    lines = said_by(WRONG).splitlines()
    assert lines[0] == (
        "sh_from_rgb: rgb is no <class 'jaxtyping.Float[ndarray, 'n 3']'>, or other arrays have other sizes: "
        "rgb float64[5, 4], return float32[5, 1, 4]"
    )
    assert len(lines) == 2


def test_compiled_functions_come_from_the_cache_that_they_have_without_the_checks(tmp_path):
    assert said_by(COMPILED, NUMBA_CACHE_DIR=str(tmp_path)).split() == ["0", "1"]
    assert said_by(COMPILED, "checked", NUMBA_CACHE_DIR=str(tmp_path)).split() == ["1", "0"]


def test_sizes_are_shared_by_the_arguments_and_the_result():
    namespace = {"np": np, "Float": Float, "__name__": __name__}
    exec(
        "from __future__ import annotations\n"
        "def nodes(cells: Float[np.ndarray, 'n'], at: Float[np.ndarray, 'n+1'] | None = None)"
        " -> Float[np.ndarray, 'n+1']: return np.zeros(4)\n",
        namespace,
    )
    nodes = array_shapes.checked(namespace["nodes"])
    assert nodes(np.zeros(3)).shape == nodes(np.zeros(3), at=np.zeros(4)).shape == (4,)
    for wrong in ((np.zeros(4),), (np.zeros(3), np.zeros(3))):
        with pytest.raises(array_shapes.TypeCheckError, match=r"^nodes: (at|return) is no .*float64\[4\]"):
            nodes(*wrong)


def test_what_refuses_a_wrong_array_itself_does_so_in_its_own_words_and_fields_count_as_they_are_kept():
    namespace = {"np": np, "Float": Float, "__name__": __name__}
    exec(
        "from __future__ import annotations\n"
        "from dataclasses import dataclass\n"
        "@dataclass(frozen=True)\n"
        "class Row:\n"
        "    values: Float[np.ndarray, 'n 3']\n"
        "    def __post_init__(self):\n"
        "        if len(self.values) == 0: raise ValueError('no values')\n"
        "        object.__setattr__(self, 'values', np.asarray(self.values, float))\n",
        namespace,
    )
    row = namespace["Row"]
    array_shapes.check_class(row)
    assert row([[1, 2, 3]]).values.dtype == float
    with pytest.raises(ValueError, match="no values"):
        row([])
    with pytest.raises(array_shapes.TypeCheckError, match=r"^Row: values is no .*float64\[1, 2\]"):
        row([[1, 2]])


def test_the_fast_tier_checks_and_other_runs_do_not(pytestconfig):
    on = any(isinstance(finder, array_shapes.Finder) for finder in sys.meta_path)
    assert on == bool(FAST.fullmatch(pytestconfig.getoption("markexpr")))
    assert all(FAST.fullmatch(chosen) for chosen in ("unit", "whole", "unit or whole"))
    assert not any(FAST.fullmatch(chosen) for chosen in ("", "not unit", "ladder", "unit or ladder"))
