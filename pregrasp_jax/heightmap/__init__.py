"""Heightmaps: one rasterizer of convex hulls, two cameras, one network input for training and deployment."""

from pregrasp_jax.heightmap.observation import (
    SEGMENTATION,
    fuse_segmentation,
    network_input,
    object_hulls,
    observe,
    overhead_camera,
    robot_hulls,
    scene_hulls,
)
from pregrasp_jax.heightmap.sensor import Photo, episode_key, photograph, sense
from pregrasp_jax.heightmap.views import (
    Camera,
    HullInstances,
    orthographic,
    pinhole,
    render_pinhole,
    unproject,
)

__all__ = [
    "SEGMENTATION",
    "Camera",
    "HullInstances",
    "Photo",
    "episode_key",
    "fuse_segmentation",
    "network_input",
    "object_hulls",
    "observe",
    "orthographic",
    "overhead_camera",
    "photograph",
    "pinhole",
    "render_pinhole",
    "robot_hulls",
    "scene_hulls",
    "sense",
    "unproject",
]
