"""A sum tree under jit: sample leaves in proportion to their values in O(log capacity).

A flat array of twice the padded capacity: node i has children 2i and 2i + 1, the root is node 1, leaf k is node
size + k. Parents are always recomputed as the sum of their children, so that rounding cannot accumulate, and a
subtree whose leaves are all zero has the value zero exactly and is never entered.
"""

import flax.struct as struct
import jax
import jax.numpy as jnp


class SumTree(struct.PyTreeNode):
    """Values of the leaves and the sums above them.

    Attributes:
        nodes: [2 * size] float32, nodes[0] unused, size = capacity rounded up to a power of two.
        capacity: number of leaves.
    """

    nodes: jax.Array
    capacity: int = struct.field(pytree_node=False)

    @property
    def total(self) -> jax.Array:
        """Return the sum () of all leaves."""
        return self.nodes[1]

    @property
    def leaves(self) -> jax.Array:
        """Return the values [capacity] of the leaves."""
        size = self.nodes.shape[0] // 2
        return self.nodes[size : size + self.capacity]


def init(capacity: int) -> SumTree:
    """Return a tree of zeros.

    Raises:
        ValueError: capacity is below 1.
    """
    if capacity < 1:
        raise ValueError(f"sum tree capacity = {capacity} is out of range; allowed is 1 or more")
    return SumTree(jnp.zeros(2 * _padded(capacity), jnp.float32), capacity)


def build(leaves: jax.Array) -> SumTree:
    """Return the tree over `leaves` [capacity]: cheaper than `set_leaves` when many change."""
    capacity = leaves.shape[0]
    level = jnp.pad(leaves.astype(jnp.float32), (0, _padded(capacity) - capacity))
    levels = [level]
    while level.shape[0] > 1:
        level = level[0::2] + level[1::2]
        levels.append(level)
    return SumTree(jnp.concatenate([jnp.zeros(1, jnp.float32), *reversed(levels)]), capacity)


def set_leaves(tree: SumTree, indices: jax.Array, values: jax.Array) -> SumTree:
    """Set leaves and recompute the sums above them.

    Args:
        tree: to change.
        indices: [K] int32; out of [0, capacity) is ignored. Duplicates are allowed: the largest value wins,
            whatever their order.
        values: [K] float32, >= 0.
    """
    assert indices.shape == values.shape and indices.ndim == 1, f"expected [K], got {indices.shape}, {values.shape}"
    size = tree.nodes.shape[0] // 2
    valid = (indices >= 0) & (indices < tree.capacity)
    node = jnp.where(valid, size + indices, 2 * size)
    # Clearing first makes the maximum one over the new values only.
    nodes = tree.nodes.at[node].set(0.0, mode="drop").at[node].max(values, mode="drop")
    for _ in range(size.bit_length() - 1):
        node = jnp.where(valid, node // 2, 2 * size)
        children = jnp.where(valid, 2 * node, 0)
        nodes = nodes.at[node].set(nodes[children] + nodes[children + 1], mode="drop")
    return tree.replace(nodes=nodes)


def find(tree: SumTree, mass: jax.Array) -> jax.Array:
    """Return the leaf () int32 whose interval of the cumulative sum holds `mass` () in [0, total).

    A leaf of value zero is returned only if the whole tree is zero. Unbatched.
    """
    size = tree.nodes.shape[0] // 2
    node = jnp.int32(1)
    for _ in range(size.bit_length() - 1):
        left, right = tree.nodes[2 * node], tree.nodes[2 * node + 1]
        # Rounding may leave a mass that no child holds; it must not lead into an empty subtree.
        go_right = (mass >= left) & (right > 0)
        mass = jnp.where(go_right, mass - left, mass)
        node = 2 * node + go_right.astype(jnp.int32)
    return node - size


def sample(tree: SumTree, key: jax.Array, batch_size: int) -> jax.Array:
    """Draw leaves [batch_size] int32 in proportion to their values, one from each stratum of equal mass.

    Source: Schaul et al. 2016, App. B.2.1 (stratified sampling).
    """
    offsets = (jnp.arange(batch_size, dtype=jnp.float32) + jax.random.uniform(key, (batch_size,))) / batch_size
    return jax.vmap(find, in_axes=(None, 0))(tree, offsets * tree.total)


def _padded(capacity: int) -> int:
    return 1 << (capacity - 1).bit_length()
