"""The policy that ships with the package: complete, small, and of this version's network."""

import json

import jax
import jax.numpy as jnp
import numpy as np

from pregrasp_jax.assets.catalogue import builtin_bank
from pregrasp_jax.checkpoint import load_policy
from pregrasp_jax.checkpoint.policy import PRETRAINED
from pregrasp_jax.config import Config
from pregrasp_jax.learning.q_function import make_q_function
from pregrasp_jax.robot import get_robot
from pregrasp_jax.task.push import push_actions
from pregrasp_jax.types import Observation


def test_it_is_small_and_fits_its_network():
    assert sum(file.stat().st_size for file in PRETRAINED.iterdir()) <= 3_000_000
    policy = load_policy("pretrained")
    robot = get_robot(policy.config.task.robot)
    q = make_q_function(policy.config.network, policy.config.task, push_actions(robot))
    assert q.fits(policy.params)
    blank = jnp.zeros((100, 100), jnp.uint8)
    values = jax.jit(q.values)(
        policy.params, Observation(blank, blank, jax.tree.map(jnp.asarray, robot.start)), jnp.int32(0)
    )
    assert np.isfinite(values).all() and 0.05 < np.ptp(np.asarray(values)) < 4, "trained, and within 0 to 4 or so"


def test_its_evaluation_is_of_these_objects():
    document = json.loads((PRETRAINED / "test_scenes.json").read_text())
    assert document["hull_bank_hash"] == builtin_bank("seen").content_hash
    assert document["episodes"] == 200 and document["object_set"] == "seen"
    assert document["success_rate"] == np.mean([row["success"] for row in document["rows"]])
    assert document["policy"] == "pretrained" and len(document["rows"]) == 200
    trained, evaluated = load_policy("pretrained").config, Config.from_dict(document["config"])
    assert evaluated.network == trained.network and evaluated.task == trained.task
