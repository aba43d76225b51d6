"""Memory and disk that a run will need, estimated before it starts: nobody likes to run out on the second day."""

import shutil
from pathlib import Path
from typing import Any

import jax

from pregrasp_jax.checkpoint.state import KEEP
from pregrasp_jax.machine import free_memory

COMPRESSED = 0.25
"""Share of the observations' bytes that their chunks take on disk; 0.1 was measured on clutter."""

WORKING_MEMORY = 1e9
"""Bytes for compiled programs, the scene bank and a chunk on its way to disk (1.1e9 measured, with libraries)."""


def num_bytes(tree: Any) -> int:
    """Return the bytes of a pytree of arrays or `jax.ShapeDtypeStruct`; a PRNG key counts as 8."""
    return sum(leaf.size * getattr(leaf.dtype, "itemsize", 8) for leaf in jax.tree.leaves(tree))


def available_memory() -> int | None:
    """Return the bytes that this process may still take: of the device, of its control group, of the machine.

    Returns:
        None where nobody says.
    """
    stats = jax.local_devices()[0].memory_stats() or {}
    if "bytes_limit" in stats:
        return stats["bytes_limit"] - stats.get("bytes_in_use", 0)
    return free_memory()


def available_disk(path: Path) -> int:
    """Return the bytes free for `path`, which need not exist yet."""
    existing = next(parent for parent in (path.absolute(), *path.absolute().parents) if parent.exists())
    return shutil.disk_usage(existing).free


def check(state: Any, ring: Any, run_dir: Path) -> None:
    """Refuse a run that cannot fit.

    Args:
        state: shapes of everything but the ring.
        ring: shapes of the replay's observations.
        run_dir: where checkpoints will go; those of a resumed run are there already.

    Raises:
        ValueError: too little memory or disk; one line says how much of what, and which setting to change if one helps.
    """
    state_bytes, ring_bytes, held = num_bytes(state), num_bytes(ring), _held_by_checkpoints(run_dir)
    # A resumed ring exists on the host, leaf by leaf, while it moves to the device; a saved state twice.
    memory = 3 * state_bytes + WORKING_MEMORY
    _refuse_above("memory", memory + 1.5 * ring_bytes, available_memory(), fixed=memory, resumed=held > 0)
    # Whatever lies there already, the next state is written before the oldest one goes.
    fixed = max((KEEP + 1) * state_bytes - held, state_bytes)
    disk = max((KEEP + 1) * state_bytes + COMPRESSED * ring_bytes - held, state_bytes)
    _refuse_above(f"disk at {run_dir}", disk, available_disk(run_dir), fixed=fixed, resumed=held > 0)


def _refuse_above(what: str, needed: float, available: int | None, *, fixed: float, resumed: bool) -> None:
    """Refuse a need; `fixed` is what the smallest replay would leave of it, and a resumed run keeps its capacity."""
    if available is None or needed <= available:
        return
    if fixed > available:
        advice = f"allowed is more room: {fixed / 1e9:.2f} GB are needed even without the replay's observations"
    elif resumed:
        advice = "allowed is more room, or a new run (--init-from keeps the parameters) with a smaller replay.capacity"
    else:
        advice = f"a smaller replay.capacity helps (its observations take {(needed - fixed) / 1e9:.2f} GB of it)"
    raise ValueError(
        f"the run needs about {needed / 1e9:.2f} GB of {what}, {available / 1e9:.2f} GB are free; {advice}"
    )


def _held_by_checkpoints(run_dir: Path) -> int:
    """Return the bytes of a run's checkpoints, without those that were damaged and have been set aside."""
    files = (path for path in (run_dir / "checkpoints").rglob("*") if path.is_file())
    return sum(path.stat().st_size for path in files if path.parent.suffix != ".damaged")
