"""Devices: the guard, the RG2 against what stands for it, and files that other programs write."""

import asyncio
import os
import threading
import time
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from bundles import push_to, small_bundle, small_decider
from PIL import Image

from pregrasp_jax.deploy.decision import Decider
from pregrasp_jax.deploy.devices import DeviceError
from pregrasp_jax.deploy.drivers.dry import DryArm, DryGripper
from pregrasp_jax.deploy.files import FileSegmenter, FileSource
from pregrasp_jax.deploy.guard import (
    LIFT_HEIGHT,
    START_ERROR,
    ArmState,
    Limits,
    refuse_lift,
    refuse_motion,
    refuse_pose,
    refuse_state,
)


@pytest.fixture
def decider() -> Decider:
    return small_decider()


def state(**changes) -> ArmState:
    good = {"age_s": 0.0, "joints": np.zeros(6), "tcp_pose": np.zeros(6), "force_n": 1.0, "safety_mode": 1}
    good |= {"protective_stop": False, "emergency_stop": False, "connected": True}
    return ArmState(**(good | changes))


def test_states_in_which_nothing_may_move():
    refuse_state(state(), Limits())
    for changes, said in (
        ({"connected": False}, "link to the arm is down"),
        ({"age_s": 0.3}, "0.30 s old"),
        ({"age_s": float("nan")}, "s old"),
        ({"emergency_stop": True}, "emergency stop"),
        ({"protective_stop": True}, "protective stop"),
        ({"safety_mode": 3}, "safety mode 3"),
        ({"tcp_pose": np.zeros(5)}, "six finite"),
        ({"tcp_pose": np.full(6, np.nan)}, "six finite"),
        ({"joints": np.zeros(0)}, "six finite"),
        ({"joints": np.full(6, np.nan)}, "six finite"),
        ({"force_n": 61.0}, "61 N"),
        ({"force_n": float("nan")}, "nan N"),
    ):
        with pytest.raises(DeviceError, match=said):
            refuse_state(state(**changes), Limits())


def test_motions_that_may_not_be():
    start, end = np.array([-0.3, 0.0, 0.1]), np.array([-0.1, 0.1, 0.1])
    fine: dict[str, Any] = {"speed": 0.1, "acceleration": 0.5, "limits": Limits()}
    refuse_motion(start, end, **fine)
    for change, said in (
        ({"end": np.array([9.0, 0, 0.1])}, "the box"),
        ({"end": np.array([-0.1, 0.1, 0.02])}, "the box"),
        ({"end": np.array([np.nan, 0, 0.1])}, "three finite"),
        ({"end": np.zeros(2)}, "three finite"),
        ({"end": np.array([0.2, 0.2, 0.1])}, "m long"),
        ({"speed": 0.3}, "speed"),
        ({"speed": float("nan")}, "speed"),
        ({"acceleration": 9.0}, "acceleration"),
    ):
        with pytest.raises(DeviceError, match=said):
            given: dict[str, Any] = {"start": start, "end": end} | fine | change
            refuse_motion(**given)
    for pose in (np.zeros(5), np.full(6, np.inf)):
        with pytest.raises(DeviceError, match="six finite"):
            refuse_pose(pose)


def test_limits_leave_room_to_lift():
    for height in np.arange(0.05, 0.15, 0.01).astype(np.float32):
        enough = f"{height + LIFT_HEIGHT + START_ERROR:g}"
        roomy = Limits(high_m=(0.3, 0.3, float(enough)), step_m=LIFT_HEIGHT)
        refuse_lift(roomy, float(height))
        start = np.array([0.0, 0.0, height], float)
        refuse_motion(start, start + [0.0, 0.0, LIFT_HEIGHT], speed=0.1, acceleration=0.5, limits=roomy)  # noqa: RUF005
        for tight in (Limits(high_m=(0.3, 0.3, float(enough) - 0.005)), Limits(step_m=LIFT_HEIGHT - 0.005)):
            with pytest.raises(ValueError, match=f"allowed is a third number of {enough} and more"):
                refuse_lift(tight, float(height))


