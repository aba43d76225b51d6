"""PPG's own protocol: clear a scene, whatever comes first.

A scene ends after fifteen strokes or when at most one object is left. SR-1 is the share of scenes whose first stroke
ended in a stable grasp, SR-N that of all strokes; clearance is the mean share of its objects that a scene is rid of,
(removed + 1) / all, because the last one need not be taken.
"""

import dataclasses
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.tree_util import Partial

from pregrasp_jax.evaluation.statistics import wilson_interval
from pregrasp_jax.policies.scripts import Policy
from pregrasp_jax.task.env import Env
from pregrasp_jax.task.primitive import Plan
from pregrasp_jax.task.push_grasp import make_push_grasp
from pregrasp_jax.task.stages import Stages, make_stages
from pregrasp_jax.task.stroke_rules import GraspOutcome, standing
from pregrasp_jax.types import EnvState

HOLD_TIME = 1.0
"""s of holding after the lift; the target-oriented protocol holds for longer."""

MAX_ATTEMPTS = 15
"""Strokes in a scene."""


@dataclass(frozen=True, kw_only=True)
class Cleared:
    """How one scene went.

    Attributes:
        scene: row of the scene bank.
        objects: in it at the start.
        removed: of them, in whatever way.
        stable: of every stroke, whether it ended in a stable grasp.
        collided: strokes that touched something on the way down.
    """

    scene: int
    objects: int
    removed: int
    stable: tuple[bool, ...]
    collided: int


def own_protocol(env: Env) -> Env:
    """Return an environment whose strokes hold as long as in PPG's own protocol.

    Raises:
        ValueError: its primitive has no free aperture: it has no strokes.
    """
    if not env.primitive.actions.free:
        raise ValueError(
            f"task.primitive = {env.task.primitive!r} has no strokes with an aperture to choose; allowed is push_grasp"
        )
    primitive = make_push_grasp(env.robot, env.workspace, env.task, max_distance=0.0, hold_time=HOLD_TIME)
    return dataclasses.replace(env, primitive=primitive)


def clear_scenes(
    env: Env,
    policy: Policy,
    *,
    scenes: int,
    seed: int = 0,
    num_envs: int = 16,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> list[Cleared]:
    """Clear scenes 0 to `scenes` - 1 by one policy.

    Args:
        env: from `own_protocol`.
        policy: which strokes.
        scenes: at most those of the bank.
        seed: of the policy's own randomness.
        num_envs: scenes side by side; results do not depend on it.
        progress: told how many scenes are through.

    Raises:
        ValueError: more scenes than there are, or one with fewer than two objects.
    """
    if not 1 <= scenes <= len(env.scenes):
        raise ValueError(f"scenes = {scenes} is out of range; this scene bank allows 1 to {len(env.scenes)}")
    objects = (np.asarray(env.scenes.object_ids)[:scenes] >= 0).sum(axis=1)
    if objects.min() < 2:
        raise ValueError(f"scene {objects.argmin()} has {objects.min()} objects; allowed are two or more")
    policy = policy if isinstance(policy, Partial) else Partial(policy)
    reset = jax.jit(jax.vmap(env.reset_to))
    attempt: Any = None
    cleared: list[Cleared] = []
    for first in range(0, scenes, num_envs):
        rows = np.minimum(np.arange(first, first + num_envs), scenes - 1)
        states = reset(rows)
        arguments = policy, states, np.ones(num_envs, bool), jax.random.key(seed), jnp.int32(0)
        attempt = attempt or _stages(env).compile(*arguments)
        cleared += list(_clear(attempt, policy, states, rows[: scenes - first], jax.random.key(seed)))
        progress(len(cleared), scenes)
    return cleared


def summary(cleared: list[Cleared]) -> dict[str, Any]:
    """Return SR-1 and SR-N with 95 % intervals, clearance, and what they are made of."""
    strokes = [stable for scene in cleared for stable in scene.stable]
    first = [scene.stable[0] for scene in cleared]
    return {
        "scenes": len(cleared),
        "sr_1": sum(first) / len(first),
        "sr_1_ci95": list(wilson_interval(sum(first), len(first))),
        "sr_n": sum(strokes) / len(strokes),
        "sr_n_ci95": list(wilson_interval(sum(strokes), len(strokes))),
        "clearance": float(np.mean([min(scene.removed + 1, scene.objects) / scene.objects for scene in cleared])),
        "strokes": len(strokes),
        "collided": sum(scene.collided for scene in cleared),
    }


def _stages(env: Env) -> Stages:
    """Return the stages (policy, states, going [E] bool, key, attempt) -> (states, outcomes, objects left [E])."""

    def decide(policy: Policy, state: EnvState, going: jax.Array, key: jax.Array, attempt: jax.Array) -> Plan:
        key = jax.random.fold_in(jax.random.fold_in(key, state.scene_index), attempt)
        return env.plan(state, env.primitive.normal(policy(state, key))).unless(~going, "no_ik")

    def before(policy: Policy, states: EnvState, going: jax.Array, key: jax.Array, attempt: jax.Array) -> Any:
        plans = jax.vmap(decide, (None, 0, 0, None, None))(policy, states, going, key, attempt)
        return states.physics, plans, states

    def after(states: EnvState, plans: Plan, physics: Any) -> tuple[EnvState, GraspOutcome, jax.Array]:
        states, results = jax.vmap(env.conclude)(states, plans, physics)
        return states, results.outcome, jnp.sum(jax.vmap(standing)(states), axis=1)

    return make_stages(env.engine, before, after)


def _clear(attempt: Any, policy: Policy, states: EnvState, scenes: np.ndarray, key: jax.Array) -> Iterator[Cleared]:
    """Yield what became of the first scenes of a batch."""
    objects = (np.asarray(states.scene.object_ids) >= 0).sum(axis=1)
    going, left = np.arange(len(objects)) < len(scenes), objects.copy()
    stable: list[list[bool]] = [[] for _ in objects]
    collided = np.zeros(len(objects), int)
    for number in range(MAX_ATTEMPTS):
        if not going.any():
            break
        states, outcome, left = attempt(policy, states, going, key, jnp.int32(number))
        left = np.asarray(left)
        for index in np.flatnonzero(going):
            stable[index].append(bool(outcome.stable[index].any()))
        collided += going & np.asarray(outcome.collided)
        going = going & (left > 1) & ~np.asarray(outcome.diverged)
    for index, scene in enumerate(scenes):
        yield Cleared(
            scene=int(scene),
            objects=int(objects[index]),
            removed=int(objects[index] - left[index]),
            stable=tuple(stable[index]),
            collided=int(collided[index]),
        )
