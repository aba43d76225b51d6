"""The task as a pure environment: reset, step, grasp, for any robot, place, primitive, rules and engine.

`Env` methods describe ONE scene and are meant for `jax.jit(jax.vmap(...))`. The caller resets a scene when
its `StepResult` says terminated or truncated.
"""

import dataclasses
import functools
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from pregrasp_jax import geometry, heightmap, startup
from pregrasp_jax.assets.sets import load_bank_for
from pregrasp_jax.config import Config, TaskConfig
from pregrasp_jax.physics import make_engine
from pregrasp_jax.physics.base import Engine
from pregrasp_jax.robot import get_robot
from pregrasp_jax.robot.base import Robot
from pregrasp_jax.robot.clearance import CLEARANCE_MARGIN
from pregrasp_jax.scene import bank as scene_bank
from pregrasp_jax.scene.bank import SceneBank, Split
from pregrasp_jax.scene.packing import MAX_RADIUS
from pregrasp_jax.spaces import grid
from pregrasp_jax.spaces.workspace import Workspace, get_workspace
from pregrasp_jax.task import grasp, registry
from pregrasp_jax.task.primitive import Plan, Primitive
from pregrasp_jax.task.rules import Rules
from pregrasp_jax.types import (
    MAX_OBJECTS,
    REASONS,
    EnvState,
    GraspResult,
    HandPose,
    HullBank,
    Observation,
    SceneParams,
    StepResult,
)


