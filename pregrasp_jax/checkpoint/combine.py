"""Several trained policies as one, whose values are the mean of theirs."""

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from pregrasp_jax import io
from pregrasp_jax.checkpoint.policy import TrainedPolicy, load_policy, save_policy
from pregrasp_jax.learning.members import join, split
from pregrasp_jax.ranges import RANGES
from pregrasp_jax.settings import flatten, to_dict

_FREE = ("network.members", "network.initial_bias")
"""Settings of the network that may differ."""

VALUES_DEPEND_ON = ("learner.discount", "train.try_grasps", "task.in_region_reward", "task.approach_reward")
"""Settings that decide what a value means."""


def combine(policies: Sequence[Path | str], folder: Path, *, first: int = 0, any_values: bool = False) -> TrainedPolicy:
    """Write the policy whose value of a push is the mean of those of several policies, and return it.

    Its configuration is that of the first one.

    Args:
        policies: at least two, or one with `first`, each as `load_policy` reads it. Of a policy that has several
            networks each counts.
        folder: of the new policy; must not exist.
        first: networks of each policy that count, the first ones; 0 takes all.
        any_values: they may have been trained for other rewards and discounts; their mean says something only once it
            has been trained on.

    Raises:
        ValueError: one cannot be read, has learnt by imitation, or is of another network, task or discount than the
            first (but for `any_values`), so that its values mean something else; or there are too many networks.
    """
    if first < 0:
        raise ValueError(f"first = {first} is out of range; allowed is 1 and more, or 0 to take all networks")
    if len(policies) < (1 if first else 2):
        raise ValueError(f"combine needs at least two policies, got {len(policies)}; one is enough with --first")
    if folder.exists():
        raise ValueError(f"{folder} exists already; allowed is a new folder")
    io.refuse_unwritable(folder)
    loaded = [load_policy(path) for path in policies]
    wanted = _meaning(policies[0], loaded[0])
    for path, policy in zip(policies, loaded, strict=True):
        for name, value in _meaning(path, policy).items():
            if value != wanted[name] and not (any_values and name in VALUES_DEPEND_ON):
                learnable = ", or --any-values True and to train on what comes out" if name in VALUES_DEPEND_ON else ""
                raise ValueError(
                    f"{path} has {name} = {value}, but {policies[0]} {wanted[name]}: the mean of their values would "
                    f"mean nothing; allowed are policies of one network, task and discount{learnable}"
                )
    found = [_networks(path, policy) for path, policy in zip(policies, loaded, strict=True)]
    networks = [params for of_policy in found for params in of_policy[: first or None]]
    most = int(RANGES["network.members"][1])
    if len(networks) > most:
        raise ValueError(f"the policies have {len(networks)} networks together; allowed are {most}")
    config = loaded[0].config
    config = dataclasses.replace(config, network=dataclasses.replace(config.network, members=len(networks)))
    save_policy(folder, join(networks), config, {})
    return load_policy(folder)


def _networks(path: Path | str, policy: TrainedPolicy) -> list[Any]:
    """Return the parameters of every network of a policy."""
    try:
        return split(policy.params, policy.config.network.num_members)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None


def _meaning(path: Path | str, policy: TrainedPolicy) -> dict[str, Any]:
    """Return, by name, the settings that decide what a value means, and of what network it is."""
    if policy.config.train.method != "q_learning":
        raise ValueError(f"{path} has learnt by {policy.config.train.method}; allowed are policies of Q-learning")
    network = dataclasses.replace(policy.config.network, path_channels=policy.config.network.num_path_channels)
    settings = flatten(to_dict(dataclasses.replace(policy.config, network=network)))
    return {
        name: value
        for name, value in settings.items()
        if name in VALUES_DEPEND_ON or (name.startswith(("network.", "task.")) and name not in _FREE)
    }
