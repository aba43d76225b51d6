"""The slot model: one compiled MjModel in which any objects of a hull bank can stand.

`MAX_OBJECTS` free bodies with `MAX_HULLS` mesh geoms each are compiled once. Putting an object into a slot
rewrites the fields in `SLOT_FIELDS`, which takes microseconds instead of a compilation.
"""

from collections.abc import Iterable
from dataclasses import dataclass

import mujoco
import numpy as np

from pregrasp_jax.scene.spec import compile_spec
from pregrasp_jax.types import MAX_HULLS, MAX_OBJECTS, HullBank

GEOM_FIELDS = (
    "geom_dataid",
    "geom_pos",
    "geom_quat",
    "geom_size",
    "geom_aabb",
    "geom_contype",
    "geom_conaffinity",
    "geom_friction",
)
BODY_FIELDS = ("body_mass", "body_inertia", "body_ipos", "body_iquat", "body_gravcomp")
RBOUND = "geom_rbound"
"""`mj_setConst` puts this one back to the compiled mesh's radius, so it is written after it, never before."""

_ROTATION_LENGTH = 0.15
"""m; speed of an object's outside per rad/s, by which `sleep` decides: one for all, though objects differ."""

_PARKED_MASS = 0.1
_PARKING = (0.0, -3.0, -1.0)
"""m; empty slots wait here without weight and without contacts, out of every camera's view."""


@dataclass(frozen=True)
class SlotModel:
    """A compiled model and the field values of every object.

    Attributes:
        mj_model: the compiled model; its slots hold no object yet.
        slot_body_ids: [MAX_OBJECTS] int.
        slot_geom_ids: [MAX_OBJECTS, MAX_HULLS] int.
        slot_qpos_ids: [MAX_OBJECTS, 7] int indices into qpos.
        slot_dof_ids: [MAX_OBJECTS, 6] int indices into qvel.
        fields: per field name, [N + 1, ...] values of one slot for each object; the last row is the empty slot.
    """

    mj_model: mujoco.MjModel
    slot_body_ids: np.ndarray
    slot_geom_ids: np.ndarray
    slot_qpos_ids: np.ndarray
    slot_dof_ids: np.ndarray
    fields: dict[str, np.ndarray]


def make_slot_model(spec: mujoco.MjSpec, bank: HullBank) -> SlotModel:
    """Append the slots to `spec` (table and, first of all, any robot), compile, and tabulate every object.

    Raises:
        ValueError: an object of the bank has no hull.
    """
    if not (np.asarray(bank.object_hulls)[:, 0] >= 0).all():
        raise ValueError("hull bank: every object needs at least one hull")
    _add_hull_meshes(spec, bank)
    _add_slots(spec, bank)
    spec.option.disableflags |= mujoco.mjtDisableBit.mjDSBL_MIDPHASE | mujoco.mjtDisableBit.mjDSBL_AUTORESET
    spec.option.jacobian = mujoco.mjtJacobian.mjJAC_SPARSE
    mj_model = compile_spec(spec)
    surplus = [i for i in range(mj_model.ngeom) if mj_model.geom(i).name.startswith("catalogue")]
    mj_model.geom_contype[surplus] = 0
    mj_model.geom_conaffinity[surplus] = 0
    bodies = [mj_model.body(f"slot_{i}") for i in range(MAX_OBJECTS)]
    geoms = [[mj_model.geom(_geom_name(i, j)).id for j in range(MAX_HULLS)] for i in range(MAX_OBJECTS)]
    qpos = np.array([mj_model.jnt_qposadr[b.jntadr[0]] for b in bodies])
    dofs = np.array([b.dofadr[0] for b in bodies])[:, None] + np.arange(6)
    mj_model.dof_length[dofs[:, 3:]] = _ROTATION_LENGTH
    model = SlotModel(
        mj_model=mj_model,
        slot_body_ids=np.array([b.id for b in bodies]),
        slot_geom_ids=np.array(geoms),
        slot_qpos_ids=qpos[:, None] + np.arange(7),
        slot_dof_ids=dofs,
        fields=_tabulate(mj_model, bank),
    )
    write_slots(model, mj_model, np.full(MAX_OBJECTS, -1))
    return model


def silence_warnings() -> None:
    """Keep MuJoCo from printing warnings and appending them to a file in the working folder.

    Nothing is lost: `mujoco.batch.Batch.warning` counts them for each scene, and a scene that warns is diverged.
    """
    mujoco.set_mju_user_warning(lambda _: None)


def write_slots(model: SlotModel, target: mujoco.MjModel, object_ids: np.ndarray) -> None:
    """Put objects into the slots of `target`, a model compiled like `model.mj_model`, and update its constants.

    Args:
        model: the slot model.
        target: changed in place.
        object_ids: [MAX_OBJECTS] int, -1 for an empty slot.
    """
    for name in (*GEOM_FIELDS, *BODY_FIELDS):
        ids = model.slot_geom_ids if name in GEOM_FIELDS else model.slot_body_ids
        getattr(target, name)[ids] = model.fields[name][object_ids]
    mujoco.mj_setConst(target, mujoco.MjData(target))
    getattr(target, RBOUND)[model.slot_geom_ids] = model.fields[RBOUND][object_ids]


def parking_poses() -> np.ndarray:
    """Return the poses [MAX_OBJECTS, 7] of empty slots."""
    poses = np.tile([*_PARKING, 1.0, 0.0, 0.0, 0.0], (MAX_OBJECTS, 1))
    poses[:, 0] += 0.5 * np.arange(MAX_OBJECTS)
    return poses


