"""Poses of a tool, calibrations in every form, and the files that describe a cell."""

import re
from pathlib import Path

import numpy as np
import pytest
import yaml
from bundles import push_to, small_decider
from scipy.spatial.transform import Rotation

from pregrasp_jax.deploy.cell import camera_of, read_cell
from pregrasp_jax.deploy.decision import Decider
from pregrasp_jax.deploy.poses import (
    angle_between,
    grasp_point,
    matrix_of_vector,
    on_table,
    read_pose,
    rotation_vector,
    tcp_pose,
)
from pregrasp_jax.robot import kinematics


@pytest.fixture
def decider() -> Decider:
    return small_decider()


def test_rotation_vectors_are_those_of_scipy():
    turns = Rotation.random(50, rng=np.random.default_rng(0)).as_matrix()
    half = Rotation.from_rotvec(np.pi * np.eye(3)).as_matrix()
    for turn in [*turns, *half, np.eye(3)]:
        vector = rotation_vector(turn)
        np.testing.assert_allclose(Rotation.from_rotvec(vector).as_matrix(), turn, atol=1e-6)
        np.testing.assert_allclose(matrix_of_vector(vector), turn, atol=1e-6)
        expected = Rotation.from_matrix(turn.T @ turns[0]).magnitude()
        assert angle_between(vector, rotation_vector(turns[0])) == pytest.approx(expected, abs=1e-5)


def test_the_tool_pose_brings_the_grasp_point_where_it_was_sent(decider: Decider):
    arm, push = decider.body.arm, push_to(decider)
    pose = tcp_pose(arm, push.poses[-1])
    np.testing.assert_allclose(grasp_point(arm, pose), push.poses[-1, :3], atol=1e-6)
    flange = kinematics.forward_kinematics(arm, push.joints[-1])[-1]  # another way to the same pose
    np.testing.assert_allclose(matrix_of_vector(pose[3:]), flange[:3, :3], atol=1e-5)
    np.testing.assert_allclose(pose[:3], flange[:3, :3] @ [0, 0, 0.172] + flange[:3, 3], atol=1e-5)
    base = pose[:3]
    np.testing.assert_allclose([-0.75 - base[0], -base[1], base[2]], push.poses[-1, :3], atol=1e-6)


def test_a_robot_below_the_table_reaches_as_far_up(decider: Decider):
    body, push = on_table(decider.body, 0.05), push_to(decider)
    solutions = kinematics.hand_inverse_kinematics(body.arm, push.poses[-1])
    joints = solutions[~np.isnan(solutions).any(axis=1)][0]
    np.testing.assert_allclose(kinematics.grasp_pose(body.arm, joints)[:3], push.poses[-1, :3], atol=1e-5)
    links = body.links.matrices(np.concatenate([joints, [0, 0]]))
    assert links[0, 2, 3] == pytest.approx(-0.05), "it is drawn lower too"


QUAT = [0.0, 1.0, 0.0, 0.0]  # x, y, z, w; half a turn about y: looking down
OLD = {
    "parameters": {"name": "cell", "calibration_type": "eye_on_base", "robot_base_frame": "base"},
    "transformation": {"x": 0.75, "y": 0.0, "z": 1.0, "qx": 0.0, "qy": 1.0, "qz": 0.0, "qw": 0.0},
}
NEW = {
    "parameters": {"name": "cell", "calibration_type": "eye_on_base"},
    "transform": {
        "translation": {"x": 0.75, "y": 0.0, "z": 1.0},
        "rotation": {"x": 0.0, "y": 1.0, "z": 0.0, "w": 0.0},
    },
}
MATRIX = np.array([[-1.0, 0, 0, 0.75], [0, 1, 0, 0], [0, 0, -1, 1.0], [0, 0, 0, 1]])


def test_calibrations_in_every_form_are_the_same(tmp_path: Path):
    (tmp_path / "old.yaml").write_text(yaml.safe_dump(OLD))
    (tmp_path / "new.calib").write_text(yaml.safe_dump(NEW))
    np.save(tmp_path / "m.npy", MATRIX)
    np.savetxt(tmp_path / "m.txt", MATRIX)
    (tmp_path / "m.json").write_text(str(MATRIX.tolist()))
    for name in ("old.yaml", "new.calib", "m.npy", "m.txt", "m.json"):
        np.testing.assert_allclose(read_pose(tmp_path / name), MATRIX, atol=1e-12, err_msg=name)


def test_calibrations_that_cannot_be_are_refused(tmp_path: Path):
    path = tmp_path / "c.yaml"
    on_hand = {**OLD, "parameters": {"calibration_type": "eye_in_hand"}}
    long = {**OLD, "transformation": {**OLD["transformation"], "qw": 1.0}}
    short = {**OLD, "transformation": {"x": 1}}
    for values, said in (
        (on_hand, "camera on the hand"),
        (long, "quaternion has length"),
        (short, "is not a calibration"),
        ([1, 2], "is not a calibration"),
        ({"a": 1}, "is not a calibration"),
    ):
        path.write_text(yaml.safe_dump(values))
        with pytest.raises(ValueError, match=said):
            read_pose(path)
    np.save(tmp_path / "bad.npy", 2 * MATRIX)
    with pytest.raises(ValueError, match="no rotation"):
        read_pose(tmp_path / "bad.npy")
    with pytest.raises(ValueError, match="allowed are easy_handeye2's"):
        read_pose(tmp_path / "pose.docx")
    (tmp_path / "cut.npy").write_bytes(b"PK\x03\x04 and no more")
    with pytest.raises(ValueError, match=r"cut\.npy cannot be read"):
        read_pose(tmp_path / "cut.npy")


