"""What a real depth camera and a real segmentation do to the pinhole image, and how that becomes a heightmap.

Every effect has its switch, and one seed per episode decides all of them: two policies, or two sensors, meet the same
noise on the same scene. The robot's own pixels stay exact, because a deployed policy draws the robot from its joints.
"""

import math
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp

from pregrasp_jax.geometry import quat_to_matrix
from pregrasp_jax.heightmap.views import Camera, HullInstances, project_upward, render_pinhole, unproject
from pregrasp_jax.sensors import Sensor
from pregrasp_jax.types import MAX_OBJECTS, ROBOT_ID, TABLE_ID

_EDGE = 0.02
"""m; neighbours farther apart than this in depth are an edge, where pixels fly."""


def sense(
    sensor: Sensor,
    hulls: HullInstances,
    camera: Camera,
    *,
    episode: jax.Array,
    num_pushes: jax.Array,
    target: jax.Array,
) -> tuple[jax.Array, jax.Array]:
    """Look through the pinhole as a real sensor does; see `views.pinhole`, which is that of an exact one.

    Args:
        sensor: which effects.
        hulls: what stands on the table, robot included (unbatched).
        camera: where the calibration has it.
        episode: key of the episode.
        num_pushes: () int32; every image has noise of its own.
        target: () int32 slot, whose mask is never overlooked.

    Returns:
        height [H, W] float32 m and instance ids [H, W] uint8.
    """
    rows, columns = camera.shape
    border = max(columns - rows, 0) // 2
    camera = camera.replace(shape=(rows, columns - 2 * border))  # the workspace is a square in the middle
    photo = photograph(sensor, hulls, camera, episode=episode, num_pushes=num_pushes, target=target, border=border)
    robot = photo.labels == ROBOT_ID
    # The robot is drawn where its joints say that it is, whatever the calibration.
    seen = jnp.where(robot[..., None], unproject(photo.exact, photo.actual), unproject(photo.depth, camera))
    return project_upward(seen, photo.labels, robot | jnp.isfinite(photo.depth), cell=sensor.cell)


class Photo(NamedTuple):
    """What a camera gives, and what it does not know.

    Attributes:
        depth: [rows, columns] float32 m; NaN where there is none.
        labels: [rows, columns] uint8 instance ids, as a segmentation would give them; the robot's own are exact.
        exact: [rows, columns] float32 m, the depth without any error.
        actual: where the camera really is.
    """

    depth: jax.Array
    labels: jax.Array
    exact: jax.Array
    actual: Camera


def photograph(
    sensor: Sensor,
    hulls: HullInstances,
    camera: Camera,
    *,
    episode: jax.Array,
    num_pushes: jax.Array,
    target: jax.Array,
    border: int = 0,
) -> Photo:
    """Return the image that a sensor takes; see `sense`, of whose camera `border` columns are cut off on each side."""
    pose_key, image_key = jax.random.split(episode)
    stereo_key, block_key, mask_key = jax.random.split(jax.random.fold_in(image_key, num_pushes), 3)
    actual = _displaced(camera, sensor, pose_key)
    exact, labels = render_pinhole(hulls, actual)
    depth = _measured(exact, sensor, camera, stereo_key, block_key, border=border)
    return Photo(depth, _masks(labels, hulls, sensor, mask_key, target), exact, actual)


def episode_key(sensor: Sensor, poses: jax.Array, target: jax.Array) -> jax.Array:
    """Return the key of the episode that starts with objects at `poses` [N, 7] and a target () int32.

    It follows from the scene, so that nothing else need be carried along, and the same scene has the same noise: of
    places only whole millimetres count, which do not depend on the program that has computed them.
    """
    places = jnp.round(poses[:, :2] * 1000).astype(jnp.int32).astype(jnp.uint32).ravel()
    factors = 2 * jnp.arange(len(places), dtype=jnp.uint32) + jnp.uint32(0x9E3779B1)
    mixed = jnp.sum(places * factors, dtype=jnp.uint32)
    return jax.random.fold_in(jax.random.fold_in(jax.random.key(sensor.seed), mixed), target)


def _displaced(camera: Camera, sensor: Sensor, key: jax.Array) -> Camera:
    """Return where the camera really is."""
    if sensor.pose_m == sensor.pose_deg == 0:
        return camera
    shift, turn = jax.random.normal(key, (2, 3)) * jnp.array([[sensor.pose_m], [math.radians(sensor.pose_deg)]])
    quat = jnp.append(1.0, turn / 2)  # good to a hundredth of a turn of some degrees
    rotation = quat_to_matrix(quat / jnp.linalg.norm(quat))
    turned = jnp.matmul(rotation, camera.rotation, precision="highest")
    return camera.replace(position=camera.position + shift, rotation=turned)


def _measured(
    depth: jax.Array, sensor: Sensor, camera: Camera, stereo_key: jax.Array, block_key: jax.Array, *, border: int
) -> jax.Array:
    """Return what a sensor tells of a depth image [rows, columns] m; NaN where it tells nothing.

    `border` pixels of the image have been cut off on the left.
    """
    hole = jnp.zeros(depth.shape, bool)
    if sensor.shadow and sensor.baseline > 0:
        hole |= ~_seen_by_both(depth, camera.focal * sensor.baseline, border)
    if sensor.speckle > 0 or sensor.flying > 0:
        drawn = _blocks(block_key, depth.shape, sensor.correlation, jax.random.uniform)
        hole |= drawn < sensor.speckle
        depth = _with_flying(depth, sensor.flying, 1 - drawn) if sensor.flying > 0 else depth
    if sensor.baseline > 0 and sensor.subpixel > 0:
        error = _blocks(stereo_key, depth.shape, sensor.correlation, jax.random.normal)
        depth = depth + error * depth**2 * (sensor.subpixel / (sensor.focal * sensor.baseline))
    if sensor.quantum > 0:
        depth = jnp.round(depth / sensor.quantum) * sensor.quantum
    return jnp.where(hole, jnp.nan, depth)


