"""Learned models by name: which of the user's cache a job takes (`--models`), and which one a job has used.

A job's settings name what it takes (`depth.model`, `depth.weights`), so that the same settings give the same asset on
every machine that has these models; `auto` is only a way to fill them in.
"""

from __future__ import annotations

import os
from dataclasses import dataclass, replace
from typing import Any

from fluidlift.backends.model_cache import kept
from fluidlift.backends.model_card import ModelCard
from fluidlift.backends.model_table import MODELS, lacking_packages, model_of
from fluidlift.config import JobConfig
from fluidlift.errors import InputRejected, MissingPackage
from fluidlift.messages import Notice
from fluidlift.pipeline.inputs import OF_CACHE, Inputs, Weights
from fluidlift.pipeline.known_camera import tells_pose

NONE, AUTO = "none", "auto"


@dataclass(frozen=True)
class _Task:
    """A place in a job that a model can take."""

    word: str
    """for people, and in a manifest"""
    section: str
    option: str
    """in that section, which names the back end"""
    purpose: str
    """in the registry"""
    files: tuple[str, ...]
    """of a job, that leave nothing to do here"""


TASKS = (
    _Task("masks", "segment", "method", "mask method", ("mask",)),
    _Task("depth", "depth", "model", "depth model", ("depth", "geometry")),
    _Task("flow", "motion", "method", "flow method", ("flow",)),
    _Task("tilt", "view", "model", "view model", ("camera",)),
)
PLACES = tuple(task.word for task in TASKS)
"""all that a job with every stage can take"""
NEEDS_WORDS = ("sam3",)
"""back ends that look for words: which ones, only a person knows, so that `auto` leaves them alone"""


@dataclass(frozen=True)
class ModelWish:
    """What a person says of learned models, for all clips of a session."""

    models: str = NONE
    """as `with_models` is asked"""
    use: str | None = None
    """what the results are for"""

    def on(self, config: JobConfig, inputs: Inputs) -> Chosen:
        """`with_models` for a job.

        Raises:
            InputRejected, MissingPackage: as `with_models`.
        """
        use = config.generate.use if self.use is None else self.use
        return with_models(replace(config, generate=replace(config.generate, use=use)), inputs, self.models)


NO_MODELS = ModelWish()


@dataclass(frozen=True)
class Chosen:
    """Settings with the models that a job takes, and what to tell about it."""

    config: JobConfig
    told: tuple[str, ...] = ()


@dataclass(frozen=True)
class UsedModel:
    """A learned model that an asset was made with."""

    task: str
    method: str
    name: str
    """that of its card, or of the file or folder that the user gave, without where that is"""
    files: dict[str, str]
    """SHA-256 of each"""
    card: ModelCard | None = None

    def to_dict(self) -> dict[str, Any]:
        """For a manifest."""
        known = {} if self.card is None else {"terms": self.card.terms, "licence": self.card.licence}
        return {"for": self.task, "method": self.method, "name": self.name, "files": self.files} | known


def with_models(config: JobConfig, inputs: Inputs, asked: str, *, places: tuple[str, ...] = PLACES) -> Chosen:
    """The settings of a job with learned models filled in.

    Args:
        config: of the job, as it was asked for: what it names already stays.
        inputs: its files: what is given is not estimated.
        asked: none; auto: for masks, depth, flow and tilt the first model of the table that is in the cache and can
            run; or names with commas between them.
        places: what the stages of this job can take, of `PLACES`.

    Raises:
        InputRejected: a name that is not known or not in the cache, two models for one thing, or one that has nothing
            to do.
        MissingPackage: a named one lacks its packages.
    """
    names = [part.strip() for part in asked.split(",") if part.strip()]
    if names in ([], [NONE]):
        return Chosen(config)
    if names == [AUTO]:
        return _automatic(config, inputs, places)
    done: dict[str, str] = {}
    for name in names:
        card = model_of(name)
        task = _task_of(card)
        if task.word not in places:
            raise InputRejected(
                f"--models {name}, which is for {task.word}", f"a model for {' or '.join(places)}", "leave it out here"
            )
        if task.word in done:
            raise InputRejected(f"--models {asked}, two for {task.word}", "one of them", f"leave out {name}")
        _require_free(card, task, config, inputs)
        if kept(name) is None:
            raise InputRejected(
                f"the model {name} is not in the cache", "one that is", f"fluidlift models get {name}"
            )  # fmt: skip
        if lacking := _lacking(card, config):
            raise MissingPackage(f"{', '.join(lacking)} is not installed. Needed: for {name}. Do: {card.install}.")
        done[task.word] = name
        config = _taken(config, task, card)
    return Chosen(config, tuple(f"{task} by {name}" for task, name in done.items()))


def used_models(config: JobConfig, inputs: Inputs) -> tuple[UsedModel, ...]:
    """The learned models of a job, by their content.

    Raises:
        InputRejected: a model of the cache that is not what was fetched.
    """
    found = []
    for task in TASKS:
        section = getattr(config, task.section)
        method = getattr(section, task.option)
        if not _learned(task, method) or _settled(task, config, inputs) is not None:
            continue
        weights = Weights.of(section.weights)
        if weights is None:
            found.append(UsedModel(task.word, method, "the default of its package", {}))
            continue
        card = next((c for c in MODELS if c.name == weights.model), None)
        found.append(UsedModel(task.word, method, weights.label, dict(weights.files), card))
    return tuple(found)


def allowed_models(config: JobConfig, inputs: Inputs) -> tuple[tuple[UsedModel, ...], list[Notice]]:
    """The learned models of a job, and warnings about their terms.

    Raises:
        InputRejected: as `used_models` and `require_use`.
    """
    models = used_models(config, inputs)
    return models, require_use(models, config.generate.use)


