"""A policy that simulates before it pushes, in a scene rebuilt from what the camera sees."""

import time
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import numpy as np

from pregrasp_jax.config import PlanningConfig
from pregrasp_jax.heightmap import overhead_camera
from pregrasp_jax.learning.q_function import QFunction
from pregrasp_jax.planning import memory as remembering
from pregrasp_jax.planning import simulation
from pregrasp_jax.planning.memory import Memory, Sight
from pregrasp_jax.planning.rollout import NUM_SCRIPTED, Rollout
from pregrasp_jax.planning.search import Search
from pregrasp_jax.planning.solids import Frustums, hull_bank
from pregrasp_jax.scene.model import parking_poses
from pregrasp_jax.spaces import grid
from pregrasp_jax.task.env import Env
from pregrasp_jax.types import MAX_OBJECTS, ROBOT_ID, TABLE_ID, HullBank

DENSITY, FRICTION = 300.0, 0.25
"""kg/m^3, and friction between objects, of what is known by sight only: what `assets` takes where nothing else is said."""

BATCH = 16
"""Pushes simulated at a time."""


class Planned(NamedTuple):
    """A decision.

    Attributes:
        action: () int flat index of Q.
        memory: for the next decision of the episode.
        seconds: s that it took.
        pushes: simulated.
    """

    action: int
    memory: Memory
    seconds: float
    pushes: int


class Planner:
    """Decides for one scene at a time; keeps nothing from one decision to the next but compiled programs."""

    def __init__(self, env: Env, q_function: QFunction, params: Any, config: PlanningConfig, *, threads: int = 0):
        """Compile the model of rebuilt objects.

        Args:
            env: of the task; its objects and scenes are not looked at.
            q_function: of the policy that proposes and continues.
            params: of the policy.
            config: how long to search.
            threads: of the simulations; 0 takes every core.
        """
        self._config, self._robot = config, env.robot
        self._simulations = simulation.make_simulations(
            env.robot, env.workspace, num_variants=config.variants, threads=threads
        )
        engine = simulation.make_engine(self._simulations, env.robot)
        self._rollout = Rollout(env, engine, q_function, params, batch=BATCH)
        model = self._simulations.model
        self._rollout.num_velocities = model.mj_model.nv
        self._home_qpos = self._simulations.coordinates(self._simulations.home_state())[0]
        self._joint_ids, self._slot_ids = env.robot.joint_qpos_ids(model.mj_model), model.slot_qpos_ids
        self._camera = None if env.task.camera == "orthographic" else np.asarray(overhead_camera().position)

    def decide(self, sight: Sight, memory: Memory, key: jax.Array) -> Planned:
        """Return the push that does best in simulation.

        Args:
            sight: what the policy may read now.
            memory: of the episode's earlier decisions, `memory.NOTHING` at its begin.
            key: for scripted pushes and variants.
        """
        begin = time.perf_counter()
        edge = self._config.pinhole_edge if self._camera is not None else 0.0
        memory = remembering.look(sight, memory, unseen=self._unseen(sight), edge=edge)
        values, allowed = self._rollout.value_map(sight.obs, sight.target)
        if memory[sight.target] is None:
            best = int(np.argmax(np.where(allowed, values, -np.inf)))
            return Planned(best, memory, time.perf_counter() - begin, 0)
        script_key, variant_key = jax.random.split(key)
        seed = np.asarray(jax.random.key_data(variant_key)).tolist()
        bank, states = self._rebuild(sight, memory, np.random.default_rng(seed))
        proposed = spread_best(np.where(allowed, values, -np.inf), self._config.candidates)
        first = self._rollout.take(states, np.zeros((), int))
        scripted = self._rollout.propose(first, script_key)
        count = max(BATCH - len(proposed), 0) if self._config.scripted else 0
        candidates = list(dict.fromkeys([*proposed, *scripted[:count].tolist()]))
        search = Search(self._rollout, bank, states, np.array(candidates), self._config, begin)
        action = search.run()
        return Planned(action, memory, time.perf_counter() - begin, search.pushes)

    def _rebuild(self, sight: Sight, memory: Memory, rng: np.random.Generator) -> tuple[HullBank, Any]:
        """Write the variants of the rebuilt scene into the simulations; return their objects and states [V]."""
        config = self._config
        solids, known = remembering.solids_of(memory)
        poses = np.stack([shape.pose if shape is not None else np.zeros(3) for shape in memory])
        shapes, density, placed = [], [], []
        for variant in range(config.variants):
            jitter = variant > 0
            grown = jitter * config.size_jitter * rng.standard_normal((MAX_OBJECTS, 1, 1, 1)) - config.shrink
            shapes.append(solids._replace(support=np.maximum(solids.support + grown, _MIN_SUPPORT(solids))))
            density.append(np.full(MAX_OBJECTS, DENSITY) * config.mass_jitter ** (jitter * rng.uniform(-1, 1, MAX_OBJECTS)))
            moved = poses + jitter * rng.standard_normal((MAX_OBJECTS, 3)) * np.array(
                [config.position_jitter, config.position_jitter, config.turn_jitter]
            )
            placed.append(_standing(moved, known))
        joined = Frustums(*(np.concatenate(columns) for columns in zip(*shapes, strict=True)))
        bank = hull_bank(joined, density=np.concatenate(density), friction=FRICTION)
        self._simulations.write(bank)
        ids = np.arange(config.variants * MAX_OBJECTS, dtype=np.int32).reshape(config.variants, MAX_OBJECTS)
        object_ids, world = np.where(known, ids, -1).astype(np.int32), np.stack(placed).astype(np.float32)
        qpos = np.tile(self._home_qpos, (config.variants, 1)).astype(np.float32)
        qpos[:, self._joint_ids] = sight.joint_pos
        qpos[:, self._slot_ids] = world
        return bank, self._rollout.start(bank, object_ids, world, qpos, sight.obs.hand, sight.target, sight.joint_pos)

    def _unseen(self, sight: Sight) -> np.ndarray:
        """Return the cells [H, W] bool that something tall hides from the camera."""
        if self._camera is None:
            return np.zeros((grid.GRID_SIZE, grid.GRID_SIZE), bool)
        return shadows(np.asarray(sight.obs.height), np.asarray(sight.obs.instance_ids), self._camera)


