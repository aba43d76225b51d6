"""From the two maps to a push: the best one that is allowed and that the arm can make, or that it is time to close."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from pregrasp_jax.deploy.contract import ActionEntry, ChoiceEntry, Contract
from pregrasp_jax.deploy.policy import Values
from pregrasp_jax.deploy.projection import Maps
from pregrasp_jax.geometry import matrix_product, matrix_to_pose, quat_to_matrix, rigid_inverse, rigid_motion
from pregrasp_jax.robot import kinematics
from pregrasp_jax.robot.following import Body, Followed, follow
from pregrasp_jax.robot.region import ClosingRegion
from pregrasp_jax.spaces import grid, motion
from pregrasp_jax.spaces.actions import REFUSED_RADIUS, ActionSpace, Choice
from pregrasp_jax.spaces.workspace import Box, Workspace

DT = 0.02
"""s between poses along a push."""


@dataclass(frozen=True, eq=False)
class Push:
    """A push, and how the arm makes it.

    Attributes:
        action: flat index of q.
        row: of the cell.
        col: of the cell.
        choice: index of how the hand is held.
        value: of it.
        start: of the hand, as commanded before.
        end: of the hand.
        poses: [T, 7] of the grasp point in the table frame, every `DT`.
        joints: [T, 6] rad.
        apertures: [T] rad.
        seconds: how long it takes.
        base_pose: [7] x, y, z m and qw, qx, qy, qz of the grasp point at the end, in the robot's base frame.
    """

    action: int
    row: int
    col: int
    choice: int
    value: float
    start: motion.Held
    end: motion.Held
    poses: np.ndarray
    joints: np.ndarray
    apertures: np.ndarray
    seconds: float
    base_pose: np.ndarray


class Decision(NamedTuple):
    """What was decided, with everything that it follows from.

    Attributes:
        close: whether the target is enclosed: close and lift.
        coverage: share of the target's cells in the closing region.
        push: None if the hand should close, or if no push is left.
        refused: (action, what is in the way) of better pushes that the arm cannot make.
        searched: the action that a search has chosen, None without one.
        q: [H, W, K] values; None if the hand should close.
        allowed: [H, W, K] bool.
    """

    close: bool
    coverage: float
    push: Push | None
    refused: tuple[tuple[int, str], ...]
    q: np.ndarray | None
    allowed: np.ndarray
    searched: int | None = None


@dataclass(frozen=True, eq=False, kw_only=True)
class Decider:
    """A policy with its robot and place.

    Attributes:
        contract: of the bundle.
        values: from `policy.load_values`.
        body: of the robot.
        workspace: with the walls that are kept clear of.
    """

    contract: Contract
    values: Values
    body: Body
    workspace: Workspace

    def start(self) -> motion.Held:
        """Return how the hand is held before the first push."""
        entry = self.contract.action
        widest = max(entry.choices, key=lambda choice: choice.aperture_rad)
        return _held(np.array(entry.start_m), widest)

    def decide(
        self,
        maps: Maps,
        hand: motion.Held,
        joint_pos: np.ndarray,
        *,
        search: Callable[[], int] | None = None,
        lap: Callable[[str], None] = lambda _: None,
    ) -> Decision:
        """Return what to do next.

        Args:
            maps: what is seen.
            hand: commanded end of the last push; `start` before the first.
            joint_pos: [J] rad, measured.
            search: asked for a push unless it is time to close; if the arm cannot make that one, the network counts.
            lap: told when a part of the work is done.

        Raises:
            ValueError: joints or maps are not usable, or the target is not seen.
        """
        entry = self.contract.action
        joint_pos = refuse_joints(joint_pos, self.contract)
        labels = self.contract.grid.labels
        if not (maps.labels == labels["target"]).any():
            raise ValueError(
                "no cell of the map shows the target: its mask lies outside of the workspace, or has no depth"
            )
        allowed = allowed_pushes(entry, hand)
        coverage = self.coverage(maps, joint_pos)
        open_choices = [choice.aperture_rad for choice in entry.choices if choice.has_region]
        region_exists = any(abs(float(hand.aperture) - aperture) < 1e-3 for aperture in open_choices)
        end = self.contract.end
        if end is not None and region_exists and coverage > end.coverage:
            return Decision(True, coverage, None, (), None, allowed)
        p1 = np.asarray(hand.xy, np.float32)
        lap("region")
        q = self.values(maps.height_m[None], maps.labels[None], p1[None])[0]
        lap("network")
        searched = None
        if search is not None:
            searched = search()
            lap("search")
        push, refused = self._best(q, allowed, hand, joint_pos, first=searched)
        return Decision(False, coverage, push, refused, q, allowed, searched)

    def coverage(self, maps: Maps, joint_pos: np.ndarray) -> float:
        """Return the share of the target's cells that lie in the closing region of the hand where it is now."""
        end = self.contract.end
        if end is None:
            return 0.0
        region = ClosingRegion(np.array(end.stations_m), np.array(end.half_width_m), True)
        pose = kinematics.grasp_pose(self.body.arm, joint_pos[:6])
        row, col = np.nonzero(maps.labels == self.contract.grid.labels["target"])
        offset = grid.cell_to_world(row, col) - pose[:2]
        yaw = 2 * np.arctan2(pose[6], pose[3])
        turn = np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]])
        return float(region.holds(offset @ turn).mean())

    def plan(self, action: int, value: float, hand: motion.Held, joint_pos: np.ndarray) -> tuple[Push, str]:
        """Return a push and what is in its way, "" if nothing is."""
        space, entry = action_space(self.contract.action), self.contract.action
        row, col, choice = (int(x) for x in space.unravel(np.int32(action)))
        end = _held(grid.cell_to_world(np.float64(row), np.float64(col)), entry.choices[choice])
        longest = entry.r_out_m / entry.push_speed_m_s + entry.aperture_s + entry.settle_s + np.pi / motion.TURN_SPEED
        times = DT * np.arange(int(np.ceil(longest / DT)) + 1)
        line = motion.straight_line(hand, end, times, push_speed=entry.push_speed_m_s, shortest=DT)
        rows = min(int(np.ceil(float(line.seconds) / DT)) + 1, len(times))
        zero = np.zeros(rows)
        half = line.yaw[:rows] / 2
        poses = np.column_stack([line.xy[:rows], line.z[:rows], np.cos(half), zero, zero, np.sin(half)])
        apertures = np.broadcast_to(line.aperture[:rows], (rows,))
        found = follow(self.body, joint_pos[:6], poses, apertures, self.workspace, dt=DT)
        pose = _in_base(self.body, poses[-1])
        seconds = float(line.seconds)
        push = Push(action, row, col, choice, value, hand, end, poses, found.path, apertures, seconds, pose)
        return push, _obstruction(found)

    def _best(
        self, q: np.ndarray, allowed: np.ndarray, hand: motion.Held, joint_pos: np.ndarray, *, first: int | None = None
    ) -> tuple[Push | None, tuple[tuple[int, str], ...]]:
        """Return the best push that the arm can make, `first` before all others, and the better ones that it cannot.

        Those near to a refused one are left out, as in `policies.learned.best_reachable`.
        """
        space, left, refused = action_space(self.contract.action), allowed & np.isfinite(q), []
        order = np.where(left, q, -np.inf)
        if first is not None:
            order.flat[first] = np.inf
        while left.any():
            action = int(np.argmax(np.where(left, order, -np.inf)))
            push, obstruction = self.plan(action, float(q.flat[action]), hand, joint_pos)
            if not obstruction:
                return push, tuple(refused)
            refused.append((action, obstruction))
            left = left & ~space.near(action, REFUSED_RADIUS)
        return None, tuple(refused)


