"""The folder of a run: who may write to it, and its files beside the checkpoints.

runs/NAME/: config.yaml, manifest.json, metrics.jsonl, tensorboard/ (if asked for), checkpoints/, best/, dumps/ (if the
physics diverged), run.lock.
"""

import datetime
import fcntl
import json
import os
import platform
from collections.abc import Callable
from pathlib import Path
from typing import Any, TextIO

import jax

from pregrasp_jax import io
from pregrasp_jax.checkpoint.run_config import (
    CONFIG,
    MANIFEST,
    WHAT_MAY_CHANGE,
    fixed_difference,
    read_manifest,
    stored_config,
    write_config,
)
from pregrasp_jax.checkpoint.state import exists
from pregrasp_jax.config import Config, with_absolute_paths
from pregrasp_jax.machine import versions
from pregrasp_jax.messages import command
from pregrasp_jax.settings import difference, to_dict
from pregrasp_jax.training.event_log import EventLog


class RunFolder:
    """A locked run folder; `create` or `open` one, and use it in a `with` block.

    Attributes:
        path: of the folder.
    """

    def __init__(self, path: Path, lock: TextIO | None):
        """Hold the lock; use `create` or `open`."""
        self.path = path
        self._lock = lock
        self._event_log: EventLog | None = None

    @property
    def checkpoints(self) -> Path:
        """Folder of the checkpoints."""
        return self.path / "checkpoints"

    @property
    def has_checkpoint(self) -> bool:
        """Whether the run got as far as its first checkpoint."""
        return exists(self.checkpoints)

    @property
    def dumps(self) -> Path:
        """Folder of the pushes that the physics did not survive (see `dump`)."""
        return self.path / "dumps"

    @property
    def metrics(self) -> Path:
        """File of the rows of metrics."""
        return self.path / "metrics.jsonl"

    @property
    def best(self) -> Path:
        """Folder of the best policy."""
        return self.path / "best"

    @classmethod
    def create(cls, path: Path, config: Config) -> "RunFolder":
        """Begin a run.

        Raises:
            ValueError: the folder holds something, or cannot be written.
        """
        refuse_used(path)
        folder = cls(path, _locked(path))
        write_config(path / CONFIG, config)
        return folder

    @classmethod
    def open(cls, path: Path, config: Config) -> "RunFolder":
        """Continue a run.

        Args:
            path: a folder that `create` made.
            config: its configuration, up to `CHANGEABLE`.

        Raises:
            ValueError: no run, one that has lost its checkpoints, in use by another process, or another configuration
                than it was made with, be it that of `config` or that of an edited config.yaml; the latter two list the
                difference.
        """
        if refused := fixed_difference(with_absolute_paths(stored_config(path)), config):
            raise ValueError(
                f"run {path} cannot be resumed with a changed configuration ({'; '.join(refused)}); {WHAT_MAY_CHANGE}"
            )
        folder = WatchedFolder(path)
        if not folder.has_checkpoint and (folder.best.exists() or folder.metrics.exists()):
            raise ValueError(
                f"run {path} has lost its checkpoints; allowed is a run with one in {folder.checkpoints}; --init-from "
                "starts a new run from its best policy"
            )
        lock = _locked(path)
        io.sweep(path)
        return cls(path, lock)

    def __enter__(self) -> "RunFolder":
        """Keep the lock."""
        return self

    def __exit__(self, *_: object) -> None:
        """Release the lock."""
        if self._lock:
            self._lock.close()

    def begin_session(self, config: Config, hashes: dict[str, str]) -> None:
        """Record configuration, versions, machine and hashes; call it before anything else is written.

        Raises:
            ValueError: the run began with other objects or scenes, in another place or with another sensor, or its
                manifest is damaged.
        """
        manifest = read_manifest(self.path) or {"hashes": hashes, "sessions": []}
        then = manifest["hashes"]
        for name in then | hashes:
            if then.get(name) != hashes.get(name):
                raise ValueError(
                    f"run {self.path} began with another {name} ({then.get(name)}, now {hashes.get(name)}); resume it "
                    "with the same objects, place, sensor, MuJoCo and package version; --init-from starts a new run "
                    "from its parameters"
                )
        if difference(stored_config(self.path), config):
            write_config(self.path / CONFIG, config)
        session = {
            "started": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
            "versions": versions(),
            "machine": describe_machine(),
        }
        record = {"config": to_dict(config), "sessions": [*manifest["sessions"], session]}
        io.write_json(self.path / MANIFEST, manifest | record)

    def begin_event_log(self, *, resumed_at: int | None = None) -> None:
        """Write what is appended to metrics.jsonl to TensorBoard's files too (see `EventLog`)."""
        self._event_log = EventLog(self.path / "tensorboard", resumed_at=resumed_at)

    def attempt(
        self,
        what: str,
        write: Callable[[], object],
        *,
        step: int,
        say: Callable[[str], None],
        consequence: str = "the run goes on",
    ) -> bool:
        """Write something of the run; a full disk is reported, and costs that alone.

        Args:
            what: the name of it.
            write: does it.
            step: of the run.
            say: told what could not be written.
            consequence: of that, for the message.

        Returns:
            Whether it was written.
        """
        try:
            write()
        except OSError as error:
            say(f"warning: no {what} written at step {step} ({error.strerror}: {self.path}); {consequence}")
            return False
        return True

    def append_metrics(self, row: dict[str, Any]) -> None:
        """Append one row to metrics.jsonl, whole or not at all.

        Raises:
            OSError: the disk is full.
        """
        io.append_json_lines(self.metrics, row)
        if self._event_log:
            self._event_log.append(row)

    def forget_metrics_after(self, env_steps: int, *, evaluated_at: int | None) -> None:
        """Drop the rows later than a checkpoint, which will be measured again, and a last line that was cut.

        Args:
            env_steps: of the checkpoint.
            evaluated_at: env steps of the last evaluation that the checkpoint knows of.
        """

        def known(line: str) -> bool:
            step, evaluation = _describe_row(line)
            return step <= env_steps and (not evaluation or step < env_steps or evaluated_at == step)

        if self.metrics.exists():
            kept = [line for line in self.metrics.read_text(errors="replace").splitlines() if known(line)]
            io.write_bytes(self.metrics, "".join(f"{line}\n" for line in kept).encode())


