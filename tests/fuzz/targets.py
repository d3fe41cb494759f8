"""Every reader of files from strangers, as a function that gets one changed file: it reads it, or refuses it."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from pathlib import Path

import numpy as np
import yaml

from fluidlift.errors import InputRejected

from . import corpus
from .beside import BESIDE
from .corpus import Seed
from .target import Target, texts

SIZE = (48, 32)
"""px of the clips that the files belong to"""


def _scene(folder: Path) -> None:
    from fluidlift.io.scene import read_edits

    read_edits(folder)


def _edited(folder: Path) -> None:
    from fluidlift.io.scene import scene_text
    from fluidlift.io.scene_text import with_value, without

    text = scene_text(folder)
    without(with_value(text, ("parameters", "density"), 900.0), ("parameters", "density"))


def _values(folder: Path) -> None:
    """Values as they stand on the command line."""
    from fluidlift.config import FitConfig, build_config
    from fluidlift.pipeline.fit_request import request_of

    text = (folder / "value.txt").read_bytes().decode("utf-8", "replace")
    readers = (
        lambda: build_config(overrides=(f"fit.max_seconds={text}",)),
        lambda: build_config(overrides=(text,)),
        lambda: request_of(FitConfig(hold=(f"density={text}",))),
    )
    for read in readers:
        try:
            read()
        except InputRejected:
            continue


def _shots(folder: Path) -> None:
    from fluidlift.cli.batch import Batch, shots_of

    shots_of(Batch((folder / "shots.yaml",), folder / "out"))


def _settings(folder: Path) -> None:
    from fluidlift.config import build_config

    build_config(None, folder / "a.yaml")


def _camera(folder: Path) -> None:
    from fluidlift.io.images import read_camera, read_distortion

    read_camera(folder / "a.json", SIZE)
    read_distortion(folder / "a.json")


def _distortion(folder: Path) -> None:
    from fluidlift.io.images import read_distortion

    read_distortion(folder / "a.json")


def _view(folder: Path) -> None:
    from fluidlift.io.views import read_view

    read_view(folder / "a.json")


def _asset(folder: Path) -> None:
    from fluidlift.io.asset_folder import load_asset

    load_asset(folder)


def _history(folder: Path) -> None:
    from fluidlift.scene.edit_history import announced, read_history

    announced(folder)
    read_history(folder)


def _history_files() -> list[Seed]:
    import json

    from fluidlift.scene.edit_history import EditRecord

    edit = EditRecord.of(1, "set", "a: 1\n", "a: 2\n")
    lines = [{"time": "", "what": "found", "text": "a: 1\n"}, edit.to_dict()]
    return [Seed(b"".join(json.dumps(line).encode() + b"\n" for line in lines))]


def _force(folder: Path) -> None:
    from fluidlift.io.force_file import read_filmed

    read_filmed(folder)


def _force_files() -> list[Seed]:
    shapes = {"u": (3, 2, 2), "v": (2, 3, 2), "w": (2, 2, 3)}
    return corpus.npz_seeds(corpus.npz(**{n: np.ones(s, np.float32) for n, s in shapes.items()}))


def _part(name: str) -> Callable[[], list[Seed]]:
    def seeds() -> list[Seed]:
        data = corpus.asset_parts()[name]
        return corpus.npz_seeds(data) if name.endswith(".npz") else [Seed(data)]

    return seeds


def _validated(folder: Path) -> None:
    """All checks of an asset: a frame of it is changed."""
    from fluidlift.validate import validate_asset

    validate_asset(folder)


def _frame_parts() -> dict[str, bytes]:
    (splats,) = corpus.splats()
    return corpus.asset_parts() | {"frames/splats/1002.ply": splats.data}


def _packed(folder: Path) -> None:
    from fluidlift.io.packed_splats import read_packed

    read_packed(folder / "a.flsp")


def _mesh(name: str) -> Callable[[Path], object]:
    def read(folder: Path) -> object:
        from fluidlift.io.read_mesh import read_any_mesh

        return read_any_mesh(folder / name)

    return read


def _beside_obj() -> dict[str, bytes]:
    return {"a.obj": corpus.OBJ, "a.mtl": corpus.MTL, "a.png": corpus.pictures()[0].data}


def _splats(folder: Path) -> None:
    from fluidlift.io.ply import read_splats

    read_splats(folder / "a.ply", drop_broken=True)
    read_splats(folder / "a.ply")


def _spz(folder: Path) -> None:
    from fluidlift.io.spz import read_spz

    read_spz(folder / "a.spz")


def _picture(folder: Path) -> None:
    from fluidlift.io.pictures import eight_bit, read_picture

    eight_bit(read_picture(folder / "a.png"))


def _exr(folder: Path) -> None:
    from fluidlift.io.exr import read_channels

    read_channels(folder / "a.exr")


def _environment(folder: Path) -> None:
    from fluidlift.io.environments import read_environment_image

    read_environment_image(folder / "a.hdr")


def _depth(folder: Path) -> None:
    from fluidlift.io.images import read_depth

    read_depth(folder / "a.npz", SIZE)


def _depth_picture(folder: Path) -> None:
    from fluidlift.io.images import read_depth

    read_depth(folder / "a.exr", (64, 32))


def _mask(folder: Path) -> None:
    from fluidlift.io.images import read_mask

    read_mask(folder / "a.png", SIZE, 1)


def _flow(name: str) -> Callable[[Path], object]:
    def read(folder: Path) -> None:
        from fluidlift.io.flow_files import open_flow

        open_flow(folder / name, SIZE, 1).pair(0)

    return read


def _flows(*wanted: int) -> Callable[[], list[Seed]]:
    return lambda: [corpus.flows()[k] for k in wanted]


def _checkpoint(folder: Path) -> None:
    from fluidlift.io.checkpoint import read_checkpoint, read_parts

    read_parts(folder / "a.npz")
    read_checkpoint(folder / "a.npz")


def _stage(folder: Path) -> None:
    """A cache is there or not: nothing is refused."""
    from fluidlift.io.stage_cache import load_stage, owner_of

    owner_of(folder, "flow")
    try:
        load_stage(folder, "flow", "k")
    except InputRejected as error:
        raise AssertionError("a damaged cache counts as absent") from error


@cache
def _stage_files() -> dict[str, bytes]:
    import tempfile

    from fluidlift.io.stage_cache import Scratch, mark_owner, save_stage

    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        scratch = Scratch(folder, "flow")
        long = scratch.array("long", (40, 3), np.float32)  # no numbers that are better packed
        long[:] = np.random.default_rng(0).normal(size=(40, 3))
        save_stage(folder, "flow", "k", {"a": np.ones(3), "long": long}, {"n": 1}, scratch=scratch)
        mark_owner(folder, "flow", "k")
        return {p.relative_to(folder).as_posix(): p.read_bytes() for p in folder.rglob("*") if p.is_file()}


def _stage_part(name: str) -> Callable[[], list[Seed]]:
    def seeds() -> list[Seed]:
        data = _stage_files()[name]
        return corpus.npz_seeds(data) if name.endswith(".npz") else [Seed(data)]

    return seeds


def _video(folder: Path) -> None:
    from fluidlift.io.lens import lens_field_of_view
    from fluidlift.io.video import probe, read_clip

    probe(folder / "a.mp4")
    lens_field_of_view(folder / "a.mp4")
    read_clip(folder / "a.mp4", max_size=64)


def _usd_checked(folder: Path) -> None:
    from fluidlift.io.validate_usd import validate_usd

    validate_usd(folder / "a.usda")


def _yaml(folder: Path) -> None:
    from fluidlift.io.yaml_reader import parse_yaml

    try:
        parse_yaml((folder / "a.yaml").read_bytes().decode("utf-8", "replace"))
    except yaml.YAMLError as error:
        raise InputRejected(str(error)) from None


_CAMERA = (
    b'{"width": 48, "height": 32, "K": [[40, 0, 24], [0, 40, 16], [0, 0, 1]], "R": [[1, 0, 0], [0, 1, 0], [0, 0, 1]],'
    b' "t": [0, 0, 2], "k1": 0.1, "distortion": [0.1, 0, 0, 0]}'
)
_TRANSFORMS = (
    b'{"w": 48, "h": 32, "camera_angle_x": 0.8, "frames": [{"transform_matrix":'
    b" [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 2], [0, 0, 0, 1]]}]}"
)
_KEYS = (
    b'{"keys": [{"frame": 1001, "eye": [1, 2, 3], "target": [0, 0, 0]},'
    b' {"frame": 1010.5, "eye": [2, 2, 3], "target": [0, 0, 0], "fov": 50}]}'
)

TARGETS: dict[str, Target] = {
    "yaml": Target(texts(corpus.SCENE, corpus.SETTINGS), _yaml, "a.yaml"),
    "scene": Target(texts(corpus.SCENE, corpus.TEMPLATE), _scene, "scene.yaml", lambda: {"a.obj": corpus.OBJ}),
    "scene-edited": Target(texts(corpus.SCENE, corpus.TEMPLATE), _edited, "scene.yaml", slow=True),
    "settings": Target(texts(corpus.SETTINGS), _settings, "a.yaml"),
    "values": Target(texts(b"3", b"[0, 0, -9.81]", b"fit.max_seconds=60"), _values, "value.txt"),
    "shots": Target(texts(corpus.SHOTS), _shots, "shots.yaml"),
    "camera": Target(texts(_CAMERA, _TRANSFORMS), _camera, "a.json"),
    "distortion": Target(texts(_CAMERA), _distortion, "a.json"),
    "view": Target(texts(_CAMERA, _KEYS), _view, "a.json"),
    "manifest": Target(_part("manifest.json"), _asset, "manifest.json", corpus.asset_parts, slow=True),
    "parameters": Target(_part("parameters.json"), _asset, "parameters.json", corpus.asset_parts, slow=True),
    "asset-camera": Target(_part("rest/camera.json"), _asset, "rest/camera.json", corpus.asset_parts, slow=True),
    "terrain": Target(_part("rest/terrain.npz"), _asset, "rest/terrain.npz", corpus.asset_parts, slow=True),
    "velocity": Target(_part("rest/velocity.npz"), _asset, "rest/velocity.npz", corpus.asset_parts, slow=True),
    "frames": Target(corpus.splats, _validated, "frames/splats/1001.ply", _frame_parts, slow=True),
    "packed-frames": Target(corpus.packed, _validated, "frames/splats/1001.flsp", _frame_parts, slow=True),
    "force": Target(_force_files, _force, "rest/force.npz"),
    "history": Target(_history_files, _history, "edits/history.jsonl"),
    "obj": Target(texts(corpus.OBJ), _mesh("a.obj"), "a.obj", _beside_obj),
    "mtl": Target(texts(corpus.MTL), _mesh("a.obj"), "a.mtl", _beside_obj),
    "glb": Target(corpus.glb, _mesh("a.glb"), "a.glb"),
    "mesh-ply": Target(corpus.mesh_plys, _mesh("a.ply"), "a.ply"),
    "splats": Target(corpus.splats, _splats, "a.ply"),
    "packed": Target(corpus.packed, _packed, "a.flsp"),
    "spz": Target(corpus.spz, _spz, "a.spz"),
    "picture": Target(corpus.pictures, _picture, "a.png"),
    "mask": Target(corpus.pictures, _mask, "a.png"),
    "exr": Target(corpus.exr, _exr, "a.exr"),
    "environment": Target(lambda: corpus.radiance() + corpus.exr()[1:2], _environment, "a.hdr"),
    "depth": Target(corpus.depths, _depth, "a.npz"),
    "depth-exr": Target(lambda: corpus.exr()[:2], _depth_picture, "a.exr"),
    "flow-flo": Target(_flows(0), _flow("a.flo"), "a.flo"),
    "flow-exr": Target(_flows(1), _flow("a.exr"), "a.exr"),
    "flow-npz": Target(lambda: corpus.flows()[2:-1], _flow("a.npz"), "a.npz"),
    "flow-npy": Target(_flows(-2), _flow("a.npy"), "a.npy"),
    "flow-kitti": Target(_flows(-1), _flow("a.png"), "a.png"),
    "checkpoint": Target(corpus.checkpoints, _checkpoint, "a.npz"),
    "stage-facts": Target(_stage_part("work/flow/k.json"), _stage, "work/flow/k.json", _stage_files),
    "stage-arrays": Target(_stage_part("work/flow/k.npz"), _stage, "work/flow/k.npz", _stage_files),
    "stage-mapped": Target(_stage_part("work/flow/k.long.npy"), _stage, "work/flow/k.long.npy", _stage_files),
    "video": Target(corpus.videos, _video, "a.mp4", slow=True),
    "usd-checked": Target(texts(corpus.USDA), _usd_checked, "a.usda", slow=True),
} | BESIDE
