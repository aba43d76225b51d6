"""A bundle of a small random policy, made once per worker, and what decides by it; tests copy what they alter."""

import functools
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from drawn_params import drawn_params

from pregrasp_jax.checkpoint import TrainedPolicy, load_policy, save_policy
from pregrasp_jax.config import Config, NetworkConfig, TaskConfig
from pregrasp_jax.deploy.build import make_decider
from pregrasp_jax.deploy.bundle import Bundle, read_bundle
from pregrasp_jax.deploy.camera import PinholeCamera
from pregrasp_jax.deploy.cell import Cell
from pregrasp_jax.deploy.decision import Decider, Push
from pregrasp_jax.deploy.golden import golden_view
from pregrasp_jax.deploy.view import View
from pregrasp_jax.export.bundle import export_policy
from pregrasp_jax.learning.q_function import QFunction, make_q_function
from pregrasp_jax.robot import get_robot, robot_file
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


class Small:
    """What is in the small bundle, read when it is first asked for: tests are collected without making it."""

    @functools.cached_property
    def bundle(self) -> Bundle:
        return read_bundle(small_bundle())

    @functools.cached_property
    def golden(self) -> dict[str, np.ndarray]:
        return self.bundle.arrays("golden.npz")

    @functools.cached_property
    def view(self) -> View:
        return golden_view(self.golden)

    @property
    def camera(self) -> PinholeCamera:
        return self.view.camera

    @functools.cached_property
    def body(self) -> robot_file.Body:
        return robot_file.from_arrays(self.bundle.arrays("robot.npz"))


SMALL = Small()


@functools.cache
def small_decider() -> Decider:
    """Return what decides by the small bundle in a plain cell."""
    return make_decider(SMALL.bundle, Cell())


def push_to(decider: Decider, row: int = 50, col: int = 4) -> Push:
    """Return the push of the second choice from the start to a cell of the map."""
    joints = np.array(decider.contract.robot.home)
    push, obstruction = decider.plan((row * 100 + col) * 2 + 1, 1.0, decider.start(), joints)
    assert not obstruction
    return push
