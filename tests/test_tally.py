"""Counts of a training, by hand."""

from types import SimpleNamespace
from typing import Any

import jax.numpy as jnp
import pytest

from pregrasp_jax.training.tally import new_tally
from pregrasp_jax.types import OBSTRUCTIONS, PUSH_REASONS


def test_tally_keeps_the_reasons_of_the_last_episodes():
    tally = new_tally(3, recent=4)
    success, truncated = PUSH_REASONS.index("target_in_region"), PUSH_REASONS.index("truncated")
    stopped, wall, error = (
        PUSH_REASONS.index("unreachable"),
        OBSTRUCTIONS.index("wall"),
        OBSTRUCTIONS.index("end_error"),
    )
    pushes = [([success, 0, truncated], [1, 0, 1]), ([0, success, success], [0, 1, 1]), ([stopped, 0, 0], [1, 0, 0])]
    for reason, ended in pushes:
        # A physics failure goes before what stopped the hand: only the reason tells.
        outcome = SimpleNamespace(obstruction=jnp.array([wall if reason[0] == stopped else 0, 0, error]))
        results: Any = SimpleNamespace(reason=jnp.array(reason), reward=jnp.ones(3), outcome=outcome)
        random, overflowed = jnp.array([True, False, False]), jnp.array([reason[0] == success, False, True])
        diverged = jnp.array([False, False, False, reason[1] == success, True])  # with a branch of two scenes
        tally = tally.count(results, jnp.array(ended, bool), random, overflowed, diverged)
    report = tally.metrics((success,))
    assert report["train/success_rate"] == 0.5, "the first success has left the window of four"
    assert (report["episodes"], report["env_steps"]) == (5, 9)
    assert (report["reasons/target_in_region"], report["reasons/truncated"]) == (3, 1)
    assert {name: report[f"unreachable/{name}"] for name in OBSTRUCTIONS[1:] if report[f"unreachable/{name}"]} == {
        "wall": 1
    }
    assert report["train/explored"] == pytest.approx(1 / 3) and report["train/episode_length"] == pytest.approx(9 / 5)
    assert report["physics/overflows"] == 4, "one in the first scene, three in the last"
    assert report["physics/diverged"] == 4, "one in one branch, three in the last"
    fresh = tally.begin_report().metrics((success,))
    assert fresh["physics/overflows"] == 0 and fresh["physics/diverged"] == 0
    assert fresh["train/success_rate"] == 0.5 and fresh["train/reward"] is None and fresh["episodes"] == 5
