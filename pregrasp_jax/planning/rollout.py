"""Pushes of rebuilt scenes, a batch of fixed size at a time: simulate, judge by the task's own rules, ask the network."""

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from pregrasp_jax.learning.q_function import QFunction
from pregrasp_jax.physics.base import Engine
from pregrasp_jax.policies import scripts
from pregrasp_jax.task import registry
from pregrasp_jax.task.env import Env
from pregrasp_jax.task.primitive import Plan
from pregrasp_jax.task.stages import Stages, make_stages
from pregrasp_jax.types import EnvState, GraspResult, HandPose, HullBank, Observation, SceneParams, StepResult

NUM_SCRIPTED = 8
"""Pushes that scripts propose: `straight`, `clear`, and as many guided as uniform ones."""

_GRASP_ROWS = 165
"""Control rows, 3.3 s, of a grasp: until the object is up. The seconds of holding it tell little."""


class Pushed(NamedTuple):
    """What pushes [B] of rebuilt scenes did.

    Attributes:
        states: where they led.
        results: what the rules say.
        values: [B] of the best push that the network knows next.
        actions: [B] int32, that push.
    """

    states: EnvState
    results: StepResult
    values: jax.Array
    actions: jax.Array


class Rollout:
    """Compiled programs of one environment and one network; shapes never change."""

    def __init__(self, env: Env, engine: Engine, q_function: QFunction, params: Any, *, batch: int):
        """Compile nothing yet.

        Args:
            env: of the task; objects, scenes and engine of it are not used.
            engine: of rebuilt objects.
            q_function: of the policy.
            params: of the policy.
            batch: pushes at a time.
        """
        self.batch = batch
        self._env, self._engine, self._params = env, engine, params
        self._q = q_function
        self._start = jax.jit(jax.vmap(self._start_one, (None, 0, 0, 0, None, None, None)))
        self._propose = jax.jit(self._propose_one)
        self._value = jax.jit(self._value_map)
        self._take = jax.jit(lambda tree, index: jax.tree.map(lambda leaf: leaf[index], tree))
        self._join = jax.jit(lambda a, b: jax.tree.map(lambda *leaves: jnp.concatenate(leaves), a, b))
        self._push = make_stages(engine, self._before_push, self._after_push)
        self._grasp = make_stages(engine, self._before_grasp, self._after_grasp)
        self._compiled: dict[str, Callable[..., Any]] = {}

    def start(
        self,
        bank: HullBank,
        object_ids: np.ndarray,
        poses: np.ndarray,
        qpos: np.ndarray,
        hand: HandPose,
        target: int,
        joint_pos: np.ndarray,
    ) -> EnvState:
        """Return the states [V] of rebuilt scenes: objects stand at poses [V, MAX_OBJECTS, 7], the robot where it is."""
        del joint_pos
        return self._start(bank, object_ids, poses, qpos, hand, np.int32(target), 0)

    def value_map(self, obs: Observation, target: int) -> tuple[np.ndarray, np.ndarray]:
        """Return what the network says of every push of a real picture [H, W, K], and which are allowed."""
        return jax.device_get(self._value(self._params, obs, np.int32(target)))

    def propose(self, state: EnvState, key: jax.Array) -> np.ndarray:
        """Return pushes [NUM_SCRIPTED] int32 of scripts in a rebuilt scene."""
        return np.asarray(self._propose(state, key))

    def succeeded(self, reason: np.ndarray) -> np.ndarray:
        """Return which reasons [...] count as success, [...] bool."""
        return np.isin(reason, self._env.rules.successes)

    def take(self, states: EnvState, index: np.ndarray) -> EnvState:
        """Return the states at `index` [B]."""
        return self._take(states, index)

    def push(self, bank: HullBank, states: EnvState, actions: np.ndarray, execute: np.ndarray) -> Pushed:
        """Push in B states; where not to be executed [B], nothing is simulated."""
        return self._run("push", self._push, bank, self._params, states, actions, execute)

    def grasp(self, bank: HullBank, states: EnvState, execute: np.ndarray) -> np.ndarray:
        """Return which grasps hold, [B] bool."""
        return np.asarray(self._run("grasp", self._grasp, bank, states, execute).held)

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
        pushes: int,
    ) -> EnvState:
        physics = self._engine.place(object_ids, qpos, jnp.zeros(self.num_velocities))
        blank = jnp.zeros((1,))
        state = EnvState(
            physics=physics,
            scene=SceneParams(object_ids, poses, target),
            scene_index=jnp.int32(-1),
            physics_obs=self._engine.observe(physics),
            obs=Observation(blank, blank, hand),  # pyright: ignore[reportArgumentType]
            centroids=blank,
            num_pushes=jnp.int32(pushes),
        )
        return self._rebuilt(bank).look(state, hand)

    num_velocities = 0

    def _propose_one(self, state: EnvState, key: jax.Array) -> jax.Array:
        env = self._env
        half = (NUM_SCRIPTED - 2) // 2
        keys = jax.random.split(key, 2 * half)
        guided = jax.vmap(scripts.make_guided(env), (None, 0))(state, keys[:half])
        uniform = jax.vmap(scripts.make_random(env), (None, 0))(state, keys[half:])
        ahead = jnp.stack([scripts.make_straight(env)(state, key), scripts.make_clear(env)(state, key)])
        return jnp.concatenate([ahead, guided, uniform])

    def _value_map(self, params: Any, obs: Observation, target: jax.Array) -> tuple[jax.Array, jax.Array]:
        return self._q.values(params, obs, target), self._env.action_mask(obs.hand)

    def _before_push(
        self, bank: HullBank, params: Any, states: EnvState, actions: jax.Array, execute: jax.Array
    ) -> tuple[Any, Plan, Any]:
        plan = jax.vmap(lambda s, a, go: self._env.plan(s, a).unless(~go, "no_ik"))(states, actions, execute)
        return states.physics, plan, (bank, params, states)

    def _after_push(self, kept: Any, plan: Plan, physics: Any) -> Pushed:
        bank, params, states = kept
        env = self._rebuilt(bank)
        states, results = jax.vmap(env.conclude)(states, plan, physics)
        inputs = jax.vmap(self._q.input_fn)(states.obs, states.scene.target)
        q = jnp.where(jax.vmap(env.action_mask)(states.hand), self._q.apply(params, inputs), -jnp.inf)
        flat = q.reshape(self.batch, -1)
        return Pushed(states, results, flat.max(axis=1), flat.argmax(axis=1).astype(jnp.int32))

    def _before_grasp(self, bank: HullBank, states: EnvState, execute: jax.Array) -> tuple[Any, Plan, Any]:
        plan = jax.vmap(lambda s, go: self._env.plan_grasp(s).unless(~go, "no_ik"))(states, execute)
        plan = plan.replace(ctrl=plan.ctrl[:, :_GRASP_ROWS], num_ctrl=jnp.minimum(plan.num_ctrl, _GRASP_ROWS))
        return states.physics, plan, (bank, states)

    def _after_grasp(self, kept: Any, plan: Plan, physics: Any) -> GraspResult:
        del plan
        bank, states = kept
        return jax.vmap(self._rebuilt(bank).conclude_grasp)(states, physics)
