"""The table of hulls that MJX's colliders read."""

import jax
import numpy as np

from pregrasp_jax.assets.catalogue import builtin_bank
from pregrasp_jax.physics.hull_table import make_hull_table


def test_hulls_keep_their_shape():
    """Faces bound the vertices, every corner lies on its face, and Euler's formula holds for what is not padding."""
    bank = builtin_bank("seen")
    table = jax.tree.map(np.asarray, make_hull_table(bank.coarse))
    for hull, coarse in enumerate(np.asarray(bank.coarse.vertices)):
        normal, face, edge = table.face_normal[hull], table.face[hull], table.edge[hull]
        np.testing.assert_allclose(table.vert[hull] + table.centre[hull], coarse, atol=1e-7)
        offset = np.einsum("fi,fpi->fp", normal, face)
        assert np.ptp(offset, axis=1).max() < 5e-6
        assert (table.vert[hull] @ normal.T - offset[:, 0]).max() < 5e-6
        vertices = len(np.unique(coarse, axis=0))
        faces = len(np.unique(np.hstack([normal, offset[:, :1]]), axis=0))
        edges = len(np.unique(np.sort(edge, axis=1), axis=0))
        assert vertices - edges + faces == 2
        for (a, b), normals in zip(edge, table.edge_face_normal[hull], strict=True):
            along = table.vert[hull][b] - table.vert[hull][a]
            assert np.abs(normals @ along).max() < 5e-6
