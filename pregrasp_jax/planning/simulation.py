"""Simulations of rebuilt objects on the native engine: one compiled model, into which any frustums are written.

`mujoco.batch.Batch` cannot keep vertices for each simulation, but it can run each simulation on a model of its own. So
there is one copy of the compiled model for every variant of the rebuilt scene, and a decision writes its objects into
these copies: a millisecond instead of a compilation.
"""

import copy
import queue
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor

import mujoco
import numpy as np
from mujoco.batch import Batch

from pregrasp_jax.physics import native
from pregrasp_jax.planning.solids import NUM_SIDES, Frustums, hull_bank
from pregrasp_jax.robot.base import Robot
from pregrasp_jax.scene import model as slot_model
from pregrasp_jax.scene.model import SlotModel, first_hull
from pregrasp_jax.spaces.workspace import Workspace
from pregrasp_jax.types import MAX_HULLS, MAX_OBJECTS, HullBank

TIMESTEP, ITERATIONS = 0.01, 8
"""s, and iterations of the solver: half the work of the task's own 0.004 and 20. Of 48 pushes all ended for the same
reason, and 90 % of the objects within 5 mm of where they would be."""

SLEEP_TOLERANCE = 0.01
"""m/s; what is slower for a tenth of a second, and touches nothing faster, is left out of the computation. MuJoCo's own
is 0.001; this saves a seventh of the time."""

_NUM_VERTICES = 2 * NUM_SIDES
_EXTREMA = np.stack(np.meshgrid(*[[-1.0, 0.0, 1.0]] * 3, indexing="ij"), axis=-1).reshape(27, 3)
"""The directions of `mjModel.mesh_extrema`."""


