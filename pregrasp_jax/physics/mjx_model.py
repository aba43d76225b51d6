"""The slot model for MJX: hull geoms that all name one mesh, and everything about an object in one table row."""

from pregrasp_jax.physics import mjx_version  # noqa: F401  (refuses other releases before their internals are used)

# isort: split
import copy
from collections.abc import Collection, Iterable
from dataclasses import dataclass
from typing import Any

import flax.struct as struct
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from mujoco import mjx

from pregrasp_jax.physics import native
from pregrasp_jax.physics.hull_collision import Limits
from pregrasp_jax.physics.hull_table import HullTable, make_hull_table
from pregrasp_jax.robot.base import Robot
from pregrasp_jax.scene import model as slot_model
from pregrasp_jax.scene.spec import compile_spec, scene_spec
from pregrasp_jax.spaces.workspace import Workspace
from pregrasp_jax.types import MAX_HULLS, MAX_OBJECTS, HullBank

ITERATIONS, LS_ITERATIONS = 20, 8
"""Of Newton and of its line search. 100 and 50 change final poses of pushes by no more than rounding does (a few mm
where a row of objects is pushed, see tests/test_mjx.py); MJX always runs all steps of the line search."""

BODY_FIELDS = (*slot_model.BODY_FIELDS, "body_subtreemass", "body_invweight0")
DOF_FIELDS = ("dof_invweight0", "dof_M0")
"""Of a slot's body and its degrees of freedom; these and the last two of the body are what `mj_setConst` derives."""


_PADS = ("hand_left_pad", "hand_right_pad")
"""Geoms of the RG2 that hold a target."""

PAD_FRICTION, PAD_IMPEDANCE = 2**0.5, (0.995, 0.9995)
"""Of the finger pads. A pyramid of friction 1 lies within the cone of friction 1, one of sqrt(2) around it; and without
`impratio` only harder contacts slip less. Of 84 grasps of objects that stand up to 1 cm before the palm 86 % hold with
the values of `native`, 98 % with these, as many as in `native` (`python benchmarks/grasp.py --scatter --like-mjx`)."""

DIFFERENCES = ("hulls", "solver", "condim", "awake")
"""In what this model is not that of `native`: coarse hulls, a pyramidal cone with firmer pads and fewer iterations on
dense matrices, three contact dimensions also at the pads, and no sleep of objects at rest."""


class ObjectTable(struct.PyTreeNode):
    """What a slot becomes for each of N objects; the last row is the empty slot.

    Attributes:
        hull_ids: [N + 1, M] int32 row of the hull table, -1 where absent.
        body: per field name, [N + 1, ...].
        dof: per field name, [N + 1, 6].
        geom: per field name, [N + 1, M, ...].
    """

    hull_ids: jax.Array
    body: dict[str, jax.Array]
    dof: dict[str, jax.Array]
    geom: dict[str, jax.Array]


@dataclass(frozen=True)
class MjxSlotModel:
    """A compiled model and the tables of its slots.

    Attributes:
        mj_model: the compiled model, slots as objects of median mass.
        mjx_model: the same on the device; per-scene fields are replaced by `fill_slots`.
        hulls: all hulls of the bank at the coarse level.
        objects: all objects of the bank.
        limits: sizes of the broadphase.
        body_ids: [S] int.
        geom_ids: [S, M] int.
        qpos_ids: [S, 7] int.
        dof_ids: [S, 6] int.
    """

    mj_model: mujoco.MjModel
    mjx_model: mjx.Model
    hulls: HullTable
    objects: ObjectTable
    limits: Limits
    body_ids: np.ndarray
    geom_ids: np.ndarray
    qpos_ids: np.ndarray
    dof_ids: np.ndarray

    @property
    def num_slots(self) -> int:
        """Objects that fit."""
        return len(self.body_ids)