@dataclass(frozen=True)
class Env:
    """Packed scenes, and everything that acts on them.

    Attributes:
        task: horizon and camera.
        workspace: where.
        robot: who.
        primitive: does what.
        rules: to what end.
        bank: the objects, as host arrays.
        eligible: [N] bool, which of them may be targets, a host array.
        scenes: the packed scenes of one split.
        engine: physics.
        max_distance: m, longest push that is planned.
    """

    task: TaskConfig
    workspace: Workspace
    robot: Robot
    primitive: Primitive
    rules: Rules
    bank: HullBank
    eligible: np.ndarray
    scenes: SceneBank
    engine: Engine
    max_distance: float

    def reset(self, key: jax.Array) -> EnvState:
        """Return a random scene of the bank under a random yaw with a random eligible target."""
        scene_key, yaw_key, target_key = jax.random.split(key, 3)
        index = jax.random.randint(scene_key, (), 0, len(self.scenes))
        yaw = jax.random.uniform(yaw_key, minval=-jnp.pi, maxval=jnp.pi)
        object_ids = jnp.asarray(self.scenes.object_ids)[index]
        target = jax.random.categorical(target_key, jnp.where(self.eligible_slots(object_ids), 0.0, -jnp.inf))
        return self.start(self._scene(index, yaw, target), index)

    def reset_to(self, index: jax.Array) -> EnvState:
        """Return scene `index` of the bank with its own yaw and target."""
        yaw, target = jnp.asarray(self.scenes.yaw)[index], jnp.asarray(self.scenes.target)[index]
        return self.start(self._scene(index, yaw, target), index)

    def step(self, state: EnvState, action: Any, *, execute: jax.Array | bool = True) -> tuple[EnvState, StepResult]:
        """Push, look, judge.

        Args:
            state: a running scene.
            action: () int32 flat index of Q[row, col, choice], or what else the primitive takes; it need not be allowed
                by `action_mask`.
            execute: () bool; False refuses the push as if it were out of reach, which costs no physics. For searches
                that are through with one scene of a batch.

        Returns:
            The next state, which is never reset here, and what the push did.
        """
        plan = self.plan(state, action).unless(~jnp.asarray(execute), "no_ik")
        return self.conclude(state, plan, self.engine.run(state.physics, plan.ctrl, plan.num_ctrl))

    def plan(self, state: EnvState, action: Any) -> Plan:
        """Return the motion of a push, reachable or not; see `step`."""
        return self.primitive.plan(state.physics_obs.joint_pos, self.primitive.decode(state.hand, action))

    def conclude(self, state: EnvState, plan: Plan, physics: Any) -> tuple[EnvState, StepResult]:
        """Look and judge, as `step` does, once `physics` has run through the plan of a push."""
        hand = jax.tree.map(functools.partial(jnp.where, plan.reachable), plan.hand, state.hand)
        after = self.look(state.replace(physics=physics, num_pushes=state.num_pushes + plan.reachable), hand)
        outcome = self.rules.measure(state, after, plan)
        reward, terminated, reason = self.rules.judge(outcome, state.scene.target)
        truncated = ~terminated & (after.num_pushes >= self.task.max_pushes)
        reason = jnp.where(truncated, REASONS.index("truncated"), reason)
        return after, StepResult(outcome, reward, terminated, truncated, reason, plan.seconds)

    def action_mask(self, hand: HandPose) -> jax.Array:
        """Return which actions [H, W, K] bool are allowed next."""
        return self.primitive.mask(hand)

    def eligible_slots(self, object_ids: jax.Array) -> jax.Array:
        """Return which slots [...] bool of object ids [...] int32 hold an object that may be a target."""
        return (object_ids >= 0) & jnp.asarray(self.eligible)[object_ids]

    def plan_grasp(self, state: EnvState) -> Plan:
        """Return the motion of the grasp that ends an evaluated episode."""
        return grasp.plan_grasp(self.robot, self.workspace, state)

    def grasp(self, state: EnvState, *, execute: jax.Array | bool = True) -> GraspResult:
        """Close with constant force, lift 0.2 m, hold 5 s. Without `execute` () bool nothing is held, at no cost."""
        plan = self.plan_grasp(state).unless(~jnp.asarray(execute), "no_ik")
        return self.conclude_grasp(state, self.engine.run(state.physics, plan.ctrl, plan.num_ctrl))

    def conclude_grasp(self, state: EnvState, physics: Any) -> GraspResult:
        """Return whether the grasp holds, once `physics` has run through its plan."""
        return grasp.judge_grasp(self.robot, self.bank, state, self.engine.observe(physics))

    def start(self, scene: SceneParams, index: jax.Array | int = -1) -> EnvState:
        """Return any scene with the hand at the start; `index` is its row of the bank, -1 for none."""
        blank = jnp.zeros((grid.GRID_SIZE, grid.GRID_SIZE), jnp.uint8)
        physics = self.engine.reset(self.engine.init(), scene)
        hand = jax.tree.map(jnp.asarray, self.robot.start)
        state = EnvState(
            physics=physics,
            scene=scene,
            scene_index=jnp.int32(index),
            physics_obs=self.engine.observe(physics),
            obs=Observation(blank, blank, hand),
            centroids=jnp.zeros((MAX_OBJECTS, 3)),
            num_pushes=jnp.int32(0),
        )
        return self.look(state, hand)

    def _scene(self, index: jax.Array, yaw: jax.Array, target: jax.Array) -> SceneParams:
        """Return scene `index` of the bank turned by `yaw` about the centre."""
        object_ids, poses = jnp.asarray(self.scenes.object_ids)[index], jnp.asarray(self.scenes.poses)[index]
        turned = jax.vmap(functools.partial(_turn, yaw=yaw))(poses)
        return SceneParams(object_ids, jnp.where((object_ids >= 0)[:, None], turned, poses), target.astype(jnp.int32))

    def look(self, state: EnvState, hand: HandPose | None = None) -> EnvState:
        """Return the state with everything that is seen or measured brought up to date with its physics.

        Args:
            state: its physics is ahead of the rest.
            hand: where the hand has been sent; as the state says if None.
        """
        physics_obs = self.engine.observe(state.physics)
        hulls = heightmap.scene_hulls(self.bank, self.robot, state.scene, physics_obs, self.workspace)
        com = jnp.asarray(self.bank.com)[state.scene.object_ids]
        centroids = jax.vmap(geometry.transform_points)(physics_obs.object_poses, com)
        obs = heightmap.observe(hulls, state.hand if hand is None else hand, camera=self.task.camera)
        return state.replace(physics_obs=physics_obs, obs=obs, centroids=centroids)


def make_env(
    config: Config, *, split: Split, threads: int | None = None, progress: scene_bank.PackingProgress | None = None
) -> Env:
    """Load the objects, load or pack the scenes of a split, and compile an engine of this environment's own.

    Args:
        config: the run's configuration.
        split: `train`, `validation` or `test`.
        threads: overrides `config.physics.threads`.
        progress: told about scenes packed so far, if any must be packed.

    Raises:
        ValueError: the objects or settings cannot be used; one line says why.
    """
    startup.check()
    threads = config.physics.threads if threads is None else threads
    refuse_walls(get_robot(config.task.robot), get_workspace(config.task.workspace))
    registry.get_kind(config.task.primitive)  # before anything is packed
    bank = load_bank_for(config.assets.object_dir, config.assets.object_set)
    eligible = eligible_targets(get_robot(config.task.robot), bank, origin=str(config.assets.object_dir or "built in"))
    scenes = scene_bank.load_or_build(bank, eligible, config.scene, split, threads=threads, progress=progress)
    return assemble(config, bank, scenes, eligible=eligible, threads=threads)


