"""A search before every push of `deploy`, where JAX and MuJoCo are installed: `planning` behind `deploy.search`."""

import dataclasses
from collections.abc import Callable

import jax
import numpy as np

from pregrasp_jax.checkpoint import load_policy
from pregrasp_jax.config import Config, SceneConfig
from pregrasp_jax.deploy.bundle import Bundle
from pregrasp_jax.deploy.contract import SAFETENSORS
from pregrasp_jax.deploy.decision import Decider
from pregrasp_jax.deploy.masks import ROBOT, TABLE
from pregrasp_jax.deploy.search import Seen
from pregrasp_jax.evaluation_config import PlanningConfig
from pregrasp_jax.machine import announced_compilation
from pregrasp_jax.planning.memory import NOTHING, Sight
from pregrasp_jax.planning.planner import Planner, make_planner
from pregrasp_jax.planning.tracking import TARGET_SLOT, slots_of
from pregrasp_jax.robot import kinematics
from pregrasp_jax.robot.kinematics import Arm
from pregrasp_jax.spaces import grid, motion
from pregrasp_jax.startup import prepare
from pregrasp_jax.task.assembly import make_env
from pregrasp_jax.types import ROBOT_ID, HandPose, Observation


class CellSearch:
    """A `deploy.search.Search` by a planner; it remembers the objects of a trial."""

    def __init__(self, planner: Planner, *, cell: Arm, trained: Arm):
        """Begin with a trial of which nothing has been seen.

        Args:
            planner: decides.
            cell: the arm that is there.
            trained: the arm of the planner, whose base may stand higher or lower against the table.
        """
        self._planner, self._memory, self._cell, self._trained = planner, NOTHING, cell, trained

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
        joint_pos = joints_as_trained(seen.joint_pos, cell=self._cell, trained=self._trained)
        sight = Sight(obs, joint_pos.astype(np.float32), TARGET_SLOT, seen.pushes)
        planned = self._planner.decide(sight, self._memory, jax.random.key(seen.pushes))
        self._memory = planned.memory
        return planned.action


def joints_as_trained(joint_pos: np.ndarray, *, cell: Arm, trained: Arm) -> np.ndarray:
    """Return the joints [J] rad with which the trained arm holds its hand where that of the cell does, [J] rad.

    Raises:
        ValueError: it cannot.
    """
    if np.array_equal(cell.world_from_base, trained.world_from_base):
        return joint_pos
    arm, fingers = joint_pos[:6], joint_pos[6:]
    solutions = kinematics.hand_inverse_kinematics(trained, kinematics.grasp_pose(cell, arm))
    solutions = solutions[np.isfinite(solutions).all(axis=1)]
    if not len(solutions):
        raise ValueError(
            "plan = True: the arm of training cannot hold its hand where this one does; check table.height_m"
        )
    solutions += 2 * np.pi * np.round((arm - solutions) / (2 * np.pi))
    nearest = solutions[np.abs(solutions - arm).max(axis=1).argmin()]
    return np.concatenate([nearest, fingers])


def make_search(
    bundle: Bundle,
    planning: PlanningConfig,
    *,
    decider: Decider,
    camera_m: np.ndarray,
    say: Callable[[str], None] = print,
) -> CellSearch:
    """Return a search by the policy of a bundle, compiled.

    Args:
        bundle: with its parameters.
        planning: how much is searched.
        decider: of the bundle in its cell.
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
    # No object of it is looked at, and the sensor of the training may be a file that is not here.
    task = dataclasses.replace(trained.config.task, sensor="clean")
    config = Config(task=task, scene=SceneConfig(test_scenes=1))
    env = make_env(config.validate(), split="test")
    assert env.robot.body is not None, "a decider has an arm"
    planner, arm = make_planner(env, trained, planning, camera_m=camera_m), env.robot.body.arm
    with announced_compilation(say):  # now, lest the arm stands and waits for it
        home = np.array(bundle.contract.robot.home)
        CellSearch(planner, cell=arm, trained=arm).choose(_something(decider.start(), home))
    return CellSearch(planner, cell=decider.body.arm, trained=arm)


def _something(hand: motion.Held, joint_pos: np.ndarray) -> Seen:
    """Return a block 10 cm high at the centre, seen with the arm at its start."""
    instances = np.full((grid.GRID_SIZE, grid.GRID_SIZE), TABLE, np.uint8)
    middle = slice(grid.GRID_SIZE // 2 - 6, grid.GRID_SIZE // 2 + 6)
    instances[middle, middle] = 1
    return Seen(np.where(instances == 1, np.float32(0.1), np.float32(0)), instances, 1, hand, joint_pos, 0)
