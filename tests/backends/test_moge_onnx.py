"""MoGe as an ONNX file: what its bare network says becomes metres and a lens, and other files are refused."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from fluidlift.backends.model_table import model_of
from fluidlift.backends.moge_onnx import LICENCE, MogeOnnx, focal_and_shift
from fluidlift.backends.monocular_depth import make_depth_estimator
from fluidlift.backends.onnx_file import read_onnx
from fluidlift.backends.registry import ModelChoice
from fluidlift.errors import InputRejected, MissingPackage
from fluidlift.types import PinholeCamera

H, W = 40, 60
FLOAT, INT64 = 1, 7


@pytest.fixture(scope="module")
def runtime():
    return pytest.importorskip("onnxruntime", reason="onnxruntime is not installed")


def quiet(line: str) -> None:
    """Nobody listens."""


# a few messages of onnx.proto, written as protocol buffers: (field number, value) pairs


def number(value: int) -> bytes:
    out = b""
    while value > 0x7F:
        out, value = out + bytes([value & 0x7F | 0x80]), value >> 7
    return out + bytes([value])


def message(*fields: tuple[int, int | str | bytes]) -> bytes:
    out = b""
    for at, value in fields:
        if isinstance(value, int):
            out += number(at << 3) + number(value)
        else:
            data = value.encode() if isinstance(value, str) else value
            out += number(at << 3 | 2) + number(len(data)) + data
    return out


def tensor(name: str, values: np.ndarray, *more: tuple[int, int | str | bytes]) -> bytes:
    data = np.ascontiguousarray(values, np.float32)
    return message(*((1, n) for n in data.shape), (2, FLOAT), (8, name), (9, data.tobytes()), *more)


def value(name: str, kind: int, *sides: int | str) -> bytes:
    shape = message(*((1, message((1, s) if isinstance(s, int) else (2, s))) for s in sides))
    return message((1, name), (2, message((1, message((1, kind), (2, shape))))))


def node(op: str, inputs: list[str], output: str, *attributes: tuple[str, int]) -> bytes:
    parts = ((5, message((1, name), (3, v), (20, 2))) for name, v in attributes)
    return message(*((1, i) for i in inputs), (2, output), (4, op), *parts)


def export(
    points: np.ndarray, mask: np.ndarray, normal: np.ndarray | None = None, scale: str | None = "scale",
    factor: float = 2.0, size: tuple = ("height", "width"), more: bytes = b"", tokens: str = "num_tokens",
) -> bytes:  # fmt: skip
    """A file like MoGe's, whose answer is written in it; the scale is `factor` for pictures that reach white."""
    kept = {"points": points, "mask": mask} | ({} if normal is None else {"normal": normal})
    nodes = [node("Identity", [f"{k}_in"], k) for k in kept]
    held = [tensor(f"{k}_in", v[None]) for k, v in kept.items()]
    given = {k: ["b", *(f"{k}{i}" for i in range(v.ndim))] for k, v in kept.items()}
    if scale is not None:
        nodes += [
            node("ReduceMax", ["image"], "peak", ("keepdims", 0)), node("Cast", [tokens], "count", ("to", FLOAT)),
            node("Mul", ["count", "zero"], "none"), node("Mul", ["peak", "factor"], "grown"),
            node("Add", ["grown", "none"], scale),
        ]  # fmt: skip
        held += [tensor("factor", np.array([factor])), tensor("zero", np.array([0.0]))]
        given[scale] = ["b"]
    graph = message(
        *((1, n) for n in nodes), (2, "made"), *((5, t) for t in held),
        (11, value("image", FLOAT, "batch", 3, *size)), (11, value(tokens, INT64)),
        *((12, value(k, FLOAT, *sides)) for k, sides in given.items()),
    )  # fmt: skip
    return message((1, 8), (8, message((1, ""), (2, 13))), (7, graph + more))


def saved(folder: Path, data: bytes) -> Path:
    (folder / "model.onnx").write_bytes(data)
    return folder / "model.onnx"


def scene(fov: float, pitch: float = 40.0, factor: float = 2.0, shift: float = 0.7):
    """The ground 4 m below a camera, as the network gives it: in units of `factor` m, and shifted along the view.

    Returns:
        Points as given, normals, pixels that show ground, and the true depth, m.
    """
    camera = PinholeCamera.from_fov(fov, (W, H))
    x, y = (camera.pixel_grid() - np.asarray(camera.center)).transpose(2, 0, 1) / camera.focal[0]
    p = np.radians(pitch)
    below = np.cos(p) * y + np.sin(p)
    seen = below > 0.1
    depth = 4.0 / np.maximum(below, 0.1)
    points = np.stack([x * depth, y * depth, depth], axis=-1) / factor
    points[..., 2] -= shift
    normal = np.broadcast_to([0.0, -np.cos(p), -np.sin(p)], points.shape)
    return points, normal, seen, depth


