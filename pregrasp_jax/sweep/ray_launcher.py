"""Ray: workers as tasks of a cluster, which places them; everything else is as on one machine (extra `ray`)."""

import importlib.util
import logging
import os
import subprocess
from typing import Any

from pregrasp_jax.sweep.estimate import memory_of
from pregrasp_jax.sweep.folder import SweepFolder
from pregrasp_jax.sweep.launchers import worker_command
from pregrasp_jax.sweep.spec import Spec
from pregrasp_jax.sweep.state import Job

LOST = -1
"""Exit code of a worker whose node is gone."""


def require_ray() -> None:
    """Refuse a cluster without the package.

    Raises:
        ValueError: it is not installed.
    """
    if importlib.util.find_spec("ray") is None:
        raise ValueError("--launcher ray needs ray, which is not installed; allowed is pip install 'pregrasp_jax[ray]'")


class RayLauncher:
    """Workers on a Ray cluster: that of RAY_ADDRESS, or a new one on this machine."""

    def __init__(self, folder: SweepFolder, spec: Spec, *, parallel: int | None = None, **init: Any):
        """Connect.

        Args:
            folder: of the sweep, on a file system that all nodes see.
            spec: of the sweep.
            parallel: trials at a time; as many as fit if None.
            init: further arguments of `ray.init`.

        Raises:
            ValueError: ray is not installed, or not even one trial fits.
        """
        require_ray()
        import ray  # pyright: ignore[reportMissingImports]

        self._ray, self._folder = ray, folder
        self._own = not ray.is_initialized()
        if self._own:
            os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
            ray.init(include_dashboard=False, log_to_driver=False, logging_level=logging.WARNING, **init)
        wanted, there = spec.resources, ray.cluster_resources()
        needs = {"CPU": float(wanted.cores), "GPU": wanted.gpu, "memory": memory_of(spec)}
        room = min(int(there.get(name, 0.0) / need + 1e-9) for name, need in needs.items() if need)
        if room < (parallel or 1):
            offer = {name: there.get(name, 0.0) for name, need in needs.items() if need}
            raise ValueError(
                f"{parallel or 1} trials at a time do not fit into this cluster ({offer}; a trial takes {needs}); "
                f"allowed is --parallel of at most {room}, or smaller resources"
            )
        self.slots = parallel or room
        # A worker that is lost is started again by the driver, which knows what it has done.
        options = {"num_cpus": wanted.cores, "num_gpus": wanted.gpu, "memory": needs["memory"], "max_retries": 0}
        self._start = ray.remote(**options)(_run)
        self._running: dict[Any, str] = {}

    def submit(self, job: Job) -> None:
        """Hand a worker to the cluster."""
        self._running[self._start.remote(worker_command(self._folder, job))] = job.trial.id

    def ended(self) -> list[tuple[str, int]]:
        """Return what has ended."""
        if not self._running:
            return []
        over, _ = self._ray.wait(list(self._running), num_returns=len(self._running), timeout=0)
        return [(self._running.pop(reference), self._code(reference)) for reference in over]

    def stop(self) -> None:
        """Ask all workers to stop; they look at the folder."""
        self._folder.ask_to_stop(True)

    def close(self) -> None:
        """Leave the cluster."""
        if self._own:
            self._ray.shutdown()

    def _code(self, reference: Any) -> int:
        try:
            return self._ray.get(reference)
        except self._ray.exceptions.RayError:
            return LOST


def _run(command: list[str]) -> int:
    """Run a worker on some node and return its exit code."""
    return subprocess.run(command, stdin=subprocess.DEVNULL, check=False).returncode
