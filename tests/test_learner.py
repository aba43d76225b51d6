import functools
from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from fake_env import hand_at

from pregrasp_jax.config import LearnerConfig
from pregrasp_jax.learning import learner
from pregrasp_jax.learning.records import UNKNOWN, Batch
from pregrasp_jax.types import REASONS, HandPose

H, W = 2, 3
Q = jnp.array([[[1.0, 2.0], [3.0, 9.0], [5.0, 4.0]], [[0.5, -1.0], [8.0, 7.0], [-2.0, 6.0]]])


@pytest.mark.parametrize(
    ("cells", "value", "action"),
    [
        ([(0, 0)], 2.0, 1),
        ([(0, 0), (0, 2)], 5.0, 4),
        ([(1, 2)], 6.0, 11),
        ([(1, 0), (0, 0)], 2.0, 1),
        ([(r, c) for r in range(H) for c in range(W)], 9.0, 3),
    ],
)
def test_best_allowed_push(cells, value, action):
    mask = jnp.zeros((H, W, 2), bool).at[tuple(zip(*cells, strict=True))].set(True)
    assert float(learner.max_q(Q, mask)) == value
    assert int(learner.greedy_action(Q, mask)) == action


def test_negative_values_are_not_replaced_by_a_masked_zero():
    mask = jnp.zeros((H, W, 2), bool).at[0, 0].set(True)
    assert float(learner.max_q(-Q, mask)) == -1.0
    assert int(learner.greedy_action(-Q, mask)) == 0


def test_a_choice_that_is_not_allowed_is_not_taken():
    mask = jnp.zeros((H, W, 2), bool).at[0, 1, 0].set(True).at[1, 2].set(True)
    assert float(learner.max_q(Q, mask)) == 6.0, "9 is the other choice of the first cell"
    assert int(learner.greedy_action(Q, mask)) == 11


def test_empty_half_ring_is_worth_nothing():
    empty = jnp.zeros((H, W, 2), bool)
    assert float(learner.max_q(Q, empty)) == 0.0
    assert int(learner.greedy_action(Q, empty)) == 0
    with jax.debug_nans(True):
        grad = jax.grad(lambda q: learner.max_q(q, empty))(Q)
    np.testing.assert_array_equal(grad, jnp.zeros_like(Q))


@pytest.mark.parametrize(
    ("reward", "terminated", "expected"), [(0.5, False, 2.5), (2.0, True, 2.0), (0.0, True, 0.0), (0.0, False, 2.0)]
)
def test_td_target(reward, terminated, expected):
    target = learner.td_target(jnp.float32(reward), jnp.asarray(terminated), jnp.float32(4.0), discount=0.5)
    assert float(target) == expected


def test_a_terminated_target_ignores_an_infinite_value():
    assert float(learner.td_target(jnp.float32(2.0), jnp.asarray(True), jnp.float32(jnp.inf), discount=0.5)) == 2.0


def test_td_target_passes_no_gradient():
    grad = jax.grad(lambda v: learner.td_target(v, jnp.asarray(False), v, discount=0.5))(1.0)
    assert grad == 0.0


@pytest.mark.parametrize(
    ("error", "loss", "slope"),
    [(0.0, 0.0, 0.0), (0.05, 0.00125, 0.05), (-0.1, 0.005, -0.1), (0.3, 0.025, 0.1), (-2.0, 0.195, -0.1)],
)
def test_huber_hand_numbers(error, loss, slope):
    value, grad = jax.value_and_grad(learner.huber)(jnp.float32(error), delta=0.1)
    assert float(value) == pytest.approx(loss, abs=1e-7)
    assert float(grad) == pytest.approx(slope, abs=1e-6)


def test_huber_agrees_with_optax():
    errors = jnp.linspace(-1, 1, 101)
    expected = optax.losses.huber_loss(errors, delta=0.1)
    np.testing.assert_allclose(learner.huber(errors, delta=0.1), expected, atol=1e-7)


