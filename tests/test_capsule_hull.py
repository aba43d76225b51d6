"""Capsule against hull: exact distances, on hulls of the built-in objects, lying on them, in them and beside them."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from mjx_oracle import least_translation
from mujoco.mjx._src.collision_types import ConvexInfo, GeomInfo

from pregrasp_jax.assets.catalogue import builtin_bank
from pregrasp_jax.physics.capsule_hull import capsule_hull
from pregrasp_jax.physics.hull_table import make_hull_table

NUM_PAIRS = 900


class CapsuleDistance:
    """`mj_geomDistance` between a capsule and any hull of a bank; both are placed in the hull's frame."""

    def __init__(self, vertices: list[np.ndarray]):
        spec = mujoco.MjSpec()
        for i, points in enumerate(vertices):
            mesh = spec.add_mesh(name=f"hull_{i}")
            mesh.uservert = points.ravel()
            mesh.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_CONVEX
            spec.worldbody.add_geom(name=f"hull_{i}", type=mujoco.mjtGeom.mjGEOM_MESH, meshname=mesh.name)
        body = spec.worldbody.add_body()
        body.add_freejoint()
        body.add_geom(name="capsule", type=mujoco.mjtGeom.mjGEOM_CAPSULE, size=[0.1, 0.1, 0.0])
        self.mj_model = spec.compile()
        self.data = mujoco.MjData(self.mj_model)
        mujoco.mj_kinematics(self.mj_model, self.data)

    def __call__(self, hull: int, radius: float, half_length: float, position: np.ndarray, axes: np.ndarray) -> float:
        geom = self.mj_model.geom("capsule").id
        self.mj_model.geom_size[geom] = radius, half_length, 0
        self.data.geom_xpos[geom], self.data.geom_xmat[geom] = position, axes.ravel()
        return mujoco.mj_geomDistance(self.mj_model, self.data, geom, self.mj_model.geom(f"hull_{hull}").id, 1.0, None)


@pytest.fixture(scope="module")
def table():
    return make_hull_table(builtin_bank("seen").coarse)


@pytest.fixture(scope="module")
def collider(table):
    """(hulls [n], sizes [n, 3], positions [n, 3], axes [n, 3, 3], hull poses) -> dist, pos, normal."""

    def one(hull, size, pos, mat, hull_pos, hull_mat):
        fields = {name: rows[hull] for name, rows in vars(table).items() if name != "centre"}
        return capsule_hull(GeomInfo(pos, mat, size), ConvexInfo(hull_pos, hull_mat, jnp.zeros(3), **fields))

    return jax.jit(jax.vmap(one))


def rotation(rng: np.random.Generator) -> np.ndarray:
    mat, quat = np.zeros(9), rng.normal(size=4)
    mujoco.mju_quat2Mat(mat, quat / np.linalg.norm(quat))
    return mat.reshape(3, 3)


