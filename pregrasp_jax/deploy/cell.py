"""cell.yaml: everything about a cell that the bundle cannot know. Unknown keys are errors; paths count from it."""

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from pregrasp_jax import yaml_file
from pregrasp_jax.deploy.camera import PinholeCamera, optical_from, refuse_pose
from pregrasp_jax.deploy.guard import Limits
from pregrasp_jax.deploy.masks import Target
from pregrasp_jax.deploy.poses import read_pose, world_from
from pregrasp_jax.robot.kinematics import Arm
from pregrasp_jax.sensors import PointOfCell
from pregrasp_jax.settings import from_dict

Rows = tuple[tuple[float, ...], ...]

_LENS = "plumb_bob"
"""What ROS calls Brown's model of a lens, which is `PinholeCamera`'s."""


@dataclass(frozen=True, kw_only=True)
class CameraSettings:
    """The depth camera."""

    intrinsics: Rows | str | None = None
    """K as three rows, or a ROS CameraInfo as YAML (k, d, width, height). `--arm sim` has the contract's camera
    and needs neither."""
    width: int = 640
    height: int = 480
    distortion: tuple[float, ...] = (0.0, 0.0, 0.0, 0.0, 0.0)
    """k1, k2, p1, p2, k3."""
    depth_scale: float | None = None
    """m per step; None is 1 for floats and 0.001 for integers."""
    extrinsics: Rows | str | None = None
    """4 x 4, or the file of a calibration: where the camera is in `parent`."""
    parent: Literal["base", "base_link", "table"] = "base"
    """What the calibration is given in: the controller's base, ROS's, or the table frame."""
    frame: Literal["optical", "mujoco"] = "optical"
    """Axes of the camera: x right, y down, z forward; or x right, y up, looking along -z."""
    depth: str = ""
    """File that the camera's driver writes, .npy or 16-bit .png; for `--arm dry` and `ur`."""
    color: str = ""
    """The same in colour, .png; may be left out."""


@dataclass(frozen=True, kw_only=True)
class TableSettings:
    """The table."""

    height_m: float = 0.0
    """Of its top above the base of the robot."""


@dataclass(frozen=True, kw_only=True)
class RobotSettings:
    """The arm."""

    host: str = "192.168.56.101"
    speed_m_s: float | None = None
    """Of pushes; None is the contract's."""
    acceleration_m_s2: float = 0.5
    payload_kg: float = 0.0
    """Of hand and cables; 0 leaves what the controller has."""
    limits: Limits = field(default_factory=Limits)


@dataclass(frozen=True, kw_only=True)
class GripperSettings:
    """The RG2."""

    host: str = "192.168.1.1"
    port: int = 502
    unit: int = 65
    force_n: float = 20.0
    max_width_m: float = 0.110


@dataclass(frozen=True, kw_only=True)
class SegmenterSettings:
    """Who finds the objects."""

    kind: Literal["tabletop", "file"] = "tabletop"
    """`tabletop` needs no network; `file` reads masks that another program writes beside the depth."""
    file: str = ""
    """.npz with masks, labels, scores as Mask R-CNN gives them, or a .png of instance ids."""
    min_score: float = 0.5


@dataclass(frozen=True, kw_only=True)
class TargetSettings:
    """Which object is wanted; one of these."""

    index: int | None = None
    name: str | None = None
    pixel: tuple[int, ...] | None = None
    """Column and row."""


@dataclass(frozen=True, kw_only=True)
class SimSettings:
    """The simulated cell of `--arm sim`."""

    scene: int = 0
    """Of the test scenes."""
    object_set: Literal["seen", "unseen"] = "seen"
    object_dir: str | None = None
    sensor: str = "clean"


@dataclass(frozen=True, kw_only=True)
class RuntimeSettings:
    """How maps are made."""

    cell: PointOfCell | None = None
    """Which of the points above a cell is its height; null is the one that the policy was trained with."""
    threads: int = 1


@dataclass(frozen=True, kw_only=True)
class Cell:
    """A cell."""

    camera: CameraSettings = field(default_factory=CameraSettings)
    table: TableSettings = field(default_factory=TableSettings)
    robot: RobotSettings = field(default_factory=RobotSettings)
    gripper: GripperSettings = field(default_factory=GripperSettings)
    segmenter: SegmenterSettings = field(default_factory=SegmenterSettings)
    target: TargetSettings | None = None
    runtime: RuntimeSettings = field(default_factory=RuntimeSettings)
    sim: SimSettings = field(default_factory=SimSettings)


def read_cell(path: Path) -> Cell:
    """Read a cell.yaml.

    Raises:
        ValueError: not YAML, an unknown key, or a value of the wrong type or out of range.
    """
    values = yaml_file.read(path)
    try:
        cell = from_dict(values if values is not None else {}, Cell)
        _refuse_ranges(cell)
        return replace(cell, sim=_found_from(path.parent, cell.sim))
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None


def _found_from(folder: Path, sim: SimSettings) -> SimSettings:
    """Return what is simulated with its paths found from the folder of the file that names them."""
    meshes = None if sim.object_dir is None else str(folder / sim.object_dir)
    sensor = str(folder / sim.sensor) if sim.sensor.endswith((".yaml", ".yml")) else sim.sensor
    return replace(sim, object_dir=meshes, sensor=sensor)


