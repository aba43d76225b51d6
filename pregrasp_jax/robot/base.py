"""What a robot is: a record of names and functions, so that no other stage knows a joint, a link or a finger.

`robot.ur5e_rg2` is the first; docs/extend.md says how to add your own.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from pregrasp_jax.robot.chain import Links
from pregrasp_jax.robot.following import Body
from pregrasp_jax.robot.region import ClosingRegion
from pregrasp_jax.spaces.workspace import Workspace
from pregrasp_jax.types import OBSTRUCTIONS, HandPose, HullBank


class Eligibility(NamedTuple):
    """Which objects the hand can take.

    Attributes:
        eligible: [N] bool, host array.
        reasons: N texts, why not; empty where eligible.
    """

    eligible: np.ndarray
    reasons: tuple[str, ...]


@dataclass(frozen=True)
class Robot:
    """A robot with a hand; every function is pure, unbatched and usable under `jax.jit`, unless it says host.

    Attributes:
        name: as in `TaskConfig.robot`.
        joints: names of the J joints of `PhysicsObservation.joint_pos`.
        actuators: names of the A actuators, in the order of a control row.
        start: where the hand is at the start of an episode, in host arrays.
        home: [J] joint positions at the start, host array, rad or m.
        links: the bodies that move, and their hulls.
        attach: host; (spec) -> None adds bodies, actuators and constraints to a scene.
        set_home: host; (mj_model, mj_data, *, home=`home`) -> None puts the robot at rest at joint positions.
        hand_pose: (joint_pos [J]) -> [7] pose of the grasp point in the world, x forward, z up.
        follow: (joint_pos [J], poses [T, 7], apertures [T], workspace) -> controls [T, A] and code [T] int32, for every
            row an index into `OBSTRUCTIONS`: what keeps the hand from that pose. Rows are `types.CTRL_DT` apart.
        clearance: (joint_pos [J], workspace) -> () m to table and walls of what must keep clear of them.
        closing_region: (aperture () rad) -> `ClosingRegion`; None for a hand without one.
        eligibility: host; (hull bank) -> `Eligibility`.
        grasp_aperture: rad, commanded to close with constant force.
        front: (aperture () rad, y [...] m) -> [...] m, how far forward the open hand reaches on lines at y beside its
            heading, -inf where it does not; None where nobody asks.
        fingertips: names of the links that end the fingers; what nothing but them touches is pinched, not held.
        body: of an arm with closed-form kinematics, so that a deployed policy can do without MuJoCo; None if there is
            none.
        mirrored_home: [J] the mirror image of `home` in the plane y = 0, host array; None if the robot has none.
    """

    name: str
    joints: tuple[str, ...]
    actuators: tuple[str, ...]
    start: HandPose
    home: np.ndarray
    links: Links
    attach: Callable[[mujoco.MjSpec], None]
    set_home: Callable[..., None]
    hand_pose: Callable[[jax.Array], jax.Array]
    follow: Callable[[jax.Array, jax.Array, jax.Array, Workspace], tuple[jax.Array, jax.Array]]
    clearance: Callable[[jax.Array, Workspace], jax.Array]
    closing_region: Callable[[jax.Array], ClosingRegion] | None
    eligibility: Callable[[HullBank], Eligibility]
    grasp_aperture: float
    front: Callable[[jax.Array, jax.Array], jax.Array] | None = None
    fingertips: tuple[str, ...] = ()
    body: Body | None = None
    mirrored_home: np.ndarray | None = None

    @property
    def homes(self) -> np.ndarray:
        """The posture at the start and its mirror image, [2, J]; twice the same where there is none."""
        return np.stack([self.home, self.home if self.mirrored_home is None else self.mirrored_home])

    def joint_qpos_ids(self, mj_model: mujoco.MjModel) -> np.ndarray:
        """Return the addresses [J] in qpos of the joints."""
        return np.array([mj_model.joint(name).qposadr[0] for name in self.joints])


def hand_pose_of(xy: tuple[float, float], *, z: float, yaw: float, aperture: float) -> HandPose:
    """Return a pose in host arrays, float32."""
    x, y = xy
    return HandPose(np.array([x, y], np.float32), *map(np.float32, (z, yaw, aperture)))  # pyright: ignore[reportArgumentType]


def first_obstruction(holds: dict[str, jax.Array]) -> jax.Array:
    """Return an index into `OBSTRUCTIONS` [T] int32: the first name that holds [T] bool, 0 where none does."""
    code = jnp.zeros(next(iter(holds.values())).shape, jnp.int32)
    for name in reversed(holds):
        code = jnp.where(holds[name], OBSTRUCTIONS.index(name), code)
    return code
