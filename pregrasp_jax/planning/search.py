"""Which of several first pushes does best: rounds of simulations, in each of which fewer candidates stay."""

import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import NamedTuple

import jax
import numpy as np

from pregrasp_jax.evaluation_config import PlanningConfig
from pregrasp_jax.planning.promise import Promise
from pregrasp_jax.planning.rollout import Pushed, Rollout
from pregrasp_jax.types import EnvState, HullBank

ROUNDS = (3, 2)
"""Candidates that stay for the second round and those after it. Round n makes n pushes for each of them: one more in
every variant where something may follow, and the others in new variants."""

GRASPED = 2
"""Candidates that are left when grasps are tried: it takes long, nearly all that is enclosed is held, and what slips in
one variant slips in most."""

GRASP_WORK = 2
"""How many times as long a round takes in which grasps are tried, too."""

DISCOUNT = 0.93
"""What a success one push later is worth."""

ENDS = 0.4
"""Share of the planned episodes that end well which do so with the next push: they took 2 to 4 more."""

SALVAGE = 0.6
"""Share of its promise that a state keeps after every continuation that has been tried: another can be chosen then."""

SLIPPED = 0.85
"""Share of its worth that an enclosed target keeps which the simulated grasp does not hold: in truth 97 of 100 enclosed
targets are held, and a rebuilt shape may slip where the object does not."""


class Choice(NamedTuple):
    """The result of a search.

    Attributes:
        action: flat index of Q.
        pushes: simulated, grasps not counted.
    """

    action: int
    pushes: int


@dataclass
class Node:
    """Where a line of pushes has led in one variant of the rebuilt scene.

    Attributes:
        state: that scene now, host arrays.
        proposals: what may be pushed next, best first; none once the episode has ended.
        depth: pushes so far.
        safety: how likely nothing else has left the workspace until now than what has left.
        promise: how likely the episode ends well, discounted by the pushes that takes, if no continuation is known.
        ungrasped: whether the target is enclosed and its grasp has yet to be tried.
        children: where the first of the proposals have led.
    """

    state: EnvState
    proposals: list[int]
    depth: int = 0
    safety: float = 1.0
    promise: float = 0.0
    ungrasped: bool = False
    children: "list[Node]" = field(default_factory=list)

    @property
    def remainder(self) -> float:
        """What the proposals that have not been tried promise; every one that has been takes its share."""
        return self.promise * SALVAGE ** len(self.children)

    @property
    def worth(self) -> float:
        """What the best continuation is worth that is known."""
        return max([self.remainder, *(child.worth for child in self.children)])

    def nodes(self) -> "Iterator[Node]":
        """Iterate over this node and all that follow from it."""
        yield self
        for child in self.children:
            yield from child.nodes()


def search(
    rollout: Rollout,
    bank: HullBank,
    roots: EnvState,
    candidates: list[int],
    config: PlanningConfig,
    promise: Promise,
    *,
    left: int,
    deadline: float,
) -> Choice:
    """Return the candidate that does best on average over variants, by rounds in which fewer and fewer stay.

    Args:
        rollout: simulates.
        bank: the objects of all variants.
        roots: [V] the rebuilt scene in all variants, as host arrays.
        candidates: flat indices of Q, at least one.
        config: how deep, in how many variants.
        promise: what the values of the network mean.
        left: pushes that the episode may still have, the one that is searched for included.
        deadline: by `time.perf_counter`; no round begins that would not end before it if a push took as long as in
            the last one.
    """
    trees: list[list[Node]] = [[] for _ in candidates]
    best, seconds_per_push = list(range(len(candidates))), 0.0
    for number, keep in enumerate((len(candidates), *ROUNDS)):
        begin = time.perf_counter()
        best = sorted(best, key=lambda c: -_mean_worth(trees[c]))[:keep]
        work = len(best) * (1 + number) * (1 if len(best) > GRASPED else GRASP_WORK)
        if number and begin + work * seconds_per_push > deadline:
            break
        due = [n for c in best for n in _due(trees[c], candidates[c], roots, 1 + number, config, left)]
        batches = _batches(due, rollout.batch)
        # All are under way before the first is looked at: its pictures are drawn while the next is pushed.
        pushed = [_push(rollout, bank, nodes) for nodes in batches]
        going_on = [child for nodes, ends in zip(batches, pushed, strict=True) for child in _grow(rollout, nodes, ends)]
        if going_on:
            _look_ahead(rollout, going_on, promise, left)
        if len(best) <= GRASPED:
            _grasp_leader(rollout, bank, [trees[c] for c in best])
        seconds_per_push = (time.perf_counter() - begin) / work
    pushes = sum(node.depth > 0 for of_candidate in trees for tree in of_candidate for node in tree.nodes())
    return Choice(candidates[max(best, key=lambda c: _mean_worth(trees[c]))], pushes)


