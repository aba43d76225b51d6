"""What a push can be: a cell of the grid, one of a few choices of how the hand is held, and free parameters.

An action is an int32, the flat index of Q[row, col, choice]. This is the one place that turns it into anything else.
Functions are unbatched or broadcast, and serve numpy and jax alike.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np

from pregrasp_jax.spaces import grid
from pregrasp_jax.spaces.arrays import namespace

REFUSED_RADIUS = 0.02
"""m; so near to a push that the arm cannot make, no other one is tried."""


@dataclass(frozen=True, kw_only=True)
class Choice:
    """How the hand is held while it pushes.

    Attributes:
        name: what pictures call it.
        z: m above the table.
        yaw: rad, heading of the hand, 0 along +x.
        aperture: rad, drive angle of the fingers.
    """

    name: str
    z: float
    yaw: float
    aperture: float


@dataclass(frozen=True, kw_only=True)
class Bound:
    """A continuous parameter beside the flat index, from `low` to `high` in `unit`."""

    name: str
    low: float
    high: float
    unit: str

    def refuse(self, value: float) -> None:
        """Refuse a value beyond the bounds.

        Raises:
            ValueError: one line says which is allowed.
        """
        if not self.low <= value <= self.high:
            raise ValueError(
                f"{self.name} = {value:g} {self.unit} is out of range; allowed is {self.low} to {self.high}"
            )


@dataclass(frozen=True)
class ActionSpace:
    """Every cell of the grid with every choice.

    Attributes:
        choices: K of them, the last axis of Q maps.
        mirrored: [K] the choice that each becomes in the mirror image of the scene (reflected in y = 0).
        free: parameters that a policy gives beside the index; pushes have none.
    """

    choices: tuple[Choice, ...]
    mirrored: tuple[int, ...]
    free: tuple[Bound, ...] = ()

    def __post_init__(self):
        names = [choice.name for choice in self.choices]
        if not names or len(set(names)) < len(names):
            raise ValueError(f"choices of an action space are {names}; allowed are one or more of different names")
        order = range(len(names))
        if sorted(self.mirrored) != list(order) or any(self.mirrored[self.mirrored[k]] != k for k in order):
            raise ValueError(
                f"mirrored = {self.mirrored}; allowed is an order of 0 to {len(names) - 1} that undoes itself when "
                "applied twice"
            )

    @property
    def num_choices(self) -> int:
        """Return K."""
        return len(self.choices)

    @property
    def shape(self) -> tuple[int, int, int]:
        """Return the shape [H, W, K] of a Q map."""
        return grid.GRID_SIZE, grid.GRID_SIZE, self.num_choices

    @property
    def widest(self) -> int:
        """Return the first choice with the largest aperture."""
        return max(range(self.num_choices), key=lambda k: self.choices[k].aperture)

    @property
    def narrowest(self) -> int:
        """Return the first choice with the smallest aperture."""
        return min(range(self.num_choices), key=lambda k: self.choices[k].aperture)

    def encode(self, row: Any, col: Any, choice: Any) -> Any:
        """Return the flat index int32 of Q[row, col, choice]."""
        xp = namespace(row, col, choice)
        return ((row * grid.GRID_SIZE + col) * self.num_choices + choice).astype(xp.int32)

    def unravel(self, action: Any) -> tuple[Any, Any, Any]:
        """Return row, col and choice of a flat index; inverse of `encode`."""
        cell, choice = action // self.num_choices, action % self.num_choices
        return cell // grid.GRID_SIZE, cell % grid.GRID_SIZE, choice

    def decode(self, action: Any) -> tuple[Any, Any]:
        """Return the centre [..., 2] m of the cell of a flat index, and its choice."""
        row, col, choice = self.unravel(action)
        return grid.cell_to_world(row, col), choice

    def near(self, action: Any, radius: float) -> Any:
        """Return which pushes [H, W, K] bool end less than `radius` m from where `action` does, held as it is."""
        row, col, choice = self.unravel(action)
        cells, choices = np.arange(grid.GRID_SIZE), np.arange(self.num_choices)
        squared = (cells[:, None] - row) ** 2 + (cells[None] - col) ** 2
        within = squared < (radius / grid.HEIGHTMAP_RESOLUTION) ** 2 - 1e-3
        return within[..., None] & (choices == choice)[None, None]

    def mirror(self, action: Any) -> Any:
        """Return the flat index of a push reflected in the robot's plane y = 0."""
        row, col, choice = self.unravel(action)
        xp = namespace(action)
        return self.encode(grid.GRID_SIZE - 1 - row, col, xp.asarray(self.mirrored)[choice])

    def mirror_map(self, q: Any) -> Any:
        """Return the Q map [..., H, W, K] of the mirror image of a scene as one of the scene itself."""
        flipped = q[..., ::-1, :, :]
        alike = self.mirrored == tuple(range(self.num_choices))  # then nothing need be gathered
        return flipped if alike else flipped[..., np.array(self.mirrored)]

    def held(self, choice: Any) -> tuple[Any, Any, Any]:
        """Return z m, yaw rad and aperture rad, float32, of a choice."""
        xp = namespace(choice)
        columns = zip(*((c.z, c.yaw, c.aperture) for c in self.choices), strict=True)
        z, yaw, aperture = (xp.asarray(column, dtype=xp.float32)[choice] for column in columns)
        return z, yaw, aperture