def make_mjx_slot_model(
    bank: HullBank,
    robot: Robot,
    workspace: Workspace,
    *,
    limits: Limits,
    num_slots: int = MAX_OBJECTS,
    num_hulls: int = MAX_HULLS,
) -> MjxSlotModel:
    """Compile robot, table, walls and slots for MJX, and tabulate every object.

    Raises:
        ValueError: more slots than a scene has, or an object of the bank has no hull or more than a slot holds.
    """
    present = np.asarray(bank.object_hulls) >= 0
    if not 1 <= num_slots <= MAX_OBJECTS:
        raise ValueError(f"num_slots = {num_slots}; allowed are 1 to {MAX_OBJECTS}")
    for name, count in zip(bank.names, present.sum(axis=1), strict=True):
        if not 1 <= count <= num_hulls:
            raise ValueError(f"object {name!r} has {count} hulls; a slot of the mjx engine holds 1 to {num_hulls}")
    hulls = make_hull_table(bank.coarse)
    spec = scene_spec(robot, workspace)
    set_options(spec, limits)
    _add_slots(spec, bank, num_slots, num_hulls)
    mj_model = compile_spec(spec)
    bodies = [mj_model.body(f"slot_{i}") for i in range(num_slots)]
    return MjxSlotModel(
        mj_model=mj_model,
        mjx_model=mjx.put_model(mj_model),
        hulls=hulls,
        objects=_tabulate(bank, hulls, num_hulls, scene_spec(robot, workspace)),
        limits=limits,
        body_ids=np.array([body.id for body in bodies]),
        geom_ids=np.array([body.geomadr[0] + np.arange(num_hulls) for body in bodies]),
        qpos_ids=np.array([mj_model.jnt_qposadr[body.jntadr[0]] + np.arange(7) for body in bodies]),
        dof_ids=np.array([body.dofadr[0] + np.arange(6) for body in bodies]),
    )


def fill_slots(model: MjxSlotModel, object_ids: jax.Array) -> tuple[mjx.Model, jax.Array]:
    """Return the model of one scene and the hull row [ngeom] int32 of every geom (-1: none).

    Args:
        model: the slot model.
        object_ids: [num_slots] int32, -1 for an empty slot.
    """
    table = jax.tree.map(lambda rows: rows[object_ids], model.objects)
    m = model.mjx_model
    values = [(table.body, model.body_ids), (table.dof, model.dof_ids), (table.geom, model.geom_ids)]
    fields = {name: getattr(m, name).at[ids].set(rows[name]) for rows, ids in values for name in rows}
    hull_ids = jnp.full(m.ngeom, -1, jnp.int32).at[model.geom_ids].set(table.hull_ids)
    return m.replace(**fields), hull_ids


def set_options(spec: mujoco.MjSpec, limits: Limits | None) -> None:
    """Choose what MJX does well: a pyramidal cone, Newton with dense matrices, and one contact dimension.

    Elliptic cones build a matrix of all constraint rows squared; other contact dimensions would double the groups of
    the hand. Without limits MJX keeps every contact.
    """
    _choose_solver(spec.option, spec.geoms)
    if limits is not None:
        spec.add_numeric(name="max_contact_points", data=[limits.max_contact_points], size=1)
    for geom in spec.geoms:
        geom.condim = 3


def _choose_solver(option: Any, geoms: Iterable[Any]) -> None:
    """Set cone and solver in the options of a spec or of a model, and the pads in its geoms."""
    option.cone, option.impratio = mujoco.mjtCone.mjCONE_PYRAMIDAL, 1
    option.solver, option.jacobian = mujoco.mjtSolver.mjSOL_NEWTON, mujoco.mjtJacobian.mjJAC_DENSE
    option.iterations, option.ls_iterations = ITERATIONS, LS_ITERATIONS
    option.disableflags |= mujoco.mjtDisableBit.mjDSBL_EULERDAMP
    for geom in geoms:
        if geom.name in _PADS:
            geom.friction[0], geom.solimp[:2] = PAD_FRICTION, PAD_IMPEDANCE


