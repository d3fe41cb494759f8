"""The engine of many machines: a task of Ray per shot, on one machine or on a cluster that is there.

A task does what the local engine does (`farm.making`), on whatever machine; results lie in the folder, which all of
them share, and only what became of a shot travels. Ray's own retries are off: the batch knows which failures another
try can mend. Moritz, Nishihara et al. 2018, "Ray: a distributed framework for emerging AI applications".
"""

from __future__ import annotations

import signal
import time
import uuid
from collections import deque
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from platform import node
from typing import Any

from fluidlift import __version__
from fluidlift.errors import InputRejected
from fluidlift.farm.engine import TASK_CORES, TASK_MEMORY, Limits, Tell, next_limits
from fluidlift.farm.making import RunningMakes, finished, is_wanted, make_shot, now
from fluidlift.farm.preflight import NOTE, Machine, looked_at, require_fit
from fluidlift.farm.ray_session import session
from fluidlift.farm.shots import Shot
from fluidlift.farm.state import LOG, ShotOutcome, claimed, list_names, write_outcome
from fluidlift.farm.store import Store
from fluidlift.io.asset_lock import held

AHEAD = 2
"""tasks in flight per one that can run: the next begin at once, and a cluster that grows sees that it should"""
_POLL = 2.0
"""s after which machines are counted again, and shots that somebody else held are looked at again"""
_ELSEWHERE = 60.0
"""s until a shot that somebody else makes is left to him: the makes of a machine that was lost end sooner"""
_LOOK = 120.0
"""s that a machine has to answer; the first process of a cold node takes ten"""
_SETTLE = 3.0
"""s, `RunningMakes.settle`: a worker whose driver died kills what it started, then leaves within 0.1 s on an idle
machine"""
_LAST = 40.0
"""s that cancelled tasks have to end their makes"""


@dataclass(frozen=True)
class RayEngine:
    """A Ray cluster."""

    address: str | None = None
    """of its head, HOST:PORT, or "auto"; None: processes of this machine alone"""
    jobs: int | None = None
    """shots at a time; None: as many as there is room for"""
    cores: int | None = None
    """of each shot; None: `TASK_CORES`, or all of the largest machine where that has fewer"""
    gpus: float = 0.0
    """of each shot"""
    store: Store | None = None
    """where assets belong, which each machine makes in a folder of its own; None: the folder, which all share"""

    def shots(self, shots: list[Shot], folder: Path, limits: Limits, tell: Tell, part: Tell) -> Iterator[ShotOutcome]:
        """As `Engine.shots`.

        Raises:
            MissingPackage: Ray is not installed.
        """
        with session(self.address) as ray:
            cluster = _Cluster(ray)
            task = cluster.task_of(self, limits)
            for line in cluster.looked_at(folder, shots, self.store):
                tell(line)
            tell(f"{cluster.words()}; each shot: {task.words()}")
            list_names(folder, [shot.name for shot in shots])
            limits = replace(limits, threads=task.cores, memory=task.memory)
            batch = _ShotQueue(cluster, task, folder, tell, deque(_Try(shot, limits) for shot in shots), self.store)
            try:
                yield from batch.outcomes(self.jobs)
            finally:
                batch.stop()


@dataclass(frozen=True)
class _TaskResources:
    """What a shot asks of a machine."""

    cores: int
    memory: float
    gpus: float

    def words(self) -> str:
        gpus = f", {self.gpus:g} GPU" if self.gpus else ""
        return f"{self.cores} cores, {self.memory / 1e9:.3g} GB{gpus}"


@dataclass
class _Try:
    """A shot that is not done."""

    shot: Shot
    limits: Limits
    not_before: float = 0.0
    elsewhere_since: float | None = None


