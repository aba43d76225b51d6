"""What is seen of a set of hulls: exact heights from straight above, or depth through a pinhole."""

import flax.struct as struct
import jax
import jax.numpy as jnp

from pregrasp_jax.heightmap.rasterizer import PixelHulls, decode_key, encode_key, rasterize
from pregrasp_jax.spaces import grid
from pregrasp_jax.types import TABLE_ID

HEIGHT_LIMIT = 2.0
"""m; nothing of a UR5e on the table reaches higher (its reach is 0.85 m). Heights are exact to 0.24 um."""

NEAR = 0.1
"""m; a pinhole sees nothing nearer, as no depth camera does. At 1 m, depth is exact to 1.2 um."""


class HullInstances(struct.PyTreeNode):
    """K convex hulls placed in the world.

    Attributes:
        planes: [K, F, 4] float32 rows (n, d), inside iff n . x <= d, world frame, m.
        vertices: [K, V, 3] float32 m, world frame.
        labels: [K] uint8 instance id: slot + 1 or `ROBOT_ID`.
        present: [K] bool; absent hulls are not drawn.
    """

    planes: jax.Array
    vertices: jax.Array
    labels: jax.Array
    present: jax.Array


class Camera(struct.PyTreeNode):
    """A pinhole camera with square pixels and the principal point at the image centre (MuJoCo's conventions).

    Attributes:
        position: [3] m, world frame.
        rotation: [3, 3] camera axes as columns, in the world: x right, y up in the image, looking along -z.
            The identity looks straight down with world +x right and +y up.
        fovy: () rad, vertical field of view.
        shape: pixels (rows, columns).
    """

    position: jax.Array
    rotation: jax.Array
    fovy: jax.Array
    shape: tuple[int, int] = struct.field(pytree_node=False, default=(480, 640))

    @property
    def focal(self) -> jax.Array:
        """Return the focal length () in pixels."""
        return self.shape[0] / 2 / jnp.tan(self.fovy / 2)


def orthographic(hulls: HullInstances) -> tuple[jax.Array, jax.Array]:
    """Look straight down on the grid from infinitely high: at each cell centre the highest surface wins.

    Args:
        hulls: what stands on the table, robot included (unbatched).

    Returns:
        height [H, W] float32 m above the table, not clipped to `grid.MAX_HEIGHT`, and instance ids [H, W]
        uint8; table cells hold 0 and `TABLE_ID`.

    Source:
        The upward back-projection of Sec. III-B, without occlusion; `mj_ray` straight down on the same hulls
        agrees within 0.1 mm.
    """
    step, start = grid.HEIGHTMAP_RESOLUTION, grid.cell_centers()[0]
    nx, ny, nz, d = jnp.moveaxis(hulls.planes, -1, 0)
    coefficients = jnp.stack([nx * step, ny * step, (nx + ny) * start - d, -nz], axis=-1)
    cells = (hulls.vertices[..., 1::-1] - start) / step
    box = jnp.concatenate([cells.min(axis=1), cells.max(axis=1)], axis=-1)
    drawn = PixelHulls(coefficients=coefficients, box=box, labels=hulls.labels, present=hulls.present)
    return rasterize(drawn, shape=(grid.GRID_SIZE, grid.GRID_SIZE), limit=HEIGHT_LIMIT)


def render_pinhole(hulls: HullInstances, camera: Camera) -> tuple[jax.Array, jax.Array]:
    """Take a depth and an instance image.

    Args:
        hulls: what stands on the table (unbatched).
        camera: from where; above the table, which is the unbounded plane z = 0.

    Returns:
        depth [rows, columns] float32 m along the optical axis, inf above the horizon, and labels
        [rows, columns] uint8, `TABLE_ID` where no hull is seen. Row 0 is the top of the image.

    Source:
        Agrees with `mj_ray` from the camera through the pixel centres.
    """
    rows, columns = camera.shape
    nx, ny, nz = jnp.moveaxis(_rotate(hulls.planes[..., :3], camera.rotation.T), -1, 0)
    offset = hulls.planes[..., 3] - jnp.sum(hulls.planes[..., :3] * camera.position[None, None, :], axis=-1)
    per_col, per_row = nx / camera.focal, -ny / camera.focal
    at_origin = -nz - per_col * (columns - 1) / 2 - per_row * (rows - 1) / 2
    coefficients = jnp.stack([per_col, per_row, at_origin, offset], axis=-1)
    drawn = PixelHulls(
        coefficients=coefficients, box=_pixel_box(hulls.vertices, camera), labels=hulls.labels, present=hulls.present
    )
    inverse_depth, labels = rasterize(drawn, shape=camera.shape, limit=1 / NEAR, tile=32, chunk=32)
    of_table = jnp.maximum(-_rays(camera)[..., 2] / camera.position[2], 0.0)
    return 1 / jnp.maximum(inverse_depth, of_table), jnp.where(inverse_depth > of_table, labels, TABLE_ID)


