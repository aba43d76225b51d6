"""What no command may pass: every motion and every state of the arm is looked at here, whatever the driver."""

from dataclasses import dataclass

import numpy as np

from pregrasp_jax.deploy.devices import DeviceError

NORMAL = 1
"""Safety mode of a UR controller in which it may move (2 is reduced, which is fine too)."""

REDUCED = 2

LIFT_HEIGHT = 0.2
"""m; how far a hand goes up after its fingers have closed."""

START_ERROR = 0.02
"""m; a push starts where the last one was commanded to end, within this."""

START_TURN = 0.05
"""rad; and the hand is turned then as a push holds it, within this."""

TCP_ERROR = 0.002
"""m; how far the controller's tool centre point may be from the contract's."""


_ROUNDING = 1e-6
"""m by which a motion that was commanded to be as long as is allowed may seem longer."""


@dataclass(frozen=True, kw_only=True)
class Limits:
    """What a motion may be; lengths in the table frame."""

    low_m: tuple[float, float, float] = (-0.40, -0.30, 0.05)
    high_m: tuple[float, float, float] = (0.30, 0.30, 0.45)
    speed_m_s: float = 0.25
    acceleration_m_s2: float = 1.0
    step_m: float = 0.45
    """Longest motion in one command."""
    force_n: float = 60.0
    """Of the tool; beyond it the arm is stopped."""
    age_s: float = 0.1
    """Oldest data that is acted upon."""

    def __post_init__(self):
        """Refuse a box that is none, or none that holds: comparisons with NaN let everything pass."""
        if not all(-1 <= low < high <= 1 for low, high in zip(self.low_m, self.high_m, strict=True)):
            raise ValueError(
                f"robot.limits.low_m = {list(self.low_m)} and high_m = {list(self.high_m)} are no box; allowed is each "
                "number of the first below that of the second, all within -1 to 1 m"
            )


@dataclass(frozen=True, kw_only=True)
class ArmState:
    """What a controller says of its arm.

    Attributes:
        age_s: since it has said so.
        joints: [6] rad.
        tcp_pose: [6] x, y, z m and rotation vector, in the base frame.
        force_n: of the tool.
        safety_mode: as the controller numbers it.
        protective_stop: whether it is in one.
        emergency_stop: whether it is in one.
        connected: whether the link is up.
    """

    age_s: float
    joints: np.ndarray
    tcp_pose: np.ndarray
    force_n: float
    safety_mode: int
    protective_stop: bool
    emergency_stop: bool
    connected: bool


def refuse_state(state: ArmState, limits: Limits) -> None:
    """Refuse to move, or to go on moving.

    Raises:
        DeviceError: the link is down, data is stale or not finite, the arm is stopped, or pushes too hard.
    """
    if not state.connected:
        raise DeviceError("the link to the arm is down; its program has stopped, look at the robot before you go on")
    if not state.age_s <= limits.age_s:
        raise DeviceError(f"the arm's data is {state.age_s:.2f} s old; allowed is {limits.age_s:g} s")
    if state.emergency_stop:
        raise DeviceError("the arm is in emergency stop; a person has to release it")
    if state.protective_stop or state.safety_mode not in (NORMAL, REDUCED):
        raise DeviceError(
            f"the arm is in a protective stop or not in normal mode (safety mode {state.safety_mode}); a person has to "
            "look why, and release it on the pendant"
        )
    if any(values.shape != (6,) or not np.isfinite(values).all() for values in (state.tcp_pose, state.joints)):
        raise DeviceError("the arm's pose or joints are not six finite numbers")
    if not state.force_n <= limits.force_n:
        raise DeviceError(f"the tool is pushed with {state.force_n:.0f} N; allowed is {limits.force_n:g} N")


def refuse_motion(start: np.ndarray, end: np.ndarray, *, speed: float, acceleration: float, limits: Limits) -> None:
    """Refuse a straight motion of the grasp point.

    Args:
        start: [3] m in the table frame, where it is.
        end: [3] m.
        speed: m/s.
        acceleration: m/s^2.
        limits: that hold.

    Raises:
        DeviceError: not three finite numbers, out of the box, too long, too fast.
    """
    for name, point in (("start", start), ("end", end)):
        if np.shape(point) != (3,) or not np.isfinite(point).all():
            raise DeviceError(f"{name} of a motion is {point!r}; allowed are three finite numbers in m")
        low, high = np.array(limits.low_m), np.array(limits.high_m)
        slack = 0.01 if name == "start" else 0.0
        if (point < low - slack).any() or (point > high + slack).any():
            raise DeviceError(
                f"{name} of a motion is {np.round(point, 3).tolist()} m; allowed is the box {list(limits.low_m)} to "
                f"{list(limits.high_m)}"
            )
    length = float(np.linalg.norm(np.subtract(end, start)))
    if length > limits.step_m + _ROUNDING:
        raise DeviceError(f"a motion is {length:.3f} m long; allowed is {limits.step_m:g} m")
    if not 0 < speed <= limits.speed_m_s:
        raise DeviceError(f"a motion's speed is {speed:g} m/s; allowed is above 0 to {limits.speed_m_s:g}")
    if not 0 < acceleration <= limits.acceleration_m_s2:
        raise DeviceError(f"a motion's acceleration is {acceleration:g} m/s^2; allowed is {limits.acceleration_m_s2:g}")


def refuse_lift(limits: Limits, height_m: float) -> None:
    """Refuse limits in which what is grasped could not be lifted: better before a trial than with the fingers closed.

    Args:
        limits: that hold.
        height_m: of the grasp point above the table, when the fingers close.

    Raises:
        ValueError: the box is too low, or the longest motion too short.
    """
    highest = round(height_m + LIFT_HEIGHT + START_ERROR, 3)
    if limits.high_m[2] < highest or limits.step_m < LIFT_HEIGHT:
        raise ValueError(
            f"robot.limits.high_m = {list(limits.high_m)} and step_m = {limits.step_m:g} leave no room to lift what is "
            f"grasped; allowed is a third number of {highest:g} and more, and step_m of {LIFT_HEIGHT:g} and more"
        )


def refuse_pose(pose: object) -> list[float]:
    """Return a tool pose as six finite numbers for a controller that checks nothing.

    Raises:
        DeviceError: it is something else.
    """
    numbers = np.asarray(pose, float)
    if numbers.shape != (6,) or not np.isfinite(numbers).all():
        raise DeviceError(f"a tool pose is {numbers.tolist()}; allowed are six finite numbers")
    return [float(x) for x in numbers]
