"""Robots, chosen by name."""

import functools
from collections.abc import Callable
from typing import TYPE_CHECKING

from pregrasp_jax import messages

if TYPE_CHECKING:
    from pregrasp_jax.robot.base import Robot


def _ur5e_rg2() -> "Robot":
    from pregrasp_jax.robot import ur5e_rg2  # with jax and MuJoCo, which a deployed policy does without

    return ur5e_rg2.make_robot()


def _barrett() -> "Robot":
    from pregrasp_jax.robot import barrett

    return barrett.make_robot()


ROBOTS: "dict[str, Callable[[], Robot]]" = {"ur5e_rg2": _ur5e_rg2, "barrett": _barrett}
"""Makers of robots by the name that `task.robot` knows them by; add your own before you make an environment."""


@functools.cache
def get_robot(name: str) -> "Robot":
    """Return the robot called `name`, made once.

    Raises:
        ValueError: there is none; the line lists those that exist.
    """
    return messages.lookup(ROBOTS, name, key="task.robot")()
