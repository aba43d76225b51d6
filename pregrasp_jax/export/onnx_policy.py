"""The whole policy as one ONNX graph, from heights in metres to the value of every push.

Everything that could be done wrong outside of it is inside: clipping, the steps in which heights are stored, the mean
and deviation of an image, the window around the hand, the mirror image. It is `QFunction.values` operation by
operation, and tested against it.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import onnx
from onnx import TensorProto, numpy_helper

from pregrasp_jax.config import Config
from pregrasp_jax.export.graph import Graph
from pregrasp_jax.heightmap import SEGMENTATION
from pregrasp_jax.heightmap.observation import MIN_STD
from pregrasp_jax.learning.compact import DOUBLINGS, LOOKS, PATCH, WindowSize, way_weights, window_size
from pregrasp_jax.learning.members import split
from pregrasp_jax.learning.networks import PATH, PATH_READOUT, READOUT, upsample_weights
from pregrasp_jax.spaces import grid
from pregrasp_jax.spaces.actions import ActionSpace

SIZE = grid.GRID_SIZE

INPUTS: dict[str, tuple[str, tuple[int | str, ...]]] = {
    "height_m": ("float32", ("batch", SIZE, SIZE)),
    "labels": ("uint8", ("batch", SIZE, SIZE)),
    "p1_m": ("float32", ("batch", 2)),
}
"""Name -> type and shape of what every exported policy reads; the contract says what it means."""

OUTPUT = "q"

Params = Mapping[str, Any]


def make_onnx(params: Params, config: Config, actions: ActionSpace) -> onnx.ModelProto:
    """Return the policy of a configuration as an ONNX model.

    Args:
        params: of the network, nested mappings of arrays.
        config: its network and task.
        actions: what the choices of a Q map are.
    """
    graph = Graph()
    body = {"paper": _paper_values, "compact": _compact_values}[config.network.architecture]
    q = body(graph, params, config, actions)
    shapes = {OUTPUT: ("float32", ("batch", *actions.shape))}
    return graph.model(INPUTS, shapes, results={OUTPUT: q}, name="pregrasp_policy")


def _paper_values(graph: Graph, params: Params, config: Config, actions: ActionSpace) -> str:
    """Add the network of Fig. 3 on the whole grid; `QNetwork.__call__`."""
    segmentation = graph("Div", graph.cast("labels", TensorProto.FLOAT), _scalar(max(SEGMENTATION.values())))
    images = graph("Concat", *(_as_channel(graph, image) for image in (_heights(graph), segmentation)), axis=1)

    def readout(images: str, params: Params) -> str:
        features = [
            _residual_block(graph, _channel(graph, images, index), params[f"{name}_block"])
            for index, name in enumerate(("height", "segmentation"))
        ]
        x = _relu(graph, _conv(graph, graph("Concat", *features, axis=1), params["fuse"]))
        x = _max_pool(graph, _residual_block(graph, _max_pool(graph, x), params["down"]))
        for index in range(_count(params, "deep_")):
            x = _residual_block(graph, x, params[f"deep_{index}"])
        x = _residual_block(graph, _upsample(graph, x, SIZE // 4, SIZE // 4, 1), params["up"])
        return _conv(graph, x, params["readout"])

    def values(images: str) -> str:
        x = _mean(graph, [readout(images, member) for member in split(params, config.network.num_members)])
        return graph("Transpose", _upsample(graph, x, SIZE // 2, SIZE // 2, 1), perm=[0, 2, 3, 1])

    if not config.network.mirror:
        return values(images)
    both = graph("Concat", images, _flip_rows(graph, images, axis=2), axis=0)
    return _mean_of_mirrored(graph, values(both), lambda q: _flip_rows(graph, q, axis=1), actions)


def _compact_values(graph: Graph, params: Params, config: Config, actions: ActionSpace) -> str:
    """Add the network that looks at a window around the hand; `CompactNetwork.__call__`."""
    size = window_size(config.task)
    rows, cols = size.shape
    labels = [_label(graph, value) for name, value in SEGMENTATION.items() if name != "table"]
    one = numpy_helper.from_array(np.ones(1, np.float32))
    inside = graph("ConstantOfShape", graph("Shape", "labels"), value=one)
    channels = [_as_cells(graph, image) for image in (_heights(graph), *labels, inside)]
    cells = graph("Concat", *channels, axis=2)
    row, col = _window_origin(graph, size)
    own = np.arange(rows - 1)  # the last row completes no patch, it is there for the mirror image
    windows = [_read_window(graph, cells, row, col, own, cols)]
    origins = [row]
    if config.network.mirror:
        windows.append(_read_window(graph, cells, row, col, rows - 1 - own, cols))
        origins.append(graph("Sub", np.array(SIZE - rows), row))
    window, origin_rows = (
        graph("Concat", *parts, axis=0) if len(parts) > 1 else parts[0] for parts in (windows, origins)
    )
    origin_cols = graph("Concat", *[col] * len(origins), axis=0) if len(origins) > 1 else col
    x = graph("SpaceToDepth", graph("Transpose", window, perm=[0, 3, 1, 2]), blocksize=PATCH)
    x = graph("Concat", x, _coordinates(graph, origin_rows, origin_cols, (rows - 1, cols)), axis=1)

    def upsampled(x: str) -> str:
        return _upsample(graph, x, (rows - 1) // PATCH, cols // PATCH, DOUBLINGS)

    readouts, along = [], []
    for member in split(params, config.network.num_members):
        features = _compact_features(graph, x, member)
        readouts.append(_conv(graph, features, member[READOUT]))
        if config.network.num_path_channels:
            found = _read_ways(graph, _conv(graph, features, member[PATH]), config.network.num_path_channels, size)
            along.append(_conv(graph, _relu(graph, found), member[PATH_READOUT]))
    q = upsampled(_mean(graph, readouts))
    if along:
        (top, bottom), (left, right) = ((box.start, box.stop) for box in size.reached)
        beyond = np.array([0, 0, top, left, 0, 0, rows - 1 - bottom, cols - right])
        q = graph("Add", q, graph("Pad", _mean(graph, along), beyond))
    q = graph("Transpose", q, perm=[0, 2, 3, 1])
    q = graph("Reshape", q, np.array([0, (rows - 1) * cols, actions.num_choices]))
    q = _paste(graph, q, origin_rows, origin_cols, (rows - 1, cols))
    if not config.network.mirror:
        return q
    return _mean_of_mirrored(graph, q, lambda q: _flip_rows(graph, q, axis=1), actions)


def _compact_features(graph: Graph, x: str, params: Params) -> str:
    """Add the layers of one network before its readouts."""
    x = _relu(graph, _conv(graph, x, params["stem"]))
    for index in range(_count(params, "_in")):
        hidden = _relu(graph, _conv(graph, x, params[f"block{index}_in"]))
        x = _relu(graph, graph("Add", x, _conv(graph, hidden, params[f"block{index}_out"])))
    return x


def _read_ways(graph: Graph, parts: str, channels: int, size: WindowSize) -> str:
    """Read patches [batch, L F, N, M] along the ways of pushes within reach: [batch, F, R, S]; `_along`."""
    rows, cols = way_weights(size)
    looks, height, width = len(LOOKS), rows.shape[2], cols.shape[2]
    parts = graph("Reshape", parts, np.array([0, looks, channels, height, width]))
    rows, cols = rows.transpose(1, 0, 2)[:, None], cols.transpose(1, 2, 0)[:, None]
    return graph("ReduceSum", graph("MatMul", graph("MatMul", rows, parts), cols), np.array([1]), keepdims=0)


def _heights(graph: Graph) -> str:
    """Clip, store in steps, and normalise: [batch, H, W]; `grid.quantize_height` and `network_input`."""
    steps = 255 / grid.MAX_HEIGHT
    clipped = graph("Clip", "height_m", _scalar(0.0), _scalar(grid.MAX_HEIGHT))
    height = graph("Mul", graph("Round", graph("Mul", clipped, _scalar(steps))), _scalar(grid.MAX_HEIGHT / 255))
    off = graph("Sub", height, graph("ReduceMean", height, axes=[1, 2], keepdims=1))
    std = graph("Sqrt", graph("ReduceMean", graph("Mul", off, off), axes=[1, 2], keepdims=1))
    return graph("Div", off, graph("Max", std, _scalar(MIN_STD)))


def _label(graph: Graph, value: int) -> str:
    """Return where labels have a value, float [batch, H, W]."""
    return graph.cast(graph("Equal", "labels", np.array(value, np.uint8)), TensorProto.FLOAT)


def _as_channel(graph: Graph, image: str) -> str:
    return graph("Unsqueeze", image, np.array([1]))


def _as_cells(graph: Graph, image: str) -> str:
    """Return an image [batch, H, W] as a list of cells [batch, H * W, 1]."""
    return graph("Reshape", image, np.array([0, SIZE * SIZE, 1]))


def _channel(graph: Graph, images: str, index: int) -> str:
    return graph("Slice", images, np.array([index]), np.array([index + 1]), np.array([1]))


def _flip_rows(graph: Graph, x: str, *, axis: int) -> str:
    return graph("Gather", x, np.arange(SIZE)[::-1].copy(), axis=axis)


def _mean(graph: Graph, values: Sequence[str]) -> str:
    """Return the mean of what the members say; it commutes with the interpolation that follows."""
    return graph("Mean", *values) if len(values) > 1 else values[0]


def _mean_of_mirrored(graph: Graph, q: str, flip: Callable[[str], str], actions: ActionSpace) -> str:
    """Return the mean of values of scenes and of their mirror images, which are the second half of the batch.

    Source: `ActionSpace.mirror_map`.
    """
    half = graph("Div", graph("Gather", graph("Shape", q), np.array([0]), axis=0), np.array([2]))
    whole = graph("Shape", q, start=0, end=1)
    own = graph("Slice", q, np.array([0]), half, np.array([0]))
    other = flip(graph("Slice", q, half, whole, np.array([0])))
    if actions.mirrored != tuple(range(actions.num_choices)):
        other = graph("Gather", other, np.array(actions.mirrored), axis=3)
    return graph("Div", graph("Add", own, other), _scalar(2.0))


def _window_origin(graph: Graph, size: WindowSize) -> tuple[str, str]:
    """Return row and col of the grid where windows begin, int64 [batch, 1] each; `compact.window_origin`."""
    moved = graph("Add", "p1_m", _scalar(0.01 * grid.HEIGHTMAP_RESOLUTION))
    shifted = graph("Add", moved, _scalar(grid.WORKSPACE_HALF_SIZE))
    cell = graph.cast(graph("Floor", graph("Div", shifted, _scalar(grid.HEIGHTMAP_RESOLUTION))), TensorProto.INT64)
    x, y = (graph("Slice", cell, np.array([axis]), np.array([axis + 1]), np.array([1])) for axis in (0, 1))
    return graph("Sub", y, np.array(size.beside)), graph("Sub", x, np.array(size.behind))


def _read_window(graph: Graph, cells: str, row: str, col: str, rows: np.ndarray, num_cols: int) -> str:
    """Read cells [batch, H * W, C] at rows and columns from an origin on: [batch, R, S, C], 0 outside."""
    at_rows, at_cols = graph("Add", row, rows), graph("Add", col, np.arange(num_cols))
    return _gather_cells(graph, cells, at_rows, at_cols, (SIZE, SIZE), (len(rows), num_cols))


def _paste(graph: Graph, q: str, row: str, col: str, shape: tuple[int, int]) -> str:
    """Put values [batch, R * C, K] of windows into the grid: [batch, H, W, K], 0 outside of them; `compact.paste`."""
    at_rows, at_cols = graph("Sub", np.arange(SIZE), row), graph("Sub", np.arange(SIZE), col)
    return _gather_cells(graph, q, at_rows, at_cols, shape, (SIZE, SIZE))


def _gather_cells(
    graph: Graph, cells: str, rows: str, cols: str, shape: tuple[int, int], wanted: tuple[int, int]
) -> str:
    """Read cells [batch, shape[0] * shape[1], C] at rows [batch, R] and cols [batch, S]; 0 where they do not exist."""
    (height, width), (num_rows, num_cols) = shape, wanted
    inside = graph(
        "And",
        graph("Unsqueeze", _within(graph, rows, height), np.array([2])),
        graph("Unsqueeze", _within(graph, cols, width), np.array([1])),
    )
    clipped_rows, clipped_cols = _clipped(graph, rows, height), _clipped(graph, cols, width)
    start = graph("Unsqueeze", graph("Mul", clipped_rows, np.array(width)), np.array([2]))
    index = graph("Add", start, graph("Unsqueeze", clipped_cols, np.array([1])))
    flat = graph("Reshape", index, np.array([0, num_rows * num_cols, 1]))
    found = graph("GatherND", cells, flat, batch_dims=1)
    mask = graph("Reshape", graph.cast(inside, TensorProto.FLOAT), np.array([0, num_rows * num_cols, 1]))
    return graph("Reshape", graph("Mul", found, mask), np.array([0, num_rows, num_cols, -1]))


def _within(graph: Graph, index: str, length: int) -> str:
    return graph("And", graph("GreaterOrEqual", index, np.array(0)), graph("Less", index, np.array(length)))


def _clipped(graph: Graph, index: str, length: int) -> str:
    return graph("Max", graph("Min", index, np.array(length - 1)), np.array(0))


def _coordinates(graph: Graph, row: str, col: str, shape: tuple[int, int]) -> str:
    """Return where patches lie, [batch, 8, R / 4, C / 4]; `compact.coordinates`, whose order this is."""
    lengths = [length // PATCH for length in shape]
    cells = [PATCH * np.arange(length, dtype=np.float32) + (PATCH - 1) / 2 for length in lengths]
    columns = [cells[0].reshape(1, 1, -1, 1), cells[1].reshape(1, 1, 1, -1)]
    batch = graph("Shape", row, start=0, end=1)
    target = graph("Concat", batch, np.array([1, *lengths]), axis=0)
    parts: list[str | np.ndarray] = [
        (2 * cell + 1) / np.float32(length) - 1 for cell, length in zip(columns, shape, strict=True)
    ]
    for origin, cell in zip((row, col), columns, strict=True):
        corner = graph("Reshape", graph.cast(origin, TensorProto.FLOAT), np.array([0, 1, 1, 1]))
        doubled = graph("Add", graph("Mul", graph("Add", corner, cell), _scalar(2.0)), _scalar(1.0))
        parts.append(graph("Sub", graph("Div", doubled, _scalar(SIZE)), _scalar(1.0)))
    both = graph("Concat", *(graph("Expand", part, target) for part in parts), axis=1)
    return graph("Concat", both, graph("Mul", both, both), axis=1)


def _conv(graph: Graph, x: str, layer: Mapping[str, Any]) -> str:
    """Add a convolution of odd size padded with zeros; kernels are stored [size, size, C_in, C_out]."""
    kernel = np.asarray(layer["kernel"], np.float32)
    pads = [kernel.shape[0] // 2] * 4
    return graph("Conv", x, kernel.transpose(3, 2, 0, 1), np.asarray(layer["bias"], np.float32), pads=pads)


def _residual_block(graph: Graph, x: str, block: Mapping[str, Any]) -> str:
    hidden = _relu(graph, _conv(graph, x, block["conv1"]))
    return _relu(graph, graph("Add", _conv(graph, hidden, block["conv2"]), _conv(graph, x, block["shortcut"])))


def _relu(graph: Graph, x: str) -> str:
    return graph("Relu", x)


def _max_pool(graph: Graph, x: str) -> str:
    return graph("MaxPool", x, kernel_shape=[3, 3], strides=[2, 2], pads=[1, 1, 0, 0])


def _upsample(graph: Graph, x: str, height: int, width: int, doublings: int) -> str:
    """Double images of [batch, C, height, width] bilinearly, corner on corner, so many times; `networks.upsample`."""
    rows, cols = (upsample_weights(length, doublings) for length in (height, width))
    return graph("MatMul", graph("MatMul", rows, x), cols.T)


def _count(params: Params, part: str) -> int:
    """Return how many blocks have this in their names."""
    return sum(part in name for name in params)


def _scalar(value: float) -> np.ndarray:
    return np.array(value, np.float32)
