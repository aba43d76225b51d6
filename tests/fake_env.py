"""A world without physics, in which every episode can be worked out by hand.

The hand jumps to the cell it is told. An object is in the closing region if the open hand ends within 12 mm
of it. Cells of the five lowest rows are out of reach: such a push is refused. Even scenes hold the grasp.
"""

import functools
from dataclasses import dataclass, field
from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from pregrasp_jax.config import TaskConfig
from pregrasp_jax.sensors import CLEAN, Sensor
from pregrasp_jax.spaces import grid
from pregrasp_jax.spaces.actions import ActionSpace, Choice
from pregrasp_jax.spaces.workspace import TABLE, Workspace
from pregrasp_jax.task.primitive import Plan, Primitive, Stroke, make_plan
from pregrasp_jax.task.push import APERTURE_TIME, SETTLE_TIME
from pregrasp_jax.task.rules import Rules, judging
from pregrasp_jax.types import (
    MAX_OBJECTS,
    OBSTRUCTIONS,
    REASONS,
    EnvState,
    GraspResult,
    HandPose,
    Observation,
    Outcome,
    PhysicsObservation,
    SceneParams,
    StepResult,
)

START = (-0.30, 0.0)
IN_REGION = 0.012
UNREACHABLE_ROWS = 5
CLOSED, OPEN = 0, 1
"""Choices of a push."""

ACTIONS = ActionSpace(
    tuple(Choice(name=name, z=0.1, yaw=0.0, aperture=angle) for name, angle in (("closed", 0.0), ("open", 1.0))),
    mirrored=(0, 1),
)


def hand_at(xy: Any, *, aperture: float = 1.0) -> HandPose:
    """Return a hand at [2] m, as high and as turned as every push holds it."""
    return HandPose(jnp.asarray(xy, jnp.float32), jnp.float32(0.1), jnp.float32(0.0), jnp.float32(aperture))


def is_open(aperture: jax.Array) -> jax.Array:
    """Return whether a hand of the fake world has a closing region."""
    return aperture > 0.5


def fake_rules(task: TaskConfig, measure: Any = None) -> Rules:
    """Return the paper's rules for the hand of the fake world."""
    return judging(is_open, task, measure=measure)


def make_outcome(**fields: Any) -> Outcome:
    """Return what an open hand did that met nothing, ended nowhere nearer and enclosed nothing, but for `fields`."""
    plain = Outcome(
        coverage=jnp.zeros(MAX_OBJECTS),
        aperture=jnp.float32(1.0),
        distance_before=jnp.full(MAX_OBJECTS, 0.2),
        distance_after=jnp.full(MAX_OBJECTS, 0.2),
        toppled=jnp.zeros(MAX_OBJECTS, bool),
        off_table=jnp.zeros(MAX_OBJECTS, bool),
        obstruction=jnp.int32(0),
        no_action=jnp.zeros((), bool),
        diverged=jnp.zeros((), bool),
        slipped=jnp.zeros(MAX_OBJECTS, bool),
    )
    return plain.replace(**fields)


class FakeScenes(SimpleNamespace):
    def __len__(self) -> int:
        return len(self.target)


def make_scenes(num_scenes: int, seed: int = 0) -> FakeScenes:
    """Draw object positions [S, 8, 2]; each scene has a target in slot 1 or 2 and two obstacles."""
    rng = np.random.default_rng(seed)
    object_ids = np.full((num_scenes, MAX_OBJECTS), -1)
    object_ids[:, :3] = rng.permuted(np.tile(np.arange(3), (num_scenes, 1)), axis=1)
    return FakeScenes(
        xy=rng.uniform(-0.18, 0.2, (num_scenes, MAX_OBJECTS, 2)).astype(np.float32),
        object_ids=object_ids,
        target=rng.integers(1, 3, num_scenes),
        content_hash="scenes",
    )


def make_engine() -> SimpleNamespace:
    """Return an engine that runs nothing."""
    return SimpleNamespace(
        name="native",
        run=lambda physics, ctrl, num_ctrl: physics,
        advance=None,
        coordinates=lambda _: (np.zeros(0), np.zeros(0)),
    )


