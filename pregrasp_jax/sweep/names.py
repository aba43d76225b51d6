"""Names that only the registries know: checked by a dry run, since they bring JAX and MuJoCo with them."""

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from pregrasp_jax.checkpoint import load_policy
from pregrasp_jax.config import PUSHING, NetworkConfig
from pregrasp_jax.evaluation.player import refuse_unknown_policy
from pregrasp_jax.messages import lookup
from pregrasp_jax.robot import ROBOTS
from pregrasp_jax.spaces.workspace import WORKSPACES
from pregrasp_jax.sweep.checks import settings_to_check
from pregrasp_jax.sweep.spec import Spec
from pregrasp_jax.sweep.trials import trial_config
from pregrasp_jax.task.registry import KINDS

_TABLES: Mapping[str, Mapping[str, Any]] = {
    "task.robot": ROBOTS, "task.primitive": KINDS, "task.workspace": WORKSPACES
}  # fmt: skip


def check_names(spec: Spec, *, here: Path = Path()) -> None:
    """Refuse robots, places, tasks and policies that this version does not have, and parameters of other networks.

    Args:
        spec: of the sweep.
        here: folder that relative paths refer to.

    Raises:
        ValueError: one line names the first.
    """
    for key, name in _given(spec):
        lookup(_TABLES[key], name, key=key)
    for label, variant in spec.variants.items():
        if variant.policy is not None:
            refuse_unknown_policy(variant.policy, key=f"variants.{label}.policy")
    for varied, about in settings_to_check(spec):
        if (start := about.get("init_from")) is not None:
            network = trial_config(spec, {**spec.set, **varied}).network
            begun = load_policy(start if start in PUSHING else here / start).config.network
            for key, found, wanted in _differences(begun, network):
                raise ValueError(
                    f"variants.{about['name']}.init_from = {start!r} has network.{key} = {found}, but is to go on "
                    f"with {wanted}; allowed is one value"
                )


def _differences(begun: NetworkConfig, network: NetworkConfig) -> Iterator[tuple[str, Any, Any]]:
    """Yield by which settings, and how, the network that a training begins with is not the one that it asks for."""
    for key in ("architecture", "width"):
        if (found := getattr(begun, key)) != (wanted := getattr(network, key)):
            yield key, found, wanted
    if network.members not in (None, begun.num_members):
        yield "members", begun.num_members, network.members
    if begun.num_path_channels and network.path_channels not in (None, begun.num_path_channels):
        yield "path_channels", begun.num_path_channels, network.path_channels


def _given(spec: Spec) -> Iterator[tuple[str, str]]:
    for settings in [spec.set, *(varied for varied, _ in settings_to_check(spec)), *spec.tests.values()]:
        for key in _TABLES:
            if settings.get(key) is not None:
                yield key, settings[key]
