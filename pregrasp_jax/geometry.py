"""Poses, half-spaces and vertical rays: the few lines of geometry that every stage shares.

A pose is ``[x, y, z, qw, qx, qy, qz]``. All functions serve numpy and jax alike. They are unbatched, to be mapped by
`jax.vmap`; those that say [...] broadcast, which numpy needs.
"""

from collections.abc import Callable
from typing import Any

import numpy as np

from pregrasp_jax.spaces.arrays import namespace

Array = Any
"""Of numpy, or of jax."""

_VERTICAL = 1e-6
"""Faces with |n_z| below this are vertical: they bound a vertical ray's x and y only."""


def quat_multiply(a: Array, b: Array) -> Array:
    """Return the Hamilton product of two wxyz quaternions, [4]."""
    aw, ax, ay, az = a
    bw, bx, by, bz = b
    return namespace(a, b).stack(
        [
            aw * bw - ax * bx - ay * by - az * bz,
            aw * bx + ax * bw + ay * bz - az * by,
            aw * by - ax * bz + ay * bw + az * bx,
            aw * bz + ax * by - ay * bx + az * bw,
        ]
    )


def quat_from_yaw(yaw: Array) -> Array:
    """Return the wxyz quaternion [..., 4] of a rotation by `yaw` [...] rad about z."""
    xp = namespace(yaw)
    zero = xp.zeros_like(yaw)
    return xp.stack([xp.cos(yaw / 2), zero, zero, xp.sin(yaw / 2)], axis=-1)


def quat_to_matrix(quat: Array) -> Array:
    """Return the rotation matrix [..., 3, 3] of a unit wxyz quaternion [..., 4]."""
    xp = namespace(quat)
    w, x, y, z = (quat[..., i] for i in range(4))
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return xp.stack([xp.stack(row, axis=-1) for row in rows], axis=-2)


def transform_points(pose: Array, points: Array) -> Array:
    """Move points [..., 3] from the pose's frame to the frame the pose is given in."""
    xp = namespace(pose, points)
    return _product(points, quat_to_matrix(pose[3:]).T) + xp.broadcast_to(pose[:3], points.shape)


def transform_planes(pose: Array, planes: Array) -> Array:
    """Move half-spaces [F, 4] (n . x <= d) the way `transform_points` moves points."""
    normals = _product(planes[:, :3], quat_to_matrix(pose[3:]).T)
    return namespace(normals).concatenate([normals, planes[:, 3:] + _product(normals, pose[:3, None])], axis=-1)


def _product(a: Array, b: Array) -> Array:
    """Multiply matrices in full float32: what accelerators do by default is off by tenths of a millimetre here."""
    xp = namespace(a, b)
    return np.matmul(a, b) if xp is np else xp.matmul(a, b, precision="highest")


def vertical_interval(planes: Array, x: Array, y: Array) -> tuple[Array, Array]:
    """Intersect vertical rays with one convex hull.

    Args:
        planes: [F, 4] half-spaces n . x <= d, in the frame of the rays.
        x: [...] ray positions, m.
        y: [...] like `x`.

    Returns:
        z_bottom and z_top, [...] m; the ray hits iff z_top >= z_bottom. A ray outside a vertical face gets
        z_top = -inf.
    """
    xp = namespace(planes, x, y)
    x, y = x[..., None], y[..., None]
    nx, ny, nz, d = xp.expand_dims(planes.T, tuple(range(1, x.ndim)))
    rest = d - nx * x - ny * y
    up, down = nz > _VERTICAL, nz < -_VERTICAL
    z = rest / xp.where(up | down, nz, 1.0)
    z_top = xp.min(xp.where(up, z, xp.inf), axis=-1)
    z_bottom = xp.max(xp.where(down, z, -xp.inf), axis=-1)
    outside = xp.any(~(up | down) & (rest < 0), axis=-1)
    return z_bottom, xp.where(outside, -xp.inf, z_top)


def matrix_to_pose(matrix: Array) -> Array:
    """Return the pose [7] of a homogeneous matrix [4, 4], with qw >= 0.

    Each row of the candidates is the quaternion times four times one of its components; the largest is stable.
    """
    xp = namespace(matrix)
    (m00, m01, m02), (m10, m11, m12), (m20, m21, m22) = matrix[:3, :3]
    candidates = xp.stack(
        [
            xp.stack([1 + m00 + m11 + m22, m21 - m12, m02 - m20, m10 - m01]),
            xp.stack([m21 - m12, 1 + m00 - m11 - m22, m10 + m01, m02 + m20]),
            xp.stack([m02 - m20, m10 + m01, 1 - m00 + m11 - m22, m21 + m12]),
            xp.stack([m10 - m01, m02 + m20, m21 + m12, 1 - m00 - m11 + m22]),
        ]
    )
    quat = candidates[xp.argmax(xp.diagonal(candidates))]
    quat = quat / xp.linalg.norm(quat)
    return xp.concatenate([matrix[:3, 3], xp.where(quat[0] < 0, -quat, quat)])


def matrix_product(a: Array, b: Array) -> Array:
    """Return a @ b for [..., 4, 4]; for jax in full float32, written as a sum, which XLA vectorizes over a batch."""
    xp = namespace(a, b)
    if xp is np:
        return np.matmul(a, b)
    a, b = xp.asarray(a, xp.float32), xp.asarray(b, xp.float32)
    return xp.sum(a[..., :, :, None] * b[..., None, :, :], axis=-2)


def rigid_inverse(matrix: Array) -> Array:
    """Return the inverse [..., 4, 4] of a rigid motion [..., 4, 4]."""
    xp = namespace(matrix)
    turn = xp.swapaxes(matrix[..., :3, :3], -1, -2)
    place = -xp.sum(turn * matrix[..., None, :3, 3], axis=-1)
    return rigid_motion(turn, place)


def rigid_motion(turn: Array, place: Array) -> Array:
    """Return the matrix [..., 4, 4] that turns by [..., 3, 3] and then moves by [..., 3]."""
    xp = namespace(turn, place)
    upper = xp.concatenate([turn, place[..., None]], axis=-1)
    last = xp.asarray(np.array([[0.0, 0.0, 0.0, 1.0]], np.float32))
    return xp.concatenate([upper, xp.broadcast_to(last, (*upper.shape[:-2], 1, 4))], axis=-2)


def scan(step: Callable[[Any, Any], tuple[Any, Any]], carry: Array, rows: Array) -> tuple[Array, Array]:
    """Return what `jax.lax.scan` does; a loop for numpy."""
    if namespace(carry, rows) is not np:
        import jax

        return jax.lax.scan(step, carry, rows)
    found = []
    for row in rows:
        carry, out = step(carry, row)
        found.append(out)
    return carry, np.stack(found) if found and found[0] is not None else None


def of_rows(function: Callable[[Array], Array], rows: Array) -> Array:
    """Return what a function says of every row: mapped by `jax.vmap`; one that serves numpy broadcasts by itself."""
    if namespace(rows) is np:
        return function(rows)
    import jax

    return jax.vmap(function)(rows)


def repeat(times: int, step: Callable[[Any], Any], carry: Any) -> Any:
    """Return a carry after so many steps: one loop of the compiled program for jax."""
    leaves = carry if isinstance(carry, tuple) else (carry,)
    if namespace(*leaves) is not np:
        import jax

        return jax.lax.fori_loop(0, times, lambda _, carry: step(carry), carry)
    for _ in range(times):
        carry = step(carry)
    return carry
