"""Every stored byte of these transitions encodes which push it belongs to, so a misaligned field cannot hide."""

import functools
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from fake_env import ACTIONS
from replay_world import (
    ALL_ELIGIBLE,
    MAX_PUSHES,
    NUM_ENVS,
    RULES,
    World,
    add,
    add_hindsight,
    alive_rows,
    decode_input,
    empty,
    fill,
    image,
    read_image,
    sample,
    set_priorities,
)

from pregrasp_jax.learning import hindsight, replay
from pregrasp_jax.types import MAX_OBJECTS, REASONS


def test_each_observation_is_stored_once():
    world = World(0)
    memory = fill(world, empty(capacity=1000), 40)
    written = int(memory.observations_written)
    stored = read_image(memory.observations)[:written]
    assert sorted(stored) == sorted(set(stored))
    expected = {row["obs"] for row in world.transitions} | {row["next_obs"] for row in world.transitions}
    assert set(stored) == expected


@pytest.mark.parametrize("capacity", [30, 37, 64, 200])
def test_alive_rows_are_exactly_those_whose_observations_are_both_kept(capacity):
    """Against a Python memory that forgets by number, over many wraps of both rings."""
    world = World(1)
    memory = empty(capacity)
    order: list[int] = []
    fresh = [True] * NUM_ENVS
    for _ in range(120):
        steps = world.step()
        new = world.transitions[-NUM_ENVS:]
        order += [row["obs"] for row, is_fresh in zip(new, fresh, strict=True) if is_fresh]
        order += [row["next_obs"] for row in new]
        fresh = [row["terminated"] or row["truncated"] for row in new]
        memory = add(memory, steps)
    kept = set(order[-capacity:])
    expected = sorted(
        (row["obs"], row["next_obs"], row["goal"], row["action"], row["reward"], row["terminated"], False)
        for row in world.transitions
        if row["obs"] in kept and row["next_obs"] in kept
    )
    assert sorted(alive_rows(memory)) == expected
    assert int(memory.observations_written) == len(order) > 2 * capacity
    assert set(read_image(memory.observations)) == kept


@pytest.mark.parametrize("capacity", [30, 37, 64])
def test_hindsight_rows_stay_aligned_and_die_with_their_observations(capacity):
    world = World(2, enclose=0.5)
    memory = fill(world, empty(capacity), 150)
    kept = set(read_image(memory.observations))
    rows = alive_rows(memory)
    by_obs = {row["obs"]: row for row in world.transitions}
    assert sum(row[-1] for row in rows) > 5
    for obs, next_obs, goal, action, reward, terminated, is_hindsight in rows:
        origin = by_obs[obs]
        assert next_obs == origin["next_obs"] and action == origin["action"]
        assert obs in kept and next_obs in kept
        if is_hindsight:
            # Distances grow by whole metres here, so the only reward is the end's.
            assert goal >= 3 and reward == (2.0 if terminated else 0.0)
            assert terminated == (origin["coverage"][goal] > 0.95)
        else:
            assert (goal, reward, terminated) == (origin["goal"], origin["reward"], origin["terminated"])
    real = {row[0] for row in rows if not row[-1]}
    assert real == {row["obs"] for row in world.transitions if row["obs"] in kept and row["next_obs"] in kept}


@pytest.mark.parametrize("seed", range(3))
def test_what_refers_to_lost_observations_is_forgotten_now_and_later(seed):
    """An episode under way keeps nothing of what is lost, also when hindsight relabels it at its end."""
    world = World(seed, enclose=0.5)
    memory = fill(world, empty(64), 50)
    numbers = read_image(memory.observations)
    lost = np.zeros(64, bool)
    lost[np.random.default_rng(seed).choice(64, 20, replace=False)] = True
    lost[int(memory.episodes.obs_slot[0])] = True
    gone = set(numbers[lost])
    expected = [row for row in alive_rows(memory) if not gone & set(row[:2])]
    memory = replay.forget(memory, jnp.asarray(lost))
    assert alive_rows(memory) == expected and len(expected) > 5
    memory = fill(world, memory, 6)
    before = len(world.transitions) - 6 * NUM_ENVS
    rows = [row for row in alive_rows(memory) if not row[-1]]
    later = {row["obs"] for row in world.transitions[before:]}
    assert later <= {row[0] for row in rows}, "what comes afterwards is all there"
    assert not gone & {row[0] for row in alive_rows(memory) if row[0] not in later}
    assert not gone & {row[1] for row in alive_rows(memory)}


