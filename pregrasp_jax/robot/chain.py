"""A robot as a tree of links: where every part is for given joints, for numpy and jax alike.

`links.make_links` makes one of an MJCF; a deployed policy reads one from its bundle.
"""

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from pregrasp_jax.geometry import matrix_product, matrix_to_pose, scan
from pregrasp_jax.spaces.arrays import namespace

Array = Any


class LinkGeom(NamedTuple):
    """One collision geom, as the points whose hull it is, grown by a radius (0 for a box).

    Attributes:
        name: as in the MJCF.
        link: index into `Links.names`.
        points: [2, 3] ends of a capsule or [8, 3] corners of a box, m in the link frame.
        radius: m.
    """

    name: str
    link: int
    points: np.ndarray
    radius: float


@dataclass(frozen=True, eq=False)
class Links:
    """The L bodies of a robot, parents first; everything is a host array.

    Attributes:
        names: as in the MJCF.
        parents: [L] int, index of the parent link, -1 for the world.
        fixed: [L, 4, 4] pose in the parent at joint position 0.
        to_axis: [L, 4, 4] rotation of z onto the joint axis.
        joint: [L] int, index into the joints of the joint that moves it; 0 where nothing does.
        turn: [L] rad per unit of that joint; 0 where it does not turn, -1 where it mirrors another finger.
        slide: [L] m per unit of that joint; 0 where it does not slide.
        ancestors: [R, L] int, the ancestors 1, 2, 4, ... steps above; L is the world.
        geoms: collision geoms in the order of the MJCF.
        hulls: `types.Hulls`, one per geom, in link frames. Boxes are exact; a capsule's polyhedron straddles its
            surface within `CAPSULE_ERROR` of its radius.
        hull_links: [M] int32, the link of each hull.
    """

    names: tuple[str, ...]
    parents: np.ndarray
    fixed: np.ndarray
    to_axis: np.ndarray
    joint: np.ndarray
    turn: np.ndarray
    slide: np.ndarray
    ancestors: np.ndarray
    geoms: tuple[LinkGeom, ...]
    hulls: Any
    hull_links: np.ndarray

    def matrices(self, joint_pos: Array) -> Array:
        """Return the homogeneous world poses [..., L, 4, 4] for joint positions [..., J]; see `poses`.

        All links at once, in log2(depth) rounds: each is multiplied onto its ancestor 1, 2, 4, ... steps above. The
        rounds are a scan because XLA fuses an unrolled chain into one expression that takes minutes to compile.
        """
        xp = namespace(joint_pos)
        driven = joint_pos[..., self.joint]
        angle = driven * self.turn
        cos, sin, zero, one = xp.cos(angle), xp.sin(angle), xp.zeros_like(angle), xp.ones_like(angle)
        rise = driven * self.slide if self.slide.any() else zero
        motion = [[cos, -sin, zero, zero], [sin, cos, zero, zero], [zero, zero, one, rise], [zero, zero, zero, one]]
        about_z = xp.stack([xp.stack(row, axis=-1) for row in motion], axis=-2)
        start = self.fixed @ self.to_axis
        world = matrix_product(matrix_product(start, about_z), self.to_axis.swapaxes(1, 2))
        outside = xp.broadcast_to(xp.eye(4, dtype=world.dtype), (*world.shape[:-3], 1, 4, 4))

        def climb(world: Array, ancestor: Array) -> tuple[Array, None]:
            # The extra row is the world, the ancestor of whatever has run out of parents.
            padded = xp.concatenate([world, outside], axis=-3)
            return matrix_product(padded[..., ancestor, :, :], world), None

        return scan(climb, world, xp.asarray(self.ancestors))[0]

    def poses(self, joint_pos: Array) -> Array:
        """Return the world poses [L, 7] for joint positions [J]. Agrees with MuJoCo's kinematics within 1e-6."""
        import jax  # the only thing here that numpy does not do

        return jax.vmap(matrix_to_pose)(self.matrices(joint_pos))
