"""The contract of a trained policy."""

import datetime
from typing import Any

import jax
import numpy as np

from pregrasp_jax import io
from pregrasp_jax.checkpoint import TrainedPolicy, checksum
from pregrasp_jax.deploy.contract import (
    FORMAT,
    ActionEntry,
    CameraEntry,
    ChoiceEntry,
    Contract,
    EndEntry,
    GridEntry,
    PlaceEntry,
    RobotEntry,
    Tensor,
    Training,
)
from pregrasp_jax.evaluation.statistics import wilson_interval
from pregrasp_jax.export.onnx_policy import INPUTS, OUTPUT
from pregrasp_jax.heightmap import SEGMENTATION, overhead_camera
from pregrasp_jax.learning.networks import num_parameters
from pregrasp_jax.machine import versions
from pregrasp_jax.robot.base import Robot
from pregrasp_jax.sensors import get_sensor
from pregrasp_jax.settings import to_dict
from pregrasp_jax.spaces import grid
from pregrasp_jax.spaces.actions import ActionSpace
from pregrasp_jax.spaces.motion import APERTURE_TIME, SETTLE_TIME
from pregrasp_jax.spaces.workspace import Workspace
from pregrasp_jax.task.rules import IN_REGION_COVERAGE

_TABLE_FRAME = "table frame: origin at the centre of the workspace on the table top, x away from the robot, z up"

_NOT_GUARANTEED = (
    "Success on a real robot: every number here was measured in simulation.",
    "Safety: nothing here replaces the robot's own safety settings, an emergency stop, and a person who watches.",
    "Other cameras: views that are not from above, at about 1 m, see other things than the policy was trained on.",
    "Other hands: the closing region and the drawn robot are those of the robot named here.",
    "Objects shorter than 0.11 m or outside the workspace: the hand pushes 0.1 m above the table.",
    "Inputs out of range: a runtime must refuse them, because the graph computes something from anything.",
)


def describe(policy: TrainedPolicy, robot: Robot, workspace: Workspace, actions: ActionSpace) -> Contract:
    """Return the contract of a policy; the entries of its files come later."""
    return Contract(
        format=FORMAT,
        created=datetime.datetime.now(datetime.UTC).strftime("%Y-%m-%dT%H:%M:%SZ"),
        tensors=_inputs(),
        outputs=(_output(actions),),
        grid=GridEntry(
            rows="y, from -0.25 m upward",
            columns="x, from -0.25 m upward",
            size=grid.GRID_SIZE,
            resolution_m=grid.HEIGHTMAP_RESOLUTION,
            origin_m=(-grid.WORKSPACE_HALF_SIZE, -grid.WORKSPACE_HALF_SIZE),
            max_height_m=grid.MAX_HEIGHT,
            labels=dict(SEGMENTATION),
        ),
        action=_action(policy, robot, actions),
        end=_end(robot, actions),
        robot=_robot(robot),
        camera=_camera(policy),
        place=PlaceEntry(
            name=workspace.name,
            low_m=_finite(workspace.low),
            high_m=_finite(workspace.high),
            walls=tuple(
                {"center_m": list(wall.center), "half_size_m": list(wall.half_size), "yaw_rad": wall.yaw}
                for wall in workspace.walls
            ),
        ),
        training=_training(policy),
        evaluation=_evaluation(policy),
        normalisation="Inside the graph: heights are clipped to [0, 0.30] m, rounded to 255 steps, and their mean is "
        "taken off and divided by their deviation (at least 1 mm). Do not normalise before.",
        versions=versions(),
        not_guaranteed=_NOT_GUARANTEED,
    )


def _inputs() -> tuple[Tensor, ...]:
    about = {
        "height_m": {
            "unit": "m",
            "frame": _TABLE_FRAME,
            "kind": "state/heightmap",
            "meaning": "Highest point above each cell, the robot drawn in. Cells without a point are 0.",
            "low": -0.05,
            "high": 2.0,
            "invalid": "NaN, infinity; a runtime must refuse them.",
        },
        "labels": {
            "unit": "label",
            "frame": "the same grid",
            "kind": "state/segmentation",
            "meaning": ", ".join(f"{value} {name}" for name, value in SEGMENTATION.items()) + ".",
            "low": 0.0,
            "high": float(max(SEGMENTATION.values())),
            "invalid": "other values; a map without the target.",
        },
        "p1_m": {
            "unit": "m",
            "frame": "table frame, (x, y)",
            "kind": "state/hand/position",
            "meaning": "Commanded end of the last push, not the measured one; `start_m` before the first.",
            "low": -1.0,
            "high": 1.0,
            "invalid": "NaN.",
        },
    }
    return tuple(
        Tensor(name=name, dtype=dtype, shape=tuple(map(str, shape)), **about[name])  # pyright: ignore[reportArgumentType]
        for name, (dtype, shape) in INPUTS.items()
    )


def _output(actions: ActionSpace) -> Tensor:
    return Tensor(
        name=OUTPUT,
        dtype="float32",
        shape=("batch", *map(str, actions.shape)),
        unit="reward",
        frame="the same grid; last axis: choice",
        kind="target/push/value",
        meaning="Expected discounted reward of a push that ends in the cell, the hand held as the choice says. Take "
        "the largest among those that are allowed.",
        low=None,
        high=None,
        invalid="pushes that are not allowed have values too.",
    )


