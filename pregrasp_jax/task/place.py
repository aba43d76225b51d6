"""The place of a task: found by its name and dimensions, and refused where robot or scenes do not fit in."""

import dataclasses
import functools
from collections import Counter
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

from pregrasp_jax.config import TaskConfig
from pregrasp_jax.robot.base import Robot
from pregrasp_jax.robot.clearance import CLEARANCE_MARGIN
from pregrasp_jax.scene.bank import SceneBank
from pregrasp_jax.scene.packing import MAX_RADIUS
from pregrasp_jax.spaces.workspace import Workspace, get_workspace
from pregrasp_jax.task.primitive import Primitive
from pregrasp_jax.types import OBSTRUCTIONS

_TRIED_ACTIONS = 64
"""Of those that are allowed at the start, spread over all, to see whether a place can be used at all."""


def place_of(task: TaskConfig) -> Workspace:
    """Return the place of a task, in the dimensions that it asks for."""
    return get_workspace(task.workspace, dataclasses.asdict(task.place))


def refuse_walls(robot: Robot, workspace: Workspace) -> None:
    """Refuse a place whose walls are where the robot starts or where scenes are packed.

    Raises:
        ValueError: one line says which wall, and what is allowed.
    """
    if not workspace.walls:
        return
    clear_of = np.asarray(_clearances(robot, workspace)(jnp.asarray(robot.homes)))
    for index, (wall, clear) in enumerate(zip(workspace.walls, clear_of, strict=True)):
        reach = wall.distance_to_origin()
        if reach < MAX_RADIUS:
            raise ValueError(
                f"workspace '{workspace.name}': wall {index} comes within {reach:.3f} m of the centre, where scenes "
                f"are packed; allowed is {MAX_RADIUS} m or more"
            )
        if clear < CLEARANCE_MARGIN:
            raise ValueError(
                f"workspace '{workspace.name}': robot {robot.name} at its start pose is {clear:.3f} m from wall "
                f"{index} or the table; allowed is {CLEARANCE_MARGIN} m or more"
            )


def _clearances(robot: Robot, workspace: Workspace) -> Callable[[jax.Array], jax.Array]:
    """Return a function from joint positions [N, J] to the least clearance of each wall [W], m."""
    places = [dataclasses.replace(workspace, walls=(wall,)) for wall in workspace.walls]
    return jax.jit(
        lambda homes: jnp.stack([jnp.min(jax.vmap(lambda q, p=p: robot.clearance(q, p))(homes)) for p in places])
    )


def refuse_scenes(workspace: Workspace, scenes: SceneBank) -> None:
    """Refuse a place in which an object of a scene has left at the start, under some yaw.

    Raises:
        ValueError: one line says how far it stands from the centre.
    """
    reach = float(np.linalg.norm(scenes.poses[..., :2], axis=-1)[scenes.object_ids >= 0].max())
    limit = float(np.abs([workspace.low, workspace.high]).min())
    if reach > limit:
        raise ValueError(
            f"workspace '{workspace.name}': objects leave {limit:g} m from the centre, but in {scenes.split} scenes "
            f"they stand up to {reach:.3f} m from it; allowed is a place at least that wide"
        )


def refuse_blocked(robot: Robot, workspace: Workspace, primitive: Primitive, *, mirrored: bool) -> None:
    """Refuse a place between whose walls no action can be executed at the start.

    Args:
        robot: who moves.
        workspace: where.
        primitive: what is tried.
        mirrored: whether some scenes start in the mirror image of the arm's posture.

    Raises:
        ValueError: one line says in which posture, and what is in the way.
    """
    if not workspace.walls:
        return
    start = jax.tree.map(jnp.asarray, robot.start)
    allowed = np.flatnonzero(jax.jit(primitive.mask)(start))
    # Drawn, since an even stride would meet the same choices everywhere.
    tried = np.random.default_rng(0).permutation(allowed)[:_TRIED_ACTIONS].astype(np.int32)

    @jax.jit
    @functools.partial(jax.vmap, in_axes=(0, None))
    @functools.partial(jax.vmap, in_axes=(None, 0))
    def obstructions(home: jax.Array, action: jax.Array) -> jax.Array:
        return primitive.plan(home, primitive.decode(start, action)).obstruction

    postures = ("", "mirrored ") if mirrored else ("",)
    codes = np.asarray(obstructions(jnp.asarray(robot.homes[: len(postures)]), jnp.asarray(tried)))
    for posture, found in zip(postures, codes, strict=True):
        if not (found == OBSTRUCTIONS.index("none")).any():
            reasons = ", ".join(f"{OBSTRUCTIONS[code]} {count}" for code, count in Counter(found).most_common())
            instead = ", or --task.mirrored-start False" if posture else ""
            raise ValueError(
                f"workspace '{workspace.name}': none of {len(tried)} pushes from the {posture}start pose of robot "
                f"{robot.name} can be executed ({reasons}); allowed are walls that leave room for some{instead}"
            )
