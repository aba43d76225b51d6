"""The policies that ship with the package: complete, small, and of this version's networks."""

import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from pregrasp_jax.assets.catalogue import builtin_bank
from pregrasp_jax.checkpoint import load_policy
from pregrasp_jax.checkpoint.policy import SHIPPED
from pregrasp_jax.config import Config
from pregrasp_jax.learning.imitation import StrokeFunction
from pregrasp_jax.learning.q_function import make_q_function
from pregrasp_jax.robot import get_robot
from pregrasp_jax.task.push import push_actions
from pregrasp_jax.task.push_grasp import stroke_actions
from pregrasp_jax.types import Observation


@pytest.mark.parametrize("name", SHIPPED)
def test_it_is_small(name):
    assert sum(file.stat().st_size for file in SHIPPED[name].iterdir()) <= 3_000_000


@pytest.mark.parametrize("name", ["pretrained", "cpu-1"])
def test_it_fits_its_network(name):
    policy = load_policy(name)
    robot = get_robot(policy.config.task.robot)
    q = make_q_function(policy.config.network, policy.config.task, push_actions(robot))
    assert q.fits(policy.params)
    blank = jnp.zeros((100, 100), jnp.uint8)
    values = jax.jit(q.values)(
        policy.params, Observation(blank, blank, jax.tree.map(jnp.asarray, robot.start)), jnp.int32(0)
    )
    assert np.isfinite(values).all() and 0.05 < np.ptp(np.asarray(values)) < 4, "trained, and within 0 to 4 or so"


@pytest.mark.parametrize("name", ["pretrained", "cpu-1"])
def test_its_evaluation_is_of_these_objects(name):
    document = json.loads((SHIPPED[name] / "test_scenes.json").read_text())
    assert document["hull_bank_hash"] == builtin_bank("seen").content_hash
    assert document["episodes"] == 200 and document["object_set"] == "seen"
    assert document["success_rate"] == np.mean([row["success"] for row in document["rows"]])
    assert document["policy"] == name and len(document["rows"]) == 200
    trained, evaluated = load_policy(name).config, Config.from_dict(document["config"])
    assert evaluated.network == trained.network and evaluated.task == trained.task


def test_ppg_begins_beside_what_stands_there_and_not_on_it():
    policy = load_policy("ppg")
    function = StrokeFunction(policy.config.strokes, stroke_actions())
    assert function.fits(policy.params) and policy.config.strokes.collection is None
    height = np.zeros((100, 100), np.float32)
    height[42:58, 42:58] = 0.15
    values = np.asarray(jax.jit(function.values)(policy.params, jnp.asarray(height)))
    rows, cols, _ = np.unravel_index(np.argsort(values.ravel())[-20:], values.shape)
    distance = 0.005 * np.maximum(np.abs(rows - 49.5) - 7.5, np.abs(cols - 49.5) - 7.5)
    assert np.isfinite(values).all() and (distance > 0.04).all() and (distance < 0.2).all(), "m from a box of 8 cm"
