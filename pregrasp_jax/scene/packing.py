"""Tightly packed scenes: objects are placed apart, drawn together by a velocity servo, and left to settle.

A constant pull (2 N at table height in the reference implementation) topples every scene on a slippery
table. A servo does not: each object is driven toward the centre at a bounded speed by a force at its centre
of mass, and a weak torque holds it upright while it is being moved. Both end before the scene settles.
"""

import mujoco
import numpy as np
from mujoco.batch import Batch

from pregrasp_jax.scene import model as slot_model
from pregrasp_jax.scene.model import SlotModel
from pregrasp_jax.scene.spec import table_spec
from pregrasp_jax.spaces.workspace import TABLE
from pregrasp_jax.types import HullBank

SERVO_SPEED = 0.18
"""m/s toward the centre."""
SERVO_RATE = 40.0
"""1/s, force per mass and speed error."""
MAX_ACCELERATION = 3.0
"""m/s^2, bound on the servo's planar force per mass; it fades over the last quarter, so that nothing springs back."""
UPRIGHT_RATE = 400.0
"""1/s^2, torque per inertia and tilt; the damping is critical."""
SERVO_STEPS, CHUNK = 400, 5
"""Physics steps of servo at most, and between two updates of its forces."""
REST_STEPS = 125
"""Physics steps (0.5 s) without any force but gravity."""

NEAR = 3e-3
"""m; every object of a packed scene has another one this close."""
MAX_PENETRATION = 1e-3
"""m."""
MAX_TILT = 0.1
"""rad."""
MAX_REST_SPEED, MAX_REST_SPIN = 0.01, 0.05
"""m/s and rad/s at the end of the settling time; light objects rock by a few mrad on their four contacts."""
MAX_RADIUS = 0.245
"""m; a packed scene lies within this distance of the centre, so that no yaw brings it to the open hand."""
_PLACE_GAP = 0.004
_PLACE_STEP = 0.005
"""m; start gap between two footprints, and step of the search for a free place."""


def footprint_radius(bank: HullBank) -> np.ndarray:
    """Return the radius [N] m of each object's vertical projection about its frame's origin."""
    points = np.asarray(bank.full.vertices)[..., :2]
    per_hull = np.linalg.norm(points, axis=-1).max(axis=1)
    hulls = np.asarray(bank.object_hulls)
    return np.where(hulls >= 0, per_hull[hulls], 0.0).max(axis=1)