@dataclass(frozen=True)
class _Cluster:
    """Machines that are alive."""

    ray: Any

    def machines(self) -> list[dict[str, Any]]:
        return [node for node in self.ray.nodes() if node["Alive"]]

    def largest(self, resource: str) -> float:
        return max((node["Resources"].get(resource, 0.0) for node in self.machines()), default=0.0)

    def slots(self, task: _TaskResources) -> int:
        """Shots that can be made at a time."""

        def of(node: dict[str, float]) -> int:
            gpus = [node.get("GPU", 0.0) / task.gpus] if task.gpus else []
            return int(min(node.get("CPU", 0.0) / task.cores, node.get("memory", 0.0) / task.memory, *gpus))

        return sum(of(node["Resources"]) for node in self.machines())

    def words(self) -> str:
        found = self.machines()
        cores = sum(node["Resources"].get("CPU", 0.0) for node in found)
        return f"Ray: {len(found)} machine{'s' * (len(found) != 1)}, {cores:.0f} cores"

    def task_of(self, engine: RayEngine, limits: Limits) -> _TaskResources:
        """What a shot asks for.

        Raises:
            InputRejected: no machine has as much.
        """
        cores, memory = self.largest("CPU"), self.largest("memory")
        task = _TaskResources(
            engine.cores or max(min(TASK_CORES, int(cores)), 1),
            limits.memory or min(TASK_MEMORY, memory), engine.gpus,
        )  # fmt: skip
        have = _TaskResources(int(cores), memory, self.largest("GPU"))
        if task.cores > have.cores or task.memory > have.memory or task.gpus > have.gpus:
            raise InputRejected(
                f"a shot asks for {task.words()}; the largest machine of the cluster has {have.words()}",
                "a machine with as much", "lower --cores, --memory-limit or --gpus, or add a larger machine",
            )  # fmt: skip
        return task

    def looked_at(self, folder: Path, shots: list[Shot], store: Store | None) -> list[str]:
        """What should be known of the machines, before work starts.

        Raises:
            InputRejected: one of them cannot be used.
        """
        note = f"looking {uuid.uuid4().hex}"
        clips = [shot.clip for shot in (shots[0], shots[-1]) if shot.clip.exists()] if shots else []
        with held(folder / NOTE, note, wait=_LOOK):
            ours = looked_at(folder)
            require_fit([ours], folder)
            asked = {self._asked(node["NodeID"], store or folder, note, clips): node for node in self.machines()}
            notes: list[str] = []
            until = time.monotonic() + _LOOK
            while asked:
                ready, _ = self.ray.wait(list(asked), timeout=max(until - time.monotonic(), 0.0))
                if not ready:
                    silent = ", ".join(sorted(node["NodeManagerHostname"] for node in asked.values()))
                    raise InputRejected(f"no answer from {silent} in {_LOOK:.0f} s", "machines that answer",
                                        "see ray status, and take them out")  # fmt: skip
                machine = self._answer(ready[0], asked.pop(ready[0]))
                if machine is not None:
                    notes += require_fit([machine], folder, ours=replace(ours, clock=time.time()))
        return list(dict.fromkeys(notes))

    def _asked(self, node: str, where: Path | Store, note: str, clips: list[Path]) -> Any:
        strategy = self.ray.util.scheduling_strategies.NodeAffinitySchedulingStrategy(node, soft=False)
        told = vars(where) if isinstance(where, Store) else where  # there may be no fluidlift
        return _looker(self.ray).options(scheduling_strategy=strategy).remote(told, note, clips)

    def _answer(self, ref: Any, node: dict[str, Any]) -> Machine | None:
        """What a machine said of itself; None of one that is gone meanwhile."""
        try:
            return Machine(**self.ray.get(ref))
        except self.ray.exceptions.RayTaskError as error:
            return Machine(node["NodeManagerHostname"], error=f"looking at it failed: {error.cause!r}"[:300])
        except self.ray.exceptions.RayError:
            return None


def _looker(ray: Any) -> Any:
    """The task that looks at its machine. It travels as it stands, as there may be no fluidlift, or another one."""

    def look(where, note, clips):
        import platform

        try:
            from fluidlift.farm.preflight import looked_at, looked_at_store
        except ImportError as error:
            found = {"host": platform.node(), "error": f"no fluidlift of this version ({error})"}
            with suppress(ImportError):
                import fluidlift

                found |= {"error": "", "version": fluidlift.__version__}
            return found
        return dict(vars(looked_at_store(where, clips) if isinstance(where, dict) else looked_at(where, note, clips)))

    return ray.remote(num_cpus=0, max_retries=0)(look)


def _make(shot: Shot, place: Path | Store, limits: Limits, version: str) -> ShotOutcome | None:
    """What a task does.

    Raises:
        InputRejected: its machine, which came after the others were looked at, has another version of fluidlift.
    """
    store = place if isinstance(place, Store) else None
    folder = place.folder if isinstance(place, Store) else place
    require_fit([Machine(node(), __version__)], folder, ours=Machine("", version))
    with suppress(ValueError):  # a batch that a shell began in the background ignores it, and so would a cancelled task
        signal.signal(signal.SIGINT, signal.default_int_handler)
    return make_shot(shot, folder, limits, RunningMakes(settle=_SETTLE), store)


