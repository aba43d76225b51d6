"""Train policies that rearrange clutter before grasping, on MuJoCo and JAX."""

import os
import sys
import warnings

__version__ = "0.1.0"

_MIN_XLA_THREADS = 4


def num_threads_asked() -> int:
    """Return ``NPROC``, 0 where it is unset or no number."""
    value = os.environ.get("NPROC", "")
    return int(value) if value.isdecimal() else 0


def guard_small_machine() -> bool:
    """Give XLA's CPU client at least four threads; with fewer, MJX programs deadlock in jaxlib 0.10.

    XLA sizes its thread pool from ``NPROC``, or else by the cores, when jax is first imported, so the guard must run
    before that. If jax is already imported it is too late to help and a warning says which line to add.

    Returns:
        Whether it has set ``NPROC``.
    """
    num_cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    num_threads = num_threads_asked() or num_cores
    if num_threads >= _MIN_XLA_THREADS:
        return False
    if "jax" in sys.modules:
        warnings.warn(
            f"jax was imported before pregrasp_jax with {num_threads} threads for XLA, where MJX can deadlock; "
            f"add `import os; os.environ['NPROC'] = '{_MIN_XLA_THREADS}'` before the first `import jax`",
            RuntimeWarning,
            stacklevel=2,
        )
        return False
    os.environ["NPROC"] = str(_MIN_XLA_THREADS)
    return True


NPROC_BY_GUARD = guard_small_machine()
"""Whether ``NPROC`` is the guard's; otherwise it is as the environment has it."""