class Simulations(native.Simulations):
    """Native simulations whose objects are written, not chosen: v * MAX_OBJECTS + s stands in slot s of variant v.

    Pushes take unlike long and there are few of them, so that cores would wait for each other if they went on together.
    Here each is one piece of work, which whichever thread is free takes to its end.
    """

    def __init__(self, model: SlotModel, robot: Robot, *, num_variants: int, at_once: int, threads: int = 0):
        """Compile nothing; see `make_simulations`."""
        self._models = [copy.copy(model.mj_model) for _ in range(num_variants)]
        self._data = mujoco.MjData(model.mj_model)
        self._writer = _Writer(model)
        super().__init__(model, robot, threads=threads)
        num_threads = Batch(model.mj_model, at_once, threads, persistent=True).nthread
        self._batches = [self._batch, *(self._make_batch() for _ in range(num_threads - 1))]
        self._free: queue.SimpleQueue[Batch] = queue.SimpleQueue()
        for batch in self._batches:
            self._free.put(batch)
        self._pool = ThreadPoolExecutor(num_threads)

    def _allocate(self, num_scenes: int) -> None:
        del num_scenes  # a simulation for every variant is all that a thread needs
        self._batch = self._make_batch()

    def _make_batch(self) -> Batch:
        batch = Batch(self.model.mj_model, len(self._models), 1, persistent=True)
        batch.set_models(self._models)
        return batch

    def model_of(self, variant: int) -> mujoco.MjModel:
        """Return the model that holds the objects of a variant; read it, do not change it."""
        return self._models[variant]

    def _simulate(
        self, state: np.ndarray, object_ids: np.ndarray, ctrl: np.ndarray, num_steps: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Step E scenes, each on the variant that its object ids [E, MAX_OBJECTS] belong to; see `native`."""
        variants = np.maximum(object_ids.max(axis=1), 0) // MAX_OBJECTS
        new_state, failed, deepest = state.copy(), np.zeros(len(state), bool), np.zeros(len(state))

        def push(scene: int) -> None:
            batch, sim, one = self._free.get(), variants[scene : scene + 1], slice(scene, scene + 1)
            try:
                self._set(batch, sim, state[one])
                sensed, errors = self._roll(batch, sim, ctrl[one, : num_steps[scene]])
                new_state[one], deepest[one] = batch.state[sim], sensed[..., 0].min()
                failed[one] = errors.size > 0 or batch.warning[sim].any()
            finally:
                self._free.put(batch)  # whatever went wrong, or the next push would wait for ever

        moving = np.flatnonzero(num_steps)
        for _ in self._pool.map(push, moving[np.argsort(-num_steps[moving], kind="stable")]):  # the longest first
            pass
        return new_state, failed, deepest

    def place(self, poses: np.ndarray, joint_pos: np.ndarray) -> np.ndarray:
        """Return qpos [V, nq] float32 with the objects at poses [V, MAX_OBJECTS, 7] and the robot at joints [J]."""
        qpos = np.tile(self.coordinates(self.home_states()[0])[0], (len(poses), 1))
        qpos[:, self._joint_ids], qpos[:, self.model.slot_qpos_ids] = joint_pos, poses
        self._couple(qpos)
        return qpos.astype(np.float32)

    def _couple(self, qpos: np.ndarray) -> None:
        """Put the joints that others drive, such as finger tips, where these want them; qpos [V, nq] is changed."""
        model = self.model.mj_model
        for index in np.flatnonzero(model.eq_type == mujoco.mjtEq.mjEQ_JOINT):
            driven, driver = (model.jnt_qposadr[ids[index]] for ids in (model.eq_obj1id, model.eq_obj2id))
            moved = qpos[:, driver] - model.qpos0[driver]
            qpos[:, driven] = model.qpos0[driven] + np.polyval(model.eq_data[index, 4::-1], moved)

    def write(self, bank: HullBank) -> None:
        """Put the objects of a rebuilt bank, `num_variants` times MAX_OBJECTS, into the models."""
        with self._lock:
            for variant, target in enumerate(self._models):
                self._writer.write(target, self._data, bank, variant * MAX_OBJECTS)
            for batch in self._batches:
                batch.set_models(self._models)  # it asks to be told of every change


def make_simulations(
    robot: Robot, workspace: Workspace, *, num_variants: int, at_once: int = 8, threads: int = 0
) -> Simulations:
    """Compile the slot model of frustums for a robot and a place.

    Args:
        robot: who moves.
        workspace: where.
        num_variants: models to run on.
        at_once: pushes at a time, as many threads at most.
        threads: 0 takes every core; results do not depend on it.
    """
    spec = native.native_spec(robot, workspace)
    spec.option.timestep, spec.option.iterations = TIMESTEP, ITERATIONS
    spec.option.sleep_tolerance = SLEEP_TOLERANCE
    model = slot_model.make_slot_model(spec, _template())
    return Simulations(model, robot, num_variants=num_variants, at_once=at_once, threads=threads)


def _template() -> HullBank:
    """Return eight cylinders in six parts each: the solids that the model is compiled with."""
    shape = (MAX_OBJECTS, MAX_HULLS)
    height = np.stack(np.broadcast_arrays(0.03 * np.arange(MAX_HULLS), 0.03 * np.arange(1, MAX_HULLS + 1)), axis=-1)
    solids = Frustums(
        support=np.full((*shape, 2, NUM_SIDES), 0.035),
        height=np.broadcast_to(height, (*shape, 2)),
        angle=np.zeros(shape),
        present=np.ones(shape, bool),
    )
    return hull_bank(solids, density=np.full(MAX_OBJECTS, 300.0), friction=np.full(MAX_OBJECTS, 0.25))


class _Writer:
    """Writes objects into models compiled like `model`; where everything lies is found once."""

    def __init__(self, model: SlotModel):
        mj_model = model.mj_model
        self._model = model
        meshes = np.arange(MAX_OBJECTS * MAX_HULLS).reshape(MAX_OBJECTS, MAX_HULLS)  # one for every geom of a slot
        meshes += first_hull(mj_model)
        self._vertex_ids = mj_model.mesh_vertadr[meshes][..., None] + np.arange(_NUM_VERTICES)
        self._polygon_ids, self._face_ids = self._polygons(mj_model, meshes)
        self._mesh_ids = meshes
        self._local_ids = self._graph_ids(mj_model, meshes)

    @staticmethod
    def _polygons(mj_model: mujoco.MjModel, meshes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return where the polygons [.., F] of meshes [..] lie, and which face of a frustum each of them is."""
        num_faces = NUM_SIDES + 2
        ids = mj_model.mesh_polyadr[meshes][..., None] + np.arange(num_faces)
        faces = np.empty(ids.shape, int)
        for index, polygon in np.ndenumerate(ids):
            start, count = mj_model.mesh_polyvertadr[polygon], mj_model.mesh_polyvertnum[polygon]
            faces[index] = _face_of(mj_model.mesh_polyvert[start : start + count])
        assert (np.sort(faces, axis=-1) == np.arange(num_faces)).all(), "a mesh is no frustum"
        return ids, faces

    @staticmethod
    def _graph_ids(mj_model: mujoco.MjModel, meshes: np.ndarray) -> np.ndarray:
        """Return the number [.., V] of every vertex in the hull graph of its mesh."""
        start = mj_model.mesh_graphadr[meshes][..., None] + 2 + _NUM_VERTICES + np.arange(_NUM_VERTICES)
        return np.argsort(mj_model.mesh_graph[start], axis=-1)

    def write(self, target: mujoco.MjModel, data: mujoco.MjData, bank: HullBank, first: int) -> None:
        """Write the objects `first` to `first + MAX_OBJECTS` of a bank into the slots of `target`."""
        objects = slice(first, first + MAX_OBJECTS)
        ids = np.asarray(bank.object_hulls[objects])
        present, hulls = ids >= 0, np.maximum(ids, 0)
        points = np.asarray(bank.full.vertices)[hulls].astype(np.float64)
        low, high = points.min(axis=-2), points.max(axis=-2)
        centre = (low + high) / 2
        points -= centre[..., None, :]
        geoms, bodies = self._model.slot_geom_ids, self._model.slot_body_ids
        target.mesh_vert[self._vertex_ids] = points
        normals = np.asarray(bank.full.planes)[hulls][..., : NUM_SIDES + 2, :3]
        target.mesh_polynormal[self._polygon_ids] = np.take_along_axis(normals, self._face_ids[..., None], axis=-2)
        farthest = np.argmax(np.einsum("...vi,di->...dv", points, _EXTREMA), axis=-1)
        target.mesh_extrema[self._mesh_ids] = np.take_along_axis(self._local_ids, farthest, axis=-1)
        target.geom_dataid[geoms] = self._mesh_ids
        target.geom_pos[geoms], target.geom_quat[geoms] = centre, [1.0, 0.0, 0.0, 0.0]
        target.geom_size[geoms] = (high - low) / 2
        target.geom_aabb[geoms] = np.concatenate([np.zeros_like(centre), (high - low) / 2], axis=-1)
        target.geom_contype[geoms] = target.geom_conaffinity[geoms] = present
        target.geom_friction[geoms, 0] = np.asarray(bank.friction[objects])[:, None]
        standing = present.any(axis=1)
        empty = {name: self._model.fields[name][-1] for name in slot_model.BODY_FIELDS}
        full = {
            "body_mass": bank.mass,
            "body_inertia": bank.inertia,
            "body_ipos": bank.com,
            "body_iquat": bank.inertia_quat,
            "body_gravcomp": np.zeros(len(bank.mass)),
        }
        for name, values in full.items():
            rows = np.asarray(values, np.float64)[objects]
            getattr(target, name)[bodies] = np.where(standing.reshape(-1, *[1] * (rows.ndim - 1)), rows, empty[name])
        self._set_const(target, data)
        target.geom_rbound[geoms] = np.linalg.norm(points, axis=-1).max(axis=-1)

    def _set_const(self, target: mujoco.MjModel, data: mujoco.MjData) -> None:
        """Update what follows from mass and inertia, and keep what belongs to the compiled model."""
        mujoco.mj_setConst(target, data)
        target.dof_length[:] = self._model.mj_model.dof_length
        target.stat.meaninertia = self._model.mj_model.stat.meaninertia


def _face_of(polygon: Sequence[int] | np.ndarray) -> int:
    """Return which row of `solids.planes` a polygon of vertex numbers is."""
    below = sorted(int(vertex) for vertex in polygon if vertex < NUM_SIDES)
    if len(below) != 2:
        return NUM_SIDES if below else NUM_SIDES + 1
    first, second = below
    return 0 if (first, second) == (0, NUM_SIDES - 1) else second  # side k lies between corners k - 1 and k