def place(radii: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return poses [n, 7] of n standing objects whose footprint circles do not touch, close to the centre.

    The first object stands at the centre; each later one stands as near to it as a random direction allows.
    """
    poses = np.zeros((len(radii), 7))
    for i, radius in enumerate(radii):
        angle, yaw = rng.uniform(0, 2 * np.pi, 2)
        direction, xy = np.array([np.cos(angle), np.sin(angle)]), np.zeros(2)
        while (np.linalg.norm(poses[:i, :2] - xy, axis=1) < radii[:i] + radius + _PLACE_GAP).any():
            xy = xy + _PLACE_STEP * direction
        poses[i] = [*xy, 0.0, np.cos(yaw / 2), 0.0, 0.0, np.sin(yaw / 2)]
    return poses


class Packer:
    """Packs many scenes at once on the table alone (the robot is absent, so it cannot be in the way)."""

    def __init__(self, bank: HullBank, num_scenes: int, *, threads: int = 0):
        slot_model.silence_warnings()
        self._model = slot_model.make_slot_model(table_spec(TABLE), bank)
        self._batch = Batch(self._model.mj_model, num_scenes, threads)
        names = (*slot_model.GEOM_FIELDS, *slot_model.BODY_FIELDS, slot_model.RBOUND)
        self._expanded = {name: self._batch.expand(name) for name in names}
        self._mass = np.append(np.asarray(bank.mass), 0.0)
        self._inertia = np.append(np.asarray(bank.inertia).max(axis=1), 0.0)
        self._com = np.append(np.asarray(bank.com)[:, 2], 0.0)
        self._radii = np.append(footprint_radius(bank), 0.0)

    def pack(self, object_ids: np.ndarray, rngs: list[np.random.Generator]) -> tuple[np.ndarray, np.ndarray]:
        """Try to pack one scene per row.

        Args:
            object_ids: [E, MAX_OBJECTS] int, -1 for an empty slot (empty slots last).
            rngs: E generators, one per scene, so that a scene depends on its own seed only.

        Returns:
            Poses [E, MAX_OBJECTS, 7] and accepted [E] bool: whether the scene is packed as the module demands.
        """
        poses = self._start(object_ids, rngs)
        batch = self._batch
        batch.reset()
        batch.warning[:] = 0
        qpos, force = batch.bind("qpos"), batch.bind("xfrc_applied")
        qpos[:, self._model.slot_qpos_ids] = poses
        for strength in np.minimum(1.0, 4 * (1 - np.arange(0, SERVO_STEPS, CHUNK) / SERVO_STEPS)):
            force[:, self._model.slot_body_ids] = self._servo(object_ids, strength)
            batch.step(nstep=CHUNK)
        force[:] = 0
        batch.step(nstep=REST_STEPS)
        packed = qpos[:, self._model.slot_qpos_ids].copy()
        return packed, self._accept(object_ids, packed)

    def _start(self, object_ids: np.ndarray, rngs: list[np.random.Generator]) -> np.ndarray:
        sims = np.arange(len(object_ids))
        slot_model.write_batch_slots(self._model, self._expanded, sims, object_ids)
        self._batch.set_const(sims)
        slot_model.write_batch_fields(self._model, self._expanded, sims, object_ids, [slot_model.RBOUND])
        poses = np.tile(slot_model.parking_poses(), (len(object_ids), 1, 1))
        for row, ids, rng in zip(poses, object_ids, rngs, strict=True):
            count = int((ids >= 0).sum())
            row[:count] = place(self._radii[ids[:count]], rng)
        return poses

    def _servo(self, object_ids: np.ndarray, strength: float) -> np.ndarray:
        """Return wrenches [E, MAX_OBJECTS, 6] (force at the centre of mass, torque) toward the centre, upright."""
        qpos = self._batch.bind("qpos")[:, self._model.slot_qpos_ids]
        qvel = self._batch.bind("qvel")[:, self._model.slot_dof_ids]
        up = _up_axis(qpos[..., 3:])
        com = self._com[object_ids][..., None]
        position = qpos[..., :2] + com * up[..., :2]
        distance = np.linalg.norm(position, axis=-1, keepdims=True)
        wanted = -SERVO_SPEED * position / np.maximum(distance, 0.02)
        acceleration = SERVO_RATE * (wanted - qvel[..., :2])
        size = np.linalg.norm(acceleration, axis=-1, keepdims=True)
        acceleration *= np.minimum(1.0, strength * MAX_ACCELERATION / np.maximum(size, 1e-9))
        tilt = np.stack([up[..., 1], -up[..., 0]], axis=-1)
        spin = _to_world(qpos[..., 3:], qvel[..., 3:])[..., :2]
        righting = UPRIGHT_RATE * tilt - 2 * np.sqrt(UPRIGHT_RATE) * spin
        wrench = np.zeros((*object_ids.shape, 6))
        wrench[..., :2] = self._mass[object_ids][..., None] * acceleration
        wrench[..., 3:5] = self._inertia[object_ids][..., None] * righting
        return np.where((object_ids >= 0)[..., None], wrench, 0.0)

    def _accept(self, object_ids: np.ndarray, poses: np.ndarray) -> np.ndarray:
        present = object_ids >= 0
        tilt = np.arccos(np.clip(_up_axis(poses[..., 3:])[..., 2], -1, 1))
        speed = np.abs(self._batch.bind("qvel")[:, self._model.slot_dof_ids])
        still = (speed[..., :3].max(axis=-1) <= MAX_REST_SPEED) & (speed[..., 3:].max(axis=-1) <= MAX_REST_SPIN)
        reach = np.linalg.norm(poses[..., :2], axis=-1) + self._radii[object_ids]
        calm = (tilt <= MAX_TILT) & still & (reach <= MAX_RADIUS)
        accepted = (calm | ~present).all(axis=1) & ~self._batch.warning.any(axis=(1, 2))
        for scene in np.flatnonzero(accepted):
            gaps = slot_gaps(self._model, self._batch.get_model(scene), self._batch.get_data(scene), present[scene])
            accepted[scene] = gaps.min(axis=1).max() <= NEAR and gaps.min() >= -MAX_PENETRATION
        return accepted


def slot_gaps(
    model: SlotModel, mj_model: mujoco.MjModel, data: mujoco.MjData, present: np.ndarray, *, reach: float = 0.05
) -> np.ndarray:
    """Return the signed distances [n, n] m between the n present objects; the diagonal is inf.

    Distances beyond `reach` m may be reported as that. Source: `mj_geomDistance` over all pairs of hulls.
    """
    mujoco.mj_kinematics(mj_model, data)
    slots = np.flatnonzero(present)
    gaps = np.full((len(slots), len(slots)), np.inf)
    for i, a in enumerate(slots):
        for j, b in enumerate(slots[:i]):
            gap = min(
                mujoco.mj_geomDistance(mj_model, data, int(g), int(h), reach, None)
                for g in model.slot_geom_ids[a]
                for h in model.slot_geom_ids[b]
                if mj_model.geom_contype[g] and mj_model.geom_contype[h]
            )
            gaps[i, j] = gaps[j, i] = gap
    return gaps


def _up_axis(quat: np.ndarray) -> np.ndarray:
    """Return the body z axis [..., 3] in the world of wxyz quaternions [..., 4]."""
    w, x, y, z = np.moveaxis(quat, -1, 0)
    return np.stack([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)], axis=-1)


def _to_world(quat: np.ndarray, vector: np.ndarray) -> np.ndarray:
    """Rotate vectors [..., 3] from the frame of wxyz quaternions [..., 4] to the world."""
    cross = 2 * np.cross(quat[..., 1:], vector)
    return vector + quat[..., :1] * cross + np.cross(quat[..., 1:], cross)
