"""Several processes, one per host, that train as one (`pregrasp-jax train --distributed True`).

All run the same program on the same numbers, each on its own devices. Process 0 alone writes and speaks, and it
decides what depends on a clock, a signal or a disk: these differ between hosts, and a process that turned another way
than the rest would wait for them for ever.
"""

import contextlib
import os
from collections.abc import Iterator

import jax
import numpy as np
from jax.experimental import multihost_utils

NUM_PROCESSES, PROCESS_ID = "JAX_NUM_PROCESSES", "JAX_PROCESS_ID"
"""Environment variables beside jax's own JAX_COORDINATOR_ADDRESS, for hosts without a cluster manager."""

FAREWELL = 60
"""s that a process which ends, or fails, waits for the others to end too; then jax ends them all."""


def join() -> None:
    """Connect this process with the others of the run; nothing may have touched a device before.

    Raises:
        ValueError: nobody says which process this is, of how many, and where process 0 listens.
    """
    try:
        jax.distributed.initialize(
            num_processes=_number(NUM_PROCESSES),
            process_id=_number(PROCESS_ID),
            shutdown_timeout_seconds=FAREWELL,
        )
    except ValueError as error:
        raise ValueError(
            f"--distributed True found no cluster ({str(error).rstrip('.')}); allowed is to start every process by "
            f"SLURM, Open MPI, Kubernetes or on a TPU pod, or to set JAX_COORDINATOR_ADDRESS (HOST:PORT of process 0), "
            f"{NUM_PROCESSES} and {PROCESS_ID}"
        ) from None


def is_first() -> bool:
    """Return whether this process writes and speaks; true of one that is alone."""
    return jax.process_index() == 0


def agreed(value: bool) -> bool:
    """Return what process 0 says; every process must ask."""
    return bool(agreed_number(value))


def agreed_number(value: int) -> int:
    """Return what process 0 says, at most 2^31 - 1; every process must ask."""
    return int(multihost_utils.broadcast_one_to_all(np.int32(min(value, 2**31 - 1))))


@contextlib.contextmanager
def first_goes_first(what: str) -> Iterator[None]:
    """Let process 0 do something before the others do: it may change files that they then read.

    Args:
        what: the same words in every process.
    """
    if not is_first():
        multihost_utils.sync_global_devices(what)
    yield
    if is_first():
        multihost_utils.sync_global_devices(what)


def refuse_difference(digest: str) -> None:
    """Refuse to train with processes that were not told the same.

    Args:
        digest: hash of configuration, objects and scenes; equally long in every process.

    Raises:
        ValueError: another process has another digest; all processes raise.
    """
    digests = multihost_utils.process_allgather(np.frombuffer(digest.encode(), np.uint8))
    odd = np.flatnonzero((digests != digests[:1]).any(axis=1))
    if odd.size:
        raise ValueError(
            f"process {odd[0]} has another configuration, other objects or other scenes than process 0; allowed are "
            "the same options and files on every host"
        )


def _number(name: str) -> int | None:
    """Return an environment variable as a number; None if it is not set.

    Raises:
        ValueError: it is no number.
    """
    text = os.environ.get(name, "")
    if text and not text.isdecimal():
        raise ValueError(f"{name} = {text!r} is no number")
    return int(text) if text else None
