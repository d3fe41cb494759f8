"""Kinds of fluid: values that code asks, and a rule that it asks nothing else."""

import ast
import re
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import get_args, get_type_hints

import numpy as np
import pytest

import fluidlift
from fluidlift.cli.options import SceneOptions
from fluidlift.config.sections import ShapeConfig
from fluidlift.errors import InputRejected
from fluidlift.look.vessel import glass_of
from fluidlift.motion.bed import layer_thickness
from fluidlift.motion.volume import volume_velocity
from fluidlift.pipeline.stages.fit import sticking
from fluidlift.shape.airborne import airborne_setting
from fluidlift.shape.kind import KINDS as RECOGNISED
from fluidlift.shape.kind import estimate_up, level_camera
from fluidlift.shape.kinds import builder_of
from fluidlift.shape.registration import metric_scale
from fluidlift.types import (
    KINDS,
    CellType,
    FluidKind,
    FluidParameters,
    Grid,
    PinholeCamera,
    SurfaceMotion,
    Terrain,
    TriangleMesh,
    UpEvidence,
    kind_of,
)
from fluidlift.types.kind import BASIN, DAM, FALL, FOUNTAIN, PLUME, POUR, STREAM
from fluidlift.viewer.controls import controls_of

ROOT = Path(fluidlift.__file__).parent
MENTIONED = re.compile("|".join(f"[\"']{name}[\"']|{name.upper()}" for name in KINDS))
"""in the source of a file that is worth a closer look"""
MAY_NAME = ("types/kind.py", "shape/kinds/")
MAY_TABULATE = ("shape/kind_weights.py", "synthetic/")
"""what speaks for each kind, and made scenes, which bear such names too"""


def is_named(node: ast.AST) -> bool:
    """A name of a kind, the value of a kind, or a collection with one of them."""
    if isinstance(node, ast.Constant):
        return node.value in KINDS
    if isinstance(node, ast.Name | ast.Attribute):
        name = node.id if isinstance(node, ast.Name) else node.attr
        return name.lower() in KINDS and name.isupper()
    if isinstance(node, ast.Call):  # kind_of("dam")
        return any(map(is_named, node.args))
    return isinstance(node, ast.Tuple | ast.List | ast.Set) and any(map(is_named, node.elts))


def named_kinds(source: str, *, tables: bool) -> list[int]:
    """Lines that decide by the name of a kind: comparisons, cases and, if asked, tables."""
    lines = []
    for node in ast.walk(ast.parse(source)):
        compared = isinstance(node, ast.Compare) and any(map(is_named, (node.left, *node.comparators)))
        case = isinstance(node, ast.MatchValue) and is_named(node.value)
        table = isinstance(node, ast.Dict) and sum(is_named(k) for k in node.keys if k is not None) > 1
        looked_up = isinstance(node, ast.Subscript) and is_named(node.slice)
        if compared or case or (tables and (table or looked_up)):
            lines.append(node.value.lineno if isinstance(node, ast.MatchValue) else node.lineno)
    return lines


@pytest.mark.parametrize(
    "line",
    [
        'kind == "dam"', '"plume" != scene.kind', 'kind in ("fall", "pour")', "kind is POUR", "kind == kinds.STREAM",
        'kind == kind_of("dam")', '{"fall": 1, "pour": 2}[kind]', 'PRIOR["stream"]', 'kind in {"dam"}',
    ],
)  # fmt: skip
def test_the_rule_sees_what_decides_by_name(line):
    assert named_kinds(line, tables=True)


def test_the_rule_sees_cases_and_lets_values_be():
    assert named_kinds('match kind:\n    case "dam":\n        pass', tables=True) == [2]
    for line in ("kind.is_gas", 'film = {"kind": "stream"}', 'kind != "auto"', "kind = STREAM", 'make(kind="pour")'):
        assert not named_kinds(line, tables=True)


