"""The same policy for users of JAX: StableHLO as `jax.export` serialises it, with the inputs of the ONNX graph."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import export

from pregrasp_jax.export.onnx_policy import INPUTS
from pregrasp_jax.heightmap import SEGMENTATION
from pregrasp_jax.learning.q_function import QFunction
from pregrasp_jax.spaces import grid
from pregrasp_jax.types import ROBOT_ID, TABLE_ID, HandPose, Observation

PLATFORMS = ("cpu", "cuda")
"""Lowered for both; no GPU is needed for that."""

_TARGET_SLOT = 0
_INSTANCE_OF = {"table": TABLE_ID, "obstacle": _TARGET_SLOT + 2, "target": _TARGET_SLOT + 1, "robot": ROBOT_ID}
"""Label -> an instance id that is fused to it."""


def policy_function(q_function: QFunction, params: Any) -> Callable[..., jax.Array]:
    """Return (height_m, labels, p1_m) -> q of batches, as the ONNX graph computes it."""
    instances = np.array([_INSTANCE_OF[name] for name in SEGMENTATION], np.uint8)

    def values(height_m: jax.Array, labels: jax.Array, p1_m: jax.Array) -> jax.Array:
        zero = jnp.zeros(())
        hand = HandPose(p1_m, zero, zero, zero)
        obs = Observation(grid.quantize_height(height_m), jnp.asarray(instances)[labels], hand)
        return q_function.values(params, obs, jnp.int32(_TARGET_SLOT))

    return jax.vmap(values)


def make_stablehlo(q_function: QFunction, params: Any, *, batch: str) -> bytes:
    """Return the serialised program.

    Args:
        q_function: the network and its input.
        params: of the network; they become constants of the program.
        batch: a number, or the name of a size that may vary.
    """
    (size,) = (int(batch),) if batch.isdecimal() else export.symbolic_shape(batch)
    args = [jax.ShapeDtypeStruct((size, *shape[1:]), jnp.dtype(dtype)) for dtype, shape in INPUTS.values()]
    return bytes(export.export(jax.jit(policy_function(q_function, params)), platforms=PLATFORMS)(*args).serialize())
