"""What became of the trials, read from the events, and what is to be done next: functions without a clock or a disk."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

from pregrasp_jax.messages import one_line
from pregrasp_jax.sweep.spec import Spec
from pregrasp_jax.sweep.trials import Trial

Record = dict[str, Any]

TRIES = 3
"""Failures after which a trial is given up; the sweep goes on."""

DONE, FAILED, REFUSED, STOPPED, RUNG = "done", "failed", "refused", "stopped", "rung"
"""How a session of a trial may end."""


@dataclass
class TrialState:
    """A trial and what is known of it.

    Attributes:
        trial: what it is.
        outcome: of its last session, empty before the first has ended.
        failures: sessions that failed, since the last that did not.
        scores: rung (env steps) -> what was measured there.
        score: the best measured so far, None before the first.
        motions: mean pushes of the policy with that score.
        env_steps: pushes so far.
        seconds: wall-clock time of all sessions.
        message: what the last failure said.
        begun: whether a session has ever started.
        endings: sessions whose end is known.
    """

    trial: Trial
    outcome: str = ""
    failures: int = 0
    scores: dict[int, float] = field(default_factory=dict)
    score: float | None = None
    motions: float | None = None
    env_steps: int = 0
    seconds: float = 0.0
    message: str = ""
    begun: bool = False
    endings: int = 0

    @property
    def over(self) -> bool:
        """Whether there is nothing left to do for it, halving aside."""
        return self.outcome in (DONE, REFUSED) or self.failures >= TRIES

    @property
    def failed(self) -> bool:
        """Whether it has ended without a result."""
        return self.over and self.outcome != DONE

    def settled(self, rung: int | None) -> bool:
        """Return whether it has come as far as a rung; None is the end."""
        return self.over or (rung is not None and rung in self.scores)


class Job(NamedTuple):
    """What a worker is asked for: bring a trial to a rung, or to its end."""

    trial: Trial
    rung: int | None


def read_states(events: Sequence[Record]) -> list[TrialState]:
    """Return the trials in the order of their numbers; what was planned twice is one trial.

    Raises:
        ValueError: an event does not have what belongs to it; one line names it.
    """
    states: dict[str, TrialState] = {}
    for number, event in enumerate(events, start=1):
        try:
            _take(states, event)
        except (KeyError, TypeError, ValueError, AttributeError):
            raise ValueError(f"event {number} is damaged: {one_line(event)[:80]}") from None
    return sorted(states.values(), key=lambda state: state.trial.number)


def _take(states: dict[str, TrialState], event: Record) -> None:
    """Change the states of trials, by id, as an event says."""
    if event["event"] == "planned":
        trial = Trial(**event["trial"])
        states.setdefault(trial.id, TrialState(trial))
    elif event["event"] == "started":
        states[event["id"]].begun = True
    elif event["event"] == "retry":
        states[event["id"]].outcome, states[event["id"]].failures = "", 0
    elif event["event"] == "ended":
        _end(states[event["id"]], event)


def _end(state: TrialState, event: Record) -> None:
    state.outcome = event["outcome"]
    state.endings += 1
    state.failures = state.failures + 1 if state.outcome == FAILED else 0
    state.seconds += event["seconds"]
    state.message = event.get("message", "")
    state.env_steps = max(state.env_steps, event.get("env_steps") or 0)
    if event.get("score") is not None:
        state.score, state.motions = event["score"], event.get("motions")
    state.scores |= {int(rung): score for rung, score in event.get("scores", {}).items()}


def next_jobs(spec: Spec, states: Sequence[TrialState]) -> list[Job]:
    """Return what can be done now, in order. Nothing is left to do if this is empty and nothing runs.

    With halving, all trials of the settings that are left come to a rung before any goes beyond it.
    """
    main = [state for state in states if not state.trial.final]
    alive = main
    for rung in rungs(spec):
        if unsettled := [state for state in alive if not state.settled(rung)]:
            return [Job(state.trial, rung) for state in unsettled]
        alive = survivors(spec, alive, rung)
    jobs = [Job(state.trial, None) for state in alive if not state.over]
    return jobs + [Job(state.trial, None) for state in states if state.trial.final and not state.over]


def rungs(spec: Spec) -> tuple[int, ...]:
    """Return the env steps at which settings are given up."""
    return spec.stop.rungs if spec.stop.method == "halving" else ()


def survivors(spec: Spec, states: Sequence[TrialState], rung: int) -> list[TrialState]:
    """Return the trials of the best settings at a rung, by the mean over their seeds; one with a failure is none.

    A policy that is not trained comes to no rung, and takes no other's place.
    """
    scores = {
        group: mean([state.scores.get(rung, -math.inf) for state in members])
        for group, members in by_setting([state for state in states if state.trial.policy is None]).items()
    }
    whole = sorted((group for group in scores if scores[group] > -math.inf), key=lambda group: -scores[group])
    kept = set(whole[: math.ceil(spec.stop.keep * len(scores) - 1e-9)])
    return [state for state in states if state.trial.group in kept]


def dropped(spec: Spec, states: Sequence[TrialState]) -> set[str]:
    """Return the ids of the trials that halving has given up."""
    alive = [state for state in states if not state.trial.final]
    gone: set[str] = set()
    for rung in rungs(spec):
        if any(not state.settled(rung) for state in alive):
            break
        kept = survivors(spec, alive, rung)
        kept_ids = {state.trial.id for state in kept}
        gone |= {state.trial.id for state in alive if state.trial.id not in kept_ids and not state.over}
        alive = kept
    return gone


def ranking(spec: Spec, states: Sequence[TrialState]) -> list[list[TrialState]]:
    """Return the trials by setting, best first: those that went furthest, and of these by the mean of their scores."""
    main = [state for state in states if not state.trial.final]
    gone = dropped(spec, states)

    def merit(members: list[TrialState]) -> tuple[float, float, float]:
        ended = all(state.outcome == DONE for state in members)
        steps = 0.0 if not gone else -mean([float(state.env_steps) for state in members])
        scores = [state.score for state in members if state.score is not None]
        return (0.0 if ended else 1.0, steps if not ended else 0.0, -mean(scores) if scores else math.inf)

    return sorted(by_setting(main).values(), key=merit)


def winners(spec: Spec, states: Sequence[TrialState]) -> list[Trial]:
    """Return one trial of each of the best settings that were trained to their end with all seeds."""
    whole = [
        members
        for members in ranking(spec, states)
        if all(state.outcome == DONE and state.score is not None for state in members)
    ]
    return [members[0].trial for members in whole[: spec.final.top]]


def by_setting(states: Sequence[TrialState]) -> dict[str, list[TrialState]]:
    """Return trials by their setting, in order."""
    groups: dict[str, list[TrialState]] = {}
    for state in states:
        groups.setdefault(state.trial.group, []).append(state)
    return groups


def mean(values: Sequence[float]) -> float:
    """Return the mean."""
    return sum(values) / len(values)
