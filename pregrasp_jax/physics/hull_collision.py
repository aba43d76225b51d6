"""Collisions in which every hull geom may be any hull: one group for all hull pairs, whatever stands in the scene.

Stock MJX compiles one subgraph for each pair of meshes, and all scenes share the meshes. Here a geom names its
hull by a row of a `HullTable`, so compile time does not depend on the number of hulls, and hulls differ per scene.
Broadphase is by axis-aligned boxes; both of its limits report when they are exceeded.
"""

from pregrasp_jax.physics import mjx_version  # noqa: F401  (refuses other releases before their internals are used)

# isort: split
from dataclasses import dataclass

import flax.struct as struct
import jax
import jax.numpy as jnp
from mujoco import mjx
from mujoco.mjx._src import collision_driver, math, mesh
from mujoco.mjx._src.collision_types import ConvexInfo, FunctionKey, GeomInfo
from mujoco.mjx._src.types import Contact, GeomType

from pregrasp_jax.physics.capsule_hull import capsule_hull
from pregrasp_jax.physics.hull_table import HullTable
from pregrasp_jax.physics.plane_hull import NO_CONTACT, plane_hull
from pregrasp_jax.physics.separating_axis import hull_hull

_FAR = 1e6
"""m; absent hulls are this far from everything."""


@dataclass(frozen=True)
class Limits:
    """Sizes fixed when the program is compiled.

    Attributes:
        max_hull_pairs: pairs of hulls that reach the narrow phase, those whose boxes overlap most.
        max_robot_pairs: the same for a hull and one of the robot's boxes, and for a hull and one of its capsules.
        max_contact_points: contacts that reach the solver, the deepest ones.
    """

    max_hull_pairs: int
    max_robot_pairs: int
    max_contact_points: int


class ContactCounts(struct.PyTreeNode):
    """What the broadphase saw, before it dropped anything.

    Attributes:
        hull_pairs: () int32 pairs of hulls with overlapping boxes.
        robot_pairs: () int32 the same for hulls and robot, in the fuller of its two groups.
        contacts: () int32 penetrating contacts.
        depth: () float32 m, deepest penetration.
    """

    hull_pairs: jax.Array
    robot_pairs: jax.Array
    contacts: jax.Array
    depth: jax.Array


def collide(
    m: mjx.Model, d: mjx.Data, hulls: HullTable, hull_ids: jax.Array, limits: Limits
) -> tuple[mjx.Data, ContactCounts]:
    """Fill the contacts of one scene; takes the place of `mjx.collision`.

    Args:
        m: model whose mesh geoms all name one mesh, so that they share their collision groups; condim 3 throughout.
        d: data after kinematics.
        hulls: table of all hulls.
        hull_ids: [ngeom] int32 row of the table for mesh geoms, -1 where the slot has no such hull.
        limits: sizes.

    Returns:
        The data with its contacts, and the counts to be compared with `limits`.
    """
    boxes = bounding_boxes(m, d, hulls, hull_ids)
    parts, overlaps = [], {"hull": jnp.int32(0), "robot": jnp.int32(0)}
    for key, pairs in collision_driver._geom_groups(m).items():
        geom = jnp.array(pairs)[:, :2]
        gap = jnp.full(len(geom), -_FAR)
        if key.types[0] != GeomType.PLANE:
            gap = _gap(boxes, geom)
            name = "hull" if key.types[0] == GeomType.MESH else "robot"
            overlaps[name] = jnp.maximum(overlaps[name], jnp.sum(gap < 0, dtype=jnp.int32))
            limit = limits.max_hull_pairs if name == "hull" else limits.max_robot_pairs
            gap, chosen = _smallest(gap, min(limit, len(geom)))
            geom = geom[chosen]
        dist, pos, frame = _narrow_phase(m, d, key, geom, hulls, hull_ids)
        repeats = len(dist) // len(geom)
        present = (gap < 0) & ~_absent(m, hull_ids)[geom].any(axis=1)
        parts.append(
            (jnp.where(jnp.repeat(present, repeats), dist, NO_CONTACT), pos, frame, jnp.repeat(geom, repeats, 0))
        )
    dist, pos, frame, geom = (jnp.concatenate(part) for part in zip(*parts, strict=True))
    count = ContactCounts(
        hull_pairs=overlaps["hull"],
        robot_pairs=overlaps["robot"],
        contacts=jnp.sum(dist < 0).astype(jnp.int32),
        depth=jnp.max(-dist, initial=0.0),
    )
    dist, deepest = _smallest(dist, len(d._impl.contact.dim))
    contact = _with_parameters(m, d._impl.contact, dist, pos[deepest], frame[deepest], geom[deepest])
    return d.tree_replace({"_impl.contact": contact}), count