def _due(trees: list[Node], action: int, roots: EnvState, count: int, config: PlanningConfig, left: int) -> list[Node]:
    """Return from where a candidate, `action`, is pushed on in a round of `count` pushes.

    Where nothing follows in the variants that it has been tried in, new ones join its `trees`.
    """
    found = [_most_promising(tree, min(config.depth, left - 1)) for tree in trees]
    further = [node for node in found if node is not None]
    tried = len(trees)
    for variant in range(tried, min(tried + count - len(further), config.variants)):
        trees.append(Node(jax.tree.map(lambda leaf, v=variant: leaf[v], roots), [action]))
    return further + trees[tried:]


def _mean_worth(trees: list[Node]) -> float:
    """Return what a candidate is worth on average over the variants that it has been tried in, at least one."""
    return sum(tree.worth for tree in trees) / max(len(trees), 1)


def _most_promising(tree: Node, max_depth: int) -> Node | None:
    """Return the node after 1 to `max_depth` pushes whose next proposal promises most; None if there is none."""
    nodes = (node for node in tree.nodes() if 0 < node.depth <= max_depth and node.proposals[len(node.children) :])
    return max(nodes, key=lambda node: node.remainder, default=None)


def _batches(nodes: list[Node], size: int) -> list[list[Node]]:
    return [nodes[start : start + size] for start in range(0, len(nodes), size)]


def _padded(nodes: list[Node], size: int) -> tuple[list[Node], np.ndarray, EnvState]:
    """Return a batch of nodes, the last one repeated, which of them are real [B] bool, and their states [B]."""
    padded = nodes + nodes[-1:] * (size - len(nodes))
    states = jax.tree.map(lambda *leaves: np.stack(leaves), *(node.state for node in padded))
    return padded, np.arange(size) < len(nodes), states


def _push(rollout: Rollout, bank: HullBank, nodes: list[Node]) -> Pushed:
    """Try the next proposal of every node, at most a batch of them."""
    padded, real, states = _padded(nodes, rollout.batch)
    actions = np.array([node.proposals[len(node.children)] for node in padded], np.int32)
    return rollout.push(bank, states, actions, real)


def _grow(rollout: Rollout, nodes: list[Node], pushed: Pushed) -> list[Node]:
    """Append to every node where its push has led; return those new ones whose episodes go on."""
    ends, reasons, terminated, safety = jax.device_get(
        (pushed.states, pushed.results.reason, pushed.results.terminated, pushed.safety)
    )
    enclosed = rollout.succeeded(reasons)
    for i, node in enumerate(nodes):
        still_safe = node.safety * float(safety[i])
        child = Node(
            state=jax.tree.map(lambda leaf, i=i: leaf[i], ends),
            proposals=[],
            depth=node.depth + 1,
            safety=still_safe,
            promise=float(enclosed[i]) * still_safe * DISCOUNT**node.depth,
            ungrasped=bool(enclosed[i]),
        )
        node.children.append(child)
    return [node.children[-1] for node, ended in zip(nodes, terminated, strict=False) if not ended]


def _look_ahead(rollout: Rollout, nodes: list[Node], promise: Promise, left: int) -> None:
    """Ask the network what follows where episodes go on, in one node at least; the rest is as in `search`."""
    proposed = rollout.propose([node.state for node in nodes])
    for node, chance, actions in zip(nodes, promise(proposed.values), proposed.actions.tolist(), strict=True):
        in_time = 1 - (1 - ENDS) ** (left - node.depth)
        node.proposals = actions
        node.promise = in_time * float(chance) * node.safety * DISCOUNT**node.depth


def _grasp_leader(rollout: Rollout, bank: HullBank, best: list[list[Node]]) -> None:
    """Try the grasps of the candidate that leads, of those given by their trees, unless it would lead if they slipped.

    So on for whoever leads then: the one chosen in the end is the one that trying all grasps would choose.
    """
    while True:
        leader, *others = sorted(best, key=_mean_worth, reverse=True)
        rival = max(map(_mean_worth, others), default=0.0)
        nodes = [node for tree in leader for node in tree.nodes() if node.ungrasped][: rollout.batch]
        if not nodes or SLIPPED * _mean_worth(leader) >= rival:
            return
        _, real, states = _padded(nodes, rollout.batch)
        for node, holds in zip(nodes, rollout.grasp(bank, states, real), strict=False):
            node.ungrasped = False
            node.promise *= 1.0 if holds else SLIPPED
