"""PPG and Target-PPG: strokes that a network chooses, and a last one that goes for the target.

PPG takes the best start and heading of all, whatever object that brings. Target-PPG does the same until there is
enough free space around the target, and then takes it with a stroke of its own (`free_space`). A policy without a
network draws its strokes at random: what training is worth.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax.tree_util import Partial

from pregrasp_jax.config import StrokesConfig
from pregrasp_jax.learning.imitation import StrokeFunction
from pregrasp_jax.policies.free_space import FinalStroke, make_cluster, make_feasible
from pregrasp_jax.policies.scripts import Policy
from pregrasp_jax.policies.strokes import IndexedStroke, from_index, guided_stroke, squared_distance
from pregrasp_jax.spaces import grid
from pregrasp_jax.task.env import Env
from pregrasp_jax.task.push_grasp import PushGrasp
from pregrasp_jax.types import EnvState

Choose = Callable[[Any, EnvState, jax.Array], IndexedStroke]
"""(parameters, state, key) -> the stroke of a policy that knows no target."""

FREE_SPACE = {"feasible": make_feasible, "cluster": make_cluster}
"""What Target-PPG takes for enough free space, by the name that `strokes.free_space` knows it by."""


def greedy(function: StrokeFunction, *, mask_radius: float = 0.0) -> Choose:
    """Return the best of all strokes by the networks.

    Args:
        function: the networks.
        mask_radius: m, only strokes that begin so near to the target; 0 for all.
    """

    def choose(params: Any, state: EnvState, key: jax.Array) -> IndexedStroke:
        del key
        height = grid.dequantize_height(state.obs.height)
        values = function.values(params, height)
        if mask_radius:
            of_target = state.obs.instance_ids == state.scene.target + 1
            near = squared_distance(of_target) <= (mask_radius / grid.HEIGHTMAP_RESOLUTION) ** 2
            near = near | ~jnp.any(near)  # a target that is not seen is near to nothing
            values = jnp.where(near[..., None], values, -jnp.inf)
        index = jnp.argmax(values).astype(jnp.int32)
        return IndexedStroke(index, function.aperture_of(params, height, index))

    return choose


def at_random(env: Env) -> Choose:
    """Return guided strokes at random; they need no parameters."""

    def choose(params: Any, state: EnvState, key: jax.Array) -> IndexedStroke:
        del params
        return guided_stroke(key, grid.dequantize_height(state.obs.height), env.primitive.actions)

    return choose


def make_ppg(env: Env, choose: Choose) -> Callable[[Any], Policy]:
    """Return the constructor params -> policy that knows no target."""

    def act(params: Any, state: EnvState, key: jax.Array) -> PushGrasp:
        return from_index(env.primitive.actions, choose(params, state, key))

    return lambda params: Partial(act, params)


def make_target_ppg(env: Env, choose: Choose, config: StrokesConfig) -> Callable[[Any], Policy]:
    """Return the constructor params -> policy that goes for the target once there is free space around it."""
    final_stroke: FinalStroke = FREE_SPACE[config.free_space](env.robot)
    ppg = make_ppg(env, choose)

    def act(params: Any, state: EnvState, key: jax.Array) -> PushGrasp:
        choose_key, final_key = jax.random.split(key)
        final, there_is = final_stroke(state, final_key)
        explore = ppg(params)(state, choose_key)
        return jax.tree.map(lambda a, b: jnp.where(there_is, a, b), final, explore)

    return lambda params: Partial(act, params)


STROKE_SCRIPTS: dict[str, Callable[[Env, StrokesConfig], Policy]] = {
    "strokes": lambda env, config: make_ppg(env, at_random(env))(None),
    "target-strokes": lambda env, config: make_target_ppg(env, at_random(env), config)(None),
}
"""Both baselines with strokes at random, by the name `pregrasp-jax evaluate --policy` knows them by."""