def cell_file(folder: Path, text: str) -> Path:
    path = folder / "cell.yaml"
    path.write_text(text)
    return path


def test_the_frames_of_a_calibration_agree(tmp_path: Path, decider: Decider):
    intrinsics = "intrinsics: [[617, 0, 319.5], [0, 617, 239.5], [0, 0, 1]]"
    poses = []
    for parent, frame, rows in (
        ("base", "optical", "[[-1,0,0,-0.75],[0,1,0,0],[0,0,-1,1],[0,0,0,1]]"),
        ("base_link", "optical", "[[1,0,0,0.75],[0,-1,0,0],[0,0,-1,1],[0,0,0,1]]"),
        ("table", "optical", "[[1,0,0,0],[0,-1,0,0],[0,0,-1,1],[0,0,0,1]]"),
        ("table", "mujoco", "[[1,0,0,0],[0,1,0,0],[0,0,1,1],[0,0,0,1]]"),
    ):
        text = f"camera:\n  {intrinsics}\n  parent: {parent}\n  frame: {frame}\n  extrinsics: {rows}\n"
        cell = read_cell(cell_file(tmp_path, text))
        poses.append(camera_of(cell.camera, decider.body.arm, tmp_path).world_from_optical)
    for pose in poses:
        np.testing.assert_allclose(pose, poses[-1], atol=1e-6)


def test_a_camera_info_is_read(tmp_path: Path, decider: Decider):
    info = {"width": 640, "height": 480, "k": [617.0, 0, 319.5, 0, 617.0, 239.5, 0, 0, 1], "d": [-0.05, 0.06, 0, 0, 0]}
    (tmp_path / "info.yaml").write_text(yaml.safe_dump(info))
    np.save(tmp_path / "m.npy", MATRIX)
    cell = read_cell(
        cell_file(tmp_path, "camera:\n  intrinsics: info.yaml\n  extrinsics: m.npy\n  parent: base_link\n")
    )
    camera = camera_of(cell.camera, decider.body.arm, tmp_path)
    assert camera.shape == (480, 640) and camera.distortion[:2] == (-0.05, 0.06) and camera.matrix[0, 0] == 617
    printed = "header: {frame_id: c}\n" + yaml.safe_dump({**info, "distortion_model": "plumb_bob"}) + "---\n"
    calibrated = {
        "image_width": 640,
        "image_height": 480,
        "camera_name": "c",
        "camera_matrix": {"rows": 3, "cols": 3, "data": info["k"]},
        "distortion_model": "plumb_bob",
        "distortion_coefficients": {"rows": 1, "cols": 5, "data": info["d"]},
    }
    for text in (printed, yaml.safe_dump(calibrated)):
        (tmp_path / "info.yaml").write_text(text)
        again = camera_of(cell.camera, decider.body.arm, tmp_path)
        assert again.shape == camera.shape and again.distortion == camera.distortion
        np.testing.assert_array_equal(again.matrix, camera.matrix)


@pytest.mark.parametrize(
    ("camera", "said"),
    [
        ({}, "distortion_model is equidistant; allowed is plumb_bob, so rectify the images before"),
        ({"width": 320}, "camera.width is what info.yaml says; allowed is to leave it out"),
        ({"intrinsics": np.eye(3).tolist(), "extrinsics": [[1.0, 0.0], [0.0]]}, "has rows of [2, 1] numbers"),
    ],
)
def test_cameras_that_are_not_what_they_say_are_refused(camera: dict, said: str, tmp_path: Path, decider: Decider):
    info = {"width": 640, "height": 480, "k": [617.0, 0, 319.5, 0, 617.0, 239.5, 0, 0, 1], "d": [0.1, 0, 0, 0]}
    (tmp_path / "info.yaml").write_text(yaml.safe_dump({**info, "distortion_model": "equidistant"}))
    np.save(tmp_path / "m.npy", MATRIX)
    given = {"intrinsics": "info.yaml", "extrinsics": "m.npy", **camera}
    cell = read_cell(cell_file(tmp_path, yaml.safe_dump({"camera": given})))
    with pytest.raises(ValueError, match=re.escape(said)):
        camera_of(cell.camera, decider.body.arm, tmp_path)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("robots: {}", "unknown config key robots"),
        ("robot:\n  limits:\n    speed_m_s: 2.0", "robot.limits.speed_m_s = 2.0 is out of range"),
        ("robot:\n  speed_m_s: 0.3", "robot.speed_m_s = 0.3 is out of range"),
        ("gripper:\n  force_n: 90", "gripper.force_n = 90.0 is out of range"),
        ("camera:\n  frame: ros", "camera.frame = 'ros' is unknown"),
        ("camera:\n  extrinsics: [[1, 2], [a]]", "extrinsics"),
        ("table: 3", "must be a mapping"),
        ("[1, 2", "line 1"),
    ],
)
def test_cells_that_cannot_be_are_refused_in_one_line(tmp_path: Path, text: str, said: str):
    with pytest.raises(ValueError) as stopped:
        read_cell(cell_file(tmp_path, text))
    assert said in str(stopped.value) and str(tmp_path) in str(stopped.value) and "\n" not in str(stopped.value)
