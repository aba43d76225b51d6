"""From the state of a scene to what the network reads; the same functions serve training and deployment."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

from pregrasp_jax.assets.hulls import make_hulls
from pregrasp_jax.geometry import transform_planes, transform_points
from pregrasp_jax.heightmap.views import Camera, HullInstances, orthographic, pinhole
from pregrasp_jax.robot.base import Robot
from pregrasp_jax.robot.links import pose_to_matrix
from pregrasp_jax.scene.spec import table_model
from pregrasp_jax.spaces import grid
from pregrasp_jax.spaces.workspace import TABLE, Workspace
from pregrasp_jax.types import (
    FULL_TOPOLOGY,
    ROBOT_ID,
    TABLE_ID,
    HandPose,
    HullBank,
    Hulls,
    Observation,
    PhysicsObservation,
    SceneParams,
)

SEGMENTATION = {"table": 0, "obstacle": 1, "target": 2, "robot": 3}
"""Pixel values of the fused segmentation (Sec. III-B)."""

MIN_STD = 1e-3
"""m; floor of the standard deviation, so that an empty table gives zeros."""


def scene_hulls(
    bank: HullBank, robot: Robot, scene: SceneParams, physics_obs: PhysicsObservation, workspace: Workspace = TABLE
) -> HullInstances:
    """Place the hulls of all objects, robot links and walls in the world.

    Args:
        bank: the objects.
        robot: who moves.
        scene: which object is in which slot (unbatched).
        physics_obs: where objects and joints are now.
        workspace: its walls are drawn with the id of the table.

    Returns:
        K = MAX_OBJECTS * MAX_HULLS + number of robot hulls + number of walls, in this order.
    """
    parts = [
        object_hulls(bank, scene.object_ids, physics_obs.object_poses),
        robot_hulls(robot, physics_obs.joint_pos),
        *([wall_hulls(workspace)] if workspace.walls else []),
    ]
    return jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *parts)


def robot_hulls(robot: Robot, joint_pos: jax.Array) -> HullInstances:
    """Place the hulls of all robot links in the world, for joint positions [J] as in `PhysicsObservation`."""
    links = robot.links
    planes, vertices = _place(jax.tree.map(jnp.asarray, links.hulls), links.poses(joint_pos)[links.hull_links])
    labels, present = jnp.full(len(planes), ROBOT_ID, jnp.uint8), jnp.ones(len(planes), bool)
    return HullInstances(planes=planes, vertices=vertices, labels=labels, present=present)


def wall_hulls(workspace: Workspace) -> HullInstances:
    """Return the walls of a place, at least one."""
    with jax.ensure_compile_time_eval():  # also where a caller is being traced
        hulls = make_hulls([wall.corners() for wall in workspace.walls], FULL_TOPOLOGY)
    count = len(workspace.walls)
    labels, present = jnp.full(count, TABLE_ID, jnp.uint8), jnp.ones(count, bool)
    planes, vertices = (jnp.asarray(rows, jnp.float32) for rows in (hulls.planes, hulls.vertices))
    return HullInstances(planes=planes, vertices=vertices, labels=labels, present=present)


def object_hulls(bank: HullBank, object_ids: jax.Array, poses: jax.Array) -> HullInstances:
    """Place the hulls of objects [N] (index into the bank, -1 for none) at poses [N, 7]; N * MAX_HULLS instances."""
    bank = jax.tree.map(jnp.asarray, bank)
    num_slots, hulls_per_object = object_ids.shape[0], bank.object_hulls.shape[1]
    assert poses.shape == (num_slots, 7), poses.shape
    hull = bank.object_hulls[object_ids]
    present = (hull >= 0) & (object_ids >= 0)[:, None]
    flat = jnp.where(present, hull, 0).ravel()
    planes, vertices = _place(jax.tree.map(lambda leaf: leaf[flat], bank.full), jnp.repeat(poses, hulls_per_object, 0))
    labels = jnp.repeat(jnp.arange(1, num_slots + 1, dtype=jnp.uint8), hulls_per_object)
    return HullInstances(planes=planes, vertices=vertices, labels=labels, present=present.ravel())


def observe(
    hulls: HullInstances,
    hand: HandPose,
    *,
    camera: str | Camera = "orthographic",
    look: Callable[[HullInstances, Camera], tuple[jax.Array, jax.Array]] = pinhole,
) -> Observation:
    """Return what a policy is told: what a camera sees, and where the hand has been sent.

    Args:
        hulls: what stands on the table, robot included (unbatched), from `scene_hulls`.
        hand: commanded end of the last push.
        camera: ``orthographic``, ``pinhole`` for the overhead camera of the MJCF, or a pinhole camera.
        look: what a pinhole camera makes of hulls; `sensor.sense` is another.

    Raises:
        ValueError: another name.
    """
    if isinstance(camera, Camera):
        height, instance_ids = look(hulls, camera)
    elif camera == "pinhole":
        height, instance_ids = look(hulls, overhead_camera())
    elif camera == "orthographic":
        height, instance_ids = orthographic(hulls)
    else:
        raise ValueError(f"camera '{camera}' is unknown; allowed are orthographic, pinhole, or a heightmap.Camera")
    return Observation(height=grid.quantize_height(height), instance_ids=instance_ids, hand=hand)


def overhead_camera() -> Camera:
    """Return the camera ``overhead`` of the MJCF, 640 x 480 pixels."""
    mj_model = table_model()
    camera = mj_model.camera("overhead")
    pose = pose_to_matrix(camera.pos, camera.quat)
    columns, rows = (int(pixels) for pixels in mj_model.cam_resolution[camera.id])
    return Camera(
        position=jnp.asarray(pose[:3, 3], jnp.float32),
        rotation=jnp.asarray(pose[:3, :3], jnp.float32),
        fovy=jnp.asarray(np.deg2rad(camera.fovy.item()), jnp.float32),
        shape=(rows, columns),
    )


def fuse_segmentation(instance_ids: jax.Array, target_slot: jax.Array) -> jax.Array:
    """Return the `SEGMENTATION` [H, W] uint8 of instance ids [H, W] for the object in `target_slot` ()."""
    of_object = jnp.where(instance_ids == target_slot + 1, SEGMENTATION["target"], SEGMENTATION["obstacle"])
    of_thing = jnp.where(instance_ids == ROBOT_ID, SEGMENTATION["robot"], of_object)
    return jnp.where(instance_ids == TABLE_ID, SEGMENTATION["table"], of_thing).astype(jnp.uint8)


def network_input(obs: Observation, target_slot: jax.Array) -> jax.Array:
    """Return what the network reads, for one observation and any object as the target.

    Args:
        obs: the observation (unbatched).
        target_slot: () int32.

    Returns:
        [H, W, 2] float32: height minus its mean over its standard deviation (floor 1 mm), and segmentation / 3.

    Source:
        Sec. III-B of the paper.
    """
    assert obs.height.shape == obs.instance_ids.shape and obs.height.ndim == 2, obs.height.shape
    height = grid.dequantize_height(obs.height)
    normalized = (height - height.mean()) / jnp.maximum(height.std(), MIN_STD)
    segmentation = fuse_segmentation(obs.instance_ids, target_slot).astype(jnp.float32)
    return jnp.stack([normalized, segmentation / max(SEGMENTATION.values())], axis=-1)


def _place(hulls: Hulls, poses: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Return the world planes and vertices of K hulls at K poses."""
    return jax.vmap(transform_planes)(poses, hulls.planes), jax.vmap(transform_points)(poses, hulls.vertices)
