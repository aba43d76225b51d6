"""Pushes of rebuilt scenes, a batch of one size at a time: simulate, judge by the task's rules, ask the network."""

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from pregrasp_jax.learning.q_function import QFunction
from pregrasp_jax.physics.native import engine_of
from pregrasp_jax.planning.simulation import Simulations
from pregrasp_jax.policies import exploration, scripts
from pregrasp_jax.task import registry
from pregrasp_jax.task.env import Env
from pregrasp_jax.task.grasp import TRIAL_HOLD
from pregrasp_jax.task.primitive import Plan
from pregrasp_jax.task.stages import Stages, make_stages
from pregrasp_jax.types import EnvState, GraspResult, HandPose, HullBank, Observation, SceneParams, StepResult

NUM_SCRIPTED = 8
"""Pushes that scripts propose: `straight`, `clear`, and as many guided as uniform ones."""

NUM_NEXT, _APART = 3, 0.02
"""Pushes that the network proposes after a simulated one, and how far apart they are, m."""

_MOVED, _EDGE = 0.005, 0.02
"""m; an object that moved more than this and ended nearer to an edge than that may have fallen in truth: where objects
end is known to 1 to 5 cm only after a long way."""


class Pushed(NamedTuple):
    """What pushes [B] of rebuilt scenes did.

    Attributes:
        states: where they led.
        results: what the rules say.
        safety: [B] how likely nothing else has left the workspace than what has left here.
    """

    states: EnvState
    results: StepResult
    safety: jax.Array


class Proposed(NamedTuple):
    """What the network says of N scenes.

    Attributes:
        values: [N] of its best push.
        actions: [N, NUM_NEXT] int32, that push and others.
    """

    values: np.ndarray
    actions: np.ndarray


