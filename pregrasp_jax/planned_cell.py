"""A search before every push of `deploy`, where JAX and MuJoCo are installed: `planning` behind `deploy.search`."""

from collections.abc import Callable

import jax
import numpy as np

from pregrasp_jax.checkpoint import load_policy
from pregrasp_jax.config import Config, SceneConfig
from pregrasp_jax.deploy.bundle import Bundle
from pregrasp_jax.deploy.contract import SAFETENSORS
from pregrasp_jax.deploy.search import ROBOT, TABLE, Seen
from pregrasp_jax.evaluation_config import PlanningConfig
from pregrasp_jax.machine import announced_compilation
from pregrasp_jax.planning.memory import NOTHING, Sight
from pregrasp_jax.planning.planner import Planner, make_planner
from pregrasp_jax.planning.tracking import TARGET_SLOT, slots_of
from pregrasp_jax.spaces import grid, motion
from pregrasp_jax.startup import prepare
from pregrasp_jax.task.assembly import make_env
from pregrasp_jax.types import ROBOT_ID, HandPose, Observation


class CellSearch:
    """A `deploy.search.Search` by a planner; it remembers the objects of a trial."""

    def __init__(self, planner: Planner):
        """Begin with a trial of which nothing has been seen."""
        self._planner, self._memory = planner, NOTHING

    def choose(self, seen: Seen) -> int:
        """Return the push that does best in simulation; see `Search.choose`."""
        if seen.pushes == 0:
            self._memory = NOTHING
        values = [int(value) for value in np.unique(seen.instances) if value not in (TABLE, ROBOT)]
        masks = [seen.instances == value for value in values]
        slots = slots_of(masks, seen.height_m, values.index(seen.target), self._memory)
        ids = np.where(seen.instances == ROBOT, ROBOT_ID, 0).astype(np.uint8)
        for mask, slot in zip(masks, slots, strict=True):
            ids[mask] = slot + 1
        hand = HandPose(*(np.asarray(value, np.float32) for value in seen.hand))  # pyright: ignore[reportArgumentType]
        obs = Observation(grid.quantize_height(seen.height_m), ids, hand)  # pyright: ignore[reportArgumentType]
        sight = Sight(obs, np.asarray(seen.joint_pos, np.float32), TARGET_SLOT, seen.pushes)
        planned = self._planner.decide(sight, self._memory, jax.random.key(seen.pushes))
        self._memory = planned.memory
        return planned.action


def make_search(
    bundle: Bundle,
    planning: PlanningConfig,
    *,
    start: motion.Held,
    camera_m: np.ndarray,
    say: Callable[[str], None] = print,
) -> CellSearch:
    """Return a search by the policy of a bundle, compiled.

    Args:
        bundle: with its parameters.
        planning: how much is searched.
        start: how the hand is held before the first push.
        camera_m: [3], where the camera is in the table frame.
        say: told about compilation.

    Raises:
        ValueError: the bundle lacks its parameters, or its policy does not push.
    """
    if SAFETENSORS not in bundle.files:
        raise ValueError(
            f"plan = True: {bundle.folder} has no {SAFETENSORS}; allowed is a bundle exported with "
            "--formats onnx safetensors"
        )
    prepare()
    trained = load_policy(bundle.folder)
    if trained.config.train.method != "q_learning":
        raise ValueError(f"plan = True: {bundle.folder} chooses strokes; allowed is a policy that pushes")
    config = Config(task=trained.config.task, scene=SceneConfig(test_scenes=1))  # of which no object is looked at
    planner = make_planner(make_env(config.validate(), split="test"), trained, planning, camera_m=camera_m)
    with announced_compilation(say):  # now, lest the arm stands and waits for it
        CellSearch(planner).choose(_something(start, np.array(bundle.contract.robot.home)))
    return CellSearch(planner)


def _something(hand: motion.Held, joint_pos: np.ndarray) -> Seen:
    """Return a block 10 cm high at the centre, seen with the arm at its start."""
    instances = np.full((grid.GRID_SIZE, grid.GRID_SIZE), TABLE, np.uint8)
    middle = slice(grid.GRID_SIZE // 2 - 6, grid.GRID_SIZE // 2 + 6)
    instances[middle, middle] = 1
    return Seen(np.where(instances == 1, np.float32(0.1), np.float32(0)), instances, 1, hand, joint_pos, 0)