def make_reference_model(
    bank: HullBank, robot: Robot, workspace: Workspace, differences: Collection[str] = DIFFERENCES
) -> slot_model.SlotModel:
    """Return a slot model for C MuJoCo that differs from that of `native` as MJX does, to compare the engine with.

    Args:
        bank: host hull bank.
        robot: who moves.
        workspace: where.
        differences: which of `DIFFERENCES` to take over.
    """
    hulls = bank.replace(full=bank.coarse) if "hulls" in differences else bank
    model = slot_model.make_slot_model(native.native_spec(robot, workspace), hulls)
    if "awake" in differences:
        model.mj_model.opt.enableflags &= ~int(mujoco.mjtEnableBit.mjENBL_SLEEP)
    if "solver" in differences:
        _choose_solver(model.mj_model.opt, map(model.mj_model.geom, range(model.mj_model.ngeom)))
    if "condim" in differences:
        model.mj_model.geom_condim[:] = 3
    return model


def _add_slots(spec: mujoco.MjSpec, bank: HullBank, num_slots: int, num_hulls: int) -> None:
    """Add the slots; their one mesh only tells MJX that they are meshes, its shape is never used."""
    mesh = spec.add_mesh(name="hull")
    mesh.uservert = slot_model.hull_points(bank, 0).ravel()
    mesh.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_CONVEX
    mass, inertia = float(np.median(bank.mass)), np.median(bank.inertia, axis=0)
    for slot in range(num_slots):
        body = spec.worldbody.add_body(name=f"slot_{slot}", explicitinertial=True, mass=mass, inertia=inertia)
        body.ipos = np.median(bank.com, axis=0)
        body.add_freejoint(name=f"slot_{slot}")
        for hull in range(num_hulls):
            name = f"slot_{slot}_hull_{hull}"
            body.add_geom(name=name, type=mujoco.mjtGeom.mjGEOM_MESH, meshname="hull", condim=3)


def _tabulate(bank: HullBank, hulls: HullTable, num_hulls: int, spec: mujoco.MjSpec) -> ObjectTable:
    """Return the table from the native slot model, so that both engines mean the same by an object.

    What `mj_setConst` derives it derives here, with one object after the other in the first slot: a free body's
    constants depend on nothing but itself.
    """
    slots = slot_model.make_slot_model(spec, bank)
    hull_ids = np.vstack([np.asarray(bank.object_hulls)[:, :num_hulls], np.full((1, num_hulls), -1)])
    geom = {
        "geom_pos": np.asarray(hulls.centre)[hull_ids],
        "geom_quat": np.tile([1.0, 0.0, 0.0, 0.0], (*hull_ids.shape, 1)),
        "geom_rbound": np.linalg.norm(np.asarray(hulls.vert), axis=-1).max(axis=-1)[hull_ids],
        "geom_friction": slots.fields["geom_friction"][:, :num_hulls],
    }
    rows: dict[str, list[np.ndarray]] = {name: [] for name in (*BODY_FIELDS, *DOF_FIELDS)}
    target = copy.copy(slots.mj_model)
    for row in [*range(len(bank.names)), -1]:
        slot_model.write_slots(slots, target, np.array([row] + [-1] * (MAX_OBJECTS - 1)))
        for name, values in rows.items():
            ids = slots.slot_body_ids[0] if name in BODY_FIELDS else slots.slot_dof_ids[0]
            values.append(getattr(target, name)[ids].copy())
    arrays = {name: jnp.asarray(np.stack(values), float) for name, values in rows.items()}
    return ObjectTable(
        hull_ids=jnp.asarray(hull_ids, jnp.int32),
        body={name: arrays[name] for name in BODY_FIELDS},
        dof={name: arrays[name] for name in DOF_FIELDS},
        geom={name: jnp.asarray(values, float) for name, values in geom.items()},
    )