@dataclass(frozen=True)
class FakeEnv:
    """Same interface as `pregrasp_jax.task.env.Env`."""

    scenes: FakeScenes = field(default_factory=lambda: make_scenes(12))
    task: TaskConfig = field(default_factory=TaskConfig)
    bank: Any = field(default_factory=lambda: SimpleNamespace(names=("mug", "can", "box"), content_hash="hulls"))
    eligible: Any = field(default_factory=lambda: np.array([True, True, False]))
    engine: Any = field(default_factory=make_engine)
    workspace: Workspace = TABLE
    sensor: Sensor = CLEAN
    symmetric: bool = True

    @functools.cached_property
    def primitive(self) -> Primitive:
        def decode(hand: HandPose, action: jax.Array) -> Stroke:
            xy, choice = ACTIONS.decode(action)
            return Stroke(start=hand, end=HandPose(xy, *ACTIONS.held(choice)))

        def plan(joint_pos: jax.Array, stroke: Stroke) -> Plan:
            del joint_pos
            row, _ = grid.world_to_cell(stroke.end.xy)
            code = jnp.where(row >= UNREACHABLE_ROWS, 0, OBSTRUCTIONS.index("no_ik"))
            wait = jnp.where(stroke.start.aperture == stroke.end.aperture, 0.0, APERTURE_TIME)
            seconds = wait + jnp.linalg.norm(stroke.end.xy - stroke.start.xy) / self.task.push_speed + SETTLE_TIME
            return make_plan(jnp.zeros((1, 1)), jnp.int32(1), seconds, code, stroke.end)

        return Primitive(name="jump", actions=ACTIONS, mask=self.action_mask, decode=decode, plan=plan)

    @functools.cached_property
    def rules(self) -> Rules:
        return fake_rules(self.task, self._measure)

    def reset_to(self, index: jax.Array) -> EnvState:
        scene = SceneParams(
            jnp.asarray(self.scenes.object_ids)[index],
            jnp.zeros((MAX_OBJECTS, 7)),
            jnp.asarray(self.scenes.target, jnp.int32)[index],
        )
        blank = jnp.zeros((grid.GRID_SIZE, grid.GRID_SIZE), jnp.uint8)
        return EnvState(
            physics=(),
            scene=scene,
            scene_index=jnp.asarray(index, jnp.int32),
            physics_obs=PhysicsObservation(
                jnp.zeros((MAX_OBJECTS, 7)), jnp.zeros(8), jnp.zeros(7), jnp.zeros((), bool), jnp.int32(0)
            ),
            obs=Observation(blank, blank, hand_at(START)),
            centroids=jnp.pad(jnp.asarray(self.scenes.xy)[index], ((0, 0), (0, 1))),
            num_pushes=jnp.int32(0),
        )

    def action_mask(self, hand: HandPose) -> jax.Array:
        ring = grid.half_ring(hand.xy, r_in=self.task.r_in, r_out=self.task.r_out)
        return jnp.broadcast_to(ring[..., None], ACTIONS.shape)

    def eligible_slots(self, object_ids: jax.Array) -> jax.Array:
        return (object_ids >= 0) & jnp.asarray(self.eligible)[object_ids]

    def plan(self, state: EnvState, action: jax.Array) -> Plan:
        return self.primitive.plan(state.physics_obs.joint_pos, self.primitive.decode(state.hand, action))

    def conclude(self, state: EnvState, plan: Plan, physics: Any) -> tuple[EnvState, StepResult]:
        hand = jax.tree.map(functools.partial(jnp.where, plan.reachable), plan.hand, state.hand)
        num_pushes = state.num_pushes + plan.reachable
        after = state.replace(physics=physics, obs=state.obs.replace(hand=hand), num_pushes=num_pushes)
        outcome = self.rules.measure(state, after, plan)
        reward, terminated, reason = self.rules.judge(outcome, state.scene.target)
        truncated = ~terminated & (num_pushes >= self.task.max_pushes)
        reason = jnp.where(truncated, REASONS.index("truncated"), reason)
        return after, StepResult(outcome, reward, terminated, truncated, reason, plan.seconds)

    def step(
        self, state: EnvState, action: jax.Array, *, execute: jax.Array | bool = True
    ) -> tuple[EnvState, StepResult]:
        plan = self.plan(state, action).unless(~jnp.asarray(execute), "no_ik")
        return self.conclude(state, plan, state.physics)

    def plan_grasp(self, state: EnvState) -> Plan:
        return make_plan(jnp.zeros((1, 1)), jnp.int32(1), jnp.float32(1.0), jnp.int32(0), state.hand)

    def plan_trial(self, after: EnvState, result: StepResult) -> Plan:
        return self.plan_grasp(after).unless(~self.rules.encloses(result.reason), "no_ik")

    def conclude_trial(self, after: EnvState, result: StepResult, physics: Any) -> StepResult:
        del physics
        slipped = self.rules.encloses(result.reason) & (after.scene_index % 2 == 1)
        outcome = result.outcome.replace(slipped=jnp.broadcast_to(slipped, (MAX_OBJECTS,)))
        reward, terminated, reason = self.rules.judge(outcome, after.scene.target)
        reason = jnp.where(result.truncated, result.reason, reason)
        return result.replace(outcome=outcome, reward=reward, terminated=terminated, reason=reason)

    def conclude_grasp(self, state: EnvState, plan: Plan, physics: Any) -> GraspResult:
        del physics
        return GraspResult(state.scene_index % 2 == 0, jnp.bool_(False), jnp.int32(0), plan.obstruction)

    def grasp(self, state: EnvState, *, execute: jax.Array | bool = True) -> GraspResult:
        result = self.conclude_grasp(state, self.plan_grasp(state), state.physics)
        return result.replace(held=result.held & execute)

    def _measure(self, before: EnvState, after: EnvState, plan: Plan) -> Outcome:
        distance = _distance(after)
        present = before.scene.object_ids >= 0
        return make_outcome(
            coverage=jnp.where(present & (distance < IN_REGION), 1.0, 0.0),
            aperture=after.hand.aperture,
            distance_before=_distance(before),
            distance_after=distance,
            obstruction=plan.obstruction,
            no_action=~jnp.any(self.action_mask(after.hand)),
        )


def _distance(state: EnvState) -> jax.Array:
    return jnp.linalg.norm(state.centroids[:, :2] - state.hand.xy[None], axis=-1)


def fake_env(**fields: Any) -> Any:
    """Return a `FakeEnv`, typed as whatever the caller needs."""
    return FakeEnv(**fields)
