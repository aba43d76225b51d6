"""Train policies that rearrange clutter before grasping, on MuJoCo and JAX."""

import os
import sys
import warnings

__version__ = "0.1.0"

_MIN_XLA_THREADS = 4


def guard_small_machine() -> None:
    """Give XLA's CPU client at least four threads; with fewer, MJX programs deadlock in jaxlib 0.10.

    XLA sizes its thread pool from ``NPROC`` when jax is first imported, so the guard must run before
    that. If jax is already imported it is too late to help and a warning says which line to add.
    """
    num_cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    if num_cores >= _MIN_XLA_THREADS or int(os.environ.get("NPROC") or 0) >= _MIN_XLA_THREADS:
        return
    if "jax" in sys.modules:
        warnings.warn(
            f"jax was imported before pregrasp_jax on a machine with {num_cores} cores, where MJX programs can "
            f"deadlock; add `import os; os.environ['NPROC'] = '{_MIN_XLA_THREADS}'` before the first `import jax`",
            RuntimeWarning,
            stacklevel=2,
        )
        return
    os.environ["NPROC"] = str(_MIN_XLA_THREADS)


guard_small_machine()
