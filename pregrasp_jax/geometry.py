"""Poses, half-spaces and vertical rays: the few lines of geometry that every stage shares.

A pose is ``[x, y, z, qw, qx, qy, qz]``. All functions are unbatched; `jax.vmap` them.
"""

import jax
import jax.numpy as jnp
import numpy as np

_VERTICAL = 1e-6
"""Faces with |n_z| below this are vertical: they bound a vertical ray's x and y only."""


def quat_multiply(a: jax.Array, b: jax.Array) -> jax.Array:
    """Return the Hamilton product of two wxyz quaternions, [4]."""
    aw, ax, ay, az = a
    bw, bx, by, bz = b
    return jnp.stack(
        [
            aw * bw - ax * bx - ay * by - az * bz,
            aw * bx + ax * bw + ay * bz - az * by,
            aw * by - ax * bz + ay * bw + az * bx,
            aw * bz + ax * by - ay * bx + az * bw,
        ]
    )


def quat_from_yaw(yaw: jax.Array) -> jax.Array:
    """Return the wxyz quaternion [4] of a rotation by `yaw` rad about z."""
    zero = jnp.zeros_like(yaw)
    return jnp.stack([jnp.cos(yaw / 2), zero, zero, jnp.sin(yaw / 2)])


def quat_to_matrix(quat: jax.Array) -> jax.Array:
    """Return the rotation matrix [3, 3] of a unit wxyz quaternion [4]."""
    w, x, y, z = quat
    return jnp.stack(
        [
            jnp.stack([1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)]),
            jnp.stack([2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)]),
            jnp.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)]),
        ]
    )


def transform_points(pose: jax.Array, points: jax.Array) -> jax.Array:
    """Move points [..., 3] from the pose's frame to the frame the pose is given in."""
    return _product(points, quat_to_matrix(pose[3:]).T) + jnp.broadcast_to(pose[:3], points.shape)


def transform_planes(pose: jax.Array, planes: jax.Array) -> jax.Array:
    """Move half-spaces [F, 4] (n . x <= d) the way `transform_points` moves points."""
    normals = _product(planes[:, :3], quat_to_matrix(pose[3:]).T)
    return jnp.concatenate([normals, planes[:, 3:] + _product(normals, pose[:3, None])], axis=-1)


def _product(a: jax.Array, b: jax.Array) -> jax.Array:
    """Multiply matrices in full float32: what accelerators do by default is off by tenths of a millimetre here."""
    return jnp.matmul(a, b, precision=jax.lax.Precision.HIGHEST)


def vertical_interval(planes: jax.Array, x: jax.Array, y: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Intersect vertical rays with one convex hull.

    Args:
        planes: [F, 4] half-spaces n . x <= d, in the frame of the rays.
        x: [...] ray positions, m.
        y: [...] like `x`.

    Returns:
        z_bottom and z_top, [...] m; the ray hits iff z_top >= z_bottom. A ray outside a vertical face gets
        z_top = -inf.
    """
    x, y = x[..., None], y[..., None]
    nx, ny, nz, d = jnp.expand_dims(planes.T, tuple(range(1, x.ndim)))
    rest = d - nx * x - ny * y
    up, down = nz > _VERTICAL, nz < -_VERTICAL
    z = rest / jnp.where(up | down, nz, 1.0)
    z_top = jnp.min(jnp.where(up, z, jnp.inf), axis=-1)
    z_bottom = jnp.max(jnp.where(down, z, -jnp.inf), axis=-1)
    outside = jnp.any(~(up | down) & (rest < 0), axis=-1)
    return z_bottom, jnp.where(outside, -jnp.inf, z_top)


def matrix_to_pose(matrix: jax.Array) -> jax.Array:
    """Return the pose [7] of a homogeneous matrix [4, 4], with qw >= 0.

    Each row of the candidates is the quaternion times four times one of its components; the largest is stable.
    """
    (m00, m01, m02), (m10, m11, m12), (m20, m21, m22) = matrix[:3, :3]
    candidates = jnp.stack(
        [
            jnp.stack([1 + m00 + m11 + m22, m21 - m12, m02 - m20, m10 - m01]),
            jnp.stack([m21 - m12, 1 + m00 - m11 - m22, m10 + m01, m02 + m20]),
            jnp.stack([m02 - m20, m10 + m01, 1 - m00 + m11 - m22, m21 + m12]),
            jnp.stack([m10 - m01, m02 + m20, m21 + m12, 1 - m00 - m11 + m22]),
        ]
    )
    quat = candidates[jnp.argmax(jnp.diagonal(candidates))]
    quat = quat / jnp.linalg.norm(quat)
    return jnp.concatenate([matrix[:3, 3], jnp.where(quat[0] < 0, -quat, quat)])


def matrix_product(a: jax.Array | np.ndarray, b: jax.Array | np.ndarray) -> jax.Array:
    """Return a @ b for [..., 4, 4] in full float32; written as a sum, which XLA vectorizes over a batch."""
    a, b = jnp.asarray(a, jnp.float32), jnp.asarray(b, jnp.float32)
    return jnp.sum(a[..., :, :, None] * b[..., None, :, :], axis=-2)
