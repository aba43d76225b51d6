"""`pregrasp-jax sweep`: start, follow, stop and go on with many trainings; docs/sweeps.md explains them."""

import subprocess
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Literal

from pregrasp_jax import io
from pregrasp_jax.cli.command_line import deferred
from pregrasp_jax.sweep import checks, driver, slurm, table
from pregrasp_jax.sweep.driver import Driver
from pregrasp_jax.sweep.estimate import describe, memory_of
from pregrasp_jax.sweep.folder import SPEC, SweepFolder
from pregrasp_jax.sweep.launchers import Launcher, LocalLauncher
from pregrasp_jax.sweep.ray_launcher import RayLauncher, require_ray
from pregrasp_jax.sweep.spec import PROGRAM, Spec, read_spec
from pregrasp_jax.sweep.study import require_optuna
from pregrasp_jax.sweep.table_files import format_table, to_dict, write_table
from pregrasp_jax.sweep.worker import Worker

LauncherName = Literal["local", "ray", "slurm"]


def commands(arguments: Sequence[str]) -> dict[str, Callable[..., Callable[[], int | None]]]:
    """Return the commands by name."""
    del arguments
    functions = (start, status, show_table, stop, resume, report, worker)
    return {function.__name__.removeprefix("show_"): deferred(function) for function in functions}


def start(
    spec: Path,
    /,
    *,
    dir: Path,
    launcher: LauncherName = "local",
    parallel: int | None = None,
    dry_run: bool = False,
) -> int:
    """Start a sweep and drive it to its end; Ctrl-C is safe, and `resume` goes on.

    Args:
        spec: YAML of the sweep (docs/sweeps.md).
        dir: new or empty folder of the sweep.
        launcher: `local` shares out the cores and GPUs of this machine; `ray` those of a cluster (extra `ray`); `slurm`
            hands everything to sbatch and returns.
        parallel: trials at a time; as many as fit if left out.
        dry_run: check everything, say what would be done, and do nothing.
    """
    read = read_spec(spec)
    check(read, launcher=launcher, parallel=parallel, names=dry_run, file=spec)
    SweepFolder.refuse_used(dir)
    for line in describe(read, launcher=launcher, parallel=parallel):
        print(line, flush=True)
    if dry_run:
        return 0
    return drive(SweepFolder.create(dir, read), read, launcher=launcher, parallel=parallel)


def resume(
    folder: Path, /, *, launcher: LauncherName = "local", parallel: int | None = None, retry: bool = False
) -> int:
    """Go on with a sweep where it stopped, whatever stopped it.

    Args:
        folder: of the sweep.
        launcher: as in `start`; it may be another one.
        parallel: as in `start`.
        retry: whether trials that were refused, or failed three times, are tried again.
    """
    opened = SweepFolder.open(folder)
    spec = opened.spec()
    check(spec, launcher=launcher, parallel=parallel, file=opened.path / SPEC, here=opened.cwd)
    with opened.drive():  # what another driver was asked to do is not taken back
        opened.ask_to_stop(False)
        for failed in [s for s in opened.states() if retry and s.failed]:
            opened.append({"event": "retry", "id": failed.trial.id})
    return drive(opened, spec, launcher=launcher, parallel=parallel)


def status(folder: Path, /, *, json: Path | None = None) -> None:
    """Say how far a sweep is.

    Args:
        folder: of the sweep.
        json: write the state of every trial here.
    """
    _refuse_json(json)
    opened = SweepFolder.open(folder)
    spec, states = opened.spec(), opened.states()
    running = [s.trial.id for s in states if not s.over and opened.is_running(s.trial)]
    words = driver.status(spec, states, running)
    print(driver.progress_line(spec, states, running=len(running), slots=len(running)))
    for s in states:
        score = "" if s.score is None else f"{spec.stop.metric} {s.score:.3g}"
        said = f"({s.message})" if s.message and words[s.trial.id] in ("failed", "refused", "paused") else ""
        parts = [f"{s.trial.number:4d}  {s.trial.id}  {words[s.trial.id]:<12}step {s.env_steps:<8}", score]
        print("  ".join([*parts, f"{s.trial.label}, seed {s.trial.seed}", said]).rstrip())
    if json:
        io.write_json(json, [{"id": s.trial.id, "state": words[s.trial.id], "env_steps": s.env_steps} for s in states])


def show_table(folder: Path, /, *, json: Path | None = None, reference: str | None = None) -> None:
    """Rank the settings of a sweep, also while it runs; writes table.json and table.csv.

    Args:
        folder: of the sweep.
        json: write the table here, too.
        reference: setting that others are compared with on test scenes, by the name in the table; the best if left out.
    """
    _refuse_json(json)
    opened = SweepFolder.open(folder)
    made = table.make_table(opened, opened.spec(), reference=reference)
    print(format_table(made))
    write_table(opened, made)
    if json:
        io.write_json(json, to_dict(made))


