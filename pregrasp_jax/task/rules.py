"""What a push was worth, for any object as the goal.

One function decides reward, termination and reason. `env.step` calls it with the scene's own target and
hindsight relabelling with the enclosed obstacle, so a relabelled episode is judged exactly as a real one.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp

from pregrasp_jax.config import TaskConfig
from pregrasp_jax.robot.base import Robot
from pregrasp_jax.robot.closing_region import scene_coverage
from pregrasp_jax.spaces.workspace import Workspace
from pregrasp_jax.task.primitive import Plan, Primitive
from pregrasp_jax.types import REASONS, EnvState, HullBank, Outcome, PhysicsObservation

IN_REGION_COVERAGE = 0.95
"""An object is in the closing region if more than this share of its projection is (Sec. III-D)."""

MIN_APPROACH = 1e-3
"""m; the hand moved closer to the goal if the planar distance fell by more than this."""

MAX_END_ERROR = 0.010
"""m; a push that ends farther from its command than this counts as unreachable, though it was executed."""

TOPPLED = 0.7
"""rad of tilt."""

RUNNING = REASONS.index("running")
TARGET_IN_REGION = REASONS.index("target_in_region")
OBSTACLE_IN_REGION = REASONS.index("obstacle_in_region")


class Verdict(NamedTuple):
    """What a push was worth for one goal.

    Attributes:
        reward: () float32.
        terminated: () bool.
        reason: () int32 index into `REASONS`, `RUNNING` if not terminated.
    """

    reward: jax.Array
    terminated: jax.Array
    reason: jax.Array


@dataclass(frozen=True)
class Rules:
    """Who has won, and who has lost; every function is pure and unbatched.

    Attributes:
        measure: (state before, state after, plan) -> `Outcome`, the same for every goal. The state after says where the
            hand was sent if the plan was executed.
        judge: (outcome, goal () int32 slot) -> `Verdict`.
        hindsight_goal: (outcome, goal, eligible [MAX_OBJECTS] bool) -> slot () int32 and found () bool: the object for
            which an episode that ends with this outcome was a success, if there is one.
        successes: reasons that count as success, indices into `REASONS`.
        asks_for_grasp: whether a success has yet to be grasped, by `Env.grasp`.
    """

    measure: Callable[[EnvState, EnvState, Plan], Outcome]
    judge: Callable[[Outcome, jax.Array], Verdict]
    hindsight_goal: Callable[[Outcome, jax.Array, jax.Array], tuple[jax.Array, jax.Array]]
    successes: tuple[int, ...]
    asks_for_grasp: bool = True

    def encloses(self, reason: jax.Array) -> jax.Array:
        """Return () bool, whether an episode that ended for this reason has left an object to be grasped."""
        return self.asks_for_grasp & ((reason == TARGET_IN_REGION) | (reason == OBSTACLE_IN_REGION))

    def succeeded(self, reason: jax.Array) -> jax.Array:
        """Return [...] bool, which reasons [...] count as success."""
        return jnp.any(jnp.stack([reason == success for success in self.successes]), axis=0)


def make_rules(robot: Robot, workspace: Workspace, primitive: Primitive, bank: HullBank, task: TaskConfig) -> Rules:
    """Return the paper's rules: the target has to lie in the closing region of the open hand, before any obstacle does.

    Raises:
        ValueError: the robot has no closing region.
    """
    region = robot.closing_region
    if region is None:
        raise ValueError(
            f"robot {robot.name} has no closing region; allowed for primitive {primitive.name} is one that has"
        )

    def measure(before: EnvState, after: EnvState, plan: Plan) -> Outcome:
        present = before.scene.object_ids >= 0
        seen, hand = after.physics_obs, after.hand
        up_z = 1 - 2 * (seen.object_poses[:, 4] ** 2 + seen.object_poses[:, 5] ** 2)
        end_error = jnp.linalg.norm(seen.hand_pose[:3] - jnp.append(hand.xy, hand.z))
        jammed = _jammed(workspace, seen)
        return Outcome(
            coverage=scene_coverage(
                bank, before.scene.object_ids, seen.object_poses, seen.hand_pose, region(hand.aperture)
            ),
            aperture=hand.aperture,
            distance_before=_distance(before),
            distance_after=_distance(after),
            toppled=present & (up_z < jnp.cos(TOPPLED)),
            off_table=present & workspace.has_left(after.centroids),
            obstruction=plan.unless(jammed, "jammed").unless(end_error > MAX_END_ERROR, "end_error").obstruction,
            no_action=~jnp.any(primitive.mask(hand)),
            diverged=seen.diverged & ~jammed,
            slipped=jnp.zeros_like(present),
        )

    return judging(lambda aperture: jnp.asarray(region(aperture).exists), task, measure=measure)


def judging(
    region_exists: Callable[[jax.Array], jax.Array],
    task: TaskConfig,
    *,
    measure: Callable[[EnvState, EnvState, Plan], Outcome],
) -> Rules:
    """Return the paper's rules for outcomes that are measured in any way.

    Args:
        region_exists: (aperture) -> () bool, whether a hand held like this has a closing region.
        task: rewards, and whether obstacles may leave.
        measure: see `Rules`.
    """

    def reason_for(outcome: Outcome, goal: jax.Array) -> jax.Array:
        enclosed = in_region(outcome, region_exists(outcome.aperture))
        return end_reason(outcome, goal, enclosed, obstacles_may_leave=task.obstacles_may_leave)

    def judge(outcome: Outcome, goal: jax.Array) -> Verdict:
        reason = reason_for(outcome, goal)
        terms = reward_terms(outcome, goal, reason)
        weights = {"target_in_region": task.in_region_reward, "approach": task.approach_reward}
        reward = sum((weights[name] * term for name, term in terms.items()), jnp.float32(0.0))
        return Verdict(reward, reason != RUNNING, reason)

    def hindsight_goal(outcome: Outcome, goal: jax.Array, eligible: jax.Array) -> tuple[jax.Array, jax.Array]:
        assert outcome.coverage.shape == eligible.shape, f"{outcome.coverage.shape} and {eligible.shape} differ"
        # The target may lie there as well, if it slipped when its grasp was tried.
        others = eligible & (jnp.arange(eligible.shape[0]) != goal)
        candidates = in_region(outcome, region_exists(outcome.aperture)) & others
        slot = jnp.argmax(jnp.where(candidates, outcome.coverage, -1.0)).astype(jnp.int32)
        return slot, jnp.any(candidates) & (reason_for(outcome, goal) == OBSTACLE_IN_REGION)

    return Rules(measure, judge, hindsight_goal, successes=(TARGET_IN_REGION,))


def in_region(outcome: Outcome, exists: jax.Array) -> jax.Array:
    """Return which objects lie in the closing region, [MAX_OBJECTS] bool; none if it does not exist () bool."""
    return exists & (outcome.coverage > IN_REGION_COVERAGE)


def end_reason(
    outcome: Outcome, goal: jax.Array, enclosed: jax.Array, *, obstacles_may_leave: bool = False
) -> jax.Array:
    """Return why the push ends an episode whose target is `goal`, index into `REASONS`; `RUNNING` if it does not.

    The first match in the order of `REASONS` wins. Truncation is not a property of a push and is left to the caller.

    Args:
        outcome: what the push did, unbatched.
        goal: () int32 slot.
        enclosed: [MAX_OBJECTS] bool, from `in_region`.
        obstacles_may_leave: only the goal ends the episode by leaving the workspace (Sec. IV-A, how the paper counts);
            else every object does (Sec. III-D, how it trains).
    """
    is_goal = jnp.arange(enclosed.shape[0]) == goal
    holds = {
        "nan": outcome.diverged,
        "unreachable": outcome.unreachable,
        "off_table": jnp.any(outcome.off_table & is_goal if obstacles_may_leave else outcome.off_table),
        "target_toppled": jnp.any(outcome.toppled & is_goal),
        "target_in_region": jnp.any(enclosed & is_goal & ~outcome.slipped),
        "obstacle_in_region": jnp.any(enclosed & ~is_goal),
        "no_action": outcome.no_action,
        "grasp_failed": jnp.any(enclosed & is_goal),
    }
    names = [reason for reason in REASONS if reason in holds]
    ends, codes = jnp.stack([holds[name] for name in names]), jnp.array([REASONS.index(name) for name in names])
    return jnp.where(jnp.any(ends), codes[jnp.argmax(ends)], RUNNING).astype(jnp.int32)


def reward_terms(outcome: Outcome, goal: jax.Array, reason: jax.Array) -> dict[str, jax.Array]:
    """Return the raw terms, () float32 each, 0 or 1, at most one of them 1; the configuration has their weights.

    Args:
        outcome: what the push did, unbatched.
        goal: () int32 slot.
        reason: () int32 from `end_reason`.

    Source: Sec. III-D. The approach counts only for a push that does not end the episode.
    """
    # The finite side carries the subtraction, so that a diverged distance_after makes no new NaN.
    approached = outcome.distance_after[goal] < outcome.distance_before[goal] - MIN_APPROACH
    return {
        "target_in_region": (reason == TARGET_IN_REGION).astype(jnp.float32),
        "approach": (approached & (reason == RUNNING)).astype(jnp.float32),
    }


def _jammed(workspace: Workspace, seen: PhysicsObservation) -> jax.Array:
    """Return () bool, whether the hand has pressed objects against walls until they overlap too deeply.

    On an open table objects give way, and such an overlap is an error of the physics. Between walls they cannot, and
    the arm is strong enough.
    """
    if not workspace.walls:
        return jnp.zeros((), bool)
    finite = jnp.all(jnp.isfinite(seen.object_poses)) & jnp.all(jnp.isfinite(seen.joint_pos))
    return seen.diverged & finite


def _distance(state: EnvState) -> jax.Array:
    """Return the planar distance [MAX_OBJECTS] m from each centroid to the grasp point."""
    return jnp.linalg.norm(state.centroids[:, :2] - state.physics_obs.hand_pose[None, :2], axis=-1)