def test_the_ring_of_rows_never_overwrites_a_row_that_is_alive():
    """At the smallest capacity, with most episodes relabelled: rows that die, die with an observation."""
    world = World(3, enclose=0.6)
    memory = empty(capacity=30)
    for _ in range(200):
        before, first = jax.tree.map(np.array, memory), int(memory.observations_written)
        memory = add(memory, world.step())
        overwritten = np.arange(first, int(memory.observations_written)) % 30
        stale = np.isin(before.rows.obs_slot, overwritten) | np.isin(before.rows.next_obs_slot, overwritten)
        survivors = (before.priorities.leaves > 0) & ~stale
        memory = add_hindsight(memory, ALL_ELIGIBLE)
        for old, new in zip(jax.tree.leaves(before.rows), jax.tree.leaves(memory.rows), strict=True):
            np.testing.assert_array_equal(old[survivors], np.asarray(new)[survivors])
    assert int(memory.rows_written) > 3 * memory.priorities.capacity


def test_sampled_batches_are_aligned_after_wrap_around(key):
    world = World(4, enclose=0.4)
    memory = fill(world, empty(), 100)
    by_obs = {row["obs"]: row for row in world.transitions}
    for k in jax.random.split(key, 5):
        batch = sample(memory, k, importance_exponent=0.4)
        obs, goal = decode_input(batch.inputs)
        next_obs, next_goal = decode_input(batch.next_inputs)
        np.testing.assert_array_equal(goal, next_goal)
        np.testing.assert_array_equal(goal, np.asarray(memory.rows.goal)[batch.rows[:, 0]])
        for i, obs_id in enumerate(obs):
            origin = by_obs[obs_id]
            assert next_obs[i] == origin["next_obs"] and int(batch.action[i, 0]) == origin["action"]
            if not batch.hindsight[i]:
                assert (goal[i], float(batch.reward[i, 0])) == (origin["goal"], origin["reward"])
                assert bool(batch.terminated[i, 0]) == origin["terminated"]
                assert int(batch.reason[i, 0]) == origin["reason"]
            elif batch.terminated[i, 0]:
                assert REASONS[int(batch.reason[i, 0])] == "target_in_region"
        np.testing.assert_array_equal(batch.next_hand.xy, np.stack([next_obs, -next_obs], axis=-1))


def test_truncated_rows_bootstrap():
    world = World(5, enclose=0.0)
    memory = fill(world, empty(capacity=100), MAX_PUSHES)
    assert all(row["truncated"] for row in world.transitions[-NUM_ENVS:])
    assert not np.any(memory.rows.terminated)
    assert np.all(memory.episodes.ended) and np.all(np.asarray(memory.episodes.length) == MAX_PUSHES)


def test_priorities_new_rows_get_the_largest_and_exponent_applies(key):
    memory = fill(World(6), empty(capacity=100), 4, relabel=False)
    np.testing.assert_array_equal(memory.priorities.leaves[:12], np.ones(12))
    memory = set_priorities(memory, jnp.array([0, 1, 2]), jnp.array([-2.0, 0.0, 0.5]))
    expected = (np.array([2.0, 0.0, 0.5]) + replay.MIN_TD_ERROR) ** 0.6
    np.testing.assert_allclose(memory.priorities.leaves[:3], expected, rtol=1e-6)
    memory = fill(World(7), memory, 1, relabel=False)
    np.testing.assert_allclose(memory.priorities.leaves[12:15], expected.max(), rtol=1e-6)
    assert int(memory.num_alive) == 15


def test_sampling_follows_priorities_and_weights_undo_it(key):
    memory = fill(World(8), empty(capacity=100), 4, relabel=False)
    errors = jnp.linspace(0.1, 3.0, 12)
    memory = set_priorities(memory, jnp.arange(12), errors)
    batches = [sample(memory, k, importance_exponent=0.7) for k in jax.random.split(key, 60)]
    drawn = np.concatenate([batch.rows[:, 0] for batch in batches])
    priority = (np.asarray(errors) + replay.MIN_TD_ERROR) ** 0.6
    probability = priority / priority.sum()
    np.testing.assert_allclose(np.bincount(drawn, minlength=12) / len(drawn), probability, atol=0.02)
    weights = (1 / (12 * probability)) ** 0.7
    for batch in batches[:5]:
        expected = weights[batch.rows[:, 0]] / weights[batch.rows].max()
        np.testing.assert_allclose(batch.importance_weights, expected, rtol=1e-5)
        assert float(batch.importance_weights.max()) == 1.0


