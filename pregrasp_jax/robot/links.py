"""Where every part of the robot is, and its shape as convex hulls in link frames; both derived from the MJCF.

A link is a body of the MJCF: base, six arm links, the hand and, per side, the driver and the tip of a finger.
"""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from pregrasp_jax.assets.hulls import make_hulls
from pregrasp_jax.robot import description
from pregrasp_jax.robot.kinematics import matrix_product, matrix_to_pose
from pregrasp_jax.types import FULL_TOPOLOGY, Hulls

_CAPSULE_RINGS = ((9, 0.0), (6, np.deg2rad(40.0)), (1, np.deg2rad(90.0)))
"""Vertices and latitude of the rings on each half sphere, 32 in all; the best of a search over such layouts."""

CAPSULE_ERROR = 0.0636
"""Largest distance between a capsule and its polyhedron, as a share of the radius: 3.8 mm at the shoulder."""


class Link(NamedTuple):
    """One body of the robot.

    Attributes:
        name: as in the MJCF.
        parent: index of the parent link, -1 for the world.
        pos: [3] m in the parent.
        quat: [4] wxyz in the parent.
        axis: [3] joint axis, zero where the link is fixed.
        joint: index into `description.JOINTS` of the joint that moves it.
        ratio: joint angle per angle of that joint; -1 for a tip, which mirrors its driver.
    """

    name: str
    parent: int
    pos: np.ndarray
    quat: np.ndarray
    axis: np.ndarray
    joint: int
    ratio: float


class LinkGeom(NamedTuple):
    """One collision geom, as the points whose hull it is, grown by a radius (0 for a box).

    Attributes:
        name: as in the MJCF.
        link: index into `links()`.
        points: [2, 3] ends of a capsule or [8, 3] corners of a box, m in the link frame.
        radius: m.
    """

    name: str
    link: int
    points: np.ndarray
    radius: float


@functools.cache
def links() -> tuple[Link, ...]:
    """Return the robot's links, parents first."""
    mj_model = description.robot_model()
    base = mj_model.body(description.BASE_BODY).id
    bodies = [i for i in range(mj_model.nbody) if mj_model.body_rootid[i] == base]
    moved_by = _moved_by(mj_model)
    result = []
    for body in bodies:
        joint = mj_model.body_jntadr[body]
        axis, (driver, ratio) = (
            (mj_model.jnt_axis[joint].copy(), moved_by[joint]) if joint >= 0 else (np.zeros(3), (0, 0.0))
        )
        parent = mj_model.body_parentid[body]
        result.append(
            Link(
                name=mj_model.body(body).name,
                parent=bodies.index(parent) if parent in bodies else -1,
                pos=mj_model.body_pos[body].copy(),
                quat=mj_model.body_quat[body].copy(),
                axis=axis,
                joint=driver,
                ratio=ratio,
            )
        )
    return tuple(result)


def _moved_by(mj_model: mujoco.MjModel) -> dict[int, tuple[int, float]]:
    """Return, per joint id, the index into `JOINTS` it follows and its ratio to it."""
    ids = [mj_model.joint(name).id for name in description.JOINTS]
    result = {joint: (index, 1.0) for index, joint in enumerate(ids)}
    for equality in range(mj_model.neq):
        follower, leader = mj_model.eq_obj1id[equality], mj_model.eq_obj2id[equality]
        if follower not in result:
            result[follower] = (ids.index(leader), float(mj_model.eq_data[equality, 1]))
    return result


def link_matrices(joint_pos: jax.Array) -> jax.Array:
    """Return the homogeneous world poses [L, 4, 4] of the links for joint positions [8] rad; see `link_poses`.

    All links at once, in log2(depth) rounds: each is multiplied onto its ancestor 1, 2, 4, ... steps above. The
    rounds are a scan because XLA fuses an unrolled chain into one expression that takes minutes to compile.
    """
    fixed, to_axis, joint, ratio, ancestors = _chain()
    angle = joint_pos[joint] * ratio
    cos, sin, zero, one = jnp.cos(angle), jnp.sin(angle), jnp.zeros_like(angle), jnp.ones_like(angle)
    turn = [[cos, -sin, zero, zero], [sin, cos, zero, zero], [zero, zero, one, zero], [zero, zero, zero, one]]
    about_z = jnp.stack([jnp.stack(row, axis=-1) for row in turn], axis=-2)
    world = matrix_product(matrix_product(fixed @ to_axis, about_z), to_axis.swapaxes(1, 2))

    def climb(world: jax.Array, ancestor: jax.Array) -> tuple[jax.Array, None]:
        # The extra row is the world, the ancestor of whatever has run out of parents.
        padded = jnp.concatenate([world, jnp.eye(4)[None]])
        return matrix_product(padded[ancestor], world), None

    return jax.lax.scan(climb, world, jnp.asarray(ancestors))[0]


