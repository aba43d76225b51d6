"""The task of the paper as a pure environment: reset, step, grasp, on any engine.

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

from pregrasp_jax import geometry, grid, heightmap, primitives, startup
from pregrasp_jax.assets.sets import load_bank_for
from pregrasp_jax.config import Config, TaskConfig
from pregrasp_jax.judge import judge
from pregrasp_jax.physics import make_engine
from pregrasp_jax.physics.base import CTRL_DT, Engine
from pregrasp_jax.robot import model as robot
from pregrasp_jax.robot.closing_region import scene_coverage
from pregrasp_jax.scene import bank as scene_bank
from pregrasp_jax.scene.bank import SceneBank, Split
from pregrasp_jax.types import (
    MAX_OBJECTS,
    OPEN,
    REASONS,
    EnvState,
    GraspResult,
    HullBank,
    Observation,
    Outcome,
    PhysicsObservation,
    SceneParams,
    StepResult,
)

MAX_END_ERROR = 0.010
"""m; a push that ends farther from its command than this counts as unreachable, though it was executed."""

TOPPLED = 0.7
"""rad of tilt."""

LIFT_HEIGHT, LIFT_SPEED = 0.2, 0.1
"""m and m/s, after the fingers have closed (Sec. IV-A)."""

CLOSE_TIME, HOLD_TIME = 1.0, 5.0
"""s of closing with constant force, and of holding after the lift."""

_MIN_LIFT = 0.15
"""m; a held object may slip by a quarter of the lift, no more."""


@dataclass(frozen=True)
class Env:
    """Packed scenes, an engine, a camera and the rules.

    Attributes:
        task: radii, horizon, camera.
        bank: the objects, as host arrays.
        scenes: the packed scenes of one split.
        engine: physics.
        max_distance: m, longest push that is planned.
    """

    task: TaskConfig
    bank: HullBank
    scenes: SceneBank
    engine: Engine
    max_distance: float

    def reset(self, key: jax.Array) -> EnvState:
        """Return a random scene of the bank under a random yaw with a random eligible target."""
        scene_key, yaw_key, target_key = jax.random.split(key, 3)
        index = jax.random.randint(scene_key, (), 0, len(self.scenes))
        yaw = jax.random.uniform(yaw_key, minval=-jnp.pi, maxval=jnp.pi)
        object_ids = jnp.asarray(self.scenes.object_ids)[index]
        eligible = (object_ids >= 0) & jnp.asarray(self.bank.eligible)[object_ids]
        target = jax.random.categorical(target_key, jnp.where(eligible, 0.0, -jnp.inf))
        return self.start(self._scene(index, yaw, target), index)

    def reset_to(self, index: jax.Array) -> EnvState:
        """Return scene `index` of the bank with its own yaw and target."""
        yaw, target = jnp.asarray(self.scenes.yaw)[index], jnp.asarray(self.scenes.target)[index]
        return self.start(self._scene(index, yaw, target), index)

    def step(
        self, state: EnvState, action: jax.Array, *, execute: jax.Array | bool = True
    ) -> tuple[EnvState, StepResult]:
        """Push, look, judge.

        Args:
            state: a running scene.
            action: () int32 flat index of Q[row, col, aperture]; it need not lie in the half ring.
            execute: () bool; False refuses the push as if it were out of reach, which costs no physics. For searches
                that are through with one scene of a batch.

        Returns:
            The next state, which is never reset here, and what the push did.
        """
        plan = self.plan(state, action)
        executed = plan.reachable & execute
        physics = self.engine.run(state.physics, plan.ctrl, jnp.where(executed, plan.num_ctrl, 0))
        return self.conclude(state, action, executed, physics)

    def plan(self, state: EnvState, action: jax.Array) -> primitives.Plan:
        """Return the motion of a push, reachable or not; see `step`."""
        row, col, aperture = grid.decode_action(action)
        return primitives.plan_push(
            state.physics_obs.joint_pos[:6],
            state.p1,
            grid.cell_to_world(row, col),
            state.aperture,
            aperture,
            push_speed=self.task.push_speed,
            num_rows=primitives.num_push_rows(self.max_distance, self.task.push_speed),
        )

    def conclude(
        self, state: EnvState, action: jax.Array, reachable: jax.Array, physics: Any
    ) -> tuple[EnvState, StepResult]:
        """Look and judge, as `step` does, once `physics` has run through the plan of a push; () bool `reachable`."""
        row, col, aperture = grid.decode_action(action)
        next_state = self.look(
            state.replace(
                physics=physics,
                p1=jnp.where(reachable, grid.cell_to_world(row, col), state.p1),
                aperture=jnp.where(reachable, aperture, state.aperture),
                num_pushes=state.num_pushes + reachable,
            )
        )
        outcome = self._outcome(state, next_state, reachable)
        reward, terminated, reason = judge(
            outcome, state.scene.target, obstacles_may_leave=self.task.obstacles_may_leave
        )
        truncated = ~terminated & (next_state.num_pushes >= self.task.max_pushes)
        reason = jnp.where(truncated, REASONS.index("truncated"), reason)
        return next_state, StepResult(outcome, reward, terminated, truncated, reason)

    def action_mask(self, p1: jax.Array) -> jax.Array:
        """Return the cells [H, W] bool in which the next push may end."""
        return primitives.half_ring_mask(p1, r_in=self.task.r_in, r_out=self.task.r_out, full_ring=self.task.full_ring)

    def grasp(self, state: EnvState, *, execute: jax.Array | bool = True) -> GraspResult:
        """Close with constant force, lift 0.2 m, hold 5 s. Without `execute` () bool nothing is held, at no cost."""
        times = CTRL_DT * jnp.arange(round((CLOSE_TIME + LIFT_HEIGHT / LIFT_SPEED + HOLD_TIME) / CTRL_DT))
        lift = LIFT_HEIGHT * primitives.minimum_jerk((times - CLOSE_TIME) / (LIFT_HEIGHT / LIFT_SPEED))
        xy = jnp.broadcast_to(state.p1, (len(times), 2))
        positions = jnp.concatenate([xy, robot.PUSH_HEIGHT + lift[:, None]], axis=1)
        arm, ok = primitives.plan_arm(state.physics_obs.joint_pos[:6], positions)
        fingers = jnp.full((len(times), 1), robot.FINGER_CLOSED)
        ctrl = jnp.concatenate([arm, fingers], axis=1)
        physics = self.engine.run(state.physics, ctrl, jnp.where(jnp.all(ok) & execute, len(times), 0))
        after = self.engine.observe(physics)
        target = state.scene.target
        rise = after.object_poses[target, 2] - state.physics_obs.object_poses[target, 2]
        held = self._coverage(after, state.scene, jnp.int32(OPEN))[target] > 0
        return GraspResult((rise > _MIN_LIFT) & held & ~after.diverged, after.diverged, after.overflows)

    def start(self, scene: SceneParams, index: jax.Array | int = -1) -> EnvState:
        """Return any scene with the open hand at the start; `index` is its row of the bank, -1 for none."""
        blank = jnp.zeros((grid.GRID_SIZE, grid.GRID_SIZE), jnp.uint8)
        physics = self.engine.reset(self.engine.init(), scene)
        p1 = jnp.asarray(robot.START_POSE[:2], jnp.float32)
        return self.look(
            EnvState(
                physics=physics,
                scene=scene,
                scene_index=jnp.int32(index),
                physics_obs=self.engine.observe(physics),
                obs=Observation(blank, blank, p1),
                centroids=jnp.zeros((MAX_OBJECTS, 2)),
                p1=p1,
                aperture=jnp.int32(OPEN),
                num_pushes=jnp.int32(0),
            )
        )

    def _scene(self, index: jax.Array, yaw: jax.Array, target: jax.Array) -> SceneParams:
        """Return scene `index` of the bank turned by `yaw` about the centre."""
        object_ids, poses = jnp.asarray(self.scenes.object_ids)[index], jnp.asarray(self.scenes.poses)[index]
        turned = jax.vmap(functools.partial(_turn, yaw=yaw))(poses)
        return SceneParams(object_ids, jnp.where((object_ids >= 0)[:, None], turned, poses), target.astype(jnp.int32))

    def look(self, state: EnvState) -> EnvState:
        """Return the state with everything that is seen or measured brought up to date with its physics."""
        physics_obs = self.engine.observe(state.physics)
        hulls = heightmap.scene_hulls(self.bank, state.scene, physics_obs)
        com = jnp.asarray(self.bank.com)[state.scene.object_ids]
        centroids = jax.vmap(geometry.transform_points)(physics_obs.object_poses, com)[:, :2]
        obs = heightmap.observe(hulls, state.p1, camera=self.task.camera)
        return state.replace(physics_obs=physics_obs, obs=obs, centroids=centroids)

    def _coverage(self, physics_obs: PhysicsObservation, scene: SceneParams, aperture: jax.Array) -> jax.Array:
        return scene_coverage(self.bank, scene.object_ids, physics_obs.object_poses, physics_obs.hand_pose, aperture)

    def _outcome(self, before: EnvState, after: EnvState, reachable: jax.Array) -> Outcome:
        present = before.scene.object_ids >= 0
        poses = after.physics_obs.object_poses
        com_z = jax.vmap(geometry.transform_points)(poses, jnp.asarray(self.bank.com)[before.scene.object_ids])[:, 2]
        beyond = jnp.any(jnp.abs(after.centroids) > grid.WORKSPACE_HALF_SIZE, axis=-1)
        up_z = 1 - 2 * (poses[:, 4] ** 2 + poses[:, 5] ** 2)
        end_error = jnp.linalg.norm(after.physics_obs.hand_pose[:3] - jnp.append(after.p1, robot.PUSH_HEIGHT))
        return Outcome(
            coverage=self._coverage(after.physics_obs, before.scene, after.aperture),
            distance_before=_distance(before),
            distance_after=_distance(after),
            toppled=present & (up_z < jnp.cos(TOPPLED)),
            off_table=present & (beyond | (com_z < 0)),
            unreachable=~reachable | (end_error > MAX_END_ERROR),
            no_action=~jnp.any(self.action_mask(after.p1)),
            diverged=after.physics_obs.diverged,
        )


def make_env(
    config: Config, *, split: Split, threads: int | None = None, progress: scene_bank.Progress | None = None
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
    _refuse_empty_ring(config.task)
    bank = load_bank_for(config.assets.object_dir, config.assets.object_set)
    engine = make_engine(config.physics.engine, bank, threads=threads)
    scenes = scene_bank.load_or_build(bank, config.scene, split, threads=threads, progress=progress)
    return Env(task=config.task, bank=bank, scenes=scenes, engine=engine, max_distance=longest_push(config))


def longest_push(config: Config) -> float:
    """Return the length, m, of the longest push that is planned: unguided exploration goes anywhere at once."""
    return config.task.r_out if config.exploration.guided else float(np.hypot(0.5, 0.5) + 0.1)


def with_task(env: Env, **changes: object) -> Env:
    """Return the same scenes and engine under a changed task, for example another `r_out` or camera."""
    task = dataclasses.replace(env.task, **changes)  # pyright: ignore[reportArgumentType]
    return dataclasses.replace(env, task=task, max_distance=max(env.max_distance, task.r_out))


def _turn(pose: jax.Array, *, yaw: jax.Array) -> jax.Array:
    """Rotate a pose about the world's z axis."""
    turn = geometry.quat_from_yaw(yaw)
    blank = jnp.concatenate([jnp.zeros(3), turn])
    position = geometry.transform_points(blank, pose[:3])
    return jnp.concatenate([position, geometry.quat_multiply(turn, pose[3:])])


def _distance(state: EnvState) -> jax.Array:
    """Return the planar distance [MAX_OBJECTS] m from each centroid to the grasp point."""
    return jnp.linalg.norm(state.centroids - state.physics_obs.hand_pose[None, :2], axis=-1)


def _refuse_empty_ring(task: TaskConfig) -> None:
    start = jnp.asarray(robot.START_POSE[:2], jnp.float32)
    if not primitives.half_ring_mask(start, r_in=task.r_in, r_out=task.r_out, full_ring=task.full_ring).any():
        raise ValueError(
            f"task.r_in = {task.r_in} and task.r_out = {task.r_out} leave no cell of the workspace around the start "
            f"pose (x = {robot.START_POSE[0]} m); allowed is a ring at least 0.01 m wide that reaches 0.06 m"
        )
