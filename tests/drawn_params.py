"""Parameters that numpy draws: XLA takes a second to compile the draw of one kernel, and a network has forty."""

import zlib
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np


def drawn_params(init: Callable[..., Any], *args: Any, seed: int = 0) -> Any:
    """Return what ``init(key, *args)`` would, random in every layer: kernels of unit gain, biases of 0.1."""
    shapes = jax.eval_shape(init, jax.random.key(0), *args)

    def draw(path: Any, leaf: jax.ShapeDtypeStruct) -> jax.Array:
        rng = np.random.default_rng((seed, zlib.crc32(jax.tree_util.keystr(path).encode())))
        scale = 0.1 if leaf.ndim < 2 else (2 / np.prod(leaf.shape[:-1])) ** 0.5
        return jnp.asarray(rng.normal(0.0, scale, leaf.shape), leaf.dtype)

    return jax.tree_util.tree_map_with_path(draw, shapes)
