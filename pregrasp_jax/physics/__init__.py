"""Physics engines behind one contract, `base.Engine`, chosen by name."""

from collections.abc import Callable, Mapping

from pregrasp_jax.physics import native
from pregrasp_jax.physics.base import Engine
from pregrasp_jax.robot.base import Robot
from pregrasp_jax.spaces.workspace import Workspace
from pregrasp_jax.types import HullBank


def _make_mjx(bank: HullBank, robot: Robot, workspace: Workspace, *, threads: int = 0) -> Engine:
    del threads
    from pregrasp_jax.physics import mjx  # imported late: MJX takes seconds to import

    return mjx.make_engine(bank, robot, workspace)


ENGINES: dict[str, Callable[..., Engine]] = {"native": native.make_engine, "mjx": _make_mjx}
"""Makers of engines by the name that `physics.engine` knows them by."""


def make_engine(
    name: str,
    bank: HullBank,
    robot: Robot,
    workspace: Workspace,
    *,
    threads: int = 0,
    engines: Mapping[str, Callable[..., Engine]] = ENGINES,
) -> Engine:
    """Return the engine called `name` for the objects of `bank`, a robot and a place.

    Args:
        name: `native` or `mjx`.
        bank: host hull bank.
        robot: who moves.
        workspace: where.
        threads: of the native engine; 0 takes every core.
        engines: makers by name, of those that can do what the task needs.

    Raises:
        ValueError: there is no such engine, or it cannot be used here; one line says why.
    """
    if name not in engines:
        problem = "cannot do this task" if name in ENGINES else "does not exist"
        raise ValueError(f"physics.engine = {name!r} {problem}; allowed: {', '.join(engines)}")
    return engines[name](bank, robot, workspace, threads=threads)
