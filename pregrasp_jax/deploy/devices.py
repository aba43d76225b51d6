"""What a cell is made of: protocols that simulated, dry and real devices implement alike."""

from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from pregrasp_jax.deploy.decision import Push
from pregrasp_jax.deploy.masks import Masks


class DeviceError(OSError):
    """A device cannot or must not go on: one line says what a person has to look at. Nothing is retried."""


@dataclass(frozen=True, eq=False)
class Frame:
    """One look at the cell.

    Attributes:
        depth: [rows, columns] as the camera gives it.
        color: [rows, columns, 3] uint8, None without one.
        joint_pos: [J] rad when it was taken, in the order of the contract.
        time_s: when it was taken, s since the epoch.
    """

    depth: np.ndarray
    color: np.ndarray | None
    joint_pos: np.ndarray
    time_s: float


class ImageSource(Protocol):
    """A depth camera, or whatever stands for one."""

    def capture(self) -> tuple[np.ndarray, np.ndarray | None, float]:
        """Return depth, colour or None, and when they were taken, s since the epoch."""
        ...


class Segmenter(Protocol):
    """Finds the objects of an image."""

    def segment(self, frame: Frame) -> Masks:
        """Return one mask per object, none of the robot."""
        ...


class ArmDriver(Protocol):
    """An arm that can make a straight push."""

    def joints(self) -> np.ndarray:
        """Return the joints [6] rad, measured now."""
        ...

    def push(self, push: Push) -> None:
        """Move along a push and stand still at its end.

        Raises:
            DeviceError: it must not start, or something stopped it.
        """
        ...

    def lift(self, height_m: float) -> None:
        """Move straight up."""
        ...

    def close(self) -> None:
        """Stop and let go of the connection."""
        ...


class GripperDriver(Protocol):
    """A parallel gripper."""

    def opening(self) -> float:
        """Return how far it is open, measured: 0 closed, 1 as wide as it goes."""
        ...

    def move(self, opening: float) -> None:
        """Open or close to a share of the widest opening, and wait for it."""
        ...

    def grasp(self) -> bool:
        """Close with constant force; return whether something is held."""
        ...

    def close(self) -> None:
        """Let go of the connection."""
        ...


def refuse_missing(package: str, extra: str, error: Any) -> DeviceError:
    """Return the error of a driver whose package is not installed."""
    return DeviceError(f"{package} cannot be imported ({error}); allowed is pip install 'pregrasp_jax[{extra}]'")
