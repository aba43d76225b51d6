"""Policies against brute force on the grid and hand-made worlds."""

from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from fake_env import ACTIONS, CLOSED, OPEN, UNREACHABLE_ROWS, FakeEnv, fake_env, hand_at, make_scenes

from pregrasp_jax.config import TaskConfig
from pregrasp_jax.policies import scripts
from pregrasp_jax.policies.learned import best_reachable, make_learned
from pregrasp_jax.spaces import grid
from pregrasp_jax.task.rules import TARGET_IN_REGION
from pregrasp_jax.types import REASONS, EnvState, GraspResult, Observation

ENV = fake_env()


def _state(p1: tuple[float, float], target: tuple[float, float]) -> EnvState:
    state = ENV.reset_to(0)
    # Every other object sits elsewhere: a policy that aims at the wrong slot is caught.
    centroids = jnp.full((8, 3), -0.2).at[state.scene.target, :2].set(jnp.array(target))
    return _moved(state, p1).replace(centroids=centroids)


def _moved(state: EnvState, xy: tuple[float, float]) -> EnvState:
    return state.replace(obs=state.obs.replace(hand=hand_at(xy)))


def _end(action: jax.Array) -> tuple[np.ndarray, int]:
    xy, choice = ACTIONS.decode(action)
    return np.asarray(xy), int(choice)


def test_straight_ends_on_a_target_in_reach(key: jax.Array) -> None:
    # Neither on the diagonal nor at the centre: swapped rows and columns miss it.
    end, aperture = _end(scripts.make_straight(ENV)(_state((-0.1, -0.1), (-0.0525, 0.0125)), key))
    np.testing.assert_allclose(end, [-0.0525, 0.0125], atol=1e-6)
    assert aperture == OPEN


@pytest.mark.parametrize("target", [(0.15, 0.02), (0.0, -0.22), (-0.22, 0.1), (-0.295, 0.01), (-0.2, -0.01)])
@pytest.mark.parametrize("p1", [(-0.3, 0.0), (-0.1975, 0.0525)])
def test_straight_ends_in_the_half_ring_nearest_to_the_target(
    p1: tuple[float, float], target: tuple[float, float], key: jax.Array
) -> None:
    end, _ = _end(scripts.make_straight(ENV)(_state(p1, target), key))
    axis = -0.25 + 0.005 * (np.arange(100) + 0.5)
    cells = np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2)
    radius = np.linalg.norm(cells - p1, axis=1)
    ring = cells[(radius >= 0.04 - 1e-6) & (radius <= 0.2 + 1e-6) & (cells[:, 0] >= p1[0] - 1e-6)]
    best = np.linalg.norm(ring - target, axis=1).min()
    assert np.linalg.norm(end - target) == pytest.approx(best, abs=1e-5)
    assert np.linalg.norm(ring - end, axis=1).min() < 1e-5


@pytest.mark.parametrize(("distance", "aperture"), [(0.129, OPEN), (0.131, CLOSED), (0.05, OPEN), (0.3, CLOSED)])
def test_clear_opens_near_the_target(distance: float, aperture: int, key: jax.Array) -> None:
    direction = np.array([0.6, 0.8])
    p1 = (-0.1, -0.1)
    target = tuple(float(x) for x in np.asarray(p1) + distance * direction)
    state = _state(p1, (target[0], target[1]))
    end, chosen = _end(scripts.make_clear(ENV)(state, key))
    assert chosen == aperture
    np.testing.assert_allclose(end, _end(scripts.make_straight(ENV)(state, key))[0])


def test_random_is_uniform_in_the_half_ring(key: jax.Array) -> None:
    state = _state((-0.1, 0.0), (0.1, 0.1))
    keys = jax.random.split(key, 600)
    actions = jax.jit(jax.vmap(scripts.make_random(ENV), (None, 0)))(state, keys)
    row, col, aperture = (np.asarray(x) for x in ACTIONS.unravel(actions))
    mask = np.asarray(ENV.action_mask(state.hand))[..., OPEN]
    assert mask[row, col].all()
    assert abs(aperture.mean() - 0.5) < 0.07
    # Uniform over cells, not over radius or angle: a cell's expected position is the mask's centroid.
    expected = np.argwhere(mask).mean(axis=0)
    np.testing.assert_allclose([row.mean(), col.mean()], expected, atol=3.0)
    assert len(set(zip(row, col, strict=True))) > 400


def test_guided_heads_for_the_target(key: jax.Array) -> None:
    state = _state((-0.1, 0.0), (0.0, 0.1))
    actions = jax.jit(jax.vmap(scripts.make_guided(ENV), (None, 0)))(state, jax.random.split(key, 500))
    end, aperture = ACTIONS.decode(actions)
    offset = np.asarray(end) - np.array([-0.1, 0.0])
    angle = np.arctan2(offset[:, 1], offset[:, 0])
    assert angle.mean() == pytest.approx(np.pi / 4, abs=0.1)
    assert float(aperture.mean()) == pytest.approx(0.7, abs=0.07)


