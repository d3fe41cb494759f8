"""The stage that asks a third-party generator for a body per united frame; each is kept as soon as it is there."""

from __future__ import annotations

import os
import shutil
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from fluidlift.backends import generators
from fluidlift.backends.generator_licence import require_accepted, require_use
from fluidlift.config import JobConfig
from fluidlift.errors import InputRejected, MissingPackage
from fluidlift.io.asset_paths import asset_file
from fluidlift.messages import Notice
from fluidlift.pipeline.given_body import NOTE
from fluidlift.pipeline.inputs import Inputs
from fluidlift.pipeline.known_camera import known_field_of_view
from fluidlift.pipeline.settings import GenerateSettings, GivenView
from fluidlift.pipeline.work import Work
from fluidlift.shape.rest_frames import FEWEST_PIXELS, united_range
from fluidlift.types.fluid_masks import FluidMasks
from fluidlift.types.stages import Bodies, Read, Segmentation

if TYPE_CHECKING:
    from fluidlift.backends.generator_card import GeneratorCard

STAGE = "generate"
_KEPT = 2
"""folders of bodies: going back to the settings before is free"""


def stages_of(stages: tuple[str, ...]) -> tuple[str, ...]:
    """The stages of a job that asks a generator: with `generate` before the geometry."""
    at = stages.index("geometry")
    return (*stages[:at], STAGE, *stages[at:])


def choice_of(config: GenerateSettings, field_of_view: float | None = None) -> generators.GeneratorChoice:
    """The generator as the job has it."""
    runner = None if config.runner is None else Path(os.path.expanduser(config.runner.name))
    weights = None if config.weights is None else config.weights.name
    return generators.GeneratorChoice(
        config.name, config.python, config.code, runner, weights, config.device, config.seed, config.download,
        field_of_view, config.frame_seconds,
    )  # fmt: skip


def require_usable(inputs: Inputs, config: JobConfig, folder: Path) -> list[Notice]:
    """Look at everything that can be known of the generator before the clip is read; warnings about its use.

    Args:
        inputs: of the job.
        config: of the job, which names a generator.
        folder: of the asset: where it is there already, its bodies may be too, and the generator is not needed.

    Raises:
        InputRejected: an unknown generator, terms that were not accepted or forbid the use, or two sources of geometry.
        MissingPackage: the generator is not installed.
    """
    c = config.generate
    card = generators.card_of(str(c.name))
    other = next((k for k in ("geometry", "depth") if getattr(inputs, k) is not None), None)
    if other is not None or config.depth.model != "none":
        option = {"geometry": "--geometry-from", "depth": "--depth", None: f"--depth-model {config.depth.model}"}[other]
        raise InputRejected(
            f"--generator {c.name} together with {option}", "one source of the fluid's shape", "leave one out"
        )
    warning = require_use(card, c.use, tuple(generators.card_of(name) for name in generators.GENERATORS))
    require_accepted(card, c.accept_licence)
    choice = choice_of(GenerateSettings.of(config))
    generators.make_generator(replace(choice, device="cpu" if choice.device == "auto" else choice.device))
    if not folder.exists():
        _require_installed(card, choice)
    return [warning] if warning else []


def _require_installed(card: GeneratorCard, choice: generators.GeneratorChoice) -> None:
    if choice.runner is not None:  # a script of the user's own knows best what it needs
        return
    found = generators.check(card.name, choice)
    if found.installed:
        return
    commands = "; ".join(card.install) or f"see {card.home}"
    lacking = found.problem or f"{found.where} lacks {', '.join(found.missing)}"
    raise MissingPackage(
        f"{card.title} is not installed ({lacking}). Needed: its packages, in this or another environment. Do: "
        f"{commands}; then name that environment's Python with --generator-python. fluidlift generators {card.name} "
        "tells more; without --generator the built-in one needs nothing."
    )


def bodies_folder(folder: Path, key: str) -> Path:
    """Where an asset keeps the bodies that were made with the settings of a key."""
    return asset_file(folder, f"work/{STAGE}/{key}")


def bodies_there(folder: Path, made: Bodies) -> bool:
    """Whether the files of all bodies are still in their folder."""
    return all((folder / f"{t:04d}{s}").is_file() for t in made.frames for s in (".ply", ".json"))


def generate(
    read: Read, segmentation: Segmentation, given: GivenView, config: GenerateSettings, *, folder: Path, work: Work
) -> Bodies:
    """Bodies of the united frames, those that are there already left out; their note is written last.

    Args:
        read: the clip.
        segmentation: of it.
        given: what is known of the lens.
        config: which generator.
        folder: of the asset.
        work: has the key under which the bodies are kept.

    Raises:
        GeneratorFailed: what it says; bodies before that are kept.
    """
    from fluidlift.backends.generator_process import GeneratorFailed, Picture
    from fluidlift.io.atomic import write_json
    from fluidlift.io.ply import write_gaussians
    from fluidlift.io.stage_cache import mark_work_folder

    clip, fluid = read.clip, FluidMasks(segmentation.labels.labels)
    view, told = known_field_of_view(given, config.fov, clip.size)
    start, united = united_range(clip, fluid, config.longest_union)
    frames = [t for t in range(start, start + united) if t == start or fluid[t].sum() >= FEWEST_PIXELS]
    mark_work_folder(folder)
    folder = bodies_folder(folder, work.key)
    if work.again:
        shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True, exist_ok=True)
    todo = [t for t in frames if not (folder / f"{t:04d}.json").is_file()]
    choice = choice_of(config, view)
    card = generators.card_of(choice.name)
    pictures = [Picture(t, np.ascontiguousarray(clip.frames[t]), np.asarray(fluid[t])) for t in todo]
    done = len(frames) - len(todo)
    work.step(done, len(frames))
    try:
        if todo:
            _require_installed(card, choice)
        for t, body, camera in generators.bodies(generators.make_generator(choice), choice, pictures):
            write_gaussians(folder / f"{t:04d}.ply", body)
            write_json(folder / f"{t:04d}.json", camera.to_dict())
            done += 1
            work.step(done, len(frames))
    except (InputRejected, MissingPackage) as error:  # not the clip's fault: what was found in it is kept
        raise GeneratorFailed(str(error)) from error
    knows_up = bool(getattr(generators.generator_class(choice.name), "knows_up", False))
    # metres that follow from a guessed field of view are none
    note: dict[str, Any] = {"name": card.name, "metric": card.metric and told, "knows_up": knows_up, "frames": frames}
    write_json(folder / NOTE, note | {"licence": card.licence})
    _forget_old(folder)
    return Bodies(card.name, tuple(frames))


def _forget_old(folder: Path) -> None:
    others = [p for p in folder.parent.iterdir() if p.is_dir() and not p.is_symlink() and p != folder]
    others.sort(key=lambda p: p.stat().st_mtime, reverse=True)
    for old in others[_KEPT - 1 :]:
        with suppress(OSError):
            shutil.rmtree(old)
