"""Which tuned numbers matter: each one of `fluidlift.shape` and `fluidlift.motion` times 0.5 and times 2.

    python benchmarks/sensitivity.py                          all made scenes; resumes where it was stopped
    python benchmarks/sensitivity.py --scenes stream dam --only 'shape.kind.*'
    python benchmarks/sensitivity.py --clips CLIPS --only ...  real clips too (first 1.2 s, 320 px): what is found
                                                              against what was found with the numbers as they are
    python benchmarks/sensitivity.py --undecided              the classes alone, sooner: what matters by one trial is
                                                              not tried again
    python benchmarks/sensitivity.py --record                 writes benchmarks/results/sensitivity.json and the tables
                                                              of docs/experiments/2026-11-sensitivity.md

A scene is looked at once with a trace of its lines, which says what each stage reads; a number is tried only where it
is read, from the first stage that reads it on, in a process of its own that is forked off with all results before it. A
stage whose inputs are the same bits, and which does not read the number itself, is not run again.

A number *matters* where it changes a figure by more than other seeds of the same scenes do (simulation and texture
anew): by more than the median, over the scenes, of the standard deviation over three seeds. A run that
ends is counted apart. A number *changes nothing* where every value of every stage has the same bits.
"""

from __future__ import annotations

import argparse
import fnmatch
import hashlib
import io
import json
import os
import pickle
import shutil
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from types import CodeType, FrameType
from typing import Any

import numpy as np
import sensitivity_constants as tuned
import sensitivity_scenes as made
from sensitivity_constants import Constant
from sensitivity_scenes import SCENES, SEEDS, Findings

FACTORS = (0.5, 2.0)
STAGES = {
    "read": (),
    "flow": ("read",),
    "clues": ("read", "flow"),
    "segment": ("read", "flow", "clues"),
    "sighted": ("read", "flow", "segment"),
    "geometry": ("read", "flow", "segment", "sighted"),
    "refine": ("read", "flow", "segment", "geometry"),
    "motion": ("read", "flow", "segment", "geometry"),
}
"""in their order, with those whose results each is given; the first parts of segment and geometry by themselves"""
FOUND = ("read", "flow", "segment", "geometry", "refine", "motion")
LONGEST = 120.0
"""s that a trial may take; it is given up then, and counts as failed"""
QUICK = ("shape.cells=32", "motion.targets=1", "shape.refine_iterations=3")
CLIP_SECONDS, CLIP_PX = 1.2, 320


class Stages:
    """Runs the stages of one clip.

    Args:
        clip: video file or folder of pictures.
        scratch: an empty folder for large arrays.
        real: a real clip, of which only the beginning is looked at.
    """

    def __init__(self, clip: Path, scratch: Path, *, real: bool) -> None:
        from fluidlift.config import build_config
        from fluidlift.pipeline.inputs import GivenFiles, Inputs

        more = (f"read.duration={CLIP_SECONDS}", f"read.max_size={CLIP_PX}") if real else ()
        self.config, self.scratch = build_config("draft", None, (*QUICK, *more), {}), scratch
        self.given = GivenFiles.of(Inputs(clip))

    def run(self, name: str, values: dict[str, Any]) -> Any:
        """One stage, from the values of those before it."""
        from fluidlift.pipeline import begin, settings, stages
        from fluidlift.pipeline.hints import NO_HINTS
        from fluidlift.pipeline.work import Work
        from fluidlift.types.hints import NOTHING_SAID

        c, given, before = self.config, self.given, [values[k] for k in STAGES[name] if k in FOUND]
        work = Work.alone(self.scratch / name)
        view = settings.GivenView.of(given, c)
        match name:
            case "read":
                told = settings.ReadSettings.of(c)
                return stages.read.read(given.clip, given.camera, told, work=work)
            case "flow":
                return stages.flow.estimated_flow(*before, settings.FlowSettings.of(c), work=work)
            case "clues":
                return stages.segment.clues(*before, None)
            case "segment":
                told = settings.SegmentSettings.of(c)
                with replaced(stages.segment, "clues", values["clues"]):
                    return stages.segment.segment(*before, None, told, NO_HINTS, work=work)
            case "sighted":
                told = begin.geometry_settings(values["read"], c, NOTHING_SAID)
                return stages.geometry.sighted(*before, view, told, work=work)
            case "geometry":
                told = begin.geometry_settings(values["read"], c, NOTHING_SAID)
                with replaced(stages.geometry, "sighted", values["sighted"]):
                    return stages.geometry.geometry(*before, view, told, work=work)
            case "refine":
                told = settings.taken(settings.RefineSettings, c.shape, seed=c.seed)
                return stages.refine.refine(*before, None, told, work=work)
        return stages.motion.motion(*before, settings.MotionSettings.of(c, guide=False), work=work)


