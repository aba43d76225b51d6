"""Policies on disk: network parameters that can be loaded without the run they come from.

best/params.safetensors     complete by itself: parameters, and in its header config, evaluation, checksum
config.yaml            the same for people
evaluation.json
"""

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from pregrasp_jax import io
from pregrasp_jax.checkpoint import trees
from pregrasp_jax.checkpoint.run_config import CONFIG, stored_config, write_config
from pregrasp_jax.checkpoint.state import read_newest_policy
from pregrasp_jax.checkpoint.trees import DamagedFileError
from pregrasp_jax.config import Config
from pregrasp_jax.settings import to_dict

FORMAT = "pregrasp_jax policy 2"
"""What the header of a policy says that it is."""

_FORMAT_1 = "pregrasp_jax policy 1"
"""Of earlier runs; its checksum covers the parameters alone."""

PPG = "ppg"
"""Name of the policy of strokes that ships with the package."""

_PACKAGE = Path(__file__).parent.parent

SHIPPED = {
    "pretrained": _PACKAGE / "pretrained",
    "cpu-1": _PACKAGE / "pretrained_cpu",
    PPG: _PACKAGE / "pretrained_ppg",
}
"""Folders of the policies that ship with the package: those that `config.PUSHING` names, and the one of strokes."""

_PARAMS = "params.safetensors"
BUNDLED = "policy.safetensors"
"""The same file in an exported bundle."""

_ALLOWED = (
    f"pretrained, a run folder or its checkpoints, a folder with the {_PARAMS} that it wrote, or an exported bundle"
)


@dataclass(frozen=True)
class TrainedPolicy:
    """A trained network.

    Attributes:
        params: parameters of the network, nested dicts of device arrays.
        config: of the run that trained it.
        evaluation: what was measured on the validation scenes when it was saved; may be empty.
        origin: the file that it was read from, or the folder of the checkpoint.
    """

    params: Any
    config: Config
    evaluation: dict[str, Any]
    origin: Path


def save_policy(folder: Path, params: Any, config: Config, evaluation: dict[str, Any]) -> None:
    """Write a policy. `params.safetensors` alone is complete; the two other files repeat its header for people."""
    io.write_bytes(folder / _PARAMS, policy_bytes(params, config, evaluation))
    write_config(folder / CONFIG, config)
    io.write_json(folder / "evaluation.json", evaluation)


def policy_bytes(params: Any, config: Config, evaluation: dict[str, Any]) -> bytes:
    """Return a policy as safetensors: its parameters, and in the header everything else."""
    arrays = trees.named_leaves(params)
    about = {"format": FORMAT, "config": json.dumps(to_dict(config)), "evaluation": json.dumps(evaluation)}
    return trees.encode(arrays, about | {"checksum": _checksum(arrays, about)})


def load_policy(path: Path | str) -> TrainedPolicy:
    """Read a policy from a run folder (its best policy, else its latest checkpoint), a policy folder, or a file.

    The folder `checkpoints` of a run stands for its latest checkpoint, whatever was best. The names in `SHIPPED` are
    those of policies that ship with the package.

    Raises:
        ValueError: nothing there, damaged, not finite, or not written by `save_policy`; one line says which.
    """
    path = SHIPPED.get(str(path), Path(path))
    for candidate in (path, path / _PARAMS, path / "best" / _PARAMS, path / BUNDLED):
        if candidate.is_file():
            try:
                return _read_policy(candidate)
            except ValueError as error:
                raise type(error)(f"{error}; allowed: {_ALLOWED}") from None
    for checkpoints in (path / "checkpoints", path):
        if checkpoints.name == "checkpoints" and checkpoints.is_dir() and (checkpoints.parent / CONFIG).is_file():
            return _policy_of_checkpoint(checkpoints, stored_config(checkpoints.parent))
    problem = "is neither a run folder nor a policy folder" if path.is_dir() else "does not exist"
    raise ValueError(f"policy {path} {problem}; allowed: {_ALLOWED}")


def _read_policy(path: Path) -> TrainedPolicy:
    data = path.read_bytes()
    arrays, metadata = trees.decode(data, origin=str(path)), trees.read_metadata(data)
    if not {"format", "config", "evaluation", "checksum"} <= metadata.keys():
        raise ValueError(f"{path} was not written by this package: its header names no config")
    if metadata["format"] not in (FORMAT, _FORMAT_1):
        raise ValueError(f"{path} was written by another version of this package: {metadata['format']}")
    if _checksum(arrays, metadata) != metadata["checksum"]:
        raise DamagedFileError(f"{path} is altered (checksum differs)")
    try:
        config = Config.from_dict(json.loads(metadata["config"])).validate()
        evaluation = json.loads(metadata["evaluation"])
    except ValueError as error:
        raise ValueError(f"{path} was written by another version of this package: {error}") from None
    return _policy(arrays, config, evaluation, path)


def _checksum(arrays: Mapping[str, np.ndarray], metadata: Mapping[str, str]) -> str:
    """Return the checksum of parameters, config and evaluation, by the rule of the format that the header names."""
    params = trees.checksum(arrays)
    if metadata["format"] == _FORMAT_1:
        return params
    return io.content_hash(params, metadata["config"], metadata["evaluation"])


def _policy_of_checkpoint(folder: Path, config: Config) -> TrainedPolicy:
    params, origin = read_newest_policy(folder)
    return _policy(params, config, {}, origin)


def _policy(
    arrays: Mapping[str, np.ndarray], config: Config, evaluation: dict[str, Any], origin: Path
) -> TrainedPolicy:
    for name, array in arrays.items():
        if not np.isfinite(array).all():
            raise ValueError(f"{origin}: {name} has values that are not finite, with which no push can be chosen")
    return TrainedPolicy(trees.nest(arrays), config, evaluation, origin)
