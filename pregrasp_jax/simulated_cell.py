"""A cell in simulation, for `deploy --arm sim`: camera, masks, arm and gripper of one scene on the native engine.

It is the environment of training behind the protocols of `deploy.devices`, so that the loop that runs a real robot can
be run, and measured, without one.
"""

import dataclasses
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from pregrasp_jax import heightmap
from pregrasp_jax.config import AssetsConfig, Config, SceneConfig
from pregrasp_jax.deploy.build import make_decider, nominal_view
from pregrasp_jax.deploy.bundle import Bundle
from pregrasp_jax.deploy.cell import Cell, TableSettings
from pregrasp_jax.deploy.decision import Push
from pregrasp_jax.deploy.devices import Frame
from pregrasp_jax.deploy.files import masks_of_ids
from pregrasp_jax.deploy.log import DecisionLog
from pregrasp_jax.deploy.loop import Station
from pregrasp_jax.deploy.masks import Masks, Target
from pregrasp_jax.startup import prepare
from pregrasp_jax.task.assembly import make_env
from pregrasp_jax.task.env import Env
from pregrasp_jax.task.primitive import Stroke
from pregrasp_jax.types import REASONS, ROBOT_ID, EnvState, HandPose


class Programs:
    """The compiled functions of an environment, shared by the cells of all its scenes."""

    def __init__(self, env: Env):
        self.env = env
        self.camera = heightmap.overhead_camera()
        self.reset = jax.jit(env.reset_to)
        self.photograph = jax.jit(self._photograph)
        self.push = jax.jit(self._push)
        self.grasp = jax.jit(env.grasp)

    def _photograph(self, state: EnvState) -> tuple[jax.Array, jax.Array]:
        env, scene = self.env, state.scene
        hulls = heightmap.scene_hulls(env.bank, env.robot, scene, state.physics_obs, env.workspace)
        episode = heightmap.episode_key(env.sensor, scene.poses, scene.target)
        photo = heightmap.photograph(
            env.sensor, hulls, self.camera, episode=episode, num_pushes=state.num_pushes, target=scene.target
        )
        return photo.depth, photo.labels

    def _push(self, state: EnvState, end: HandPose) -> Any:
        env = self.env
        plan = env.primitive.plan(state.physics_obs.joint_pos, Stroke(start=state.hand, end=end))
        return env.conclude(state, plan, env.engine.run(state.physics, plan.ctrl, plan.num_ctrl))


class SimulatedCell:
    """One scene: an `ImageSource`, a `Segmenter` (ground truth), an `ArmDriver` and a `GripperDriver`."""

    def __init__(self, programs: Programs, scene: int):
        """Put the objects of a test scene onto the table, the hand at the start."""
        self._programs = programs
        self.state = programs.reset(jnp.int32(scene))
        self.reason, self.held = "running", False
        self._aperture = float(self.state.hand.aperture)
        self._ids: np.ndarray | None = None

    @property
    def target(self) -> Target:
        """Return which mask is the target's."""
        return Target(name=str(int(self.state.scene.target) + 1))

    def capture(self) -> tuple[np.ndarray, np.ndarray | None, float]:
        """Return what the overhead camera sees; see `ImageSource.capture`."""
        depth, ids = jax.device_get(self._programs.photograph(self.state))
        self._ids = np.where(ids == ROBOT_ID, 0, ids)
        return np.asarray(depth), None, time.time()

    def segment(self, frame: Frame) -> Masks:
        """Return the masks of the image that was captured last, which are those of the scene."""
        del frame
        assert self._ids is not None, "an image is captured before it is segmented"
        return masks_of_ids(self._ids)

    def joints(self) -> np.ndarray:
        """Return the joints [6] rad."""
        return np.asarray(self.state.physics_obs.joint_pos, float)[:6]

    def push(self, push: Push) -> None:
        """Push, on the engine, with the aperture that the gripper was told."""
        z, yaw, aperture = (jnp.float32(value) for value in (push.end.z, push.end.yaw, self._aperture))
        end = HandPose(jnp.asarray(push.end.xy, jnp.float32), z, yaw, aperture)
        self.state, result = self._programs.push(self.state, end)
        if self.reason == "running" and (bool(result.terminated) or bool(result.truncated)):
            self.reason = REASONS[int(result.reason)]

    def lift(self, height_m: float) -> None:
        """Nothing: the grasp of the environment closes, lifts and holds in one motion."""
        del height_m

    def opening(self) -> float:
        """Return how far the fingers are open."""
        fingers = float(np.asarray(self.state.physics_obs.joint_pos)[6:].mean())
        low, high = self._span()
        return float(np.clip((fingers - low) / (high - low), 0.0, 1.0))

    def move(self, opening: float) -> None:
        """Remember it: the push that follows opens or closes first, as in training."""
        low, high = self._span()
        self._aperture = low + opening * (high - low)

    def grasp(self) -> bool:
        """Close with constant force, lift, hold; return whether the target is held."""
        self.held = bool(self._programs.grasp(self.state).held)
        return self.held

    def close(self) -> None:
        """Nothing is open."""

    def _span(self) -> tuple[float, float]:
        apertures = [choice.aperture for choice in self._programs.env.primitive.actions.choices]
        return min(apertures), max(apertures)


def make_programs(bundle: Bundle, cell: Cell) -> Programs:
    """Return the task that a policy was trained for, with the objects and the sensor of a cell.

    Objects, scenes and engine are those of `evaluate`, whatever the training had: both meet the same test scenes.

    Raises:
        ValueError: something of it cannot be used.
    """
    prepare()
    config, sim = Config.from_dict(bundle.contract.training.config), cell.sim
    config = Config(
        task=dataclasses.replace(config.task, camera="pinhole", sensor=sim.sensor),
        assets=AssetsConfig(object_set=sim.object_set, object_dir=sim.object_dir),
        scene=SceneConfig(test_scenes=max(SceneConfig().test_scenes, sim.scene + 1)),
    )
    return Programs(make_env(config.validate(), split="test"))


_OWN = ("camera", "table", "robot", "gripper", "segmenter", "target")
"""What of a cell's file is about real devices."""


def make_simulated_station(
    bundle: Bundle,
    cell: Cell,
    *,
    programs: Programs | None = None,
    log: Path | None = None,
    say: Callable[[str], None] = print,
) -> Station:
    """Return a station whose every device is simulated; its camera is the contract's, its table level with the base.

    Args:
        bundle: the policy.
        cell: which scene, objects and sensor, and how maps are made; a note says what else of it is not used.
        programs: from `make_programs`, where they are at hand.
        log: folder for decisions, None for none.
        say: told what happens.

    Raises:
        ValueError: something cannot be used.
    """
    if cell.sim.scene < 0:
        raise ValueError(f"sim.scene = {cell.sim.scene} is out of range; allowed is 0 and more")
    own = [name for name in _OWN if getattr(cell, name) != getattr(Cell(), name)]
    if own:
        say(f"note: a simulated cell has its own {', '.join(own)}; those of the file are not used")
    decider = make_decider(bundle, dataclasses.replace(cell, table=TableSettings()))
    decisions = DecisionLog(log, bundle.contract) if log else None
    scene = SimulatedCell(programs or make_programs(bundle, cell), cell.sim.scene)
    return Station(
        decider=decider,
        cell=cell.runtime.cell or bundle.contract.camera.cell,
        log=decisions,
        say=say,
        view=nominal_view(bundle.contract.camera),
        source=scene,
        segmenter=scene,
        arm=scene,
        gripper=scene,
        target=scene.target,
    )