def bounding_boxes(m: mjx.Model, d: mjx.Data, hulls: HullTable, hull_ids: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Return the lower and upper corner [ngeom, 3] m of the world-aligned box around each capsule, box and hull."""
    size, mat, kind = m.geom_size, d.geom_xmat, jnp.array(m.geom_type)[:, None]
    capsule = jnp.abs(mat[:, :, 2]) * size[:, 1:2] + size[:, :1]
    box = jnp.einsum("gij,gj->gi", jnp.abs(mat), size)
    half = jnp.where(kind == GeomType.CAPSULE, capsule, box)
    low, high = d.geom_xpos - half, d.geom_xpos + half
    (is_hull,) = (m.geom_type == GeomType.MESH).nonzero()
    ids = hull_ids[is_hull]
    points = jnp.einsum("gij,gvj->gvi", mat[is_hull], hulls.vert[ids]) + d.geom_xpos[is_hull, None]
    absent = (ids < 0)[:, None]
    low = low.at[is_hull].set(jnp.where(absent, _FAR, points.min(axis=1)))
    return low, high.at[is_hull].set(jnp.where(absent, -_FAR, points.max(axis=1)))


def _gap(boxes: tuple[jax.Array, jax.Array], geom: jax.Array) -> jax.Array:
    """Return the largest distance [P] along an axis between the boxes of pairs [P, 2]; negative where they overlap."""
    low, high = boxes
    first, second = geom.T
    return jnp.maximum(low[first] - high[second], low[second] - high[first]).max(axis=-1)


def _smallest(values: jax.Array, count: int) -> tuple[jax.Array, jax.Array]:
    negative, indices = jax.lax.top_k(-values, count)
    return -negative, indices


def _absent(m: mjx.Model, hull_ids: jax.Array) -> jax.Array:
    return jnp.array(m.geom_type == GeomType.MESH) & (hull_ids < 0)


def _narrow_phase(
    m: mjx.Model, d: mjx.Data, key: FunctionKey, geom: jax.Array, hulls: HullTable, hull_ids: jax.Array
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Return dist [n], pos [n, 3] and frame [n, 3, 3] of the contacts of pairs [P, 2] of one kind, n = P * ncon."""
    kinds = GeomType(key.types[0]), GeomType(key.types[1])
    if kinds[1] != GeomType.MESH:
        return collision_driver._COLLISION_FUNC[kinds](m, d, key, geom)
    (first, first_axes), (second, _) = (
        _shape(m, d, kind, ids, hulls, hull_ids) for kind, ids in zip(kinds, geom.T, strict=True)
    )
    dist, pos, normal = jax.vmap(_COLLIDERS[kinds[0]], in_axes=(first_axes, 0))(first, second)
    frame = jax.vmap(jax.vmap(math.make_frame))(normal)
    return dist.reshape(-1), pos.reshape(-1, 3), frame.reshape(-1, 3, 3)


def _shape(
    m: mjx.Model, d: mjx.Data, kind: int, geom: jax.Array, hulls: HullTable, hull_ids: jax.Array
) -> tuple[GeomInfo | ConvexInfo, GeomInfo | ConvexInfo | int]:
    """Return what a collider needs of geoms [P], and which of it has a pair axis."""
    info = GeomInfo(d.geom_xpos[geom], d.geom_xmat[geom], m.geom_size[geom])
    if kind == GeomType.MESH:
        h = jax.tree.map(lambda rows: rows[hull_ids[geom]], hulls)
        return ConvexInfo(**vars(info), **{k: v for k, v in vars(h).items() if k != "centre"}), 0
    if kind == GeomType.BOX:
        box = mesh.box(info)
        return box, jax.tree.map(lambda _: None, box).replace(pos=0, mat=0, size=0, vert=0, face=0)
    return info, 0


_COLLIDERS = {
    GeomType.PLANE: plane_hull,
    GeomType.CAPSULE: capsule_hull,
    GeomType.BOX: hull_hull,
    GeomType.MESH: hull_hull,
}
"""By the type of the first geom; the second is a hull."""


def _with_parameters(
    m: mjx.Model, contact: Contact, dist: jax.Array, pos: jax.Array, frame: jax.Array, geom: jax.Array
) -> Contact:
    """Return the contacts [n] with friction and softness of their geoms mixed as MuJoCo does.

    The geom of higher priority decides; among equals friction is the larger, and softness the mean weighted by
    solmix. (Negative solref, which MuJoCo mixes otherwise, does not occur in the slot model.)
    """
    first, second = geom.T
    lead = jnp.array(m.geom_priority)[first] - jnp.array(m.geom_priority)[second]
    weight = m.geom_solmix[first] / (m.geom_solmix[first] + m.geom_solmix[second])
    weight = jnp.where(lead == 0, weight, (lead > 0).astype(weight.dtype))[:, None]
    friction = jnp.maximum(m.geom_friction[first], m.geom_friction[second])
    chosen = jnp.where((lead > 0)[:, None], m.geom_friction[first], m.geom_friction[second])
    friction = jnp.where((lead == 0)[:, None], friction, chosen)
    return contact.replace(
        dist=dist,
        pos=pos,
        frame=frame,
        includemargin=jnp.zeros_like(dist),
        friction=friction[:, jnp.array([0, 0, 1, 2, 2])],
        solref=weight * m.geom_solref[first] + (1 - weight) * m.geom_solref[second],
        solreffriction=jnp.zeros((len(dist), 2)),
        solimp=weight * m.geom_solimp[first] + (1 - weight) * m.geom_solimp[second],
        geom1=first,
        geom2=second,
        geom=geom,
    )
