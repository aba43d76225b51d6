"""Checkpoints of the whole training state, and policies that can be loaded without it."""

from pregrasp_jax.checkpoint.chunks import Ring
from pregrasp_jax.checkpoint.policy import TrainedPolicy, load_policy, save_policy
from pregrasp_jax.checkpoint.run_config import read_config, write_config
from pregrasp_jax.checkpoint.state import Restored, restore, save
from pregrasp_jax.checkpoint.trees import checksum

__all__ = [
    "Restored",
    "Ring",
    "TrainedPolicy",
    "checksum",
    "load_policy",
    "read_config",
    "restore",
    "save",
    "save_policy",
    "write_config",
]
