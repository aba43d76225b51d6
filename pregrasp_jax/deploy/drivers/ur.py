"""A Universal Robots arm by ur-rtde (extra `robot`), which checks next to nothing itself: all checks are here.

A push is one `moveL` that is watched while it runs: the link, the age of its data, the safety mode, the force, and
whether the tool still moves. Anything else than arriving stops the arm and ends the program with one line; nothing is
retried, and a protective stop is never released from here.
"""

import time
from collections.abc import Callable
from typing import Any

import numpy as np

from pregrasp_jax.deploy.decision import Push
from pregrasp_jax.deploy.devices import DeviceError, refuse_missing
from pregrasp_jax.deploy.guard import (
    START_ERROR,
    START_TURN,
    TCP_ERROR,
    ArmState,
    Limits,
    refuse_motion,
    refuse_pose,
    refuse_state,
)
from pregrasp_jax.deploy.poses import angle_between, grasp_point, tcp_pose
from pregrasp_jax.messages import one_line
from pregrasp_jax.robot.kinematics import Arm
from pregrasp_jax.spaces.motion import SETTLE_TIME

_ARRIVED = 0.002
"""m from the end of a motion at which it is done."""

_PERIOD = 0.02
"""s between two looks at a moving arm."""

_NEWS = 0.002
"""s between two looks for new data; a controller sends 125 or 500 times a second."""

_STALLED = 1.0
"""s without moving a millimetre on the way: stalled."""

_FIRST_DATA = 2.0
"""s in which the controller must have said something."""

_STOP = 2.0
"""m/s^2 with which the arm is stopped."""


