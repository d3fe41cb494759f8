"""The stages that every command on a clip begins with: read, flow, segment, geometry."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from fluidlift.config import JobConfig
from fluidlift.errors import InputRejected
from fluidlift.pipeline import body, depths, given_body, reading, seeing
from fluidlift.pipeline.reading import Inputs
from fluidlift.pipeline.seeing import NO_HINTS, Hints
from fluidlift.pipeline.story import Result, Story, file_hash

Hashes = dict[str, Any]
"""SHA-256 of the input files by name"""
_OPTIONS = {"geometry": ("--geometry-from", "folder")}
"""option and what it takes, where they are not --name and a file"""


def input_hashes(inputs: Inputs) -> Hashes:
    """Of every file that was given.

    Raises:
        InputRejected: a file that is not there.
    """
    from fluidlift.io.limits import require_file
    from fluidlift.io.sequences import is_sequence, list_sequence

    if not is_sequence(inputs.clip):
        require_file(inputs.clip, "video")
    hashes: Hashes = {}
    for name, path in inputs.existing().items():
        if path.exists():
            hashes[name] = file_hash(path)
        elif name == "clip":
            hashes[name] = [file_hash(p) for _, p in list_sequence(path)]
        elif name in ("flow", "mask") and is_sequence(path):  # a pattern
            hashes[name] = file_hash(path.parent)
        else:
            option, what = _OPTIONS.get(name, (f"--{name}", "file"))
            raise InputRejected(f"no such {name} {what}: '{path}'", f"an existing {what}", f"check {option}")
    return hashes


def provenance_of(inputs: Inputs, hashes: Hashes) -> dict[str, Any]:
    """Names and hashes of the inputs, for a manifest."""
    return {"inputs": {k: {"name": inputs.existing()[k].name, "sha256": v} for k, v in hashes.items()}}


def weights_hash(weights: str | None) -> str | None:
    """Of a file or folder of weights; the name itself where there is none of that name here."""
    path = None if weights is None else Path(weights)
    return file_hash(path) if path is not None and path.exists() else weights


def look(story: Story, inputs: Inputs, config: JobConfig, hashes: Hashes, hints: Hints = NO_HINTS) -> None:
    """Run read, flow and segment; what later stages are given is looked at before the slow ones."""
    depths.require_weights(config)
    motion, segment = config.section("motion"), config.section("segment")
    segment["weights"] = weights_hash(segment["weights"])
    # limits guard the reading and do not change what is read
    read = {k: v for k, v in config.section("read").items() if k not in ("max_frames", "max_pixels")}

    def flow() -> Result:
        seeing.require_usable(story, inputs, config, hints)
        depths.require_file(story, inputs, config)
        if inputs.geometry is not None:
            given_body.given_bodies(inputs.geometry, reading.clip_of(story).size, [0])
        return seeing.flow(story, inputs, config)

    story.run(
        "read",
        lambda: reading.read(story, inputs, config),
        settings=[hashes["clip"], hashes.get("camera"), read],
        after=(),
    )
    story.run(
        "flow",
        flow,
        settings=[hashes["flow"], {k: motion[k] for k in ("flow_channels", "flow_v_up", "flow_scale")}]
        if "flow" in hashes
        else [motion["method"], weights_hash(motion["weights"])],
        after=("read",),
    )
    story.run(
        "segment",
        lambda: seeing.segment(story, inputs, config, hints),
        settings=[hashes["mask"], hints.plain()] if "mask" in hashes else [segment, hints.plain()],
        after=("read", "flow"),
    )


def shape(story: Story, inputs: Inputs, config: JobConfig, hashes: Hashes) -> None:
    """Run geometry."""
    names = ("kind", "fov", "pitch", "roll", "size", "depth_ratio", "cells", "cell_limit", "longest_union")
    section = config.section("shape")
    given = {k: hashes.get(k) for k in ("camera", "depth", "geometry")}
    story.run(
        "geometry",
        lambda: body.geometry(story, inputs, config),
        settings=[{k: section[k] for k in names}, given, depths.key_parts(config)],
        after=("read", "flow", "segment"),
    )
