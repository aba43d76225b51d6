"""SLURM: what is submitted, and a sweep on a fake of it whose tasks run out of time and are put back into the queue."""

import re
import sys
from collections import Counter
from pathlib import Path
from typing import Any

import pytest
from test_sweep import make_spec, sessions

from pregrasp_jax.cli.sweep import drive, worker
from pregrasp_jax.sweep import driver, slurm
from pregrasp_jax.sweep.folder import SweepFolder
from pregrasp_jax.sweep.spec import Spec
from pregrasp_jax.sweep.trials import evaluation_files
from pregrasp_jax.sweep.worker import BUSY, UNWRITTEN, Worker

FAKE = Path(__file__).parent / "fake_sbatch.py"


def begin(path: Path, **keys: Any) -> tuple[SweepFolder, Spec]:
    spec = make_spec(**keys)
    folder = SweepFolder.create(path / "sweep", spec)
    driver.plan(folder, spec)
    return folder, spec


def test_the_script_says_what_a_task_needs_and_is_replaced_by_the_worker(tmp_path):
    keys = {"resources": {"cores": 4, "memory_gb": 8, "gpu": 1.0}, "slurm": {"partition": "gpu", "time": "4:00:00"}}
    folder, spec = begin(tmp_path, **keys)
    lines = slurm.sbatch_text(folder, spec, "rung-100", 12, ["--rung", "100"], parallel=3).splitlines()
    options = {line for line in lines if line.startswith("#SBATCH")}
    wanted = ["array=0-11%3", "cpus-per-task=4", "mem=8000M", "gres=gpu:1", "signal=B:TERM@180", "open-mode=append"]
    last = r'exec \S+ -m pregrasp_jax sweep worker \S+ --requeue True --rung 100 --task "\$SLURM_ARRAY_TASK_ID"'
    assert {f"#SBATCH --{option}" for option in [*wanted, "partition=gpu", "time=4:00:00"]} < options
    assert lines[0] == "#!/bin/bash" and "#SBATCH --requeue" in options
    assert re.fullmatch(last, lines[-1])


@pytest.mark.parametrize(
    ("code", "failures", "again"),
    [(0, 0, False), (143, 0, True), (BUSY, 0, True), (UNWRITTEN, 0, True), (1, 2, True), (1, 3, False), (2, 0, False)],
)
def test_a_task_goes_back_into_the_queue_unless_there_is_nothing_left_to_do(
    code, failures, again, tmp_path, monkeypatch
):
    spec = make_spec()
    folder = SweepFolder.create(tmp_path / "sweep", spec)
    driver.plan(folder, spec)
    trial = folder.states()[0].trial
    ended = {"event": "ended", "id": trial.id, "rung": None, "outcome": "failed", "exit_code": 1, "seconds": 1.0}
    for _ in range(failures):
        folder.append(ended)
    calls = []
    monkeypatch.setattr(slurm.subprocess, "run", lambda command, **_: calls.append(command))
    monkeypatch.setenv("SLURM_ARRAY_JOB_ID", "7")
    monkeypatch.setenv("SLURM_ARRAY_TASK_ID", "3")
    slurm.requeue(folder, trial, code)
    assert calls == ([["scontrol", "requeue", "7_3"]] if again else [])
    folder.ask_to_stop(True)
    slurm.requeue(folder, trial, code)
    assert len(calls) == again, "not while the sweep is asked to stop"


def test_only_a_task_of_slurm_is_put_back(tmp_path, monkeypatch):
    """A local sweep in somebody's own job must not end that."""
    folder, _ = begin(tmp_path)
    calls = []
    monkeypatch.setattr(Worker, "run", lambda self: 143)
    monkeypatch.setattr(slurm, "requeue", lambda *about: calls.append(about[2]))
    assert worker(folder.path, task=0) == 143 and calls == []
    assert worker(folder.path, task=0, requeue=True) == 143 and calls == [143]


def test_a_trial_that_is_done_may_still_lack_a_test(tmp_path):
    folder, spec = begin(tmp_path, stop={"method": "halving", "rungs": [100], "keep": 0.5})
    first, second = (known.trial for known in folder.states())
    for trial, outcome, score in ((first, "done", 0.1), (second, "rung", 0.9)):
        folder.append({
            "event": "ended", "id": trial.id, "rung": 100, "outcome": outcome, "exit_code": 0, "seconds": 1.0,
            "scores": {"100": score},
        })  # fmt: skip
    found = [slurm.trial_of(folder, spec, task, rung=None, final=False) for task in (0, 1)]
    assert [trial and trial.id for trial in found] == [first.id, second.id]


def test_what_slurm_cannot_do_is_refused(tmp_path, monkeypatch):
    monkeypatch.setenv("PATH", str(tmp_path))
    folder, spec = begin(tmp_path)
    with pytest.raises(ValueError, match="needs sbatch, which is not here"):
        slurm.check(spec)
    shared = make_spec(resources={"gpu": 0.5})
    with pytest.raises(ValueError, match=r"resources.gpu = 0.5: SLURM shares no GPU between tasks"):
        slurm.check(shared)
    learning = make_spec(search={"method": "tpe", "trials": 3})
    with pytest.raises(ValueError, match="needs a driver that lives as long as the sweep"):
        slurm.check(learning)
    with pytest.raises(ValueError, match="there is no trial 9; allowed is 0 to 1"):
        slurm.trial_of(folder, spec, 9, rung=None, final=False)


def test_an_array_for_every_rung_with_requeue_and_the_winner_again(tmp_path, monkeypatch, capsys):
    binaries, state = tmp_path / "bin", tmp_path / "slurm"
    binaries.mkdir()
    state.mkdir()
    for name in ("sbatch", "scontrol"):
        program = binaries / name
        program.write_text(f'#!/bin/sh\nexec {sys.executable} {FAKE} {name} "$@"\n')
        program.chmod(0o755)
    monkeypatch.setenv("PATH", f"{binaries}:/usr/bin:/bin")
    monkeypatch.setenv("FAKE_SLURM", str(state))
    monkeypatch.setenv("FAKE_LIMIT", "0.1")
    spec = make_spec(
        set={"train.env_steps": 1200, "train.minutes": 0, "train.evaluate_every": 100},
        stop={"method": "halving", "rungs": [100], "keep": 0.5},
        final={"seeds": [10], "episodes": 20},
    )
    folder = SweepFolder.create(tmp_path / "sweep", spec)
    assert drive(folder, spec, launcher="slurm", parallel=2) == 0
    said = capsys.readouterr().out
    assert re.findall(r"submitted (\S+) as job (\d+): (\d) tasks", said) == [
        ("rung-100.sbatch", "100", "2"), ("end.sbatch", "101", "2"), ("final.sbatch", "102", "1")
    ]  # fmt: skip
    assert [(state / f"job-{job}").read_text() for job in (100, 101, 102)] == [
        "--parsable", "--parsable --dependency=afterany:100", "--parsable --dependency=afterany:101"
    ]  # fmt: skip
    states = folder.states()
    words = driver.status(spec, states)
    assert Counter(words.values()) == {"done": 2, "dropped": 1}
    done = [known for known in states if words[known.trial.id] == "done"]
    assert [known.trial.final for known in done] == [False, True]
    assert evaluation_files(spec, done[1].trial, folder.run(done[1].trial))["test"].exists()
    for known in done:
        assert known.env_steps == 1200 and not (folder.run(known.trial) / "TWICE").exists()
    requeued = list(state.glob("requeued-*"))
    assert requeued, "some task has run out of time"
    assert max(len(sessions(folder, known)) for known in done) >= 2
