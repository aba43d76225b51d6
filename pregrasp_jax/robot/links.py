"""The links of a robot and their shapes as convex hulls, derived from its MJCF.

A link is a body of the MJCF. `make_links` tabulates them once, when a robot is made.
"""

from collections.abc import Sequence

import jax
import mujoco
import numpy as np

from pregrasp_jax.assets.hulls import make_hulls
from pregrasp_jax.robot.chain import LinkGeom, Links
from pregrasp_jax.types import FULL_TOPOLOGY

_CAPSULE_RINGS = ((9, 0.0), (6, np.deg2rad(40.0)), (1, np.deg2rad(90.0)))
"""Vertices and latitude of the rings on each half sphere, 32 in all; the best of a search over such layouts."""

CAPSULE_ERROR = 0.0636
"""Largest distance between a capsule and its polyhedron, as a share of the radius: 3.8 mm at a UR5e's shoulder."""


def make_links(mj_model: mujoco.MjModel, joints: Sequence[str]) -> Links:
    """Tabulate all bodies of a model that holds nothing but a robot.

    Args:
        mj_model: of the robot alone.
        joints: names of the joints whose positions will be given; others must follow one of them by an equality.

    Raises:
        ValueError: a geom is neither capsule nor box, the two shapes that every engine collides; a body has several
            joints, or one that nobody drives; a joint turns about another point than its body's origin, is
            not 0 as drawn, or follows another one by more than a ratio.
    """
    bodies = range(1, mj_model.nbody)
    moved_by = _moved_by(mj_model, joints)
    joint, turn, slide = (
        np.zeros(len(bodies), int),
        np.zeros(len(bodies), np.float32),
        np.zeros(len(bodies), np.float32),
    )
    axes = np.zeros((len(bodies), 3))
    for link, body in enumerate(bodies):
        if mj_model.body_jntnum[body] > 1:
            raise ValueError(f"body '{mj_model.body(body).name}' of the robot has several joints; allowed is one")
        if mj_model.body_jntnum[body]:
            own = int(mj_model.body_jntadr[body])
            kind = mujoco.mjtJoint(int(mj_model.jnt_type[own]))
            if own not in moved_by or kind not in (mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE):
                raise ValueError(
                    f"joint '{mj_model.joint(own).name}' of the robot; allowed are hinges and slides among "
                    f"{', '.join(joints)}, or coupled to one of them"
                )
            anchored = kind == mujoco.mjtJoint.mjJNT_HINGE and mj_model.jnt_pos[own].any()
            if anchored or mj_model.qpos0[mj_model.jnt_qposadr[own]]:
                name = mj_model.joint(own).name
                raise ValueError(f"joint '{name}' of the robot has a pos or a ref; allowed is none: move its body")
            axes[link], (joint[link], ratio) = mj_model.jnt_axis[own], moved_by[own]
            (turn if kind == mujoco.mjtJoint.mjJNT_HINGE else slide)[link] = ratio
    geoms = tuple(_link_geom(mj_model, geom) for geom in range(mj_model.ngeom))
    parents = np.asarray(mj_model.body_parentid[1:]) - 1
    return Links(
        names=tuple(mj_model.body(body).name for body in bodies),
        parents=parents,
        fixed=np.stack([pose_to_matrix(mj_model.body_pos[b], mj_model.body_quat[b]) for b in bodies]),
        to_axis=np.stack([_z_onto(axis) for axis in axes]),
        joint=joint,
        turn=turn,
        slide=slide,
        ancestors=_ancestors(parents),
        geoms=geoms,
        hulls=jax.tree.map(np.asarray, make_hulls([_hull_points(geom) for geom in geoms], FULL_TOPOLOGY)),
        hull_links=np.array([geom.link for geom in geoms], np.int32),
    )


def pose_to_matrix(pos: np.ndarray, quat: np.ndarray) -> np.ndarray:
    """Return the 4 x 4 matrix of a position and a wxyz quaternion, in float64."""
    rotation = np.zeros(9)
    mujoco.mju_quat2Mat(rotation, np.asarray(quat, np.float64) / np.linalg.norm(quat))
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = rotation.reshape(3, 3), pos
    return matrix


def _moved_by(mj_model: mujoco.MjModel, joints: Sequence[str]) -> dict[int, tuple[int, float]]:
    """Return, per joint id, the index into `joints` it follows and its ratio to it."""
    ids = [mj_model.joint(name).id for name in joints]
    result = {joint: (index, 1.0) for index, joint in enumerate(ids)}
    for equality in np.flatnonzero(mj_model.eq_type == mujoco.mjtEq.mjEQ_JOINT):
        follower, leader = mj_model.eq_obj1id[equality], mj_model.eq_obj2id[equality]
        if follower not in result and leader in ids:
            if mj_model.eq_data[equality, [0, 2, 3, 4]].any():
                raise ValueError(
                    f"joint '{mj_model.joint(follower).name}' of the robot follows by polycoef "
                    f"{mj_model.eq_data[equality, :5].tolist()}; allowed is a ratio alone, 0 r 0 0 0"
                )
            result[follower] = (ids.index(leader), float(mj_model.eq_data[equality, 1]))
    return result


def _ancestors(parents: np.ndarray) -> np.ndarray:
    """Return the ancestors [R, L] 1, 2, 4, ... steps above (L is the world)."""
    world = len(parents)
    parent = np.append(np.where(parents >= 0, parents, world), world)
    ancestors = []
    while (parent[:-1] < world).any():
        ancestors.append(parent[:-1])
        parent = parent[parent]
    return np.array(ancestors, int).reshape(-1, world)


def _z_onto(axis: np.ndarray) -> np.ndarray:
    """Return a rotation [4, 4] that turns z onto a unit axis; the identity for a zero axis (a fixed link)."""
    quat = np.array([1.0, 0.0, 0.0, 0.0])
    if axis.any():
        mujoco.mju_quatZ2Vec(quat, axis)
    return pose_to_matrix(np.zeros(3), quat)


def _link_geom(mj_model: mujoco.MjModel, geom: int) -> LinkGeom:
    local, radius = _shape(mj_model, geom)
    pose = pose_to_matrix(mj_model.geom_pos[geom], mj_model.geom_quat[geom])
    points = local @ pose[:3, :3].T + pose[:3, 3]
    return LinkGeom(mj_model.geom(geom).name, int(mj_model.geom_bodyid[geom]) - 1, points, radius)


def _shape(mj_model: mujoco.MjModel, geom: int) -> tuple[np.ndarray, float]:
    """Return points and radius of a geom in its own frame."""
    size = mj_model.geom_size[geom]
    if mj_model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_CAPSULE:
        return np.array([[0, 0, -size[1]], [0, 0, size[1]]]), float(size[0])
    if mj_model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_BOX:
        return size * np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]), 0.0
    raise ValueError(f"geom '{mj_model.geom(geom).name}' of the robot must be a capsule or a box")


def _hull_points(geom: LinkGeom) -> np.ndarray:
    return geom.points if geom.radius == 0 else _capsule_points(geom.points[0], geom.points[1], geom.radius)


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
