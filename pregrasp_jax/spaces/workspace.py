"""The place in which the task happens: what may not be left, and walls.

A `Workspace` is plain data. Its walls are collided with, kept clear of by the arm and drawn in people's pictures; in
heightmaps a wall inside the grid is drawn with the id of the table.
"""

import dataclasses
import inspect
import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from pregrasp_jax import io, messages
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

    @property
    def symmetric(self) -> bool:
        """Whether the place is its own mirror image in the plane y = 0, walls as solids."""
        return self.low[1] == -self.high[1] and _solids(self.walls) == _solids(map(_mirrored, self.walls))

    @property
    def content_hash(self) -> str:
        """Hash of everything that makes the place."""
        return io.content_hash(dataclasses.asdict(self))

    def has_left(self, points: Any) -> Any:
        """Return [N] bool, which of the points [N, 3] m lie beyond the limits or below the table."""
        xp = namespace(points)
        low, high = (xp.asarray(limit, dtype=xp.float32)[None] for limit in (self.low, self.high))
        beyond = xp.any((points[:, :2] < low) | (points[:, :2] > high), axis=-1)
        return beyond | (points[:, 2] < 0)


TABLE = Workspace(name="table")
"""The paper's open table, 0.5 x 0.5 m."""


def make_shelf(
    *,
    half_width: float = 0.25,
    back: float = 0.25,
    front: float = -0.25,
    wall_height: float = 0.30,
    wall_thickness: float = 0.02,
) -> Workspace:
    """Return a table between two side walls and a back wall, open in front and above; objects leave at the front.

    Args:
        half_width: m, from the middle to either side wall.
        back: m, x of the back wall's inner face.
        front: m, x of the edge over which objects leave and at which the side walls begin.
        wall_height: m.
        wall_thickness: m.

    Source: the paper shows a shelf without dimensions (Sec. IV-C); docs/confined.md says how these were chosen.
    """
    if not front < back:
        raise ValueError(f"workspace 'shelf': front = {front} must be below back = {back}")
    half, z = wall_thickness / 2, wall_height / 2
    across = Box(center=(back + half, 0.0, z), half_size=(half, half_width + wall_thickness, z))
    sides = [
        Box(center=((front + back) / 2, y, z), half_size=((back - front) / 2, half, z))
        for y in (half_width + half, -half_width - half)
    ]
    return Workspace(name="shelf", low=(front, -math.inf), high=(math.inf, math.inf), walls=(across, *sides))


def make_narrow(*, half_width: float = 0.22) -> Workspace:
    """Return a table that ends early at its sides, |y| = `half_width` m."""
    reach = grid.WORKSPACE_HALF_SIZE
    return Workspace(name="narrow", low=(-reach, -half_width), high=(reach, half_width))


WORKSPACES: dict[str, Workspace | Callable[..., Workspace]] = {
    TABLE.name: TABLE,
    "shelf": make_shelf,
    "narrow": make_narrow,
}
"""Places by the name that `task.workspace` knows them by, or what makes one from dimensions (`task.place`), which have
defaults; add your own before you make an environment."""


def get_workspace(name: str, dimensions: Mapping[str, float | None] | None = None) -> Workspace:
    """Return the place called `name`.

    Args:
        name: a key of `WORKSPACES`.
        dimensions: m, by name; None is the place's own.

    Raises:
        ValueError: there is no such place, or it has no such dimension; the line lists those that exist.
    """
    place = messages.lookup(WORKSPACES, name, key="task.workspace")
    given = {key: value for key, value in (dimensions or {}).items() if value is not None}
    known = [] if isinstance(place, Workspace) else list(inspect.signature(place).parameters)
    for key, value in given.items():
        if key not in known:
            raise ValueError(
                f"task.place.{key} = {value}: workspace '{name}' has no such dimension; allowed: "
                f"{', '.join(known) or 'none'}"
            )
    return place if isinstance(place, Workspace) else place(**given)


def _mirrored(wall: Box) -> Box:
    """Return the mirror image of a wall in the plane y = 0."""
    x, y, z = wall.center
    return dataclasses.replace(wall, center=(x, -y, z), yaw=-wall.yaw)


def _solids(walls: Iterable[Box]) -> set[tuple[Any, ...]]:
    """Return the corners of walls, in any order, so that equal solids are equal whatever they are called."""
    return {tuple(sorted(map(tuple, np.round(wall.corners(), 6) + 0.0))) for wall in walls}
