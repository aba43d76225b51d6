"""`pregrasp-jax deploy` and `calibrate-check`: a bundle on a robot, or on something that stands for one."""

import dataclasses
from pathlib import Path
from typing import Literal

from pregrasp_jax import io
from pregrasp_jax.deploy.bundle import Bundle, read_bundle
from pregrasp_jax.deploy.cell import Cell, read_cell
from pregrasp_jax.deploy.loop import Station
from pregrasp_jax.evaluation_config import PlanningConfig, refuse_planning

_PLANNING = PlanningConfig()


def deploy(
    bundle: Path | None = None,
    /,
    *,
    config: Path | None = None,
    arm: Literal["dry", "sim", "ur"] = "dry",
    gripper: Literal["dry", "sim", "modbus"] | None = None,
    once: bool = False,
    plan: bool = False,
    planning: PlanningConfig = _PLANNING,
    log: Path | None = None,
    replay: Path | None = None,
) -> None:
    """Run a bundle: look, decide, push, until the target is held. Without options it moves nothing (docs/robot.md).

    Args:
        bundle: Folder that `export` has written.
        config: cell.yaml: camera, calibration, robot, gripper, masks, target. `--arm sim` can do without.
        arm: `dry` says what it would send; `sim` simulates the whole cell; `ur` moves a UR arm (extra `robot`).
        gripper: `dry`, `sim`, or `modbus`, an OnRobot RG2 (extra `robot`); by default dry, or sim with sim.
        once: Decide and push once only.
        plan: Search in a rebuilt scene before every push; needs JAX and MuJoCo (docs/planning.md).
        planning: How much is searched.
        log: New folder for every decision with all that it followed from.
        replay: Draw the decisions of such a folder and do nothing else.
    """
    from pregrasp_jax.deploy.build import make_station
    from pregrasp_jax.deploy.log import draw_log

    if replay is not None:
        others = (bundle, config, arm, gripper, once, plan, planning, log)
        if others != (None, None, "dry", None, False, False, _PLANNING, None):
            raise ValueError("--replay draws a log and does nothing else; allowed is --replay FOLDER alone")
        for picture in draw_log(replay):
            print(f"wrote {picture}")
        return
    if bundle is None:
        raise ValueError("a bundle is missing; allowed is `pregrasp-jax deploy BUNDLE --config cell.yaml`")
    if config is None and arm != "sim":
        raise ValueError(f"--config is missing; allowed with --arm {arm} is a cell.yaml (docs/robot.md)")
    cell, folder = (Cell(), Path()) if config is None else (read_cell(config), config.parent)
    hand = gripper or ("sim" if arm == "sim" else "dry")
    refuse_planning(plan, planning)
    held = read_bundle(bundle)
    if arm == "sim" and hand == "sim":
        import pregrasp_jax.simulated_cell as simulated  # with JAX and MuJoCo

        station = simulated.make_simulated_station(held, cell, log=log)
    elif arm != "sim" and hand != "sim":
        station = make_station(held, cell, folder, arm=arm, gripper=hand, log=log)
    else:
        raise ValueError(f"--arm {arm} with --gripper {hand}: a simulated cell has both; allowed is sim with sim")
    try:
        if plan:
            station = _with_search(station, held, planning)
        station.run(once=once)
    finally:
        station.arm.close()
        station.gripper.close()


def _with_search(station: Station, bundle: Bundle, planning: PlanningConfig) -> Station:
    """Return a station that searches before every push."""
    try:
        from pregrasp_jax.planned_cell import make_search
    except ImportError as error:
        raise ValueError(f"plan = True: {error.name} is not installed; allowed is pip install pregrasp_jax") from None
    camera_m = station.view.camera.world_from_optical[:3, 3]
    search = make_search(bundle, planning, decider=station.decider, camera_m=camera_m, say=station.say)
    return dataclasses.replace(station, search=search)


def calibrate_check(config: Path, /, *, bundle: Path, depth: Path, png: Path = Path("calibration.png")) -> int:
    """Say how well a calibration fits the table, from one depth image of it. Exit code 1 where a number is not good.

    Args:
        config: cell.yaml.
        bundle: Folder that `export` has written, for the robot's reach.
        depth: Image of the table, .npy or 16-bit .png; objects may stand on less than half of it.
        png: Picture of how far the table is from where it should be.
    """
    from pregrasp_jax.deploy.build import make_decider, view_of
    from pregrasp_jax.deploy.calibrate import check_calibration, draw_report
    from pregrasp_jax.deploy.camera import depth_in_metres
    from pregrasp_jax.deploy.files import read_depth
    from pregrasp_jax.drawing import refuse_image, save_image

    refuse_image(png)
    io.refuse_unwritable(png)
    cell = read_cell(config)
    decider = make_decider(read_bundle(bundle), cell)
    view = view_of(cell, decider, config.parent)
    metres = depth_in_metres(read_depth(depth), scale=cell.camera.depth_scale, shape=view.camera.shape)
    report = check_calibration(metres, view=view, decider=decider)
    print("\n".join(report.lines()))
    save_image(png, draw_report(report))
    print(f"wrote {png}: white is right, red too high, blue too low, grey not seen")
    return 0 if report.good else 1
