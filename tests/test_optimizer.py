"""Muon against singular values by numpy, and Adam where Muon leaves it."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from pregrasp_jax.config import NetworkConfig, TaskConfig
from pregrasp_jax.learning.q_function import make_q_function
from pregrasp_jax.presets import PRESETS
from pregrasp_jax.spaces.actions import ActionSpace, Choice
from pregrasp_jax.training.learn import make_optimizer

ACTIONS = ActionSpace(tuple(Choice(name=name, z=0.1, yaw=0.0, aperture=0.0) for name in ("closed", "open")), (0, 1))
MUON = dataclasses.replace(PRESETS["cpu"].learner, optimizer="muon", learning_rate=1e-2, learning_rate_steps=0)


def parameters(architecture):
    config = NetworkConfig(architecture=architecture, width=0.125)
    return make_q_function(config, TaskConfig(), ACTIONS).init(jax.random.key(0))


def updates(optimizer, params, grads, count):
    change, state = grads, optimizer.init(params)
    for _ in range(count):
        change, state = optimizer.update(grads, state, params)
    return change


@pytest.fixture(scope="module", params=["compact", "paper"])
def first(request):
    """Parameters, random gradients of them, and the first update by either optimizer."""
    params = parameters(request.param)
    leaves, tree = jax.tree.flatten(params)
    keys = jax.random.split(jax.random.key(1), len(leaves))
    grads = tree.unflatten([jax.random.normal(key, leaf.shape) for key, leaf in zip(keys, leaves, strict=True)])
    muon = updates(make_optimizer(MUON), params, grads, 1)
    return params, grads, muon, updates(optax.nadam(MUON.learning_rate), params, grads, 1)


def named(tree):
    return {jax.tree_util.keystr(path): np.asarray(leaf) for path, leaf in jax.tree.leaves_with_path(tree)}


def is_muons(name, leaf):
    return leaf.ndim == 4 and "readout" not in name


def test_updates_of_kernels_are_nearly_orthogonal_and_point_downhill(first):
    _, grads, muon, _ = first
    grads = named(grads)
    kernels = {name: leaf for name, leaf in named(muon).items() if is_muons(name, leaf)}
    assert len(kernels) >= 10
    for name, leaf in kernels.items():
        matrix = leaf.reshape(-1, leaf.shape[-1])
        left, _, right = np.linalg.svd(-grads[name].reshape(matrix.shape).astype(np.float64), full_matrices=False)
        sizes = np.linalg.svd(matrix, compute_uv=False) / (MUON.learning_rate * 0.2 * np.sqrt(max(matrix.shape)))
        assert sizes.min() > 0.6 and sizes.max() < 1.3, name
        # The nearest orthogonal matrix is the product of the gradient's singular vectors.
        cosine = np.sum(matrix * (left @ right)) / (np.linalg.norm(matrix) * np.linalg.norm(left @ right))
        assert cosine > 0.97, (name, cosine)


def test_biases_and_the_readout_are_adams(first):
    _, _, muon, adam = first
    adam, others = named(adam), {name: leaf for name, leaf in named(muon).items() if not is_muons(name, leaf)}
    assert sum("readout" in name for name in others) == 2 and len(others) > 10
    for name, leaf in others.items():
        np.testing.assert_allclose(leaf, adam[name], rtol=1e-5, err_msg=name)


def test_the_step_size_of_both_parts_follows_the_schedule():
    params = {"stem": {"kernel": jnp.ones((3, 3, 4, 8)), "bias": jnp.ones(8)}}
    config = dataclasses.replace(MUON, learning_rate_steps=None, final_learning_rate=MUON.learning_rate / 10)
    grads = jax.tree.map(lambda leaf: jax.random.normal(jax.random.key(2), leaf.shape), params)
    steady, fallen = (named(updates(make_optimizer(each, 10), params, grads, 30)) for each in (MUON, config))
    for name in steady:
        np.testing.assert_allclose(fallen[name], 0.1 * steady[name], rtol=1e-4, err_msg=name)
