"""The task as a pure environment: reset, step, grasp, for any robot, place, primitive, rules and engine.

`Env` methods describe ONE scene and are meant for `jax.jit(jax.vmap(...))`. The caller resets a scene when
its `StepResult` says terminated or truncated.
"""

import functools
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from pregrasp_jax import geometry, heightmap
from pregrasp_jax.config import TaskConfig
from pregrasp_jax.physics.base import Engine
from pregrasp_jax.robot.base import Robot
from pregrasp_jax.scene.bank import SceneBank
from pregrasp_jax.sensors import CLEAN, Sensor
from pregrasp_jax.spaces import grid
from pregrasp_jax.spaces.workspace import Workspace
from pregrasp_jax.task import grasp
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

_VARIANTS = 1
"""Tells the key that draws variants of objects from those of images."""


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
        sensor: what the pinhole camera and the masks get wrong.
        num_variants: of every object in the bank, which differ in mass and friction; an episode draws among them.
        target_weights: [N] > 0, how likely they become the target of a random scene, a host array; None draws evenly.
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
    sensor: Sensor = CLEAN
    num_variants: int = 1
    target_weights: np.ndarray | None = None

    @property
    def symmetric(self) -> bool:
        """Whether the mirror image of an episode in the plane y = 0 is an episode of the same task.

        Between walls the arm counts, so that it has to start in its mirror image too.
        """
        arm = self.task.mirrored_start and self.robot.mirrored_home is not None
        return self.workspace.symmetric and (arm or not self.workspace.walls)

    def reset(self, key: jax.Array) -> EnvState:
        """Return a random scene of the bank under a random yaw with a random eligible target."""
        scene_key, yaw_key, target_key = jax.random.split(key, 3)
        index = jax.random.randint(scene_key, (), 0, len(self.scenes))
        yaw = jax.random.uniform(yaw_key, minval=-jnp.pi, maxval=jnp.pi)
        object_ids = jnp.asarray(self.scenes.object_ids)[index]
        return self.start(self._scene(index, yaw, self.draw_target(target_key, object_ids)), index)

    def draw_target(self, key: jax.Array, object_ids: jax.Array) -> jax.Array:
        """Return the slot () int32 of a random eligible target among object ids [MAX_OBJECTS]."""
        logits = 0.0 if self.target_weights is None else jnp.log(jnp.asarray(self.target_weights))[object_ids]
        return jax.random.categorical(key, jnp.where(self.eligible_slots(object_ids), logits, -jnp.inf))

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

    def plan_grasp(self, state: EnvState, *, hold: float = grasp.HOLD_TIME) -> Plan:
        """Return the motion of the grasp that ends an evaluated episode, with `hold` s of holding."""
        return grasp.plan_grasp(self.robot, self.workspace, state, hold=hold)

    def plan_trial(self, after: EnvState, result: StepResult) -> Plan:
        """Return the motion that tries to grasp what a push has enclosed; it moves nothing if that is nothing."""
        trial = self.plan_grasp(after, hold=grasp.TRIAL_HOLD)
        return trial.unless(~self.rules.encloses(result.reason), "no_ik")

    def conclude_trial(self, after: EnvState, result: StepResult, physics: Any) -> StepResult:
        """Judge a push anew once `physics` has run through `plan_trial`: a target that slips is no success.

        Where obstacles are enclosed they are what may slip, so that hindsight judges by the same rule.
        """
        held = grasp.held_objects(self.robot, self.bank, after, self.engine.observe(physics))
        outcome = result.outcome.replace(slipped=self.rules.encloses(result.reason) & ~held)
        reward, terminated, reason = self.rules.judge(outcome, after.scene.target)
        reason = jnp.where(result.truncated, result.reason, reason)
        return result.replace(outcome=outcome, reward=reward, terminated=terminated, reason=reason)

    def grasp(self, state: EnvState, *, execute: jax.Array | bool = True) -> GraspResult:
        """Close with constant force, lift 0.2 m, hold 5 s. Without `execute` () bool nothing is held, at no cost."""
        plan = self.plan_grasp(state).unless(~jnp.asarray(execute), "no_ik")
        return self.conclude_grasp(state, plan, self.engine.run(state.physics, plan.ctrl, plan.num_ctrl))

    def conclude_grasp(self, state: EnvState, plan: Plan, physics: Any) -> GraspResult:
        """Return whether the grasp holds, once `physics` has run through its plan."""
        return grasp.judge_grasp(self.robot, self.bank, state, plan, self.engine.observe(physics))

    def start(self, scene: SceneParams, index: jax.Array | int = -1) -> EnvState:
        """Return any scene with the hand at the start; `index` is its row of the bank, -1 for none."""
        blank = jnp.zeros((grid.GRID_SIZE, grid.GRID_SIZE), jnp.uint8)
        physics = self.engine.reset(self.engine.init(), scene, self._starts_mirrored(scene))
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

    def _starts_mirrored(self, scene: SceneParams) -> jax.Array | bool:
        """Return () bool, whether the arm starts in the mirror image of its posture; see `TaskConfig.mirrored_start`.

        The mirror image of a scene then starts with the mirror image of the arm.
        """
        return bool(self.task.mirrored_start and self.workspace.walls) and scene.poses[scene.target, 1] < 0

    def _scene(self, index: jax.Array, yaw: jax.Array, target: jax.Array) -> SceneParams:
        """Return scene `index` of the bank turned by `yaw` about the centre."""
        object_ids, poses = jnp.asarray(self.scenes.object_ids)[index], jnp.asarray(self.scenes.poses)[index]
        turned = jax.vmap(functools.partial(_turn, yaw=yaw))(poses)
        target, poses = target.astype(jnp.int32), jnp.where((object_ids >= 0)[:, None], turned, poses)
        return SceneParams(self._drawn(object_ids, heightmap.episode_key(self.sensor, poses, target)), poses, target)

    def _drawn(self, object_ids: jax.Array, episode: jax.Array) -> jax.Array:
        """Return object ids [MAX_OBJECTS] with a variant of each object, as the episode draws them."""
        if self.num_variants == 1:
            return object_ids
        key = jax.random.fold_in(episode, _VARIANTS)
        variant = jax.random.randint(key, object_ids.shape, 0, self.num_variants)
        num_objects = len(self.bank.names) // self.num_variants
        return jnp.where(object_ids >= 0, object_ids + num_objects * variant, object_ids)

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
        hand = state.hand if hand is None else hand
        obs = heightmap.observe(hulls, hand, camera=self.task.camera, look=self._camera(state))
        return state.replace(physics_obs=physics_obs, obs=obs, centroids=centroids)

    def _camera(self, state: EnvState) -> Callable[..., Any]:
        """Return what the pinhole camera makes of hulls in this state."""
        if self.sensor == CLEAN:
            return heightmap.pinhole
        scene = state.scene
        return functools.partial(
            heightmap.sense,
            self.sensor,
            episode=heightmap.episode_key(self.sensor, scene.poses, scene.target),
            num_pushes=state.num_pushes,
            target=scene.target,
        )


def _turn(pose: jax.Array, *, yaw: jax.Array) -> jax.Array:
    """Rotate a pose about the world's z axis."""
    turn = geometry.quat_from_yaw(yaw)
    blank = jnp.concatenate([jnp.zeros(3), turn])
    position = geometry.transform_points(blank, pose[:3])
    return jnp.concatenate([position, geometry.quat_multiply(turn, pose[3:])])
