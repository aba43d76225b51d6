"""The UR5e with the OnRobot RG2 as a `Robot`: it pushes with a level hand that may point anywhere."""

import functools

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from pregrasp_jax.robot import clearance, closing_region, description, following, kinematics
from pregrasp_jax.robot.base import ClosingRegion, Eligibility, Robot, first_obstruction, hand_pose_of
from pregrasp_jax.robot.chain import LinkGeom, Links
from pregrasp_jax.robot.following import Body
from pregrasp_jax.robot.links import make_links
from pregrasp_jax.spaces.workspace import Workspace
from pregrasp_jax.types import CTRL_DT, HandPose, HullBank

FINGER_CLOSED, FINGER_OPEN = (float(limit) for limit in description.joint_range(description.FINGER_JOINTS[0]))
"""rad. Commanding `FINGER_CLOSED` around an object saturates the actuator: it closes with constant force."""

START = hand_pose_of((-0.30, 0.0), z=0.1, yaw=0.0, aperture=FINGER_OPEN)
"""The near side of the table, pointing +x, open."""

CLOSING_REGION_SIZE = (0.0855, 0.110)
"""m, depth (palm at 145.6 mm to fingertip at 231.1 mm from the flange) and width of what the closing fingers sweep."""

MAX_TARGET_WIDTH = 0.105
"""m; an object whose narrowest width is not below this does not fit between the open fingers."""


def make_robot() -> Robot:
    """Return the robot; reads its MJCF."""
    links = make_links(description.robot_model(), description.JOINTS)
    home, mirrored_home = _homes(links)
    body = Body(arm=description.arm(), links=links, above_table=above_table(links), moving=moving(links))

    def clear_of(joint_pos: jax.Array, workspace: Workspace) -> jax.Array:
        table = clearance.height_above_table(links, above_table(links), joint_pos)
        return jnp.minimum(table, clearance.distance_to_walls(links, moving(links), joint_pos, workspace))

    return Robot(
        name="ur5e_rg2",
        joints=description.JOINTS,
        actuators=description.ACTUATORS,
        start=START,
        home=home,
        mirrored_home=mirrored_home,
        links=links,
        attach=description.attach,
        set_home=functools.partial(_set_home, home=home),
        hand_pose=lambda joint_pos: kinematics.grasp_pose(body.arm, joint_pos[:6]),
        follow=functools.partial(follow, body),
        clearance=clear_of,
        closing_region=region,
        eligibility=eligibility,
        grasp_aperture=FINGER_CLOSED,
        body=body,
    )


def above_table(links: Links) -> list[LinkGeom]:
    """Return what must keep clear of the table: the arm and the hand's body.

    The base stands on the table and the fingers may touch it, so neither counts.
    """
    return [geom for geom in moving(links) if geom.link <= links.names.index(description.HAND_BODY)]


def moving(links: Links) -> list[LinkGeom]:
    """Return what must keep clear of walls: all but the base."""
    return [geom for geom in links.geoms if geom.link > links.names.index(description.BASE_BODY)]


def region(aperture: jax.Array) -> ClosingRegion:
    """Return the closing region; it begins at the palm, and exists while the fingers are all the way open."""
    start, (depth, width) = -description.palm_to_grasp_point(), CLOSING_REGION_SIZE
    return ClosingRegion(np.array([start, start + depth]), np.full(2, width / 2), aperture > FINGER_OPEN - 1e-3)


def eligibility(bank: HullBank) -> Eligibility:
    """Return which objects fit between the open fingers and into the closing region."""
    return closing_region.eligibility(bank, region(np.float32(FINGER_OPEN)), max_width=MAX_TARGET_WIDTH)  # pyright: ignore[reportArgumentType]


def follow(
    body: Body, joint_pos: jax.Array, poses: jax.Array, apertures: jax.Array, workspace: Workspace
) -> tuple[jax.Array, jax.Array]:
    """Follow poses of the grasp point; see `Robot.follow` and `following.follow`.

    Commands have velocity feed-forward, and are 0 where there is no solution.
    """
    found = following.follow(body, joint_pos[:6], poses, apertures, workspace, dt=CTRL_DT)
    lead = jnp.asarray(description.feed_forward()[:6], jnp.float32)[None]
    controls = jnp.concatenate([found.path + lead * found.velocity, apertures[:, None]], axis=1)
    return controls, first_obstruction(found.holds)


def _homes(links: Links) -> tuple[np.ndarray, np.ndarray]:
    """Return joint positions [8] at the start, rad, and their mirror image in the plane y = 0, in which the start lies.

    The first is the least bent of the solutions that keep clear of the table. In its mirror image shoulder, wrist and
    elbow are on the other side.
    """

    @jax.jit
    def solve(pose: jax.Array) -> jax.Array:
        solutions = kinematics.hand_inverse_kinematics(description.arm(), pose)
        joints = jnp.concatenate([solutions, jnp.full((len(solutions), 2), FINGER_OPEN)], axis=1)
        height = jax.vmap(lambda q: clearance.height_above_table(links, above_table(links), q))(joints)
        clear = height > clearance.CLEARANCE_MARGIN
        branch = jnp.argmin(jnp.where(clear, jnp.linalg.norm(solutions, axis=-1), jnp.inf))
        return joints[jnp.stack([branch, len(solutions) - 1 - branch])]

    home, mirrored_home = np.asarray(solve(_pose(START)), np.float32)
    return home, mirrored_home


def _pose(hand: HandPose) -> np.ndarray:
    """Return the pose [7] of the grasp point of a `HandPose` of host arrays."""
    return np.array([*hand.xy, hand.z, np.cos(hand.yaw / 2), 0.0, 0.0, np.sin(hand.yaw / 2)], np.float32)


def _set_home(mj_model: mujoco.MjModel, data: mujoco.MjData, *, home: np.ndarray) -> None:
    """Put the robot at rest at the start: positions, controls, and forward kinematics of `data`."""
    data.qpos[[mj_model.joint(name).qposadr[0] for name in description.JOINTS]] = home
    for tip, driver in zip(("hand_left_tip", "hand_right_tip"), description.FINGER_JOINTS, strict=True):
        data.joint(tip).qpos[0] = -data.joint(driver).qpos[0]
    data.qvel[mj_model.jnt_dofadr[[mj_model.joint(name).id for name in description.JOINTS]]] = 0.0
    data.ctrl[[mj_model.actuator(name).id for name in description.ACTUATORS]] = home[:7]
    mujoco.mj_forward(mj_model, data)
