"""The public face: its names exist, come late, and are the ones that editors see."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

import fluidlift

STUB = Path(fluidlift.__file__).with_suffix(".pyi")


@pytest.mark.parametrize("name", fluidlift.__all__)
def test_a_name_of_the_face_is_what_its_module_calls_by_that_name(name):
    value = getattr(fluidlift, name)
    assert value is getattr(fluidlift, name)  # the second time without an import
    assert name.startswith("__") or value.__name__ == name


def test_an_unknown_name_is_an_attribute_error_that_lists_the_known_ones():
    with pytest.raises(AttributeError, match=r"no attribute 'mak'.*load_asset.*make"):
        fluidlift.mak  # noqa: B018


def test_editors_see_the_names_and_places_that_are_there():
    tree = ast.parse(STUB.read_text(encoding="utf-8"))
    imports = [n for n in tree.body if isinstance(n, ast.ImportFrom)]
    seen = {a.name: i.module for i in imports for a in i.names}
    assert seen == fluidlift._MODULE_OF
    assert set(dir(fluidlift)) >= set(fluidlift.__all__)


def test_importing_the_package_imports_nothing_heavy():
    code = "import sys, fluidlift; print(sorted({'numpy', 'torch', 'numba', 'cv2', 'scipy'} & set(sys.modules)))"
    found = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert found.stdout.strip() == "[]"
