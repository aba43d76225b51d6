"""What depth cameras, and the masks made from their images, do to a picture: settings, and those of known cameras.

`heightmap.sensor` does it.
"""

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from pregrasp_jax import yaml_file
from pregrasp_jax.settings import check_ranges, from_dict

PointOfCell = Literal["max", "second", "median"]
"""Which of the points above a cell is its height: the highest, the one below it, or the middle one."""


@dataclass(frozen=True, kw_only=True)
class Sensor:
    """A stereo camera above the table, the masks made from its image, and how far objects differ from their models."""

    cell: PointOfCell = "max"
    """Which of the points above a cell is its height: the highest, the one below it, or the middle one."""
    baseline: float = 0.0
    """m between the two imagers; 0 is no stereo camera, and then `subpixel` and `shadow` do nothing."""
    focal: float = 425.0
    """Pixels, of the stereo pair (848 x 480), not of the image that depth is aligned to."""
    subpixel: float = 0.0
    """Pixels, deviation of the disparity."""
    correlation: int = 3
    """Pixels of the aligned image, the side of blocks that share their error."""
    quantum: float = 0.0
    """m, step in which depth is told."""
    shadow: bool = False
    """Pixels that the second imager does not see have no depth: beside every object on one side, and at the border."""
    flying: float = 0.0
    """Share of the pixels at edges whose depth lies between both sides."""
    speckle: float = 0.0
    """Share of blocks without depth."""
    pose_m: float = 0.0
    """m, deviation of each coordinate of the camera from where the calibration has it; one draw per episode."""
    pose_deg: float = 0.0
    """Degrees, the same about each axis."""
    erode: int = 0
    """Pixels that masks lose all around."""
    dilate: int = 0
    """Pixels of the table that masks gain all around."""
    drop: float = 0.0
    """Chance of each obstacle to be overlooked in an image; without a mask of the target nothing is decided."""
    merge: float = 0.0
    """Chance that an object and its nearest neighbour get one mask in an image; the target's, if it is one of them."""
    mass_spread: float = 0.0
    """Deviation of the logarithm of an object's mass."""
    friction_spread: float = 0.0
    """Deviation of the logarithm of an object's friction."""
    seed: int = 0
    """Of all draws, beside the scene itself."""

    def validate(self) -> "Sensor":
        """Return self.

        Raises:
            ValueError: a value is out of range; the line says which, and what is allowed.
        """
        check_ranges(self, _RANGES)
        return self


_RANGES: dict[str, tuple[float, float]] = {
    "baseline": (0.0, 1.0),
    "focal": (50.0, 5000.0),
    "subpixel": (0.0, 2.0),
    "correlation": (1, 16),
    "quantum": (0.0, 0.02),
    "flying": (0.0, 1.0),
    "speckle": (0.0, 1.0),
    "pose_m": (0.0, 0.1),
    "pose_deg": (0.0, 10.0),
    "erode": (0, 20),
    "dilate": (0, 20),
    "drop": (0.0, 1.0),
    "merge": (0.0, 1.0),
    "mass_spread": (0.0, 1.0),
    "friction_spread": (0.0, 1.0),
    "seed": (0, 2**31 - 1),
}

_REALSENSE = Sensor(
    subpixel=0.08,
    quantum=0.001,
    shadow=True,
    flying=0.3,
    speckle=0.002,
    pose_m=0.002,
    pose_deg=0.3,
    erode=2,
    drop=0.05,
    merge=0.05,
    mass_spread=0.2,
    friction_spread=0.2,
)
"""Subpixel error between well (0.05) and poorly (0.1) textured; a careful hand-eye calibration."""

CLEAN = Sensor()
"""Gets nothing wrong."""

SENSORS: dict[str, Sensor] = {
    "clean": CLEAN,
    "d435": dataclasses.replace(_REALSENSE, baseline=0.050),
    "d455": dataclasses.replace(_REALSENSE, baseline=0.095),
}
"""Sensors by the name that `task.sensor` knows them by. Source of baselines and noise: Intel's tuning paper."""


def camera_sensor(name: str, camera: str) -> Sensor:
    """Return the sensor called `name` (see `get_sensor`) of a camera.

    Raises:
        ValueError: as `get_sensor`, or the camera has no use for it.
    """
    sensor = get_sensor(name)
    if sensor != CLEAN and camera != "pinhole":
        raise ValueError(
            f"task.sensor = {name!r} is what a pinhole camera gets wrong, but task.camera = {camera!r}; allowed with "
            "it is pinhole"
        )
    return sensor


def get_sensor(name: str) -> Sensor:
    """Return the sensor called `name`, or that of a YAML file, in which `base` names the one it starts from.

    Raises:
        ValueError: there is none, the file cannot be read, or a key or value of it is not allowed.
    """
    if name in SENSORS:
        return SENSORS[name]
    path = Path(name)
    if path.suffix not in (".yaml", ".yml"):
        raise ValueError(f"task.sensor = {name!r} does not exist; allowed: {', '.join(SENSORS)}, or a .yaml file")
    values = yaml_file.read(path)
    if not isinstance(values, Mapping):
        raise ValueError(f"{path}: a sensor must be a mapping; allowed keys: base, {', '.join(_fields())}")
    base = values.get("base", "clean")
    if not isinstance(base, str) or base not in SENSORS:
        raise ValueError(f"{path}: base = {base!r} does not exist; allowed: {', '.join(SENSORS)}")
    settings = dataclasses.asdict(SENSORS[base]) | {key: value for key, value in values.items() if key != "base"}
    try:
        return from_dict(settings, Sensor).validate()
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None


def _fields() -> list[str]:
    return [field.name for field in dataclasses.fields(Sensor)]