def test_no_code_decides_by_the_name_of_a_kind():
    found = []
    for path in sorted(ROOT.rglob("*.py")):
        name = path.relative_to(ROOT).as_posix()
        source = path.read_text(encoding="utf-8")
        if MENTIONED.search(source) and not name.startswith(MAY_NAME):
            tables = not name.startswith(MAY_TABULATE)
            found += [f"{name}:{n}" for n in named_kinds(source, tables=tables)]
    assert not found, f"ask the kind what it is (`types.kind.FluidKind`): {', '.join(found)}"


def test_a_name_gives_its_kind_and_an_unknown_one_the_names_that_there_are():
    assert [kind_of(name).name for name in KINDS] == list(KINDS)
    assert kind_of(DAM) is DAM and str(DAM) == "dam"
    with pytest.raises(InputRejected, match=r"'lava'.*stream, fall, pour, plume, dam, basin, fountain"):
        kind_of("lava")


def test_what_a_user_may_say_is_what_there_is():
    asked = get_type_hints(ShapeConfig)["kind"]
    assert get_args(asked) == ("auto", *KINDS)
    assert get_args(get_args(get_type_hints(SceneOptions)["kind"])[0]) == ("auto", *KINDS)


def test_kinds_differ_in_physics():
    """Each question, and who says yes to it."""
    said = {
        question: [k.name for k in KINDS.values() if getattr(k, question)]
        for question in ("is_gas", "airborne", "is_channel_flow", "is_standing_water", "lies_on_ground", "falls_freely",
                         "enters_over_rim", "nearly_level", "runs_nearly_level", "starts_at_rest", "fills_vessel",
                         "has_mean_motion", "is_level_throughout", "is_still_water", "rises_from_pool",
                         "is_driven_in_sight")
    }  # fmt: skip
    assert said == {
        "is_gas": ["plume"], "airborne": ["pour", "plume"], "is_channel_flow": ["stream", "fall"],
        "is_standing_water": ["basin", "fountain"], "lies_on_ground": ["stream", "fall", "basin", "fountain"],
        "falls_freely": ["fall", "pour"], "enters_over_rim": ["fall"], "nearly_level": ["stream", "basin", "fountain"],
        "is_level_throughout": ["stream", "basin"], "is_still_water": ["basin"], "rises_from_pool": ["fountain"],
        "runs_nearly_level": ["stream"], "starts_at_rest": ["dam"], "fills_vessel": ["pour"],
        "has_mean_motion": ["stream", "fall", "pour", "basin", "fountain"],
        "is_driven_in_sight": ["stream", "fall", "pour", "plume"],
    }  # fmt: skip


@pytest.mark.parametrize(
    "changed",
    [
        {"pitch_prior": (8.0, 0.0)},
        {"airborne": True},
        {"looked_down_on": 1.0},
        {"depth_ratio": None},
        {"is_channel_flow": False},
        {"is_standing_water": True},
        {"rises_from_pool": True},
    ],
    ids=str,
)
def test_a_kind_that_contradicts_itself_is_refused(changed):
    with pytest.raises(ValueError, match=r"the kind"):
        replace(STREAM, **changed)


@pytest.mark.parametrize("kind", [FALL, POUR, PLUME, DAM, STREAM, BASIN, FOUNTAIN], ids=str)
def test_every_kind_has_a_builder(kind):
    bulk = np.array([0.3, 0.1, -0.2])
    direction = builder_of(kind).mainstream(bulk)
    assert np.isfinite(direction).all()
    if kind.airborne:  # it goes the way that gravity or buoyancy takes it
        assert np.sign(direction[2]) == (1.0 if kind.is_gas else -1.0)


@pytest.fixture
def mist(monkeypatch):
    """A new kind, by one registration and one file: vapour that sinks."""
    kind = FluidKind(
        "mist", pitch_prior=(12.0, 3.0), kinematic_viscosity=2e-5, wall_damping=0.01, wall_layer=0.3, is_gas=True,
        airborne=True,
    )  # fmt: skip
    from fluidlift.shape.kinds import plume

    monkeypatch.setitem(KINDS, kind.name, kind)
    monkeypatch.setitem(sys.modules, "fluidlift.shape.kinds.mist", SimpleNamespace(BUILDER=plume.BUILDER))
    return kind