@contextmanager
def replaced(module: Any, name: str, value: Any) -> Iterator[None]:
    """A function of a module gives a value that is known."""
    function = getattr(module, name)
    setattr(module, name, lambda *_, **__: value)
    try:
        yield
    finally:
        setattr(module, name, function)


def import_all() -> None:
    """All that a trial calls: what is loaded before a fork is loaded once."""
    import fluidlift.evaluate
    import fluidlift.io.video
    import fluidlift.pipeline.begin
    import fluidlift.pipeline.stages.motion
    import fluidlift.pipeline.stages.refine  # noqa: F401

    for module in tuned.modules():
        __import__(f"fluidlift.{module}")


def digest(value: Any) -> str:
    """Of all bits of a stage's value."""
    from fluidlift.io.stage_codec import packed

    if not type(value).__module__.endswith("types.stages"):
        return hashlib.sha256(pickled(value)).hexdigest()
    arrays, data = packed(value)
    found = hashlib.sha256(json.dumps(data, sort_keys=True, default=str).encode())
    for name in sorted(arrays):
        found.update(f"{name}{arrays[name].dtype}{arrays[name].shape}".encode())
        found.update(np.ascontiguousarray(arrays[name]).tobytes())
    return found.hexdigest()


class _Pickler(pickle.Pickler):
    """Arrays that are mapped from disk are kept by their content."""

    def reducer_override(self, value: Any) -> Any:
        return np.array(value).__reduce__() if isinstance(value, np.memmap) else NotImplemented


def pickled(value: Any) -> bytes:
    """With the content of mapped arrays."""
    held = io.BytesIO()
    _Pickler(held, protocol=5).dump(value)
    return held.getvalue()


# one trial, in a process of its own -----------------------------------------------------------------------------------


def forked(function: Callable[[Path], Any]) -> Any:
    """What a function returns in a child process, pickled; {"failed": why} where it raises or takes too long."""
    with tempfile.TemporaryDirectory(prefix="sensitivity-") as folder:
        answer = Path(folder) / "answer.pickle"
        child = os.fork()
        if child == 0:
            _answer(function, Path(folder), answer)
        until = time.monotonic() + LONGEST
        while os.waitpid(child, os.WNOHANG)[0] == 0:
            if time.monotonic() > until:
                os.kill(child, 9)
                os.waitpid(child, 0)
                return {"failed": f"over {LONGEST:.0f} s"}
            time.sleep(0.01)
        if not answer.is_file():
            return {"failed": "the process ended"}
        return pickle.loads(answer.read_bytes())


def _answer(function: Callable[[Path], Any], folder: Path, answer: Path) -> None:
    """Of the child; does not return."""
    sys.stdout = sys.stderr = open(os.devnull, "w")  # noqa: SIM115
    try:
        found = function(folder)
    except BaseException as error:
        found = {"failed": f"{type(error).__name__}: {error}"[:160]}
    answer.with_suffix(".part").write_bytes(pickled(found))
    os.replace(answer.with_suffix(".part"), answer)
    os._exit(0)


def findings(values: dict[str, Any]) -> Findings:
    """Of the values of all stages."""
    return Findings(*(values[name] for name in FOUND))


def _note(lines: set[tuple[CodeType, int]], frame: FrameType, event: str, _: Any) -> Any:
    """Trace function that notes the lines of fluidlift that are run."""
    code = frame.f_code
    if not code.co_filename.startswith(str(tuned.ROOT)):
        return None

    def line(frame: FrameType, event: str, _: Any) -> Any:
        lines.add((code, frame.f_lineno))
        return line

    return line(frame, event, None)


def looked_at(clip: Path, everything: list[Constant], scratch: Path, *, real: bool) -> dict[str, Any]:
    """A clip with the numbers as they are: values and digests of the stages, and what each reads."""
    stages, values, digests, read = Stages(clip, scratch, real=real), {}, {}, {}
    for name in STAGES:
        lines: set[tuple[CodeType, int]] = set()
        threading.settrace(partial(_note, lines))
        sys.settrace(partial(_note, lines))
        values[name] = stages.run(name, values)
        sys.settrace(None)
        threading.settrace(None)
        files = {code.co_filename for code, _ in lines}
        digests[name] = digest(values[name])
        read[name] = tuned.reads(lines, everything) | tuned.early_reads(files, everything)
    return {"values": values, "digests": digests, "reads": read}