def picture() -> np.ndarray:
    image = np.random.default_rng(0).integers(0, 255, (H, W, 3), dtype=np.uint8)
    image[0, 0] = 255
    return image


@pytest.mark.parametrize("fov", [30.0, 55.0, 90.0])
@pytest.mark.parametrize("shift", [0.0, 0.7, -1.5])
def test_focal_length_and_shift_are_those_by_which_points_fall_onto_their_pixels(fov, shift):
    points, _, seen, _ = scene(fov, shift=shift)
    found = focal_and_shift(points, seen)
    assert found is not None
    assert found[1] == pytest.approx(shift, abs=2e-3)
    wanted = PinholeCamera.from_fov(fov, (W, H)).focal[0] / (0.5 * np.hypot(W, H))
    assert found[0] == pytest.approx(wanted, rel=1e-3)  # the search ends at 1e-7 of the distance's logarithm


def test_a_known_lens_fixes_the_shift_alone():
    points, _, seen, _ = scene(55.0)
    focal = PinholeCamera.from_fov(55.0, (W, H)).focal[0] / (0.5 * np.hypot(W, H))
    kept = focal_and_shift(points, seen, focal)
    wider = focal_and_shift(points, seen, 0.8 * focal)
    assert kept is not None and wider is not None
    assert kept[1] == pytest.approx(0.7, abs=2e-3) and wider[0] == 0.8 * focal
    assert focal_and_shift(points, np.zeros((H, W), bool)) is None


def test_a_wall_seen_straight_on_is_not_shifted():
    """Each shift with its focal length puts its points onto the same pixels."""
    camera = PinholeCamera.from_fov(50.0, (W, H))
    x, y = (camera.pixel_grid() - np.asarray(camera.center)).transpose(2, 0, 1) / camera.focal[0]
    points = np.stack([3.0 * x, 3.0 * y, np.full((H, W), 3.0)], axis=-1)
    found = focal_and_shift(points, np.ones((H, W), bool))
    assert found is not None
    assert found[1] == 0.0
    assert found[0] / (3.0 + found[1]) == pytest.approx(camera.focal[0] / (0.5 * np.hypot(W, H)) / 3.0, rel=1e-3)


@pytest.mark.parametrize("scale", ["scale", "metric_scale", None])
@pytest.mark.parametrize("as_folder", [True, False])
def test_a_known_scene_comes_back_in_metres(runtime, tmp_path, scale, as_folder):
    points, normal, seen, depth = scene(55.0, pitch=10.0)  # with sky above
    path = saved(tmp_path, export(points, seen.astype(float), normal, scale))
    told: list[str] = []
    choice = ModelChoice(tmp_path if as_folder else path, announce=told.append)
    model = make_depth_estimator("moge-onnx", choice)
    assert told == [LICENCE]
    found = model.guess(picture(), None)
    assert found.holds == ("relative" if scale is None else "metres")
    assert found.field_of_view == pytest.approx(55.0, abs=0.05)
    factor = 0.5 if scale is None else 1.0
    np.testing.assert_allclose(found.values[seen], factor * depth[seen], rtol=2e-3)
    assert np.isnan(found.values[~seen]).all() and (~seen).any()
    assert found.normals is not None
    np.testing.assert_allclose(found.normals[seen], normal[seen], atol=1e-6)
    assert np.isnan(found.normals[~seen]).all()


def test_a_known_camera_sets_its_lens(runtime, tmp_path):
    points, _, seen, depth = scene(55.0)
    model = MogeOnnx(saved(tmp_path, export(points, seen.astype(float))), announce=quiet)
    camera = PinholeCamera.from_fov(55.0, (2 * W, 2 * H))  # of the clip at twice the size
    found = model.guess(picture(), camera)
    np.testing.assert_allclose(found.values[seen], depth[seen], rtol=2e-3)
    assert found.field_of_view == pytest.approx(55.0) and found.normals is None
    wrong = model.guess(picture(), PinholeCamera.from_fov(40.0, (W, H)))
    assert wrong.field_of_view == pytest.approx(40.0)


