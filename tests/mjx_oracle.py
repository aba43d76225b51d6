"""C MuJoCo on the same coarse hulls and options as the `mjx` engine, and exact penetration of convex solids."""

import copy
from typing import NamedTuple

import mujoco
import numpy as np
from scipy.spatial import ConvexHull

from pregrasp_jax.physics.mjx_model import make_reference_model
from pregrasp_jax.robot import get_robot
from pregrasp_jax.scene import model as slot_model
from pregrasp_jax.spaces.workspace import TABLE
from pregrasp_jax.types import CTRL_DT, MAX_OBJECTS, HullBank

ROBOT = get_robot("ur5e_rg2")


class Touch(NamedTuple):
    """The deepest contact of two geoms; the normal points from the first name to the second."""

    dist: float
    pos: np.ndarray
    normal: np.ndarray
    parameters: np.ndarray


class CoarseModel:
    """The native slot model of coarse hulls with MJX's solver options, filled with one scene at a time."""

    def __init__(self, bank: HullBank):
        self.slots = make_reference_model(bank, ROBOT, TABLE)
        self.model = copy.copy(self.slots.mj_model)

    def fill(self, object_ids: np.ndarray, poses: np.ndarray) -> mujoco.MjData:
        """Return data with objects [<= MAX_OBJECTS] at poses and the robot at the start."""
        empty = MAX_OBJECTS - len(object_ids)
        slot_model.write_slots(self.slots, self.model, np.append(object_ids, np.full(empty, -1)))
        data = mujoco.MjData(self.model)
        ROBOT.set_home(self.model, data)
        data.qpos[self.slots.slot_qpos_ids] = np.vstack([poses, slot_model.parking_poses()[len(poses) :]])
        return data

    def touches(self, data: mujoco.MjData) -> dict[tuple[str, str], Touch]:
        """Return the deepest contact of every pair of geoms, by their names in order."""
        mujoco.mj_kinematics(self.model, data)
        mujoco.mj_comPos(self.model, data)
        mujoco.mj_collision(self.model, data)
        found = []
        for contact in data.contact[: data.ncon]:
            names = [self.model.geom(g).name for g in contact.geom]
            parameters = np.concatenate([contact.friction, contact.solref, contact.solimp])
            found.append((*names, contact.dist, contact.pos, contact.frame[:3], parameters))
        return deepest(found)

    def push(self, data: mujoco.MjData, ctrl: np.ndarray, num_ctrl: int) -> np.ndarray:
        """Run control rows as the engines do and return the object poses [MAX_OBJECTS, 7]."""
        substeps = round(CTRL_DT / self.model.opt.timestep)
        for k in range(num_ctrl * substeps):
            row, share = divmod(k, substeps)
            following = ctrl[min(row + 1, len(ctrl) - 1)]
            data.ctrl[:] = ctrl[row] + share / substeps * (following - ctrl[row])
            mujoco.mj_step(self.model, data)
        return data.qpos[self.slots.slot_qpos_ids]

    def distance(self, data: mujoco.MjData, names: tuple[str, str]) -> float:
        """Return the signed distance of two geoms by `mj_geomDistance`."""
        return mujoco.mj_geomDistance(self.model, data, *(self.model.geom(name).id for name in names), 1.0, None)

    def corners(self, data: mujoco.MjData, name: str) -> np.ndarray:
        """Return the corners [n, 3] in the world of a hull or box geom."""
        geom = self.model.geom(name)
        if geom.type[0] == mujoco.mjtGeom.mjGEOM_BOX:
            local = geom.size * np.array(np.meshgrid(*[[-1, 1]] * 3)).reshape(3, -1).T
        else:
            first, count = (x[geom.dataid[0]] for x in (self.model.mesh_vertadr, self.model.mesh_vertnum))
            local = self.model.mesh_vert[first : first + count]
        return local @ data.geom_xmat[geom.id].reshape(3, 3).T + data.geom_xpos[geom.id]


def deepest(contacts: list[tuple]) -> dict[tuple[str, str], Touch]:
    """Return the deepest of contacts (name, name, dist, pos, normal, parameters) for each pair of names, in order."""
    touches: dict[tuple[str, str], Touch] = {}
    for first, second, dist, pos, normal, parameters in contacts:
        swap = first > second
        key = (second, first) if swap else (first, second)
        if key not in touches or dist < touches[key].dist:
            outward = (-1 if swap else 1) * np.array(normal)
            touches[key] = Touch(float(dist), np.array(pos), outward, np.array(parameters))
    return touches


def ways_out(a: np.ndarray, b: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return by how much [k] and along which normals [k, 3] the hull of points a [n, 3] reaches into that of b [m, 3].

    They are the faces of the Minkowski difference, normals from a to b, the least translation that parts them first;
    negative where the two are apart.
    """
    faces = ConvexHull((a[:, None] - b[None]).reshape(-1, 3)).equations
    faces = faces[np.argsort(-faces[:, 3])]
    return -faces[:, 3], faces[:, :3]


def least_translation(a: np.ndarray, b: np.ndarray) -> float:
    """Return how far the hull of points a [n, 3] must move to leave that of b [m, 3]."""
    return float(ways_out(a, b)[0][0])


def margin_of_the_first(depths: np.ndarray, normals: np.ndarray, angle: float) -> float:
    """Return by how much the first way out is shorter than any other that differs by more than an angle, rad."""
    other = normals @ normals[0] < np.cos(angle)
    return float(depths[other].min() - depths[0]) if other.any() else np.inf


def overlap_along(a: np.ndarray, b: np.ndarray, normal: np.ndarray) -> float:
    """Return how far a reaches into b along the normal from a to b."""
    return float((a @ normal).max() - (b @ normal).min())


def outside_of(points: np.ndarray, position: np.ndarray) -> float:
    """Return how far a position [3] lies outside of the hull of points [n, 3]; negative inside."""
    faces = ConvexHull(points).equations
    return float((faces[:, :3] @ position + faces[:, 3]).max())
