"""Values of stages come back from arrays and JSON as they were, or not at all."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass, fields, is_dataclass, replace
from enum import Enum
from typing import Any, Literal

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays_of
from jaxtyping import Float, Int

from fluidlift.io.atomic import plain
from fluidlift.io.stage_codec import Mistyped, field_types, packed, unpacked
from fluidlift.messages import Notice
from fluidlift.types import (
    Estimate,
    FaceVelocity,
    FluidParameters,
    Gaussians,
    Grid,
    KindEvidence,
    MetricScale,
    PinholeCamera,
    PixelFlow,
    PixelLabels,
    RigidTransform,
    Setting,
    Similarity3,
    SlopeEvidence,
    Terrain,
    TriangleMesh,
    UpEvidence,
    VideoClip,
    stages,
)

RNG = np.random.default_rng(7)
GRID = Grid((3, 2, 2), 0.25, (0.1, -0.2, 0.3))
T, H, W = 4, 5, 9


def same(a, b) -> bool:
    """Equal to the bit, arrays with their types."""
    if is_dataclass(a):
        return type(a) is type(b) and all(same(getattr(a, f.name), getattr(b, f.name)) for f in fields(a))
    if isinstance(a, np.ndarray):
        return a.dtype == b.dtype and a.shape == b.shape and a.tobytes() == b.tobytes()
    if isinstance(a, list | tuple):
        return type(a) is type(b) and len(a) == len(b) and all(map(same, a, b))
    if isinstance(a, dict):
        return list(a) == list(b) and all(same(a[k], b[k]) for k in a)
    return type(a) is type(b) and (a == b or (a != a and b != b))


def again(value):
    """Through the text of a JSON file."""
    arrays, data = packed(value)
    return unpacked(type(value), arrays, json.loads(json.dumps(plain(data), allow_nan=False)))


def floats(*shape: int, dtype: Any = np.float32) -> np.ndarray:
    return RNG.standard_normal(shape).astype(dtype)


def velocity() -> FaceVelocity:
    return FaceVelocity(*(floats(*GRID.face_shape(a)) for a in range(3)))


def clip() -> VideoClip:
    return VideoClip(
        RNG.integers(0, 255, (T, H, W, 3), np.uint8), 0.04 * np.arange(T), "a.mp4", warnings=(Notice("odd", "odd"),)
    )


def setting(textured: bool) -> Setting:
    faces = np.array([[0, 1, 2], [2, 3, 0]])
    picture = (floats(2, 3, 2), np.zeros((2, 4, 3), np.uint8)) if textured else (None, None)
    mesh = TriangleMesh(floats(4, 3, dtype=float), faces, floats(4, 3), *picture)
    terrain = Terrain(GRID, floats(4, 3, 3), np.array([1.0, 0.0, 0.0]), mesh)
    height = floats(3, 2) if textured else None
    return Setting(terrain, np.zeros(GRID.shape, np.uint8), height, floats(3, 2), None if textured else 0.2)


def geometry(textured: bool) -> stages.Geometry:
    pose = RigidTransform(np.eye(3), np.array([0.1, 1 / 3, 2.0]))
    picture = {n: floats(H, W) for n in ("depth", "half_thickness", "sighted_depth", "mean_confidence")}
    return stages.Geometry(
        kind="stream", kind_source="user", kind_evidence=KindEvidence("stream", {"stream": 0.1 + 0.2}, {"grey": 1.0}),
        up=UpEvidence(12.0, -1.5, "horizon", 0.7), scale=MetricScale(0.3, "size", across=2.0), scale_sentence="so",
        camera=PinholeCamera((90.1, 90.2), (4.4, 2.6), (W, H), pose),
        world_from_canonical=Similarity3(0.7, np.eye(3), np.array([0.0, 1e-17, 5.0])), setting=setting(textured),
        mask=floats(H, W) > 0, mean_flow=floats(H, W, 2), plate=np.zeros((H, W, 3), np.uint8), rest_frame=1,
        united_frames=2, **picture, rocks=floats(H, W) > 0 if textured else None, known_scale=None,
        depth_source={"source": "depth file", "frames": [1, 2]} if textured else None,
        jets=({"width": 0.1, "path": [[0.0, 1.0]]},),
        slope=SlopeEvidence(1.0, 0.5, 3.0, 0.2, 1.1, "motion") if textured else None,
        warnings=(Notice("a", "a"), Notice("b", "b")),
    )  # fmt: skip


def motion() -> stages.Motion:
    target = stages.TargetVelocity(1, velocity(), floats(*GRID.shape) > 0, 0.5, {"solve": {"converged": True}})
    completed = floats(T - 1, H, W, 2, dtype=np.float16)
    completed[0] = np.nan
    bits = RNG.integers(0, 255, (T - 1, H, 2), np.uint8)
    return stages.Motion((target, replace(target, frame=2, observed_share=None, report={})), completed, bits, 1.0, 0.2)


def fit() -> stages.Fit:
    known = Estimate(1e-6, 1e-7, True, 2e-6, "m^2/s", (1e-7, 2e-6), "fitted")
    return stages.Fit(
        FluidParameters(gravity=(0.0, 0.1, -9.0)), FluidParameters(),
        {"kinematic_viscosity": known, "density": Estimate(1000.0, math.inf, False, 1000.0)},
        ({"name": "density", "sigma": None, "interval": [1.0, 2.0]},), False, "failed", "so", 12, ("note",),
        {"loss": math.nan, "loss_at_rest": math.inf, "rise_runs": 3.0}, np.array([3.0, 2.0]),
    )  # fmt: skip


def read() -> stages.Read:
    return stages.Read(clip(), np.array([0, 1, 3, 4]), 6, 0.25, True, (2,), (Notice("w", "w"),))


def flow() -> stages.Flow:
    found = PixelFlow(floats(T - 1, H, W, 2, dtype=np.float16), floats(T - 1, H, W, dtype=np.float16))
    return stages.Flow(found, "multiframe", warnings=(Notice("w", "w"),))


def segmentation() -> stages.Segmentation:
    labels = PixelLabels(RNG.integers(0, 3, (T, H, W), np.uint8), floats(T, H, W, dtype=np.float16))
    return stages.Segmentation(labels, 0.3, 0.9, 0.5, False)


def refined() -> stages.Refined:
    body = Gaussians.isotropic(floats(6, 3), 0.1, np.full((6, 3), 0.5), 0.9)
    return stages.Refined(body, 3, 2, 1, 0, 20.0, 25.5, True)


def simulation() -> stages.Simulation:
    poses = floats(3, 2, 7, dtype=float)
    return stages.Simulation(
        floats(3), floats(3), np.array([5, 6, 7]), poses, (4, 5), 1, "blew up", (Notice("w", "w"),)
    )


VALUES = {
    "Window": lambda: stages.Window(1.25, 2.5, ((61.5, 0.8),), (Notice("odd", "odd"),)),
    "Read": read,
    "Flow": flow,
    "Segmentation": segmentation,
    "Bodies": lambda: stages.Bodies("trellis", (1, 2)),
    "DepthGuess": lambda: stages.DepthGuess(floats(2, H, W), "metres", 55.0),
    "ViewGuesses": lambda: stages.ViewGuesses("geocalib", *floats(3, 2), floats(2, 3), floats(2)),
    "ViewGuesses of nothing": lambda: stages.ViewGuesses("geocalib", *floats(3, 0), floats(0, 3), floats(0)),
    "Geometry": lambda: geometry(True),
    "Geometry without a height": lambda: geometry(False),
    "Refined": refined,
    "TargetVelocity": lambda: motion().targets[0],
    "Motion": motion,
    "Stretch": lambda: stages.Stretch(61.5, tuple(motion().targets), 0.25),
    "Elsewhere": lambda: stages.Elsewhere((stages.Stretch(61.5, tuple(motion().targets), 0.25),), (Notice("w", "w"),)),
    "Fit": fit,
    "Lift": lambda: stages.Lift(read(), flow(), segmentation(), geometry(True), refined(), motion(), fit()),
    "Calibration": lambda: stages.Calibration(velocity(), 0.1, 0.2, 0.3, 14, (Notice("w", "w"),)),
    "Calibration of nothing": stages.Calibration,
    "Simulation": simulation,
    "Shown": lambda: stages.Shown(
        3, {"verdict": "holds"}, np.zeros((2, H, W, 3), np.uint8), floats(2, H, W) > 0, floats(2, H, W, 2)
    ),
    "Shown without a clip": lambda: stages.Shown(3, {"none": "no clip"}),
    "MaskFiles": lambda: stages.MaskFiles(4, (W, H)),
    "VelocityFiles": lambda: stages.VelocityFiles(({"frame": 0, "warnings": []},), (Notice("w", "w"),)),
}


def test_no_stage_is_left_out():
    known = {n for n, kind in vars(stages).items() if is_dataclass(kind) and kind.__module__ == stages.__name__}
    assert known == {name.split()[0] for name in VALUES}


@pytest.mark.parametrize("make", VALUES.values(), ids=VALUES)
def test_the_value_of_a_stage_comes_back_to_the_bit(make):
    value = make()
    assert same(again(value), value)


@pytest.mark.parametrize("make", VALUES.values(), ids=VALUES)
def test_names_of_arrays_are_names_of_files(make):
    for name in packed(make())[0]:
        assert name.replace("-", "").replace("_", "").isalnum() and len(name) <= 64


class Colour(Enum):
    RED = "red"
    BLUE = "blue"


@dataclass(frozen=True)
class Inner:
    number: float
    name: str = ""


@dataclass(frozen=True)
class Outer:
    """One field of each type."""

    flag: bool
    count: int
    size: float
    text: str
    maybe: float | None
    pair: tuple[int, str]
    many: tuple[Inner, ...]
    listed: list[float]
    named: dict[str, Inner]
    plain: Any
    colour: Colour
    choice: Literal["a", "b"]
    array: np.ndarray
    shaped: Float[np.ndarray, "n 3"]
    ints: Int[np.ndarray, " n"] | None


NUMBERS = st.floats(allow_nan=True, allow_infinity=True, width=64)
INNER = st.builds(Inner, NUMBERS, st.text(max_size=5))
JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False, allow_infinity=False) | st.text(max_size=4),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=3), inner, max_size=3),
    max_leaves=6,
)
OUTER = st.builds(
    Outer,
    flag=st.booleans(),
    count=st.integers(),
    size=NUMBERS,
    text=st.text(max_size=8),
    maybe=st.none() | NUMBERS,
    pair=st.tuples(st.integers(), st.text(max_size=3)),
    many=st.lists(INNER, max_size=3).map(tuple),
    listed=st.lists(NUMBERS, max_size=3),
    named=st.dictionaries(st.text(max_size=3), INNER, max_size=3),
    plain=JSON,
    colour=st.sampled_from(Colour),
    choice=st.sampled_from(["a", "b"]),
    array=arrays_of.arrays(
        st.sampled_from([np.uint8, np.bool_, np.float64, np.complex64]), arrays_of.array_shapes(max_dims=3, max_side=3)
    ),
    shaped=arrays_of.arrays(np.float16, st.tuples(st.integers(0, 3), st.just(3))),
    ints=st.none() | arrays_of.arrays(np.int32, st.integers(0, 3)),
)


@settings(max_examples=80, deadline=None)
@given(OUTER)
def test_any_value_of_known_types_comes_back_to_the_bit(value):
    assert same(again(value), value)


def outer(**change) -> Outer:
    known = Outer(
        True, 1, 0.5, "t", None, (1, "a"), (Inner(1.0),), [1.0], {"k": Inner(2.0)}, {"a": 1}, Colour.RED, "a",
        np.zeros(2), np.zeros((2, 3)), None,
    )  # fmt: skip
    return replace(known, **change)


WRONG = {
    "flag": 1, "count": True, "size": "0.5", "text": 3, "maybe": "x", "pair": (1, "a", 2), "many": ({"number": 1.0},),
    "listed": "ab", "named": [1], "colour": "green", "choice": "c", "array": [1.0], "shaped": np.zeros((2, 3), int),
    "ints": np.zeros((2, 2), int),
}  # fmt: skip


@pytest.mark.parametrize(("name", "wrong"), WRONG.items(), ids=WRONG)
def test_a_field_that_holds_something_else_is_refused_before_it_is_kept(name, wrong):
    with pytest.raises(Mistyped, match=name):
        packed(outer(**{name: wrong}))


@pytest.mark.parametrize("name", [f.name for f in fields(Outer) if f.name != "plain"])
@pytest.mark.parametrize("wrong", [[], {}, "else", 1.5, None, ["array"], {"number": 1.0}], ids=repr)
def test_data_of_another_type_is_refused(name, wrong):
    arrays, data = packed(outer())
    try:
        found = unpacked(Outer, arrays, data | {name: wrong})
    except Mistyped:
        return
    # what is taken has the type that the field says
    assert same(again(found), found)


@settings(max_examples=150, deadline=None)
@given(data=JSON, part=st.sampled_from([f.name for f in fields(stages.Fit)]))
def test_no_json_does_more_than_be_refused(data, part):
    arrays, known = packed(fit())
    for text in (data, known | {part: data}):
        try:
            found = unpacked(stages.Fit, arrays, text)
        except Mistyped:
            continue
        assert (isinstance(found, stages.Fit) and found.initial == fit().initial) or part == "initial"


def test_arrays_that_are_gone_or_of_another_kind_are_refused():
    arrays, data = packed(read())
    for other in ({}, arrays | {"kept": np.array(["a"] * T)}, arrays | {"clip-frames": np.zeros((T, H, W, 3))},
                  arrays | {"clip-frames": np.zeros((T, H, W), np.uint8)}):  # fmt: skip
        with pytest.raises(Mistyped):
            unpacked(stages.Read, other, data)


def test_values_check_themselves_when_they_come_back():
    arrays, data = packed(read())
    with pytest.raises(Mistyped, match="numbers for 4 frames"):
        unpacked(stages.Read, arrays | {"kept": np.arange(3)}, data)


@dataclass(frozen=True)
class Vague:
    either: int | str


def test_types_that_json_cannot_tell_apart_are_refused():
    with pytest.raises(Mistyped, match="cannot be stored"):
        packed(Vague(1))


def test_nothing_is_left_out_of_a_stage():
    assert list(field_types(stages.Read)) == [f.name for f in fields(stages.Read)]


@dataclass(frozen=True)
class Earlier:
    """As a version before had it."""

    values: Float[np.ndarray, " n"]
    loss: list[float]
    count: int


@dataclass(frozen=True)
class Later:
    """Without the loss, and with a field that has a default."""

    values: Float[np.ndarray, " n"]
    count: int
    seen: float = 0.5


def test_a_value_of_another_version_is_read_where_all_that_is_needed_is_there():
    arrays, data = packed(Earlier(np.arange(3.0), [1.0], 2))
    with pytest.raises(Mistyped):
        unpacked(Later, arrays, data)
    found = unpacked(Later, arrays, data, exact=False)
    assert found.values.tolist() == [0.0, 1.0, 2.0] and found.count == 2 and found.seen == 0.5
    arrays, data = packed(found)
    with pytest.raises(Mistyped):
        unpacked(Earlier, arrays, data, exact=False)
