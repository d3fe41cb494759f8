"""Readers of the small files that lie beside clips and assets: hints, states of a batch, cuts, notes, cases with a
known truth, answers that are kept."""

from __future__ import annotations

import contextlib
import json
import tempfile
from dataclasses import asdict
from functools import cache
from pathlib import Path
from types import SimpleNamespace

import numpy as np
from small_asset import small_asset

from . import corpus
from .corpus import Seed
from .target import Target, texts

HINTS = b"""hints: 1
clip: {size: [48, 32]}
start: 1
duration: 2.0
kind: stream
fov: 50
horizon: [[0, 1], [20, 3]]
ruler: {from: [0, 1], to: [2, 3], metres: 2}
rims: [{center: [3, 4], axes: [4, 5], turned: 3}]
regions:
  - {is: fluid, area: [[0, 0], [3, 0], [3, 3]]}
  - {is: rock, area: [[0, 0], [9, 0], [3, 3]]}
clicks: [{at: [1, 2], fluid: true}]
roi: [0, 0, 40, 30]
flow: [{at: [1, 2], to: [3, 4]}]
level: [[0, 0], [3, 3]]
found: {kind: stream, tilt: 3}
"""
STEPS = b'{"done": [{"hints": 1, "kind": "fall"}, {"hints": 1}], "undone": [{"hints": 1, "fov": 30}]}'


def _hints(folder: Path) -> None:
    from fluidlift.io.hints_file import hints_text, read_found, read_hints

    hints = read_hints(folder / "a.yaml")
    hints_text(hints.at((96, 64)), read_found(folder / "a.yaml"))


def _steps(folder: Path) -> None:
    """What a person did in the studio, taken back and done again."""
    from fluidlift.io.hints_file import parse_hints
    from fluidlift.studio.history import HintsHistory

    identity = parse_hints({"hints": 1, "clip": {"size": [48, 32]}}).clip
    assert identity is not None
    (folder / "a.yaml").unlink(missing_ok=True)
    history = HintsHistory(folder / "a.mp4", folder / "a.yaml", folder / "steps.json", identity)
    while history.can_undo:
        history.undo()
    while history.can_redo:
        history.redo()


def _status(folder: Path) -> None:
    """Everything that a folder of a batch is asked for."""
    from fluidlift.farm import state, summary

    found = summary.status_of(folder)
    found.lines()
    summary.as_csv(found.outcomes)
    summary.write_parquet(folder, found.outcomes)
    state.list_names(folder, ["three"])
    json.dumps(summary.rows(found.outcomes)).encode()


@cache
def _states() -> list[Seed]:
    from fluidlift.farm.state import ShotOutcome

    outcome = ShotOutcome("two", "done, warnings", 3.5, "two.fluid", "two.log", ["a: b"], peak_memory_mb=90.5)
    return [Seed(json.dumps(asdict(outcome), indent=1).encode())]


def _cuts(folder: Path) -> None:
    from fluidlift.farm.cuts import parted
    from fluidlift.farm.shots import Shot

    before, tempfile.tempdir = tempfile.tempdir, str(folder)  # where the clip is looked through, is inside as well
    try:
        parted([Shot(folder / "a.mp4", "two", {})], folder, lambda line: None)
    finally:
        tempfile.tempdir = before


def _cut_files() -> list[Seed]:
    import hashlib

    span = dict.fromkeys(("start", "duration", "fps"), "None")
    asked = {"clip": hashlib.sha256(b"no clip").hexdigest(), "span": span}
    parts = [{"start": 0.0, "end": 0.9, "seconds": 0.9}, {"start": 0.9, "end": None, "seconds": 0.8}]
    return [Seed(json.dumps({"asked": asked, "parts": parts}).encode())]


def _mask_facts(folder: Path) -> None:
    from fluidlift.pipeline.mask_facts import is_straight, require_unchanged

    is_straight(folder)
    require_unchanged(folder, "segment")


def _journal(folder: Path) -> None:
    """Rows of a run that was stopped; a damaged one ends them."""
    from fluidlift.pipeline.frame_files import FrameWriter

    there = SimpleNamespace(journal=folder / "a.jsonl", folder=folder, files=SimpleNamespace(of_frame=lambda *_: []))
    FrameWriter._written_before(there)  # type: ignore[arg-type]


def _bodies(folder: Path) -> None:
    from fluidlift.pipeline.given_body import given_bodies

    given_bodies(folder, (48, 32), [0, 1])


CAMERA = json.dumps({"width": 48, "height": 32, "K": [[40, 0, 24], [0, 40, 16], [0, 0, 1]]}).encode()


