"""Collada (.dae): the polygons of its scene, in metres; its unit is applied, its up axis is told."""

import io

import numpy as np

from pregrasp_jax.assets.formats.extras import import_extra
from pregrasp_jax.assets.formats.surface import Surface, from_polygons, join

_UP = {"X_UP": "x", "Y_UP": "y", "Z_UP": "z"}


def read_collada(data: bytes) -> Surface:
    """Read the polygons of the scene; materials, lights and cameras say nothing.

    Raises:
        ValueError: pycollada is not installed, or the file is damaged.
    """
    collada = import_extra("collada", "the format .dae")
    errors = collada.common
    document = collada.Collada(
        io.BytesIO(data),
        # A texture that is not there, or an effect that is not known, changes no shape.
        ignore=[errors.DaeBrokenRefError, errors.DaeUnsupportedError, errors.DaeIncompleteError],
        aux_file_loader=lambda name: None,
    )
    parts = []
    if document.scene is not None:
        for kind in ("geometry", "controller"):
            for bound in document.scene.objects(kind):
                parts += [_read_primitive(primitive) for primitive in bound.primitives()]
    joined = join([part for part in parts if part is not None], up=_UP.get(document.assetInfo.upaxis or "Y_UP"))
    return joined._replace(vertices=joined.vertices * (document.assetInfo.unitmeter or 1.0))


def _read_primitive(primitive) -> Surface | None:
    """Return the polygons of one bound primitive, None if it has lines."""
    if primitive.vertex is None or primitive.vertex_index is None:
        return None
    corners = np.asarray(primitive.vertex_index)
    if hasattr(primitive, "polyindex"):
        sizes = np.diff(primitive.polyindex, axis=1).ravel()
    elif corners.ndim == 2 and corners.shape[1] == 3:
        sizes = np.full(len(corners), 3)
    else:
        return None
    return from_polygons(np.asarray(primitive.vertex), sizes, corners.ravel())
