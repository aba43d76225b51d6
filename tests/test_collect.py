"""The actors in a world without physics: branches, grasps that are tried, resets, counts."""

import jax
import jax.numpy as jnp
import numpy as np
from fake_training import PictureEnv, make_config, make_program

from pregrasp_jax.config import Config
from pregrasp_jax.settings import to_dict
from pregrasp_jax.types import PUSH_REASONS


def test_branches_are_learned_from_and_change_nothing_else():
    """Three pushes from every state: the scenes go on from the first, the others are episodes cut short."""
    values = to_dict(make_config())
    values["exploration"] |= {"branches": 2, "epsilon_start": 0.5}
    values["replay"] |= {"capacity": 300}
    built = make_program(Config.from_dict(values))
    state = jax.jit(built.init)(jax.random.key(0))
    collect_once, remember = jax.jit(built.collect), jax.jit(built.remember)
    params, branch_actions = state.learning.learner.params, []
    for step in range(1, 9):
        before = state.actors
        actors, experience = collect_once(before, params, built.pace)
        learning = remember(state.learning, experience)
        state = state.replace(actors=actors, learning=learning)
        steps = experience.steps
        assert steps.action.shape == (9,) and int(actors.tally.env_steps) == 3 * step
        for branch in range(3):
            of_branch = slice(3 * branch, 3 * branch + 3)
            np.testing.assert_array_equal(steps.obs.height[of_branch], before.env_states.obs.height)
            np.testing.assert_array_equal(steps.goal[of_branch], before.env_states.scene.target)
        ended = np.asarray(steps.terminated | steps.truncated)
        assert ended[3:].all() and not np.any(steps.terminated & steps.truncated)
        going_on = ~ended[:3]
        np.testing.assert_array_equal(
            np.asarray(actors.env_states.obs.height)[going_on], np.asarray(steps.next_obs.height)[:3][going_on]
        )
        branch_actions.append(np.asarray(steps.action).reshape(3, 3))
        memory = learning.replay
        assert int(memory.rows_written) == 9 * step + int(memory.hindsight_rows_written)
        # The state before a push is stored once, for its three pushes and the one before.
        assert int(memory.observations_written) == 9 * step + 3 + int(actors.tally.episodes) - int(ended[:3].sum())
        slots = np.asarray(memory.episodes.rows)[:, 0]
        stored = np.asarray(memory.observations.height)[np.asarray(memory.rows.obs_slot)[slots[3:]]]
        np.testing.assert_array_equal(stored, steps.obs.height[3:])
    different = [len(set(actions)) for actions in np.concatenate(branch_actions, axis=1).T]
    assert np.mean(different) > 2.5, "branches of one state are drawn independently"


def test_a_grasp_that_is_tried_ends_the_same_episodes_and_pays_only_for_what_holds(monkeypatch):
    """In the fake world the scenes of odd index drop what is grasped; here with a wide closing region."""
    monkeypatch.setattr("fake_env.IN_REGION", 0.06)
    experiences = []
    for try_grasps in (False, True):
        config = make_config(try_grasps=try_grasps)
        values = to_dict(config)
        values["exploration"] |= {"branches": 2, "epsilon_start": 0.5}
        values["replay"] |= {"capacity": 300}
        built = make_program(Config.from_dict(values))
        state = jax.jit(built.init)(jax.random.key(0))
        collect_once, actors, seen = jax.jit(built.collect), state.actors, []
        for _ in range(40):
            odd = np.tile(np.asarray(actors.env_states.scene_index) % 2 == 1, 3)
            actors, experience = collect_once(actors, state.learning.learner.params, built.pace)
            seen.append((odd, jax.device_get(experience.steps)))
        experiences.append(seen)
        counts = actors.tally.metrics(built.successes)
        assert (counts["reasons/grasp_failed"] > 0) == try_grasps
    success, dropped = PUSH_REASONS.index("target_in_region"), PUSH_REASONS.index("grasp_failed")
    slips = 0
    for (odd, untried), (_, tried) in zip(*experiences, strict=True):
        np.testing.assert_array_equal(tried.action, untried.action)
        np.testing.assert_array_equal(tried.terminated, untried.terminated)
        slipped = odd & (untried.reason == success)
        np.testing.assert_array_equal(tried.reason, np.where(slipped, dropped, untried.reason))
        np.testing.assert_array_equal(tried.reward, np.where(slipped, 0.0, untried.reward))
        slips += slipped.sum()
    assert slips > 3


def test_a_scene_that_ended_starts_anew_and_the_others_go_on():
    config = make_config()
    env = PictureEnv()
    built = make_program(config)
    actors = built.init(jax.random.key(3)).actors
    params = built.shapes().learning.learner.params
    collect_fn, params = jax.jit(built.collect), jax.tree.map(lambda s: jnp.zeros(s.shape, s.dtype), params)
    for _ in range(12):
        before = actors
        actors, experience = collect_fn(actors, params, built.pace)
        steps = experience.steps
        ended = np.asarray(steps.terminated | steps.truncated)
        pushed, _ = jax.vmap(env.step)(before.env_states, steps.action)
        np.testing.assert_array_equal(steps.obs.height, before.env_states.obs.height)
        np.testing.assert_array_equal(steps.next_obs.height, pushed.obs.height)
        now = np.asarray(actors.env_states.num_pushes)
        np.testing.assert_array_equal(now, np.where(ended, 0, np.asarray(pushed.num_pushes)))
        eligible = np.isin(np.asarray(before.env_states.scene.object_ids), [0, 1])
        np.testing.assert_array_equal(experience.eligible, eligible)