def _refuse_ranges(cell: Cell) -> None:
    ranges: dict[str, tuple[Any, float, float]] = {
        "camera.width": (cell.camera.width, 16, 10_000),
        "camera.height": (cell.camera.height, 16, 10_000),
        "camera.depth_scale": (cell.camera.depth_scale, 1e-6, 1.0),
        "table.height_m": (cell.table.height_m, -1.0, 1.0),
        "robot.speed_m_s": (cell.robot.speed_m_s, 0.01, cell.robot.limits.speed_m_s),
        "robot.acceleration_m_s2": (cell.robot.acceleration_m_s2, 0.05, cell.robot.limits.acceleration_m_s2),
        "robot.payload_kg": (cell.robot.payload_kg, 0.0, 5.0),
        "robot.limits.speed_m_s": (cell.robot.limits.speed_m_s, 0.01, 0.25),
        "robot.limits.acceleration_m_s2": (cell.robot.limits.acceleration_m_s2, 0.05, 2.0),
        "robot.limits.step_m": (cell.robot.limits.step_m, 0.01, 1.0),
        "robot.limits.force_n": (cell.robot.limits.force_n, 5.0, 150.0),
        "robot.limits.age_s": (cell.robot.limits.age_s, 0.01, 1.0),
        "gripper.port": (cell.gripper.port, 1, 65535),
        "gripper.unit": (cell.gripper.unit, 1, 247),
        "gripper.force_n": (cell.gripper.force_n, 3.0, 40.0),
        "gripper.max_width_m": (cell.gripper.max_width_m, 0.01, 0.2),
        "segmenter.min_score": (cell.segmenter.min_score, 0.0, 1.0),
        "runtime.threads": (cell.runtime.threads, 1, 64),
    }
    for key, (value, low, high) in ranges.items():
        if value is not None and not low <= value <= high:
            raise ValueError(f"{key} = {value} is out of range; allowed is {low:g} to {high:g}")


def target_of(cell: Cell) -> Target:
    """Return which object is wanted.

    Raises:
        ValueError: the file does not say, or says it twice.
    """
    wanted = cell.target
    if wanted is None:
        raise ValueError("target is missing in cell.yaml; allowed is one of target.index, target.name, target.pixel")
    if wanted.pixel is not None and len(wanted.pixel) != 2:
        raise ValueError(f"target.pixel = {list(wanted.pixel)}; allowed are two numbers, column and row")
    column_row = None if wanted.pixel is None else (int(wanted.pixel[0]), int(wanted.pixel[1]))
    return Target(index=wanted.index, name=wanted.name, pixel=column_row)


def camera_of(settings: CameraSettings, arm: Arm, folder: Path) -> PinholeCamera:
    """Return the camera.

    Args:
        settings: of cell.yaml.
        arm: whose base calibrations may be given in, where it stands in this cell.
        folder: that paths count from.

    Raises:
        ValueError: a file or number cannot be used.
    """
    matrix, shape, distortion = _intrinsics(settings, folder)
    given = settings.extrinsics
    if given is None:
        raise ValueError("camera.extrinsics is missing; allowed is a 4 x 4 matrix or the file of a calibration")
    pose = read_pose(folder / given) if isinstance(given, str) else _rows(given, "camera.extrinsics")
    refuse_pose(pose, what="camera.extrinsics")
    pose = world_from(settings.parent, arm) @ optical_from(pose, settings.frame)
    return PinholeCamera(matrix=matrix, world_from_optical=pose, shape=shape, distortion=distortion)


def _rows(given: Rows, key: str) -> np.ndarray:
    lengths = [len(row) for row in given]
    if len(set(lengths)) > 1:
        raise ValueError(f"{key} has rows of {lengths} numbers; allowed is a 4 x 4 matrix")
    return np.array(given, float)


def _intrinsics(settings: CameraSettings, folder: Path) -> tuple[np.ndarray, tuple[int, int], tuple[float, ...]]:
    """Return K, (rows, columns) and the distortion."""
    shape = (settings.height, settings.width)
    if isinstance(settings.intrinsics, str):
        for name in ("width", "height", "distortion"):
            if getattr(settings, name) != getattr(CameraSettings(), name):
                raise ValueError(f"camera.{name} is what {settings.intrinsics} says; allowed is to leave it out")
        return _camera_info(folder / settings.intrinsics)
    if settings.intrinsics is None:
        raise ValueError("camera.intrinsics is missing; allowed is K as three rows, or a CameraInfo file")
    try:
        return np.array(settings.intrinsics, float).reshape(3, 3), shape, settings.distortion
    except ValueError:
        raise ValueError(f"camera.intrinsics = {settings.intrinsics}; allowed are three rows of three") from None


def _camera_info(path: Path) -> tuple[np.ndarray, tuple[int, int], tuple[float, ...]]:
    """Return K, (rows, columns) and the distortion of a file of ROS: CameraInfo, or what its calibration writes.

    Raises:
        ValueError: it is neither, or of a lens that this camera is not.
    """
    values = yaml_file.read(path)
    try:
        if "camera_matrix" in values:
            k, d = values["camera_matrix"]["data"], values["distortion_coefficients"]["data"]
            size = values["image_height"], values["image_width"]
        else:
            k, d = values.get("k", values.get("K")), values.get("d", values.get("D", ()))
            size = values["height"], values["width"]
        model = values.get("distortion_model") or _LENS
        matrix, distortion = np.array(k, float).reshape(3, 3), tuple(float(x) for x in d)
        rows, columns = int(size[0]), int(size[1])
    except (AttributeError, KeyError, TypeError, ValueError):
        raise ValueError(
            f"{path} is no CameraInfo; allowed is YAML with k (9 numbers), d, width and height, or with camera_matrix, "
            "distortion_coefficients, image_width and image_height"
        ) from None
    if model != _LENS:
        raise ValueError(f"{path}: distortion_model is {model}; allowed is {_LENS}, so rectify the images before")
    return matrix, (rows, columns), distortion or (0.0,) * 5
