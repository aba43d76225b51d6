"""Stable grasps of random strokes, which PPG learns from.

Scenes are attempted side by side. Each gets `attempts` guided strokes without a reset, or fewer if at most one object
is left; what is stored of an attempt that ended in a stable grasp is what the camera saw before it and the stroke.
"""

from collections.abc import Callable
from typing import Any

import flax.struct as struct
import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from pregrasp_jax.policies.strokes import IndexedStroke, from_index, guided_stroke
from pregrasp_jax.scene.model import make_slot_model, write_slots
from pregrasp_jax.scene.packing import slot_gaps
from pregrasp_jax.scene.spec import table_spec
from pregrasp_jax.spaces import grid
from pregrasp_jax.spaces.workspace import TABLE
from pregrasp_jax.task.env import Env
from pregrasp_jax.task.primitive import Plan
from pregrasp_jax.task.stages import Stages, make_stages
from pregrasp_jax.task.stroke_rules import GraspOutcome, standing
from pregrasp_jax.types import EnvState, HullBank, StepResult

_NEIGHBOURHOOD = 0.2
"""m; how far away a nearest neighbour is looked for."""


class Positives(struct.PyTreeNode):
    """P stable grasps.

    Attributes:
        height: [P, H, W] uint8 as observed before the stroke.
        index: [P] int32, flat index of Q[row, col, heading].
        aperture: [P] float32 rad.
        gain: [P] float32 m, by how much the push took the object away from its nearest neighbour.
    """

    height: jax.Array
    index: jax.Array
    aperture: jax.Array
    gain: jax.Array


class Scenes(struct.PyTreeNode):
    """Scenes under way.

    Attributes:
        states: [E].
        attempts: [E] int32 strokes since the reset.
        batches: () int32 strokes of every scene so far.
        stable: () int32 stable grasps so far.
    """

    states: EnvState
    attempts: jax.Array
    batches: jax.Array
    stable: jax.Array


class Attempt(struct.PyTreeNode):
    """What was tried in E scenes.

    Attributes:
        height: [E, H, W] uint8 before.
        stroke: [E].
        scene_ids: [E, MAX_OBJECTS] int32, the objects that stood there before, -1 for none.
        result: [E].
        poses: [E, 3, MAX_OBJECTS, 7], see `types.Touch`.
    """

    height: jax.Array
    stroke: IndexedStroke
    scene_ids: jax.Array
    result: StepResult
    poses: jax.Array


def blank_positives(capacity: int) -> Positives:
    """Return host arrays with room for so many grasps."""
    fields: dict[str, Any] = {
        "height": np.zeros((capacity, grid.GRID_SIZE, grid.GRID_SIZE), np.uint8),
        "index": np.zeros(capacity, np.int32),
        "aperture": np.zeros(capacity, np.float32),
        "gain": np.zeros(capacity, np.float32),
    }
    return Positives(**fields)


def begin(env: Env, num_envs: int, key: jax.Array) -> Scenes:
    """Return scenes that have just been reset."""
    states = jax.jit(jax.vmap(env.reset))(jax.random.split(key, num_envs))
    return Scenes(states, jnp.zeros(num_envs, jnp.int32), jnp.int32(0), jnp.int32(0))


def make_collect(env: Env, max_attempts: int) -> Stages:
    """Return the stages (scenes, key) -> (scenes, `Attempt`): one stroke in every scene, and a reset of those that end.

    The key is that of the run; scenes count what has been drawn from it.
    """
    actions = env.primitive.actions

    def decide(state: EnvState, key: jax.Array) -> tuple[Plan, IndexedStroke]:
        stroke = guided_stroke(key, grid.dequantize_height(state.obs.height), actions)
        return env.plan(state, from_index(actions, stroke)), stroke

    def before(scenes: Scenes, key: jax.Array) -> tuple[Any, Plan, Any]:
        stroke_key, reset_key = jax.random.split(jax.random.fold_in(key, scenes.batches))
        num_envs = scenes.attempts.shape[0]
        plans, strokes = jax.vmap(decide)(scenes.states, jax.random.split(stroke_key, num_envs))
        return scenes.states.physics, plans, (scenes, strokes, jax.random.split(reset_key, num_envs))

    def after(kept: Any, plans: Plan, physics: Any) -> tuple[Scenes, Attempt]:
        scenes, strokes, reset_keys = kept
        states, results = jax.vmap(env.conclude)(scenes.states, plans, physics)
        outcome: GraspOutcome = results.outcome
        there = jax.vmap(standing)(scenes.states)
        attempt = Attempt(
            height=scenes.states.obs.height,
            stroke=strokes,
            scene_ids=jnp.where(there, scenes.states.scene.object_ids, -1),
            result=results,
            poses=states.physics.touch.poses,
        )
        attempts = scenes.attempts + 1
        left = jnp.sum(jax.vmap(standing)(states), axis=1)
        over = (attempts >= max_attempts) | (left <= 1) | outcome.diverged
        fresh = jax.lax.cond(jnp.any(over), lambda: jax.vmap(env.reset)(reset_keys), lambda: states)
        states = jax.vmap(lambda end, new, old: jax.tree.map(lambda a, b: jnp.where(end, a, b), new, old))(
            over, fresh, states
        )
        stable = scenes.stable + jnp.sum(outcome.stable, dtype=jnp.int32)
        return Scenes(states, jnp.where(over, 0, attempts), scenes.batches + 1, stable), attempt

    return make_stages(env.engine, before, after)


def make_keep(bank: HullBank) -> Callable[[Positives, int, Attempt], int]:
    """Return (positives, written, attempt) -> written: adds the stable grasps of a batch, on the host, in place."""
    model = make_slot_model(table_spec(TABLE), bank)
    data = mujoco.MjData(model.mj_model)

    def gap(object_ids: np.ndarray, poses: np.ndarray, slot: int) -> float:
        """Return the distance m from an object to the nearest other one."""
        present = object_ids >= 0
        data.qpos[model.slot_qpos_ids] = poses
        gaps = slot_gaps(model, model.mj_model, data, present, reach=_NEIGHBOURHOOD)
        return min(float(gaps[int(present[:slot].sum())].min(initial=np.inf)), _NEIGHBOURHOOD)

    def keep(positives: Positives, written: int, attempt: Attempt) -> int:
        stable = np.asarray(attempt.result.outcome.stable)
        for scene in np.flatnonzero(stable.any(axis=1))[: len(positives.index) - written]:
            object_ids, slot = np.asarray(attempt.scene_ids[scene]), int(stable[scene].argmax())
            write_slots(model, model.mj_model, object_ids)
            before, pushed = (gap(object_ids, np.asarray(attempt.poses[scene, leg]), slot) for leg in (0, 1))
            positives.height[written] = attempt.height[scene]
            positives.index[written] = attempt.stroke.index[scene]
            positives.aperture[written] = attempt.stroke.aperture[scene]
            positives.gain[written] = pushed - before
            written += 1
        return written

    return keep