def _MIN_SUPPORT(solids: Frustums) -> np.ndarray:
    return solids.support - 0.004


def _standing(poses: np.ndarray, known: np.ndarray) -> np.ndarray:
    """Return poses [MAX_OBJECTS, 7] of objects that stand at [MAX_OBJECTS, 3] x, y, heading; parked where unknown."""
    x, y, yaw = poses.T
    zero = np.zeros_like(x)
    standing = np.stack([x, y, zero, np.cos(yaw / 2), zero, zero, np.sin(yaw / 2)], axis=-1)
    return np.where(known[:, None], standing, parking_poses())


def spread_best(values: np.ndarray, count: int, *, apart: int = 4) -> list[int]:
    """Return the flat indices of the best `count` of values [H, W, K], those of one choice `apart` cells apart."""
    values = values.copy()
    found = []
    for _ in range(count):
        index = int(np.argmax(values))
        if not np.isfinite(values.flat[index]):
            break
        row, col, choice = np.unravel_index(index, values.shape)
        found.append(index)
        values[max(row - apart + 1, 0) : row + apart, max(col - apart + 1, 0) : col + apart, choice] = -np.inf
    return found


def shadows(height: np.ndarray, instance_ids: np.ndarray, camera: np.ndarray) -> np.ndarray:
    """Return the table cells [H, W] bool from which something stands between them and the camera at [3] m."""
    z = grid.dequantize_height(height)
    centers = grid.cell_centers()
    x, y = np.meshgrid(centers, centers)
    hidden = np.zeros(z.shape, bool)
    for share in np.linspace(0.02, 0.3, 15):  # of the way to the camera; above 0.3 m nothing is drawn
        row, col = grid.world_to_cell(np.stack([x + share * (camera[0] - x), y + share * (camera[1] - y)], axis=-1))
        row, col = np.clip(row, 0, grid.GRID_SIZE - 1), np.clip(col, 0, grid.GRID_SIZE - 1)
        hidden |= z[row, col] > share * camera[2] + 0.005
    return hidden & (instance_ids == TABLE_ID) & (instance_ids != ROBOT_ID)