def test_pictures_go_in_from_black_to_white(runtime, tmp_path):
    """The file's scale is twice the largest value of the picture: 255 is 1."""
    points, _, seen, depth = scene(55.0)
    model = MogeOnnx(saved(tmp_path, export(points, seen.astype(float))), announce=quiet)
    dim = model.guess((picture() // 2), None)
    np.testing.assert_allclose(dim.values[seen], 127 / 255 * depth[seen], rtol=2e-3)


def test_a_picture_of_nothing_but_sky_has_no_depth(runtime, tmp_path):
    points, *_ = scene(55.0)
    model = MogeOnnx(saved(tmp_path, export(points, np.zeros((H, W)))), announce=quiet)
    with pytest.raises(InputRejected, match="no depth"):
        model.guess(picture(), None)


@pytest.mark.parametrize("wrong", ["inputs", "outputs", "fixed size", "shape", "graph", "empty", "cut", "text"])
def test_other_files_are_refused(runtime, tmp_path, wrong):
    points, _, seen, _ = scene(55.0)
    mask, says = seen.astype(float), ""
    if wrong == "inputs":
        data, says = export(points, mask, tokens="tokens"), "takes"
    elif wrong == "outputs":
        data, says = export(points, mask).replace(b"points", b"pounds"), "gives pounds"
    elif wrong == "fixed size":
        data, says = export(points, mask, size=(H, W)), "alone"
    elif wrong == "shape":
        data, says = export(points[:-1], mask), r"gives 'points' of \[1, 39, 60, 3\]"
    elif wrong == "graph":
        data, says = export(points, mask).replace(b"ReduceMax", b"ReduceMix"), "cannot be loaded"
    elif wrong == "empty":
        data, says = b"", "holds 0 graphs"
    else:
        data, says = export(points, mask)[:-100] if wrong == "cut" else b"version https://git-lfs", "no whole ONNX file"
    with pytest.raises(InputRejected, match=says):
        MogeOnnx(saved(tmp_path, data), announce=quiet).guess(picture(), None)


@pytest.mark.parametrize("where", ["tensor", "location alone", "attribute", "graph of an attribute", "sparse"])
def test_a_file_that_points_to_others_is_refused(tmp_path, where):
    """Before any runtime sees it; the path leads out of its folder."""
    points, _, seen, _ = scene(55.0)
    away = tensor("away", np.zeros(1), (13, message((1, "location"), (2, "../../secret"))), (14, 1))
    if where == "location alone":
        away = tensor("away", np.zeros(1), (14, 1))
    more = {
        "attribute": message((1, message((2, "o"), (4, "Constant"), (5, message((1, "value"), (5, away), (20, 4)))))),
        "graph of an attribute": message(
            (1, message((2, "o"), (4, "If"), (5, message((1, "then_branch"), (6, message((5, away))), (20, 5)))))
        ),
        "sparse": message((15, message((1, away)))),
    }.get(where, message((5, away)))
    path = saved(tmp_path, export(points, seen.astype(float), more=more))
    with pytest.raises(InputRejected, match="in other files"):
        read_onnx(path, "a model")
    assert read_onnx(saved(tmp_path, export(points, seen.astype(float))), "a model")


def test_graphs_without_end_and_files_too_large_are_refused(monkeypatch, tmp_path):
    graph = b""
    for _ in range(60):
        graph = message((1, message((5, message((6, graph))))))
    with pytest.raises(InputRejected, match="without end"):
        read_onnx(saved(tmp_path, message((7, graph))), "a model")
    monkeypatch.setattr("fluidlift.backends.onnx_file.MOST_BYTES", 20)
    with pytest.raises(InputRejected, match="at most 20 bytes"):
        read_onnx(tmp_path / "model.onnx", "a model")
    with pytest.raises(InputRejected, match="no file"):
        read_onnx(tmp_path / "other.onnx", "a model")


@pytest.mark.parametrize("seed", range(3))
def test_damaged_bytes_end_in_a_refusal_or_are_read(tmp_path, seed):
    points, _, seen, _ = scene(55.0)
    whole = export(points[:4, :4], seen[:4, :4].astype(float))
    rng = np.random.default_rng(seed)
    refused = 0
    for _ in range(200):
        data = bytearray(whole)
        for at in rng.integers(0, len(data), 3):
            data[at] = rng.integers(0, 256)
        try:
            assert read_onnx(saved(tmp_path, bytes(data)), "a model") == bytes(data)
        except InputRejected:
            refused += 1
    assert 0 < refused < 200


def test_without_the_runtime_the_message_says_what_to_install(monkeypatch, tmp_path):
    monkeypatch.setitem(__import__("sys").modules, "onnxruntime", None)
    with pytest.raises(MissingPackage, match=r"fluidlift\[onnx\]"):
        MogeOnnx(tmp_path, announce=quiet)
    card = model_of("moge-2-vits-normal-onnx")
    assert card.back_end == ("depth model", "moge-onnx") and card.packages == ("onnxruntime",)
