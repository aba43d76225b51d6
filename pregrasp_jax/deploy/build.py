"""A station from a bundle and a cell.yaml."""

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Literal

import numpy as np

from pregrasp_jax.deploy.bundle import Bundle
from pregrasp_jax.deploy.camera import centred_camera
from pregrasp_jax.deploy.cell import Cell, camera_of, target_of
from pregrasp_jax.deploy.contract import ROBOT, CameraEntry
from pregrasp_jax.deploy.decision import Decider, workspace_of
from pregrasp_jax.deploy.devices import ArmDriver, GripperDriver, Segmenter
from pregrasp_jax.deploy.drivers.dry import DryArm, DryGripper
from pregrasp_jax.deploy.files import FileSegmenter, FileSource
from pregrasp_jax.deploy.guard import refuse_lift
from pregrasp_jax.deploy.log import DecisionLog
from pregrasp_jax.deploy.loop import Station
from pregrasp_jax.deploy.policy import load_values
from pregrasp_jax.deploy.poses import on_table
from pregrasp_jax.deploy.tabletop import TabletopSegmenter
from pregrasp_jax.deploy.view import View, make_view
from pregrasp_jax.robot.robot_file import from_arrays

ArmKind = Literal["dry", "ur"]
GripperKind = Literal["dry", "modbus"]
Say = Callable[[str], None]


def make_decider(bundle: Bundle, cell: Cell) -> Decider:
    """Return the policy of a bundle in a cell.

    Raises:
        ValueError: the bundle has no robot, or its policy cannot be loaded.
    """
    if bundle.contract.robot.world_from_base is None:
        raise ValueError(f"{bundle.folder} is of robot {bundle.contract.robot.name}, which has no arm to deploy on")
    body = on_table(from_arrays(bundle.arrays(ROBOT)), cell.table.height_m)
    values = load_values(bundle, threads=cell.runtime.threads)
    return Decider(contract=bundle.contract, values=values, body=body, workspace=workspace_of(bundle.contract))


def nominal_view(entry: CameraEntry) -> View:
    """Return the view of a contract's camera, which looks straight down."""
    pose = np.eye(4)
    pose[:3, 3] = entry.position_m
    return make_view(centred_camera(focal_px=entry.focal_px, shape=(entry.height, entry.width), pose=pose))


def view_of(cell: Cell, decider: Decider, folder: Path) -> View:
    """Return the view of a cell's camera.

    Raises:
        ValueError: its calibration cannot be used, or it misses the workspace.
    """
    return make_view(camera_of(cell.camera, decider.body.arm, folder))


def make_station(
    bundle: Bundle,
    cell: Cell,
    folder: Path,
    *,
    arm: ArmKind = "dry",
    gripper: GripperKind = "dry",
    log: Path | None = None,
    say: Say = print,
) -> Station:
    """Return a station; real devices are connected to here. `simulated_cell` makes one that is simulated.

    Args:
        bundle: the policy.
        cell: what is where.
        folder: that paths of the cell count from.
        arm: which driver.
        gripper: which driver.
        log: folder for decisions, None for none.
        say: told what happens.

    Raises:
        ValueError: something cannot be used.
        DeviceError: a device is not there or not ready.
    """
    decider = make_decider(bundle, cell)
    view = view_of(cell, decider, folder)
    if not cell.camera.depth:
        raise ValueError("camera.depth is missing in cell.yaml; allowed is the file that the camera's driver writes")
    fresh = arm != "dry"
    color = folder / cell.camera.color if cell.camera.color else None
    source = FileSource(folder / cell.camera.depth, color, fresh=fresh)
    hand = _gripper(cell, gripper, say)
    try:
        return Station(
            decider=decider,
            cell=cell.runtime.cell or bundle.contract.camera.cell,
            log=DecisionLog(log, bundle.contract) if log else None,
            say=say,
            view=view,
            source=source,
            segmenter=_segmenter(cell, decider, view, folder, fresh=fresh),
            target=target_of(cell),
            arm=_arm(cell, decider, arm, say),
            gripper=hand,
            depth_scale=cell.camera.depth_scale,
        )
    except BaseException:
        hand.close()
        raise


def _arm(cell: Cell, decider: Decider, kind: ArmKind, say: Say) -> ArmDriver:
    contract, limits = decider.contract, cell.robot.limits
    if contract.end is not None:
        refuse_lift(limits, max(choice.z_m for choice in contract.action.choices))
    speed = contract.action.push_speed_m_s if cell.robot.speed_m_s is None else cell.robot.speed_m_s
    if kind == "dry":
        acceleration = cell.robot.acceleration_m_s2
        home = np.array(contract.robot.home)
        return DryArm(decider.body.arm, limits, home, speed=speed, acceleration=acceleration, say=say)
    from pregrasp_jax.deploy.drivers.ur import UrArm

    return UrArm(
        cell.robot.host,
        decider.body.arm,
        limits,
        speed=speed,
        acceleration=cell.robot.acceleration_m_s2,
        payload_kg=cell.robot.payload_kg,
    )


def _gripper(cell: Cell, kind: GripperKind, say: Say) -> GripperDriver:
    if kind == "dry":
        return DryGripper(say=say)
    from pregrasp_jax.deploy.drivers.rg2 import Rg2

    return Rg2(**dataclasses.asdict(cell.gripper))


def _segmenter(cell: Cell, decider: Decider, view: View, folder: Path, *, fresh: bool) -> Segmenter:
    settings = cell.segmenter
    if settings.kind == "tabletop":
        entry, scale = decider.contract.grid, cell.camera.depth_scale
        return TabletopSegmenter(view, decider.body, entry, scale=scale)
    if not settings.file:
        raise ValueError("segmenter.file is missing in cell.yaml; allowed is the .npz or .png that the network writes")
    return FileSegmenter(folder / settings.file, min_score=settings.min_score, fresh=fresh)