def link_poses(joint_pos: jax.Array) -> jax.Array:
    """Return where the links are.

    Args:
        joint_pos: [8] rad, as in `PhysicsObservation`; tips mirror their drivers.

    Returns:
        [L, 7] world poses in the order of `links()`. Agrees with MuJoCo's kinematics within 1e-6 m and 1e-6.
    """
    return jax.vmap(matrix_to_pose)(link_matrices(joint_pos))


@functools.cache
def _chain() -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return the fixed numbers of `link_matrices`.

    Returns:
        T_parent_link [L, 4, 4], a rotation [L, 4, 4] of z onto the joint axis, joint [L] and ratio [L], and the
        ancestors [R, L] 1, 2, 4, ... steps above (L is the world).
    """
    chain = links()
    fixed = np.stack([description.pose_to_matrix(link.pos, link.quat) for link in chain])
    to_axis = np.stack([_z_onto(link.axis) for link in chain])
    parent = np.array([link.parent if link.parent >= 0 else len(chain) for link in chain] + [len(chain)])
    ancestors = []
    while (parent[:-1] < len(chain)).any():
        ancestors.append(parent[:-1])
        parent = parent[parent]
    joint, ratio = np.array([link.joint for link in chain]), np.array([link.ratio for link in chain], np.float32)
    return fixed, to_axis, joint, ratio, np.stack(ancestors)


def _z_onto(axis: np.ndarray) -> np.ndarray:
    """Return a rotation [4, 4] that turns z onto a unit axis; the identity for a zero axis (a fixed link)."""
    quat = np.array([1.0, 0.0, 0.0, 0.0])
    if axis.any():
        mujoco.mju_quatZ2Vec(quat, axis)
    return description.pose_to_matrix(np.zeros(3), quat)


@functools.cache
def link_geoms() -> tuple[LinkGeom, ...]:
    """Return the robot's geoms in the order of the MJCF.

    Raises:
        ValueError: a geom is neither capsule nor box, the two shapes that every engine collides.
    """
    mj_model = description.robot_model()
    index = {mj_model.body(link.name).id: i for i, link in enumerate(links())}
    result = []
    for geom in range(mj_model.ngeom):
        body = int(mj_model.geom_bodyid[geom])
        if body not in index:
            continue
        local, radius = _shape(mj_model, geom)
        pose = description.pose_to_matrix(mj_model.geom_pos[geom], mj_model.geom_quat[geom])
        points = local @ pose[:3, :3].T + pose[:3, 3]
        result.append(LinkGeom(mj_model.geom(geom).name, index[body], points, radius))
    return tuple(result)


def _shape(mj_model: mujoco.MjModel, geom: int) -> tuple[np.ndarray, float]:
    """Return points and radius of a geom in its own frame."""
    size = mj_model.geom_size[geom]
    if mj_model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_CAPSULE:
        return np.array([[0, 0, -size[1]], [0, 0, size[1]]]), float(size[0])
    if mj_model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_BOX:
        return size * np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]), 0.0
    raise ValueError(f"geom '{mj_model.geom(geom).name}' of the robot must be a capsule or a box")


@functools.cache
def robot_hulls() -> tuple[Hulls, np.ndarray]:
    """Return the robot as convex hulls.

    Returns:
        Hulls [M] at `FULL_TOPOLOGY` in link frames, and the link [M] int32 of each, in the order of `link_geoms()`.
        Boxes are exact; a capsule's polyhedron straddles its surface within `CAPSULE_ERROR` of its radius.
    """
    geoms = link_geoms()
    parts = [
        geom.points if geom.radius == 0 else _capsule_points(geom.points[0], geom.points[1], geom.radius)
        for geom in geoms
    ]
    hulls = jax.tree.map(jnp.asarray, make_hulls(parts, FULL_TOPOLOGY))
    return hulls, np.array([geom.link for geom in geoms], np.int32)


def _capsule_points(start: np.ndarray, end: np.ndarray, radius: float) -> np.ndarray:
    """Return 32 points whose hull is as far inside the capsule at the face centres as outside at the corners."""
    axis = (end - start) / np.linalg.norm(end - start)
    side = np.cross(axis, np.eye(3)[np.abs(axis).argmin()])
    side /= np.linalg.norm(side)
    basis = np.stack([side, np.cross(axis, side), axis])
    half = np.concatenate([_ring(count, latitude) for count, latitude in _CAPSULE_RINGS])
    scale = radius * (1 + CAPSULE_ERROR)
    return np.concatenate([end + scale * half @ basis, start + scale * (half * [1, 1, -1]) @ basis])


def _ring(count: int, latitude: float) -> np.ndarray:
    angle = 2 * np.pi * np.arange(count) / count
    around = np.cos(latitude)
    return np.stack([around * np.cos(angle), around * np.sin(angle), np.full(count, np.sin(latitude))], axis=-1)