def test_a_dry_cell_says_what_it_would_send(decider: Decider):
    said: list[str] = []
    arm = DryArm(
        decider.body.arm, Limits(), np.array(decider.contract.robot.home), speed=0.1, acceleration=0.5, say=said.append
    )
    gripper, push = DryGripper(say=said.append), push_to(decider)
    gripper.move(0.0)
    arm.push(push)
    np.testing.assert_allclose(arm.joints(), push.joints[-1])
    assert not gripper.grasp()
    assert said[0] == "dry: gripper to 0%" and said[1].startswith("dry: moveL([") and "0.1 m/s" in said[1]
    arm.lift(0.2)
    assert said[-1] == "dry: lift by 0.2 m"
    with pytest.raises(DeviceError, match="the box"):
        arm.lift(0.4)
    with pytest.raises(DeviceError, match="speed"):
        DryArm(decider.body.arm, Limits(), np.zeros(6), speed=0.5, acceleration=0.5).push(push)


class Gripper:
    """An RG2 behind Modbus on the loopback: busy for a moment, then as wide as it was told, or as an object is."""

    def __init__(self, *, object_mm: float = 0.0, status: int = 0, forever: bool = False):
        pymodbus = pytest.importorskip("pymodbus")
        assert pymodbus
        self.object, self.extra, self.forever = object_mm * 10, status, forever
        self.written: list[list[int]] = []
        self.moved = 0.0
        self.port: int = 0
        self.started = threading.Event()
        self.loop = asyncio.new_event_loop()
        threading.Thread(target=self._serve, daemon=True).start()
        assert self.started.wait(10)

    async def _act(self, function, start, address, count, registers, values):
        del start, count
        if values:
            self.written.append(list(values))
            self.moved = time.monotonic()
            registers[0x0113] = int(max(values[1], self.object))
        elif function == 3 and address == 0x010C:
            since = time.monotonic() - self.moved
            busy = self.forever or 0.06 < since < 0.16  # it needs a moment to begin
            held = since > 0.1 and self.object > 0 and bool(self.written) and self.written[-1][1] < self.object
            registers[0x010C] = self.extra | (1 if busy and self.written else 0) | (2 if held and not busy else 0)

    def _serve(self) -> None:
        from pymodbus.server import ModbusTcpServer
        from pymodbus.simulator import DataType, SimData, SimDevice

        async def run() -> None:
            data = [SimData(0, values=[0] * 0x420, datatype=DataType.REGISTERS)]
            device = SimDevice(id=65, simdata=data, action=self._act)
            server: Any = ModbusTcpServer(device, address=("127.0.0.1", 0))
            await server.serve_forever(background=True)
            self.port = server.transport.sockets[0].getsockname()[1]
            self.started.set()
            await asyncio.Event().wait()

        asyncio.set_event_loop(self.loop)
        self.loop.run_until_complete(run())

    def connect(self, **options):
        from pregrasp_jax.deploy.drivers.rg2 import Rg2

        return Rg2("127.0.0.1", port=self.port, **options)


def test_a_gripper_opens_closes_and_holds():
    server = Gripper(object_mm=60)
    gripper = server.connect(force_n=20)
    gripper.move(1.0)
    assert server.written[-1] == [200, 1100, 16] and gripper.opening() == pytest.approx(1.0)
    gripper.move(0.8)
    assert gripper.opening() == pytest.approx(0.8)
    assert gripper.grasp() and gripper.opening() == pytest.approx(60 / 110)
    gripper.move(0.52)  # 57 mm: near enough to 60
    with pytest.raises(DeviceError, match="stands 60 mm open instead of 55"):
        gripper.move(0.5)
    with pytest.raises(DeviceError, match="allowed is 0 to 1"):
        gripper.move(float("nan"))
    gripper.close()
    empty = Gripper().connect()
    assert not empty.grasp()