def provenance_of(models: tuple[UsedModel, ...]) -> dict[str, Any]:
    """For what a job writes about itself; nothing where it took none."""
    return {"models": [model.to_dict() for model in models]} if models else {}


def require_use(models: tuple[UsedModel, ...], use: str | None) -> list[Notice]:
    """Warnings about models whose terms allow research only, where nothing was said about the use.

    Raises:
        InputRejected: commercial use of one whose terms forbid it.
    """
    bound = [m.card for m in models if m.card is not None and not m.card.licence_commercial]
    if not bound or use == "research":
        return []
    names = ", ".join(card.name for card in bound)
    if use == "commercial":
        raise InputRejected(
            f"--use commercial with {names}, whose terms allow research only. {bound[0].licence}",
            "a model whose terms allow the use", "fluidlift models lists them; or leave it out",
        )  # fmt: skip
    return [
        Notice(
            "model-not-commercial",
            f"{names} may be used for research only: so may this asset. Say what it is for with --use research or "
            "--use commercial",
        )
    ]


def require_weights(config: JobConfig) -> None:
    """Say before the clip is read that a model of depth or of the view lacks its weights.

    Raises:
        InputRejected: a model without weights, or weights that are not there and may not be fetched.
    """
    d, v = config.depth, config.view
    _require_weights(
        d.model, d.weights, f"--depth-model {d.model}", "--depth-weights PATH", fetched=d.download,
        check="check --depth-weights, or --set depth.download=true for a name on the hub",
    )  # fmt: skip
    _require_weights(v.model, v.weights, f"view.model={v.model}", "--set view.weights=PATH", check="check view.weights")


def _require_weights(
    model: str, weights: str | None, asked: str, option: str, *, check: str, fetched: bool = False
) -> None:
    """`require_weights` of one model.

    Args:
        model, weights: as the job has them.
        asked: how the model was asked for.
        option: how its weights are given.
        check: what to do about weights that are not there.
        fetched: whether such ones may be fetched.
    """
    if model == "none":
        return
    if weights is None:
        raise InputRejected(
            f"{asked} without its weights", "a file or folder with them",
            f"{option}, or fluidlift models get NAME and make --models NAME",
        )  # fmt: skip
    there = weights.startswith(OF_CACHE) or os.path.exists(os.path.expanduser(weights))
    if not (there or fetched):
        raise InputRejected(
            f"weights '{weights}' that are not there", "an existing file or folder, or model:NAME of the cache", check
        )


def _automatic(config: JobConfig, inputs: Inputs, places: tuple[str, ...]) -> Chosen:
    told = []
    for task in TASKS:
        if task.word not in places or _occupied(task, config, inputs) is not None:
            continue
        for card in MODELS:
            if card.back_end[0] != task.purpose or card.back_end[1] in NEEDS_WORDS or kept(card.name) is None:
                continue
            if config.generate.use == "commercial" and card.terms != "allowed":
                told.append(f"{card.name} is left out: its terms ({card.terms}) and --use commercial")
                continue
            if lacking := _lacking(card, config):
                told.append(f"{card.name} is left out: {', '.join(lacking)} is not installed ({card.install})")
                continue
            config = _taken(config, task, card)
            told.append(f"{task.word} by {card.name} (on a CPU: {card.cpu})")
            break
    return Chosen(config, tuple(told) or ("no learned model is in the cache that could help here: fluidlift models",))


def _lacking(card: ModelCard, config: JobConfig) -> list[str]:
    """Packages that a model lacks; of one that runs in another Python that is told there."""
    elsewhere = config.depth.python is not None and card.back_end[0] == "depth model"
    return [] if elsewhere else lacking_packages(card)


def _task_of(card: ModelCard) -> _Task:
    for task in TASKS:
        if task.purpose == card.back_end[0]:
            return task
    raise InputRejected(
        f"{card.name} is a generator",
        "a model for masks, depth, flow or tilt",
        f"--generator {card.name}, without --models",
    )


def _taken(config: JobConfig, task: _Task, card: ModelCard) -> JobConfig:
    chosen = replace(
        getattr(config, task.section), **{task.option: card.back_end[1], "weights": f"{OF_CACHE}{card.name}"}
    )
    return replace(config, **{task.section: chosen})


def _learned(task: _Task, method: str) -> bool:
    from fluidlift.backends.registry import names

    return method in names(task.purpose)


def _settled(task: _Task, config: JobConfig, inputs: Inputs) -> str | None:
    """What leaves a model of this task nothing to do, as an option."""
    given = next((name for name in task.files if getattr(inputs, name) is not None), None)
    if task.word == "tilt":
        if given is not None and not (inputs.camera is not None and tells_pose(inputs.camera)):
            given = None  # a lens alone leaves the tilt open
        s = config.shape
        if given is None and None not in (s.pitch, s.roll, s.fov):
            return "--pitch, --roll and --fov"
    return None if given is None else {"geometry": "--geometry-from"}.get(given, f"--{given}")


def _occupied(task: _Task, config: JobConfig, inputs: Inputs) -> str | None:
    """What does a task already, as an option; None: nothing that a person chose."""
    settled = _settled(task, config, inputs)
    if settled is not None:
        return settled
    if task.word == "depth" and config.generate.name is not None:
        return f"--generator {config.generate.name}"
    method = getattr(getattr(config, task.section), task.option)
    usual = getattr(getattr(JobConfig(), task.section), task.option)
    return None if method == usual else f"{task.section}.{task.option}={method}"


def _require_free(card: ModelCard, task: _Task, config: JobConfig, inputs: Inputs) -> None:
    other = _occupied(task, config, inputs)
    if other is not None:
        raise InputRejected(
            f"--models {card.name} together with {other}", f"one source of {task.word}", "leave one out"
        )
