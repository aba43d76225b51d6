"""A search that learns: it asks for what looks good, and forgets nothing."""

import pytest
from test_sweep import Here, assert_whole, drive, keep_signals, make_spec  # noqa: F401  (a fixture of all tests here)

from pregrasp_jax.sweep import driver
from pregrasp_jax.sweep.folder import SweepFolder
from pregrasp_jax.sweep.state import Job


def test_tpe_asks_for_what_looks_good_and_forgets_nothing_when_it_goes_on(tmp_path):
    pytest.importorskip("optuna")
    search = {"method": "tpe", "trials": 7}
    parameters = {"learner.learning_rate": {"log": [1e-4, 1e-2]}, "task.max_pushes": {"int": [3, 9]}}
    small = {"train.env_steps": 100, "train.minutes": 0, "train.evaluate_every": 100}
    spec = make_spec(search=search, parameters=parameters, set=small)
    folder = SweepFolder.create(tmp_path / "sweep", spec)

    class Killed(Exception):
        pass

    def dies(job: Job) -> int | None:
        if job.trial.number == 4:
            raise Killed
        return None

    with pytest.raises(Killed):
        drive(folder, spec, Here(folder, spec, code=dies))
    assert drive(folder, spec, Here(folder, spec)) == 0
    states = assert_whole(folder, length=100)
    assert len(states) == len({known.trial.group for known in states}) == 7
    import optuna

    study = driver.Study(folder.path, spec)._study
    told = {t.number: t.value for t in study.get_trials(states=(optuna.trial.TrialState.COMPLETE,))}
    assert {known.trial.proposal: known.score for known in states}.items() >= told.items() and len(told) >= 6
    assert not [known for known in states if not 3 <= known.trial.settings["task.max_pushes"] <= 9]


def test_tpe_ends_when_it_has_proposed_every_setting_there_is(tmp_path):
    pytest.importorskip("optuna")
    search, small = {"method": "tpe", "trials": 7}, {"train.env_steps": 100, "train.minutes": 0}
    spec = make_spec(search=search, parameters={"task.max_pushes": {"int": [3, 4]}}, set=small)
    folder = SweepFolder.create(tmp_path / "sweep", spec)
    assert drive(folder, spec, Here(folder, spec)) == 0
    assert len(folder.states()) == 2
    study = driver.Study(folder.path, spec)
    assert study.propose(folder.states()) == (None, -1)
    asked = len(study._study.trials)
    assert study.propose(folder.states()) == (None, -1) and len(study._study.trials) == asked, "it is not asked again"
