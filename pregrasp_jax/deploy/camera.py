"""A camera as its maker and its calibration describe it, and the images that it gives.

The frame here is the optical one (x right, y down, z forward); `frame: mujoco` (x right, y up, looking along -z) is
turned into it. Pixel centres are at integers.
"""

import functools
from dataclasses import dataclass

import numpy as np

_OPTICAL_FROM_MUJOCO = np.diag([1.0, -1.0, -1.0])

_ROTATION_ERROR = 1e-3
"""How far a rotation may be off: its determinant from 1, R^T R from the identity."""

_UNDISTORT_STEPS = 8
"""Of the fixed-point search; 1e-6 of a pixel for the lenses of depth cameras."""


@dataclass(frozen=True, eq=False, kw_only=True)
class PinholeCamera:
    """Intrinsics and pose.

    Attributes:
        matrix: [3, 3] K, pixels.
        world_from_optical: [4, 4] m.
        shape: (rows, columns).
        distortion: (k1, k2, p1, p2, k3) of Brown's model, as CameraInfo has them for `plumb_bob`.
    """

    matrix: np.ndarray
    world_from_optical: np.ndarray
    shape: tuple[int, int]
    distortion: tuple[float, ...] = (0.0,) * 5

    def __post_init__(self):
        k = np.asarray(self.matrix, float)
        if (
            k.shape != (3, 3)
            or not np.isfinite(k).all()
            or min(k[0, 0], k[1, 1]) <= 1
            or k[2, 2] != 1
            or k[2, :2].any()
        ):
            raise ValueError(
                f"camera intrinsics are {k.tolist()}; allowed is [[fx, 0, cx], [0, fy, cy], [0, 0, 1]] in pixels"
            )
        if not (0 <= k[0, 2] < self.shape[1] and 0 <= k[1, 2] < self.shape[0]):
            raise ValueError(
                f"camera: principal point ({k[0, 2]:g}, {k[1, 2]:g}) is outside of the image of {self.shape[1]} x "
                f"{self.shape[0]} pixels; allowed is inside, as x, y"
            )
        if len(self.distortion) != 5 or not np.isfinite(self.distortion).all():
            raise ValueError(f"camera distortion is {self.distortion}; allowed are five numbers k1, k2, p1, p2, k3")
        refuse_pose(self.world_from_optical, what="camera pose")
        if self.world_from_optical[2, 3] <= 0:
            raise ValueError(
                f"camera pose: it is at z = {self.world_from_optical[2, 3]:.3f} m, below the table; allowed is above"
            )

    def project(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return pixels [..., 2] (column, row) and depth [...] m of world points [..., 3]; undoes `rays`."""
        turn, place = self.world_from_optical[:3, :3], self.world_from_optical[:3, 3]
        local = (points - place) @ turn
        depth = local[..., 2]
        x, y = np.moveaxis(local[..., :2] / np.maximum(depth, 1e-6)[..., None], -1, 0)
        if any(self.distortion):
            x, y = _distorted(x, y, self.distortion, within=self._widest)
        col = self.matrix[0, 0] * x + self.matrix[0, 2]
        row = self.matrix[1, 1] * y + self.matrix[1, 2]
        return np.stack([col, row], axis=-1), depth

    @functools.cached_property
    def _widest(self) -> float:
        """Return how far from the axis, at depth 1 m, the ray through the farthest corner of the image is."""
        k, (rows, columns) = self.matrix, self.shape
        v, u = np.meshgrid([0.0, rows - 1.0], [0.0, columns - 1.0])
        x, y = _undistorted((u - k[0, 2]) / k[0, 0], (v - k[1, 2]) / k[1, 1], self.distortion)
        return float(np.hypot(x, y).max())

    def rays(self, rows: slice, columns: slice) -> np.ndarray:
        """Return directions [3, R, C] float32 through pixels of a part of the image, at depth 1 m, in the world."""
        v, u = np.meshgrid(np.arange(rows.start, rows.stop), np.arange(columns.start, columns.stop), indexing="ij")
        k = self.matrix
        x, y = (u - k[0, 2]) / k[0, 0], (v - k[1, 2]) / k[1, 1]
        if any(self.distortion):
            x, y = _undistorted(x, y, self.distortion)
        local = np.stack([x, y, np.ones_like(x)])
        return np.tensordot(self.world_from_optical[:3, :3], local, axes=1).astype(np.float32)


def _bend(x: np.ndarray, y: np.ndarray, distortion: tuple[float, ...]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return by what a lens multiplies and shifts (x, y), at depth 1 m: factor, shift of x, shift of y (Brown 1966)."""
    k1, k2, p1, p2, k3 = distortion
    r2 = x**2 + y**2
    factor = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    return factor, 2 * p1 * x * y + p2 * (r2 + 2 * x**2), p1 * (r2 + 2 * y**2) + 2 * p2 * x * y


def _distorted(
    x: np.ndarray, y: np.ndarray, distortion: tuple[float, ...], *, within: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return where a lens bends rays to.

    Farther from the axis than `within`, where the image ends and the polynomials fold back, it bends as it does there.
    """
    inside = within / np.maximum(np.hypot(x, y), within)
    factor, dx, dy = _bend(x * inside, y * inside, distortion)
    return x * factor + dx, y * factor + dy


def _undistorted(x: np.ndarray, y: np.ndarray, distortion: tuple[float, ...]) -> tuple[np.ndarray, np.ndarray]:
    """Return where rays go that a lens has bent to (x, y), by fixed-point iteration."""
    found_x, found_y = x, y
    for _ in range(_UNDISTORT_STEPS):
        factor, dx, dy = _bend(found_x, found_y, distortion)
        found_x, found_y = (x - dx) / factor, (y - dy) / factor
    return found_x, found_y


def refuse_pose(matrix: np.ndarray, *, what: str) -> None:
    """Refuse a matrix [4, 4] that is no rigid motion.

    Raises:
        ValueError: the line says what is wrong with it.
    """
    matrix = np.asarray(matrix, float)
    if matrix.shape != (4, 4) or not np.isfinite(matrix).all():
        raise ValueError(f"{what} has shape {list(matrix.shape)} or is not finite; allowed is a 4 x 4 matrix")
    turn = matrix[:3, :3]
    off = max(abs(np.linalg.det(turn) - 1), np.abs(turn.T @ turn - np.eye(3)).max())
    if off > _ROTATION_ERROR or np.abs(matrix[3] - [0, 0, 0, 1]).max() > _ROTATION_ERROR:
        raise ValueError(f"{what} is no rotation and shift (off by {off:.3g}); allowed is {_ROTATION_ERROR:g}")
    if np.abs(matrix[:3, 3]).max() > 10:
        raise ValueError(
            f"{what} lies {np.abs(matrix[:3, 3]).max():g} m away; allowed is 10 m (are these millimetres?)"
        )


def optical_from(pose: np.ndarray, frame: str) -> np.ndarray:
    """Return the pose of the optical frame, given that of a frame in either convention."""
    if frame == "optical":
        return pose
    turned = pose.copy()
    turned[:3, :3] = pose[:3, :3] @ _OPTICAL_FROM_MUJOCO
    return turned


def centred_camera(*, focal_px: float, shape: tuple[int, int], pose: np.ndarray) -> PinholeCamera:
    """Return a camera whose principal point is the middle of its image.

    Args:
        focal_px: in both directions.
        shape: (rows, columns).
        pose: [4, 4] m, of its frame as MuJoCo has it.
    """
    matrix = np.array([[focal_px, 0, (shape[1] - 1) / 2], [0, focal_px, (shape[0] - 1) / 2], [0, 0, 1]])
    return PinholeCamera(matrix=matrix, world_from_optical=optical_from(pose, "mujoco"), shape=shape)


def depth_in_metres(depth: np.ndarray, *, scale: float | None, shape: tuple[int, int]) -> np.ndarray:
    """Return a depth image [rows, columns] float32 m with NaN where there is none.

    Args:
        depth: metres as floats (NaN, infinity or 0: none), or integers times `scale` (0: none).
        scale: m per step; None is 1 for floats and 0.001 for integers, as REP 118 has it.
        shape: (rows, columns) that the camera gives.

    Raises:
        ValueError: another shape or type, nothing measured, or numbers that cannot be metres.
    """
    depth = np.asarray(depth)
    if depth.shape != shape:
        raise ValueError(f"depth image has shape {list(depth.shape)}; allowed is {list(shape)}, as the camera says")
    if depth.dtype.kind not in "fui" or depth.dtype == np.uint8:
        raise ValueError(f"depth image is of {depth.dtype}; allowed are floats (m) and 16-bit integers (steps)")
    steps = depth.dtype.kind in "ui"
    metres = depth.astype(np.float32) * np.float32(scale if scale is not None else (0.001 if steps else 1.0))
    metres = np.where(np.isfinite(metres) & (metres > 0), metres, np.nan)
    measured = metres[np.isfinite(metres)]
    if measured.size < 0.05 * metres.size:
        raise ValueError(f"depth image: {measured.size / metres.size:.0%} of it has a depth; allowed is 5 % and more")
    middle = float(np.median(measured))
    if not 0.15 <= middle <= 5.0:
        raise ValueError(
            f"depth image: the median is {middle:g} m; allowed is 0.15 to 5 m (floats are metres, integers are "
            f"`camera.depth_scale` metres; are these millimetres?)"
        )
    return metres
