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
from pregrasp_jax.robot import get_robot
from pregrasp_jax.task.push import push_actions
from pregrasp_jax.training.learn import make_optimizer

MUON = dataclasses.replace(PRESETS["cpu"].learner, optimizer="muon", learning_rate=1e-2, learning_rate_steps=0)
SHAPES = {
    "stem": {"kernel": (3, 3, 4, 8), "bias": (8,)},
    "deep": {"conv": {"kernel": (1, 1, 8, 6), "bias": (6,)}},
    "readout": {"kernel": (1, 1, 6, 2), "bias": (2,)},
}


def draw(seed):
    rng = np.random.default_rng(seed)

    def normal(shape):
        return jnp.asarray(rng.normal(size=shape), jnp.float32)

    return jax.tree.map(normal, SHAPES, is_leaf=lambda node: isinstance(node, tuple))


def updates(config, count, steps=10):
    """Return the last of so many updates of the same gradients."""
    optimizer, params, grads = make_optimizer(config, steps), draw(0), draw(1)

    @jax.jit
    def update(state):
        return optimizer.update(grads, state, params)

    change, state = grads, optimizer.init(params)
    for _ in range(count):
        change, state = update(state)
    return named(jax.device_get(change))


def named(tree):
    return {jax.tree_util.keystr(path): leaf for path, leaf in jax.tree.leaves_with_path(tree)}


@pytest.fixture(scope="module")
def first():
    return updates(MUON, 1)


@pytest.mark.parametrize("name", ["['stem']['kernel']", "['deep']['conv']['kernel']"])
def test_the_update_of_a_kernel_is_nearly_orthogonal_and_points_downhill(first, name):
    matrix = first[name].reshape(-1, first[name].shape[-1])
    left, _, right = np.linalg.svd(-named(jax.device_get(draw(1)))[name].reshape(matrix.shape), full_matrices=False)
    sizes = np.linalg.svd(matrix, compute_uv=False) / (MUON.learning_rate * 0.2 * np.sqrt(max(matrix.shape)))
    assert sizes.min() > 0.6 and sizes.max() < 1.3
    # The nearest orthogonal matrix is the product of the gradient's singular vectors.
    cosine = np.sum(matrix * (left @ right)) / (np.linalg.norm(matrix) * np.linalg.norm(left @ right))
    assert cosine > 0.97


def test_biases_and_the_readout_are_adams(first):
    adam = optax.nadam(MUON.learning_rate)
    adams = named(adam.update(draw(1), adam.init(draw(0)))[0])
    others = [name for name in first if "bias" in name or "readout" in name]
    assert len(others) == 4
    for name in others:
        np.testing.assert_allclose(first[name], adams[name], rtol=1e-5, err_msg=name)


@pytest.mark.parametrize(("architecture", "path"), [("compact", 16), ("paper", None)])
def test_muon_takes_every_kernel_before_the_readouts(architecture, path):
    network = NetworkConfig(architecture=architecture, path_channels=path)
    q = make_q_function(network, TaskConfig(), push_actions(get_robot("ur5e_rg2")))
    params = jax.eval_shape(q.init, jax.random.key(0))
    held = jax.eval_shape(make_optimizer(MUON).init, params).inner_states["muon"]
    mine = {name for name in named(params) if "kernel" in name and "readout" not in name}
    momenta = {name.partition(".mu")[2] for name in named(held) if ".mu[" in name}
    assert len(mine) >= 10 and momenta == mine


def test_the_step_size_of_both_parts_follows_the_schedule():
    falling = dataclasses.replace(MUON, learning_rate_steps=None, final_learning_rate=MUON.learning_rate / 10)
    steady, fallen = updates(MUON, 30), updates(falling, 30)
    for name in steady:
        np.testing.assert_allclose(fallen[name], 0.1 * steady[name], rtol=1e-4, err_msg=name)
