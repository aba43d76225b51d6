"""The `native` engine: MuJoCo's C engine on CPU threads, called by the host once per push.

`mujoco.batch.Batch` keeps model fields per simulation, so a call compares the objects that a scene wants with those
that are loaded and rewrites only what differs. The dynamic state travels through JAX as pairs of uint32 (the bits of
MuJoCo's float64), so that x64 stays off and nothing is rounded. Only `run` and `coordinates` leave the device: under
`jax.jit` they are host callbacks, and whoever divides a step calls `advance` between two compiled programs instead.
"""

import threading
from typing import Any

import flax.struct as struct
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from mujoco.batch import Batch, SimulationError

from pregrasp_jax.physics.base import MAX_PENETRATION, MAX_SPEED, Engine, refuse_controls
from pregrasp_jax.robot.base import Robot
from pregrasp_jax.scene import model as slot_model
from pregrasp_jax.scene.model import SlotModel
from pregrasp_jax.scene.spec import scene_spec
from pregrasp_jax.spaces.workspace import Workspace
from pregrasp_jax.types import CTRL_DT, MAX_OBJECTS, HullBank, PhysicsObservation, SceneParams

_STATE = mujoco.mjtState.mjSTATE_INTEGRATION

_SMALLEST_DISTANCE = 1
"""How a contact sensor chooses among contacts: `mindist` of MJCF's attribute `reduce`."""


class NativeState(struct.PyTreeNode):
    """Everything MuJoCo integrates, and what it looks like from outside.

    Attributes:
        bits: [2 * nstate] uint32, mjSTATE_INTEGRATION as pairs.
        object_ids: [MAX_OBJECTS] int32.
        object_poses: [MAX_OBJECTS, 7] float32.
        joint_pos: [J] float32 rad.
        diverged: () bool.
    """

    bits: jax.Array
    object_ids: jax.Array
    object_poses: jax.Array
    joint_pos: jax.Array
    diverged: jax.Array