def tabular(params, inputs):
    """Q-maps from a table: the first pixel of the input names the state."""
    return params[inputs[:, 0, 0, 0].astype(jnp.int32)]


def tabular_at(params, inputs, action):
    return tabular(params, inputs).reshape(len(action), -1)[jnp.arange(len(action)), action]


def table(apply=tabular) -> Any:
    """Return the Q-function of a table, on a grid of H x W cells."""
    return SimpleNamespace(apply=apply, at=tabular_at, networks=lambda params: [params])


SUCCESS = REASONS.index("target_in_region")
OPTIONS: dict[str, Any] = {"successes": (SUCCESS,), "config": LearnerConfig()}


def state_input(states) -> jax.Array:
    states = jnp.asarray(states, jnp.float32)
    return jnp.broadcast_to(states[:, None, None, None], (len(states), H, W, 2))


def make_batch(states, next_states, **changes) -> Batch:
    size = len(states)
    fields = {
        "inputs": state_input(states),
        "next_inputs": state_input(next_states),
        "next_hand": hands([(0.0, 0.0)] * size),
        "importance_weights": jnp.ones(size),
        "hindsight": jnp.zeros(size, bool),
    }
    pushes = {
        "rows": jnp.arange(size),
        "drawn": jnp.ones(size, bool),
        "next_values": jnp.full(size, UNKNOWN),
        "action": jnp.zeros(size, jnp.int32),
        "reward": jnp.zeros(size),
        "terminated": jnp.zeros(size, bool),
        "reason": jnp.zeros(size, jnp.int32),
    }
    given = {name: changes.pop(name, values).reshape(size, -1) for name, values in pushes.items()}
    return Batch(**(fields | given | changes))


def hands(points) -> HandPose:
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *(hand_at(point) for point in points))


def first_row(hand):
    """A half ring of a kind: row 0 only, or nothing where x is 9."""
    return (jnp.arange(H) == 0)[:, None, None] & jnp.ones((1, W, 2), bool) & (hand.xy[0] != 9.0)


def run_update(params, batch, optimizer=None, **options):
    optimizer = optimizer or optax.sgd(1.0)
    state = learner.init(params, optimizer)
    options = OPTIONS | {"q": table(), "mask_fn": first_row, "optimizer": optimizer} | options
    return jax.jit(functools.partial(learner.update, **options))(state, batch)


@pytest.mark.parametrize("compiled", [False, True])
def test_update_by_hand(compiled):
    params = jnp.stack([Q, 10 * Q, -Q])
    batch = make_batch(
        [0, 1, 2],
        [1, 0, 0],
        action=jnp.array([3, 10, 0], jnp.int32),
        reward=jnp.array([0.5, 2.0, 0.0]),
        terminated=jnp.array([False, True, False]),
        reason=jnp.array([0, SUCCESS, REASONS.index("off_table")]),
        next_hand=hands([(0.0, 0.0), (0.0, 0.0), (9.0, 0.0)]),
        importance_weights=jnp.array([1.0, 0.5, 0.25]),
        hindsight=jnp.array([True, False, False]),
    )
    function = jax.jit(run_update) if compiled else run_update
    state, errors, values, metrics = function(params, batch)
    np.testing.assert_allclose(values[:, 0], [90.0, 3 * 3.0, 0.0])
    # y = .5 + .5 * max(row 0 of 10 Q = 90), 2, 0 (empty ring); Q taken = 9, 10 * -2, -1.
    np.testing.assert_allclose(errors[:, 0], [9.0 - 45.5, -20.0 - 2.0, -1.0], rtol=1e-6)
    expected = np.array(params)
    # Slope -0.1 each (linear branch), times weight, over the batch size; sgd with step 1 adds it.
    for index, weight in zip([(0, 0, 1, 1), (1, 1, 2, 0), (2, 0, 0, 0)], [1.0, 0.5, 0.25], strict=True):
        expected[index] += 0.1 * weight / 3
    np.testing.assert_allclose(state.params, expected, rtol=1e-6)
    np.testing.assert_allclose(state.target_params, 0.999 * params + 0.001 * state.params, rtol=1e-6)
    assert int(state.gradient_steps) == 1
    loss = np.mean([0.1 * (36.5 - 0.05), 0.5 * 0.1 * (22 - 0.05), 0.25 * 0.1 * (1 - 0.05)])
    values = {name: float(value) for name, value in metrics.items()}
    assert values["train/loss"] == pytest.approx(loss, rel=1e-5)
    assert values["train/td_error"] == pytest.approx(59.5 / 3, rel=1e-5)
    assert values["train/target_mean"] == pytest.approx(47.5 / 3, rel=1e-5)
    assert (values["train/target_min"], values["train/target_max"]) == (0.0, 45.5)
    assert values["train/q_taken"] == pytest.approx(-4.0, rel=1e-5)
    assert values["train/grad_norm"] == pytest.approx(0.1 / 3 * np.sqrt(1 + 0.25 + 0.0625), rel=1e-5)
    shares = [values[f"train/share_{name}"] for name in ("success", "approach", "nothing", "hindsight")]
    np.testing.assert_allclose(shares, [1 / 3] * 4, rtol=1e-6)


