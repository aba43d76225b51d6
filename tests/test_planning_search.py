"""A search: how it ranks pushes, what it asks of simulations and of the network, and what a value promises."""

# Host arrays and stand-ins are given for device arrays here.
# pyright: reportArgumentType=false

import math
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from pregrasp_jax.config import TaskConfig
from pregrasp_jax.evaluation_config import PlanningConfig
from pregrasp_jax.planning import search as searching
from pregrasp_jax.planning.promise import promise_of
from pregrasp_jax.planning.rollout import Rollout
from pregrasp_jax.planning.search import search
from pregrasp_jax.types import REASONS

PROMISE = promise_of(TaskConfig(), 0.5)


class World:
    """A rollout of made-up scenes: a push numbered a leads from state s to 10 s + a, and `rules` says what of it."""

    batch = 4

    def __init__(self, rules: dict[int, tuple[str, float]]):
        self.rules, self.pushes, self.calls, self.grasps = rules, 0, 0, 0

    def push(self, bank: Any, states: np.ndarray, actions: np.ndarray, execute: np.ndarray) -> Any:
        after = 10 * states + actions
        told = [self.rules.get(int(state), ("running", 0.5)) for state in after]
        reason = np.array([REASONS.index(name) for name, _ in told])
        self.pushes, self.calls = self.pushes + int(execute.sum()), self.calls + 1
        results = SimpleNamespace(reason=reason, terminated=reason != 0)
        return SimpleNamespace(states=after, results=results, safety=np.ones(len(after)))

    def propose(self, states: list[np.ndarray]) -> Any:
        told = [self.rules.get(int(state), ("running", 0.5)) for state in states]
        assert told and {reason for reason, _ in told} == {"running"}, "nothing is asked where an episode has ended"
        return SimpleNamespace(values=np.array([value for _, value in told]), actions=np.tile([1, 2], (len(states), 1)))

    def succeeded(self, reason: np.ndarray) -> np.ndarray:
        return reason == REASONS.index("target_in_region")

    def grasp(self, bank: Any, states: np.ndarray, execute: np.ndarray) -> np.ndarray:
        self.grasps += int(execute.sum())
        return execute & (states % 10 != 7)  # what ends with push 7 slips


def decide(world: World, candidates: list[int], *, left: int = 10, deadline: float = math.inf, **settings: int) -> int:
    config = PlanningConfig(**{"variants": 2, "depth": 1} | settings)
    roots = np.arange(1, config.variants + 1)
    found = search(world, None, roots, candidates, config, PROMISE, left=left, deadline=deadline)
    assert found.pushes == world.pushes
    return found.action


def test_a_success_in_all_variants_beats_one_in_some_and_a_promise():
    won = ("target_in_region", 0.0)
    assert decide(World({13: won, 14: won, 24: won, 15: ("running", 1.9), 25: ("running", 1.9)}), [3, 4, 5]) == 4


def test_what_fails_is_not_chosen_and_what_slips_only_before_a_poor_promise():
    """A grasp that slips in a rebuilt scene is no certain failure: it is worth less than one that holds."""
    won = ("target_in_region", 0.0)
    lost = {start + a: ("off_table", 2.0) for start in (10, 20) for a in (3, 4)}
    enclosed = {start + a: won for start in (10, 20) for a in (7, 8)}  # 7 slips
    promising = {start + 6: ("running", 2.0) for start in (10, 20)}
    world = lost | enclosed | promising
    assert decide(World(world), [3, 7, 4, 2]) == 7
    assert decide(World(world), [3, 7, 8]) == 8
    assert decide(World(world), [7, 6], depth=0) == 6


def test_continuations_tell_promises_apart():
    """Both look alike after one push; only one of them goes on to a success."""
    rules = {start + a: ("running", 1.4) for start in (10, 20) for a in (3, 4)}
    rules |= {131: ("off_table", 0.0), 231: ("off_table", 0.0), 141: ("target_in_region", 0.0)}
    assert decide(World(rules), [3, 4]) == 4
    assert decide(World(rules), [3, 4], depth=0) == 3


def test_another_continuation_is_tried_where_the_first_fails():
    """Of what the network would push next the first fails in both lines, the second only in one."""
    rules = {start + a: ("running", 1.4) for start in (10, 20) for a in (3, 4)}
    rules |= {131: ("off_table", 0.0), 141: ("off_table", 0.0), 132: ("off_table", 0.0), 142: ("target_in_region", 0.0)}
    assert decide(World(rules), [3, 4]) == 4


def test_what_seems_to_win_is_tried_in_more_variants():
    """Push 3 wins in the first three variants only, push 4 in all but the first."""
    rules = {10 * v + 3: ("target_in_region" if v <= 3 else "off_table", 0.0) for v in range(1, 9)}
    rules |= {10 * v + 4: ("target_in_region" if v > 1 else "off_table", 0.0) for v in range(1, 9)}
    assert decide(World(rules), [3, 4], variants=3) == 3
    assert decide(World(rules), [3, 4], variants=8) == 4


def test_grasps_are_tried_where_they_can_decide():
    """Of two that enclose alike the first holds in all six scenes; or it slips in the first, and the second holds."""
    enclosed = {10 * v + a: ("target_in_region", 0.0) for v in range(1, 9) for a in (3, 4, 7)}
    for candidates, grasps in (([3, 4], 6), ([7, 3], 1 + 6)):
        world = World(enclosed)
        assert decide(world, candidates, variants=6) == 3
        assert world.grasps == grasps
    alone = World(enclosed | {10 * v + 5: ("running", 1.2) for v in range(1, 9)})
    assert decide(alone, [7, 5], depth=0) == 7 and alone.grasps == 0, "better than the other, even if it slips"


