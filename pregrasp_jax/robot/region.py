"""What the closing fingers of a hand sweep; for numpy and jax alike."""

from typing import Any, NamedTuple

from pregrasp_jax.spaces.arrays import namespace

Array = Any


class ClosingRegion(NamedTuple):
    """What the closing fingers sweep, in the hand frame (x forward, y to the side), symmetric about y = 0.

    Attributes:
        x: [P] m, increasing stations along the hand; the first is the palm.
        half_width: [P] m, half of the region's width there, linear in between.
        exists: () bool; there is no region unless the fingers are open.
    """

    x: Array
    half_width: Array
    exists: Any

    def holds(self, xy: Array) -> Array:
        """Return which points [..., 2] m of the hand frame lie in the region, whether it exists now or not."""
        xp = namespace(xy)
        half = xp.interp(xy[..., 0], xp.asarray(self.x, xp.float32), xp.asarray(self.half_width, xp.float32))
        along = (xy[..., 0] >= self.x[0]) & (xy[..., 0] <= self.x[-1])
        return along & (xp.abs(xy[..., 1]) <= half)