def test_a_gripper_that_must_not_go_on():
    with pytest.raises(DeviceError, match="safety switch"):
        Gripper(status=0b100).connect()
    with pytest.raises(DeviceError, match="is its unit id 66"):
        Gripper().connect(unit=66)
    with pytest.raises(DeviceError, match="no gripper at 127"):
        from pregrasp_jax.deploy.drivers.rg2 import Rg2

        Rg2("127.0.0.1", port=1)
    with pytest.raises(ValueError, match="out of range"):
        Gripper().connect(force_n=90)
    stuck = Gripper(forever=True)
    ticks = iter(np.arange(0.0, 1000.0, 1.0))
    with pytest.raises(DeviceError, match="still busy"):
        stuck.connect(clock=lambda: float(next(ticks))).move(0.5)
    assert stuck.written[-1][2] == 8, "it is told to stop"


def test_pictures_are_taken_after_they_are_asked_for_and_masks_are_of_them(tmp_path):
    depth, ids = tmp_path / "depth.npy", tmp_path / "ids.png"
    np.save(depth, np.ones((4, 4), np.float32))
    Image.fromarray(np.ones((4, 4), np.uint8)).save(ids)
    assert FileSource(depth, fresh=False).capture()[2] == depth.stat().st_mtime
    source = FileSource(depth, fresh=True, patience_s=0.5)
    with pytest.raises(DeviceError, match=r"no new depth image in .*depth\.npy for 0\.5 s"):
        source.capture()
    np.save(tmp_path / "next.npy", np.full((4, 4), 2, np.float32))

    def write() -> None:
        (tmp_path / "next.npy").touch()
        (tmp_path / "next.npy").replace(depth)

    threading.Timer(0.2, write).start()
    image, _, taken = source.capture()
    assert image[0, 0] == 2
    ahead = time.time() + 60
    os.utime(depth, (ahead, ahead))  # its writer's clock is, and it writes no more
    with pytest.raises(DeviceError, match="no new depth image"):
        source.capture()
    segmenter = FileSegmenter(ids, min_score=0.5, fresh=False, patience_s=0.5)
    frame: Any = SimpleNamespace(time_s=taken)
    with pytest.raises(DeviceError, match=r"no new file of masks in .*ids\.png"):
        segmenter.segment(frame)
    os.utime(ids, (taken, taken))
    assert len(segmenter.segment(frame).masks) == 1


def test_masks_of_an_image_from_before_the_arm_stood_still_are_not_taken(tmp_path):
    """A network that takes 0.3 s an image: masks that it writes after the frame may be of an image from before."""
    image, ids = tmp_path / "image.npy", tmp_path / "ids.png"
    stop = threading.Event()

    def show(objects: int) -> None:
        np.save(tmp_path / "next.npy", np.arange(objects + 1, dtype=np.uint8)[None])
        (tmp_path / "next.npy").replace(image)

    def network() -> None:
        while not stop.is_set():
            seen = np.load(image)
            time.sleep(0.3)
            Image.fromarray(seen).save(tmp_path / "next.png")
            (tmp_path / "next.png").replace(ids)

    show(1)
    thread = threading.Thread(target=network)
    thread.start()
    try:
        time.sleep(0.45)  # its second image is under way
        show(2)
        frame: Any = SimpleNamespace(time_s=time.time())
        assert len(FileSegmenter(ids, min_score=0.5, fresh=True).segment(frame).masks) == 2
    finally:
        stop.set()
        thread.join()


@pytest.mark.parametrize("box", [((float("nan"), 0, 0), (1, 1, 1)), ((-9, -9, -9), (1, 1, 1)), ((0, 0, 0), (1, 0, 1))])
def test_a_box_that_holds_nothing_back_is_refused(box):
    with pytest.raises(ValueError, match="are no box; allowed is"):
        Limits(low_m=box[0], high_m=box[1])


def test_a_command_line_without_a_cell_moves_nothing(capsys):
    from pregrasp_jax.cli.main import main

    for options, said in (
        (["--arm", "ur"], "--config is missing"),
        (["--arm", "sim", "--gripper", "dry"], "allowed is sim with sim"),
    ):
        with pytest.raises(SystemExit) as stopped:
            main(["deploy", str(small_bundle()), *options])
        assert stopped.value.code == 2 and said in capsys.readouterr().err
