"""Tiny tasks whose Q-values are known in closed form, learned through the shipped replay, hindsight and learner.

A state is one pixel; the Q-network is a table [state, goal, action] whose two actions are the closed and the open
hand at cell (0, 0) of the real grid, and the half ring is that cell. Each probe fails for one kind of bug.
"""

import functools
from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from fake_env import ACTIONS, fake_rules, hand_at, make_outcome

from pregrasp_jax.config import LearnerConfig, ReplayConfig, TaskConfig
from pregrasp_jax.learning import hindsight, learner, replay
from pregrasp_jax.spaces.grid import GRID_SIZE
from pregrasp_jax.types import MAX_OBJECTS, HandPose, Observation

GAMMA = 0.5
OPTIMIZER = optax.sgd(0.5)
RULES = fake_rules(TaskConfig())


def image(state: int) -> Observation:
    pixel = jnp.full((1, 1), state, jnp.uint8)
    return Observation(pixel, pixel, hand_at((0.0, 0.0)))


def network_input(obs: Observation, goal: jax.Array) -> jax.Array:
    state = obs.height.astype(jnp.float32)
    return jnp.stack([state, jnp.full_like(state, goal)], axis=-1)


def table_network(params: jax.Array, inputs: jax.Array) -> jax.Array:
    state, goal = inputs[:, 0, 0, 0].astype(jnp.int32), inputs[:, 0, 0, 1].astype(jnp.int32)
    # Everything outside the half ring promises a lot: a missing mask is noticed.
    q = jnp.full((inputs.shape[0], GRID_SIZE, GRID_SIZE, 2), 100.0)
    return q.at[:, 0, 0].set(params[state, goal])


def table_at(params: jax.Array, inputs: jax.Array, action: jax.Array) -> jax.Array:
    return table_network(params, inputs).reshape(len(action), -1)[jnp.arange(len(action)), action]


TABLE: Any = SimpleNamespace(
    apply=table_network,
    at=table_at,
    networks=lambda params: [params],
    input_fn=network_input,
    augment=lambda key, inputs, action: (inputs, action),
)


def one_cell(hand: HandPose) -> jax.Array:
    del hand
    return jnp.zeros(ACTIONS.shape, bool).at[0, 0].set(True)


def push(state, action, next_state, *, goal=0, enclosed=None, approach=(), truncated=False) -> replay.Steps:
    """One scene's push, judged by the shipped rules: `enclosed` and `approach` name object slots."""
    slots = jnp.arange(MAX_OBJECTS)
    outcome = make_outcome(
        coverage=(slots == (-1 if enclosed is None else enclosed)).astype(jnp.float32),
        distance_before=jnp.full(MAX_OBJECTS, 0.2),
        distance_after=jnp.where(jnp.isin(slots, jnp.array([*approach, -1])), 0.1, 0.3),
    )
    reward, terminated, reason = RULES.judge(outcome, jnp.int32(goal))
    step = replay.Steps(
        root=jnp.int32(0),
        obs=image(state),
        action=jnp.int32(action),
        goal=jnp.int32(goal),
        outcome=outcome,
        reward=reward,
        terminated=terminated,
        reason=reason,
        truncated=jnp.asarray(truncated),
        next_obs=image(next_state),
    )
    return jax.tree.map(lambda leaf: leaf[None], step)


def remember(pushes, *, relabel: bool = True) -> replay.Replay:
    memory = replay.init(pushes[0], capacity=max(64, 2 * len(pushes)), max_pushes=10)
    for step in pushes:
        memory = add(memory, step)
        if relabel:
            memory = add_hindsight(memory, jnp.ones((1, MAX_OBJECTS), bool))
    return memory


add = jax.jit(replay.add)
add_hindsight = jax.jit(functools.partial(hindsight.add_hindsight, rules=RULES))


@functools.partial(jax.jit, static_argnames=("num_updates", "batch_size", "priority_exponent"))
def train(memory, params, key, *, num_updates, batch_size=16, priority_exponent=0.6, polyak=0.9):
    config = LearnerConfig(batch_size=batch_size, discount=GAMMA, polyak=polyak, huber_delta=10.0)

    def one(carry, k):
        state, memory, metrics = learner.sample_and_update(
            carry[0],
            carry[1],
            k,
            q=TABLE,
            importance_exponent=0.4,
            replay_config=ReplayConfig(priority_exponent=priority_exponent),
            config=config,
            mask_fn=one_cell,
            successes=RULES.successes,
            optimizer=OPTIMIZER,
        )
        return (state, memory), metrics

    carry = (learner.init(params, OPTIMIZER), memory)
    (state, _), metrics = jax.lax.scan(one, carry, jax.random.split(key, num_updates))
    return state.params, metrics


