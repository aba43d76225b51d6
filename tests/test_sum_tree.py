import jax
import jax.numpy as jnp
import numpy as np
import pytest

from pregrasp_jax.learning import sum_tree


def oracle_find(leaves: np.ndarray, mass: float) -> int:
    """The leaf whose interval of the float64 cumulative sum holds `mass`."""
    return int(np.searchsorted(np.cumsum(leaves.astype(np.float64)), mass, side="right"))


@pytest.mark.parametrize("capacity", [1, 2, 3, 7, 8, 100, 1000])
def test_find_agrees_with_cumsum(capacity):
    rng = np.random.default_rng(capacity)
    leaves = rng.integers(0, 5, capacity).astype(np.float32)
    leaves[rng.integers(capacity)] = 3.0
    tree = sum_tree.set_leaves(sum_tree.init(capacity), jnp.arange(capacity), jnp.asarray(leaves))
    assert float(tree.total) == leaves.sum()
    np.testing.assert_array_equal(tree.leaves, leaves)
    masses = np.concatenate([np.arange(leaves.sum()), rng.random(64) * leaves.sum()]).astype(np.float32)
    found = jax.jit(jax.vmap(sum_tree.find, in_axes=(None, 0)))(tree, jnp.asarray(masses))
    np.testing.assert_array_equal(found, [oracle_find(leaves, mass) for mass in masses])


def test_build_equals_setting_all_leaves_bit_for_bit():
    leaves = jnp.asarray(np.random.default_rng(0).random(777), jnp.float32)
    one_by_one = sum_tree.init(777)
    for index in np.random.default_rng(1).permutation(777)[:50]:
        one_by_one = sum_tree.set_leaves(one_by_one, jnp.array([index]), leaves[index][None])
    rest = sum_tree.set_leaves(one_by_one, jnp.arange(777), leaves)
    np.testing.assert_array_equal(rest.nodes[1:], sum_tree.build(leaves).nodes[1:])


@pytest.mark.parametrize("order", [[0, 1, 2, 3], [3, 2, 1, 0], [1, 3, 0, 2]])
def test_duplicates_largest_wins_in_any_order_and_old_values_do_not_count(order):
    tree = sum_tree.build(jnp.array([9.0, 9.0, 9.0, 9.0, 9.0]))
    indices, values = jnp.array([1, 1, 3, 1])[jnp.array(order)], jnp.array([2.0, 5.0, 1.0, 4.0])[jnp.array(order)]
    tree = sum_tree.set_leaves(tree, indices, values)
    np.testing.assert_array_equal(tree.leaves, [9, 5, 9, 1, 9])
    assert float(tree.total) == 33.0


def test_out_of_range_indices_are_ignored():
    tree = sum_tree.build(jnp.array([1.0, 2.0, 3.0]))
    after = sum_tree.set_leaves(tree, jnp.array([3, -1, 100, 1]), jnp.array([7.0, 8.0, 9.0, 5.0]))
    np.testing.assert_array_equal(after.leaves, [1, 5, 3])
    assert float(after.total) == 9.0
    np.testing.assert_array_equal(after.nodes[4 + 3 :], [0.0])


def test_parents_do_not_drift():
    """A million-to-one leaf comes and goes; an incremented sum would keep its rounding error."""
    tree = sum_tree.build(jnp.full(5, 1e-3))
    set_leaf = jax.jit(sum_tree.set_leaves)
    for _ in range(20):
        tree = set_leaf(tree, jnp.array([2]), jnp.array([1e6]))
        tree = set_leaf(tree, jnp.array([2]), jnp.array([1e-3]))
    np.testing.assert_array_equal(tree.nodes, sum_tree.build(jnp.full(5, 1e-3)).nodes)


def test_zero_leaves_are_never_found_even_where_rounding_overshoots():
    rng = np.random.default_rng(3)
    leaves = np.where(rng.random(1000) < 0.9, 0.0, rng.random(1000) ** 8).astype(np.float32)
    tree = sum_tree.build(jnp.asarray(leaves))
    masses = jnp.concatenate([jnp.linspace(0, tree.total, 20_000), jnp.array([tree.total, tree.total * 1.001])])
    found = jax.vmap(sum_tree.find, in_axes=(None, 0))(tree, masses)
    assert np.all(leaves[np.asarray(found)] > 0)


def test_sampling_frequencies_and_strata(key):
    leaves = jnp.array([0.0, 1.0, 2.0, 0.0, 4.0, 1.0])
    tree = sum_tree.build(leaves)
    draw = jax.jit(lambda k: sum_tree.sample(tree, k, 8))
    drawn = np.stack([draw(k) for k in jax.random.split(key, 500)])
    # Eight strata of mass 1 over integer leaves: every batch holds leaf k exactly leaves[k] times.
    counts = np.stack([np.bincount(batch, minlength=6) for batch in drawn])
    np.testing.assert_array_equal(counts, np.tile(np.asarray(leaves), (500, 1)))
    single = np.asarray(jax.vmap(lambda k: sum_tree.sample(tree, k, 1)[0])(jax.random.split(key, 8000)))
    np.testing.assert_allclose(np.bincount(single, minlength=6) / 8000, np.asarray(leaves) / 8, atol=0.02)


def test_capacity_must_be_positive():
    with pytest.raises(ValueError, match="sum tree capacity = 0"):
        sum_tree.init(0)
