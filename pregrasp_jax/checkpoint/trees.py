"""Pytrees of arrays as named, checksummed safetensors bytes; never pickled.

A leaf is named by its path ("learner/params/conv/kernel"), so a file can be read by tools that do not know
the tree, and a tree that has changed shape is refused by name.
"""

import json
from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import safetensors
import safetensors.numpy

from pregrasp_jax import io


class DamagedFileError(ValueError):
    """A file is cut short, altered or missing; an older copy may still be whole."""


def leaf_names(tree: Any) -> list[str]:
    """Return the paths of the leaves of a pytree, in the order of `jax.tree.leaves`."""
    return [_name(path) for path, _ in jax.tree_util.tree_flatten_with_path(tree)[0]]


def named_leaves(tree: Any) -> dict[str, np.ndarray]:
    """Return the leaves of a pytree on the host, by path; PRNG keys as their uint32 data."""
    return {name: _to_host(leaf) for name, leaf in zip(leaf_names(tree), jax.tree.leaves(tree), strict=True)}


def rebuild(template: Any, arrays: Mapping[str, np.ndarray], *, origin: str) -> Any:
    """Return a tree with the structure of `template` and fresh device copies of `arrays`; inverse of `named_leaves`.

    Args:
        template: pytree of arrays or `jax.ShapeDtypeStruct`; only structure, shapes and dtypes matter.
        arrays: by path.
        origin: where the arrays came from, for the error.

    Raises:
        ValueError: a leaf is missing, left over, or of another shape or dtype.
    """
    leaves, structure = jax.tree.flatten(template)
    expected = dict(zip(leaf_names(template), leaves, strict=True))
    if odd := sorted(expected.keys() ^ arrays.keys()):
        problem = "is missing" if odd[0] in expected else "is not part of this configuration"
        raise ValueError(f"{origin}: {odd[0]} {problem}")
    return structure.unflatten([_to_device(arrays[name], leaf, f"{origin}: {name}") for name, leaf in expected.items()])


def nest(arrays: Mapping[str, np.ndarray]) -> dict[str, Any]:
    """Return nested dicts of device arrays from names such as "params/conv/kernel"."""
    nested: dict[str, Any] = {}
    for name, array in arrays.items():
        *parents, last = name.split("/")
        node = nested
        for parent in parents:
            node = node.setdefault(parent, {})
        node[last] = jnp.array(array)
    return nested


def checksum(tree: Any) -> str:
    """Return 16 hex digits that two trees share exactly if all leaves are bit-identical."""
    leaves = named_leaves(tree)
    return io.content_hash(*(part for name in sorted(leaves) for part in (name, leaves[name])))


def encode(arrays: Mapping[str, np.ndarray], metadata: dict[str, str] | None = None) -> bytes:
    """Return arrays and text as safetensors."""
    return safetensors.numpy.save(dict(arrays), metadata)


def decode(data: bytes, *, origin: str) -> dict[str, np.ndarray]:
    """Return the arrays of safetensors bytes.

    Raises:
        DamagedFileError: the bytes are not whole, or of a type that numpy lacks; `origin` names them.
    """
    try:
        return safetensors.numpy.load(data)
    except safetensors.SafetensorError as error:
        raise DamagedFileError(f"{origin} is damaged or not safetensors ({error})") from None
    except KeyError as error:  # a type that numpy lacks, such as BF16
        raise DamagedFileError(f"{origin} is damaged or not of this package (its arrays are {error.args[0]})") from None


def read_metadata(data: bytes) -> dict[str, str]:
    """Return the text that `encode` put beside the arrays; `data` has passed `decode`.

    A safetensors file starts with the length of its JSON header, 8 bytes little-endian.
    """
    length = int.from_bytes(data[:8], "little")
    return json.loads(data[8 : 8 + length]).get("__metadata__") or {}


def _name(path: tuple[Any, ...]) -> str:
    return jax.tree_util.keystr(path, simple=True, separator="/")


def _is_key(leaf: Any) -> bool:
    return jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key)


def _to_host(leaf: Any) -> np.ndarray:
    # order="C" makes the copy contiguous, which safetensors assumes without checking.
    return np.array(jax.random.key_data(leaf) if _is_key(leaf) else leaf, order="C")


def _to_device(array: np.ndarray, like: Any, origin: str) -> jax.Array:
    expected = jax.eval_shape(jax.random.key_data, like) if _is_key(like) else like
    if array.shape != expected.shape or array.dtype != expected.dtype:
        raise ValueError(
            f"{origin} is {array.dtype}{list(array.shape)}, this configuration needs "
            f"{expected.dtype}{list(expected.shape)}"
        )
    # jnp.array copies: an alias of host memory must not be donated to a jitted function.
    data = jnp.array(array)
    return jax.random.wrap_key_data(data) if _is_key(like) else data