@dataclass
class _ShotQueue:
    """Shots that wait and tasks in flight."""

    cluster: _Cluster
    task: _TaskResources
    folder: Path
    tell: Tell
    waiting: deque[_Try]
    store: Store | None = None
    flying: dict[Any, _Try] = field(default_factory=dict)

    def outcomes(self, jobs: int | None) -> Iterator[ShotOutcome]:
        """Each shot as it ends."""
        slots, counted = 0, -_POLL
        while self.waiting or self.flying:
            if time.monotonic() - counted >= _POLL:
                before, slots, counted = slots, self.cluster.slots(self.task), time.monotonic()
                if slots == 0 and before:
                    self.tell("no machine is left that can make a shot: waiting for one")
            room = min(AHEAD * max(slots, 1), jobs or AHEAD * max(slots, 1))
            yield from self._fill(room)
            if not self.flying:
                time.sleep(0.1 if self.waiting else 0.0)
                continue
            ready = self._ready()
            for ref in ready:
                if (outcome := self._ended(ref, self.flying.pop(ref))) is not None:
                    yield outcome

    def _ready(self) -> list[Any]:
        """Tasks that ended, after a moment."""
        try:
            return self.cluster.ray.wait(list(self.flying), timeout=_POLL)[0]
        except SystemError as error:  # how Ray wraps what a handler of a signal raises
            raise error.__cause__ or error from None

    def _fill(self, room: int) -> Iterator[ShotOutcome]:
        """Start what there is room for; what is finished already needs none."""
        for _ in range(len(self.waiting)):
            if len(self.flying) >= room:
                return
            one = self.waiting.popleft()
            if one.not_before > time.monotonic():
                self.waiting.append(one)
            elif (known := finished(one.shot, self.folder, self.store)) is not None:
                yield known
            elif is_wanted(self.folder, one.shot.name, one.limits.retry):
                self.flying[self._started(one)] = one

    def _started(self, one: _Try) -> Any:
        task = self.cluster.ray.remote(_make).options(
            num_cpus=self.task.cores, memory=int(one.limits.memory or self.task.memory), num_gpus=self.task.gpus,
            max_retries=0, scheduling_strategy="SPREAD", name=one.shot.name,
        )  # fmt: skip
        return task.remote(one.shot, self.store or self.folder, one.limits, __version__)

    def _ended(self, ref: Any, one: _Try) -> ShotOutcome | None:
        """What became of a try; None where there is another one, or somebody else makes the shot."""
        outcome = self._result(ref, one)
        if outcome is not None and self.store is not None:  # the machine that made it wrote that into its own folder
            write_outcome(self.folder, outcome)
        if outcome is None:
            return self._elsewhere(one)
        limits = next_limits(outcome, one.limits, self.cluster.largest("memory"))
        if limits is None:
            return outcome
        more = f", with {limits.memory / 1e9:.3g} GB" if limits.memory and limits.memory != one.limits.memory else ""
        self.tell(f"{one.shot.name}: {outcome.reason or outcome.failure}; tried again{more}")
        self.waiting.append(_Try(one.shot, limits))
        return None

    def _elsewhere(self, one: _Try) -> None:
        since = time.monotonic() if one.elsewhere_since is None else one.elsewhere_since
        if time.monotonic() - since > _ELSEWHERE:
            self.tell(f"{one.shot.name}: being made by another batch, left to it")
            return
        self.waiting.append(replace(one, not_before=time.monotonic() + _POLL, elsewhere_since=since))

    def _result(self, ref: Any, one: _Try) -> ShotOutcome | None:
        """What a task gave; where it was lost with its process or machine, that is what became of the shot."""
        errors = self.cluster.ray.exceptions
        try:
            return self.cluster.ray.get(ref)
        except errors.RayTaskError as error:
            if isinstance(error.cause, InputRejected):  # a full disk: the others would fail as well
                raise error.cause from None
            return self._lost(one, f"the task failed: {error.cause!r}"[:300], "crash")
        except errors.OutOfMemoryError:
            return self._lost(one, "its machine ran out of memory", "memory")
        except errors.RayError as error:
            return self._lost(one, f"its process or machine was lost ({type(error).__name__})", "crash")

    def _lost(self, one: _Try, reason: str, failure: str) -> ShotOutcome:
        folder, name = self.folder, one.shot.name
        outcome = ShotOutcome(
            name, "failed", 0.0, str(folder / f"{name}.fluid"), str(folder / f"{name}{LOG}"), reason=reason,
            failure=failure, version=__version__, ended=now(), clip=str(one.shot.clip), licence=one.shot.licence,
            source=one.shot.source,
        )  # fmt: skip
        with claimed(folder, name) as lock:
            if lock is not None:
                outcome = outcome if self.store is None else self.store.put(outcome)
                write_outcome(folder, outcome)
        return outcome

    def stop(self) -> None:
        """Cancel what is in flight, and give makes the time to end; what they finished is kept."""
        if not self.flying:
            return
        ray = self.cluster.ray
        for ref in self.flying:
            with suppress(Exception):  # whatever Ray has to say of a cluster that may be gone
                ray.cancel(ref, force=False)
        with suppress(Exception):
            ray.wait(list(self.flying), num_returns=len(self.flying), timeout=_LAST)
