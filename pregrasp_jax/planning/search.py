"""Which of several first pushes does best: rounds of simulations, in each of which fewer candidates stay."""

import time
from typing import Any

import numpy as np

from pregrasp_jax.config import PlanningConfig
from pregrasp_jax.planning.rollout import Pushed, Rollout
from pregrasp_jax.types import EnvState, HullBank

SUCCESS, FAILURE = 1.0, 0.0


def chance(values: np.ndarray) -> np.ndarray:
    """Return how likely an episode succeeds whose best push the network values at [...]."""
    return np.clip(0.2 + 0.45 * values, 0.0, 0.95)


class Line:
    """A candidate in one variant of the scene, as far as it has been followed."""

    def __init__(self, candidate: int, variant: int):
        self.candidate, self.variant, self.depth = candidate, variant, 0
        self.worth, self.ended = 0.0, False
        self.state: Any = None
        self.next_action = -1
        self.enclosed = False


class Search:
    """One decision."""

    def __init__(
        self,
        rollout: Rollout,
        bank: HullBank,
        roots: EnvState,
        candidates: np.ndarray,
        config: PlanningConfig,
        begin: float,
    ):
        self._rollout, self._bank, self._roots = rollout, bank, roots
        self._candidates, self._config, self._begin = candidates, config, begin
        self._lines: dict[tuple[int, int], Line] = {}
        self.pushes = 0

    def run(self) -> int:
        """Return the best first push, flat index of Q."""
        order = list(range(len(self._candidates)))
        self._open([(candidate, 0) for candidate in order])
        for keep in self._config.rounds:
            if self._out_of_time():
                break
            order = self._ranked()[:keep]
            self._widen(order)
        return int(self._candidates[self._ranked()[0]])

    def _out_of_time(self) -> bool:
        limit = self._config.budget_ms
        return limit > 0 and (time.perf_counter() - self._begin) * 1e3 > 0.6 * limit

    def _ranked(self) -> list[int]:
        """Return the candidates, best first: those followed in most variants before the others."""
        lines = self._lines.values()
        worth = {c: [line.worth for line in lines if line.candidate == c] for c in range(len(self._candidates))}
        return sorted(worth, key=lambda c: (-len(worth[c]), -float(np.mean(worth[c])), c))

    def _widen(self, order: list[int]) -> None:
        """Follow the lines of some candidates one push further, and open another variant of each."""
        fresh, further = [], []
        for candidate in order:
            variants = [line.variant for line in self._lines.values() if line.candidate == candidate]
            if len(variants) < self._config.variants:
                fresh.append((candidate, len(variants)))
            further += [line for line in self._lines.values() if line.candidate == candidate and self._open_ended(line)]
        self._advance(further)
        self._open(fresh)

    def _open_ended(self, line: Line) -> bool:
        return not line.ended and line.depth <= self._config.depth

    def _open(self, pairs: list[tuple[int, int]]) -> None:
        lines = [Line(candidate, variant) for candidate, variant in pairs]
        if not lines:
            return
        roots = self._rollout.take(self._roots, self._padded([line.variant for line in lines]))
        self._follow(lines, roots, np.array([self._candidates[line.candidate] for line in lines]))
        self._lines |= {(line.candidate, line.variant): line for line in lines}

    def _advance(self, lines: list[Line]) -> None:
        for start in range(0, len(lines), self._rollout.batch):
            part = lines[start : start + self._rollout.batch]
            states = _stack([part[i].state for i in self._padded(range(len(part)))])
            self._follow(part, states, np.array([line.next_action for line in part]))

    def _padded(self, index: Any) -> np.ndarray:
        index = np.asarray(list(index))
        return np.concatenate([index, np.repeat(index[-1:], self._rollout.batch - len(index))])

    def _follow(self, lines: list[Line], states: EnvState, actions: np.ndarray) -> None:
        """Push once more on every line."""
        batch, count = self._rollout.batch, len(lines)
        execute = np.arange(batch) < count
        padded = np.concatenate([actions, np.repeat(actions[-1:], batch - count)]).astype(np.int32)
        pushed = self._rollout.push(self._bank, states, padded, execute)
        self.pushes += count
        reason = np.asarray(pushed.results.reason)[:count]
        terminated = np.asarray(pushed.results.terminated)[:count]
        success = np.asarray(self._rollout.succeeded(reason))
        held = success.copy()
        if self._config.grasp and success.any():
            tried = np.zeros(batch, bool)
            tried[:count] = success
            held = self._rollout.grasp(self._bank, pushed.states, tried)[:count]
        worth = chance(np.asarray(pushed.values)[:count])
        discount = self._config.discount ** np.array([line.depth for line in lines])
        for i, line in enumerate(lines):
            if held[i]:
                line.worth = SUCCESS * discount[i]
            elif terminated[i]:
                line.worth = FAILURE if line.depth == 0 else self._config.salvage * line.worth
            else:
                line.worth = self._config.discount * discount[i] * worth[i]
            line.ended = bool(terminated[i])
            line.depth += 1
            line.next_action = int(pushed.actions[i])
        self._keep_states(lines, pushed)

    def _keep_states(self, lines: list[Line], pushed: Pushed) -> None:
        for i, line in enumerate(lines):
            line.state = (pushed.states, i)


def _stack(parts: list[tuple[EnvState, int]]) -> EnvState:
    """Return states picked from several batches."""
    import jax

    leaves = [jax.tree.map(np.asarray, states) for states, _ in parts]
    return jax.tree.map(lambda *rows: np.stack([row[i] for row, (_, i) in zip(rows, parts, strict=True)]), *leaves)
