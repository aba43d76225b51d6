"""Does the calibration fit the table? Asked of one depth image of it; objects and robot may stand on parts of it."""

from typing import NamedTuple

import numpy as np

from pregrasp_jax.deploy.decision import Decider, action_space, allowed_pushes
from pregrasp_jax.deploy.view import View
from pregrasp_jax.spaces import grid

_INLIER = 0.02
"""m from the table that a point of it may be."""

_ROUNDS = 4
"""Of fitting the plane to what is near it."""


class CalibrationReport(NamedTuple):
    """Numbers of a calibration.

    Attributes:
        seen: share of the pixels on the workspace that have a depth.
        on_table: share of these within 20 mm of the plane.
        offset_m: of the plane above the table at the centre; a good calibration has 0.
        tilt_deg: of the plane.
        slope_x_deg: about y, rising with x.
        slope_y_deg: about x, rising with y.
        noise_m: deviation of points from the plane.
        pixels_per_cell: on the table.
        reachable: share of the pushes from the start that the arm can make (every tenth is tried).
        deviation_m: [H, W] of the lowest point above each cell, NaN without one.
    """

    seen: float
    on_table: float
    offset_m: float
    tilt_deg: float
    slope_x_deg: float
    slope_y_deg: float
    noise_m: float
    pixels_per_cell: float
    reachable: float
    deviation_m: np.ndarray

    def _findings(self) -> list[tuple[str, str, bool]]:
        """Return (what was measured, what is good, whether it is)."""
        tilt = f"{self.tilt_deg:.2f} degrees, {self.slope_x_deg:+.2f} along x, {self.slope_y_deg:+.2f} along y"
        return [
            (f"depth on the workspace   {self.seen:.1%} of its pixels", "above 90 %", self.seen > 0.9),
            (
                f"on the table             {self.on_table:.1%} of these within 20 mm of the plane",
                "above 60 %",
                self.on_table > 0.6,
            ),
            (
                f"height of the table      {self.offset_m * 1e3:+.1f} mm",
                "within 3 mm; table.height_m moves it",
                abs(self.offset_m) < 0.003,
            ),
            (f"tilt                     {tilt}", "below 0.5", self.tilt_deg < 0.5),
            (f"noise                    {self.noise_m * 1e3:.1f} mm", "below 5 mm", self.noise_m < 0.005),
            (
                f"resolution               {self.pixels_per_cell:.1f} pixels per cell",
                "above 4",
                self.pixels_per_cell > 4,
            ),
            (
                f"reach                    {self.reachable:.0%} of the pushes from the start",
                "100 %",
                self.reachable == 1,
            ),
        ]

    def lines(self) -> list[str]:
        """Return it as text, each line with whether it is good."""
        return [f"{found} ({'good' if fine else 'NOT GOOD'}: {wanted})" for found, wanted, fine in self._findings()]

    @property
    def good(self) -> bool:
        """Whether all numbers are."""
        return all(fine for _, _, fine in self._findings())


def check_calibration(depth_m: np.ndarray, *, view: View, decider: Decider) -> CalibrationReport:
    """Return the numbers for a depth image [rows, columns] m, NaN where there is none.

    Raises:
        ValueError: too little of the table is seen to fit a plane.
    """
    depth, place = view.cut(depth_m), view.camera.world_from_optical[:3, 3].astype(np.float32)
    points = (view.rays * depth + place[:, None, None]).reshape(3, -1).T
    of_table = view.rays * (-place[2] / np.minimum(view.rays[2], -1e-3)) + place[:, None, None]
    looks_at = (np.abs(of_table[:2]) <= grid.WORKSPACE_HALF_SIZE).all(axis=0).ravel()
    known = np.isfinite(points).all(axis=1) & looks_at
    plane, near = _fit(points[known])
    off = points[known][:, 2] - points[known][:, :2] @ plane[:2] - plane[2]
    slope_x, slope_y = np.degrees(np.arctan(plane[:2]))
    return CalibrationReport(
        seen=float(known.sum() / max(looks_at.sum(), 1)),
        on_table=float(near.mean()),
        offset_m=float(plane[2]),
        tilt_deg=float(np.degrees(np.arctan(np.hypot(*plane[:2])))),
        slope_x_deg=float(slope_x),
        slope_y_deg=float(slope_y),
        noise_m=float(off[near].std()),
        pixels_per_cell=float(looks_at.sum() / grid.GRID_SIZE**2),
        reachable=_reachable(decider),
        deviation_m=_lowest(points[known]),
    )


def draw_report(report: CalibrationReport) -> np.ndarray:
    """Return a map of the table [size, size, 3] uint8: white is right, red 10 mm too high, blue 10 mm too low."""
    from pregrasp_jax.drawing import maps

    share = np.clip(np.nan_to_num(report.deviation_m) / 0.010, -1, 1)[..., None]
    white, red, blue = (np.array(color, float) for color in ((255, 255, 255), (200, 40, 30), (30, 60, 200)))
    colors = np.where(share > 0, white + share * (red - white), white - share * (blue - white))
    colors = np.where(np.isnan(report.deviation_m)[..., None], 90.0, colors)
    return maps.as_map(colors, 500)


def _fit(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return (a, b, c) of z = a x + b y + c through points [P, 3] near the table, and which [P] bool are near it."""
    if len(points) < 1000:
        raise ValueError(f"{len(points)} pixels on the workspace have a depth; allowed is 1000 and more")
    middle = float(np.median(points[:, 2]))
    near = np.abs(points[:, 2] - middle) < 2 * _INLIER
    plane = np.array([0.0, 0.0, middle])
    for _ in range(_ROUNDS):
        if near.sum() < 1000:
            raise ValueError(
                "most of what the camera sees on the workspace is no plane; allowed is a mostly empty table"
            )
        columns = np.column_stack([points[near, :2], np.ones(near.sum())])
        plane = np.linalg.lstsq(columns.astype(float), points[near, 2].astype(float), rcond=None)[0]
        near = np.abs(points[:, 2] - points[:, :2] @ plane[:2] - plane[2]) < _INLIER
    return plane, near


def _reachable(decider: Decider) -> float:
    """Return the share of every tenth push from the start that the arm can make."""
    hand, joints = decider.start(), np.array(decider.contract.robot.home)
    space = action_space(decider.contract.action)
    actions = np.flatnonzero(np.broadcast_to(allowed_pushes(decider.contract.action, hand), space.shape))[::10]
    return float(np.mean([not decider.plan(int(action), 0.0, hand, joints)[1] for action in actions]))


def _lowest(points: np.ndarray) -> np.ndarray:
    """Return the height [H, W] m of the lowest point above each cell, NaN without one."""
    row, col = grid.world_to_cell(points[:, :2])
    inside = (np.minimum(row, col) >= 0) & (np.maximum(row, col) < grid.GRID_SIZE)
    lowest = np.full(grid.GRID_SIZE**2, np.inf, np.float32)
    np.minimum.at(lowest, (row * grid.GRID_SIZE + col)[inside], points[inside, 2])
    return np.where(np.isinf(lowest), np.nan, lowest).reshape(grid.GRID_SIZE, grid.GRID_SIZE)
