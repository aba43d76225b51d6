"""The Barrett hand BH8-282 without an arm: three fingers, their spread locked, one drive angle for all of them.

Everything about its shape follows from the MJCF by the planar kinematics of one finger: seen from above the left
fingers lie on each other and the right one is their mirror image. The frame is the hand's: x forward, y left, m.
"""

import functools

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from pregrasp_jax import io
from pregrasp_jax.robot import ur5e_rg2
from pregrasp_jax.robot.base import ClosingRegion, Robot, hand_pose_of
from pregrasp_jax.robot.floating import make_floating_hand

APERTURES = (0.6, 1.1)
"""rad, drive angles between which the hand is open; 201 and 91 mm between opposing fingertips."""

CLOSED = 1.8
"""rad, commanded to close; what is between the fingers stops them before."""

DISTAL_SHARE = 1 / 3
"""Angle of a distal joint as a share of the drive angle (gears of 125 : 1 and 93.75 : 1)."""

PALM_EDGE = 0.037
"""m; half of the palm's width between the knuckles, where the closing region begins."""

START = hand_pose_of((-0.40, 0.0), z=0.1, yaw=0.0, aperture=APERTURES[0])
"""Behind the near side of the table, out of every camera's view."""

_FINGERS = (1, 2, 3)


def make_robot() -> Robot:
    """Return the hand; reads its MJCF.

    It is asked for the same targets as the UR5e with its RG2, although it could take wider ones: so scenes and targets
    are the same, and results pair.
    """
    shares = {"proximal": 1.0, "distal": DISTAL_SHARE}
    joints = {f"{link}_{i}": share for i in _FINGERS for link, share in shares.items()}
    return make_floating_hand(
        "barrett",
        _mjcf(),
        start=START,
        closing_region=region,
        eligibility=ur5e_rg2.eligibility,
        fingers=joints,
        grasp_aperture=CLOSED,
        front=front,
        fingertips=[f"distal_{i}" for i in _FINGERS],
    )


def finger_lines(aperture: jax.Array) -> jax.Array:
    """Return the middle lines of the two capsules of a left finger, seen from above.

    Args:
        aperture: () rad, drive angle.

    Returns:
        [2, 2, 2] m: proximal and distal link, each from its joint to its end, (x, y).
    """
    finger = _finger()
    turns = jnp.stack([aperture, aperture * (1 + DISTAL_SHARE)])
    turn = jax.vmap(_clockwise)(turns)
    knuckle = jnp.asarray(finger.knuckle)
    joint = knuckle + turn[0] @ finger.distal
    ends = jnp.stack([knuckle + turn[0] @ finger.lines[0], joint + turn[1] @ finger.lines[1]])
    return jnp.stack([jnp.stack([knuckle, joint]), ends], axis=1)


def fingertip(aperture: jax.Array) -> jax.Array:
    """Return the tip [2] m of a left finger, the frame that apertures are stated for."""
    distal_joint = finger_lines(aperture)[1, 0]
    return distal_joint + _clockwise(aperture * (1 + DISTAL_SHARE)) @ _finger().tip


def region(aperture: jax.Array) -> ClosingRegion:
    """Return what the closing fingers sweep: between the palm's edges and the inner sides of the fingers."""
    lines = finger_lines(aperture)
    along = (lines[:, 1] - lines[:, 0]) / jnp.linalg.norm(lines[:, 1] - lines[:, 0], axis=1, keepdims=True)
    inward = jnp.stack([along[:, 1], -along[:, 0]], axis=1)
    inner = lines + (jnp.asarray(_finger().radii)[:, None] * inward)[:, None]
    bend = _crossing(inner[0, 0], along[0], inner[1, 0], along[1])
    end = lines[1, 1] - jnp.array([0.0, 1.0]) * _finger().radii[1]
    end = jnp.stack([jnp.maximum(end[0], inner[1, 1, 0] + 1e-4), end[1]])
    palm = jnp.array([_finger().palm_face, PALM_EDGE])
    corners = jnp.stack([palm, inner[0, 0], bend, inner[1, 1], end])
    return ClosingRegion(corners[:, 0], corners[:, 1], aperture <= APERTURES[1] + 1e-3)