def test_dead_rows_stay_dead():
    memory = fill(World(9), empty(capacity=30), 60)
    dead = np.flatnonzero(np.asarray(memory.priorities.leaves) == 0)[:4]
    after = set_priorities(memory, jnp.asarray(dead), jnp.full(4, 9.0))
    np.testing.assert_array_equal(after.priorities.leaves, memory.priorities.leaves)


def test_a_diverged_push_is_recorded_but_never_sampled(key):
    steps = World(10, enclose=0.0).step()
    diverged = jnp.array([False, True, False])
    steps = steps.replace(outcome=steps.outcome.replace(diverged=diverged), terminated=diverged)
    memory = add(empty(capacity=30), steps)
    np.testing.assert_array_equal(memory.priorities.leaves[:4], [1, 0, 1, 0])
    assert set(np.asarray(sample(memory, key, importance_exponent=1.0).rows).ravel()) == {0, 2}


def test_counters():
    world = World(13, enclose=0.5)
    memory = fill(world, empty(capacity=1000), 30)
    rows = alive_rows(memory)
    assert int(memory.num_alive) == int(memory.rows_written) == len(rows)
    assert int(memory.hindsight_rows_written) == sum(row[-1] for row in rows) == len(rows) - 30 * NUM_ENVS > 0


def test_donated_memory_is_updated_in_place():
    memory = empty(capacity=2000)
    pointers = [leaf.unsafe_buffer_pointer() for leaf in jax.tree.leaves(memory.observations)]
    memory = fill(World(11), memory, 3)
    assert [leaf.unsafe_buffer_pointer() for leaf in jax.tree.leaves(memory.observations)] == pointers


def test_one_trace():
    traces = []

    @jax.jit
    def counted(memory, steps):
        traces.append(1)
        return hindsight.add_hindsight(replay.add(memory, steps), ALL_ELIGIBLE, RULES)

    world, memory = World(12), empty()
    for _ in range(5):
        memory = counted(memory, world.step())
    assert len(traces) == 1


def test_a_capacity_that_an_episode_could_outlive_is_refused():
    smallest = 2 * NUM_ENVS * (MAX_PUSHES + 1)
    empty(smallest)
    with pytest.raises(ValueError, match=f"replay capacity = {smallest - 1} .* allowed is {smallest} or more"):
        empty(smallest - 1)
    shapes = jax.eval_shape(World(0).step)
    assert replay.init(shapes, capacity=smallest, max_pushes=MAX_PUSHES).observations.height.shape == (smallest, 1, 2)


def branched(world: World, branches: int, diverged: bool = False) -> replay.Steps:
    """One push of every scene and its branches: other actions, rewards and ends from the same observations."""
    steps = world.step()
    rows = [steps]
    for k in range(1, branches + 1):
        ends = np.array([world.new_id() for _ in range(NUM_ENVS)])
        gone = jnp.full(NUM_ENVS, diverged and k == branches)
        rows.append(
            steps.replace(
                action=steps.action + k,
                reward=steps.reward + 1000 * k,
                terminated=jnp.full(NUM_ENVS, k == 1),
                truncated=jnp.full(NUM_ENVS, k != 1),
                next_obs=image(ends),
                outcome=steps.outcome.replace(diverged=gone),
            )
        )
    return jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *rows)


def with_siblings(branches: int, steps: int, *, diverged: bool = False) -> replay.Replay:
    world, width = World(3, enclose=0.3), branches + 1
    first = branched(World(0), branches)
    memory = replay.init(first, capacity=120, max_pushes=MAX_PUSHES, num_siblings=width)
    for _ in range(steps):
        memory = add(memory, branched(world, branches, diverged))
        memory = add_hindsight(memory, jnp.ones((NUM_ENVS * width, MAX_OBJECTS), bool))
    return memory


