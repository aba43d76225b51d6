"""The place in which the task happens: what may not be left, and walls.

A `Workspace` is plain data. Its walls are collided with, kept clear of by the arm and drawn in people's pictures; in
heightmaps a wall inside the grid is drawn with the id of the table.
"""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from pregrasp_jax import messages
from pregrasp_jax.spaces import grid
from pregrasp_jax.spaces.arrays import namespace


@dataclass(frozen=True, kw_only=True)
class Box:
    """A wall.

    Attributes:
        center: (x, y, z) m in the world.
        half_size: (x, y, z) m along its own axes.
        yaw: rad about z.
    """

    center: tuple[float, float, float]
    half_size: tuple[float, float, float]
    yaw: float = 0.0

    def __post_init__(self):
        numbers = (*self.center, *self.half_size, self.yaw)
        if not all(map(math.isfinite, numbers)) or min(self.half_size) <= 0:
            raise ValueError(
                f"wall at {self.center} of half size {self.half_size} and yaw {self.yaw}; allowed are finite numbers "
                "and half sizes above 0"
            )

    def corners(self) -> np.ndarray:
        """Return the corners [8, 3] m in the world."""
        signs = np.array([(x, y, z) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
        cos, sin = math.cos(self.yaw), math.sin(self.yaw)
        turn = np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])
        return signs * self.half_size @ turn.T + self.center

    def distance_to_origin(self) -> float:
        """Return the planar distance m from the wall to the world origin, 0 if the wall stands on it."""
        cos, sin = math.cos(self.yaw), math.sin(self.yaw)
        x, y = -self.center[0], -self.center[1]
        local = np.array([cos * x + sin * y, cos * y - sin * x])
        return float(np.linalg.norm(np.maximum(np.abs(local) - self.half_size[:2], 0.0)))


@dataclass(frozen=True, kw_only=True)
class Workspace:
    """A table, open or between walls.

    Attributes:
        name: what configurations call it.
        low: (x, y) m; an object whose centre lies below has left. -inf where a wall keeps it.
        high: (x, y) m, the same above.
        walls: boxes.
    """

    name: str
    low: tuple[float, float] = (-grid.WORKSPACE_HALF_SIZE, -grid.WORKSPACE_HALF_SIZE)
    high: tuple[float, float] = (grid.WORKSPACE_HALF_SIZE, grid.WORKSPACE_HALF_SIZE)
    walls: tuple[Box, ...] = ()

    def __post_init__(self):
        if not (self.low[0] < self.high[0] and self.low[1] < self.high[1]):
            raise ValueError(f"workspace '{self.name}': low = {self.low} must be below high = {self.high}")

    def has_left(self, points: Any) -> Any:
        """Return [N] bool, which of the points [N, 3] m lie beyond the limits or below the table."""
        xp = namespace(points)
        low, high = (xp.asarray(limit, dtype=xp.float32)[None] for limit in (self.low, self.high))
        beyond = xp.any((points[:, :2] < low) | (points[:, :2] > high), axis=-1)
        return beyond | (points[:, 2] < 0)


TABLE = Workspace(name="table")
"""The paper's open table, 0.5 x 0.5 m."""

WORKSPACES: dict[str, Workspace] = {TABLE.name: TABLE}
"""Places by the name that `task.workspace` knows them by; add your own before you make an environment."""


def get_workspace(name: str) -> Workspace:
    """Return the place called `name`.

    Raises:
        ValueError: there is none; the line lists those that exist.
    """
    return messages.lookup(WORKSPACES, name, key="task.workspace")