def axes_along(direction: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return a rotation whose third column is the direction."""
    first = np.cross(direction, rng.normal(size=3))
    first /= np.linalg.norm(first)
    return np.stack([first, np.cross(direction, first), direction], axis=1)


def any_pair(table, hull: int, rng: np.random.Generator, kind: int) -> tuple[np.ndarray, np.ndarray]:
    """Return position and axes of a capsule in the hull's frame: askew, along an edge, or along a face's normal."""
    position = rng.normal(0, 0.06, 3)
    if kind == 0:
        return position, rotation(rng)
    edge = table.vert[hull][table.edge[hull][rng.integers(len(table.edge[hull]))]]
    normals = table.face_normal[hull]
    direction = [edge[1] - edge[0], normals[rng.integers(len(normals))]][kind - 1].astype(np.float64)
    return position, axes_along(direction / np.linalg.norm(direction), rng)


def test_distances_are_exact_and_parting_by_them_parts(table, collider):
    """Outside against `mj_geomDistance`, inside against the Minkowski difference: 1e-5 m, the preference for faces."""
    host, rng = jax.tree.map(np.asarray, table), np.random.default_rng(0)
    vertices = [np.unique(points, axis=0).astype(np.float64) for points in host.vert]
    distance = CapsuleDistance(vertices)
    hulls = rng.integers(0, len(vertices), NUM_PAIRS)
    sizes = np.stack([rng.uniform(0.004, 0.06, NUM_PAIRS), rng.uniform(0.01, 0.2, NUM_PAIRS), np.zeros(NUM_PAIRS)], 1)
    local = [any_pair(host, hull, rng, i % 3) for i, hull in enumerate(hulls)]
    turns, shifts = np.stack([rotation(rng) for _ in hulls]), rng.normal(0, 0.3, (NUM_PAIRS, 3))
    world = [(turn @ pos + shift, turn @ axes) for (pos, axes), turn, shift in zip(local, turns, shifts, strict=True)]
    arrays = (sizes, *(np.stack(part) for part in zip(*world, strict=True)), shifts, turns)
    dist, _, normal = jax.tree.map(np.asarray, collider(hulls, *(jnp.asarray(x, jnp.float32) for x in arrays)))
    seen = {"inside": 0, "outside": 0, "apart": 0}
    for i, hull in enumerate(hulls):
        (radius, half_length, _), (position, axes) = sizes[i], local[i]
        segment = position + np.outer([-1, 1], half_length * axes[:, 2])
        depth = least_translation(vertices[hull], segment)
        # A thin capsule: the radius adds to both kinds of distance, and C is exact where nothing overlaps.
        exact = (-depth if depth > 0 else distance(hull, 1e-9, half_length, position, axes)) - radius
        seen["inside" if depth > 0 else "outside" if exact < 0 else "apart"] += 1
        if abs(exact) > 1e-5:
            assert (dist[i, 0] < 0) == (exact < 0), i
        if exact < 0 and dist[i, 0] < 0:
            assert dist[i].min() == pytest.approx(exact, abs=1.5e-5), i
            axis = turns[i].T @ normal[i, 0]
            overlap = (segment @ axis).max() + radius - (vertices[hull] @ axis).min()
            assert overlap == pytest.approx(-exact, abs=5e-5), i
    assert min(seen.values()) > NUM_PAIRS / 10, seen


BLOCK = np.array([0.02, 0.03, 0.05])
"""Half sizes of the box below, m."""


@pytest.fixture(scope="module")
def on_block():
    """(capsule position, axis) -> dist [2], pos [2, 3], normal [2, 3] on a box, for a capsule of 10 and 40 mm."""
    corners = BLOCK * np.array(np.meshgrid(*[[-1, 1]] * 3, indexing="ij")).reshape(3, -1).T
    faces, normals, edges, edge_normals = [], [], [], []
    for axis in range(3):
        for sign in (-1, 1):
            normal = np.eye(3)[axis] * sign
            face = corners[np.sign(corners[:, axis]) == sign]
            side, up = (np.eye(3)[(axis + k) % 3] for k in (1, 2))
            order = np.argsort(sign * np.arctan2(face @ up / BLOCK.max(), face @ side / BLOCK.max()))
            faces.append(face[order])
            normals.append(normal)
    for i in range(8):
        for j in range(i):
            same = np.isclose(corners[i], corners[j])
            if same.sum() == 2:
                edges.append((j, i))
                edge_normals.append([np.sign(corners[i, k]) * np.eye(3)[k] for k in np.flatnonzero(same)])
    fields = {
        "vert": corners,
        "face": np.array(faces),
        "face_normal": np.array(normals),
        "edge_face_normal": np.array(edge_normals),
    }
    block = ConvexInfo(
        jnp.zeros(3),
        jnp.eye(3),
        jnp.zeros(3),
        edge=jnp.array(edges),
        **{name: jnp.asarray(value, jnp.float32) for name, value in fields.items()},
    )
    rng = np.random.default_rng(0)
    collide = jax.jit(capsule_hull)

    def contacts(position, axis):
        axes = axes_along(np.asarray(axis, np.float64), rng)
        info = GeomInfo(*(jnp.asarray(x, jnp.float32) for x in (position, axes, [0.01, 0.04, 0.0])))
        return [np.asarray(x) for x in collide(info, block)]

    return contacts


def test_a_capsule_lying_on_a_face_has_a_contact_at_each_end_of_what_lies_above_it(on_block):
    """2 mm deep on the top: 80 mm along y reach beyond the 60 mm of the face, so its edges end the contact."""
    dist, pos, normal = on_block([0.0, 0.0, 0.058], [0, 1, 0])
    np.testing.assert_allclose(dist, [-0.002, -0.002], atol=1e-6)
    np.testing.assert_allclose(np.sort(pos[:, 1]), [-0.03, 0.03], atol=1e-6)
    np.testing.assert_allclose(pos[:, 2], 0.049, atol=1e-6)  # half way between the two surfaces
    np.testing.assert_allclose(normal, [[0, 0, -1]] * 2, atol=1e-6)


def test_a_tilted_capsule_has_its_deeper_end_first(on_block):
    """Tilted by 0.5 mm in 40: it leaves the face at 30, where it is 1.875 and 1.125 mm deep, the first at an edge."""
    tilt = np.arcsin(0.0005 / 0.04)
    dist, pos, _ = on_block([0.0, 0.0, 0.0585], [0, np.cos(tilt), np.sin(tilt)])
    np.testing.assert_allclose(dist, [-0.0015 - 0.000375, -0.0015 + 0.000375], atol=2e-6)
    np.testing.assert_allclose(pos[:, 1], [-0.03, 0.03], atol=2e-4)


def test_a_capsule_standing_on_a_face_and_one_across_an_edge_have_one_contact(on_block):
    standing, _, normal = on_block([0.0, 0.0, 0.05 + 0.048], [0, 0, 1])
    np.testing.assert_allclose(standing, [-0.002, 1.0], atol=1e-6)
    np.testing.assert_allclose(normal[0], [0, 0, -1], atol=1e-6)
    out = np.array([0.0, 1.0, 1.0]) / np.sqrt(2)
    crossing, pos, normal = on_block([0.0, *(BLOCK[1:] + 0.007 * out[1:])], [1, 0, 0])
    np.testing.assert_allclose(crossing, [-0.003, 1.0], atol=1e-6)
    np.testing.assert_allclose(normal[0], -out, atol=1e-5)
    np.testing.assert_allclose(pos[0, 1:], BLOCK[1:] - 0.0015 * out[1:], atol=1e-6)


def test_a_capsule_right_through_the_box_leaves_by_the_nearest_face(on_block):
    """Along z through a box of 40 mm in x, 5 mm off centre: 15 mm to the face and 10 mm of radius."""
    dist, _, normal = on_block([0.005, 0.0, 0.0], [0, 0, 1])
    np.testing.assert_allclose(dist, [-0.025, -0.025], atol=1e-6)
    np.testing.assert_allclose(normal[0], [-1, 0, 0], atol=1e-6)