def hull_points(bank: HullBank, hull: int) -> np.ndarray:
    """Return the distinct vertices [<= V, 3] of one full-level hull, in the order of the bank."""
    vertices = np.asarray(bank.full.vertices[hull], np.float64)
    _, first = np.unique(vertices, axis=0, return_index=True)
    return vertices[np.sort(first)]


def _geom_name(slot: int, hull: int) -> str:
    return f"slot_{slot}_hull_{hull}"


def _add_hull_meshes(spec: mujoco.MjSpec, bank: HullBank) -> None:
    for hull in range(bank.full.vertices.shape[0]):
        mesh = spec.add_mesh(name=f"hull_{hull}")
        mesh.uservert = hull_points(bank, hull).ravel()
        mesh.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_CONVEX


def _add_slots(spec: mujoco.MjSpec, bank: HullBank) -> None:
    """Add the slots, and a hidden body for the hulls that no slot geom names.

    MuJoCo builds a hull graph only for meshes that a collidable geom names when the model is compiled, and fixes
    the scale of the solver's tolerance (`stat.meaninertia`) then, so the slots start as objects of median inertia.
    """
    num_hulls = bank.full.vertices.shape[0]
    mass, inertia = float(np.median(bank.mass)), np.median(bank.inertia, axis=0)
    for slot in range(MAX_OBJECTS):
        body = spec.worldbody.add_body(name=f"slot_{slot}", explicitinertial=True, mass=mass, inertia=inertia)
        body.ipos = np.median(bank.com, axis=0)
        body.simple = False
        body.add_freejoint(name=f"slot_{slot}")
        for hull in range(MAX_HULLS):
            mesh = (slot * MAX_HULLS + hull) % num_hulls
            _add_hull_geom(body, _geom_name(slot, hull), mesh)
    if num_hulls > MAX_OBJECTS * MAX_HULLS:
        catalogue = spec.worldbody.add_body(name="catalogue", pos=[0, 0, -2])
        for mesh in range(MAX_OBJECTS * MAX_HULLS, num_hulls):
            _add_hull_geom(catalogue, f"catalogue_{mesh}", mesh)


def _add_hull_geom(body: mujoco.MjsBody, name: str, mesh: int) -> None:
    body.add_geom(name=name, type=mujoco.mjtGeom.mjGEOM_MESH, meshname=f"hull_{mesh}", condim=3)


def _tabulate(mj_model: mujoco.MjModel, bank: HullBank) -> dict[str, np.ndarray]:
    """Return `SlotModel.fields` from the compiled meshes and the bank's masses."""
    geom_of_mesh = {int(mj_model.geom_dataid[g]): g for g in reversed(range(mj_model.ngeom)) if _is_hull(mj_model, g)}
    hulls = np.asarray(bank.object_hulls)
    present = hulls >= 0
    present = np.vstack([present, np.zeros((1, MAX_HULLS), bool)])
    mesh_ids = np.vstack([np.where(hulls >= 0, hulls, hulls[:, :1]), np.zeros((1, MAX_HULLS), hulls.dtype)])
    mesh_ids += first_hull(mj_model)
    geom_ids = np.vectorize(geom_of_mesh.__getitem__)(mesh_ids)
    friction = np.append(np.asarray(bank.friction, np.float64), 0.0)
    fields = {name: getattr(mj_model, name)[geom_ids].copy() for name in (*GEOM_FIELDS, RBOUND)}
    fields["geom_dataid"] = mesh_ids.astype(np.int32)
    fields["geom_contype"] = present.astype(np.int32)
    fields["geom_conaffinity"] = present.astype(np.int32)
    fields["geom_friction"][..., 0] = friction[:, None]
    small = 1e-4 * np.ones((1, 3))
    fields["body_mass"] = np.append(np.asarray(bank.mass, np.float64), _PARKED_MASS)
    fields["body_inertia"] = np.vstack([np.asarray(bank.inertia, np.float64), small])
    fields["body_ipos"] = np.vstack([np.asarray(bank.com, np.float64), np.zeros((1, 3))])
    quat = np.asarray(bank.inertia_quat, np.float64)
    fields["body_iquat"] = np.vstack([quat / np.linalg.norm(quat, axis=1, keepdims=True), [[1.0, 0.0, 0.0, 0.0]]])
    fields["body_gravcomp"] = np.append(np.zeros(len(bank.mass)), 1.0)
    return fields


def first_hull(mj_model: mujoco.MjModel) -> int:
    """Return the id of the first hull's mesh; the others follow, those that a robot's MJCF holds come before."""
    return int(mj_model.mesh("hull_0").id)


def _is_hull(mj_model: mujoco.MjModel, geom: int) -> bool:
    return mj_model.geom(geom).name.startswith(("slot_", "catalogue_"))


def write_batch_slots(
    model: SlotModel, expanded: dict[str, np.ndarray], sims: np.ndarray, object_ids: np.ndarray
) -> None:
    """Write all `SLOT_FIELDS` but the bounding radius of simulations `sims` of a `mujoco.batch.Batch`.

    Args:
        model: the slot model.
        expanded: live arrays of `Batch.expand` by field name.
        sims: [n] int simulations.
        object_ids: [n, MAX_OBJECTS] int, -1 for an empty slot.
    """
    write_batch_fields(model, expanded, sims, object_ids, (*GEOM_FIELDS, *BODY_FIELDS))


def write_batch_fields(
    model: SlotModel,
    expanded: dict[str, np.ndarray],
    sims: np.ndarray,
    object_ids: np.ndarray,
    names: Iterable[str],
) -> None:
    """Write the named fields of simulations `sims`; see `write_batch_slots`."""
    for name in names:
        ids = model.slot_body_ids if name in BODY_FIELDS else model.slot_geom_ids
        expanded[name][sims.reshape(-1, *[1] * ids.ndim), ids] = model.fields[name][object_ids]