def test_learned_takes_the_best_allowed_pixel(key: jax.Array) -> None:
    state = _state((-0.1, 0.0), (0.0, 0.1))
    inside, outside = grid.world_to_cell(jnp.array([[0.0, 0.0], [-0.2, 0.0]])), (7, 93)
    rows, cols = inside
    q = jnp.full((100, 100, 2), -5.0)
    q = q.at[rows[1], cols[1], 1].set(9.0).at[outside[0], outside[1], 0].set(8.0)
    q = q.at[rows[0], cols[0], 1].set(-1.0).at[rows[0], cols[0], 0].set(-2.0)
    make = make_learned(ENV, lambda params, obs, target: params)
    chosen = make(q)(state, key)
    assert chosen == ACTIONS.encode(rows[0], cols[0], jnp.int32(OPEN))


@pytest.mark.parametrize("p1", [(-0.1, -0.2), (-0.2, 0.0)])
def test_the_best_reachable_push_is_the_first_of_the_best_that_the_arm_can_make(
    p1: tuple[float, float], key: jax.Array
) -> None:
    """Against a loop; values fall toward larger y, so that the best ones are where the fake arm cannot go."""
    state = _state(p1, (0.0, 0.1))
    noise = np.random.default_rng(0).uniform(size=(100, 100, 2))
    q = 0.3 * noise - np.arange(100)[:, None, None]
    mask = np.asarray(ENV.action_mask(state.hand))
    left, wanted = mask.copy(), -1
    while wanted < 0:
        row, col, choice = np.unravel_index(np.argmax(np.where(left, q, -np.inf)), q.shape)
        if row >= UNREACHABLE_ROWS:
            wanted = int(ACTIONS.encode(row, col, choice))
        near = np.hypot(np.arange(100)[:, None] - row, np.arange(100)[None] - col) < 4
        left[..., choice] &= ~near
    q = jnp.asarray(q, jnp.float32)
    best, reached = (make_learned(ENV, lambda params, *_: params, reachable=r)(q)(state, key) for r in (False, True))
    assert reached == wanted
    assert (best == wanted) == (p1[1] == 0.0), "only near the border is the best one out of reach"


def test_the_best_push_is_taken_where_none_is_reachable(key: jax.Array) -> None:
    state = _state((-0.1, -0.2475), (0.0, 0.1))
    q = jnp.zeros((100, 100, 2)).at[0, 40, 1].set(1.0)
    mask = ENV.action_mask(state.hand) & (jnp.arange(100) < UNREACHABLE_ROWS)[:, None, None]
    assert best_reachable(ENV, state, q, mask) == ACTIONS.encode(0, 40, jnp.int32(OPEN))


def test_learned_sees_its_own_target(key: jax.Array) -> None:
    cell = grid.world_to_cell(jnp.array([0.0, 0.0]))
    state = _state((-0.1, 0.0), (0.0, 0.1))

    def q_values(params: jax.Array, obs: Observation, target: jax.Array) -> jax.Array:
        del obs
        wanted = jnp.zeros((100, 100, 2)).at[cell[0], cell[1], 0].set(1.0)
        return params * wanted * (target == state.scene.target)

    action = make_learned(ENV, q_values)(jnp.float32(1.0))(state, key)
    assert action == ACTIONS.encode(*cell, jnp.int32(CLOSED))


def test_policies_of_one_constructor_share_their_compilation(key: jax.Array) -> None:
    traces = []

    def q_values(params: jax.Array, obs: Observation, target: jax.Array) -> jax.Array:
        del target
        traces.append(1)
        return params * jnp.ones((*obs.height.shape, 2))

    make = make_learned(ENV, q_values)
    decide = jax.jit(lambda policy, state, key: policy(state, key))
    for scale in (1.0, 2.0, 3.0):
        decide(make(jnp.float32(scale)), ENV.reset_to(0), key)
    assert len(traces) == 1


def _world(xy: list[tuple[float, float]]) -> Any:
    scenes = make_scenes(1)
    scenes.xy[0, :3] = xy
    scenes.target[0] = 1
    return fake_env(scenes=scenes, task=TaskConfig(r_out=0.15))


def test_lookahead_succeeds_where_straight_encloses_the_obstacle(key: jax.Array) -> None:
    # The obstacle sits exactly where the first straight push ends.
    env = _world([(-0.1525, 0.0025), (0.0, 0.0), (0.2, 0.2)])
    state, result = env.step(env.reset_to(0), scripts.make_straight(env)(env.reset_to(0), key))
    assert REASONS[int(result.reason)] == "obstacle_in_region"
    lookahead, step = jax.jit(scripts.make_lookahead(env)), jax.jit(env.step)
    for episode in range(5):
        state = env.reset_to(0)
        for push in range(3):
            state, result = step(state, lookahead(state, jax.random.key(10 * episode + push)))
            if result.terminated:
                break
        assert int(result.reason) == TARGET_IN_REGION


