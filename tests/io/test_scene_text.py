"""scene.yaml is changed in its text: what was not meant stays as it was written."""

import yaml
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from fluidlift.io.scene import SCENE_TEMPLATE, parse_yaml
from fluidlift.io.scene_text import with_item, with_value, without

NUMBERS = st.one_of(st.integers(-5, 5), st.floats(-1e6, 1e6), st.just(1e-9))
WORDS = st.sampled_from(["duck", "yes", "- a", "#x", "a: b", "1e5x", "null", "'", "ähre", " ", "2001-01-01", "{", "~"])
LEAVES = st.one_of(NUMBERS, WORDS, st.booleans(), st.lists(NUMBERS, max_size=3))
ENTRIES = st.dictionaries(st.sampled_from(["name", "radius", "size", "position", "keys"]), LEAVES, max_size=4)
SCENES = st.fixed_dictionaries(
    {},
    optional={
        "parameters": st.one_of(st.none(), ENTRIES),
        "obstacles": st.one_of(st.none(), st.lists(ENTRIES, max_size=3)),
        "look": ENTRIES,
        "duration": NUMBERS,
    },
)
STYLES = st.fixed_dictionaries(
    {"default_flow_style": st.sampled_from([True, False, None]), "indent": st.integers(2, 4)}
)


def comments(text):
    return [line.strip() for line in text.splitlines() if line.strip().startswith("# ")]


@st.composite
def written(draw):
    """A scene as some person wrote it: block or flow style, with comments between the lines, either line end."""
    scene = draw(SCENES)
    lines = yaml.safe_dump(scene, sort_keys=False, allow_unicode=True, width=1e9, **draw(STYLES)).splitlines()
    for k in range(draw(st.integers(0, 3))):
        at = draw(st.integers(0, len(lines)))
        lines.insert(at, " " * draw(st.integers(0, 4)) + f"# thought {k}")
    text = draw(st.sampled_from(["\n", "\r\n"])).join(lines) + draw(st.sampled_from(["", "\n"]))
    assume(parse_yaml(text) == parse_yaml(yaml.safe_dump(scene)))
    return text


@settings(max_examples=80, deadline=None)
@given(written(), st.sampled_from(["gravity", "radius", "name"]), LEAVES)
def test_a_value_is_set_and_nothing_else(text, name, value):
    before = parse_yaml(text) or {}
    after = parse_yaml(with_value(text, ("parameters", name), value))
    wanted = dict(before)
    wanted["parameters"] = (before.get("parameters") or {}) | {name: value}
    assert after == wanted


@settings(max_examples=80, deadline=None)
@given(written(), ENTRIES)
def test_a_list_grows_and_shrinks_again(text, item):
    before = parse_yaml(text) or {}
    items = before.get("obstacles") or []
    longer = with_item(text, ("obstacles",), item)
    assert parse_yaml(longer) == before | {"obstacles": [*items, item]}
    shorter = without(longer, ("obstacles", len(items)))
    assert parse_yaml(shorter) == before | {"obstacles": items or None}  # the last one leaves the name alone
    if items:
        assert parse_yaml(without(text, ("obstacles", 0))) == before | {"obstacles": items[1:] or None}


@settings(max_examples=60, deadline=None)
@given(written(), st.data())
def test_an_entry_is_taken_away_and_nothing_else(text, data):
    before = parse_yaml(text) or {}
    assume(before)
    name = data.draw(st.sampled_from(sorted(before)))
    assert (parse_yaml(without(text, (name,))) or {}) == {k: v for k, v in before.items() if k != name}


def test_comments_and_order_stay():
    text = SCENE_TEMPLATE
    for path, value in [(("parameters", "density"), 900), (("look", "material"), "honey"), (("duration",), 3.0)]:
        text = with_value(text, path, value)
    text = with_item(text, ("obstacles",), {"name": "duck", "shape": "sphere"})
    assert comments(text) == comments(SCENE_TEMPLATE)
    kept = [line for line in SCENE_TEMPLATE.splitlines() if line.startswith("#")]
    assert [line for line in text.splitlines() if line.startswith("#")] == kept
    for path in [("parameters", "density"), ("look", "material"), ("duration",), ("obstacles", 0)]:
        text = without(text, path)
    assert text == SCENE_TEMPLATE


def test_what_stands_beside_a_value_stays_beside_it():
    text = "obstacles:   # two\n  # the first\n  - name: duck   # a toy\n    radius: 1 # m\n  - {name: b}\n"
    assert with_value(text, ("obstacles", 0, "radius"), 2) == text.replace("radius: 1 #", "radius: 2 #")
    assert without(text, ("obstacles", 1)) == text.replace("  - {name: b}\n", "")
    assert with_item(text, ("obstacles",), {"name": "c"}) == text + "  - {name: c}\n"
