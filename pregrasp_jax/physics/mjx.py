"""The `mjx` engine: the whole push is one XLA program, and every scene brings its own objects.

Nothing leaves the device: objects are gathered from tables by id, control rows are a `while_loop` that stops with
the last scene, and scenes that are through, or diverged, keep their state.
"""

from pregrasp_jax.physics import mjx_version  # noqa: F401  (refuses other releases before their internals are used)

# isort: split
import types
from collections.abc import Callable
from typing import Any

import flax.struct as struct
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from mujoco import mjx
from mujoco.mjx._src import constraint, forward, scan, smooth, solver

from pregrasp_jax.physics.base import MAX_PENETRATION, MAX_SPEED, Engine, refuse_controls
from pregrasp_jax.physics.hull_collision import ContactCounts, Limits, collide
from pregrasp_jax.physics.mjx_model import MjxSlotModel, fill_slots, make_mjx_slot_model
from pregrasp_jax.robot.base import Robot
from pregrasp_jax.scene.model import parking_poses
from pregrasp_jax.spaces.workspace import Workspace
from pregrasp_jax.types import CTRL_DT, MAX_HULLS, MAX_OBJECTS, HullBank, PhysicsObservation, SceneParams

LIMITS = Limits(max_hull_pairs=32, max_robot_pairs=16, max_contact_points=64)
"""Sizes for 8 slots of 6 hulls, from pushes through packed scenes (`python benchmarks/mjx_limits.py`, docs/mjx.md)."""

MAX_FALL = 0.05
"""m; an object whose frame is this far below the table has gone through it: diverged."""


class MjxState(struct.PyTreeNode):
    """What is integrated, and what happened on the way.

    Attributes:
        qpos: [nq] float32 (float64 where jax has x64 on, for comparisons).
        qvel: [nv].
        qacc_warmstart: [nv].
        object_ids: [MAX_OBJECTS] int32.
        diverged: () bool; the rest is then the last state before that.
        overflows: () int32 physics steps since the reset in which overlapping pairs or contacts were dropped.
        max_hull_pairs: () int32 most pairs of hulls with overlapping boxes since the reset.
        max_robot_pairs: () int32 the same for hulls and robot.
        max_contacts: () int32 most penetrating contacts since the reset.
    """

    qpos: jax.Array
    qvel: jax.Array
    qacc_warmstart: jax.Array
    object_ids: jax.Array
    diverged: jax.Array
    overflows: jax.Array
    max_hull_pairs: jax.Array
    max_robot_pairs: jax.Array
    max_contacts: jax.Array


def make_engine(
    bank: HullBank,
    robot: Robot,
    workspace: Workspace,
    *,
    num_slots: int = MAX_OBJECTS,
    num_hulls: int = MAX_HULLS,
    limits: Limits = LIMITS,
) -> Engine:
    """Compile the slot model of `bank` and return the engine.

    Args:
        bank: host hull bank.
        robot: who moves.
        workspace: where.
        num_slots: objects that fit; a scene with an object in a later slot counts as diverged.
        num_hulls: hulls per slot.
        limits: sizes of the broadphase.

    Raises:
        ValueError: the installed MJX is not supported, or an object has more hulls than a slot.
    """
    model = make_mjx_slot_model(bank, robot, workspace, limits=limits, num_slots=num_slots, num_hulls=num_hulls)
    template = mjx.make_data(model.mjx_model)
    home_qpos = jnp.asarray([_home_qpos(model.mj_model, robot, home) for home in robot.homes], float)
    joint_ids = robot.joint_qpos_ids(model.mj_model)
    parked = jnp.asarray(parking_poses(), float)
    zero = jnp.int32(0)

    def place(object_ids: jax.Array, qpos: jax.Array, qvel: jax.Array) -> MjxState:
        no_slot = jnp.any(object_ids[num_slots:] >= 0)
        return MjxState(
            qpos=qpos,
            qvel=qvel,
            qacc_warmstart=jnp.zeros(model.mj_model.nv),
            object_ids=object_ids.astype(jnp.int32),
            diverged=no_slot | ~jnp.all(jnp.isfinite(qpos)),
            overflows=zero,
            max_hull_pairs=zero,
            max_robot_pairs=zero,
            max_contacts=zero,
        )

    def reset(state: MjxState, scene: SceneParams, mirrored: jax.Array | bool = False) -> MjxState:
        del state
        qpos = home_qpos[jnp.asarray(mirrored, jnp.int32)].at[model.qpos_ids].set(scene.poses[:num_slots])
        return place(scene.object_ids, qpos, jnp.zeros(model.mj_model.nv))

    def init() -> MjxState:
        empty = SceneParams(jnp.full(MAX_OBJECTS, -1, jnp.int32), parked, zero)
        return reset(None, empty)  # pyright: ignore[reportArgumentType]

    def run(state: MjxState, ctrl: jax.Array, num_ctrl: jax.Array) -> MjxState:
        refuse_controls(ctrl, robot)
        with jax.numpy_rank_promotion("allow"), jax.default_matmul_precision("highest"):
            return run_controls(model, template, state, ctrl, num_ctrl)

    def observe(state: MjxState) -> PhysicsObservation:
        poses = parked.at[:num_slots].set(state.qpos[model.qpos_ids])
        joint_pos = state.qpos[joint_ids]
        return PhysicsObservation(poses, joint_pos, robot.hand_pose(joint_pos), state.diverged, state.overflows)

    def coordinates(state: MjxState) -> tuple[jax.Array, jax.Array]:
        return state.qpos, state.qvel

    return Engine("mjx", init, reset, run, observe, coordinates, place)