def _seen_by_both(depth: jax.Array, focal_baseline: jax.Array, border: int) -> jax.Array:
    """Return which pixels [rows, columns] bool the imager to the right sees as well: no nearer one comes before them.

    A pixel of column u lies at u - f B / z in the other image; what is farther right here must be farther right there.
    """
    other = border + jnp.arange(depth.shape[1], dtype=jnp.float32)[None] - focal_baseline / depth
    following = jax.lax.cummin(other, axis=1, reverse=True)
    return (other >= 0) & (other < jnp.pad(following[:, 1:], ((0, 0), (0, 1)), constant_values=jnp.inf))


def _with_flying(depth: jax.Array, share: float, drawn: jax.Array) -> jax.Array:
    """Move a share of the pixels left and right of an edge, those `drawn` below it, to anywhere between its sides."""
    padded = jnp.pad(depth, ((0, 0), (1, 1)), mode="edge")
    for beside in (padded[:, :-2], padded[:, 2:]):
        flies = (jnp.abs(beside - depth) > _EDGE) & (drawn < share)
        depth = jnp.where(flies, depth + (drawn / share) * (beside - depth), depth)
    return depth


def _blocks(key: jax.Array, shape: tuple[int, ...], side: int, draw: Callable[..., jax.Array]) -> jax.Array:
    """Return a draw for every block of side x side pixels, [rows, columns]."""
    rows, cols = (-(-length // side) for length in shape)
    fine = jnp.broadcast_to(draw(key, (rows, 1, cols, 1)), (rows, side, cols, side))
    return fine.reshape(rows * side, cols * side)[: shape[0], : shape[1]]


def _masks(labels: jax.Array, hulls: HullInstances, sensor: Sensor, key: jax.Array, target: jax.Array) -> jax.Array:
    """Return the labels [rows, columns] uint8 that a segmentation would give."""
    drop_key, merge_key, choose_key = jax.random.split(key, 3)
    slots = jnp.arange(MAX_OBJECTS)
    renamed = jnp.arange(ROBOT_ID + 1, dtype=jnp.uint8)
    if sensor.merge > 0:
        first, second = _neighbours(hulls, choose_key)
        kept = jnp.where(second == target, second, first)
        lost = jnp.where(second == target, first, second)
        merged = (jax.random.uniform(merge_key) < sensor.merge) & (kept != lost)
        renamed = renamed.at[lost + 1].set(jnp.where(merged, kept + 1, lost + 1).astype(jnp.uint8))
    if sensor.drop > 0:
        dropped = (jax.random.uniform(drop_key, (MAX_OBJECTS,)) < sensor.drop) & (slots != target)
        renamed = jnp.where(jnp.pad(dropped, (1, 1))[renamed], jnp.uint8(TABLE_ID), renamed)
    if sensor.merge > 0 or sensor.drop > 0:
        labels = renamed[labels]
    for _ in range(sensor.erode):
        same = jnp.stack([labels == beside for beside in _around(labels)]).all(axis=0)
        labels = jnp.where(same | (labels == ROBOT_ID), labels, jnp.uint8(TABLE_ID))
    for _ in range(sensor.dilate):
        beside = jnp.stack(_around(jnp.where(labels == ROBOT_ID, jnp.uint8(TABLE_ID), labels))).max(axis=0)
        labels = jnp.where(labels == TABLE_ID, beside, labels)
    return labels


def _around(image: jax.Array) -> list[jax.Array]:
    """Return what lies above, below, left and right of every pixel; the border is its own neighbour."""
    padded = jnp.pad(image, 1, mode="edge")
    return [padded[:-2, 1:-1], padded[2:, 1:-1], padded[1:-1, :-2], padded[1:-1, 2:]]


def _neighbours(hulls: HullInstances, key: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Return the slots of a random object and of the one nearest to it; the same slot twice where there is none."""
    slot = hulls.labels.astype(jnp.int32) - 1
    counted = hulls.present & (slot >= 0) & (slot < MAX_OBJECTS)
    centre = hulls.vertices.mean(axis=1)
    places = jnp.where(counted, slot, MAX_OBJECTS)
    count = jnp.zeros(MAX_OBJECTS + 1).at[places].add(1.0)[:-1]
    total = jnp.zeros((MAX_OBJECTS + 1, 2)).at[places].add(jnp.where(counted[:, None], centre[:, :2], 0.0))[:-1]
    middle = total / jnp.maximum(count, 1.0)[:, None]
    present = count > 0
    first = jax.random.categorical(key, jnp.where(present, 0.0, -jnp.inf))
    distance = jnp.linalg.norm(middle - middle[first][None], axis=-1)
    others = present & (jnp.arange(MAX_OBJECTS) != first)
    second = jnp.argmin(jnp.where(others, distance, jnp.inf))
    return first, jnp.where(others.any(), second, first)
