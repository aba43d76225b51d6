"""A bundle of a small random policy, made once per worker; tests copy what they alter."""

import functools
import tempfile
from pathlib import Path
from typing import Any

from drawn_params import drawn_params

from pregrasp_jax.checkpoint import TrainedPolicy, load_policy, save_policy
from pregrasp_jax.config import Config, NetworkConfig, TaskConfig
from pregrasp_jax.export.bundle import export_policy
from pregrasp_jax.learning.q_function import QFunction, make_q_function
from pregrasp_jax.robot import get_robot
from pregrasp_jax.task.push import push_actions

ACTIONS = push_actions(get_robot("ur5e_rg2"))


def random_params(q_function: QFunction, seed: int = 0) -> Any:
    """Return parameters that are random in every layer: the best push of fresh ones is noise."""
    return drawn_params(q_function.init, seed=seed)


def random_policy(folder: Path, config: Config, seed: int = 0) -> TrainedPolicy:
    """Return a policy of random parameters that lies in a folder."""
    q_function = make_q_function(config.network, config.task, ACTIONS)
    save_policy(folder, random_params(q_function, seed), config, {"success_rate": 0.5})
    return load_policy(folder)


@functools.cache
def small_bundle() -> Path:
    """Return the folder of a bundle; do not write to it."""
    folder = Path(tempfile.mkdtemp(prefix="pregrasp-bundle-"))
    network = NetworkConfig(architecture="compact", width=1 / 32, mirror=True)
    policy = random_policy(folder / "policy", Config(network=network, task=TaskConfig()))
    export_policy(policy, folder / "bundle", golden=2)
    return folder / "bundle"