@pytest.mark.parametrize("steps", [3, 40])
def test_siblings_are_the_pushes_from_the_same_observation(key, steps):
    memory = with_siblings(2, steps)
    batch = sample(memory, key, importance_exponent=0.5)
    obs, _ = decode_input(batch.inputs)
    rows, hidden = np.asarray(batch.rows), np.asarray(batch.hindsight)
    assert (~hidden).sum() > 10
    for i in range(len(obs)):
        same = np.asarray(memory.rows.obs_slot)[rows[i][rows[i] >= 0]]
        np.testing.assert_array_equal(same, same[0])
        if hidden[i]:
            np.testing.assert_array_equal(rows[i] >= 0, [True, False, False])
            assert batch.drawn[i, 0]
            continue
        assert np.asarray(batch.drawn[i]).sum() == 1
        np.testing.assert_array_equal(batch.action[i], obs[i] % math.prod(ACTIONS.shape) + np.arange(3))
        np.testing.assert_array_equal(batch.reward[i], obs[i] / 2 + 1000 * np.arange(3))
        np.testing.assert_array_equal(np.asarray(batch.terminated[i])[1:], [True, False])
        assert batch.next_values[i, 1] == 0.0 and batch.next_values[i, 2] == replay.UNKNOWN


def test_a_sibling_that_diverged_is_left_out(key):
    batch = sample(with_siblings(2, 3, diverged=True), key, importance_exponent=0.5)
    real = ~np.asarray(batch.hindsight)
    assert (np.asarray(batch.rows)[real, 2] == -1).all() and (np.asarray(batch.rows)[real, 1] >= 0).all()


def test_what_is_known_after_an_update_stays_with_the_rows(key):
    memory = with_siblings(2, 3)
    batch = sample(memory, key, importance_exponent=0.5)
    values = jnp.where(batch.drawn, 100.0 + batch.rows, batch.next_values)
    errors = jnp.where(values > replay.UNKNOWN, 2.0, 77.0)
    after = jax.jit(functools.partial(replay.learned, priority_exponent=1.0))(memory, batch, errors, values)
    drawn = np.unique(np.asarray(batch.rows)[np.asarray(batch.drawn)])
    others = np.setdiff1d(np.arange(len(memory.rows.next_value)), drawn)
    np.testing.assert_array_equal(after.rows.next_value[drawn], 100.0 + drawn)
    np.testing.assert_array_equal(after.rows.next_value[others], memory.rows.next_value[others])
    known = np.unique(np.asarray(batch.rows)[np.asarray((values > replay.UNKNOWN) & (batch.rows >= 0))])
    np.testing.assert_allclose(after.priorities.leaves[known], 2.0 + replay.MIN_TD_ERROR)
    rest = np.setdiff1d(np.arange(len(memory.rows.next_value)), known)
    np.testing.assert_array_equal(after.priorities.leaves[rest], memory.priorities.leaves[rest])


def test_a_row_that_was_drawn_twice_keeps_the_value_that_one_of_them_got(key):
    memory = with_siblings(2, 3)
    batch = sample(memory, key, importance_exponent=0.5)
    twice = jax.tree.map(lambda leaf: jnp.concatenate([leaf[:1], leaf[:1]]), batch)
    for valued in (0, 1):
        values = jnp.where(twice.drawn & (jnp.arange(2) == valued)[:, None], 5.0, twice.next_values)
        after = replay.learned(memory, twice, jnp.zeros_like(values), values, priority_exponent=1.0)
        assert float(after.rows.next_value[batch.rows[0][batch.drawn[0]][0]]) == 5.0


def test_a_state_is_weighed_by_how_often_any_of_its_pushes_is_drawn(key):
    memory = with_siblings(2, 2)
    memory = set_priorities(memory, jnp.arange(18), jnp.linspace(0.1, 3.0, 18))
    batches = [sample(memory, k, importance_exponent=1.0) for k in jax.random.split(key, 40)]
    first = np.concatenate([batch.rows[:, 0] for batch in batches])
    weights = np.concatenate([batch.importance_weights for batch in batches])
    for batch in batches[:1]:
        assert float(batch.importance_weights.max()) == 1.0
    states, counts = np.unique(first, return_counts=True)
    mean = np.array([weights[first == state].mean() for state in states])
    # Rare states weigh more, in proportion: each counts as much as the others in the end.
    np.testing.assert_allclose(counts * mean / (counts * mean).mean(), 1.0, atol=0.15)