def test_a_new_kind_is_one_registration(mist):
    """Everything that reads the tables takes it by its name."""
    assert kind_of("mist") is mist and "mist" not in RECOGNISED
    camera = PinholeCamera.from_fov(50.0, (24, 20))
    mask, motion = np.zeros((20, 24), bool), np.zeros((20, 24, 2))
    mask[4:16, 8:16] = True
    up = estimate_up("mist", mask, motion, np.ones(mask.shape), camera)
    assert (up.pitch, up.source) == (12.0, "usual view of a mist")
    assert layer_thickness("mist", 0.1) == pytest.approx(0.03)
    assert sticking("mist", []) == pytest.approx(0.01)
    nothing = TriangleMesh(np.zeros((0, 3)), np.zeros((0, 3), int))
    air = Terrain(Grid((1, 1, 1), 1.0), np.ones((2, 2, 2), np.float32), np.array([1.0, 0.0, 0.0]), nothing)
    assert glass_of("mist", air) is None and glass_of("pour", air) is not None
    keys = [c.key for c in controls_of(FluidParameters(), "mist")]
    assert keys == [c.key for c in controls_of(FluidParameters(), "plume")]
    points = np.random.default_rng(0).uniform(-1.0, 1.0, (50, 3))
    assert metric_scale(mist, points, np.zeros_like(points)).source == "assumed"


def test_a_new_kind_gets_a_velocity_and_a_place(mist):
    grid = Grid((8, 6, 6), 0.1, (0.0, 0.0, 0.0))
    types = np.full(grid.shape, CellType.FLUID, np.uint8)
    surface = SurfaceMotion(grid.centers()[:, :, -1].reshape(-1, 3), np.tile([0.5, 0, 0], (48, 1)), np.ones(48, bool))
    found = volume_velocity(surface, None, types, grid, kind="mist", mainstream=np.array([1.0, 0, 0]))[0]
    smoke = volume_velocity(surface, None, types, grid, kind="plume", mainstream=np.array([1.0, 0, 0]))[0]
    for new, old in zip(found.components, smoke.components):
        assert np.isfinite(new).all() and np.abs(new - old).max() < 0.05  # a layer of 0.3 cells, not 0.4
    camera = level_camera(PinholeCamera.from_fov(50.0, (24, 20)), UpEvidence(0.0, 0.0, "", 0.0))
    mask = np.zeros((20, 24), bool)
    mask[4:16, 8:16] = True
    body = np.concatenate([camera.unproject(camera.pixel_grid()[mask], np.full(mask.sum(), z)) for z in (1.9, 2.1)])
    near, far = np.where(mask, 1.9, 0.0), np.where(mask, 2.1, 0.0)
    setting = airborne_setting(
        near, far, mask, camera, body, np.array([0.0, 0.0, 1.0]), kind=mist, longest=16, cell_limit=20_000
    )
    assert (setting.cell_types == CellType.FLUID).any() and setting.pool_level is None


@pytest.mark.parametrize("kind", KINDS.values(), ids=str)
def test_the_habits_of_filming_are_shares(kind):
    shares, means, spreads = zip(*kind.pitch_habits, strict=True)
    assert sum(shares) == pytest.approx(1.0)
    mean, spread = kind.usual_pitch
    assert min(means) <= mean <= max(means)
    assert spread >= min(spreads)


def test_the_usual_size_is_that_of_what_is_filmed_so():
    river = kind_of("stream")
    assert river.usual_size(5.0) == pytest.approx(river.sizes[0], rel=0.05)  # over a landscape
    assert river.usual_size(60.0) == pytest.approx(river.sizes[1], rel=0.05)  # a pan, a table
    between = [river.usual_size(pitch) for pitch in np.arange(5.0, 61.0, 5.0)]
    assert (np.diff(between) < 0).all()
    assert kind_of("pour").usual_size(8.0) == 1.0
