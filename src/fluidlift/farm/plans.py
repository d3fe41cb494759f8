"""Jobs for other schedulers: an Open Job Description template, a Slurm array script, or one command per line.

Every task makes one shot of the list by `fluidlift batch LIST -o OUT --shard i/n`, so that states, logs and resuming
are those of a batch on one machine.
"""

from __future__ import annotations

import math
import shlex
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

KINDS = ("openjd", "slurm", "commands")
"""Open Job Description 2023-09 (AWS Deadline Cloud and others); Slurm; lines for OpenCue, Flamenco, GNU parallel"""
FILES = {"openjd": "plan.openjd.yaml", "slurm": "plan.slurm.sh", "commands": "plan.txt"}

MARGIN = 120.0
"""s between a shot's limit and its task's: it has half a minute to end, and the start takes a few seconds"""


@dataclass(frozen=True)
class TaskPlan:
    """What every task runs, and what it needs."""

    arguments: Sequence[str]
    """of `fluidlift batch`, without --shard"""
    shots: int
    cores: int
    """of each task"""
    memory: float
    """bytes, of each task"""
    seconds: float | None = None
    """that a shot may take; a scheduler ends its task only `MARGIN` later, so that what became of it is kept"""

    def command(self, task: int | str) -> list[str]:
        """Of one task, numbered from 1 (or what a scheduler puts there)."""
        return ["fluidlift", "batch", *self.arguments, "--shard", f"{task}/{self.shots}", "--warnings-ok"]


def written(kind: str, plan: TaskPlan, folder: Path) -> Path:
    """The file of a plan, in the folder of the assets."""
    from fluidlift.io.atomic import write_bytes

    text = {"openjd": _openjd, "slurm": _slurm, "commands": _commands}[kind](plan)
    path = folder / FILES[kind]
    write_bytes(path, text.encode())
    return path


def _openjd(plan: TaskPlan) -> str:
    import yaml

    action: dict = {"command": "fluidlift", "args": [*plan.command("{{Task.Param.Shot}}")[1:], "--progress", "openjd"]}
    if plan.seconds is not None:
        action["timeout"] = math.ceil(plan.seconds + MARGIN)
    job = {
        "specificationVersion": "jobtemplate-2023-09",
        "name": "fluidlift",
        "steps": [
            {
                "name": "make",
                "parameterSpace": {
                    "taskParameterDefinitions": [{"name": "Shot", "type": "INT", "range": f"1-{plan.shots}"}]
                },
                "hostRequirements": {
                    "amounts": [
                        {"name": "amount.worker.vcpu", "min": plan.cores},
                        {"name": "amount.worker.memory", "min": math.ceil(plan.memory / 2**20)},
                    ]
                },
                "script": {"actions": {"onRun": action}},
            }
        ],
    }
    return yaml.safe_dump(job, sort_keys=False, width=1000)


def _slurm(plan: TaskPlan) -> str:
    limit = "" if plan.seconds is None else f"#SBATCH --time={math.ceil((plan.seconds + MARGIN) / 60)}\n"
    command = shlex.join(plan.command("TASK")).replace("TASK/", '"$SLURM_ARRAY_TASK_ID"/')
    return (
        "#!/bin/sh\n#SBATCH --job-name=fluidlift\n"
        f"#SBATCH --array=1-{plan.shots}\n#SBATCH --cpus-per-task={plan.cores}\n"
        f"#SBATCH --mem={math.ceil(plan.memory / 2**20)}M\n{limit}#SBATCH --requeue\n"
        f"# a task that is preempted goes on from its last finished stage\nexec {command}\n"
    )


def _commands(plan: TaskPlan) -> str:
    return "".join(f"{shlex.join(plan.command(k))}\n" for k in range(1, plan.shots + 1))
