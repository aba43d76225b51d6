"""A policy that simulates before it pushes, in a scene rebuilt from what the camera sees."""

import functools
import math
import time
from typing import Any, NamedTuple

import jax
import numpy as np

from pregrasp_jax.checkpoint import TrainedPolicy
from pregrasp_jax.evaluation_config import PlanningConfig
from pregrasp_jax.heightmap import robot_hulls
from pregrasp_jax.learning.q_function import QFunction, make_q_function
from pregrasp_jax.planning import memory as remembering
from pregrasp_jax.planning import simulation
from pregrasp_jax.planning.memory import Memory, Sight
from pregrasp_jax.planning.promise import Promise, promise_of
from pregrasp_jax.planning.rebuild import draw_variants, hidden_cells
from pregrasp_jax.planning.rollout import Rollout
from pregrasp_jax.planning.search import search
from pregrasp_jax.settings import to_dict
from pregrasp_jax.task.assembly import with_task
from pregrasp_jax.task.env import Env
from pregrasp_jax.types import MAX_OBJECTS, EnvState, HullBank

BATCH = 6
"""Pushes simulated at a time: what pads a batch is drawn for nothing."""

_TRIED = 12
"""Candidates with those of scripts."""

_APART = 4
"""Cells, 2 cm, between two pushes of one choice that the network proposes."""


class Planned(NamedTuple):
    """A decision.

    Attributes:
        action: flat index of Q.
        memory: for the next decision of the episode.
    """

    action: int
    memory: Memory


class Planner:
    """Decides for one scene at a time; from one decision to the next it keeps compiled programs and what they took."""

    def __init__(
        self,
        env: Env,
        q_function: QFunction,
        params: Any,
        config: PlanningConfig,
        *,
        promise: Promise,
        camera_m: np.ndarray | None,
        threads: int = 0,
    ):
        """Compile the model of rebuilt objects.

        Args:
            env: of the task; its objects and scenes are not looked at. Rebuilt scenes are drawn as it sees them.
            q_function: of the policy that proposes and continues.
            params: of the policy.
            config: how much is searched.
            promise: what the values of the policy mean, from `promise.promise_of`.
            camera_m: [3], where the camera is that decisions are made by; None for one that looks straight down
                everywhere.
            threads: of the simulations; 0 takes every core, and decisions do not depend on it.
        """
        self._config, self._promise = config, promise
        self._robot, self._max_pushes = env.robot, env.task.max_pushes
        self._simulations = simulation.make_simulations(
            env.robot, env.workspace, num_variants=config.variants, at_once=BATCH, threads=threads
        )
        self._rollout = Rollout(env, self._simulations, q_function, params, networks=config.networks, batch=BATCH)
        self._place_robot = jax.jit(functools.partial(robot_hulls, env.robot))
        self._camera = camera_m
        self._seconds: list[float] = []
        self._pushes: list[int] = []

    def decide(self, sight: Sight, memory: Memory, key: jax.Array) -> Planned:
        """Return the push that does best in simulation.

        Args:
            sight: what the policy may read now.
            memory: of the episode's earlier decisions, `memory.NOTHING` at its begin.
            key: for scripted pushes and variants.
        """
        begin = time.perf_counter()
        hidden = hidden_cells(sight.obs, self._camera)
        memory = remembering.look(sight, memory, hidden=hidden, camera=self._camera)
        values = self._rollout.values(sight.obs, sight.target)
        proposed = spread_best(values, self._config.candidates)
        if memory[sight.target] is None or not proposed:  # nothing to search for, or among
            return Planned(proposed[0] if proposed else 0, memory)
        script_key, variant_key = jax.random.split(key)
        bank, roots = self._rebuild(sight, memory, variant_key)
        scripted = self._rollout.script(roots, script_key)[: max(_TRIED - len(proposed), 0)]
        candidates = list(dict.fromkeys([*proposed, *scripted]))
        left = self._max_pushes - sight.pushes
        think = functools.partial(
            search, self._rollout, bank, roots, candidates, self._config, self._promise, left=left
        )
        if not self._seconds:  # the first decision compiles, which is no part of a later one, nor of a budget
            self._rollout.compile_grasp(bank, roots)
            if self._config.budget_ms:
                think(deadline=math.inf)
                begin = time.perf_counter()
        limit = self._config.budget_ms / 1e3 if self._config.budget_ms else math.inf
        found = think(deadline=begin + limit)
        self._seconds.append(time.perf_counter() - begin)
        self._pushes.append(found.pushes)
        return Planned(found.action, memory)

    def describe(self) -> dict[str, Any]:
        """Return the settings of the search, and what decisions took until now (the median; the first one compiles)."""
        taken = {"seconds": self._seconds, "pushes": self._pushes}
        per_decision = {name: round(float(np.median(values or [0.0])), 3) for name, values in taken.items()}
        return {"settings": to_dict(self._config), "per_decision": per_decision}

    def _robot_at(self, sight: Sight) -> np.ndarray:
        return np.asarray(self._place_robot(sight.joint_pos).vertices)

    def _rebuild(self, sight: Sight, memory: Memory, key: jax.Array) -> tuple[HullBank, EnvState]:
        """Write the variants of the rebuilt scene into the simulations; return their objects and their states [V]."""
        seed = np.asarray(jax.random.key_data(key)).tolist()
        variants = draw_variants(memory, self._robot_at(sight), self._config.variants, np.random.default_rng(seed))
        self._simulations.write(variants.bank)
        ids = np.arange(self._config.variants * MAX_OBJECTS).reshape(-1, MAX_OBJECTS)
        object_ids = np.where(variants.known, ids, -1).astype(np.int32)
        qpos = self._simulations.place(variants.poses, sight.joint_pos)
        return variants.bank, self._rollout.start(
            variants.bank, object_ids, variants.poses, qpos, sight.obs.hand, sight.target
        )


def make_planner(
    env: Env, trained: TrainedPolicy, config: PlanningConfig, *, camera_m: np.ndarray | None, threads: int = 0
) -> Planner:
    """Return a search by a policy of Q-learning, in scenes that are drawn as in its training, by a clean sensor.

    Args:
        env: of the task; its objects and scenes are not looked at.
        trained: who proposes and continues.
        config: how much is searched.
        camera_m: as in `Planner`.
        threads: as in `Planner`.
    """
    task = trained.config.task
    return Planner(
        with_task(env, camera=task.camera, sensor="clean"),
        make_q_function(trained.config.network, task, env.primitive.actions),
        trained.params,
        config,
        promise=promise_of(task, trained.config.learner.discount),
        camera_m=camera_m,
        threads=threads,
    )


def spread_best(values: np.ndarray, count: int) -> list[int]:
    """Return the flat indices of the best `count` of values [H, W, K]; those of one choice are `_APART` cells apart.

    Args:
        values: -inf where a push is not allowed.
        count: fewer are returned where no more are allowed.
    """
    values, found = values.copy(), []
    while len(found) < count and np.isfinite(values.max()):
        index = int(np.argmax(values))
        row, col, choice = np.unravel_index(index, values.shape)
        near = tuple(slice(max(int(i) - _APART + 1, 0), int(i) + _APART) for i in (row, col))
        values[(*near, choice)] = -np.inf
        found.append(index)
    return found
