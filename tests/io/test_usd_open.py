"""USD files of strangers: what they name is read from the layers before a stage composes any of it."""

from __future__ import annotations

import pytest
from fuzz.corpus import USDA
from pxr import Sdf, Usd

from fluidlift.errors import InputRejected
from fluidlift.io.usd_open import open_stage
from fluidlift.io.validate_usd import validate_usd

SECRET = "a word of another file"
HEAD = '#usda 1.0\n(\n    defaultPrim = "A"\n    {layer}\n)\ndef Xform "A" (\n    {prim}\n)\n{{\n    {inner}\n}}\n'
DOORS = {
    "sublayer": {"layer": "subLayers = [@{name}@]"},
    "reference": {"prim": "prepend references = @{name}@</A>"},
    "payload": {"prim": "prepend payload = @{name}@</A>"},
    "clips": {"prim": "clips = {{ dictionary default = {{ asset[] assetPaths = [@{name}@]; "
                      'string primPath = "/A" }} }}'},
    "variant": {"prim": 'variantSets = "v"\n variants = {{ string v = "a" }}',
                "inner": 'variantSet "v" = {{ "a" ( prepend references = @{name}@</A> ) {{ }} }}'},
    "texture": {"inner": "asset inputs:file = @{name}@"},
}  # fmt: skip


def layer(door: str, name: str) -> str:
    parts = {"layer": "", "prim": "", "inner": ""} | {k: v.format(name=name) for k, v in DOORS[door].items()}
    return HEAD.format(**parts)


@pytest.fixture
def inside(tmp_path):
    """A folder, with a file beside it that is no business of what is in it."""
    (tmp_path / "outside.usda").write_text(f'#usda 1.0\ndef "A" {{ {SECRET}')
    (tmp_path / "asset").mkdir()
    return tmp_path / "asset"


@pytest.fixture
def opened():
    """Names of the files that OpenUSD holds open as layers."""
    return lambda: {str(found.realPath) for found in Sdf.Layer.GetLoadedLayers()}


@pytest.mark.parametrize("door", DOORS)
@pytest.mark.parametrize("name", ["../outside.usda", "ABSOLUTE", "link.usda", "outside.usda", "file:///outside.usda"])
def test_a_file_outside_is_refused_before_it_is_opened(inside, opened, monkeypatch, door, name):
    outside = inside.parent / "outside.usda"
    monkeypatch.chdir(inside.parent)  # where a bare name is looked for that is not beside its layer
    (inside / "link.usda").symlink_to(outside)
    (inside / "a.usda").write_text(layer(door, str(outside) if name == "ABSOLUTE" else name))
    with pytest.raises(InputRejected, match="names files outside the folder") as refused:
        open_stage(inside / "a.usda")
    assert SECRET not in str(refused.value)
    assert str(outside) not in opened()
    assert validate_usd(inside / "a.usda")[0].startswith("cannot be opened")


@pytest.mark.parametrize("door", ["sublayer", "reference", "payload", "variant"])
def test_layers_of_layers_are_asked_too(inside, door):
    (inside / "a.usda").write_text(layer(door, "./deep/b.usda"))
    (inside / "deep").mkdir()
    (inside / "deep" / "b.usda").write_text(layer("payload", "../../outside.usda"))
    with pytest.raises(InputRejected, match=r"\.\./\.\./outside\.usda"):
        open_stage(inside / "a.usda")


def test_layers_that_name_each_other_and_files_inside_are_opened(inside):
    (inside / "a.usda").write_text(layer("reference", "./b.usda"))
    (inside / "b.usda").write_text(layer("sublayer", "a.usda"))
    assert isinstance(open_stage(inside / "a.usda"), Usd.Stage)


def test_a_damaged_layer_is_refused_in_one_line(inside):
    (inside / "a.usda").write_text(layer("sublayer", "./b.usda"))
    (inside / "b.usda").write_bytes(b"#usda 1.0\n\xff\xfe def")
    with pytest.raises(InputRejected, match="cannot be read") as refused:
        open_stage(inside / "a.usda")
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize(
    ("found", "spoilt", "fault"),
    [
        ("point3f[] positions = [(0, 0, 0), (1, 0, 0)]", "float positions = 1", "another type"),
        ("int64[] ids = [1, 2]", 'string[] ids = ["a", "b"]', "another type"),
        ("endTimeCode = 1002", "endTimeCode = 1e18", "time codes"),
        ("startTimeCode = 1001", "startTimeCode = nan", "time codes"),
    ],
)
def test_values_of_the_wrong_type_are_faults(inside, found, spoilt, fault):
    text = USDA.decode().replace("@./other.usda@</Fluid>", "</Fluid/Points>")
    assert found in text
    (inside / "a.usda").write_text(text.replace(found, spoilt))
    assert any(fault in line for line in validate_usd(inside / "a.usda"))