class Simulations:
    """A `Batch` that grows to the number of scenes it is asked for, with the objects loaded in each.

    Not for concurrent use by several owners: a lock serialises calls, and evaluation makes its own engine.

    Attributes:
        max_penetration: m, how deep a contact may be.
    """

    max_penetration = MAX_PENETRATION

    def __init__(self, model: SlotModel, robot: Robot, *, threads: int = 0):
        slot_model.silence_warnings()
        self.model = model
        self.num_substeps = round(CTRL_DT / model.mj_model.opt.timestep)
        self._threads = threads
        self._lock = threading.Lock()
        self._joint_ids = robot.joint_qpos_ids(model.mj_model)
        self._robot = robot
        self._record = ("sensordata",) if model.mj_model.nsensordata else ()
        self._allocate(1)

    def _allocate(self, num_scenes: int) -> None:
        self._batch = Batch(self.model.mj_model, num_scenes, self._threads, persistent=True)  # for sleep
        names = (*slot_model.GEOM_FIELDS, *slot_model.BODY_FIELDS, slot_model.RBOUND, "dof_length")
        self._expanded = {name: self._batch.expand(name) for name in names}
        self._loaded = np.full((num_scenes, MAX_OBJECTS), -1)

    @property
    def state_size(self) -> int:
        """Length of one mjSTATE_INTEGRATION row."""
        return self._batch.nstate

    def load(self, object_ids: np.ndarray) -> None:
        """Put objects [E, MAX_OBJECTS] into the slots of the first E simulations, where they differ."""
        if len(object_ids) > self._batch.nsim:
            self._allocate(len(object_ids))
        sims = np.flatnonzero((self._loaded[: len(object_ids)] != object_ids).any(axis=1))
        if sims.size == 0:
            return
        wanted = object_ids[sims]
        slot_model.write_batch_slots(self.model, self._expanded, sims, wanted)
        self._batch.set_const(sims)
        # Two derived constants that come out wrong, because they belong to the meshes that were compiled.
        slot_model.write_batch_fields(self.model, self._expanded, sims, wanted, [slot_model.RBOUND])
        self._expanded["dof_length"][sims] = self.model.mj_model.dof_length
        self._loaded[sims] = wanted

    def run(self, state: np.ndarray, object_ids: np.ndarray, ctrl: np.ndarray, num_ctrl: np.ndarray) -> Any:
        """Advance E scenes by `num_ctrl` control rows each.

        Scenes that are through leave the stepped set, and so do those that fail, lest how they end depends on when
        others are through.

        Args:
            state: [E, nstate] float64.
            object_ids: [E, MAX_OBJECTS] int32.
            ctrl: [E, T, A] rad.
            num_ctrl: [E] int, at most T.

        Returns:
            The new state [E, nstate] and diverged [E] bool: an error or a warning of MuJoCo, or too deep a contact (as
            that of an object below the table is), in any physics step; not finite or too fast at the end.
        """
        fine, num_steps = interpolate(ctrl, self.num_substeps), num_ctrl * self.num_substeps
        with self._lock:
            new_state, failed, deepest = self._simulate(state, object_ids, fine, num_steps)
        speed = np.abs(self.coordinates(new_state)[1]).max(axis=1)
        bad = (deepest < -self.max_penetration) | ~(speed < MAX_SPEED) | ~np.isfinite(new_state).all(axis=1)
        return new_state, failed | bad

    def _simulate(
        self, state: np.ndarray, object_ids: np.ndarray, ctrl: np.ndarray, num_steps: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Step E scenes, with a control [E, S, A] for every step; the rest is as in `run`.

        Returns:
            The new state [E, nstate], failed [E] bool: an error or a warning, and the deepest contact [E], m.
        """
        batch, num_scenes = self._begin(state, object_ids), len(state)
        failed, deepest = np.zeros(num_scenes, bool), np.zeros(num_scenes)
        start = 0
        for stop in np.unique(num_steps[num_steps > 0]):
            ids = np.flatnonzero((num_steps >= stop) & ~failed)
            if ids.size == 0:
                break
            sensed, errors = self._roll(batch, ids, ctrl[ids, start:stop])
            failed[errors] = True
            deepest[ids] = np.minimum(deepest[ids], sensed[..., 0].min(axis=1))
            failed |= batch.warning[:num_scenes].any(axis=(1, 2))
            start = stop
        return batch.state[:num_scenes].copy(), failed, deepest

    def _begin(self, state: np.ndarray, object_ids: np.ndarray) -> Batch:
        """Put objects and states [E, nstate] into the first E simulations."""
        self.load(object_ids)
        self._set(self._batch, np.arange(len(state)), state)
        return self._batch

    @staticmethod
    def _set(batch: Batch, ids: np.ndarray, state: np.ndarray) -> None:
        """Put states [n, nstate] into simulations [n]."""
        # The state does not say which objects sleep, so all are woken: the result depends on nothing before.
        batch.reset(ids, stage=mujoco.mjtStage.mjSTAGE_NONE.value)
        batch.state[ids] = state
        batch.warning[ids] = 0

    def _roll(self, batch: Batch, ids: np.ndarray, ctrl: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Step simulations [n] with controls [n, S, A]; return sensors [n, S, .] and the simulations that failed.

        The first sensor is the deepest contact; a model without sensors gives zeros.
        """
        sensed = np.zeros((*ctrl.shape[:2], max(self.model.mj_model.nsensordata, 1)))
        out: dict[Any, np.ndarray] = {"sensordata": sensed}
        try:
            batch.rollout(ctrl.shape[1], ctrl, record=self._record, ids=ids, out=out)
        except SimulationError as error:
            return sensed, error.ids
        return sensed, ids[:0]

    def describe(self, state: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return object poses [E, MAX_OBJECTS, 7] and joint positions [E, J] float32 of states [E, nstate]."""
        qpos = self.coordinates(state)[0].astype(np.float32)
        return qpos[:, self.model.slot_qpos_ids], qpos[:, self._joint_ids]

    def coordinates(self, state: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return views of qpos [..., nq] and qvel [..., nv] of states [..., nstate]."""
        parts = (self._batch._component(part) for part in (mujoco.mjtState.mjSTATE_QPOS, mujoco.mjtState.mjSTATE_QVEL))
        qpos, qvel = (state[..., offset : offset + size] for offset, size in parts)
        return qpos, qvel

    def home_states(self) -> np.ndarray:
        """Return the states [2, nstate] with the robot in the postures of `Robot.homes` and empty slots parked."""
        states = np.zeros((2, self.state_size))
        for state, home in zip(states, self._robot.homes, strict=True):
            mj_model, data = self.model.mj_model, mujoco.MjData(self.model.mj_model)
            self._robot.set_home(mj_model, data, home=home)
            mujoco.mj_getState(mj_model, data, state, _STATE)
            self.coordinates(state)[0][self.model.slot_qpos_ids] = slot_model.parking_poses()
        return states


def interpolate(ctrl: np.ndarray, num_substeps: int) -> np.ndarray:
    """Return [E, T * num_substeps, nu] float64: the control of every physics step, linear between the rows."""
    ctrl = ctrl.astype(np.float64)
    following = np.concatenate([ctrl[:, 1:], ctrl[:, -1:]], axis=1)
    share = (np.arange(num_substeps) / num_substeps)[:, None]
    fine = ctrl[:, :, None] + share * (following - ctrl)[:, :, None]
    return fine.reshape(len(ctrl), -1, ctrl.shape[-1])


def to_bits(state: np.ndarray) -> np.ndarray:
    """Return states [..., nstate] float64 as pairs of uint32 [..., 2 * nstate]."""
    return np.ascontiguousarray(state).view(np.uint32)


def from_bits(bits: np.ndarray) -> np.ndarray:
    """Return the states of bits; inverse of `to_bits`."""
    return np.ascontiguousarray(bits).view(np.float64)


def widen_bits(values: jax.Array) -> jax.Array:
    """Return the bits [..., 2] uint32 (low, high) of float32 values [...] as float64; subnormal numbers become 0.

    The exponent moves from a bias of 127 to one of 1023, and the 23 bits of the fraction to the top of 52.
    """
    bits = jax.lax.bitcast_convert_type(values.astype(jnp.float32), jnp.uint32)
    sign, exponent, fraction = bits & jnp.uint32(1 << 31), (bits >> 23) & 0xFF, bits & 0x7FFFFF
    widened = jnp.where(exponent == 0xFF, jnp.uint32(0x7FF), exponent + jnp.uint32(1023 - 127))
    normal = exponent > 0
    high = sign | jnp.where(normal, (widened << 20) | (fraction >> 3), 0)
    return jnp.stack([jnp.where(normal, fraction << 29, 0), high], axis=-1)


def native_spec(robot: Robot, workspace: Workspace) -> mujoco.MjSpec:
    """Return the scene, with objects at rest left out of the computation until something touches them.

    A sensor tells the signed distance, m, in the deepest contact (0: none). It costs a hundredth of a step and changes
    no bit of the state.
    """
    spec = scene_spec(robot, workspace)
    spec.option.enableflags |= mujoco.mjtEnableBit.mjENBL_SLEEP
    spec.add_sensor(
        name="deepest contact",
        type=mujoco.mjtSensor.mjSENS_CONTACT,
        objtype=mujoco.mjtObj.mjOBJ_UNKNOWN,
        reftype=mujoco.mjtObj.mjOBJ_UNKNOWN,
        intprm=[1 << mujoco.mjtConDataField.mjCONDATA_DIST.value, _SMALLEST_DISTANCE, 1],
    )
    return spec


def make_engine(
    bank: HullBank, robot: Robot, workspace: Workspace, *, threads: int = 0, model: SlotModel | None = None
) -> Engine:
    """Compile the slot model of `bank` and return the engine; it owns its simulations.

    Args:
        bank: host hull bank.
        robot: who moves.
        workspace: where.
        threads: 0 takes every core; results do not depend on it.
        model: a slot model of other hulls or options for the same objects.
    """
    model = model or slot_model.make_slot_model(native_spec(robot, workspace), bank)
    return engine_of(Simulations(model, robot, threads=threads), robot)


def engine_of(simulations: Simulations, robot: Robot) -> Engine:
    """Return the engine that runs on `simulations`; see `make_engine`."""
    native = _Native(simulations, robot)
    return Engine(
        name="native",
        init=native.init,
        reset=native.reset,
        run=native.run,
        observe=native.observe,
        coordinates=native.coordinates,
        place=native.place,
        advance=native.advance,
    )


class _Native:
    """The functions of the engine, on simulations that they share."""

    def __init__(self, simulations: Simulations, robot: Robot):
        self._simulations, self._robot = simulations, robot
        homes = simulations.home_states()
        self._home_bits = to_bits(homes)
        self._home_joint_pos = simulations.describe(homes)[1]
        model = simulations.model.mj_model
        # Where qpos and qvel lie among the numbers of a state.
        self._qpos_ids, self._qvel_ids = simulations.coordinates(np.arange(simulations.state_size))
        self._sizes = model.nq, model.nv

    def init(self) -> NativeState:
        poses = jnp.asarray(slot_model.parking_poses(), jnp.float32)
        return self.reset(None, SceneParams(jnp.full(MAX_OBJECTS, -1, jnp.int32), poses, jnp.int32(0)))

    def reset(self, state: NativeState | None, scene: SceneParams, mirrored: jax.Array | bool = False) -> NativeState:
        del state
        posture = jnp.asarray(mirrored, jnp.int32)
        slots = self._qpos_ids[self._simulations.model.slot_qpos_ids]
        return NativeState(
            bits=self._write(jnp.asarray(self._home_bits)[posture], slots, scene.poses),
            object_ids=scene.object_ids.astype(jnp.int32),
            object_poses=scene.poses.astype(jnp.float32),
            joint_pos=jnp.asarray(self._home_joint_pos)[posture],
            diverged=jnp.zeros((), bool),
        )

    def place(self, object_ids: jax.Array, qpos: jax.Array, qvel: jax.Array) -> NativeState:
        bits = self._write(jnp.asarray(self._home_bits)[0], self._qpos_ids, qpos)
        model = self._simulations.model
        return NativeState(
            bits=self._write(bits, self._qvel_ids, qvel),
            object_ids=object_ids.astype(jnp.int32),
            object_poses=qpos[model.slot_qpos_ids].astype(jnp.float32),
            joint_pos=qpos[self._robot.joint_qpos_ids(model.mj_model)].astype(jnp.float32),
            diverged=jnp.zeros((), bool),
        )

    def run(self, state: NativeState, ctrl: jax.Array, num_ctrl: jax.Array) -> NativeState:
        refuse_controls(ctrl, self._robot)
        shapes = jax.tree.map(lambda leaf: jax.ShapeDtypeStruct(leaf.shape, leaf.dtype), state)
        return jax.pure_callback(self.advance, shapes, state, ctrl, num_ctrl, vmap_method="broadcast_all")

    def advance(self, state: NativeState, ctrl: Any, num_ctrl: Any) -> NativeState:
        batch = np.shape(num_ctrl)
        bits, object_ids, was_diverged = (
            np.asarray(x).reshape(-1, *np.shape(x)[len(batch) :])
            for x in (state.bits, state.object_ids, state.diverged)
        )
        ctrl = np.asarray(ctrl).reshape(-1, *np.shape(ctrl)[-2:])
        num_ctrl = np.where(was_diverged, 0, np.asarray(num_ctrl).reshape(-1))
        new_state, diverged = self._simulations.run(from_bits(bits), object_ids, ctrl, num_ctrl)
        leaves = (
            to_bits(new_state),
            object_ids.astype(np.int32),
            *self._simulations.describe(new_state),
            diverged | was_diverged,
        )
        return NativeState(*(x.reshape((*batch, *x.shape[1:])) for x in leaves))  # pyright: ignore[reportArgumentType]

    def observe(self, state: NativeState) -> PhysicsObservation:
        hand_pose = self._robot.hand_pose(state.joint_pos)
        return PhysicsObservation(state.object_poses, state.joint_pos, hand_pose, state.diverged, jnp.int32(0))

    def coordinates(self, state: NativeState) -> tuple[jax.Array, jax.Array]:
        def read(bits: Any) -> tuple[np.ndarray, ...]:
            found = self._simulations.coordinates(from_bits(np.asarray(bits)))
            return tuple(values.astype(np.float32) for values in found)

        shapes = tuple(jax.ShapeDtypeStruct((size,), jnp.float32) for size in self._sizes)
        return jax.pure_callback(read, shapes, state.bits, vmap_method="broadcast_all")

    def _write(self, bits: jax.Array, ids: np.ndarray, values: jax.Array) -> jax.Array:
        """Set numbers `ids` [...] of a state, given as bits, to values [...]."""
        return bits.at[2 * ids[..., None] + np.arange(2)].set(widen_bits(values))