def test_the_choice_is_that_of_trying_every_grasp(monkeypatch: pytest.MonkeyPatch):
    """Fifty made-up worlds in which a third of what is enclosed slips, whatever the push."""
    ways = {"leader": searching._grasp_leader, "all": grasp_all, "none": lambda *_: None}
    chosen = {way: [] for way in ways}
    for seed in range(50):
        rng = np.random.default_rng(seed)
        ends = rng.choice(["target_in_region", "running", "off_table"], p=[0.9, 0.05, 0.05], size=(9, 9))
        rules = {10 * v + a: (str(ends[v, a]), 1.4) for v in range(1, 9) for a in range(1, 9)}
        slips = rng.random(10_000) < 0.3
        for way, function in ways.items():
            monkeypatch.setattr(searching, "_grasp_leader", function)
            world = World(rules)
            monkeypatch.setattr(world, "grasp", lambda _, states, execute, slips=slips: execute & ~slips[states])
            chosen[way].append(decide(world, [3, 4, 5, 6], variants=6))
    assert chosen["leader"] == chosen["all"]
    assert np.not_equal(chosen["leader"], chosen["none"]).sum() >= 5, "grasps decide here"


def grasp_all(rollout: Any, bank: Any, best: list[list[Any]]) -> None:
    for node in (node for trees in best for tree in trees for node in tree.nodes() if node.ungrasped):
        node.ungrasped = False
        node.promise *= 1.0 if rollout.grasp(bank, np.array([node.state]), np.array([True]))[0] else searching.SLIPPED


def test_what_a_push_promises_is_worth_nothing_after_the_last_one():
    """Push 3 promises much, push 4 wins in half of the variants."""
    rules = {13: ("running", 2.0), 23: ("running", 2.0), 14: ("target_in_region", 0.0), 24: ("off_table", 0.0)}
    assert decide(World(rules), [3, 4], depth=0) == 3
    world = World(rules)
    assert decide(world, [3, 4], left=1) == 4
    assert world.pushes == 4, "nothing follows the last push"


def test_without_time_one_round_decides():
    world = World({14: ("target_in_region", 0.0)})
    assert decide(world, [3, 4, 5, 6, 8], deadline=0.0) == 4
    assert world.pushes == 5 and world.calls == 2


@pytest.mark.parametrize(("seconds", "pushes"), [(17.9, 12), (18.1, 18), (29.9, 18), (30.1, 24)])
def test_a_round_begins_if_a_push_of_it_would_take_as_long_as_of_the_last(
    seconds: float, pushes: int, monkeypatch: pytest.MonkeyPatch
):
    """A push takes a second here. Rounds make 12, 6 and 6, and the last one, which may try grasps, is taken for 12."""
    world = World({})
    monkeypatch.setattr(searching, "time", SimpleNamespace(perf_counter=lambda: float(world.pushes)))
    decide(world, list(range(1, 13)), deadline=seconds, variants=6, depth=2)
    assert world.pushes == pushes


@pytest.mark.parametrize("approach", [0.5, 0.0])
@pytest.mark.parametrize("discount", [0.5, 0.7, 0.85, 0.99])
def test_chances_rise_with_values_and_are_in_rewards_of_a_success(approach: float, discount: float):
    found = promise_of(TaskConfig(approach_reward=approach), discount)(np.linspace(-1, 3, 50))
    assert (np.diff(found) >= 0).all() and 0 < found[0] < 0.1 and 0.9 < found[-1] < 1
    tripled = promise_of(TaskConfig(approach_reward=approach, in_region_reward=6.0), discount)(
        3 * np.linspace(-1, 3, 50)
    )
    np.testing.assert_allclose(tripled, found)


def test_a_value_promises_more_where_coming_nearer_does_not_count():
    values = np.array([0.6, 0.9, 1.2])
    counting, alone = (promise_of(TaskConfig(approach_reward=reward), 0.7)(values) for reward in (0.5, 0.0))
    assert (alone > counting + 0.05).all()


def test_a_value_promises_less_the_more_a_later_success_is_worth():
    values = np.linspace(0, 2.5, 200)
    by_discount = [promise_of(TaskConfig(approach_reward=0.0), discount)(values) for discount in (0.7, 0.8, 0.9, 0.95)]
    assert (np.diff(by_discount, axis=0) <= 0.01).all()
    assert by_discount[0][80] > by_discount[1][80] + 0.05 > by_discount[3][80] + 0.1
    for discount, like in ((0.5, 0.7), (1.0, 0.95)):
        np.testing.assert_array_equal(
            *(promise_of(TaskConfig(approach_reward=0.0), d)(values) for d in (discount, like))
        )
    halfway = promise_of(TaskConfig(approach_reward=0.0), 0.825)(values)
    np.testing.assert_allclose(halfway, (by_discount[0] + by_discount[3]) / 2)


def test_the_network_is_asked_about_every_scene_in_order():
    def ask(params: float, obs: np.ndarray, target: int) -> tuple[float, list[int]]:
        return params * obs.sum(), [target, target + 10]

    rollout = object.__new__(Rollout)
    vars(rollout).update({"_some_params": 2.0, "_ask": ask})
    states: Any = [SimpleNamespace(obs=np.array([i, 1.0]), scene=SimpleNamespace(target=i)) for i in range(3)]
    proposed = rollout.propose(states)
    assert proposed.values.tolist() == [2.0, 4.0, 6.0]
    assert proposed.actions.tolist() == [[0, 10], [1, 11], [2, 12]]
