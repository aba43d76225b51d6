"""Strokes of a hand that comes from above, on the `native` engine: down, ahead, close, up; what it holds is taken away.

Beside what `native` does it stops a hand that touches something on its way down, tells what the hand touches in the
end, removes objects, and puts the hand back. Above the table nothing is in a hand's way, so that only the stroke is
simulated, not how the hand gets there and back.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import flax.struct as struct
import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from pregrasp_jax.physics import native
from pregrasp_jax.physics.base import Engine, refuse_controls
from pregrasp_jax.physics.native import NativeState, Simulations, from_bits, interpolate, to_bits
from pregrasp_jax.robot.base import Robot
from pregrasp_jax.scene import model as slot_model
from pregrasp_jax.spaces.workspace import Workspace
from pregrasp_jax.types import MAX_OBJECTS, HullBank, PhysicsObservation, SceneParams, Touch

_TOUCH = 1
"""Of the sensors of the model: how many contacts the robot has. The first is the deepest contact of all."""


_DROP = 0.05
"""m of penetration that is too deep: what slips from the hand 0.3 m up hits the table at 2.4 m/s, 10 mm per physics
step, and sinks in by 20 mm for a moment."""


class Legs(struct.PyTreeNode):
    """Controls of a stroke.

    Attributes:
        ctrl: [T, A] rad or m, as in `Engine.run`; the hand is put where the first row says before it moves.
        ends: rows after which it is down, and after which it has pushed; then it closes and lifts.
    """

    ctrl: jax.Array
    ends: tuple[int, int] = struct.field(pytree_node=False)


class StrokeState(struct.PyTreeNode):
    """State of the engine.

    Attributes:
        native: what MuJoCo integrates; objects that were taken away are -1 there.
        touch: what the last stroke did.
    """

    native: NativeState
    touch: Touch


def make_engine(
    bank: HullBank,
    robot: Robot,
    workspace: Workspace,
    *,
    gone: Callable[[np.ndarray], np.ndarray],
    threads: int = 0,
) -> Engine:
    """Return the engine; its `run` takes `Legs`, and any positive number of rows executes all of them.

    Args:
        bank: host hull bank.
        robot: who moves; a hand that floats.
        workspace: where.
        gone: (poses [..., 7] m of objects at the end of a stroke) -> [...] bool, which of them are taken away.
        threads: 0 takes every core; results do not depend on it.

    Raises:
        ValueError: the robot is not a hand whose every joint is driven, so that it cannot be put anywhere.
    """
    if robot.joints != robot.actuators:
        raise ValueError(f"robot {robot.name} cannot come from above; allowed is a hand that floats, as barrett does")
    model = slot_model.make_slot_model(_spec(robot, workspace), bank)
    simulations = _Simulations(model, robot, threads=threads)
    base = native.engine_of(simulations, robot)
    strokes = _Strokes(simulations, base, robot, gone)
    return replace(
        base,
        init=lambda: strokes.wrapped(base.init()),
        reset=strokes.reset,
        run=strokes.run,
        observe=strokes.observe,
        coordinates=lambda state: base.coordinates(state.native),
        place=lambda *coordinates: strokes.wrapped(base.place(*coordinates)),
        advance=strokes.advance,
    )


def _spec(robot: Robot, workspace: Workspace) -> mujoco.MjSpec:
    """Return the scene of `native` with a sensor that counts the contacts of the robot."""
    spec = native.native_spec(robot, workspace)
    spec.add_sensor(
        name="contacts of the robot",
        type=mujoco.mjtSensor.mjSENS_CONTACT,
        objtype=mujoco.mjtObj.mjOBJ_XBODY,
        objname=robot.links.names[0],
        reftype=mujoco.mjtObj.mjOBJ_UNKNOWN,
        intprm=[1 << mujoco.mjtConDataField.mjCONDATA_FOUND.value, 0, 1],
    )
    return spec


class _Simulations(Simulations):
    """Simulations that can stop at a touch, and tell who touches whom."""

    max_penetration = _DROP

    def __init__(self, model: slot_model.SlotModel, robot: Robot, *, threads: int = 0):
        super().__init__(model, robot, threads=threads)
        mj_model = model.mj_model
        self._data = mujoco.MjData(mj_model)
        self._link_of_geom = np.full(mj_model.ngeom, -1)
        for geom in robot.links.geoms:
            self._link_of_geom[mj_model.geom(geom.name).id] = geom.link
        self._slot_of_geom = np.full(mj_model.ngeom, -1)
        self._slot_of_geom[model.slot_geom_ids] = np.arange(MAX_OBJECTS)[:, None]
        self._num_links = len(robot.links.names)
        self.joint_ids = robot.joint_qpos_ids(mj_model)
        self.home = self.home_states()[0]

    def approach(
        self, state: np.ndarray, object_ids: np.ndarray, ctrl: np.ndarray, going: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Advance scenes until the robot touches something, or the controls end.

        Args:
            state: [E, nstate] float64.
            object_ids: [E, MAX_OBJECTS] int32.
            ctrl: [E, T, A].
            going: [E] bool, the scenes that move at all.

        Returns:
            The new state [E, nstate], touched [E] bool, control rows [E] int that were begun, and failed [E] bool.
        """
        with self._lock:
            batch, num_scenes = self._begin(state, object_ids), len(state)
            fine = interpolate(ctrl, self.num_substeps)
            touched, failed = np.zeros((2, num_scenes), bool)
            steps = np.zeros(num_scenes, int)
            ids = np.flatnonzero(going)
            for step in range(fine.shape[1]):
                if ids.size == 0:
                    break
                sensed, errors = self._roll(batch, ids, fine[ids, step : step + 1])
                failed[errors] = True
                touched[ids] = sensed[:, 0, _TOUCH] > 0
                steps[ids] += 1
                ids = ids[~touched[ids] & ~failed[ids]]
            failed |= batch.warning[:num_scenes].any(axis=(1, 2))
            return batch.state[:num_scenes].copy(), touched, -(-steps // self.num_substeps), failed

    def contacts(self, num_scenes: int) -> np.ndarray:
        """Return which links touch which slots [E, L, MAX_OBJECTS] bool at the end of the last `run`."""
        found = np.zeros((num_scenes, self._num_links, MAX_OBJECTS), bool)
        for scene in range(num_scenes):
            contact = self._batch.get_data(scene, self._data).contact
            geoms = contact.geom[contact.efc_address >= 0]
            for a, b in (geoms.T, geoms.T[::-1]):
                link, slot = self._link_of_geom[a], self._slot_of_geom[b]
                pairs = (link >= 0) & (slot >= 0)
                found[scene, link[pairs], slot[pairs]] = True
        return found


@dataclass(frozen=True)
class _Strokes:
    """The functions of the engine."""

    simulations: _Simulations
    base: Engine
    robot: Robot
    gone: Callable[[np.ndarray], np.ndarray]

    def wrapped(self, state: NativeState) -> StrokeState:
        """Return a state in which nothing has been touched yet."""
        blank = Touch(
            collided=jnp.zeros((), bool),
            rows=jnp.int32(0),
            poses=jnp.broadcast_to(state.object_poses, (3, *state.object_poses.shape)),
            contacts=jnp.zeros((len(self.robot.links.names), MAX_OBJECTS), bool),
            gone=jnp.zeros(MAX_OBJECTS, bool),
        )
        return StrokeState(state, blank)

    def reset(self, state: StrokeState, scene: SceneParams, mirrored: jax.Array | bool = False) -> StrokeState:
        return self.wrapped(self.base.reset(state.native, scene, mirrored))

    def observe(self, state: StrokeState) -> PhysicsObservation:
        return self.base.observe(state.native).replace(touch=state.touch)

    def run(self, state: StrokeState, legs: Legs, num_ctrl: jax.Array) -> StrokeState:
        refuse_controls(legs.ctrl, self.robot)
        shapes = jax.tree.map(lambda leaf: jax.ShapeDtypeStruct(leaf.shape, leaf.dtype), state)
        return jax.pure_callback(self.advance, shapes, state, legs, num_ctrl, vmap_method="broadcast_all")

    def advance(self, state: StrokeState, legs: Legs, num_ctrl: Any) -> StrokeState:
        batch = np.shape(num_ctrl)

        def flat(leaf: Any) -> np.ndarray:
            return np.array(leaf).reshape(-1, *np.shape(leaf)[len(batch) :])

        state, legs = jax.tree.map(flat, (state, legs))
        going = (np.asarray(num_ctrl).reshape(-1) > 0) & ~state.native.diverged
        result = self._stroke(state, legs, going)
        kept = jax.tree.map(lambda old, new: np.where(_like(going, new), new, old), state, result)
        return jax.tree.map(lambda leaf: leaf.reshape(*batch, *leaf.shape[1:]), kept)

    def _stroke(self, state: Any, legs: Any, going: np.ndarray) -> StrokeState:
        """Return the states [E], host arrays as the arguments are, after a stroke of those `going` [E] bool."""
        simulations, (down, pushed) = self.simulations, legs.ends
        object_ids, ctrl = state.native.object_ids, legs.ctrl
        rows = from_bits(state.native.bits).copy()
        simulations.coordinates(rows)[0][:, simulations.joint_ids] = ctrl[:, 0]
        rows, touched, num_rows, failed = simulations.approach(rows, object_ids, ctrl[:, :down], going)
        free = going & ~touched & ~failed
        poses = [simulations.describe(rows)[0]]
        for leg in (slice(down, pushed), slice(pushed, None)):
            length = ctrl[:, leg].shape[1]
            rows, diverged = simulations.run(rows, object_ids, ctrl[:, leg], np.where(free, length, 0))
            failed |= diverged & free
            poses.append(simulations.describe(rows)[0])
        gone = self.gone(poses[-1]) & (object_ids >= 0)
        touch: dict[str, Any] = {
            "collided": touched,
            "rows": np.where(free, ctrl.shape[1], num_rows).astype(np.int32),
            "poses": np.stack(poses, axis=1),
            "contacts": simulations.contacts(len(rows)) & free[:, None, None],
            "gone": gone,
        }
        return StrokeState(self._tidy(rows, np.where(gone, -1, object_ids), failed), Touch(**touch))

    def _tidy(self, rows: np.ndarray, object_ids: np.ndarray, failed: np.ndarray) -> NativeState:
        """Return states [E] with the hand at home again and without the objects that are -1."""
        simulations = self.simulations
        model = simulations.model
        fresh = np.tile(simulations.home, (len(rows), 1))
        (qpos, qvel), (old_qpos, old_qvel) = simulations.coordinates(fresh), simulations.coordinates(rows)
        there = object_ids[:, :, None] >= 0
        slots, dofs = model.slot_qpos_ids, model.slot_dof_ids
        qpos[:, slots] = np.where(there, old_qpos[:, slots], qpos[:, slots])
        qvel[:, dofs] = np.where(there, old_qvel[:, dofs], 0.0)
        poses, joint_pos = simulations.describe(fresh)
        leaves: tuple[Any, ...] = (to_bits(fresh), object_ids.astype(np.int32), poses, joint_pos, failed)
        return NativeState(*leaves)


def _like(flags: np.ndarray, leaf: np.ndarray) -> np.ndarray:
    """Return flags [E] that broadcast against a leaf [E, ...]."""
    return flags.reshape(-1, *[1] * (leaf.ndim - 1))
