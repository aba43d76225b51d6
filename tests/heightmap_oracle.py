"""Random hulls, and MuJoCo's ray casting on the same hulls: the oracle of the heightmap tests."""

import jax.numpy as jnp
import mujoco
import numpy as np
from scipy.spatial import ConvexHull

from pregrasp_jax.heightmap import HullInstances
from pregrasp_jax.types import FULL_TOPOLOGY

NUM_VERTICES, NUM_FACES, _ = FULL_TOPOLOGY


def hull_planes(points: np.ndarray) -> np.ndarray:
    """Return the distinct outward planes [F, 4] (n, d) of the convex hull of points [V, 3]."""
    equations = ConvexHull(points).equations
    return np.concatenate([equations[:, :3], -equations[:, 3:]], axis=1)


def pad(rows: np.ndarray, length: int) -> np.ndarray:
    """Repeat the last row up to `length` rows."""
    return np.concatenate([rows, np.repeat(rows[-1:], length - len(rows), axis=0)])


def make_instances(clouds: list[np.ndarray], labels: list[int]) -> HullInstances:
    """Place the convex hull of each cloud [V, 3] m, world frame, under its label."""
    return HullInstances(
        planes=jnp.asarray(np.stack([pad(hull_planes(c), NUM_FACES) for c in clouds]), jnp.float32),
        vertices=jnp.asarray(np.stack([pad(c, NUM_VERTICES) for c in clouds]), jnp.float32),
        labels=jnp.asarray(labels, jnp.uint8),
        present=jnp.ones(len(clouds), bool),
    )


def box_cloud(low: tuple[float, float, float], high: tuple[float, float, float]) -> np.ndarray:
    """Return the corners [8, 3] of an axis-aligned box."""
    return np.array(np.meshgrid(*zip(low, high, strict=True))).reshape(3, 8).T


def random_clouds(rng: np.random.Generator, count: int, *, size: float = 0.05, spread: float = 0.2) -> list[np.ndarray]:
    """Draw `count` clouds on ellipsoids that hover over, stand in, or reach out of the workspace."""
    clouds = []
    for _ in range(count):
        directions = rng.normal(size=(NUM_VERTICES, 3))
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        radii = size * rng.uniform(0.3, 1.5, size=3)
        center = rng.uniform([-spread, -spread, 0.0], [spread, spread, 0.2])
        clouds.append((center + directions * radii).astype(np.float32).astype(np.float64))
    return clouds


def cast_rays(instances: HullInstances, origins: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Cast rays with `mj_multiRay` against the same hulls, compiled as meshes.

    Args:
        instances: K hulls; absent ones are left out.
        origins: [R, 3] or [3] m.
        directions: [R, 3], need not be unit; distances are in their lengths.

    Returns:
        distance [R], -1 where nothing is hit, and labels [R], 0 there.
    """
    spec = mujoco.MjSpec()
    labels = []
    for k in np.flatnonzero(np.asarray(instances.present)):
        points = np.asarray(instances.vertices[k], np.float64)
        faces = _outward_faces(points)
        spec.add_mesh(name=f"mesh{k}", uservert=points.ravel(), userface=faces.ravel())
        spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname=f"mesh{k}")
        labels.append(int(instances.labels[k]))
    mj_model = spec.compile()
    mj_data = mujoco.MjData(mj_model)
    mujoco.mj_forward(mj_model, mj_data)
    # mj_multiRay shares one origin, which a fan of vertical rays does not have.
    origins = np.broadcast_to(origins, directions.shape)
    distance, geom_id = np.empty(len(directions)), np.zeros((len(directions), 1), np.int32)
    for r, (origin, direction) in enumerate(zip(origins, directions, strict=True)):
        distance[r] = mujoco.mj_ray(mj_model, mj_data, origin, direction, None, 1, -1, geom_id[r])
    geom_id = geom_id[:, 0]
    return distance, np.where(geom_id >= 0, np.array(labels)[geom_id], 0)


def _outward_faces(points: np.ndarray) -> np.ndarray:
    hull = ConvexHull(points)
    a, b, c = (points[hull.simplices[:, i]] for i in range(3))
    inward = np.einsum("ij,ij->i", np.cross(b - a, c - a), hull.equations[:, :3]) < 0
    faces = hull.simplices.copy()
    faces[inward] = faces[inward][:, ::-1]
    return faces.astype(np.int32)
