"""Write a bundle: whole or not at all."""

import dataclasses
import hashlib
import io as bytes_io
import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from pregrasp_jax import io
from pregrasp_jax.checkpoint import TrainedPolicy
from pregrasp_jax.checkpoint.policy import policy_bytes
from pregrasp_jax.deploy import contract as names
from pregrasp_jax.deploy.contract import Contract, FileEntry, format_contract, to_plain
from pregrasp_jax.export.describe import describe, host
from pregrasp_jax.export.golden import make_golden, make_views
from pregrasp_jax.export.onnx_policy import make_onnx
from pregrasp_jax.export.stablehlo import make_stablehlo
from pregrasp_jax.learning.q_function import make_q_function
from pregrasp_jax.robot import get_robot, robot_file
from pregrasp_jax.task import registry
from pregrasp_jax.task.place import place_of

FORMATS = ("safetensors", "onnx", "stablehlo")
"""What a policy can be written as."""


def export_policy(
    policy: TrainedPolicy, folder: Path, *, formats: Sequence[str] = FORMATS, golden: int = 8, force: bool = False
) -> Contract:
    """Write a bundle.

    Args:
        policy: what to export.
        folder: becomes the bundle.
        formats: some of `FORMATS`.
        golden: states with right answers, at least 2.
        force: replace a bundle that is there.

    Returns:
        Its contract.

    Raises:
        ValueError: the folder holds something, or an argument is not allowed; one line says which.
    """
    _refuse(folder, formats, golden, force)
    if policy.config.train.method != "q_learning":
        raise ValueError(
            f"policy {policy.origin} has learnt by {policy.config.train.method}; allowed are policies of Q-learning"
        )
    task = policy.config.task
    robot, workspace = get_robot(task.robot), place_of(task)
    kind = registry.get_kind(task.primitive)
    primitive = kind.make_primitive(robot, workspace, task, max_distance=task.r_out)
    q_function = make_q_function(policy.config.network, task, primitive.actions)
    if not q_function.fits(policy.params):
        raise ValueError(f"policy {policy.origin} does not fit its network in this version of the package")
    contract = describe(policy, robot, workspace, primitive.actions)
    views = make_views(robot, workspace, primitive, count=golden)
    files = {names.GOLDEN: _npz(make_golden(views, q_function, policy.params, primitive))}
    if robot.body is not None:
        files[names.ROBOT] = _npz(robot_file.to_arrays(robot.body))
    if "safetensors" in formats:
        own = policy.origin.suffix == ".safetensors"  # unchanged, where there is such a file
        stored = policy.origin.read_bytes() if own else policy_bytes(policy.params, policy.config, policy.evaluation)
        files[names.SAFETENSORS] = stored
    if "onnx" in formats:
        model = make_onnx(host(policy.params), policy.config, primitive.actions)
        entry = model.metadata_props.add()
        entry.key, entry.value = names.CONTRACT_KEY, json.dumps(to_plain(contract), allow_nan=False)
        files[names.ONNX] = model.SerializeToString()
    if "stablehlo" in formats:
        files[names.STABLEHLO] = make_stablehlo(q_function, policy.params, batch="1")
        files[names.STABLEHLO_BATCH] = make_stablehlo(q_function, policy.params, batch="batch")
    return _write(folder, contract, files)


def _refuse(folder: Path, formats: Sequence[str], golden: int, force: bool) -> None:
    unknown = sorted(set(formats) - set(FORMATS))
    if unknown or not formats:
        raise ValueError(f"formats = {unknown or 'none'} are not known; allowed are some of {', '.join(FORMATS)}")
    if not 2 <= golden <= 1000:
        raise ValueError(f"golden = {golden} is out of range; allowed is 2 to 1000")
    if folder.is_file():
        raise ValueError(f"{folder} is a file; allowed is the name of a folder that does not exist yet")
    if folder.is_dir() and any(folder.iterdir()) and not (force and (folder / names.CONTRACT).is_file()):
        raise ValueError(
            f"{folder} is not empty; allowed is a new folder, or --force True to replace a bundle that is there"
        )
    if folder.resolve() == Path.cwd():
        raise ValueError(f"{folder} is where the program runs, which cannot be replaced; allowed is another folder")
    io.refuse_unwritable(folder)


def _write(folder: Path, contract: Contract, files: dict[str, bytes]) -> Contract:
    """Write all files beside the folder, then put them into its place."""
    entries = {
        name: FileEntry(sha256=hashlib.sha256(data).hexdigest(), bytes=len(data))
        for name, data in sorted(files.items())
    }
    contract = dataclasses.replace(contract, files=entries)
    with io.staged_folder(folder) as staged:
        for name, data in files.items():
            io.write_bytes(staged / name, data)
        io.write_json(staged / names.CONTRACT, to_plain(contract))
        io.write_bytes(staged / names.README, (format_contract(contract) + "\n").encode())
    return contract


def _npz(arrays: dict[str, np.ndarray]) -> bytes:
    file = bytes_io.BytesIO()
    np.savez_compressed(file, **arrays)  # pyright: ignore[reportArgumentType]
    return file.getvalue()