def _action(policy: TrainedPolicy, robot: Robot, actions: ActionSpace) -> ActionEntry:
    task = policy.config.task
    widest, narrowest = actions.choices[actions.widest].aperture, actions.choices[actions.narrowest].aperture
    span = max(widest - narrowest, 1e-9)
    return ActionEntry(
        index=f"An action is the flat index ((row * {grid.GRID_SIZE}) + col) * {actions.num_choices} + choice of "
        f"q[row, col, choice]: the hand ends at the centre of the cell.",
        primitive=task.primitive,
        choices=tuple(
            ChoiceEntry(
                name=choice.name,
                z_m=choice.z,
                yaw_rad=choice.yaw,
                aperture_rad=choice.aperture,
                opening=float(np.clip((choice.aperture - narrowest) / span, 0.0, 1.0)),
                has_region=robot.closing_region is not None and bool(_region(robot, choice.aperture).exists),
            )
            for choice in actions.choices
        ),
        r_in_m=task.r_in,
        r_out_m=task.r_out,
        full_ring=task.full_ring,
        start_m=(round(float(robot.start.xy[0]), 6), round(float(robot.start.xy[1]), 6)),
        push_speed_m_s=task.push_speed,
        settle_s=SETTLE_TIME,
        aperture_s=APERTURE_TIME,
        max_pushes=task.max_pushes,
    )


def _region(robot: Robot, aperture: float) -> Any:
    assert robot.closing_region is not None
    return robot.closing_region(np.float32(aperture))  # pyright: ignore[reportArgumentType]


def _end(robot: Robot, actions: ActionSpace) -> EndEntry | None:
    if robot.closing_region is None:
        return None
    region = _region(robot, actions.choices[actions.widest].aperture)
    return EndEntry(
        rule=f"Close and lift when more than {IN_REGION_COVERAGE:.0%} of the target lies in the closing region and the "
        "last push was made with a hand that has one. The region is given in the hand's frame (x forward, y to the "
        "side), symmetric: half widths at stations along x, linear in between.",
        coverage=IN_REGION_COVERAGE,
        stations_m=tuple(map(float, region.x)),
        half_width_m=tuple(map(float, region.half_width)),
    )


def _robot(robot: Robot) -> RobotEntry:
    common = {"name": robot.name, "joints": robot.joints, "home": tuple(map(float, robot.home))}
    if robot.body is None:
        return RobotEntry(
            **common, world_from_base=None, tcp_offset_m=None, limits_rad=None, base_frame="The hand floats."
        )
    arm = robot.body.arm
    return RobotEntry(
        **common,
        world_from_base=tuple(tuple(map(float, row)) for row in arm.world_from_base),
        tcp_offset_m=tuple(map(float, arm.flange_from_hand[:3, 3])),  # pyright: ignore[reportArgumentType]
        limits_rad=tuple(tuple(map(float, row)) for row in arm.limits),
        base_frame="The base frame is the controller's `base` (UR), which ROS calls `base`; ROS `base_link` is turned "
        "by 180 degrees about z.",
    )


def _camera(policy: TrainedPolicy) -> CameraEntry:
    camera, task = overhead_camera(), policy.config.task
    rows, columns = camera.shape
    return CameraEntry(
        name=task.camera,
        sensor=task.sensor,
        width=columns,
        height=rows,
        focal_px=float(camera.focal),
        position_m=tuple(float(x) for x in camera.position),
        looking="straight down, image right = +x, image up = +y",
        depth="metres along the optical axis; no depth is NaN or 0",
        intrinsics="principal point at ((width - 1) / 2, (height - 1) / 2), pixel centres at integers",
        cell=get_sensor(task.sensor).cell,
    )


def _training(policy: TrainedPolicy) -> Training:
    config = policy.config
    return Training(
        origin=policy.origin.name,
        config_hash=io.content_hash(to_dict(config)),
        parameters_hash=checksum(policy.params),
        seed=config.seed,
        architecture=config.network.architecture,
        width=config.network.width,
        mirror=config.network.mirror,
        members=config.network.num_members,
        parameters=num_parameters(policy.params),
        config=to_dict(config),
    )


def _evaluation(policy: TrainedPolicy) -> dict[str, Any]:
    """Return what was measured when the policy was saved, with an interval where it says how many scenes there were."""
    found = dict(policy.evaluation)
    rate, episodes, assets = found.get("success_rate"), policy.config.scene.validation_scenes, policy.config.assets
    if isinstance(rate, float):
        objects = "made objects" if assets.variants else f"set {assets.object_set}"
        found.setdefault("scenes", f"{episodes} validation scenes of {objects}")
        found.setdefault("success_ci95", list(wilson_interval(round(rate * episodes), episodes)))
    return found


def _finite(values: tuple[float, float]) -> tuple[float | None, ...]:
    return tuple(value if np.isfinite(value) else None for value in values)


def host(params: Any) -> Any:
    """Return parameters as numpy arrays."""
    return jax.tree.map(np.asarray, params)
