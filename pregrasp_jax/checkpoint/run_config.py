"""The configuration of a run: config.yaml, which people read and may extend, and manifest.json, which records it.

The record says what the run was made with. Where config.yaml says something else, somebody has edited it: what may
change when a run is resumed is taken from there, anything else is refused.
"""

import json
from pathlib import Path
from typing import Any

from pregrasp_jax import io, yaml_file
from pregrasp_jax.config import Config
from pregrasp_jax.settings import difference, to_dict

CHANGEABLE = (
    "train.minutes",
    "train.episodes",
    "train.env_steps",
    "train.tensorboard",
    "assets.object_dir",
    "physics.threads",
)
"""Settings that may change when a run is resumed: when it stops, what it tells, where its meshes lie, which must be the
same ones, and how many cores its physics takes, on which no result depends."""

WHAT_MAY_CHANGE = f"allowed to change: {', '.join(CHANGEABLE)}; --init-from starts a new run from its parameters"
"""What a refusal says at its end."""

CONFIG, MANIFEST = "config.yaml", "manifest.json"


def write_config(path: Path, config: Config) -> None:
    """Write a config.yaml."""
    io.write_bytes(path, yaml_file.dump(to_dict(config)))


def read_config(path: Path) -> Config:
    """Read a config.yaml.

    Raises:
        ValueError: not YAML, an unknown key, or a value of the wrong type or out of range.
    """
    values = yaml_file.read(path)
    try:
        return Config.from_dict(values).validate()
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None


def stored_config(run: Path) -> Config:
    """Return the configuration of the run in a folder.

    Raises:
        ValueError: the folder holds no run, or its config.yaml is damaged, or edited where it may not change.
    """
    file = run / CONFIG
    if not file.is_file():
        raise ValueError(f"{run} is not a run folder (it has no {CONFIG}); allowed is the --run-dir of an earlier run")
    config, recorded = read_config(file), recorded_config(run)
    if recorded and (refused := fixed_difference(recorded, config)):
        raise ValueError(
            f"{file} is not what the run was made with ({'; '.join(refused)}), so put the first of the two values "
            f"back; {WHAT_MAY_CHANGE}"
        )
    return config


def recorded_config(run: Path) -> Config | None:
    """Return the configuration of the last session of a run, None of a run of an earlier version that has no record.

    Raises:
        ValueError: the record is damaged, or of another version.
    """
    record = read_manifest(run).get("config")
    try:
        return None if record is None else Config.from_dict(record).validate()
    except ValueError as error:
        raise ValueError(f"{run / MANIFEST}: {error}") from None


def fixed_difference(old: Config, new: Config) -> list[str]:
    """Return one line ``key: old -> new`` for every setting that differs and must not."""
    return [line for line in difference(old, new) if line.split(":")[0] not in CHANGEABLE]


def read_manifest(run: Path) -> dict[str, Any]:
    """Return hashes, sessions and, unless the run is of an earlier version, the configuration; empty if not begun.

    Raises:
        ValueError: it is damaged.
    """
    file = run / MANIFEST
    if not file.exists():
        return {}
    try:
        manifest = json.loads(file.read_bytes())
        checked = {"hashes": dict(manifest["hashes"]), "sessions": list(manifest["sessions"])}
        return checked | ({"config": dict(manifest["config"])} if "config" in manifest else {})
    except (ValueError, KeyError, TypeError):
        raise ValueError(
            f"{file} is damaged; it says with which objects, scenes and settings the run began. Put a copy back, or "
            f"delete it to go on with those that {CONFIG} names"
        ) from None
