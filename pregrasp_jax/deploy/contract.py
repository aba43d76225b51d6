"""What a bundle says about itself: every number of the policy with its unit, frame, meaning and range.

The classes are the schema: `config.from_dict` refuses unknown and missing keys and wrong types. contract.json holds one
`Contract`; the same text, without `files`, is in the metadata of policy.onnx under `CONTRACT_KEY`.
"""

import dataclasses
from dataclasses import dataclass, field
from typing import Any

from pregrasp_jax.sensors import PointOfCell

FORMAT = "pregrasp_jax bundle 1"
"""What a bundle says that it is."""

CONTRACT, ONNX, ROBOT, GOLDEN, README = "contract.json", "policy.onnx", "robot.npz", "golden.npz", "README.md"
SAFETENSORS, STABLEHLO, STABLEHLO_BATCH = "policy.safetensors", "policy.stablehlo", "policy_batch.stablehlo"
"""Names of the files."""

CONTRACT_KEY = "pregrasp_jax.contract"
"""Of the metadata of policy.onnx."""


@dataclass(frozen=True, kw_only=True)
class FileEntry:
    """A file of the bundle."""

    sha256: str
    bytes: int


@dataclass(frozen=True, kw_only=True)
class Tensor:
    """An input or output of the graph. Numbers beyond `low` and `high` are not what the policy was trained on."""

    name: str
    dtype: str
    shape: tuple[str, ...]
    unit: str
    frame: str
    kind: str
    meaning: str
    low: float | None
    high: float | None
    invalid: str


@dataclass(frozen=True, kw_only=True)
class GridEntry:
    """The heightmap: cell [row, col] has its centre at origin + resolution (col + 1/2, row + 1/2)."""

    rows: str
    columns: str
    size: int
    resolution_m: float
    origin_m: tuple[float, float]
    max_height_m: float
    labels: dict[str, int]


@dataclass(frozen=True, kw_only=True)
class ChoiceEntry:
    """How the hand is held for one value of the last index."""

    name: str
    z_m: float
    yaw_rad: float
    aperture_rad: float
    opening: float
    """0 closed, 1 open as wide as the hand goes."""
    has_region: bool
    """Whether a hand held like this can enclose the target."""


@dataclass(frozen=True, kw_only=True)
class ActionEntry:
    """What an action is, and how it is carried out."""

    index: str
    primitive: str
    choices: tuple[ChoiceEntry, ...]
    r_in_m: float
    r_out_m: float
    full_ring: bool
    start_m: tuple[float, float]
    """Where the hand is at the beginning of an episode: the first p1."""
    push_speed_m_s: float
    settle_s: float
    aperture_s: float
    max_pushes: int


@dataclass(frozen=True, kw_only=True)
class EndEntry:
    """When the fingers close: the share of the target inside the closing region, in the hand's frame."""

    rule: str
    coverage: float
    stations_m: tuple[float, ...]
    half_width_m: tuple[float, ...]


@dataclass(frozen=True, kw_only=True)
class RobotEntry:
    """Who the policy was trained with."""

    name: str
    joints: tuple[str, ...]
    home: tuple[float, ...]
    world_from_base: tuple[tuple[float, ...], ...] | None
    tcp_offset_m: tuple[float, float, float] | None
    """Of the grasp point in the frame of the flange; to be set on the controller."""
    limits_rad: tuple[tuple[float, ...], ...] | None
    base_frame: str


@dataclass(frozen=True, kw_only=True)
class CameraEntry:
    """What depth images are expected to be."""

    name: str
    sensor: str
    width: int
    height: int
    focal_px: float
    position_m: tuple[float, ...]
    looking: str
    depth: str
    intrinsics: str
    cell: PointOfCell
    """Which of the points above a cell was its height in training."""


@dataclass(frozen=True, kw_only=True)
class PlaceEntry:
    """Where the policy was trained, walls included."""

    name: str
    low_m: tuple[float | None, ...]
    high_m: tuple[float | None, ...]
    walls: tuple[dict[str, Any], ...]


@dataclass(frozen=True, kw_only=True)
class Training:
    """Where the parameters come from."""

    origin: str
    config_hash: str
    parameters_hash: str
    seed: int
    architecture: str
    width: float
    mirror: bool
    parameters: int
    members: int = 1
    config: dict[str, Any]


