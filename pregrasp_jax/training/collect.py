"""The actors: E scenes, each pushed once per call, by an epsilon-greedy policy.

`collect` touches neither replay nor learner. Its only input from learning is a set of parameters, so the
physics of the next push may run while the learner still digests the last one.
"""

import functools
from typing import Any, Protocol

import flax.struct as struct
import jax
import jax.numpy as jnp
import numpy as np

from pregrasp_jax.config import ExplorationConfig
from pregrasp_jax.learning.learner import Params, greedy_action
from pregrasp_jax.learning.q_function import QFunction
from pregrasp_jax.learning.records import Steps
from pregrasp_jax.physics.base import Engine
from pregrasp_jax.policies import exploration
from pregrasp_jax.task.primitive import Plan, Primitive
from pregrasp_jax.task.rules import Rules
from pregrasp_jax.task.stages import Stages, make_stages
from pregrasp_jax.training.mishap import Mishap, no_mishap
from pregrasp_jax.training.schedules import Pace
from pregrasp_jax.training.sharding import VmapFn
from pregrasp_jax.training.tally import Tally, new_tally
from pregrasp_jax.types import EnvState, HandPose, StepResult


class Environment(Protocol):
    """What training asks of `pregrasp_jax.task.env.Env`."""

    @property
    def engine(self) -> Engine:
        """Physics."""
        ...

    @property
    def primitive(self) -> Primitive:
        """What an action means."""
        ...

    @property
    def rules(self) -> Rules:
        """How pushes are judged."""
        ...

    def reset(self, key: jax.Array) -> EnvState:
        """Return a random scene."""
        ...

    def plan(self, state: EnvState, action: jax.Array) -> Plan:
        """Return the motion of a push."""
        ...

    def conclude(self, state: EnvState, plan: Plan, physics: Any) -> tuple[EnvState, StepResult]:
        """Look and judge after it."""
        ...

    def plan_trial(self, after: EnvState, result: StepResult) -> Plan:
        """Return the motion that tries to grasp what a push has enclosed."""
        ...

    def conclude_trial(self, after: EnvState, result: StepResult, physics: Any) -> StepResult:
        """Judge the push anew after it."""
        ...

    def action_mask(self, hand: HandPose) -> jax.Array:
        """Return which actions [H, W, K] bool are allowed next."""
        ...

    def eligible_slots(self, object_ids: jax.Array) -> jax.Array:
        """Return which slots [...] bool may be targets."""
        ...


class Actors(struct.PyTreeNode):
    """State of the actors.

    Attributes:
        env_states: of E scenes.
        key: PRNG key of actions and resets.
        tally: counts.
        mishap: the first push since the last report after which the physics made no sense.
    """

    env_states: EnvState
    key: jax.Array
    tally: Tally
    mishap: Mishap

    def begin_report(self) -> "Actors":
        """Return the actors with nothing counted or kept since the last report."""
        return self.replace(tally=self.tally.begin_report(), mishap=self.mishap.forget())


class Experience(struct.PyTreeNode):
    """What one push of every scene hands to the learner.

    Attributes:
        steps: one transition per scene, then those of the branches, each an episode of its own, cut short.
        eligible: [E (1 + branches), MAX_OBJECTS] bool, slots whose object may be a hindsight goal.
        episodes: () int32 ended ever, this push included.
    """

    steps: Steps
    eligible: jax.Array
    episodes: jax.Array


def init_actors(key: jax.Array, env: Environment, num_envs: int, *, vmap: VmapFn = jax.vmap) -> Actors:
    """Return `num_envs` scenes at the start of an episode; `vmap` is as in `make_collect`."""
    key, reset_key = jax.random.split(key)
    states = vmap(env.reset)(jax.random.split(reset_key, num_envs))
    return Actors(states, key, new_tally(num_envs), no_mishap(states))


