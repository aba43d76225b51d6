"""What an engine is: a few functions on one scene, the clock they share, and when a scene has diverged."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import jax

from pregrasp_jax.types import PhysicsObservation, SceneParams

CTRL_DT = 0.02
"""s between two rows of a control trajectory; engines interpolate linearly in between."""

NUM_CONTROLS = 7
"""Six arm joints and the finger drive, rad."""

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
        reset: (state, scene) -> state in which the scene's objects stand still and the robot is at the start pose.
        run: (state, ctrl [T, NUM_CONTROLS] rad, num_ctrl int32) -> state after the first `num_ctrl` rows, each
            `CTRL_DT` long; the control moves linearly from row k to row k + 1. A diverged scene stays diverged.
        observe: (state) -> `PhysicsObservation`.
        coordinates: (state) -> qpos [nq], qvel [nv] float32 in m, rad and s; every engine has the robot first, then the
            slots, so that another engine can take them up.
        place: (object_ids [MAX_OBJECTS] int32, qpos [nq], qvel [nv]) -> state with these coordinates.
    """

    name: str
    init: Callable[[], Any]
    reset: Callable[[Any, SceneParams], Any]
    run: Callable[[Any, jax.Array, jax.Array], Any]
    observe: Callable[[Any], PhysicsObservation]
    coordinates: Callable[[Any], tuple[jax.Array, jax.Array]]
    place: Callable[[jax.Array, jax.Array, jax.Array], Any]
