"""A step in three stages: divided around the host or as one program, the result is the same."""

import functools
from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from fake_env import fake_env

from pregrasp_jax.config import Config, SceneConfig
from pregrasp_jax.task.assembly import make_env
from pregrasp_jax.task.env import Env
from pregrasp_jax.task.stages import Stages, make_stages


def push_stages(env: Any) -> Stages:
    """Return pushes of a batch of states, and what they did."""

    def before(states: Any, actions: jax.Array) -> Any:
        return states.physics, jax.vmap(env.plan)(states, actions), states

    return make_stages(env.engine, before, jax.vmap(env.conclude))


@pytest.fixture(scope="module")
def env() -> Env:
    return make_env(Config(scene=SceneConfig(test_scenes=3)), split="test")


def assert_same(one: Any, other: Any) -> None:
    assert jax.tree.structure(one) == jax.tree.structure(other)
    jax.tree.map(np.testing.assert_array_equal, one, other)


def test_native_pushes_are_the_same_bits_divided_or_whole(env):
    """Two pushes each, of which one is refused; the second begins where the first has ended."""
    assert env.engine.advance is not None
    stages, actions = push_stages(env), env.primitive.actions
    states = jax.jit(jax.vmap(env.reset_to))(jnp.arange(3))
    first = jnp.array([actions.encode(np.int32(row), np.int32(col), 1) for row, col in ((50, 15), (60, 20), (50, 99))])
    second = first.at[2].set(first[0])
    divided, whole = stages.compile(states, first), jax.jit(stages.__call__)
    stepped = jax.jit(jax.vmap(env.step))
    ends = []
    for run in (divided, whole, stepped):
        after, result = run(states, first)
        ends.append((result, *run(after, second)))
    assert_same(ends[0], ends[1])
    assert_same(ends[0], ends[2])
    result, after, _ = ends[0]
    np.testing.assert_array_equal(result.outcome.unreachable, [False, False, True])
    np.testing.assert_array_equal(after.num_pushes, [2, 2, 1])
    assert not np.array_equal(after.physics.bits, states.physics.bits)


def test_without_a_host_part_it_is_one_program_of_the_callers_making():
    env = fake_env()
    stages = push_stages(env)
    states, actions = jax.vmap(env.reset_to)(jnp.arange(3)), jnp.array([9000, 9200, 9300])
    made: list[Any] = []

    def compile_fn(function: Any, arguments: Any) -> Any:
        made.append(arguments)
        return jax.jit(function).lower(*arguments).compile()

    compiled = stages.compile(states, actions, compile_fn=compile_fn)
    assert len(made) == 1
    assert_same(compiled(states, actions), jax.jit(stages.__call__)(states, actions))
    stepped = jax.jit(jax.vmap(env.step))(states, actions)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=1e-6), compiled(states, actions), stepped)


@pytest.mark.parametrize("on_host", [False, True])
def test_a_second_motion_begins_where_the_first_has_ended(on_host):
    env, calls = fake_env(), []

    def advance(physics: Any, ctrl: Any, num_ctrl: Any) -> Any:
        calls.append(1)
        return 10 * physics + num_ctrl

    def plan(x: jax.Array) -> Any:
        return jax.vmap(env.plan)(jax.vmap(env.reset_to)(jnp.arange(3)), jnp.full(3, 9000)).replace(num_ctrl=x)

    def first(x: jax.Array) -> Any:
        return x, plan(jnp.array([1, 2, 3])), {"x": x}

    def second(kept: Any, done: Any, physics: jax.Array) -> Any:
        return physics, plan(done.num_ctrl + 1), kept | {"first": physics}

    def last(kept: Any, done: Any, physics: jax.Array) -> Any:
        return kept | {"second": physics, "rows": done.num_ctrl}

    engine: Any = SimpleNamespace(run=lambda p, c, n: 10 * p + n, advance=advance if on_host else None)
    result = make_stages(engine, first, second, last).compile(jnp.arange(3))(jnp.array([4, 5, 6]))
    expected = {"x": [4, 5, 6], "first": [41, 52, 63], "second": [412, 523, 634], "rows": [2, 3, 4]}
    assert {name: np.asarray(value).tolist() for name, value in result.items()} == expected
    assert len(calls) == (2 if on_host else 0)


@pytest.mark.parametrize("on_host", [False, True])
def test_controls_end_with_the_physics_and_the_host_is_asked_once_per_call(on_host):
    env, calls, plans = fake_env(), [], []

    def advance(physics: Any, ctrl: Any, num_ctrl: Any) -> Any:
        calls.append(np.shape(num_ctrl))
        return physics + num_ctrl

    def before(x: jax.Array) -> Any:
        states = jax.vmap(env.reset_to)(jnp.arange(3))
        return x, jax.vmap(env.plan)(states, jnp.full(3, 9000)), 2 * x

    def after(kept: jax.Array, plan: Any, physics: jax.Array) -> jax.Array:
        plans.append(plan)
        return kept + physics

    run = functools.partial(lambda physics, ctrl, num_ctrl: physics + num_ctrl)
    engine: Any = SimpleNamespace(run=run, advance=advance if on_host else None)
    compiled = make_stages(engine, before, after).compile(jnp.arange(3))
    np.testing.assert_array_equal(compiled(jnp.array([10, 20, 30])), [31, 61, 91])
    np.testing.assert_array_equal(compiled(jnp.array([0, 0, 1])), [1, 1, 4])
    assert calls == ([(3,)] * 2 if on_host else [])
    assert len(plans) == 1 and plans[0].ctrl is None and plans[0].num_ctrl.shape == (3,)
