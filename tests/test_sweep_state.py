"""What is to be done next, what is given up, who is compared with whom: by hand."""

from typing import Any

from test_sweep_spec import FULL, changed

from pregrasp_jax.sweep import state, table
from pregrasp_jax.sweep.spec import Spec, spec_from
from pregrasp_jax.sweep.state import TRIES, TrialState, next_jobs, read_states
from pregrasp_jax.sweep.trials import make_trial, setting_trials
from pregrasp_jax.sweep.worker import measured


def halving(scores: dict[float, list[float | None]], reached: int) -> tuple[Spec, list[TrialState]]:
    """Return trials of settings (by radius) with scores at the first rungs, one a seed; None has failed for good."""
    spec = spec_from(changed(stop={"method": "halving", "rungs": [2000, 4000], "keep": 0.5}))
    states = []
    for radius, of_seeds in scores.items():
        for trial, score in zip(setting_trials(spec, {"task.r_out": radius}), of_seeds, strict=True):
            known = TrialState(trial, outcome="rung", begun=True)
            if score is None:
                known.outcome, known.failures = "failed", TRIES
            else:
                known.scores = {rung: score for rung in (2000, 4000)[:reached]}
            states.append(known)
    return spec, states


def radii(jobs: Any) -> list[tuple[float, int, int | None]]:
    return [(job.trial.settings["task.r_out"], job.trial.seed, job.rung) for job in jobs]


def test_all_come_to_a_rung_before_any_goes_on():
    spec, states = halving({0.1: [0.5, 0.5], 0.12: [0.6, 0.2]}, reached=1)
    states[2].scores = {}
    assert radii(next_jobs(spec, states)) == [(0.12, 0, 2000)]


def test_the_better_half_by_the_mean_over_seeds_goes_on_and_a_failed_one_is_none():
    spec, states = halving({0.1: [0.5, 0.5], 0.12: [0.9, 0.2], 0.14: [0.4, 0.5], 0.16: [None, 0.99]}, reached=1)
    assert radii(next_jobs(spec, states)) == [(r, seed, 4000) for r in (0.1, 0.12) for seed in (0, 1)]
    assert {s.trial.settings["task.r_out"] for s in states if s.trial.id in state.dropped(spec, states)} == {0.14, 0.16}


def test_the_share_that_is_kept_is_of_the_number_of_settings():
    assert 0.28 * 25 > 7, "in binary fractions"
    spec = spec_from(changed(stop={"method": "halving", "rungs": [2000], "keep": 0.28}, seeds=[0]))
    trials = [setting_trials(spec, {"task.r_out": 0.1 + i / 1000})[0] for i in range(25)]
    states = [TrialState(trial, scores={2000: i / 25}) for i, trial in enumerate(trials)]
    assert len(state.survivors(spec, states, 2000)) == 7


def test_a_policy_that_is_not_trained_takes_no_setting_its_place():
    spec, states = halving({0.1: [0.5, 0.5], 0.12: [0.9, 0.2]}, reached=1)
    (script,) = setting_trials(spec, {}, name="clear", policy="clear")
    states.append(TrialState(script, outcome="done", begun=True))
    assert radii(next_jobs(spec, states)) == [(0.12, seed, 4000) for seed in (0, 1)]
    assert state.dropped(spec, states) == {s.trial.id for s in states[:2]}


def test_who_passed_the_last_rung_goes_to_the_end_and_is_ranked_before_who_did_not():
    spec, states = halving({0.1: [0.5, 0.5], 0.12: [0.6, 0.6], 0.14: [0.1, 0.1], 0.16: [0.2, 0.2]}, reached=2)
    for s in states[4:]:
        del s.scores[4000]
    assert radii(next_jobs(spec, states)) == [(0.12, 0, None), (0.12, 1, None)]
    for s in states:
        s.score, s.env_steps = max(s.scores.values()), 4000 if 4000 in s.scores else 2000
    states[4].score = 0.99  # measured early, never at the end
    for s in states[2:4]:
        s.outcome, s.env_steps = "done", 8000
    assert next_jobs(spec, states) == []
    order = [members[0].trial.settings["task.r_out"] for members in state.ranking(spec, states)]
    assert order == [0.12, 0.1, 0.14, 0.16]
    assert [trial.settings["task.r_out"] for trial in state.winners(spec, states)] == [0.12]


def test_states_are_read_from_events_planned_twice_or_not():
    spec = spec_from(FULL)
    trial = make_trial(spec, {"task.r_out": 0.15}, 0)
    planned = {"event": "planned", "trial": trial.to_dict()}
    ended = {"event": "ended", "id": trial.id, "rung": None, "outcome": "failed", "seconds": 2.0, "message": "boom"}
    (known,) = read_states([{"event": "sweep"}, planned, planned, {"event": "started", "id": trial.id}, ended, ended])
    assert known.failures == 2 and known.seconds == 4.0 and not known.over and known.message == "boom"
    (known,) = read_states([planned, *([ended] * TRIES)])
    assert known.over and known.failed and next_jobs(spec_from(changed(stop=None)), [known]) == []
    stopped = {**ended, "outcome": "stopped"}
    (known,) = read_states([planned, ended, ended, stopped, ended])
    assert known.failures == 1, "one that got on has three tries again"


def test_a_score_is_the_best_up_to_the_rung():
    rows = [
        {"env_steps": 100, "eval/success_rate": 0.5, "eval/mean_motions": 2.0},
        {"env_steps": 150, "train/loss": 1.0},
        {"env_steps": 208, "eval/success_rate": 0.4, "eval/mean_motions": 3.0},
        {"env_steps": 300, "eval/success_rate": 0.9, "eval/mean_motions": None},
    ]
    metric = "eval/success_rate"
    assert measured(rows, metric, 200) == {"score": 0.5, "motions": 2.0, "env_steps": 300}
    assert measured(rows, metric, 400)["score"] is None
    assert measured(rows, metric, None) == {"score": 0.9, "motions": None, "env_steps": 300}
    lost = {"env_steps": 400, metric: float("nan"), "eval/mean_motions": 1.0}
    assert measured([*rows, lost], metric, None) == {"score": 0.9, "motions": None, "env_steps": 400}
    assert measured([lost, {**lost, metric: float("inf")}], metric, None)["score"] is None
    no_motions = {"env_steps": 9, metric: 0.1, "eval/mean_motions": float("nan")}
    assert measured([no_motions], metric, None) == {"score": 0.1, "motions": None, "env_steps": 9}
    assert measured([], metric, None) == {"score": None, "motions": None, "env_steps": 0}


def test_settings_that_met_other_scenes_or_another_place_are_not_compared():
    def row(label: str, **changes: Any) -> table.Row:
        rows = [{"scene": i, "target": "mug", "success": bool(i % 2)} for i in range(10)]
        document = {"scene_bank_hash": "s", "hull_bank_hash": "h", "object_set": "seen", "mean_motions": 2.0}
        tests = {"test": table.tested([{**document, "rows": rows, **changes}])}
        about: dict[str, Any] = dict.fromkeys(("interval", "motions"))
        return table.Row(rank=1, label=label, varied={}, members=(), words=(), scores=(), tests=tests, **about)

    changed = {"scene_bank_hash": "z"}, {"object_set": "unseen"}, {"workspace": "shelf"}, {"hull_bank_hash": "z"}
    others = [row(f"other {i}", **change) for i, change in enumerate(changed)]
    found = table._differences(row("best"), [row("alike"), *others])
    assert list(found["test"]) == ["alike"]
