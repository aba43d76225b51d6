"""The camera images of a bundle's golden states, and how well the runtime turns them into maps."""

import numpy as np

from pregrasp_jax.deploy.bundle import Bundle
from pregrasp_jax.deploy.camera import centred_camera, depth_in_metres
from pregrasp_jax.deploy.contract import ROBOT
from pregrasp_jax.deploy.masks import label_image
from pregrasp_jax.deploy.projection import project
from pregrasp_jax.deploy.view import View, make_view
from pregrasp_jax.robot.robot_file import from_arrays


def golden_view(golden: dict[str, np.ndarray]) -> View:
    """Return the view of the golden images."""
    rows, columns = golden["depth"].shape[1:]
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = golden["camera_rotation"], golden["camera_position_m"]
    return make_view(centred_camera(focal_px=float(golden["focal_px"]), shape=(rows, columns), pose=pose))


def heightmap_agreement(bundle: Bundle, golden: dict[str, np.ndarray]) -> tuple[float, float]:
    """Return the share of cells whose height is within 1 mm of the package's, and of those with its label."""
    view, body, entry = golden_view(golden), from_arrays(bundle.arrays(ROBOT)), bundle.contract.grid
    near, same = [], []
    for index in range(len(golden["depth"])):
        scale, shape = float(golden["depth_scale"]), view.camera.shape
        depth = depth_in_metres(golden["depth"][index], scale=scale, shape=shape)
        labels = label_image(golden["instances"][index], int(golden["target_id"][index]), entry.labels)
        joints = golden["joint_pos"][index]
        maps = project(depth, labels, view=view, body=body, joint_pos=joints, entry=entry)
        near.append((np.abs(maps.height_m - golden["seen_height_m"][index]) <= 1e-3).mean())
        same.append((maps.labels == golden["seen_labels"][index]).mean())
    return float(np.mean(near)), float(np.mean(same))