def _beside_bodies() -> dict[str, bytes]:
    (splats,) = corpus.splats()
    return {f"{t:04d}.{kind}": data for t in (0, 1) for kind, data in (("ply", splats.data), ("json", CAMERA))}


def _answers(folder: Path) -> None:
    from fluidlift.scene import known_state

    known_state.remember(folder, "a: 1\n", {"look"})
    known_state.recalled(folder, "a: 1\n")


def _note_of_lock(folder: Path) -> None:
    from fluidlift.io.asset_lock import _holder

    with (folder / "a").open("rb") as file:
        _holder(file.fileno())


def _codec(folder: Path) -> None:
    """A value whose JSON was changed, and whose checksum was set right."""
    from fluidlift.io.limits import read_json
    from fluidlift.io.stage_codec import Mistyped, unpacked
    from fluidlift.types import FluidAsset

    with contextlib.suppress(Mistyped):
        unpacked(FluidAsset, _packed_asset()[0], read_json(folder / "a.json"))


@cache
def _packed_asset() -> tuple[dict[str, np.ndarray], bytes]:
    from fluidlift.io.stage_codec import packed

    arrays, data = packed(small_asset())
    return arrays, json.dumps(data).encode()


def _case(folder: Path) -> None:
    from fluidlift.evaluate import case

    case.read_case(folder)


@cache
def _case_files() -> dict[str, bytes]:
    frames, keys, cells, (w, h) = 3, 2, (3, 4, 5), (48, 32)
    bits, still = np.zeros((frames, h, w // 8), np.uint8), np.zeros((frames, h, w), np.float32)
    truth = corpus.npz(
        flow=np.zeros((frames, h, w, 2), np.float32), depth=still, dz=still, mask=bits, visible=bits,
        static_depth=still[0], key_frames=np.arange(keys), grid_velocity=np.zeros((keys, *cells, 3), np.float32),
        grid_phi=np.zeros((keys, *cells), np.float32),
    )  # fmt: skip
    corners = np.zeros((3, 3), np.float32)
    solids = corpus.npz(rock_v=corners, rock_f=np.array([[0, 1, 2]]), rock_rgb=corners[0])
    camera = json.dumps(small_asset().camera.to_dict() | {"width": w, "height": h}).encode()
    scene = json.dumps({"case": "a", "grid": cells, "domain_min": [0, 0, 0], "dx": 0.1, "dt": 0.04}).encode()
    return {
        "camera.json": camera,
        "scene.json": scene,
        "truth.npz": truth,
        "solids.npz": solids,
        "video.mp4": b"no clip",
    }


def _of_case(name: str) -> Target:
    def seeds() -> list[Seed]:
        data = _case_files()[name]
        return corpus.npz_seeds(data) if name.endswith(".npz") else [Seed(data)]

    return Target(seeds, _case, name, _case_files)


BESIDE: dict[str, Target] = {
    "hints": Target(texts(HINTS), _hints, "a.yaml"),
    "steps": Target(texts(STEPS), _steps, "steps.json"),
    "states": Target(_states, _status, "two.state.json", slow=True),
    "listed": Target(texts(b'["two", "three"]'), _status, "shots.json", lambda: {"two.state.json": _states()[0].data},
                     slow=True),
    "cuts": Target(_cut_files, _cuts, "two.cuts.json", lambda: {"a.mp4": b"no clip"}),
    "mask-facts": Target(texts(b'{"of": "a.mp4", "size": [48, 32], "frames": 1, "undistorted": true, "sha256": "00"}'),
                         _mask_facts, "mask.json", lambda: {"1001.png": corpus.pictures()[0].data}),
    "journal": Target(texts(b'{"frame": 0, "a": 1}\n{"frame": 1, "a": null}\n'), _journal, "a.jsonl"),
    "bodies": Target(texts(b'{"name": "lgm", "metric": false, "knows_up": true, "frames": [0, 1]}'), _bodies,
                     "generator.json", _beside_bodies),
    "answers": Target(texts(b'{"ab": ["simulate"], "cd": []}'), _answers, "work/stale.json", corpus.asset_parts),
    "lock": Target(texts(b'{"pid": 1, "work": "make"}'), _note_of_lock, "a"),
    "codec": Target(lambda: [Seed(_packed_asset()[1])], _codec, "a.json", slow=True),
    "case-camera": _of_case("camera.json"),
    "case-scene": _of_case("scene.json"),
    "case-truth": _of_case("truth.npz"),
    "case-solids": _of_case("solids.npz"),
}  # fmt: skip
