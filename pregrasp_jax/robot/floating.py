"""Hands without an arm: any hand given as MJCF, carried by three slides and a hinge about z.

Where the arm is not the question (another gripper, a tool, a first look at an idea), a hand needs no inverse
kinematics: its pose is its joint positions.
"""

import functools
from collections.abc import Callable, Mapping, Sequence

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from pregrasp_jax.geometry import quat_from_yaw
from pregrasp_jax.robot import clearance
from pregrasp_jax.robot.base import ClosingRegion, Eligibility, Robot, first_obstruction
from pregrasp_jax.robot.chain import Links
from pregrasp_jax.robot.links import make_links
from pregrasp_jax.spaces.workspace import Workspace
from pregrasp_jax.types import CTRL_DT, HandPose, HullBank

JOINTS = ("float_x", "float_y", "float_z", "float_yaw")
"""Of the carrier, outermost first; its actuators have the same names."""

PREFIX = "hand_"
"""Put before every name of the hand's own MJCF."""

REACH = ((-0.40, 0.40), (-0.40, 0.40), (0.0, 0.60))
"""m, limits of x, y and z of the grasp point."""

_MASS, _INERTIA = 1.0, 0.05
"""kg for each slide and kg m^2 for the hinge: enough beside a hand of about 1 kg for the gains below to suit any."""

_SLIDE_GAINS, _HINGE_GAINS = (6000.0, 300.0), (80.0, 4.0)
"""kp in N/m and N m/rad, kv in N s/m and N m s/rad; about critically damped."""

_SLIDE_FORCE, _HINGE_FORCE = 150.0, 28.0
"""N and N m at most, as strong as a UR5e."""


def make_floating_hand(
    name: str,
    mjcf: str,
    *,
    start: HandPose,
    closing_region: Callable[[jax.Array], ClosingRegion] | None,
    eligibility: Callable[[HullBank], Eligibility],
    fingers: Sequence[str] | Mapping[str, float] = (),
    grasp_aperture: float = 0.0,
    front: Callable[[jax.Array, jax.Array], jax.Array] | None = None,
    fingertips: Sequence[str] = (),
) -> Robot:
    """Return a hand that goes wherever it is sent.

    Args:
        name: as in `TaskConfig.robot`.
        mjcf: text of a model whose world holds one body, the hand, of boxes and capsules. The frame of that body is the
            grasp point: x forward, z up. What its geoms collide with is set here.
        start: where the hand is at the start of an episode, in host arrays (see `hand_pose_of`).
        closing_region: as in `Robot`.
        eligibility: as in `Robot`.
        fingers: joints of the MJCF that stand at the aperture, or at the share of it that a mapping gives; each needs a
            position actuator of the same name. Others must follow one of them by an equality.
        grasp_aperture: as in `Robot`.
        front: as in `Robot`.
        fingertips: bodies of the MJCF, see `Robot`.

    Raises:
        ValueError: the MJCF is not such a hand.
    """
    joints = (*JOINTS, *(PREFIX + finger for finger in fingers))
    mj_model = _carried(name, mjcf).compile()
    links = make_links(mj_model, joints)
    drives = tuple(mj_model.actuator(i).name for i in range(mj_model.nu))
    if drives != joints:
        had, wanted = (", ".join(x.removeprefix(PREFIX) for x in names[len(JOINTS) :]) for names in (drives, joints))
        raise ValueError(
            f"the actuators of hand {name} are {had or 'none'}; allowed are {wanted or 'none'}, in this order"
        )
    shares = np.array(list(fingers.values()) if isinstance(fingers, Mapping) else [1.0] * len(fingers), np.float32)
    home = np.array([*start.xy, start.z, start.yaw, *(start.aperture * shares)], np.float32)

    def attach(spec: mujoco.MjSpec) -> None:
        spec.worldbody.add_frame().attach_body(_carried(name, mjcf).body(JOINTS[0]), "", "")

    return Robot(
        name=name,
        joints=joints,
        actuators=joints,
        start=start,
        home=home,
        mirrored_home=home if start.xy[1] == 0 and start.yaw == 0 else None,
        links=links,
        attach=attach,
        set_home=functools.partial(_set_home, links=links, joints=joints, home=home),
        hand_pose=lambda joint_pos: jnp.append(joint_pos[:3], quat_from_yaw(joint_pos[3])),
        follow=functools.partial(_follow, links, shares),
        # The fingers may touch the table, so that only walls are kept clear of.
        clearance=lambda joint_pos, place: clearance.distance_to_walls(links, links.geoms, joint_pos, place),
        closing_region=closing_region,
        eligibility=eligibility,
        grasp_aperture=grasp_aperture,
        front=front,
        fingertips=tuple(PREFIX + tip for tip in fingertips),
    )


