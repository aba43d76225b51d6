"""Motion primitives: action <-> push, the half ring of allowed ends, and joint trajectories along straight lines.

All functions are unbatched. A trajectory is sampled every `CTRL_DT`; arrays have a static number of rows and
`num_ctrl` says how many of them are executed.
"""

import math

import flax.struct as struct
import jax
import jax.numpy as jnp

from pregrasp_jax import grid
from pregrasp_jax.physics.base import CTRL_DT
from pregrasp_jax.robot import clearance, description, kinematics
from pregrasp_jax.robot import model as robot
from pregrasp_jax.types import OPEN

SETTLE_TIME = 0.25
"""s of standing still after a push."""

APERTURE_TIME = 0.5
"""s for the fingers to open or close before a push that changes the aperture."""

MAX_JOINT_SPEED = 3.14
"""rad/s, 180 degrees per second for every joint (UR5e data sheet)."""

_TOLERANCE = 1e-6
"""m; cells exactly on the rim or beside the hand belong to the ring in spite of rounding."""


class Plan(struct.PyTreeNode):
    """A joint trajectory.

    Attributes:
        ctrl: [T, 7] float32 rad, position commands with velocity feed-forward.
        num_ctrl: () int32 rows to execute.
        reachable: () bool; if False nothing may be executed.
    """

    ctrl: jax.Array
    num_ctrl: jax.Array
    reachable: jax.Array


def half_ring_mask(p1: jax.Array, *, r_in: float, r_out: float, full_ring: bool = False) -> jax.Array:
    """Return the cells [H, W] bool whose centres may end the next push (Eq. 1).

    Args:
        p1: [2] m, commanded end of the last push.
        r_in: m, inner radius, inclusive.
        r_out: m, outer radius, inclusive.
        full_ring: also allow angles beyond +-90 degrees (ablation).
    """
    centers = grid.cell_centers()
    dx, dy = centers[None, :] - p1[0], centers[:, None] - p1[1]
    distance = jnp.hypot(dx, dy)
    ring = (distance >= r_in - _TOLERANCE) & (distance <= r_out + _TOLERANCE)
    return ring if full_ring else ring & (dx >= -_TOLERANCE)


def minimum_jerk(share: jax.Array) -> jax.Array:
    """Return the travelled share [...] of a minimum-jerk motion after a `share` [...] of its time, clipped to [0, 1].

    Source: Flash and Hogan 1985, 10 s^3 - 15 s^4 + 6 s^5.
    """
    s = jnp.clip(share, 0.0, 1.0)
    return s**3 * (10 - 15 * s + 6 * s**2)


def num_push_rows(max_distance: float, push_speed: float) -> int:
    """Return the static number of control rows T that a push of at most `max_distance` m needs."""
    return math.ceil((APERTURE_TIME + max_distance / push_speed + SETTLE_TIME) / CTRL_DT) + 1


def plan_push(
    joints: jax.Array,
    p1: jax.Array,
    p2: jax.Array,
    aperture_before: jax.Array,
    aperture: jax.Array,
    *,
    push_speed: float,
    num_rows: int,
) -> Plan:
    """Plan a straight push at constant height: change the aperture if it differs, move, stand still.

    Args:
        joints: [6] rad, where the arm is now.
        p1: [2] m, start of the line.
        p2: [2] m, its end.
        aperture_before: () int, aperture now.
        aperture: () int, aperture during the push.
        push_speed: m/s, mean speed of the minimum-jerk profile.
        num_rows: static number of rows T, from `num_push_rows`.

    Returns:
        The plan; unreachable without a joint solution all along the line, at joint position or speed limits, with
        an arm link too near to the table, or when the line is longer than T rows allow.
    """
    distance = jnp.linalg.norm(p2 - p1)
    wait = jnp.where(aperture_before == aperture, 0.0, APERTURE_TIME)
    duration = jnp.maximum(distance / push_speed, CTRL_DT)
    time = CTRL_DT * jnp.arange(num_rows)
    share = minimum_jerk((time - wait) / duration)
    xy = p1[None] + share[:, None] * (p2 - p1)[None]
    positions = jnp.concatenate([xy, jnp.full((num_rows, 1), robot.PUSH_HEIGHT)], axis=1)
    opening = minimum_jerk(time / APERTURE_TIME)
    before, after = finger_command(aperture_before), finger_command(aperture)
    fingers = before + opening * (after - before)
    num_ctrl = jnp.ceil((wait + duration + SETTLE_TIME) / CTRL_DT - 1e-3).astype(jnp.int32)
    arm, ok = plan_arm(joints, positions)
    reachable = jnp.all(ok) & (num_ctrl <= num_rows)
    return Plan(jnp.concatenate([arm, fingers[:, None]], axis=1), num_ctrl, reachable)


def plan_arm(joints: jax.Array, positions: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Follow grasp-point positions with the hand horizontal and pointing along +x.

    Every row is solved in closed form; the branch is the one nearest to the current joints at the first row and
    is kept, so that the arm never jumps between postures.

    Args:
        joints: [6] rad, where the arm is now.
        positions: [T, 3] m, one per control row.

    Returns:
        Commands [T, 6] rad with velocity feed-forward (zeros where there is no solution), and ok [T] bool.
    """
    level = jnp.broadcast_to(jnp.array([1.0, 0.0, 0.0, 0.0]), (len(positions), 4))
    branches = jax.vmap(kinematics.hand_inverse_kinematics)(jnp.concatenate([positions, level], axis=1))
    candidates = kinematics.unwrap_near(branches[0], joints)
    gap = jnp.max(jnp.abs(candidates - joints[None]), axis=-1)
    branch = jnp.argmin(jnp.where(jnp.isnan(gap), jnp.inf, gap))
    path = jnp.unwrap(branches[:, branch], axis=0)
    path += (candidates[branch] - path[0])[None]
    velocity = jnp.asarray(jnp.gradient(path, CTRL_DT, axis=0))
    solved = ~jnp.any(jnp.isnan(path) | jnp.isnan(velocity), axis=-1)
    path, velocity = (jnp.where(solved[:, None], x, 0.0) for x in (path, velocity))
    low, high = kinematics.joint_limits().T
    within = (path >= low[None]) & (path <= high[None]) & (jnp.abs(velocity) <= MAX_JOINT_SPEED)
    clear = jax.vmap(clearance.link_clearance)(path) >= clearance.CLEARANCE_MARGIN
    lead = jnp.asarray(robot.feed_forward(description.robot_model())[:6], jnp.float32)[None]
    return path + lead * velocity, solved & jnp.all(within, axis=-1) & clear


def finger_command(aperture: jax.Array) -> jax.Array:
    """Return the finger drive angle, rad, of an aperture."""
    return jnp.where(aperture == OPEN, robot.FINGER_OPEN, robot.FINGER_CLOSED)
