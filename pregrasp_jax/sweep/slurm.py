"""SLURM: one generated sbatch array for every rung, each waiting for the one before; no driver stays behind.

A task finds its trial by its number and its run folder by that, so that a requeued task goes on where it was.
"""

import os
import shlex
import shutil
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

from pregrasp_jax import io
from pregrasp_jax.sweep import driver, state
from pregrasp_jax.sweep.estimate import memory_of
from pregrasp_jax.sweep.folder import SweepFolder
from pregrasp_jax.sweep.spec import Spec
from pregrasp_jax.sweep.trials import Trial
from pregrasp_jax.sweep.worker import BUSY, UNWRITTEN

NOTICE = 180
"""s before the end of its time at which a task is asked to stop."""

MOST_REQUEUES = 50
"""Times that a task may put itself back into the queue."""

_STOPPED, _FAILED = 143, 1


def check(spec: Spec) -> None:
    """Refuse a sweep that SLURM cannot do.

    Raises:
        ValueError: sbatch is not here; or the sweep needs a driver that lives as long as it does, or parts of a GPU.
    """
    if spec.search.method == "tpe":
        raise ValueError(
            "search.method tpe needs a driver that lives as long as the sweep; allowed with slurm: grid, random"
        )
    if 0 < spec.resources.gpu < 1:
        raise ValueError(
            f"resources.gpu = {spec.resources.gpu:g}: SLURM shares no GPU between tasks; allowed is 0 or a whole number"
        )
    if shutil.which("sbatch") is None:
        raise ValueError("--launcher slurm needs sbatch, which is not here; allowed is a host that can submit jobs")


def submit(folder: SweepFolder, spec: Spec, *, parallel: int | None) -> list[str]:
    """Write the arrays, hand them to sbatch, and return one line for each.

    Raises:
        ValueError: sbatch refuses.
    """
    count, said, previous = len(folder.states()), [], ""
    stages: list[tuple[str, int, list[str]]] = [
        (f"rung-{rung}", count, ["--rung", str(rung)]) for rung in state.rungs(spec)
    ]
    stages.append(("end", count, []))
    if finals := len(spec.final.seeds) * spec.final.top:
        stages.append(("final", finals, ["--final", "True"]))
    for name, size, options in stages:
        script = folder.path / f"{name}.sbatch"
        io.write_bytes(script, sbatch_text(folder, spec, name, size, options, parallel=parallel).encode())
        previous = _sbatch(script, previous)
        said.append(f"submitted {script.name} as job {previous}: {size} tasks")
    return said


def sbatch_text(
    folder: SweepFolder, spec: Spec, name: str, size: int, options: Sequence[str], *, parallel: int | None
) -> str:
    """Return the script of an array of `size` tasks."""
    resources = spec.resources
    settings = {
        "job-name": f"{folder.path.name}-{name}",
        "array": f"0-{size - 1}" + (f"%{parallel}" if parallel else ""),
        "cpus-per-task": resources.cores,
        "mem": f"{int(memory_of(spec) / 1e6)}M",
        **({"gres": f"gpu:{int(resources.gpu)}"} if resources.gpu else {}),
        "signal": f"B:TERM@{NOTICE}",
        "open-mode": "append",
        "output": folder.path / "logs" / "slurm-%A_%a.out",
        "chdir": folder.cwd,
        **spec.slurm,
    }
    lines = [f"#SBATCH --{key}={value}" for key, value in settings.items()]
    words = ["-m", "pregrasp_jax", "sweep", "worker", str(folder.path), "--requeue", "True", *options]
    command = shlex.join([sys.executable, *words])
    # The batch shell alone gets the signal, so the worker takes its place.
    return "\n".join(["#!/bin/bash", *lines, "#SBATCH --requeue", f'exec {command} --task "$SLURM_ARRAY_TASK_ID"', ""])


def _sbatch(script: Path, after: str) -> str:
    """Submit a script and return the id of its job."""
    options = [f"--dependency=afterany:{after}"] if after else []
    try:
        done = subprocess.run(
            ["sbatch", "--parsable", *options, str(script)], capture_output=True, text=True, check=True
        )
    except subprocess.CalledProcessError as error:
        said = " ".join(error.stderr.split())
        raise ValueError(f"sbatch refuses {script}: {said}; the key slurm of the spec takes further options") from None
    return done.stdout.strip().split(";")[0]


def trial_of(folder: SweepFolder, spec: Spec, task: int, *, rung: int | None, final: bool) -> Trial | None:
    """Return the trial of a task, though it may be over; None if halving has given it up, or there is no such winner.

    Raises:
        ValueError: there is no task of this number.
    """
    states = folder.states()
    if final:
        driver.plan_finals(folder, spec)
        chosen = [s.trial for s in folder.states() if s.trial.final]
        return chosen[task] if task < len(chosen) else None
    found = next((s for s in states if s.trial.number == task), None)
    if found is None:
        raise ValueError(f"there is no trial {task}; allowed is 0 to {len(states) - 1}")
    alive = [s for s in states if not s.trial.final]
    for level in state.rungs(spec):
        if rung is not None and level >= rung:
            break
        alive = state.survivors(spec, alive, level)
    return found.trial if found.trial.final or found.over or found in alive else None


def requeue(folder: SweepFolder, trial: Trial, code: int) -> None:
    """Put the SLURM task that this is back into the queue if its time was up, or its trial is busy or failed for now.

    Args:
        folder: of the sweep.
        trial: that of the task.
        code: of its worker.
    """
    job, task = os.environ.get("SLURM_ARRAY_JOB_ID"), os.environ.get("SLURM_ARRAY_TASK_ID")
    again = (_STOPPED, _FAILED, BUSY, UNWRITTEN)
    over = next(s.over for s in folder.states() if s.trial.id == trial.id)
    if code not in again or (over and code == _FAILED) or not job or folder.stopping:
        return
    if int(os.environ.get("SLURM_RESTART_COUNT") or 0) < MOST_REQUEUES:
        # Where SLURM itself puts it back, after a preemption, this one is refused, which does no harm.
        subprocess.run(["scontrol", "requeue", f"{job}_{task}"], check=False)
