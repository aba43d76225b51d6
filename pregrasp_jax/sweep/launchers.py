"""Launchers start workers: what a driver needs of them, and the one that shares out this machine."""

import os
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple, Protocol

from pregrasp_jax.machine import free_memory
from pregrasp_jax.sweep.folder import SweepFolder
from pregrasp_jax.sweep.spec import Spec
from pregrasp_jax.sweep.state import Job


class Launcher(Protocol):
    """Starts workers somewhere."""

    slots: int
    """Workers at a time."""

    def submit(self, job: Job) -> None:
        """Start a worker; only if fewer than `slots` are under way."""
        ...

    def ended(self) -> list[tuple[str, int]]:
        """Return (trial id, exit code) of the workers that have ended since this was last asked."""
        ...

    def stop(self) -> None:
        """Ask all workers to stop."""
        ...

    def close(self) -> None:
        """Give back what was taken for the sweep."""
        ...


class Slot(NamedTuple):
    """The share of a machine that one trial gets.

    Attributes:
        cores: ids of cores.
        gpus: ids of GPUs.
    """

    cores: tuple[int, ...]
    gpus: tuple[str, ...]


@dataclass
class _Running:
    job: Job
    slot: Slot
    process: subprocess.Popen[bytes]


class LocalLauncher:
    """Workers on this machine, each on cores of its own."""

    def __init__(self, folder: SweepFolder, spec: Spec, *, parallel: int | None = None, memory: float = 0.0):
        """Share out this machine.

        Args:
            folder: of the sweep.
            spec: of the sweep.
            parallel: trials at a time; as many as fit if None.
            memory: bytes of one trial.

        Raises:
            ValueError: not even one trial fits, or fewer than `parallel`.
        """
        self._folder = folder
        self._free = share_out(spec, parallel=parallel, memory=memory)
        self._running: list[_Running] = []
        self.slots = len(self._free)

    def submit(self, job: Job) -> None:
        """Start a worker on a free slot."""
        slot = self._free.pop(0)
        command = worker_command(self._folder, job, cores=slot.cores)
        environment = os.environ | ({"CUDA_VISIBLE_DEVICES": ",".join(slot.gpus)} if slot.gpus else {})
        process = subprocess.Popen(command, stdin=subprocess.DEVNULL, env=environment, start_new_session=True)
        self._running.append(_Running(job, slot, process))

    def ended(self) -> list[tuple[str, int]]:
        """Return what has ended, and take its slots back."""
        over = [running for running in self._running if running.process.poll() is not None]
        self._running = [running for running in self._running if running not in over]
        self._free += [running.slot for running in over]
        return [(running.job.trial.id, running.process.wait()) for running in over]

    def stop(self) -> None:
        """Send SIGTERM to all workers."""
        for running in self._running:
            running.process.terminate()

    def close(self) -> None:
        """Have nothing to give back."""


def worker_command(folder: SweepFolder, job: Job, *, cores: Sequence[int] = ()) -> list[str]:
    """Return the command line of the worker of a job."""
    options = ["--task", str(job.trial.number)]
    options += ["--rung", str(job.rung)] if job.rung is not None else []
    options += ["--cores", *map(str, cores)] if cores else []
    return [sys.executable, "-m", "pregrasp_jax", "sweep", "worker", str(folder.path), *options]


def share_out(spec: Spec, *, parallel: int | None, memory: float) -> list[Slot]:
    """Return what each of the trials at a time gets of this machine; see `LocalLauncher`."""
    cores, gpus, free = _cores(), _gpus(), free_memory()
    wanted = spec.resources
    room = {
        f"{len(cores)} cores of which a trial takes {wanted.cores}": len(cores) // wanted.cores,
    }
    if free is not None and memory:
        room[f"{free / 1e9:.1f} GB of free memory of which a trial takes {memory / 1e9:.1f}"] = int(free / memory)
    if wanted.gpu:
        room[f"{len(gpus)} GPUs of which a trial takes {wanted.gpu:g}"] = (
            len(gpus) * int(1 / wanted.gpu + 1e-9) if wanted.gpu < 1 else len(gpus) // int(wanted.gpu)
        )
    reason = min(room, key=lambda name: room[name])
    if room[reason] < (parallel or 1):
        raise ValueError(
            f"{parallel or 1} trials at a time do not fit: there are {reason}; allowed is --parallel of at most "
            f"{room[reason]}, or smaller resources"
        )
    count = parallel or room[reason]
    return [
        Slot(tuple(cores[i * wanted.cores : (i + 1) * wanted.cores]), _gpus_of(i, gpus, wanted.gpu))
        for i in range(count)
    ]


def _gpus_of(index: int, gpus: Sequence[str], share: float) -> tuple[str, ...]:
    """Return the GPUs of a trial: its own ones, or the one that it shares; neighbours share different ones."""
    if not share:
        return ()
    if share >= 1:
        return tuple(gpus[index * int(share) : (index + 1) * int(share)])
    return (gpus[index % len(gpus)],)


def _cores() -> list[int]:
    if hasattr(os, "sched_getaffinity"):
        return sorted(os.sched_getaffinity(0))
    return list(range(os.cpu_count() or 1))


def _gpus() -> list[str]:
    """Return the ids of the NVIDIA GPUs that this process may use."""
    if (chosen := os.environ.get("CUDA_VISIBLE_DEVICES")) is not None:
        return [name for name in chosen.split(",") if name]
    try:
        listed = subprocess.run(["nvidia-smi", "--list-gpus"], capture_output=True, text=True, timeout=20, check=True)
    except (OSError, subprocess.SubprocessError):
        return []
    return [str(i) for i in range(len(listed.stdout.splitlines()))]