def test_lookahead_never_takes_a_failure_if_a_candidate_survives(key: jax.Array) -> None:
    env = _world([(-0.2, 0.2), (0.24, -0.24), (0.2, 0.2)])
    # Near the lower edge a large share of the half ring is out of reach, and the target attracts there.
    state = _moved(env.reset_to(0), (0.05, -0.2025))
    choose = jax.jit(jax.vmap(scripts.make_lookahead(env), (None, 0)))
    rows, _, _ = ACTIONS.unravel(choose(state, jax.random.split(key, 6)))
    assert (rows >= UNREACHABLE_ROWS).all()
    guided, _, _ = ACTIONS.unravel(jax.vmap(scripts.make_guided(env), (None, 0))(state, jax.random.split(key, 50)))
    assert (guided < UNREACHABLE_ROWS).any(), "the test must offer failures"


def test_lookahead_ranks_success_then_distance_then_failure() -> None:
    env = _world([(-0.1525, 0.0025), (-0.2025, 0.0525), (0.2, 0.2)])
    pushes = [
        ((-0.2025, 0.0525), OPEN),  # encloses the target
        ((-0.2025, 0.0425), CLOSED),  # near
        ((-0.2025, -0.05), CLOSED),  # far
        ((-0.1525, 0.0025), OPEN),  # encloses the obstacle
    ]
    rows, cols = zip(*(grid.world_to_cell(jnp.array(xy)) for xy, _ in pushes), strict=True)
    actions = ACTIONS.encode(jnp.stack(rows), jnp.stack(cols), jnp.array([aperture for _, aperture in pushes]))
    plans = scripts._advance(env, scripts._start(env.reset_to(0), 4), actions)
    assert plans.ended.tolist() == [True, False, False, True]
    success, near, far, failure = plans.values.tolist()
    assert success > 0 > near > far > failure


@dataclass(frozen=True)
class _Slippery(FakeEnv):
    """Only an episode's second push leaves the target where it can be held."""

    def grasp(self, state: EnvState, *, execute: jax.Array | bool = True) -> GraspResult:
        return GraspResult((state.num_pushes == 2) & execute, jnp.bool_(False), jnp.int32(0), jnp.int32(0))


def test_lookahead_prefers_a_candidate_whose_grasp_holds(key: jax.Array) -> None:
    scenes = make_scenes(1)
    scenes.xy[0, :3], scenes.target[0] = [(0.2, -0.2), (-0.1525, 0.0025), (0.2, 0.2)], 1
    env: Any = _Slippery(scenes=scenes)
    state = env.reset_to(0)
    assert int(env.step(state, scripts.make_straight(env)(state, key))[1].reason) == TARGET_IN_REGION
    lookahead = jax.jit(scripts.make_lookahead(env))
    state, _ = env.step(state, lookahead(state, key))
    state, result = env.step(state, lookahead(state, key))
    assert int(result.reason) == TARGET_IN_REGION and env.grasp(state).held


def test_lookahead_tries_grasps_until_one_holds() -> None:
    # Even scenes hold; the first of them is not enclosed, the last is not reached.
    states = jax.vmap(ENV.reset_to)(jnp.array([2, 1, 4, 6]))
    enclosed = jnp.array([False, True, True, True])
    assert scripts._first_grasp(ENV, states, enclosed).tolist() == [False, False, True, False]
    assert not scripts._first_grasp(ENV, states, enclosed & False).any()


def test_lookahead_forgives_a_failing_continuation(key: jax.Array) -> None:
    # Whatever comes first, the straight push that follows it encloses the obstacle in front of the target.
    env = _world([(-0.1025, 0.0025), (0.0, 0.0025), (0.2, 0.2)])
    state = _moved(env.reset_to(0), (-0.2525, 0.0025))
    _, result = env.step(state, scripts.make_straight(env)(state, key))
    assert REASONS[int(result.reason)] == "obstacle_in_region"
    chosen = jax.jit(scripts.make_lookahead(env))(state, key)
    _, result = env.step(state, chosen)
    assert REASONS[int(result.reason)] == "running"


def test_every_script_runs_unbatched_under_jit(key: jax.Array) -> None:
    state = ENV.reset_to(3)
    for make in scripts.SCRIPTS.values():
        action = jax.jit(make(ENV))(state, key)
        row, col, _ = ACTIONS.unravel(action)
        assert action.dtype == jnp.int32 and action.shape == ()
        assert ENV.action_mask(state.hand)[row, col].all()
