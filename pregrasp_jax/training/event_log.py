"""TensorBoard's event files, for those who installed the extra; metrics.jsonl has the same numbers and more."""

import importlib
import importlib.util
import os
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

MODULE = "tensorboardX"
"""What the extra `tensorboard` installs."""


def require_module() -> None:
    """Refuse a run that wants event files but cannot have them.

    Raises:
        ValueError: the extra is not installed.
    """
    if importlib.util.find_spec(MODULE) is None:
        raise ValueError(
            f'train.tensorboard = True needs {MODULE}; install it with `pip install "pregrasp_jax[tensorboard]"`, or '
            "leave it False: metrics.jsonl has every number"
        )


class EventLog:
    """One event file per session, written at once: the library's own writer has a thread that hangs on a full disk."""

    def __init__(self, folder: Path, *, resumed_at: int | None = None):
        """Begin a file.

        Args:
            folder: is made if it does not exist.
            resumed_at: env steps of the checkpoint from which a run goes on; what earlier files say of later steps is
                void. None for a new run.
        """
        from tensorboardX import event_file_writer

        self._messages: Any = importlib.import_module("tensorboardX.proto.event_pb2")  # no checker sees into it
        folder.mkdir(parents=True, exist_ok=True)
        self._writer = event_file_writer.EventsWriter(str(folder / "events"), f".{os.getpid()}.{resumed_at or 0}")
        if resumed_at is not None:
            session = self._messages.SessionLog
            start = self._messages.Event(session_log=session(status=session.START), step=resumed_at + 1)
            self._writer.write_event(start)

    def append(self, row: Mapping[str, Any]) -> None:
        """Write the numbers of one row of metrics at its env steps."""
        event = self._messages.Event(wall_time=time.time(), step=row["env_steps"])
        for name, value in row.items():
            if isinstance(value, int | float) and name != "env_steps":
                event.summary.value.add(tag=name, simple_value=value)
        self._writer.write_event(event)
        self._writer.flush()
