"""`pregrasp-jax reproduce`: a table or figure of the paper by one command that may be stopped and given again."""

import subprocess
import sys
from pathlib import Path
from typing import Annotated, Literal

import tyro

from pregrasp_jax.cli.sweep import LauncherName, check, drive
from pregrasp_jax.sweep import experiments
from pregrasp_jax.sweep.estimate import describe
from pregrasp_jax.sweep.experiments import Experiment
from pregrasp_jax.sweep.folder import CHANGEABLE, SPEC, SweepFolder
from pregrasp_jax.sweep.spec import Spec, to_plain


def reproduce(
    name: Annotated[str, tyro.conf.Positional],
    *,
    budget: float | None = None,
    env_steps: int | None = None,
    size: Literal["budget", "paper"] = "budget",
    dir: Path | None = None,
    launcher: LauncherName = "local",
    parallel: int | None = None,
    cores: int = 1,
    memory_gb: float | None = None,
    gpu: float = 0.0,
    seeds: tuple[int, ...] | None = None,
    object_dir: Path | None = None,
    dry_run: bool = False,
    only_page: bool = False,
) -> int:
    """Make a table or figure of the paper: train, test, and write one page with the paper's numbers beside ours.

    The names are table1, table2, figure4, confined and transfer. The same command goes on with what was stopped.

    Args:
        name: of the experiment.
        budget: minutes of training of each trial; the experiment's own if left out. On a machine that does other
            things, too, some trials get further in them than others.
        env_steps: pushes of each trial, instead of minutes: all get as far, whatever runs beside them.
        size: `budget` trains for minutes on CPUs, `paper` as long as the paper, which is meant for accelerators.
        dir: folder of the trainings; runs/reproduce/NAME if left out.
        launcher: as in `sweep start`.
        parallel: trials at a time; as many as fit if left out.
        cores: of each trial.
        memory_gb: of each trial; estimated if left out.
        gpu: GPUs of each trial; 0.25 puts four on each.
        seeds: of every row; the experiment's own if left out.
        object_dir: folder of your meshes, for one more test.
        dry_run: check everything, say what would be done, and do nothing.
        only_page: write the page of what there is, and do nothing else.
    """
    experiment = experiments.read_experiment(name)
    resources = {"cores": cores, "memory_gb": memory_gb, "gpu": gpu}
    length = {"minutes": budget, "env_steps": env_steps}
    spec = experiments.make_spec(
        experiment, size=size, **length, seeds=seeds, object_dir=object_dir, resources=resources
    )
    path = dir or Path("runs/reproduce") / (experiment.runs if size == "budget" else f"{experiment.runs}-{size}")
    if only_page:
        others = (budget, env_steps, launcher, parallel, cores, memory_gb, gpu, seeds, object_dir, dry_run)
        if others != (None, None, "local", None, 1, None, 0.0, None, None, False):
            raise ValueError("only_page = True writes the page of what there is; allowed beside it: --dir and --size")
        return _write_page(path, experiment)
    check(spec, launcher=launcher, parallel=parallel, names=dry_run)
    for line in describe(spec, launcher=launcher, parallel=parallel):
        print(line, flush=True)
    if dry_run:
        return 0
    folder = _open(path, spec)
    code = drive(folder, spec, launcher=launcher, parallel=parallel)
    # In a process of its own: a page takes JAX, which this one does without.
    page = [sys.executable, "-m", "pregrasp_jax", "reproduce", name, "--dir", str(path), "--only-page", "True"]
    subprocess.run(page, check=False)
    return code


def _open(path: Path, spec: Spec) -> SweepFolder:
    """Return the folder of an experiment, new or as it was left.

    Raises:
        ValueError: it was begun with another budget, other seeds or another version of the experiment, or is driven.
    """
    if not (path / SPEC).exists():
        return SweepFolder.create(path, spec)
    folder = SweepFolder.open(path)
    then, now = to_plain(folder.spec()), to_plain(spec)
    for key in then.keys() | now.keys():
        if key not in CHANGEABLE and then.get(key) != now.get(key):
            raise ValueError(
                f"{path} began with another {key} ({then.get(key)}, now {now.get(key)}); allowed is the same, or "
                "another --dir"
            )
    with folder.drive():
        folder.ask_to_stop(False)
        folder.edit(tests=spec.tests, resources=spec.resources)
    return folder


def _write_page(path: Path, experiment: Experiment) -> int:
    from pregrasp_jax.sweep.paper_page import write_paper_page

    folder = SweepFolder.open(path)
    print(f"wrote {write_paper_page(folder, folder.spec(), experiment, folder.path / f'{experiment.name}.html')}")
    return 0