class WatchedFolder(RunFolder):
    """A run folder as the processes see it that do not write: they only read its checkpoints."""

    def __init__(self, path: Path):
        """Lock nothing."""
        super().__init__(path, None)

    def begin_session(self, config: Config, hashes: dict[str, str]) -> None:
        """Record nothing."""

    def begin_event_log(self, *, resumed_at: int | None = None) -> None:
        """Write no events."""

    def attempt(self, what: str, write: Callable[[], object], **about: Any) -> bool:
        """Write nothing, which is all that there is to do."""
        return True

    def append_metrics(self, row: dict[str, Any]) -> None:
        """Append nothing."""

    def forget_metrics_after(self, env_steps: int, *, evaluated_at: int | None) -> None:
        """Drop nothing."""


def refuse_used(path: Path) -> None:
    """Refuse a folder in which no run can begin, before any work is done for it.

    Raises:
        ValueError: it holds a run, or anything else, or cannot be written.
    """
    if path.exists() and not path.is_dir():
        raise ValueError(f"run folder {path} is a file; allowed is a new or empty folder")
    if (path / CONFIG).exists():
        raise ValueError(
            f"run folder {path} already holds a run; continue it with `{command('train', 'resume', path)}`, or "
            "choose another --run-dir"
        )
    if path.exists() and any(entry.name != "run.lock" for entry in path.iterdir()):
        raise ValueError(f"run folder {path} is not empty and holds no run; allowed is a new or empty folder")
    io.refuse_unwritable(path / CONFIG)


def describe_machine() -> dict[str, Any]:
    """Return what a measurement depends on besides versions."""
    return {
        "platform": platform.platform(),
        "processor": platform.machine(),
        "cores": os.cpu_count(),
        "devices": [device.device_kind for device in jax.local_devices()],
    }


def _describe_row(line: str) -> tuple[float, bool]:
    """Return the env steps of a row of metrics, infinite if it is damaged, and whether it is an evaluation."""
    try:
        row = json.loads(line)
        return row["env_steps"], "eval/success_rate" in row
    except (json.JSONDecodeError, KeyError, TypeError):
        return float("inf"), False


def _locked(path: Path) -> TextIO:
    """Return the open lock file of a folder; the lock ends with the process, however that ends."""
    try:
        path.mkdir(parents=True, exist_ok=True)
        file = (path / "run.lock").open("a+")
    except OSError as error:
        raise ValueError(f"run folder {path} cannot be written ({error.strerror})") from None
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        file.seek(0)
        holder = file.read().strip() or "unknown"
        file.close()
        raise ValueError(f"run folder {path} is in use by process {holder}; allowed is one process at a time") from None
    except OSError as error:
        file.close()
        raise ValueError(
            f"run folder {path} cannot be locked ({error.strerror}); allowed is a file system with locks"
        ) from None
    file.truncate(0)
    file.write(f"{os.getpid()}\n")
    file.flush()
    return file