def action_space(entry: ActionEntry) -> ActionSpace:
    """Return the action space of a contract."""
    choices = tuple(Choice(name=c.name, z=c.z_m, yaw=c.yaw_rad, aperture=c.aperture_rad) for c in entry.choices)
    return ActionSpace(choices, mirrored=tuple(range(len(choices))))


def allowed_pushes(entry: ActionEntry, hand: motion.Held) -> np.ndarray:
    """Return which pushes [H, W, K] bool are allowed next; `Primitive.mask`."""
    ring = grid.half_ring(
        np.asarray(hand.xy, np.float32), r_in=entry.r_in_m, r_out=entry.r_out_m, yaw=hand.yaw, full=entry.full_ring
    )
    return np.broadcast_to(ring[..., None], action_space(entry).shape)


def workspace_of(contract: Contract) -> Workspace:
    """Return the place of a contract, walls included."""
    place = contract.place
    low, high = (
        tuple(outward if value is None else value for value in values)
        for values, outward in ((place.low_m, -np.inf), (place.high_m, np.inf))
    )
    walls = tuple(
        Box(center=tuple(wall["center_m"]), half_size=tuple(wall["half_size_m"]), yaw=wall["yaw_rad"])
        for wall in place.walls
    )
    return Workspace(name=place.name, low=low, high=high, walls=walls)  # pyright: ignore[reportArgumentType]


def refuse_joints(joint_pos: Any, contract: Contract) -> np.ndarray:
    """Return joints [J] float64.

    Raises:
        ValueError: another number of them, not finite, or beyond the limits of the arm (degrees are).
    """
    joints = np.asarray(joint_pos, float)
    names = contract.robot.joints
    if joints.shape != (len(names),):
        raise ValueError(
            f"joint positions have shape {list(joints.shape)}; allowed are {len(names)}: {', '.join(names)}"
        )
    if not np.isfinite(joints).all():
        raise ValueError("joint positions hold NaN or infinity; allowed are finite numbers in rad")
    if contract.robot.limits_rad is not None:
        low, high = np.array(contract.robot.limits_rad).T
        beyond = np.flatnonzero((joints[:6] < low - 0.01) | (joints[:6] > high + 0.01))
        if beyond.size:
            first = int(beyond[0])
            raise ValueError(
                f"joint {names[first]} is at {joints[first]:.3f} rad; allowed is {low[first]:.3f} to {high[first]:.3f} "
                "(are these degrees?)"
            )
    return joints


def _held(xy: np.ndarray, choice: ChoiceEntry) -> motion.Held:
    values = (np.float64(value) for value in (choice.z_m, choice.yaw_rad, choice.aperture_rad))
    return motion.Held(np.asarray(xy, float), *values)


def _in_base(body: Body, pose: np.ndarray) -> np.ndarray:
    """Return a pose [7] of the table frame in the robot's base frame."""
    in_world = rigid_motion(quat_to_matrix(pose[3:]), pose[:3])
    return matrix_to_pose(matrix_product(rigid_inverse(body.arm.world_from_base), in_world))


def _obstruction(found: Followed) -> str:
    """Return the first thing in the way along a path, "" if there is none."""
    rows = np.stack(list(found.holds.values()))
    if not rows.any():
        return ""
    first = int(rows.any(axis=0).argmax())
    return list(found.holds)[int(rows[:, first].argmax())]