def make_collect(
    env: Environment,
    q_function: QFunction,
    config: ExplorationConfig,
    *,
    warmup: int,
    try_grasps: bool = False,
    vmap: VmapFn = jax.vmap,
) -> Stages:
    """Return the function ``(actors, params, pace) -> (actors, experience)``: push everywhere, reset what has ended.

    Args:
        env: the scenes.
        q_function: values of pushes.
        config: exploration.
        warmup: env steps before the first update.
        try_grasps: grasp whatever has been enclosed; a target that slips is no success.
        vmap: maps pushes and resets over scenes.
    """

    def explore(key: jax.Array, state: EnvState, mask: jax.Array) -> jax.Array:
        actions = q_function.actions
        if not config.guided:
            valued = jnp.broadcast_to(q_function.domain_fn(state.hand)[..., None], actions.shape)
            return exploration.random_action(key, valued, actions)
        return exploration.guided_action(
            key,
            state.hand,
            state.target_xy,
            mask,
            actions,
            angle_std=config.angle_std,
            open_probability=config.open_probability,
        )

    def promising(key: jax.Array, q: jax.Array, mask: jax.Array) -> jax.Array:
        """Return the greedy action and what its branches try instead, [1 + branches]."""
        if config.branch_spacing:
            count = 1 + config.branches
            return exploration.best_apart(q, mask, q_function.actions, count=count, spacing=config.branch_spacing)
        draw = functools.partial(exploration.softmax_action, temperature=config.branch_temperature)
        drawn = jax.vmap(draw, (0, None, None))(jax.random.split(key, config.branches), q, mask)
        return jnp.concatenate([greedy_action(q, mask)[None], drawn])

    def act(key: jax.Array, state: EnvState, q: jax.Array, epsilon: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Return actions [1 + branches] of one scene, the real one first, and which of them are random."""
        mask = env.action_mask(state.hand)
        explore_key, choice_key, softmax_key = jax.random.split(key, 3)
        explore_keys = jax.random.split(explore_key, 1 + config.branches)
        exploratory = jax.vmap(explore, (0, None, None))(explore_keys, state, mask)
        random = jax.random.uniform(choice_key, exploratory.shape) < epsilon
        return jnp.where(random, exploratory, promising(softmax_key, q, mask)), random

    def decide(actors: Actors, params: Params, pace: Pace) -> tuple[Any, Plan, Any]:
        states = actors.env_states
        num_envs = states.num_pushes.shape[0]
        key, action_key, reset_key = jax.random.split(actors.key, 3)
        epsilon = epsilon_at(actors.tally.env_steps, config, warmup=warmup, decay=pace.epsilon_decay)
        q = q_function.apply(params, jax.vmap(q_function.input_fn)(states.obs, states.scene.target))
        keys = jax.random.split(action_key, num_envs)
        actions, random = jax.vmap(act, (0, 0, 0, None))(keys, states, q, epsilon)
        # Scenes first, then the branches: [E (1 + branches)].
        starts, actions = _with_branches(states, config), actions.T.ravel()
        plans = vmap(env.plan)(starts, actions)
        return starts.physics, plans, (actors.replace(key=key), actions, random[:, 0], reset_key)

    def pushed(kept: Any, plans: Plan, physics: Any) -> tuple[EnvState, StepResult]:
        return vmap(env.conclude)(_with_branches(kept[0].env_states, config), plans, physics)

    def conclude(kept: Any, plans: Plan, physics: Any) -> tuple[Actors, Experience]:
        return hand_over(kept, *pushed(kept, plans, physics))

    def try_grasp(kept: Any, plans: Plan, physics: Any) -> tuple[Any, Plan, Any]:
        ends, results = pushed(kept, plans, physics)
        return ends.physics, vmap(env.plan_trial)(ends, results), (kept, ends, results)

    def conclude_trial(tried: Any, plans: Plan, physics: Any) -> tuple[Actors, Experience]:
        del plans
        kept, ends, results = tried
        return hand_over(kept, ends, vmap(env.conclude_trial)(ends, results, physics))

    def hand_over(kept: Any, ends: EnvState, results: StepResult) -> tuple[Actors, Experience]:
        """Return the actors, anew where an episode has ended, and what the learner gets."""
        actors, actions, random, reset_key = kept
        states = actors.env_states
        num_envs = states.num_pushes.shape[0]
        starts = _with_branches(states, config)
        of_branch = jnp.arange(len(actions)) >= num_envs
        results = results.replace(truncated=results.truncated | (of_branch & ~results.terminated))
        root = jnp.arange(len(actions), dtype=jnp.int32) % num_envs
        steps = _steps(root, starts, actions, results, ends)
        experience = Experience(steps, env.eligible_slots(starts.scene.object_ids), jnp.int32(0))
        next_states, results = jax.tree.map(lambda leaf: leaf[:num_envs], (ends, results))
        ended = results.terminated | results.truncated
        overflowed = ends.physics_obs.overflows > starts.physics_obs.overflows
        diverged = steps.outcome.diverged
        tally = actors.tally.count(results, ended, random, overflowed, diverged)
        mishap = actors.mishap.note(states, actions, ends, diverged, tally.env_steps)
        fresh = vmap(env.reset)(jax.random.split(reset_key, num_envs))
        actors = Actors(_select(ended, fresh, next_states), actors.key, tally, mishap)
        return actors, experience.replace(episodes=tally.episodes)

    following = (try_grasp, conclude_trial) if try_grasps else (conclude,)
    return make_stages(env.engine, decide, *following, vmap=vmap)


def _with_branches(states: EnvState, config: ExplorationConfig) -> EnvState:
    """Return E scenes and their branches, [E (1 + branches)]."""
    return jax.tree.map(lambda leaf: jnp.concatenate([leaf] * (1 + config.branches)), states)


def epsilon_at(
    env_steps: jax.Array | int, config: ExplorationConfig, *, warmup: int, decay: jax.Array | np.floating | float
) -> jax.Array:
    """Return the share of random actions () after `env_steps` pushes; during the warm-up that of the start.

    Args:
        env_steps: so far.
        config: where it begins and ends.
        warmup: env steps before the first update.
        decay: env steps after which it stays, see `schedules`.
    """
    decayed = exploration.linear_schedule(env_steps, start=config.epsilon_start, end=config.epsilon_end, steps=decay)
    return jnp.where(env_steps < warmup, config.epsilon_start, decayed)


def _steps(root: jax.Array, states: EnvState, actions: jax.Array, results: StepResult, next_states: EnvState) -> Steps:
    return Steps(
        root=root,
        obs=states.obs,
        action=actions,
        goal=states.scene.target,
        outcome=results.outcome,
        reward=results.reward,
        terminated=results.terminated,
        reason=results.reason,
        truncated=results.truncated,
        next_obs=next_states.obs,
    )


def _select(ended: jax.Array, fresh: Any, going_on: Any) -> Any:
    """Return `fresh` where `ended` [E], for every leaf [E, ...]."""
    return jax.vmap(lambda e, a, b: jax.tree.map(lambda x, y: jnp.where(e, x, y), a, b))(ended, fresh, going_on)