def _home_qpos(mj_model: mujoco.MjModel, robot: Robot, home: np.ndarray) -> np.ndarray:
    """Return qpos [nq] with the robot at rest at joint positions."""
    data = mujoco.MjData(mj_model)
    robot.set_home(mj_model, data, home=home)
    return data.qpos.copy()


def run_controls(
    model: MjxSlotModel, template: mjx.Data, state: MjxState, ctrl: jax.Array, num_ctrl: jax.Array
) -> MjxState:
    """Advance one scene by `num_ctrl` rows of ctrl [T, A]; see `Engine.run`."""
    m, hull_ids = fill_slots(model, state.object_ids[: model.num_slots])
    substeps = round(CTRL_DT / float(model.mj_model.opt.timestep))
    following = jnp.concatenate([ctrl[1:], ctrl[-1:]])

    def not_through(carry: tuple[jax.Array, MjxState]) -> jax.Array:
        k, state = carry
        return (k < num_ctrl * substeps) & ~state.diverged

    def body(carry: tuple[jax.Array, MjxState]) -> tuple[jax.Array, MjxState]:
        k, state = carry
        row, share = k // substeps, (k % substeps) / substeps
        d = template.replace(qpos=state.qpos, qvel=state.qvel, qacc_warmstart=state.qacc_warmstart)
        d = d.replace(ctrl=ctrl[row] + share * (following[row] - ctrl[row]))
        d, counts = step(m, d, model, hull_ids)
        return k + 1, guarded(model, state, d, counts)

    return jax.lax.while_loop(not_through, body, (jnp.int32(0), state))[1]


def step(m: mjx.Model, d: mjx.Data, model: MjxSlotModel, hull_ids: jax.Array) -> tuple[mjx.Data, ContactCounts]:
    """Advance one scene by one physics step: `mjx.step` with our collisions, and without cameras and sensors."""
    for stage in (kinematics, smooth.com_pos, smooth.tendon, smooth.crb, smooth.factor_m):
        d = stage(m, d)
    d, counts = collide(m, d, model.hulls, hull_ids, model.limits)
    stages = (constraint.make_constraint, smooth.transmission, forward.fwd_velocity, forward.fwd_actuation)
    for stage in (*stages, forward.fwd_acceleration, solver.solve, forward.implicit):
        d = stage(m, d)
    return d, counts


def _level_by_level(m: mjx.Model, f: Callable[..., Any], *arguments: Any, **options: Any) -> Any:
    """Scan the tree of bodies as MJX does, but have every level computed before the next."""
    return scan.body_tree(m, lambda *level: jax.lax.optimization_barrier(f(*level)), *arguments, **options)


kinematics = types.FunctionType(
    smooth.kinematics.__code__,
    vars(smooth) | {"scan": types.SimpleNamespace(body_tree=_level_by_level)},
    name="kinematics",
)
"""`mjx.kinematics` that XLA does not fuse across levels. Its CPU backend would make one loop of the whole chain of
bodies, and compute a parent's pose anew for every number that depends on it, again and again down the arm: 1.6 of the
2.5 ms of a step, where this takes 2 us (8 objects of 4 hulls, per scene)."""


def guarded(model: MjxSlotModel, state: MjxState, d: mjx.Data, counts: ContactCounts) -> MjxState:
    """Return the state after a physics step, or the one before, marked diverged, if the new one makes no sense."""
    finite = jnp.all(jnp.isfinite(d.qpos)) & jnp.all(jnp.isfinite(d.qvel))
    slow = jnp.max(jnp.abs(d.qvel)) < MAX_SPEED
    present = state.object_ids[: model.num_slots] >= 0
    above = jnp.all(~present | (d.qpos[model.qpos_ids[:, 2]] > -MAX_FALL))
    fine = finite & slow & above & (counts.depth < MAX_PENETRATION)
    limits = model.limits
    too_many = (counts.hull_pairs > limits.max_hull_pairs) | (counts.robot_pairs > limits.max_robot_pairs)
    too_many |= counts.contacts > limits.max_contact_points
    keep = lambda new, old: jnp.where(fine, new, old)  # noqa: E731
    return state.replace(
        qpos=keep(d.qpos, state.qpos),
        qvel=keep(d.qvel, state.qvel),
        qacc_warmstart=keep(d.qacc_warmstart, state.qacc_warmstart),
        diverged=~fine,
        overflows=state.overflows + too_many,
        max_hull_pairs=jnp.maximum(state.max_hull_pairs, counts.hull_pairs),
        max_robot_pairs=jnp.maximum(state.max_robot_pairs, counts.robot_pairs),
        max_contacts=jnp.maximum(state.max_contacts, counts.contacts),
    )
