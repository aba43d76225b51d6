"""Robots, chosen by name."""

import functools
from collections.abc import Callable

from pregrasp_jax import messages
from pregrasp_jax.robot import barrett, ur5e_rg2
from pregrasp_jax.robot.base import Robot

ROBOTS: dict[str, Callable[[], Robot]] = {"ur5e_rg2": ur5e_rg2.make_robot, "barrett": barrett.make_robot}
"""Makers of robots by the name that `task.robot` knows them by; add your own before you make an environment."""


@functools.cache
def get_robot(name: str) -> Robot:
    """Return the robot called `name`, made once.

    Raises:
        ValueError: there is none; the line lists those that exist.
    """
    return messages.lookup(ROBOTS, name, key="task.robot")()
