"""Does a bundle still do what it should? Every file of it is asked the golden questions."""

import datetime
import importlib.util
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from pregrasp_jax.deploy.bundle import Bundle
from pregrasp_jax.deploy.contract import GOLDEN, ONNX, SAFETENSORS, STABLEHLO, STABLEHLO_BATCH
from pregrasp_jax.deploy.policy import load_values
from pregrasp_jax.messages import one_line

TIE = 2e-4
"""Values nearer than this are a tie: either push is right."""

MAX_AGE = datetime.timedelta(days=182)
"""jax promises that a serialised program runs on a jax at most six months newer."""

Golden = dict[str, np.ndarray]
Checker = Callable[[Bundle, Golden], np.ndarray]


@dataclass(frozen=True)
class Finding:
    """What was found about one format.

    Attributes:
        name: of the format, or of what else was looked at.
        passed: None if it could not be looked at here.
        text: in words.
    """

    name: str
    passed: bool | None
    text: str

    def line(self) -> str:
        """Return it as one line."""
        return f"{self.name:<17}{ {True: 'ok', False: 'FAILED', None: 'skipped'}[self.passed]:<9}{self.text}"


def verify(bundle: Bundle, *, formats: Sequence[str] = (), tolerance: float = 1e-4) -> list[Finding]:
    """Compare every format of a bundle with its golden answers, and the runtime's heightmaps with the package's.

    Args:
        bundle: whole, as `read_bundle` gives it.
        formats: only these; all that the bundle has if empty.
        tolerance: largest difference of a value.

    Raises:
        ValueError: an unknown format, or one that the bundle does not have.
    """
    held = {name: file for name, (file, _) in _CHECKERS.items() if file in bundle.files}
    for name in formats:
        if name not in held:
            raise ValueError(f"format = {name!r} is not in {bundle.folder}; allowed: {', '.join(held)}")
    golden = bundle.arrays(GOLDEN)
    return [_find(bundle, golden, name, tolerance) for name in formats or held] + _drawn(bundle, golden)


def _find(bundle: Bundle, golden: Golden, name: str, tolerance: float) -> Finding:
    file, check = _CHECKERS[name]
    if reason := _cannot_look(bundle, name):
        return Finding(name, None, reason)
    try:
        q = check(bundle, golden)
    except Exception as error:  # of onnx, jax or flax; the file is whole, so this is a finding
        return Finding(name, False, f"{file}: {type(error).__name__}: {one_line(error)[:200]}")
    return compare(name, q, golden, tolerance)


def compare(name: str, q: np.ndarray, golden: Golden, tolerance: float) -> Finding:
    """Return how values [S, H, W, K] differ from the golden ones, and whether the same pushes are best."""
    wanted = golden["q"]
    if q.shape != wanted.shape or not np.isfinite(q).all():
        return Finding(
            name, False, f"values of shape {list(q.shape)}, some not finite, instead of {list(wanted.shape)}"
        )
    off = float(np.abs(q - wanted).max())
    best = q.reshape(len(q), -1).argmax(axis=1)
    given_up = wanted.reshape(len(q), -1).max(axis=1) - wanted.reshape(len(q), -1)[np.arange(len(q)), best]
    same = int((given_up <= TIE).sum())
    text = f"max |dQ| {off:.1e} (allowed {tolerance:.0e}), the best push in {same} of {len(q)} states"
    return Finding(name, off <= tolerance and same == len(q), text)


def _drawn(bundle: Bundle, golden: Golden) -> list[Finding]:
    """Return how the runtime's heightmaps differ from the package's."""
    if bundle.contract.robot.world_from_base is None:
        return []
    from pregrasp_jax.deploy.golden import heightmap_agreement

    share, labels = heightmap_agreement(bundle, golden)
    text = f"{share:.2%} of cells within 1 mm (allowed 99.5 %), {labels:.2%} of labels the same"
    return [Finding("heightmaps", share >= 0.995 and labels >= 0.99, text)]


def _cannot_look(bundle: Bundle, name: str) -> str:
    """Return why a format cannot be checked here, empty if it can."""
    missing = [package for package in _NEEDS[name] if importlib.util.find_spec(package) is None]
    if missing:
        return f"{', '.join(missing)} is not installed"
    made = datetime.datetime.fromisoformat(bundle.contract.created)
    age = datetime.datetime.now(datetime.UTC) - made
    if name.startswith("stablehlo") and age > MAX_AGE:
        return f"written {age.days // 30} months ago with jax {bundle.contract.versions.get('jax', '?')}"
    return ""


def _onnx(bundle: Bundle, golden: Golden) -> np.ndarray:
    return load_values(bundle)(golden["height_m"], golden["labels"], golden["p1_m"])


def _safetensors(bundle: Bundle, golden: Golden) -> np.ndarray:
    import jax
    import jax.numpy as jnp

    from pregrasp_jax.checkpoint import load_policy
    from pregrasp_jax.export.stablehlo import policy_function
    from pregrasp_jax.learning.q_function import make_q_function
    from pregrasp_jax.robot import get_robot
    from pregrasp_jax.task import registry
    from pregrasp_jax.task.place import place_of

    policy = load_policy(bundle.folder / SAFETENSORS)
    task = policy.config.task
    make = registry.get_kind(task.primitive).make_primitive
    actions = make(get_robot(task.robot), place_of(task), task, max_distance=task.r_out).actions
    q_function = make_q_function(policy.config.network, task, actions)
    inputs = (jnp.asarray(golden[name]) for name in ("height_m", "labels", "p1_m"))
    return np.asarray(jax.jit(policy_function(q_function, policy.params))(*inputs))


def _stablehlo(bundle: Bundle, golden: Golden) -> np.ndarray:
    from jax import export

    program = export.deserialize(bytearray(bundle.files[STABLEHLO]))
    inputs = [golden[name] for name in ("height_m", "labels", "p1_m")]
    rows = [program.call(*(x[i : i + 1] for x in inputs)) for i in range(len(inputs[0]))]
    return np.concatenate([np.asarray(row) for row in rows])


def _stablehlo_batch(bundle: Bundle, golden: Golden) -> np.ndarray:
    from jax import export

    program = export.deserialize(bytearray(bundle.files[STABLEHLO_BATCH]))
    return np.asarray(program.call(*(golden[name] for name in ("height_m", "labels", "p1_m"))))


_CHECKERS: dict[str, tuple[str, Checker]] = {
    "onnx": (ONNX, _onnx),
    "safetensors": (SAFETENSORS, _safetensors),
    "stablehlo": (STABLEHLO, _stablehlo),
    "stablehlo_batch": (STABLEHLO_BATCH, _stablehlo_batch),
}

_NEEDS = {
    "onnx": ("onnxruntime",),
    "safetensors": ("jax", "flax"),
    "stablehlo": ("jax", "flatbuffers"),
    "stablehlo_batch": ("jax", "flatbuffers"),
}