def front(aperture: jax.Array, y: jax.Array) -> jax.Array:
    """Return how far forward the open hand reaches [...] m on lines at `y` [...] m beside its heading.

    -inf where it does not reach at all. All that lies behind is swept by a hand that comes from behind.
    """
    finger, lines = _finger(), finger_lines(aperture)
    reach = jnp.where(jnp.abs(y) <= finger.palm_half_width, finger.palm_face, -jnp.inf)
    for line, radius in zip(lines, finger.radii, strict=True):
        reach = jnp.maximum(reach, _capsule_front(line[0], line[1], radius, jnp.abs(y)))
    return reach


def _capsule_front(start: jax.Array, end: jax.Array, radius: float, y: jax.Array) -> jax.Array:
    """Return the largest x [...] of a flat capsule on lines at `y` [...], -inf beside it."""

    def cap(center: jax.Array) -> jax.Array:
        inside = radius**2 - (y - center[1]) ** 2
        return jnp.where(inside >= 0, center[0] + jnp.sqrt(jnp.maximum(inside, 0.0)), -jnp.inf)

    along = end - start
    side = jnp.stack([along[1], -along[0]]) / jnp.linalg.norm(along)
    side = side * jnp.sign(side[0]) * radius
    share = (y - start[1] - side[1]) / along[1]
    edge = jnp.where((share >= 0) & (share <= 1), start[0] + side[0] + share * along[0], -jnp.inf)
    return jnp.maximum(jnp.maximum(cap(start), cap(end)), edge)


def _crossing(a: jax.Array, along_a: jax.Array, b: jax.Array, along_b: jax.Array) -> jax.Array:
    """Return where two lines [2] cross that go through `a` and `b` [2]."""
    cross = along_a[0] * along_b[1] - along_a[1] * along_b[0]
    step = ((b[0] - a[0]) * along_b[1] - (b[1] - a[1]) * along_b[0]) / cross
    return a + step * along_a


def _clockwise(angle: jax.Array) -> jax.Array:
    """Return the rotation [2, 2] that turns left (y) to forward (x): how a left finger closes."""
    cos, sin = jnp.cos(angle), jnp.sin(angle)
    return jnp.stack([jnp.stack([cos, sin]), jnp.stack([-sin, cos])])


class _Finger:
    """A left finger at joint positions 0, seen from above, m; read from the MJCF.

    Attributes:
        knuckle: [2] the proximal joint.
        distal: [2] from the proximal to the distal joint.
        lines: [2, 2] from either joint to the end of its capsule's middle line.
        radii: of the two capsules.
        tip: [2] from the distal joint to the tip.
        palm_face: x of the palm's front.
        palm_half_width: of the palm.
    """

    def __init__(self, mj_model: mujoco.MjModel):
        geoms = [mj_model.geom(f"{link}_1") for link in ("proximal", "distal")]
        self.knuckle = mj_model.body("proximal_1").pos[:2].astype(np.float32)
        self.distal = mj_model.body("distal_1").pos[:2].astype(np.float32)
        # A capsule's frame is in its middle, and it begins at the joint, the origin of the link.
        self.lines = np.stack([2 * geom.pos[:2] for geom in geoms]).astype(np.float32)
        self.radii = tuple(float(geom.size[0]) for geom in geoms)
        self.tip = mj_model.site("tip_1").pos[:2].astype(np.float32)
        palm = mj_model.geom("palm")
        self.palm_face = float(palm.pos[0] + palm.size[0])
        self.palm_half_width = float(palm.size[1])


@functools.cache
def _finger() -> _Finger:
    return _Finger(mujoco.MjSpec.from_string(_mjcf()).compile())


def _mjcf() -> str:
    return (io.mjcf_dir() / "barrett.xml").read_text()
