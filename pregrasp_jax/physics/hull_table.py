"""Convex hulls as MJX's colliders want them: polygons and edges with normals, all hulls padded to one topology."""

import flax.struct as struct
import jax
import jax.numpy as jnp
import numpy as np
from scipy.spatial import ConvexHull

from pregrasp_jax.types import COARSE_TOPOLOGY, Hulls


class HullTable(struct.PyTreeNode):
    """M hulls about their own centres, padded by repeating the last vertex, face and edge (harmless).

    Any number of scenes share the table; a geom carries nothing but the row of its hull.

    Attributes:
        centre: [M, 3] m, mean of the vertices in the object frame; the rest is relative to it.
        vert: [M, V, 3] m.
        face: [M, F, P, 3] m, the polygon of each face, counter-clockwise seen from outside.
        face_normal: [M, F, 3] outward.
        edge: [M, E, 2] int32 vertex indices.
        edge_face_normal: [M, E, 2, 3] normals of the two faces that meet at each edge.
    """

    centre: jax.Array
    vert: jax.Array
    face: jax.Array
    face_normal: jax.Array
    edge: jax.Array
    edge_face_normal: jax.Array


def make_hull_table(hulls: Hulls) -> HullTable:
    """Return the table of M hulls of `COARSE_TOPOLOGY`; P is the largest number of corners of any face."""
    rows = [_describe(*each) for each in zip(np.asarray(hulls.vertices), np.asarray(hulls.planes), strict=True)]
    _, num_faces, num_edges = COARSE_TOPOLOGY
    num_corners = max(len(polygon) for _, polygons, _, _ in rows for polygon in polygons)
    table: dict[str, list[np.ndarray]] = {name: [] for name in HullTable.__dataclass_fields__}
    for vertices, polygons, normals, edges in rows:
        centre = np.unique(vertices, axis=0).mean(axis=0)
        local = vertices - centre
        table["centre"].append(centre)
        table["vert"].append(local)
        table["face"].append(_pad(np.stack([local[_pad(np.array(p), num_corners)] for p in polygons]), num_faces))
        table["face_normal"].append(_pad(normals, num_faces))
        table["edge"].append(_pad(edges[:, :2], num_edges))
        table["edge_face_normal"].append(_pad(normals[edges[:, 2:]], num_edges))
    arrays = {name: np.stack(values) for name, values in table.items()}
    return HullTable(**{k: jnp.asarray(v, jnp.int32 if k == "edge" else float) for k, v in arrays.items()})


def _describe(vertices: np.ndarray, planes: np.ndarray) -> tuple[np.ndarray, list[list[int]], np.ndarray, np.ndarray]:
    """Return vertices [V, 3], polygons of vertex indices, normals [F, 3] and edges [E, 4] (two vertices, two faces).

    Triangles of the hull are gathered under the bank's face planes, so that flat sides stay one polygon.
    """
    vertices = vertices.astype(np.float64)
    planes = np.unique(planes.astype(np.float64), axis=0)
    _, first = np.unique(vertices, axis=0, return_index=True)
    first.sort()
    hull = ConvexHull(vertices[first])
    triangles = first[hull.simplices]
    offsets = np.abs(hull.equations[:, None, 3] + planes[None, :, 3])
    owner = np.argmax(hull.equations[:, :3] @ planes[:, :3].T - offsets, axis=1)
    used, face_of = np.unique(owner, return_inverse=True)
    normals = planes[used, :3] / np.linalg.norm(planes[used, :3], axis=1, keepdims=True)
    polygons = [_polygon(vertices, triangles[face_of == face], normals[face]) for face in range(len(used))]
    edges = [
        (first[hull.simplices[t][pair[0]]], first[hull.simplices[t][pair[1]]], face_of[t], face_of[other])
        for t in range(len(triangles))
        for pair, other in zip(([1, 2], [2, 0], [0, 1]), hull.neighbors[t], strict=True)
        if t < other and face_of[t] != face_of[other]
    ]
    return vertices, polygons, normals, np.array(edges)


def _polygon(vertices: np.ndarray, triangles: np.ndarray, normal: np.ndarray) -> list[int]:
    """Return the corners of coplanar triangles [T, 3], counter-clockwise about `normal`."""
    corners = np.unique(triangles)
    offsets = vertices[corners] - vertices[corners].mean(axis=0)
    side = offsets[0] / np.linalg.norm(offsets[0])
    angles = np.arctan2(offsets @ np.cross(normal, side), offsets @ side)
    return [int(i) for i in corners[np.argsort(angles)]]


def _pad(rows: np.ndarray, count: int) -> np.ndarray:
    return np.concatenate([rows, np.repeat(rows[-1:], count - len(rows), axis=0)])
