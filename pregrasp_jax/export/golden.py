"""States with their right answers, so that `verify` can tell whether a file still does what it should.

Packed scenes of built-in objects with the hand at the start or anywhere in reach, seen through the overhead camera.
Depth is stored in steps of 0.1 mm, masks as an image of instance ids.
"""

import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from pregrasp_jax import heightmap
from pregrasp_jax.assets.catalogue import builtin_bank
from pregrasp_jax.config import SceneConfig
from pregrasp_jax.export.stablehlo import policy_function
from pregrasp_jax.heightmap.views import project_upward
from pregrasp_jax.learning.learner import greedy_action
from pregrasp_jax.learning.q_function import QFunction
from pregrasp_jax.robot.base import Robot
from pregrasp_jax.scene import bank as scene_bank
from pregrasp_jax.spaces import grid
from pregrasp_jax.spaces.workspace import Workspace
from pregrasp_jax.task.primitive import Primitive
from pregrasp_jax.types import ROBOT_ID, HandPose, PhysicsObservation, SceneParams

DEPTH_SCALE = 1e-4
"""m per step of a stored depth image."""

NUM_IMAGES = 2
"""States that are stored as camera images too."""

_ROWS = 2
"""Control rows of a hand that stands still."""


class View(NamedTuple):
    """A state as a camera sees it.

    Attributes:
        depth: [480, 640] uint16 in steps of `DEPTH_SCALE`.
        instances: [480, 640] uint8, as the sensor would give masks: the robot has none.
        joint_pos: [J] rad or m.
        height: [H, W] float32 m, what the package makes of it.
        ids: [H, W] uint8.
        target: slot.
        hand: where it has been sent.
    """

    depth: np.ndarray
    instances: np.ndarray
    joint_pos: np.ndarray
    height: np.ndarray
    ids: np.ndarray
    target: int
    hand: HandPose


def make_views(robot: Robot, workspace: Workspace, primitive: Primitive, *, count: int) -> list[View]:
    """Return so many states: the first half with the hand at the start, the others with it inside the half ring."""
    bank = builtin_bank("seen")
    eligible = robot.eligibility(bank).eligible
    scenes = scene_bank.load_or_build(bank, eligible, SceneConfig(test_scenes=max(count, 2)), "test")
    start = jax.tree.map(jnp.asarray, robot.start)
    rng = np.random.default_rng(0)
    allowed = np.flatnonzero(np.asarray(primitive.mask(start)).any(axis=-1))
    see = jax.jit(lambda scene, seen: _see(bank, robot, workspace, scene, seen))
    stand = jax.jit(functools.partial(_stand_at, robot, workspace))
    pose_of = jax.jit(robot.hand_pose)
    views = []
    for index in range(count):
        hand, joints = start, robot.home
        if index >= (count + 1) // 2:
            row, col = divmod(int(rng.choice(allowed)), grid.GRID_SIZE)
            moved = start.replace(xy=jnp.asarray(grid.cell_to_world(np.int32(row), np.int32(col)), jnp.float32))
            hand, joints = moved, np.array(robot.home)
            driven = min(len(robot.actuators), len(joints))
            joints[:driven] = np.asarray(stand(moved))[:driven]
        scene = SceneParams(*(jnp.asarray(x[index]) for x in (scenes.object_ids, scenes.poses, scenes.target)))
        nothing = {"diverged": jnp.bool_(False), "overflows": jnp.int32(0)}
        pose = pose_of(jnp.asarray(joints))
        seen = PhysicsObservation(scene.poses, jnp.asarray(joints), pose, **nothing)
        depth, instances, height, ids = jax.device_get(see(scene, seen))
        target, sent = int(scenes.target[index]), jax.device_get(hand)
        views.append(View(depth, instances, np.asarray(joints), height, ids, target, sent))
    return views


def make_golden(views: list[View], q_function: QFunction, params: Any, primitive: Primitive) -> dict[str, np.ndarray]:
    """Return the arrays of golden.npz for a policy."""
    segmentation = [np.asarray(heightmap.fuse_segmentation(jnp.asarray(v.ids), jnp.int32(v.target))) for v in views]
    inputs = {
        "height_m": np.stack([view.height for view in views]),
        "labels": np.stack(segmentation),
        "p1_m": np.stack([view.hand.xy for view in views]).astype(np.float32),
    }
    q = np.asarray(jax.jit(policy_function(q_function, params))(**{k: jnp.asarray(v) for k, v in inputs.items()}))
    masks = np.stack([np.asarray(primitive.mask(jax.tree.map(jnp.asarray, view.hand))) for view in views])
    actions = np.array([int(greedy_action(jnp.asarray(q[i]), jnp.asarray(masks[i]))) for i in range(len(views))])
    strokes = [primitive.decode(view.hand, jnp.int32(action)) for view, action in zip(views, actions, strict=True)]
    camera, shown = heightmap.overhead_camera(), views[-NUM_IMAGES:]
    return {
        **inputs,
        "q": q,
        "action": actions,
        "push": np.array([[*s.end.xy, s.end.z, s.end.yaw, s.end.aperture] for s in strokes], np.float32),
        "depth": np.stack([view.depth for view in shown]),
        "depth_scale": np.array(DEPTH_SCALE),
        "instances": np.stack([view.instances for view in shown]),
        "target_id": np.array([view.target + 1 for view in shown]),
        "joint_pos": np.stack([view.joint_pos for view in shown]),
        "focal_px": np.array(float(camera.focal)),
        "camera_position_m": np.asarray(camera.position),
        "camera_rotation": np.asarray(camera.rotation),
        "seen_height_m": np.stack([view.height for view in shown]),
        "seen_labels": np.stack(segmentation[-NUM_IMAGES:]),
    }


def _see(bank: Any, robot: Robot, workspace: Workspace, scene: SceneParams, seen: PhysicsObservation) -> tuple:
    """Return depth in steps, instances without the robot, and what the package projects from just that."""
    camera = heightmap.overhead_camera()
    hulls = heightmap.scene_hulls(bank, robot, scene, seen, workspace)
    depth, labels = heightmap.render_pinhole(hulls, camera)
    steps = jnp.round(depth / DEPTH_SCALE)
    exact = labels == ROBOT_ID
    # The runtime draws the robot from its joints; what else it knows of depth are these steps.
    told = jnp.where(exact, depth, steps * DEPTH_SCALE)
    height, ids = project_upward(heightmap.unproject(told, camera), labels)
    return steps.astype(jnp.uint16), jnp.where(exact, 0, labels).astype(jnp.uint8), height, ids


def _stand_at(robot: Robot, workspace: Workspace, hand: HandPose) -> jax.Array:
    """Return the controls [A] that hold the hand at a pose."""
    pose = jnp.array([*hand.xy, hand.z, jnp.cos(hand.yaw / 2), 0.0, 0.0, jnp.sin(hand.yaw / 2)])
    still = jnp.tile(pose[None], (_ROWS, 1))
    controls, _ = robot.follow(jnp.asarray(robot.home), still, jnp.full(_ROWS, hand.aperture), workspace)
    return controls[0]
