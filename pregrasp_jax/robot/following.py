"""How an arm follows its hand: joint angles along a path, and what keeps it from there. For numpy and jax alike."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

from pregrasp_jax.geometry import of_rows
from pregrasp_jax.robot import clearance, kinematics
from pregrasp_jax.robot.chain import LinkGeom, Links
from pregrasp_jax.robot.kinematics import Arm
from pregrasp_jax.spaces.arrays import namespace
from pregrasp_jax.spaces.workspace import Workspace

Array = Any


@dataclass(frozen=True, eq=False, kw_only=True)
class Body:
    """An arm, its links, and which parts must keep clear of what.

    Attributes:
        arm: the kinematics.
        links: of the whole robot; its joints are the six of the arm, then two fingers.
        above_table: parts that must keep clear of the table.
        moving: parts that must keep clear of walls.
    """

    arm: Arm
    links: Links
    above_table: Sequence[LinkGeom]
    moving: Sequence[LinkGeom]


class Followed(NamedTuple):
    """Joint angles along a path.

    Attributes:
        path: [T, 6] rad; 0 where there is no solution.
        velocity: [T, 6] rad/s.
        holds: names of `types.OBSTRUCTIONS` -> [T] bool, where this is in the way; the first one that holds counts.
    """

    path: Array
    velocity: Array
    holds: dict[str, Array]


def follow(body: Body, joints: Array, poses: Array, apertures: Array, workspace: Workspace, *, dt: float) -> Followed:
    """Follow poses of the grasp point.

    Every row is solved in closed form; the branch is the one nearest to the current joints at the first row and is
    kept, so that the arm never jumps between postures.

    Args:
        body: of the robot.
        joints: [6] rad, of the arm now.
        poses: [T, 7] of the grasp point in the world.
        apertures: [T] rad.
        workspace: its walls are kept clear of.
        dt: s between rows.
    """
    arm, xp = body.arm, namespace(poses, joints)
    branches = of_rows(lambda pose: kinematics.hand_inverse_kinematics(arm, pose), poses)
    candidates = kinematics.unwrap_near(arm, branches[0], joints)
    gap = xp.max(xp.abs(candidates - joints[None]), axis=-1)
    branch = xp.argmin(xp.where(xp.isnan(gap), xp.inf, gap))
    path = xp.unwrap(branches[:, branch], axis=0)
    path = path + (candidates[branch] - path[0])[None]
    velocity = xp.asarray(xp.gradient(path, dt, axis=0))
    solved = ~xp.any(xp.isnan(path) | xp.isnan(velocity), axis=-1)
    path, velocity = (xp.where(solved[:, None], x, 0.0) for x in (path, velocity))
    low, high = kinematics.joint_limits(arm, xp).T
    within = (path >= low[None]) & (path <= high[None]) & (xp.abs(velocity) <= arm.max_speed)
    holds = {
        "no_ik": ~solved,
        "joint_limit": ~xp.all(within, axis=-1),
        **_too_near(body, path, poses, apertures, workspace),
    }
    return Followed(path, velocity, holds)


def _too_near(body: Body, path: Array, poses: Array, apertures: Array, workspace: Workspace) -> dict[str, Array]:
    """Return [T] bool for table and walls: whether arm joints [T, 6] bring the robot nearer than the margin."""
    xp, links = namespace(path), body.links
    joints = xp.concatenate([path, apertures[:, None], apertures[:, None]], axis=1)
    height = of_rows(lambda row: clearance.height_above_table(links, body.above_table, row), joints)
    return {
        "table": ~(height >= clearance.CLEARANCE_MARGIN),
        "wall": clearance.near_walls(links, body.moving, joints, poses, apertures, workspace),
    }