def trial(
    clip: Path, base: dict[str, Any], constant: Constant, factor: float, scratch: Path, *, real: bool,
    scored: Callable[[Findings], dict[str, float]],
) -> dict[str, Any]:  # fmt: skip
    """Which stages have another value with the number scaled, and the figures where any has."""
    if constant.at_import:
        tuned.import_afresh(constant, factor)
        import_all()
        base = pickle.loads(base["pickled"])
    else:
        tuned.set_in_place(constant, factor)
    stages, values, changed = Stages(clip, scratch, real=real), dict(base["values"]), []
    for name, given in STAGES.items():
        if constant.key in base["reads"][name] or any(k in changed for k in given):
            values[name] = stages.run(name, values)
            if digest(values[name]) != base["digests"][name]:
                changed.append(name)
    return {"changed": changed, "figures": scored(findings(values)) if changed else {}}


# all trials -----------------------------------------------------------------------------------------------------------


class Study:
    """All trials of a state of the source, kept in a folder as they come.

    Args:
        folder: for scenes and results; results of another source in it are dropped.
        clips: folder of real clips, or none.
    """

    def __init__(self, folder: Path, clips: Path | None) -> None:
        self.folder, self.clips = folder, clips
        folder.mkdir(parents=True, exist_ok=True)
        state, marker = _source_state(), folder / "source"
        if not marker.is_file() or marker.read_text() != state:
            for old in ("trials.jsonl", "seeds.json", "reached.json"):
                (folder / old).unlink(missing_ok=True)
            shutil.rmtree(folder / "looks", ignore_errors=True)
            marker.write_text(state)
        self.constants, self.left_out = tuned.constants()
        self.lines = folder / "trials.jsonl"
        self.rows = [json.loads(line) for line in self.lines.read_text().splitlines()] if self.lines.is_file() else []

    def real_clips(self) -> dict[str, Path]:
        """By name: the only video in each folder of `clips`."""
        if self.clips is None:
            return {}
        found = {}
        for place in sorted(p for p in self.clips.iterdir() if p.is_dir()):
            videos = sorted(p for p in place.iterdir() if p.suffix in (".mp4", ".mov", ".webm", ".mkv", ".avi"))
            if videos:
                found[place.name] = videos[0]
        return found

    def look(self, name: str, clip: Path, *, real: bool) -> dict[str, Any]:
        """The clip with the numbers as they are; kept on disk."""
        kept = self.folder / "looks" / f"{name}.pickle"
        if not kept.is_file():
            base = forked(lambda scratch: looked_at(clip, self.constants, scratch, real=real))
            if "failed" in base:
                raise SystemExit(f"{name}: {base['failed']}")
            kept.parent.mkdir(exist_ok=True)
            kept.write_bytes(pickle.dumps(base, protocol=5))
        pickled = kept.read_bytes()
        return pickle.loads(pickled) | {"pickled": pickled}

    def scorer(self, name: str, base: dict[str, Any], seed: int = 0) -> Callable[[Findings], dict[str, float]]:
        """Figures of a made scene, or changes of a real clip."""
        if name in SCENES:
            return partial(made.figures, scene=name, seed=seed, folder=self.folder / "scenes")
        return partial(made.changes, before=findings(base["values"]))

    def decided(self) -> set[str]:
        """Constants that matter by the trials that there are."""
        from sensitivity_page import bounds, judged

        found = judged(self.rows, bounds(self.seeds([])))
        return {key for key, entry in found.items() if entry["size"] > 1.0}

    def tried(self, name: str) -> set[str]:
        """Constants with trials in other scenes than this one."""
        return {r["constant"] for r in self.rows if r["scene"] != name}

    def run(self, name: str, only: str, *, undecided: bool = False, untried: bool = False) -> None:
        """All trials of one scene or clip that were not done yet.

        Args:
            name: of the scene or clip.
            only: pattern of constants.
            undecided: none of constants that matter by a trial before.
            untried: none of constants that were tried in another scene.
        """
        real = name not in SCENES
        clip = self.real_clips()[name] if real else made.clip_of(name, 0, self.folder / "scenes")
        base = self.look(name, clip, real=real)
        reached = set().union(*base["reads"].values())
        self._note_reached(name, reached)
        done = {(r["scene"], r["constant"], r["factor"]) for r in self.rows}
        if (name, "", 1.0) not in done:
            scored = self.scorer(name, base)
            self._keep(name, "", 1.0, {"changed": [], "figures": forked(lambda _: scored(findings(base["values"])))})
        skipped = (self.decided() if undecided else set()) | (self.tried(name) if untried else set())
        wanted = [
            (c, f) for c in self.constants for f in FACTORS
            if c.key in reached - skipped and fnmatch.fnmatch(c.key, only) and (name, c.key, f) not in done
        ]  # fmt: skip
        began = time.monotonic()
        for number, (constant, factor) in enumerate(wanted, 1):
            if not undecided or factor == FACTORS[0] or constant.key not in self.decided():
                work = partial(trial, clip, base, constant, factor, real=real, scored=self.scorer(name, base))
                self._keep(name, constant.key, factor, forked(lambda scratch, work=work: work(scratch=scratch)))
            left = (time.monotonic() - began) / number * (len(wanted) - number)
            if number % 10 == 0 or number == len(wanted):
                print(f"{name}: {number} of {len(wanted)}, {left / 60.0:.0f} min left", flush=True)

    def _keep(self, scene: str, constant: str, factor: float, found: dict[str, Any]) -> None:
        row = {"scene": scene, "constant": constant, "factor": factor, **found}
        self.rows.append(row)
        with self.lines.open("a") as file:
            file.write(json.dumps(row) + "\n")

    def _note_reached(self, name: str, reached: set[str]) -> None:
        text = json.dumps(self.reached() | {name: sorted(reached)})
        (self.folder / "reached.json").write_text(text)

    def reached(self) -> dict[str, list[str]]:
        """Constants that each scene reads, by scene."""
        kept = self.folder / "reached.json"
        return json.loads(kept.read_text()) if kept.is_file() else {}

    def seeds(self, scenes: list[str]) -> dict[str, dict[str, list[float]]]:
        """Figures of the scenes by other seeds, by scene and figure."""
        kept = self.folder / "seeds.json"
        known = json.loads(kept.read_text()) if kept.is_file() else {}
        for scene in scenes:
            for seed in SEEDS:
                if f"{scene}-{seed}" not in known:
                    clip, score = made.clip_of(scene, seed, self.folder / "scenes"), self.scorer(scene, {}, seed)
                    known[f"{scene}-{seed}"] = forked(lambda scratch, c=clip, s=score: s(_plainly(c, scratch)))
                    kept.write_text(json.dumps(known))
                    print(f"{scene}, seed {seed}: {known[f'{scene}-{seed}']}", flush=True)
        return known