def stop(folder: Path, /) -> None:
    """Ask a sweep to stop: trainings finish their step, write a checkpoint and end. `resume` goes on.

    Args:
        folder: of the sweep.
    """
    opened = SweepFolder.open(folder)
    opened.ask_to_stop(True)
    running = sum(opened.is_running(s.trial) for s in opened.states() if not s.over)
    print(f"asked to stop; {running} trials are running now")


def report(folder: Path, /, *, html: Path | None = None) -> None:
    """Write the page of a sweep: table, settings against success, curves of all trials, the best settings.

    Args:
        folder: of the sweep.
        html: where the page goes; report.html in the folder if left out.
    """
    from pregrasp_jax.sweep.page import write_page

    opened = SweepFolder.open(folder)
    path = html or opened.path / "report.html"
    io.refuse_ending(path, (".html", ".htm"))
    io.refuse_unwritable(path)
    print(f"wrote {write_page(opened, opened.spec(), path)}")


def worker(
    folder: Path,
    /,
    *,
    task: int,
    rung: int | None = None,
    final: bool = False,
    cores: tuple[int, ...] = (),
    requeue: bool = False,
) -> int:
    """Bring one trial to a rung or to its end; this is what launchers call.

    Args:
        folder: of the sweep.
        task: number of the trial; of the fresh seeds of the winners if `final`.
        rung: env steps at which to stop; the end if left out.
        final: plan the fresh seeds of the winners if that was not done.
        cores: those that the trial may use; all if left out.
        requeue: put the SLURM task that this is back into the queue if its trial is to go on.
    """
    opened = SweepFolder.open(folder)
    spec = opened.spec()
    trial = slurm.trial_of(opened, spec, task, rung=rung, final=final)
    if trial is None:
        return 0
    code = Worker(opened, spec, trial, rung=rung, cores=cores).run()
    if requeue:
        slurm.requeue(opened, trial, code)
    return code


def check(
    spec: Spec,
    *,
    launcher: LauncherName,
    parallel: int | None,
    names: bool = False,
    file: Path | None = None,
    here: Path = Path(),
) -> None:
    """Refuse what cannot work, before anything is written.

    Args:
        spec: of the sweep.
        launcher: its own needs are looked at, too.
        parallel: trials at a time, None for as many as fit.
        names: whether to check those that only the registries know, which takes JAX.
        file: that the sweep was read from, which errors name.
        here: folder that relative paths refer to.

    Raises:
        ValueError: one line says what, where, and what is allowed.
    """
    if parallel is not None and parallel < 1:
        raise ValueError(f"parallel = {parallel} is out of range; allowed is 1 and more")
    if spec.search.method == "tpe":
        require_optuna()
    if launcher == "ray":
        require_ray()
    try:
        checks.check(spec, here=here)
        if launcher == "slurm":
            slurm.check(spec)
        if names and spec.program == PROGRAM:
            from pregrasp_jax.sweep.names import check_names

            check_names(spec, here=here)
    except ValueError as error:
        raise ValueError(f"{file}: {error}" if file else str(error)) from None


def drive(folder: SweepFolder, spec: Spec, *, launcher: LauncherName, parallel: int | None) -> int:
    """Drive a sweep to its end and write its table and page; a sweep of SLURM is only handed over.

    Returns:
        The exit code, see `Driver.run`.
    """
    if launcher == "slurm":
        driver.plan(folder, spec)
        for line in slurm.submit(folder, spec, parallel=parallel):
            print(line)
        return 0
    code = Driver(folder, spec, _launcher(folder, spec, launcher, parallel), say=_say).run()
    made = table.make_table(folder, spec)
    write_table(folder, made)
    print(format_table(made), flush=True)
    if code in (0, 1):
        # In a process of its own: a page takes JAX, which this one does without.
        subprocess.run([sys.executable, "-m", "pregrasp_jax", "sweep", "report", str(folder.path)], check=False)
    return code


def _launcher(folder: SweepFolder, spec: Spec, name: LauncherName, parallel: int | None) -> Launcher:
    if name == "ray":
        return RayLauncher(folder, spec, parallel=parallel)
    return LocalLauncher(folder, spec, parallel=parallel, memory=memory_of(spec))


def _say(line: str) -> None:
    print(line, file=sys.stderr, flush=True)


def _refuse_json(path: Path | None) -> None:
    if path is not None:
        io.refuse_ending(path, (".json",))
        io.refuse_unwritable(path)