@dataclass(frozen=True, kw_only=True)
class Contract:
    """All of it."""

    format: str
    created: str
    tensors: tuple[Tensor, ...]
    outputs: tuple[Tensor, ...]
    grid: GridEntry
    action: ActionEntry
    end: EndEntry | None
    robot: RobotEntry
    camera: CameraEntry
    place: PlaceEntry
    training: Training
    evaluation: dict[str, Any]
    normalisation: str
    versions: dict[str, str]
    not_guaranteed: tuple[str, ...]
    files: dict[str, FileEntry] = field(default_factory=dict)


def to_plain(contract: Contract) -> dict[str, Any]:
    """Return a contract as what JSON holds."""
    return dataclasses.asdict(contract)


def _mean_of(members: int) -> str:
    return f", mean of {members} networks" if members > 1 else ""


_NOT_MEASURED = "Nothing was measured when the policy was saved."


def format_contract(contract: Contract) -> str:
    """Return the contract as text for people: Markdown that reads as plain text too."""
    grid, action, robot, camera = contract.grid, contract.action, contract.robot, contract.camera
    lines = [
        f"# Policy for {action.primitive} with {robot.name}",
        "",
        f"{contract.format}, made {contract.created} with pregrasp_jax {contract.versions.get('pregrasp_jax', '?')}. "
        f"{contract.training.parameters} parameters, {contract.training.architecture} network of width "
        f"{contract.training.width:g}{_mean_of(contract.training.members)}.",
        "",
        "## Inputs and outputs",
        "",
        *(_tensor_line(tensor) for tensor in (*contract.tensors, *contract.outputs)),
        "",
        contract.normalisation,
        "",
        "## Grid",
        "",
        f"{grid.size} x {grid.size} cells of {grid.resolution_m * 1e3:g} mm. Row: {grid.rows}; column: {grid.columns}. "
        f"The corner of cell [0, 0] is at ({grid.origin_m[0]:g}, {grid.origin_m[1]:g}) m. Labels: "
        + ", ".join(f"{value} {name}" for name, value in grid.labels.items())
        + ".",
        "",
        "## Action",
        "",
        action.index,
        f"Allowed: {'the ring' if action.full_ring else 'the half ring ahead'} from {action.r_in_m:g} to "
        f"{action.r_out_m:g} m around p1. The hand moves straight, with minimum jerk, at {action.push_speed_m_s:g} m/s "
        f"on average, then stands for {action.settle_s:g} s; a change of the aperture takes {action.aperture_s:g} s "
        f"before. At most {action.max_pushes} pushes.",
        "",
        *(
            f"* choice {index} `{c.name}`: {c.z_m:g} m high, heading {c.yaw_rad:g} rad, opening {c.opening:.0%}"
            for index, c in enumerate(action.choices)
        ),
        "",
        "## End",
        "",
        contract.end.rule if contract.end else "The hand has no closing region.",
        "",
        "## Robot and camera",
        "",
        f"Joints in this order: {', '.join(robot.joints)}. {robot.base_frame}",
        f"Tool centre point in the flange: {_numbers(robot.tcp_offset_m)} m.",
        f"Camera: {camera.name}, {camera.width} x {camera.height} pixels, f = {camera.focal_px:.1f} px, "
        f"{camera.looking}; trained with sensor `{camera.sensor}`. Depth: {camera.depth}",
        f"Place: {contract.place.name}, {len(contract.place.walls)} walls.",
        "",
        "## Evaluation",
        "",
        *([f"* {key}: {value}" for key, value in contract.evaluation.items()] or [_NOT_MEASURED]),
        "",
        "## Not guaranteed",
        "",
        *(f"* {line}" for line in contract.not_guaranteed),
        "",
        "## Files",
        "",
        *(f"* {name}: {entry.bytes} bytes, sha256 {entry.sha256[:16]}..." for name, entry in contract.files.items()),
    ]
    return "\n".join(lines)


def _tensor_line(tensor: Tensor) -> str:
    low, high = ("" if bound is None else f"{bound:g}" for bound in (tensor.low, tensor.high))
    span = f", {low} to {high}" if low or high else ""
    return (
        f"* `{tensor.name}` {tensor.dtype} [{', '.join(tensor.shape)}] in {tensor.unit}, {tensor.frame}{span}: "
        f"{tensor.meaning} Invalid: {tensor.invalid}"
    )


def _numbers(values: tuple[float, ...] | None) -> str:
    return "none" if values is None else ", ".join(f"{value:g}" for value in values)
