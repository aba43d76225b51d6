"""Contacts of random states by the `mjx` engine, by C MuJoCo and exact, pair by pair; for tests and the benchmark."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from mjx_oracle import CoarseModel, deepest, margin_of_the_first, outside_of, overlap_along, ways_out
from mujoco import mjx as mujoco_mjx

from pregrasp_jax.physics import mjx_model
from pregrasp_jax.physics.hull_collision import Limits, collide
from pregrasp_jax.physics.mjx_model import MjxSlotModel
from pregrasp_jax.robot import get_robot
from pregrasp_jax.scene.bank import SceneBank
from pregrasp_jax.scene.model import parking_poses
from pregrasp_jax.types import MAX_OBJECTS

AMPLE = Limits(max_hull_pairs=96, max_robot_pairs=64, max_contact_points=192)
"""Nothing is dropped in the states of these tests."""

ALIKE = np.radians(1.0)
"""Normals nearer than this are the same."""

EXACT = 1e-6
"""m; C, which computes in float64, either finds the least translation within this or stops short of it."""

UNIQUE = 4e-5
"""m; a least translation shorter than all others by more than this is the one, twice the tolerance of distances."""


def make_contacts_of(model: MjxSlotModel) -> Callable[..., Any]:
    """Return (object_ids [S, 8], qpos [S, nq]) -> contacts [S, n] and counts [S], all states in one call."""
    template = mujoco_mjx.make_data(model.mjx_model)

    def contacts_of_one(object_ids, qpos):
        m, hull_ids = mjx_model.fill_slots(model, object_ids)
        with jax.numpy_rank_promotion("allow"), jax.default_matmul_precision("highest"):  # as the engine does
            data = mujoco_mjx.kinematics(m, template.replace(qpos=qpos))
            data, counts = collide(m, data, model.hulls, hull_ids, model.limits)
        contact = data._impl.contact
        parameters = contact.friction, contact.solref, contact.solimp
        return (contact.geom, contact.dist, contact.pos, contact.frame[:, 0], *parameters), counts

    return jax.jit(jax.vmap(contacts_of_one))


def shaken(poses: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Press packed objects into each other by some millimetres and tilt them a little."""
    poses = poses.astype(np.float64).copy()
    poses[:, :2] *= rng.uniform(0.95, 1.0)
    poses[:, :3] += rng.normal(0, 0.0015, (len(poses), 3))
    poses[:, 3:] += rng.normal(0, 0.01, (len(poses), 4))
    return poses


def around_the_arm(poses: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Scatter objects where the start pose has its hand and its wrist."""
    low, high = [-0.5, -0.1, 0.0], [-0.18, 0.1, 0.15]
    return np.concatenate([rng.uniform(low, high, (len(poses), 3)), rng.normal(size=(len(poses), 4))], axis=1)


class Pair(NamedTuple):
    """The deepest contact of one pair of geoms by C and by us (None: no contact), and what is exact.

    `least` is the least translation that parts the two, `normal` its direction and `margin` by how much the next one
    is longer that is more than `ALIKE` away; `along` is the translation along our normal and `reference_along` that
    along C's; `outside` is how far our contact lies outside of the two. None for planes, and for capsules, of which
    only `least` is known.
    """

    kind: str
    names: tuple[str, str]
    reference: Any
    ours: Any
    least: Any = None
    normal: Any = None
    margin: Any = None
    along: Any = None
    reference_along: Any = None
    outside: Any = None

    @property
    def reference_is_exact(self) -> bool:
        """Whether C found the least translation: its distance, and a normal along which that parts the two."""
        errors = [self.reference.dist + self.least, (self.reference_along or self.least) - self.least]
        return bool(np.abs(errors).max() < EXACT)


def random_states(model: MjxSlotModel, scenes: SceneBank, num_states: int) -> tuple[np.ndarray, np.ndarray]:
    """Return object ids [S, 8] and qpos [S, nq]: packed and pressed together, or scattered around the arm, in turn."""
    data = mujoco.MjData(model.mj_model)
    get_robot("ur5e_rg2").set_home(model.mj_model, data)
    rng = np.random.default_rng(0)
    index = np.arange(num_states) % len(scenes)
    object_ids, qpos = scenes.object_ids[index].copy(), np.tile(data.qpos, (num_states, 1))
    for row, i in enumerate(index):
        if row % 2:
            object_ids[row, rng.permutation(MAX_OBJECTS)[:4]] = -1
        disturb = around_the_arm if row % 2 else shaken
        poses = np.where((object_ids[row] >= 0)[:, None], disturb(scenes.poses[i], rng), parking_poses())
        qpos[row, model.qpos_ids] = poses / np.where(np.arange(7) < 3, 1, np.linalg.norm(poses[:, 3:], axis=1)[:, None])
    return object_ids, qpos


def touching_pairs(
    model: MjxSlotModel, oracle: CoarseModel, contacts_of: Callable[..., Any], scenes: SceneBank, num_states: int
) -> list[Pair]:
    """Return all pairs that touch in `random_states`."""
    object_ids, qpos = random_states(model, scenes, num_states)
    (geom, dist, pos, normal, *parameters), counts = jax.tree.map(
        np.asarray, contacts_of(object_ids, jnp.asarray(qpos, jnp.float32))
    )
    assert counts.hull_pairs.max() <= AMPLE.max_hull_pairs
    assert counts.robot_pairs.max() <= AMPLE.max_robot_pairs
    assert counts.contacts.max() <= AMPLE.max_contact_points
    names = np.array([model.mj_model.geom(g).name for g in range(model.mj_model.ngeom)])
    found = []
    for s in range(num_states):
        state = oracle.fill(object_ids[s], qpos[s, model.qpos_ids])
        reference = oracle.touches(state)
        mixed = np.concatenate([values[s] for values in parameters], axis=1)
        touching = np.flatnonzero(dist[s] < 0)
        ours = deepest([(*names[geom[s, k]], dist[s, k], pos[s, k], normal[s, k], mixed[k]) for k in touching])
        found += [describe(oracle, state, key, reference.get(key), ours.get(key)) for key in reference | ours]
    return found


def describe(oracle, state, names, reference, ours) -> Pair:
    """Classify a pair and add what is exact."""
    if "table" in names:
        return Pair("table", names, reference, ours)
    if any(oracle.model.geom(name).type[0] == mujoco.mjtGeom.mjGEOM_CAPSULE for name in names):
        return Pair("capsule", names, reference, ours, -oracle.distance(state, names))
    kind = "hulls" if all(name.startswith("slot") for name in names) else "box"
    a, b = (oracle.corners(state, name) for name in names)
    along, reference_along = (overlap_along(a, b, touch.normal) if touch else None for touch in (ours, reference))
    depths, normals = ways_out(a, b)
    margin = margin_of_the_first(depths, normals, ALIKE)
    outside = max(outside_of(a, ours.pos), outside_of(b, ours.pos)) if ours else None
    return Pair(kind, names, reference, ours, depths[0], normals[0], margin, along, reference_along, outside)
