"""What an engine is: a few functions on one scene, and when a scene has diverged."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import jax

from pregrasp_jax.robot.base import Robot
from pregrasp_jax.types import PhysicsObservation

MAX_SPEED = 100.0
"""Generalized speed (m/s or rad/s) above which a scene counts as diverged."""

MAX_PENETRATION = 0.02
"""m; a scene in which two bodies overlap deeper than this has diverged."""


@dataclass(frozen=True)
class Engine:
    """An engine; every function is unbatched, pure, and usable under `jax.jit` and `jax.vmap`.

    Attributes:
        name: as in `PhysicsConfig.engine`.
        init: () -> state with empty slots and the robot at the start pose.
        reset: (state, scene, mirrored=False) -> state in which the scene's objects stand still and the robot is at the
            start pose, in the mirror image of its posture if `mirrored` () bool.
        run: (state, ctrl [T, A] rad or m, num_ctrl int32) -> state after the first `num_ctrl` rows, each
            `types.CTRL_DT` long; the control moves linearly from row k to row k + 1. A diverged scene stays diverged.
        observe: (state) -> `PhysicsObservation`.
        coordinates: (state) -> qpos [nq], qvel [nv] float32 in m, rad and s; every engine has the robot first, then the
            slots, so that another engine can take them up.
        place: (object_ids [MAX_OBJECTS] int32, qpos [nq], qvel [nv]) -> state with these coordinates.
        advance: `run` of a batch on the host, outside of `jax.jit`; None where `run` stays on the device. Programs that
            hold a host callback cannot be kept in jax's persistent cache, so `task.stages` divides them here.
    """

    name: str
    init: Callable[[], Any]
    reset: Callable[..., Any]
    run: Callable[[Any, jax.Array, jax.Array], Any]
    observe: Callable[[Any], PhysicsObservation]
    coordinates: Callable[[Any], tuple[jax.Array, jax.Array]]
    place: Callable[[jax.Array, jax.Array, jax.Array], Any]
    advance: Callable[[Any, Any, Any], Any] | None = None


def refuse_controls(ctrl: jax.Array, robot: Robot) -> None:
    """Refuse control rows [..., T, A] of another robot.

    Raises:
        ValueError: A is not the number of its actuators.
    """
    if ctrl.shape[-1] != len(robot.actuators):
        raise ValueError(f"ctrl must have {len(robot.actuators)} columns for robot {robot.name}, got {ctrl.shape[-1]}")
