"""Poses as controllers and calibrations write them: rotation vectors, quaternions in both orders, files."""

import dataclasses
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from pregrasp_jax import yaml_file
from pregrasp_jax.deploy.camera import refuse_pose
from pregrasp_jax.geometry import quat_to_matrix
from pregrasp_jax.messages import one_line
from pregrasp_jax.robot import kinematics
from pregrasp_jax.robot.following import Body
from pregrasp_jax.robot.kinematics import Arm

_HALF_TURN = np.diag([-1.0, -1.0, 1.0, 1.0])
"""ROS `base_link` in the controller's `base`."""


def rotation_vector(turn: np.ndarray) -> np.ndarray:
    """Return the rotation vector [3] rad, at most pi long, of a rotation [3, 3]."""
    cosine = np.clip((np.trace(turn) - 1) / 2, -1.0, 1.0)
    angle = float(np.arccos(cosine))
    axis = np.array([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]])
    if angle < 1e-7:
        return axis / 2
    if np.pi - angle < 1e-4:  # the axis is the column of R + 1 that is longest
        column = (turn + np.eye(3))[:, np.diagonal(turn).argmax()]
        column = column / np.linalg.norm(column)
        return angle * column * (np.sign(axis @ column) or 1.0)
    return angle * axis / (2 * np.sin(angle))


def matrix_of_vector(vector: np.ndarray) -> np.ndarray:
    """Return the rotation [3, 3] of a rotation vector [3] rad."""
    angle = float(np.linalg.norm(vector))
    axis = vector / angle if angle > 0 else np.array([0.0, 0.0, 1.0])
    return quat_to_matrix(np.array([np.cos(angle / 2), *np.sin(angle / 2) * axis]))


def angle_between(a: np.ndarray, b: np.ndarray) -> float:
    """Return the angle, rad, by which two rotation vectors [3] differ."""
    return float(np.linalg.norm(rotation_vector(matrix_of_vector(a).T @ matrix_of_vector(b))))


def tcp_pose(arm: Arm, hand_pose: np.ndarray) -> np.ndarray:
    """Return the tool pose [6] (m, rotation vector) in the base frame that puts the grasp point at a pose [7].

    The tool centre point is the grasp point, turned as the flange is.
    """
    flange = kinematics.flange_from_hand_pose(arm, np.asarray(hand_pose, float))
    place = flange[:3, :3] @ arm.flange_from_hand[:3, 3] + flange[:3, 3]
    return np.concatenate([place, rotation_vector(flange[:3, :3])])


def grasp_point(arm: Arm, pose: np.ndarray) -> np.ndarray:
    """Return where the grasp point is, [3] m in the table frame, for a tool pose [6] in the base frame."""
    return arm.world_from_base[:3, :3] @ pose[:3] + arm.world_from_base[:3, 3]


def on_table(body: Body, height_m: float) -> Body:
    """Return a robot whose base stands so far below the table's top, m; the policy knows tables level with the base."""
    shift = np.eye(4)
    shift[2, 3] = -height_m
    root = body.links.parents < 0
    fixed = np.where(root[:, None, None], shift @ body.links.fixed, body.links.fixed)
    return dataclasses.replace(
        body,
        arm=dataclasses.replace(body.arm, world_from_base=shift @ body.arm.world_from_base),
        links=dataclasses.replace(body.links, fixed=fixed),
    )


def world_from(parent: str, arm: Arm) -> np.ndarray:
    """Return the pose [4, 4] in the table frame of what a calibration is given in: base, base_link or table."""
    if parent == "table":
        return np.eye(4)
    return arm.world_from_base if parent == "base" else arm.world_from_base @ _HALF_TURN


def read_pose(path: Path) -> np.ndarray:
    """Return the matrix [4, 4] of a calibration file: easy_handeye2 in both forms, or a 4 x 4 in .npy, .json, .txt.

    Raises:
        ValueError: none of these, or no rigid motion.
    """
    wanted = "allowed are easy_handeye2's .yaml and .calib files, and a 4 x 4 matrix in .npy, .json or .txt"
    if path.suffix in (".yaml", ".yml", ".calib"):
        matrix = _of_handeye(yaml_file.read(path), path, wanted)
    else:
        readers = {".npy": lambda: np.load(path, allow_pickle=False), ".txt": lambda: np.loadtxt(path)}
        readers[".json"] = lambda: np.array(json.loads(path.read_text()), float)
        if path.suffix not in readers:
            raise ValueError(f"{path}: {wanted}")
        try:
            matrix = np.asarray(readers[path.suffix](), float)
        except Exception as error:  # whatever is wrong with the file: zipfile has errors of its own
            raise ValueError(f"{path} cannot be read ({one_line(error)}); {wanted}") from None
    refuse_pose(matrix, what=f"{path}: the pose")
    return matrix


def _of_handeye(values: Any, path: Path, wanted: str) -> np.ndarray:
    if not isinstance(values, Mapping):
        raise ValueError(f"{path} is not a calibration; {wanted}")
    parameters = values.get("parameters")
    kind = parameters.get("calibration_type", "") if isinstance(parameters, Mapping) else ""
    if kind == "eye_in_hand" or (isinstance(parameters, Mapping) and parameters.get("eye_on_hand") is True):
        raise ValueError(f"{path} is of a camera on the hand; allowed is one that stands still (eye on base)")
    try:
        if "transformation" in values:
            given = values["transformation"]
            place = [given[key] for key in "xyz"]
            quat = [given[f"q{key}"] for key in "wxyz"]
        else:
            given = values["transform"]
            place = [given["translation"][key] for key in "xyz"]
            quat = [given["rotation"][key] for key in "wxyz"]
        quat, place = np.array(quat, float), np.array(place, float)
    except (KeyError, TypeError, ValueError) as error:
        raise ValueError(f"{path} is not a calibration ({error} is missing or no number); {wanted}") from None
    if not np.isfinite(quat).all() or abs(np.linalg.norm(quat) - 1) > 1e-3:
        raise ValueError(f"{path}: the quaternion has length {np.linalg.norm(quat):.4f}; allowed is 1 within 0.001")
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = quat_to_matrix(quat / np.linalg.norm(quat)), place
    return matrix
