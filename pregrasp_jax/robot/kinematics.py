"""Forward kinematics and closed-form inverse kinematics of the UR5e, in float32 and unbatched.

The eight inverse solutions are ordered shoulder, wrist, elbow: index 4 s + 2 w + e. s = 0 is the arm plane on
the side of the base where q1 follows the wrist, s = 1 the other; w = 0 has q5 >= 0; e = 0 has q3 >= 0.
"""

import functools

import jax
import jax.numpy as jnp
import numpy as np

from pregrasp_jax.geometry import matrix_product, matrix_to_pose, quat_to_matrix
from pregrasp_jax.robot import description

_WRIST_SINGULAR = 1e-5
"""sin(q5) below which joints 4 and 6 are parallel: only the sum of their turns matters."""
_REACH_TOLERANCE = 1e-6
"""How far a cosine may exceed 1 by float32 rounding and still count as within reach."""


@functools.cache
def _constants() -> tuple[np.ndarray, ...]:
    a, d, alpha = description.dh_parameters()
    hand = description.flange_from_grasp_point()
    return a, d, alpha, description.world_from_base(), hand, np.linalg.inv(hand)


def forward_kinematics(arm_joints: jax.Array) -> jax.Array:
    """Return the Denavit-Hartenberg frames of the arm.

    Args:
        arm_joints: [6] rad.

    Returns:
        [7, 4, 4] T_base_i for i = 0 (the base, identity) to 6 (the flange), m.

    Source: standard convention, T = Rz(q) Tz(d) Tx(a) Rx(alpha). Agrees with MuJoCo within 1e-6 m, 2e-6 rad.
    """
    a, d, alpha, *_ = _constants()
    cos, sin = jnp.cos(arm_joints), jnp.sin(arm_joints)
    rise, lean = jnp.asarray(np.cos(alpha), jnp.float32), jnp.asarray(np.sin(alpha), jnp.float32)
    zero, one = jnp.zeros(6), jnp.ones(6)
    steps = [
        [cos, -sin * rise, sin * lean, cos * jnp.asarray(a, jnp.float32)],
        [sin, cos * rise, -cos * lean, sin * jnp.asarray(a, jnp.float32)],
        [zero, lean, rise, jnp.asarray(d, jnp.float32)],
        [zero, zero, zero, one],
    ]

    def attach(frame: jax.Array, step: jax.Array) -> tuple[jax.Array, jax.Array]:
        frame = matrix_product(frame, step)
        return frame, frame

    # A scan: XLA fuses an unrolled chain into one expression that takes minutes to compile.
    _, frames = jax.lax.scan(attach, jnp.eye(4), jnp.stack([jnp.stack(row, axis=-1) for row in steps], axis=-2))
    return jnp.concatenate([jnp.eye(4)[None], frames])


def inverse_kinematics(base_from_flange: jax.Array) -> jax.Array:
    """Return all joint positions that bring the flange to a pose.

    Args:
        base_from_flange: [4, 4] T_base_flange, m.

    Returns:
        [8, 6] rad in (-pi, pi], in the order of the module docstring; a solution that does not exist is NaN.

    Source: Hawkins, Analytic inverse kinematics for the Universal Robots UR-5/UR-10 arms, 2013, rederived with
    two-argument arc tangents throughout. FK(IK(T)) = T within 0.05 mm and 1e-4 rad.
    """
    signs = jnp.asarray([(s, w, e) for s in (1.0, -1.0) for w in (1.0, -1.0) for e in (1.0, -1.0)])
    return jax.vmap(_solve_branch, (None, 0))(base_from_flange, signs)


