"""Trained policies in an environment, by the method that trained them."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import numpy as np

from pregrasp_jax.checkpoint import TrainedPolicy
from pregrasp_jax.evaluation_config import EvaluationConfig
from pregrasp_jax.heightmap import overhead_camera
from pregrasp_jax.learning.imitation import StrokeFunction
from pregrasp_jax.learning.q_function import make_q_function
from pregrasp_jax.planning.planner import Planner, make_planner
from pregrasp_jax.policies.learned import make_learned
from pregrasp_jax.policies.ppg import greedy, make_ppg, make_target_ppg
from pregrasp_jax.policies.scripts import Policy
from pregrasp_jax.spaces import grid
from pregrasp_jax.task.env import Env


class Learned(NamedTuple):
    """A trained policy in its environment.

    Attributes:
        policy: who decides.
        q_values: (parameters, state) -> [H, W, K].
        fits: whether the parameters belong to the networks.
    """

    policy: Policy | Planner
    q_values: Callable[[Any, Any], jax.Array]
    fits: bool


def _play_q(env: Env, trained: TrainedPolicy, style: str, request: EvaluationConfig) -> Learned:
    _refuse_style(style, trained, allowed="")
    # Of the task that it was trained on: a window of another size is another input.
    q_function = make_q_function(trained.config.network, trained.config.task, env.primitive.actions)
    if request.plan:
        camera_m = None if env.task.camera == "orthographic" else np.asarray(overhead_camera().position)
        policy = make_planner(env, trained, request.planning, camera_m=camera_m, threads=request.physics.threads)
    else:
        policy = make_learned(env, q_function.values, reachable=request.reachable)(trained.params)
    return Learned(
        policy=policy,
        q_values=lambda params, state: q_function.values(params, state.obs, state.scene.target),
        fits=q_function.fits(trained.params),
    )


def _play_strokes(env: Env, trained: TrainedPolicy, style: str, request: EvaluationConfig) -> Learned:
    strokes = trained.config.strokes
    function = StrokeFunction(strokes, env.primitive.actions)
    styles = {
        "ppg": lambda: make_ppg(env, greedy(function)),
        "target-ppg": lambda: make_target_ppg(env, greedy(function, mask_radius=strokes.mask_radius), strokes),
    }
    _refuse_style(style, trained, allowed=", ".join(styles))
    return Learned(
        policy=styles[style or "ppg"]()(trained.params),
        q_values=lambda params, state: function.values(params, grid.dequantize_height(state.obs.height)),
        fits=function.fits(trained.params),
    )


METHODS: dict[str, Callable[[Env, TrainedPolicy, str, EvaluationConfig], Learned]] = {
    "q_learning": _play_q,
    "imitation": _play_strokes,
}
"""How trained policies are played, by the name of their `train.method`."""


def play(env: Env, trained: TrainedPolicy, style: str, request: EvaluationConfig) -> Learned:
    """Return a trained policy in its environment.

    Args:
        env: where.
        trained: the policy.
        style: one of `STYLES`, or empty for that of its method.
        request: whether a search decides, and how.

    Raises:
        ValueError: it cannot be played in that style.
    """
    return METHODS[trained.config.train.method](env, trained, style, request)


def _refuse_style(style: str, trained: TrainedPolicy, *, allowed: str) -> None:
    """Refuse a way of playing that a policy does not know."""
    if style and style not in allowed.split(", "):
        raise ValueError(
            f"policy {style}:{trained.origin} cannot be played so; allowed: {allowed or 'the folder alone'}"
        )