class Rollout:
    """Compiled programs of one environment and one network; shapes never change."""

    def __init__(
        self, env: Env, simulations: Simulations, q_function: QFunction, params: Any, *, networks: int, batch: int
    ):
        """Compile nothing yet.

        Args:
            env: of the task; objects, scenes and engine of it are not used.
            simulations: of rebuilt objects.
            q_function: of the policy.
            params: of the policy.
            networks: of its networks that value what pushes lead to, the first ones; without mirror images, too: half
                the time, as many successes.
            batch: pushes at a time.
        """
        self.batch = batch
        self._env, self._params, self._q = env, params, q_function
        some, self._some_params = q_function.first(params, networks)
        self._continuing = dataclasses.replace(some, mirror_fn=None)
        self._engine = engine_of(simulations, env.robot)
        self._num_velocities = simulations.model.mj_model.nv
        self._start = jax.jit(jax.vmap(self._start_one, (None, 0, 0, 0, None, None)))
        self._script, self._values, self._ask = map(jax.jit, (self._script_one, self._values_one, self._ask_one))
        self._push = make_stages(self._engine, self._before_push, self._after_push)
        self._grasp = make_stages(self._engine, self._before_grasp, self._after_grasp)
        self._compiled: dict[str, Callable[..., Any]] = {}

    def start(
        self,
        bank: HullBank,
        object_ids: np.ndarray,
        poses: np.ndarray,
        qpos: np.ndarray,
        hand: HandPose,
        target: int,
    ) -> EnvState:
        """Return the states [V] of rebuilt scenes, on the host.

        Args:
            bank: the objects.
            object_ids: [V, MAX_OBJECTS] index into it, -1 for none.
            poses: [V, MAX_OBJECTS, 7] of the objects.
            qpos: [V, nq] of the objects and the robot.
            hand: where it has been sent.
            target: slot.
        """
        return jax.device_get(self._start(bank, object_ids, poses, qpos, hand, np.int32(target)))

    def values(self, obs: Observation, target: int) -> np.ndarray:
        """Return what the network says of every push after a real picture, [H, W, K]; -inf where it is not allowed."""
        return np.asarray(self._values(self._params, obs, np.int32(target)))

    def script(self, roots: EnvState, key: jax.Array) -> list[int]:
        """Return the pushes of scripts in the first of rebuilt scenes [V]; `NUM_SCRIPTED` of them."""
        return np.asarray(self._script(jax.tree.map(lambda leaf: leaf[0], roots), key)).tolist()

    def propose(self, states: Sequence[EnvState]) -> Proposed:
        """Return what the network would push next in N >= 1 rebuilt scenes, as host arrays; no mirror images count."""
        found = [self._ask(self._some_params, state.obs, state.scene.target) for state in states]
        return Proposed(*(np.stack(parts) for parts in zip(*found, strict=True)))

    def succeeded(self, reason: jax.Array) -> np.ndarray:
        """Return which reasons [B] count as success, [B] bool."""
        return np.isin(np.asarray(reason), self._env.rules.successes)

    def push(self, bank: HullBank, states: EnvState, actions: np.ndarray, execute: np.ndarray) -> Pushed:
        """Push in B states; where not to be executed [B], nothing is simulated."""
        return self._run("push", self._push, bank, states, actions, execute)

    def grasp(self, bank: HullBank, states: EnvState, execute: np.ndarray) -> np.ndarray:
        """Return which grasps hold, [B] bool; those not to be executed [B] do not."""
        return np.asarray(self._run("grasp", self._grasp, bank, states, execute).held)

    def compile_grasp(self, bank: HullBank, roots: EnvState) -> None:
        """Compile grasps ahead of the first that is tried, which may be far into a trial; nothing is simulated."""
        states = jax.tree.map(lambda leaf: np.repeat(leaf[:1], self.batch, axis=0), roots)
        self.grasp(bank, states, np.zeros(self.batch, bool))

    def _run(self, name: str, stages: Stages, *args: Any) -> Any:
        if name not in self._compiled:
            self._compiled[name] = stages.compile(*args)
        return self._compiled[name](*args)

    def _rebuilt(self, bank: HullBank) -> Env:
        """Return the task with the objects of `bank`, which may be traced."""
        env = self._env
        kind = registry.get_kind(env.task.primitive)
        rules = kind.make_rules(env.robot, env.workspace, env.primitive, bank, env.task)
        return dataclasses.replace(env, bank=bank, rules=rules, engine=self._engine)

    def _start_one(
        self,
        bank: HullBank,
        object_ids: jax.Array,
        poses: jax.Array,
        qpos: jax.Array,
        hand: HandPose,
        target: jax.Array,
    ) -> EnvState:
        physics = self._engine.place(object_ids, qpos, jnp.zeros(self._num_velocities))
        blank = jnp.zeros(1)  # drawn and measured by `look`
        state = EnvState(
            physics=physics,
            scene=SceneParams(object_ids, poses, target),
            scene_index=jnp.int32(-1),
            physics_obs=self._engine.observe(physics),
            obs=Observation(blank, blank, hand),
            centroids=blank,
            num_pushes=jnp.int32(0),
        )
        return self._rebuilt(bank).look(state, hand)

    def _script_one(self, state: EnvState, key: jax.Array) -> jax.Array:
        env = self._env
        half = (NUM_SCRIPTED - 2) // 2
        keys = jax.random.split(key, 2 * half)
        guided = jax.vmap(scripts.make_guided(env), (None, 0))(state, keys[:half])
        uniform = jax.vmap(scripts.make_random(env), (None, 0))(state, keys[half:])
        ahead = jnp.stack([scripts.make_straight(env)(state, key), scripts.make_clear(env)(state, key)])
        return jnp.concatenate([ahead, guided, uniform])

    def _values_one(self, params: Any, obs: Observation, target: jax.Array) -> jax.Array:
        return jnp.where(self._env.action_mask(obs.hand), self._q.values(params, obs, target), -jnp.inf)

    def _ask_one(self, params: Any, obs: Observation, target: jax.Array) -> tuple[jax.Array, jax.Array]:
        q = jnp.where(self._env.action_mask(obs.hand), self._continuing.values(params, obs, target), -jnp.inf)
        return q.max(), self._next(q)

    def _before_push(
        self, bank: HullBank, states: EnvState, actions: jax.Array, execute: jax.Array
    ) -> tuple[Any, Plan, Any]:
        plan = jax.vmap(lambda s, a, go: self._env.plan(s, a).unless(~go, "no_ik"))(states, actions, execute)
        return states.physics, plan, (bank, states)

    def _after_push(self, kept: Any, plan: Plan, physics: Any) -> Pushed:
        bank, states = kept
        env = self._rebuilt(bank)
        before = states.centroids
        states, results = jax.vmap(env.conclude)(states, plan, physics)
        moved = jnp.linalg.norm(states.centroids - before, axis=-1) > _MOVED
        safety = jax.vmap(self._safety)(states.centroids, moved & (states.scene.object_ids >= 0), states.scene.target)
        return Pushed(states, results, safety)

    def _next(self, q: jax.Array) -> jax.Array:
        actions = self._env.primitive.actions
        return exploration.best_apart(q, jnp.isfinite(q), actions, count=NUM_NEXT, spacing=_APART)

    def _safety(self, centroids: jax.Array, moved: jax.Array, target: jax.Array) -> jax.Array:
        """Return how likely those of the objects [MAX_OBJECTS] that `moved` have stayed in the workspace indeed."""
        place, xy = self._env.workspace, centroids[:, :2]
        low, high = (jnp.asarray(limit, jnp.float32)[None] for limit in (place.low, place.high))
        inside = jnp.min(jnp.minimum(xy - low, high - xy), axis=-1)
        counts = jnp.arange(len(moved)) == target if self._env.task.obstacles_may_leave else moved
        return jnp.prod(jnp.where(counts & moved, jnp.clip(0.5 + 0.5 * inside / _EDGE, 0.5, 1.0), 1.0))

    def _before_grasp(self, bank: HullBank, states: EnvState, execute: jax.Array) -> tuple[Any, Plan, Any]:
        plan = jax.vmap(lambda s, go: self._env.plan_grasp(s, hold=TRIAL_HOLD).unless(~go, "no_ik"))(states, execute)
        return states.physics, plan, (bank, states)

    def _after_grasp(self, kept: Any, plan: Plan, physics: Any) -> GraspResult:
        bank, states = kept
        return jax.vmap(self._rebuilt(bank).conclude_grasp)(states, plan, physics)