def test_siblings_share_a_state_and_keep_the_values_they_had():
    """Three pushes of state 0: the one that was drawn, one whose next state had the value 6, and two to be left out."""
    batch = make_batch(
        [0],
        [1],
        drawn=jnp.array([[False, True, False, False]]),
        next_values=jnp.array([[6.0, 1e6, UNKNOWN, UNKNOWN]]),
        action=jnp.array([[0, 3, 5, 5]], jnp.int32),
        reward=jnp.array([[0.5, 0.0, 1e6, 1e6]]),
        terminated=jnp.zeros((1, 4), bool),
        reason=jnp.zeros((1, 4), jnp.int32),
        rows=jnp.array([[7, 8, 9, -1]]),
        importance_weights=jnp.array([0.5]),
    )
    params = jnp.stack([Q, 10 * Q])
    state, errors, values, metrics = run_update(params, batch)
    np.testing.assert_allclose(values, [[6.0, 90.0, UNKNOWN, UNKNOWN]])
    np.testing.assert_allclose(errors, [[1.0 - 3.5, 9.0 - 45.0, 0.0, 0.0]])
    expected = np.array(params)
    expected[0, 0, 0, 0] += 0.1 * 0.5 / 2
    expected[0, 0, 1, 1] += 0.1 * 0.5 / 2
    np.testing.assert_allclose(state.params, expected, rtol=1e-6)
    assert float(metrics["train/target_mean"]) == pytest.approx((3.5 + 45.0) / 2)
    assert float(metrics["train/target_max"]) == 45.0


def test_half_of_the_next_states_are_valued_those_that_have_no_value_first():
    """Six pushes: two ended, of the four others two have the value 7 of before."""
    ended = jnp.array([True, False, False, True, False, False])
    stored = jnp.array([UNKNOWN, 7.0, UNKNOWN, UNKNOWN, UNKNOWN, 7.0])
    batch = make_batch([0] * 6, [1] * 6, terminated=ended, next_values=jnp.where(ended, 0.0, stored))
    config = LearnerConfig(valued_share=0.5)
    valued_states = []

    def counted(params, inputs):
        valued_states.append(len(inputs))
        return tabular(params, inputs)

    _, errors, values, _ = run_update(jnp.stack([Q, 10 * Q]), batch, q=table(counted), config=config)
    assert valued_states == [3]
    np.testing.assert_allclose(values[:, 0], [0.0, 90.0, 90.0, 0.0, 90.0, 7.0])
    np.testing.assert_allclose(errors[:, 0], [1.0, 1.0 - 45.0, 1.0 - 45.0, 1.0, 1.0 - 45.0, 1.0 - 3.5])