def pinhole(hulls: HullInstances, camera: Camera) -> tuple[jax.Array, jax.Array]:
    """Look through a pinhole, unproject to points and project them upward to the grid, occlusion included.

    Args:
        hulls: what stands on the table, robot included (unbatched).
        camera: from where.

    Returns:
        As `orthographic`: per cell the highest point that the camera sees; cells without a point are table.

    Source:
        Sec. III-B of the paper.
    """
    depth, labels = render_pinhole(hulls, camera)
    return project_upward(unproject(depth, camera), labels)


def project_upward(
    points: jax.Array, labels: jax.Array, valid: jax.Array | None = None, *, cell: str = "max"
) -> tuple[jax.Array, jax.Array]:
    """Project points upward to the grid.

    Args:
        points: [..., 3] m in the world.
        labels: [...] uint8.
        valid: [...] bool, which of them are points at all; None is all.
        cell: which of the points above a cell is its height: `max`, the `second` highest (the only one where there is
            but one), or the `median` (of an even number the higher one).

    Returns:
        height [H, W] float32 m and the label of that point; cells without a point are table.
    """
    row, col = grid.world_to_cell(points[..., :2])
    on_grid = (jnp.minimum(row, col) >= 0) & (jnp.maximum(row, col) < grid.GRID_SIZE)
    on_grid &= True if valid is None else valid
    num_cells = grid.GRID_SIZE**2
    index = jnp.where(on_grid, row * grid.GRID_SIZE + col, num_cells).ravel()
    keys = encode_key(points[..., 2], labels, HEIGHT_LIMIT).ravel()
    if cell == "median":
        chosen = _median_keys(index, keys, num_cells)
    else:
        chosen = jnp.zeros(num_cells, jnp.int32).at[index].max(keys, mode="drop")
        if cell == "second":
            chosen = _second_keys(index, keys, chosen)
    return decode_key(chosen.reshape(grid.GRID_SIZE, grid.GRID_SIZE), HEIGHT_LIMIT)


def _second_keys(index: jax.Array, keys: jax.Array, highest: jax.Array) -> jax.Array:
    """Return the second largest of the keys [P] of every cell, given the largest [C]; that one where it is alone."""
    order = jnp.arange(len(keys))
    largest = keys == jnp.append(highest, -1)[index]
    winner = jnp.full(len(highest), -1).at[index].max(jnp.where(largest, order, -1), mode="drop")
    rest = jnp.where(order == jnp.append(winner, -1)[index], -1, keys)
    second = jnp.full(len(highest), -1).at[index].max(rest, mode="drop")
    return jnp.where(second < 0, highest, second)


def _median_keys(index: jax.Array, keys: jax.Array, num_cells: int) -> jax.Array:
    """Return the median of the keys [P] of every cell, the upper one of two; 0 where there is none."""
    cells, keys = jax.lax.sort((index, keys), num_keys=2)
    first = jnp.searchsorted(cells, jnp.arange(num_cells + 1))
    count = first[1:] - first[:-1]
    middle = keys[jnp.minimum(first[:-1] + count // 2, len(keys) - 1)]
    return jnp.where(count > 0, middle, 0)


def unproject(depth: jax.Array, camera: Camera) -> jax.Array:
    """Return the world points [rows, columns, 3] m of a depth image [rows, columns] m."""
    assert depth.shape == camera.shape, (depth.shape, camera.shape)
    return depth[..., None] * _rays(camera) + camera.position[None, None, :]


def _rays(camera: Camera) -> jax.Array:
    """Return the directions [rows, columns, 3] through the pixel centres, at depth 1 m, in the world."""
    rows, columns = camera.shape
    u = (jnp.arange(columns) - (columns - 1) / 2) / camera.focal
    v = ((rows - 1) / 2 - jnp.arange(rows)) / camera.focal
    return _rotate(jnp.stack([*jnp.meshgrid(u, v), -jnp.ones(camera.shape)], axis=-1), camera.rotation)


def _rotate(vectors: jax.Array, rotation: jax.Array) -> jax.Array:
    """Apply a rotation [3, 3] to vectors [..., 3] in full float32; accelerators would round the factors."""
    return jnp.matmul(vectors, rotation.T, precision=jax.lax.Precision.HIGHEST)


def _pixel_box(vertices: jax.Array, camera: Camera) -> jax.Array:
    """Return the box [K, 4] in pixels around hulls with vertices [K, V, 3]; the image where one comes too near."""
    local = _rotate(vertices - camera.position[None, None, :], camera.rotation.T)
    depth = -local[..., 2]
    rows, columns = camera.shape
    scale = camera.focal / jnp.maximum(depth, NEAR)
    col = local[..., 0] * scale + (columns - 1) / 2
    row = (rows - 1) / 2 - local[..., 1] * scale
    box = jnp.stack([row.min(axis=1), col.min(axis=1), row.max(axis=1), col.max(axis=1)], axis=-1)
    image = jnp.array([0.0, 0.0, rows - 1, columns - 1])
    return jnp.where((depth.min(axis=1) < NEAR)[:, None], image[None, :], box)
