"""Devices that do nothing but say what they would be sent; the default, and the last check before the first motion."""

from collections.abc import Callable

import numpy as np

from pregrasp_jax.deploy.decision import Push
from pregrasp_jax.deploy.guard import Limits, refuse_motion, refuse_pose
from pregrasp_jax.deploy.poses import tcp_pose
from pregrasp_jax.robot.kinematics import Arm, grasp_pose


class DryArm:
    """An arm that is always where it was told to go."""

    def __init__(
        self,
        arm: Arm,
        limits: Limits,
        joints: np.ndarray,
        *,
        speed: float,
        acceleration: float,
        say: Callable[[str], None] = print,
    ):
        self._arm, self._limits, self._joints = arm, limits, np.array(joints[:6], float)
        self._speed, self._acceleration, self._say = speed, acceleration, say

    def joints(self) -> np.ndarray:
        """Return where it was told to go."""
        return self._joints.copy()

    def push(self, push: Push) -> None:
        """Say the command, after the checks that a real one passes."""
        self._check(push.poses[0, :3], push.poses[-1, :3])
        pose = refuse_pose(tcp_pose(self._arm, push.poses[-1]))
        self._say(f"dry: moveL({np.round(pose, 4).tolist()}, speed {self._speed:g} m/s), {push.seconds:.2f} s")
        self._joints = np.array(push.joints[-1], float)

    def lift(self, height_m: float) -> None:
        """Say it, after the same checks."""
        start = grasp_pose(self._arm, self._joints)[:3]
        self._check(start, start + np.array([0.0, 0.0, height_m]))
        self._say(f"dry: lift by {height_m:g} m")

    def close(self) -> None:
        """Nothing is open."""

    def _check(self, start: np.ndarray, end: np.ndarray) -> None:
        refuse_motion(start, end, speed=self._speed, acceleration=self._acceleration, limits=self._limits)


class DryGripper:
    """A gripper that is always as open as it was told to be."""

    def __init__(self, *, say: Callable[[str], None] = print):
        self._opening, self._say = 1.0, say

    def opening(self) -> float:
        """Return how far it was told to open."""
        return self._opening

    def move(self, opening: float) -> None:
        """Say it."""
        if opening != self._opening:
            self._say(f"dry: gripper to {opening:.0%}")
        self._opening = opening

    def grasp(self) -> bool:
        """Say it; nothing is held."""
        self._say("dry: gripper closes with constant force")
        self._opening = 0.0
        return False

    def close(self) -> None:
        """Nothing is open."""