def _solve_branch(base_from_flange: jax.Array, signs: jax.Array) -> jax.Array:
    """Return one solution [6] rad, NaN if there is none."""
    a, d, *_ = _constants()
    shoulder, wrist, elbow = signs
    x6, y6, z6, p6 = base_from_flange[:3].T
    p5 = p6 - d[5] * z6

    # Frame 5 lies at distance d4 from the plane in which the arm folds.
    reach = p5[0] ** 2 + p5[1] ** 2 - d[3] ** 2
    q1 = jnp.atan2(p5[1], p5[0]) + jnp.atan2(d[3], shoulder * jnp.sqrt(jnp.maximum(reach, 0.0)))
    c1, s1 = jnp.cos(q1), jnp.sin(q1)
    normal = jnp.stack([s1, -c1, jnp.zeros_like(c1)])

    nx, ny, nz = _dot(normal, x6), _dot(normal, y6), _dot(normal, z6)
    sine5 = jnp.sqrt(nx**2 + ny**2)
    q5 = jnp.atan2(wrist * sine5, nz)
    free = _free_wrist_turn(base_from_flange, c1 * p5[0] + s1 * p5[1], p5[2] - d[0], jnp.stack([c1, s1]))
    singular = sine5 < _WRIST_SINGULAR
    q6 = jnp.where(singular, free, jnp.atan2(-wrist * ny, wrist * jnp.where(singular, 1.0, nx)))
    c6, s6 = jnp.cos(q6), jnp.sin(q6)
    x4 = jnp.cos(q5) * (c6 * x6 - s6 * y6) - jnp.sin(q5) * z6
    p4 = p5 + d[4] * (s6 * x6 + c6 * y6)

    # What is left is a planar arm of two links, from the shoulder to frame 4.
    u, v = c1 * p4[0] + s1 * p4[1], p4[2] - d[0]
    c3 = (u**2 + v**2 - a[1] ** 2 - a[2] ** 2) / (2 * a[1] * a[2])
    q3 = elbow * jnp.atan2(jnp.sqrt(jnp.maximum((1 - c3) * (1 + c3), 0.0)), c3)
    q2 = jnp.atan2(v, u) - jnp.atan2(a[2] * jnp.sin(q3), a[1] + a[2] * jnp.cos(q3))
    q4 = jnp.atan2(x4[2], c1 * x4[0] + s1 * x4[1]) - q2 - q3

    exists = (reach >= 0) & (jnp.abs(c3) <= 1 + _REACH_TOLERANCE)
    return jnp.where(exists, _wrap(jnp.stack([q1, q2, q3, q4, q5, q6])), jnp.nan)


def _free_wrist_turn(base_from_flange: jax.Array, u: jax.Array, v: jax.Array, heading: jax.Array) -> jax.Array:
    """Choose q6 where it is free: wrist 1 goes toward the shoulder if frame 5 is far from it, away if it is near.

    That reaches every pose which some choice reaches. (u, v) is frame 5 seen from the shoulder in the arm's plane,
    `heading` [2] the plane's direction.
    """
    a, *_ = _constants()
    sign = jnp.where(jnp.hypot(u, v) >= np.abs(a[1]), 1.0, -1.0)
    outward = sign * jnp.stack([u * heading[0], u * heading[1], v])
    return jnp.atan2(-_dot(outward, base_from_flange[:3, 0]), -_dot(outward, base_from_flange[:3, 1]))


def _dot(a: jax.Array, b: jax.Array) -> jax.Array:
    """Return a . b in full float32, where `jnp.dot` is what an accelerator does by default."""
    return jnp.sum(a * b)


def _wrap(angle: jax.Array) -> jax.Array:
    """Return angles in (-pi, pi]."""
    return -jnp.mod(np.pi - angle, 2 * np.pi) + np.pi


def grasp_pose(arm_joints: jax.Array) -> jax.Array:
    """Return the pose [7] of the grasp point in the world (x forward, y lateral, z up) for arm joints [6] rad."""
    *_, world_from_base, hand, _ = _constants()
    flange = forward_kinematics(arm_joints)[-1]
    matrix = matrix_product(matrix_product(world_from_base, flange), hand)
    return matrix_to_pose(matrix)


def flange_from_hand_pose(hand_pose: jax.Array) -> jax.Array:
    """Return T_base_flange [4, 4] that puts the grasp point at a world pose [7]."""
    *_, world_from_base, _, grasp_point_from_flange = _constants()
    matrix = jnp.eye(4).at[:3, :3].set(quat_to_matrix(hand_pose[3:])).at[:3, 3].set(hand_pose[:3])
    return matrix_product(matrix_product(np.linalg.inv(world_from_base), matrix), grasp_point_from_flange)


def hand_inverse_kinematics(hand_pose: jax.Array) -> jax.Array:
    """Return `inverse_kinematics` [8, 6] for a world pose [7] of the grasp point."""
    return inverse_kinematics(flange_from_hand_pose(hand_pose))


def unwrap_near(joints: jax.Array, reference: jax.Array) -> jax.Array:
    """Shift joints [..., 6] by whole turns to lie within pi of `reference` [6], where the joint limits allow it."""
    low, high = joint_limits().T
    turns = jnp.round((jnp.broadcast_to(reference, joints.shape) - joints) / (2 * np.pi))
    near = joints + 2 * np.pi * turns
    allowed = (near >= jnp.broadcast_to(low, near.shape)) & (near <= jnp.broadcast_to(high, near.shape))
    return jnp.where(allowed, near, joints)


@functools.cache
def _joint_limits() -> np.ndarray:
    return np.stack([description.joint_range(name) for name in description.ARM_JOINTS])


def joint_limits() -> jax.Array:
    """Return the lower and upper limits [6, 2] of the arm joints, rad."""
    return jnp.asarray(_joint_limits(), jnp.float32)
