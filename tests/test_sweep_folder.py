"""The folder of a sweep: what is written to it, by whom, and what of it may be edited."""

import json
import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest

from pregrasp_jax import io
from pregrasp_jax.sweep import driver
from pregrasp_jax.sweep.folder import SweepFolder
from pregrasp_jax.sweep.spec import Spec, spec_from
from pregrasp_jax.sweep.state import Job, TrialState
from pregrasp_jax.sweep.trials import Trial, final_trials
from pregrasp_jax.sweep.worker import BUSY, UNWRITTEN, Worker


def make_spec(**keys: Any) -> Spec:
    return spec_from({"preset": "ci", "set": {"train.env_steps": 400, "train.minutes": 0}, **keys})


class Nowhere:
    """A launcher that starts nothing."""

    slots = 1

    def submit(self, job: Job) -> None: ...

    def ended(self) -> list[tuple[str, int]]:
        return []

    def stop(self) -> None: ...

    def close(self) -> None: ...


def test_a_line_that_a_crash_has_cut_is_not_read_and_not_built_upon(tmp_path):
    spec = make_spec()
    folder = SweepFolder.create(tmp_path / "sweep", spec)
    driver.plan(folder, spec)
    with (folder.path / "trials.jsonl").open("a") as file:
        file.write('{"event": "ended", "id": "')
    assert len(folder.states()) == 1
    folder.append({"event": "started", "id": folder.states()[0].trial.id})
    assert [event["event"] for event in folder.events()] == ["sweep", "planned", "started"]


def test_who_works_on_a_trial_holds_it(tmp_path, monkeypatch):
    monkeypatch.setattr("pregrasp_jax.sweep.worker.PATIENCE", 0.0)
    spec = make_spec()
    folder = SweepFolder.create(tmp_path / "sweep", spec)
    driver.plan(folder, spec)
    trial = folder.states()[0].trial
    with folder.hold(trial):
        assert folder.is_running(trial) and Worker(folder, spec, trial, rung=None).run() == BUSY
    assert not folder.is_running(trial)
    assert UNWRITTEN not in (0, BUSY)


def test_a_spec_may_be_edited_where_it_changes_no_trial(tmp_path):
    spec = make_spec()
    folder = SweepFolder.create(tmp_path / "sweep", spec)
    file = folder.path / "spec.yaml"
    file.write_text(file.read_text() + "final: {seeds: [5]}\n")
    assert folder.spec().final.seeds == (5,)
    file.write_text(file.read_text().replace("preset: ci", "preset: cpu"))
    with pytest.raises(ValueError, match=r"preset is not what the sweep began with; allowed to change: "):
        folder.spec()
    with pytest.raises(ValueError, match="already holds a sweep; go on with `pregrasp-jax sweep resume"):
        SweepFolder.create(tmp_path / "sweep", spec)
    with pytest.raises(ValueError, match="is not a sweep"):
        SweepFolder.open(tmp_path)
    with pytest.raises(ValueError, match="is not empty and holds no sweep"):
        SweepFolder.create(tmp_path, spec)


def test_two_that_plan_the_same_trials_at_once_plan_them_once_and_number_them_in_order(tmp_path):
    """As tasks of SLURM do with the fresh seeds of the winners."""
    spec = make_spec(final={"seeds": [10, 11, 12]})
    folder = SweepFolder.create(tmp_path / "sweep", spec)
    driver.plan(folder, spec)

    def slowly(states: Sequence[TrialState]) -> list[Trial]:
        time.sleep(0.1)
        return final_trials(spec, [states[0].trial])

    with ThreadPoolExecutor(4) as pool:
        planned = list(pool.map(lambda _: SweepFolder.open(folder.path).plan(slowly), range(4)))
    assert sorted(planned) == [False, False, False, True]
    assert [(s.trial.number, s.trial.seed) for s in folder.states()] == [(0, 0), (1, 10), (2, 11), (3, 12)]


def test_all_seeds_of_a_proposal_are_written_at_once(tmp_path, monkeypatch):
    """A crash between two of them would leave a setting that is ranked by fewer seeds than the others."""
    search, parameters = {"method": "tpe", "trials": 2}, {"task.r_out": {"uniform": [0.15, 0.2]}}
    spec = make_spec(seeds=[0, 1], search=search, parameters=parameters)
    folder = SweepFolder.create(tmp_path / "sweep", spec)
    written: list[int] = []
    append = io.append_json_lines

    def count(path: Path, *values: Any) -> None:
        written.append(len(values))
        append(path, *values)

    monkeypatch.setattr(io, "append_json_lines", count)
    assert driver.Driver(folder, spec, Nowhere(), say=lambda line: None)._propose([])
    assert written == [2] and [(s.trial.number, s.trial.seed) for s in folder.states()] == [(0, 0), (1, 1)]


@pytest.mark.parametrize(
    ("first", "said"),
    [
        ([], "does not begin with the sweep's settings"),
        ({"event": "sweep"}, "does not begin with the sweep's settings"),
        ({"event": "sweep", "spec": {"preset": "ci"}, "cwd": 3}, "does not begin with the sweep's settings"),
        ({"event": "sweep", "spec": {"preset": 5}, "cwd": "."}, "preset = '5' does not exist"),
    ],
)
def test_a_sweep_that_does_not_say_what_it_is_is_damaged(first, said, tmp_path):
    folder = SweepFolder.create(tmp_path / "sweep", make_spec())
    (folder.path / "trials.jsonl").write_text(json.dumps(first) + "\n")
    with pytest.raises(ValueError, match=r"trials\.jsonl.*" + said):
        folder.spec()