def _carried(name: str, mjcf: str) -> mujoco.MjSpec:
    """Return the hand on its carrier."""
    hand = mujoco.MjSpec.from_string(mjcf)
    if len(hand.worldbody.bodies) != 1 or hand.worldbody.geoms:
        raise ValueError(f"the MJCF of hand {name} holds {len(hand.worldbody.bodies)} bodies; allowed is one, the hand")
    root = hand.worldbody.bodies[0]
    if root.pos.any() or not np.array_equal(root.quat, [1, 0, 0, 0]):
        raise ValueError(
            f"the body of hand {name} stands at {root.pos.tolist()}, turned by {root.quat.tolist()}; allowed is the "
            "origin, as it is held: move what is in it"
        )
    for index, geom in enumerate(hand.geoms):
        geom.name = geom.name or f"geom_{index}"  # engines look geoms up by their names
        geom.contype, geom.conaffinity = 2, 1  # objects and the table, not itself: as in mjcf/SOURCES.md
    for body in hand.bodies:
        body.gravcomp = 1
    spec = mujoco.MjSpec()
    body = spec.worldbody
    for joint, axis in zip(JOINTS, np.eye(3)[[0, 1, 2, 2]], strict=True):
        slides = joint != JOINTS[-1]
        body = body.add_body(name=joint, mass=1e-3, inertia=[1e-6] * 3, explicitinertial=True, gravcomp=1)
        body.add_joint(
            name=joint,
            type=mujoco.mjtJoint.mjJNT_SLIDE if slides else mujoco.mjtJoint.mjJNT_HINGE,
            axis=axis,
            armature=_MASS if slides else _INERTIA,
        )
        kp, kv = _SLIDE_GAINS if slides else _HINGE_GAINS
        force = _SLIDE_FORCE if slides else _HINGE_FORCE
        actuator = spec.add_actuator(
            name=joint, target=joint, trntype=mujoco.mjtTrn.mjTRN_JOINT, forcerange=[-force, force], forcelimited=True
        )
        actuator.set_to_position(kp=kp, kv=kv)
    body.add_frame().attach_body(hand.worldbody.first_body(), PREFIX, "")
    return spec


def _follow(
    links: Links, shares: np.ndarray, joint_pos: jax.Array, poses: jax.Array, apertures: jax.Array, workspace: Workspace
) -> tuple[jax.Array, jax.Array]:
    """Follow poses of the grasp point; see `Robot.follow`. Commands have velocity feed-forward."""
    yaw = jnp.unwrap(2 * jnp.arctan2(poses[:, 6], poses[:, 3]))
    turns = jnp.round((joint_pos[3] - yaw[0]) / (2 * jnp.pi))
    carrier = jnp.concatenate([poses[:, :3], (yaw + 2 * jnp.pi * turns)[:, None]], axis=1)
    fingers = apertures[:, None] * shares[None]
    path = jnp.concatenate([carrier, fingers], axis=1)
    low, high = jnp.array(REACH).T
    height = jax.vmap(lambda q: clearance.height_above_table(links, links.geoms, q))(path)
    holds = {
        "joint_limit": ~jnp.all((carrier[:, :3] >= low[None]) & (carrier[:, :3] <= high[None]), axis=-1),
        "table": ~(height >= 0),
        "wall": clearance.near_walls(links, links.geoms, path, poses, apertures, workspace),
    }
    lead = jnp.array([kv / kp for kp, kv in (*[_SLIDE_GAINS] * 3, _HINGE_GAINS)])
    velocity = jnp.asarray(jnp.gradient(carrier, CTRL_DT, axis=0))
    return jnp.concatenate([carrier + lead[None] * velocity, fingers], axis=1), first_obstruction(holds)


def _set_home(
    mj_model: mujoco.MjModel, data: mujoco.MjData, *, links: Links, joints: tuple[str, ...], home: np.ndarray
) -> None:
    """Put the hand at rest at the start: positions, those of coupled joints too, controls, and `data`'s kinematics."""
    share = links.turn + links.slide
    for link in np.flatnonzero(share):
        joint = int(mj_model.body(links.names[link]).jntadr[0])
        data.qpos[mj_model.jnt_qposadr[joint]] = share[link] * home[links.joint[link]]
        data.qvel[mj_model.jnt_dofadr[joint]] = 0.0
    data.ctrl[[mj_model.actuator(name).id for name in joints]] = home
    mujoco.mj_forward(mj_model, data)