def test_what_has_no_value_and_gets_none_is_left_out():
    batch = make_batch([0] * 4, [1] * 4)
    config = LearnerConfig(valued_share=0.25)
    state, errors, values, _ = run_update(jnp.stack([Q, 10 * Q]), batch, config=config)
    np.testing.assert_allclose(values[:, 0], [90.0, UNKNOWN, UNKNOWN, UNKNOWN])
    np.testing.assert_allclose(errors[:, 0], [1.0 - 45.0, 0.0, 0.0, 0.0])
    assert float(state.params[0, 0, 0, 0]) == pytest.approx(1.0 + 0.1), "the mean is over the one that counts"


def test_samples_of_a_kind_take_turns():
    batch = make_batch([0] * 5, [1] * 5, terminated=jnp.array([False, True, False, False, False]))
    chosen = [np.arange(5)[learner.to_value(batch, 2, jnp.int32(turn))].tolist() for turn in range(5)]
    assert chosen == [[0, 2], [2, 3], [2, 3], [3, 4], [4, 0]]


def test_targets_come_from_the_target_network():
    optimizer = optax.sgd(0.0)
    state = learner.init(jnp.zeros((1, H, W, 2)), optimizer).replace(target_params=Q[None])
    options = OPTIONS | {"q": table(), "mask_fn": first_row, "optimizer": optimizer}
    _, errors, _, _ = jax.jit(functools.partial(learner.update, **options))(state, make_batch([0], [0]))
    assert float(errors[0, 0]) == -4.5


def test_adam_and_polyak_are_what_the_paper_names():
    batch = make_batch([0], [0], reward=jnp.array([100.0]))
    state, *_ = run_update(jnp.zeros((1, H, W, 2)), batch, optax.adam(1e-4))
    assert float(state.params[0, 0, 0, 0]) == pytest.approx(1e-4, rel=1e-3)
    assert float(state.target_params[0, 0, 0, 0]) == pytest.approx(1e-7, rel=1e-3)
    assert int(jnp.sum(state.params != 0)) == 1


def test_init_copies_so_that_a_donated_state_stays_valid():
    params = jnp.ones((1, H, W, 2))
    optimizer = optax.sgd(1.0)
    state = learner.init(params, optimizer)
    step = jax.jit(
        lambda s, b: learner.update(s, b, q=table(), mask_fn=first_row, optimizer=optimizer, **OPTIONS),
        donate_argnums=0,
    )
    state, *_ = step(state, make_batch([0], [0]))
    state, *_ = step(state, make_batch([0], [0]))
    assert int(state.gradient_steps) == 2


def test_one_trace():
    traces = []

    def counted(params, inputs):
        traces.append(inputs.shape)
        return tabular(params, inputs)

    def counted_at(params, inputs, action):
        traces.append(inputs.shape)
        return tabular_at(params, inputs, action)

    optimizer = optax.adam(1e-3)
    q = SimpleNamespace(apply=counted, at=counted_at, networks=lambda params: [params])
    options = OPTIONS | {"q": q, "mask_fn": first_row, "optimizer": optimizer}
    step = jax.jit(lambda s, b: learner.update(s, b, **options))
    state = learner.init(jnp.zeros((2, H, W, 2)), optimizer)
    state, *_ = step(state, make_batch([0, 1], [1, 0]))
    num_traces = len(traces)
    for _ in range(3):
        state, *_ = step(state, make_batch([1, 1], [0, 0]))
    assert len(traces) == num_traces == 2


def test_shapes_are_checked():
    with pytest.raises(AssertionError, match="expected"):
        learner.max_q(Q, jnp.ones((W, H, 2), bool))
    with pytest.raises(AssertionError, match="expected"):
        learner.max_q(Q, jnp.ones((H, W), bool))
    with pytest.raises(AssertionError, match="expected scalars"):
        learner.td_error(jnp.zeros(3), jnp.zeros(3))