class UrArm:
    """A UR arm under remote control."""

    def __init__(
        self,
        host: str,
        arm: Arm,
        limits: Limits,
        *,
        speed: float,
        acceleration: float,
        payload_kg: float = 0.0,
        clock: Callable[[], float] = time.monotonic,
    ):
        """Connect, and refuse a controller that is not ready.

        Args:
            host: name or address of the controller.
            arm: of the bundle, with the base where it stands in this cell.
            limits: that hold.
            speed: m/s of pushes.
            acceleration: m/s^2.
            payload_kg: of hand and cables; 0 leaves what the controller has.
            clock: s.

        Raises:
            DeviceError: not installed, not there, not under remote control, stopped, or with another tool.
        """
        self._arm, self._limits, self._clock = arm, limits, clock
        self._speed, self._acceleration = speed, acceleration
        self._control, self._receive = None, None
        self._stamp, self._fresh = 0.0, clock()
        self._asked = self._fresh
        try:
            self._connect(host, payload_kg)
        except BaseException:
            self.close()
            raise

    def _connect(self, host: str, payload_kg: float) -> None:
        try:
            import dashboard_client
            import rtde_control
            import rtde_receive
        except ImportError as error:
            raise refuse_missing("ur-rtde", "robot", error) from None
        try:
            dashboard = dashboard_client.DashboardClient(host)
            dashboard.connect()
            remote = dashboard.isInRemoteControl()
            dashboard.disconnect()
            if not remote:
                raise DeviceError(f"the controller at {host} is not under remote control; switch it on at the pendant")
            self._receive = rtde_receive.RTDEReceiveInterface(host)
            self._wait_for_data()
            refuse_state(self.state(), self._limits)
            self._control = rtde_control.RTDEControlInterface(host)
        except DeviceError:
            raise
        except Exception as error:  # boost's and ur-rtde's own
            raise DeviceError(f"no UR controller at {host} ({one_line(error)})") from None
        offset = np.asarray(self._control.getTCPOffset(), float)
        wanted = np.concatenate([self._arm.flange_from_hand[:3, 3], np.zeros(3)])
        if offset.shape != (6,) or not np.abs(offset - wanted).max() <= TCP_ERROR:
            raise DeviceError(
                f"the controller's tool centre point is {np.round(offset, 4).tolist()}; the policy needs "
                f"{np.round(wanted, 4).tolist()} (m, rotation vector): set it in the installation"
            )
        if payload_kg > 0 and not self._control.setPayload(payload_kg, [0.0, 0.0, 0.06]):
            raise DeviceError("the controller did not take the payload")

    def state(self) -> ArmState:
        """Return what the controller says now. After a pause the next that it says is waited for, as long as it may."""
        receive = self._link()
        if self._clock() - self._asked > self._limits.age_s:
            self._wait_for_news()
        stamp, now = receive.getTimestamp(), self._clock()
        if stamp != self._stamp:
            self._stamp, self._fresh = stamp, now
        self._asked = now
        force = np.asarray(receive.getActualTCPForce(), float)
        return ArmState(
            age_s=now - self._fresh,
            joints=np.asarray(receive.getActualQ(), float),
            tcp_pose=np.asarray(receive.getActualTCPPose(), float),
            force_n=float(np.linalg.norm(force[:3])) if force.size else float("nan"),
            safety_mode=int(receive.getSafetyMode()),
            protective_stop=bool(receive.isProtectiveStopped()),
            emergency_stop=bool(receive.isEmergencyStopped()),
            connected=bool(receive.isConnected()),
        )

    def joints(self) -> np.ndarray:
        """Return the joints [6] rad, measured now."""
        state = self.state()
        refuse_state(state, self._limits)
        return state.joints

    def push(self, push: Push) -> None:
        """Move along a push; see `ArmDriver.push`."""
        pose = self._checked().tcp_pose
        here = grasp_point(self._arm, pose)
        off = float(np.linalg.norm(here - push.poses[0, :3]))
        if off > START_ERROR:
            raise DeviceError(
                f"the hand is {off * 1e3:.0f} mm from where the push begins; allowed is {START_ERROR * 1e3:.0f} mm. "
                "Was it moved by hand? Bring it to the start pose"
            )
        turn = angle_between(pose[3:], tcp_pose(self._arm, push.poses[0])[3:])
        if turn > START_TURN:
            raise DeviceError(
                f"the hand is turned by {np.degrees(turn):.0f} degrees from how the push holds it; allowed are "
                f"{np.degrees(START_TURN):.0f}. A push would turn it on its way. Bring it to the start pose"
            )
        self._move(push.poses[-1])
        time.sleep(SETTLE_TIME)

    def lift(self, height_m: float) -> None:
        """Move straight up from where the tool is, turned as it is."""
        pose = self._checked().tcp_pose
        up = self._arm.world_from_base[2, :3] * height_m
        self._move_tool(np.concatenate([pose[:3] + up, pose[3:]]))

    def stop(self) -> None:
        """Stop where it is, if the controller still takes commands, whether it still tells or not.

        Its own program ends when the link for commands is cut; until then a motion that is under way goes on.
        """
        if self._control is not None and self._is_up():
            self._control.stopL(_STOP)

    def close(self) -> None:
        """Stop the program on the controller and let go."""
        if self._is_up():  # else there is nobody to tell, and the client would wait for ever
            self._quietly(self._control and self._control.stopScript)
            self._quietly(self._control and self._control.disconnect)
        self._quietly(self._receive and self._receive.disconnect)
        self._control = self._receive = None

    def _is_up(self) -> bool:
        return bool(self._control and self._control.isConnected())

    @staticmethod
    def _quietly(call: Any) -> None:
        if call:
            try:
                call()
            except Exception:  # of a link that is down already
                return

    def _move(self, hand_pose: np.ndarray) -> None:
        self._move_tool(tcp_pose(self._arm, hand_pose))

    def _move_tool(self, pose: np.ndarray) -> None:
        """Move the tool straight to a pose [6], and watch it."""
        target = refuse_pose(pose)
        start, end = (grasp_point(self._arm, np.asarray(p)) for p in (self._checked().tcp_pose, target))
        refuse_motion(start, end, speed=self._speed, acceleration=self._acceleration, limits=self._limits)
        assert self._control is not None
        if not self._control.moveL(target, self._speed, self._acceleration, True):
            raise DeviceError("the controller did not take the motion; look at its log")
        try:
            self._watch(np.asarray(target), float(np.linalg.norm(end - start)))
        except BaseException:  # Ctrl-C too
            self._quietly(self.stop)
            raise

    def _watch(self, target: np.ndarray, length: float) -> None:
        """Wait until the tool has arrived."""
        begun = moved = self._clock()
        longest = 3 * (length / self._speed + self._speed / self._acceleration) + 2.0
        last = self._checked().tcp_pose[:3]
        while True:
            state = self._checked()
            place, now = state.tcp_pose[:3], self._clock()
            if np.linalg.norm(place - target[:3]) < _ARRIVED:
                return
            if np.linalg.norm(place - last) > 1e-3:
                last, moved = place, now
            left = float(np.linalg.norm(place - target[:3]))
            if now - moved > _STALLED:
                raise DeviceError(f"the arm has stalled {left * 1e3:.0f} mm before the end of its motion")
            if now - begun > longest:
                raise DeviceError(f"the arm has not arrived after {longest:.1f} s; {left * 1e3:.0f} mm are left")
            time.sleep(_PERIOD)

    def _checked(self) -> ArmState:
        state = self.state()
        refuse_state(state, self._limits)
        return state

    def _wait_for_data(self) -> None:
        begun = self._clock()
        while not self._link().getTimestamp():
            if self._clock() - begun > _FIRST_DATA:
                raise DeviceError(f"the controller has said nothing for {_FIRST_DATA:g} s")
            time.sleep(_PERIOD)

    def _wait_for_news(self) -> None:
        """Wait for data that come from now on: what has come since the last look may be as old as that."""
        begun, self._stamp = self._clock(), self._link().getTimestamp()
        while self._link().getTimestamp() == self._stamp and self._clock() - begun <= self._limits.age_s:
            time.sleep(_NEWS)

    def _link(self) -> Any:
        if self._receive is None:
            raise DeviceError("the link to the arm is closed")
        return self._receive