def assemble(
    config: Config, bank: HullBank, scenes: SceneBank, *, eligible: np.ndarray | None = None, threads: int = 0
) -> Env:
    """Return the environment of a configuration for objects and scenes at hand; see `make_env`.

    Args:
        config: the run's configuration.
        bank: the objects.
        scenes: the packed scenes of one split.
        eligible: [N] bool, from `eligible_targets`, where that is known.
        threads: of the native engine; 0 takes every core.
    """
    robot, workspace = get_robot(config.task.robot), get_workspace(config.task.workspace)
    refuse_walls(robot, workspace)
    eligible = eligible_targets(robot, bank) if eligible is None else eligible
    reach = longest_push(config)
    parts = make_task(config.task, robot, workspace, bank, max_distance=reach)
    engines = registry.get_kind(config.task.primitive).engines
    engine = make_engine(config.physics.engine, bank, robot, workspace, threads=threads, engines=engines)
    return Env(config.task, workspace, robot, *parts, bank, eligible, scenes, engine, reach)


def eligible_targets(robot: Robot, bank: HullBank, *, origin: str = "hull bank") -> np.ndarray:
    """Return which objects [N] bool a robot's hand can take.

    Args:
        robot: whose hand.
        bank: the objects.
        origin: where they come from, for the error.

    Raises:
        ValueError: none; the line says why the first one cannot be taken.
    """
    eligible, reasons = robot.eligibility(bank)
    if not eligible.any():
        raise ValueError(
            f"{origin}: none of {len(bank.names)} objects can be a target for robot {robot.name}; allowed is at least "
            f"1. The first: {bank.names[0]}: {reasons[0]}"
        )
    return eligible


def make_task(
    task: TaskConfig, robot: Robot, workspace: Workspace, bank: HullBank, *, max_distance: float
) -> tuple[Primitive, Rules]:
    """Return the primitive of a task and its rules.

    Raises:
        ValueError: there is no such primitive, the robot does not fit it, or no action is allowed at the start.
    """
    kind = registry.get_kind(task.primitive)
    primitive = kind.make_primitive(robot, workspace, task, max_distance=max_distance)
    if not primitive.mask(jax.tree.map(jnp.asarray, robot.start)).any():
        x, y = robot.start.xy
        raise ValueError(
            f"task.r_in = {task.r_in} and task.r_out = {task.r_out} leave no cell of the workspace around the start "
            f"pose (x = {x:g} m, y = {y:g} m); allowed is a ring at least 0.01 m wide that reaches the workspace"
        )
    return primitive, kind.make_rules(robot, workspace, primitive, bank, task)


def refuse_walls(robot: Robot, workspace: Workspace) -> None:
    """Refuse a place whose walls are where the robot starts or where scenes are packed.

    Raises:
        ValueError: one line says which wall, and what is allowed.
    """
    for index, wall in enumerate(workspace.walls):
        alone = dataclasses.replace(workspace, walls=(wall,))
        reach = wall.distance_to_origin()
        if reach < MAX_RADIUS:
            raise ValueError(
                f"workspace '{workspace.name}': wall {index} comes within {reach:.3f} m of the centre, where scenes "
                f"are packed; allowed is {MAX_RADIUS} m or more"
            )
        clear = float(robot.clearance(jnp.asarray(robot.home), alone))
        if clear < CLEARANCE_MARGIN:
            raise ValueError(
                f"workspace '{workspace.name}': wall {index} is {clear:.3f} m from robot {robot.name} at its start "
                f"pose; allowed is {CLEARANCE_MARGIN} m or more"
            )


def longest_push(config: Config) -> float:
    """Return the length, m, of the longest push that is planned: unguided exploration goes anywhere at once."""
    return config.task.r_out if config.exploration.guided else float(np.hypot(0.5, 0.5) + 0.1)


def with_task(env: Env, **changes: object) -> Env:
    """Return the same scenes and engine under a changed task, for example another `r_out` or camera."""
    task = dataclasses.replace(env.task, **changes)  # pyright: ignore[reportArgumentType]
    reach = max(env.max_distance, task.r_out)
    primitive, rules = make_task(task, env.robot, env.workspace, env.bank, max_distance=reach)
    return dataclasses.replace(env, task=task, primitive=primitive, rules=rules, max_distance=reach)


def _turn(pose: jax.Array, *, yaw: jax.Array) -> jax.Array:
    """Rotate a pose about the world's z axis."""
    turn = geometry.quat_from_yaw(yaw)
    blank = jnp.concatenate([jnp.zeros(3), turn])
    position = geometry.transform_points(blank, pose[:3])
    return jnp.concatenate([position, geometry.quat_multiply(turn, pose[3:])])
