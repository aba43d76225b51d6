"""Which of several first pushes does best: rounds of simulations, in each of which fewer candidates stay."""

import time
from dataclasses import dataclass
from typing import NamedTuple

import jax
import numpy as np

from pregrasp_jax.evaluation_config import PlanningConfig
from pregrasp_jax.planning.rollout import Rollout
from pregrasp_jax.types import EnvState, HullBank

ROUNDS = (8, 4)
"""Candidates that stay for the second round and for the third."""

DISCOUNT = 0.93
"""What a success one push later is worth."""

SALVAGE = 0.6
"""Share of its worth that a line keeps whose continuation failed: another push can be chosen then."""

SLIPPED = 0.7
"""Share of its worth that an enclosed target keeps which the simulated grasp does not hold: in truth 97 of 100 enclosed
targets are held, and a rebuilt shape may slip where the object does not."""

_VALUES, _CHANCES = (0.4, 0.9, 1.2, 1.5, 2.0), (0.05, 0.25, 0.65, 0.8, 0.97)
"""How often episodes of `pretrained` ended well, by what it said of its best push: 200 episodes on validation scenes of
built-in objects and of distorted ones."""


class Choice(NamedTuple):
    """The result of a search.

    Attributes:
        action: flat index of Q.
        pushes: simulated, grasps not counted.
    """

    action: int
    pushes: int


@dataclass
class Line:
    """A candidate in one variant of the rebuilt scene, as far as it has been followed.

    Attributes:
        candidate: which.
        variant: which.
        action: what is pushed next.
        state: where it stands.
        depth: pushes so far.
        worth: how likely it ends in a success, discounted by the pushes that takes.
        safety: how likely nothing has left the workspace until now.
        ended: nothing follows.
    """

    candidate: int
    variant: int
    action: int
    state: EnvState
    depth: int = 0
    worth: float = 0.0
    safety: float = 1.0
    ended: bool = False


def chance(values: np.ndarray) -> np.ndarray:
    """Return how likely an episode ends well, [...], whose best push the network values at [...]."""
    return np.interp(values, _VALUES, _CHANCES)


def search(
    rollout: Rollout, bank: HullBank, roots: EnvState, candidates: list[int], config: PlanningConfig, deadline: float
) -> Choice:
    """Return the candidate that does best on average over variants.

    Args:
        rollout: simulates.
        bank: the objects of all variants.
        roots: [V] the rebuilt scene in all variants, as host arrays.
        candidates: flat indices of Q, at least one.
        config: how deep, in how many variants.
        deadline: by `time.perf_counter`; no round begins that would not end before it.
    """
    lines: list[Line] = []
    kept, last = len(candidates), 0.0
    for keep in (len(candidates), *ROUNDS):
        begin = time.perf_counter()
        if lines and begin + last > deadline:
            break
        kept = min(kept, keep)
        best = _ranked(lines, len(candidates))[:kept]
        further = [line for line in lines if line.candidate in best and not line.ended and line.depth <= config.depth]
        fresh = _in_another_variant(lines, best, candidates, roots, config.variants)
        _follow(rollout, bank, further + fresh)
        lines += fresh
        last = time.perf_counter() - begin
    return Choice(candidates[_ranked(lines, len(candidates))[0]], sum(line.depth for line in lines))


def _ranked(lines: list[Line], count: int) -> list[int]:
    """Return `count` candidates, best first: those tried in more variants before the others."""
    worth = [[line.worth for line in lines if line.candidate == candidate] for candidate in range(count)]
    return sorted(range(count), key=lambda c: (-len(worth[c]), -sum(worth[c]), c))


def _in_another_variant(
    lines: list[Line], best: list[int], candidates: list[int], roots: EnvState, num_variants: int
) -> list[Line]:
    """Return the beginnings of lines of the best candidates in the first variants that they were not tried in."""
    fresh = []
    for candidate in best:
        variant = sum(line.candidate == candidate for line in lines)
        if variant < num_variants:
            state = jax.tree.map(lambda leaf, v=variant: leaf[v], roots)
            fresh.append(Line(candidate, variant, candidates[candidate], state))
    return fresh


def _follow(rollout: Rollout, bank: HullBank, lines: list[Line]) -> None:
    """Push once more on every line, a batch at a time."""
    for start in range(0, len(lines), rollout.batch):
        _follow_batch(rollout, bank, lines[start : start + rollout.batch])


def _follow_batch(rollout: Rollout, bank: HullBank, lines: list[Line]) -> None:
    padded = lines + lines[-1:] * (rollout.batch - len(lines))
    real = np.arange(rollout.batch) < len(lines)
    states = jax.tree.map(lambda *leaves: np.stack(leaves), *(line.state for line in padded))
    pushed = rollout.push(bank, states, np.array([line.action for line in padded], np.int32), real)
    enclosed = real & rollout.succeeded(pushed.results.reason)
    held = rollout.grasp(bank, pushed.states, enclosed)
    host = jax.device_get(pushed.states)
    chances = chance(np.asarray(pushed.values))
    for i, line in enumerate(lines):
        line.safety *= float(pushed.safety[i])
        discount = line.safety * DISCOUNT**line.depth
        if enclosed[i]:
            line.worth = discount * (1.0 if held[i] else SLIPPED)
        elif pushed.results.terminated[i]:
            line.worth = SALVAGE * line.worth  # 0 for the candidate itself
        else:
            line.worth = discount * DISCOUNT * float(chances[i])
        line.ended = bool(pushed.results.terminated[i])
        line.action, line.depth = int(pushed.actions[i]), line.depth + 1
        line.state = jax.tree.map(lambda leaf, i=i: leaf[i], host)