def table(num_states: int) -> jax.Array:
    return jnp.zeros((num_states, MAX_OBJECTS, 2))


def test_one_push_success_and_failure(key):
    """Reward and termination: Q(0, open) = 2, Q(0, closed) = 0 although the next state looks valuable."""
    memory = remember([push(0, 1, 1, enclosed=0), push(0, 0, 1, enclosed=5)], relabel=False)
    q, _ = train(memory, table(2).at[1].set(50.0), key, num_updates=200)
    np.testing.assert_allclose(q[0, 0], [0.0, 2.0], atol=0.01)


def test_a_chain_is_discounted_per_push(key):
    """0 -> 1 -> 2 -> success, approaching in the second push only: Q = 0.75, 1.5, 2."""
    chain = [push(0, 0, 1), push(1, 1, 2, approach=(0,)), push(2, 1, 3, enclosed=0)]
    q, metrics = train(remember(chain), table(4), key, num_updates=500)
    np.testing.assert_allclose([q[0, 0, 0], q[1, 0, 1], q[2, 0, 1]], [0.75, 1.5, 2.0], atol=0.02)
    assert float(metrics["train/td_error"][-1]) < 0.02


def test_truncation_bootstraps_for_ever(key):
    """A push that approaches and returns to its state: Q = 0.5 / (1 - gamma) = 1, though every episode is cut."""
    memory = remember([push(0, 1, 0, approach=(0,), truncated=True)])
    q, _ = train(memory, table(1), key, num_updates=500)
    np.testing.assert_allclose(q[0, 0], [0.0, 1.0], atol=0.02)


EPISODE = [push(0, 1, 1, approach=(5,)), push(1, 0, 2, enclosed=5)]
"""The goal is 0; the hand approaches and encloses object 5."""


@pytest.mark.parametrize("relabel", [True, False])
def test_goal_swap(key, relabel):
    """Failures for goal 0 teach goal 5: Q(1 | 5) = 2, Q(0 | 5) = 0.5 + gamma 2; without hindsight nothing."""
    q, metrics = train(remember(EPISODE, relabel=relabel), table(3), key, num_updates=500)
    np.testing.assert_allclose(q[:2, 0], 0.0, atol=0.01)
    np.testing.assert_allclose([q[0, 5, 1], q[1, 5, 0]], [1.5, 2.0] if relabel else [0.0, 0.0], atol=0.02)
    assert bool(jnp.any(metrics["train/share_hindsight"] > 0)) == relabel


def test_rare_reward_is_found_by_priority(key):
    """One success among 200 pushes that achieve nothing; few updates with small batches.

    Uniform replay draws it in 2 % of its batches of 4, prioritized replay as soon as the others are known to be dull.
    """
    pushes = [push(0, 0, 0, truncated=True)] * 200
    pushes[77] = push(0, 1, 1, enclosed=0)
    memory = remember(pushes)
    options = {"num_updates": 400, "batch_size": 4}
    prioritized, metrics = train(memory, table(2), key, **options, priority_exponent=0.9)
    uniform, _ = train(memory, table(2), key, **options, priority_exponent=0.0)
    assert abs(float(prioritized[0, 0, 1]) - 2.0) < 0.1
    assert abs(float(uniform[0, 0, 1]) - 2.0) > 0.5
    assert float(jnp.mean(metrics["train/share_success"])) > 0.05


def test_siblings_learn_the_same_values_with_the_next_states_looked_at_now_and_then(key):
    """A chain 0 -> 1 -> success; from both states a branch is pushed too, to state 2, which is worth 2, and to failure.

    Q(0) = [gamma 2, gamma 2], Q(1) = [2, 0], Q(2) = [2, 0]; the decoy is a stale value that is never looked at again.
    """

    def state(real, branch):
        pair = jax.tree.map(lambda *leaves: jnp.concatenate(leaves), real, branch)
        return pair.replace(root=jnp.zeros(2, jnp.int32), truncated=pair.truncated | jnp.array([False, True]))

    pushes = [
        state(push(0, 0, 1), push(0, 1, 2)),
        state(push(1, 0, 3, enclosed=0), push(1, 1, 3, enclosed=5)),
        state(push(2, 0, 3, enclosed=0), push(2, 1, 3, enclosed=5)),
    ]
    memory = replay.init(pushes[0], capacity=64, max_pushes=10, num_siblings=2)
    for step in pushes:
        memory = add(memory, step)
    q, metrics = train(memory, table(4), key, num_updates=500)
    np.testing.assert_allclose(q[:3, 0], [[1.0, 1.0], [2.0, 0.0], [2.0, 0.0]], atol=0.02)
    assert float(metrics["train/td_error"][-1]) < 0.02