def _plainly(clip: Path, scratch: Path) -> Findings:
    """What is found, without a trace."""
    stages, values = Stages(clip, scratch, real=False), {}
    for name in STAGES:
        values[name] = stages.run(name, values)
    return findings(values)


def _source_state() -> str:
    """Hash of the package's source."""
    found = hashlib.sha256()
    for file in sorted(tuned.ROOT.rglob("*.py")):
        found.update(file.read_bytes())
    return found.hexdigest()


def main() -> None:
    """Run what is missing; tell, and record where asked."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--work", type=Path, default=Path("runs/sensitivity"), help="scenes and results")
    parser.add_argument("--scenes", nargs="*", choices=SCENES, default=list(SCENES))
    parser.add_argument("--clips", type=Path, help="folder with a folder per real clip")
    parser.add_argument("--clip-names", nargs="*", help="of those, only these")
    parser.add_argument("--only", default="*", help="pattern of module.NAME")
    parser.add_argument("--undecided", action="store_true", help="without those that matter by a trial before")
    parser.add_argument("--untried", action="store_true", help="without those that were tried in another scene")
    parser.add_argument("--seeds", action="store_true", help="first of all, the figures by other seeds")
    parser.add_argument("--record", action="store_true", help="write results and tables; runs nothing")
    options = parser.parse_args()
    import_all()
    study = Study(options.work, options.clips)
    if options.record:
        from sensitivity_page import record

        record(study.rows, study.seeds([]), study.reached(), study.constants, study.left_out)
        return
    if options.seeds:
        study.seeds(options.scenes)
    for name in [*options.scenes, *study.real_clips()]:
        if name in SCENES or not options.clip_names or name in options.clip_names:
            study.run(name, options.only, undecided=options.undecided, untried=options.untried)


if __name__ == "__main__":
    if os.environ.get("OMP_NUM_THREADS") != "1":  # a process with a pool of threads cannot be forked
        one = dict.fromkeys(("OMP_NUM_THREADS", "NUMBA_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "1")
        os.execve(sys.executable, [sys.executable, *sys.argv], os.environ | one)
    main()
