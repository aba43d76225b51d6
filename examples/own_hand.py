"""A hand of your own: a floating paddle with eight headings, its pushes, and a script that steers it.

Prints how often the script brings the target between the paddle's lips, with a 95 % interval:

python examples/own_hand.py
"""

import pregrasp_jax  # noqa: F401  (before jax, which reads then how many threads it may have)

# isort: split
import jax
import jax.numpy as jnp
import numpy as np
import tyro

from pregrasp_jax.config import Config, SceneConfig, TaskConfig
from pregrasp_jax.evaluation import EvaluationResult, evaluate_policy
from pregrasp_jax.evaluation.statistics import wilson_interval
from pregrasp_jax.policies.scripts import Policy, nearest_action
from pregrasp_jax.robot import ROBOTS
from pregrasp_jax.robot.base import ClosingRegion, Eligibility, Robot, hand_pose_of
from pregrasp_jax.robot.closing_region import eligibility
from pregrasp_jax.robot.floating import make_floating_hand
from pregrasp_jax.spaces import grid
from pregrasp_jax.spaces.actions import ActionSpace, Choice
from pregrasp_jax.spaces.workspace import Workspace
from pregrasp_jax.task.assembly import make_env
from pregrasp_jax.task.env import Env
from pregrasp_jax.task.primitive import Primitive
from pregrasp_jax.task.push import straight_pushes
from pregrasp_jax.task.registry import KINDS, Kind
from pregrasp_jax.task.rules import make_rules
from pregrasp_jax.types import EnvState, HandPose, HullBank

PADDLE = """
<mujoco>
  <worldbody>
    <body name="paddle">  <!-- its origin is the grasp point, 45 mm ahead of the plate; x forward, z up -->
      <geom name="plate" type="box" pos="-0.05 0 0" size="0.005 0.056 0.05" mass="0.4"/>
      <geom name="left_lip" type="box" pos="-0.035 0.056 0" size="0.02 0.003 0.05" mass="0.05"/>
      <geom name="right_lip" type="box" pos="-0.035 -0.056 0" size="0.02 0.003 0.05" mass="0.05"/>
    </body>
  </worldbody>
</mujoco>
"""

Z = 0.055
"""m, height of the grasp point: the plate ends 5 mm above the table."""

DEPTH, WIDTH = 0.10, 0.106
"""m, the paddle's region: from the plate forward, and between the lips."""

HEADINGS = 8

EDGE, CLEARANCE = 0.2475, 0.10
"""m, the outermost cells, where ways to the target begin; distance to the middle of an obstacle that is enough."""


def region(aperture: jax.Array) -> ClosingRegion:
    """Return what lies between the lips; a paddle is always open."""
    del aperture
    return ClosingRegion(np.array([-0.045, DEPTH - 0.045]), np.full(2, WIDTH / 2), True)


def fits(bank: HullBank) -> Eligibility:
    """Return which objects fit between the lips."""
    return eligibility(bank, region(jnp.float32(0)), max_width=WIDTH - 0.005)


def make_paddle() -> Robot:
    """Return the hand."""
    start = hand_pose_of((-0.30, 0.0), z=Z, yaw=0.0, aperture=0.0)
    return make_floating_hand("paddle", PADDLE, start=start, closing_region=region, eligibility=fits)


def make_paddle_pushes(robot: Robot, workspace: Workspace, task: TaskConfig, *, max_distance: float) -> Primitive:
    """Return pushes that end with one of eight headings, to the ring (or the half ring ahead) of each."""
    yaws = [2 * np.pi * k / HEADINGS for k in range(HEADINGS)]
    choices = tuple(Choice(name=f"{np.degrees(yaw):.0f} degrees", z=Z, yaw=yaw, aperture=0.0) for yaw in yaws)
    # In the mirror image of a scene, left is right: heading k becomes -k.
    actions = ActionSpace(choices, mirrored=tuple(-k % HEADINGS for k in range(HEADINGS)))

    def mask(hand: HandPose) -> jax.Array:
        options = {"r_in": task.r_in, "r_out": task.r_out, "full": task.full_ring}
        return jnp.stack([grid.half_ring(hand.xy, yaw=yaw, **options) for yaw in yaws], axis=-1)

    return straight_pushes("paddle", actions, mask, robot, workspace, task, max_distance=max_distance)


ROBOTS["paddle"] = make_paddle
KINDS["paddle"] = Kind(make_paddle_pushes, make_rules)  # judged by the paper's rules, with the paddle's region


def make_steer(env: Env) -> Policy:
    """Return the script: go to where a straight way to the target is free of obstacles, and in from there."""
    actions = env.primitive.actions
    yaws = jnp.array([choice.yaw for choice in actions.choices])
    ahead = jnp.stack([jnp.cos(yaws), jnp.sin(yaws)], axis=1)

    def entry(point: jax.Array, forward: jax.Array) -> jax.Array:
        """Return where a line [2] with this direction to a point of the table enters the table."""
        lengths = (EDGE + jnp.sign(forward) * point) / jnp.maximum(jnp.abs(forward), 1e-3)
        return point - jnp.min(lengths) * forward

    def act(state: EnvState, key: jax.Array) -> jax.Array:
        del key
        hand, target = state.hand.xy, state.target_xy
        others = (state.scene.object_ids >= 0) & (jnp.arange(len(state.centroids)) != state.scene.target)
        obstacles = jnp.where(others[:, None], state.centroids[:, :2], 9.0)

        def cost(start: jax.Array) -> jax.Array:
            """Return how much is in the way from here to the target, and how far it is to get here, m."""
            way_in = jnp.sum(jnp.maximum(CLEARANCE - _distance(obstacles, start, target), 0.0))
            way_there = jnp.maximum(CLEARANCE - jnp.min(_distance(obstacles, hand, start)), 0.0)
            return way_in + 0.5 * way_there + 0.02 * jnp.linalg.norm(start - hand)

        entries = jax.vmap(entry, (None, 0))(target, ahead)
        best = jnp.argmin(jax.vmap(cost)(entries))
        here = jnp.argmax(jnp.cos(yaws - state.hand.yaw))
        to_target = target - hand
        sideways = jnp.abs(ahead[best] @ jnp.stack([-to_target[1], to_target[0]]))
        aligned = (here == best) & (sideways < 0.02) & (to_target @ ahead[best] > -0.03)
        inside = jnp.max(jnp.abs(hand)) < EDGE - 0.01
        retreat = entry(hand, ahead[here])
        goal = jnp.where(aligned, target, jnp.where(inside, retreat, entries[best]))
        choice = jnp.where(inside & ~aligned, here, best)
        return nearest_action(env.action_mask(state.hand), goal, choice, actions)

    return act


def _distance(points: jax.Array, start: jax.Array, end: jax.Array) -> jax.Array:
    """Return the distances [N] m from points [N, 2] to the segment from `start` to `end`."""
    along = end - start
    share = jnp.clip((points - start[None]) @ along / jnp.maximum(along @ along, 1e-6), 0.0, 1.0)
    return jnp.linalg.norm(points - start[None] - share[:, None] * along[None], axis=-1)


def make_config(scenes: int) -> Config:
    """Return the configuration: the paddle, its pushes, and rings as wide as the table."""
    task = TaskConfig(robot="paddle", primitive="paddle", full_ring=True, r_in=0.01, r_out=0.5, push_speed=0.2)
    return Config(task=task, scene=SceneConfig(test_scenes=scenes)).validate()


def main(*, scenes: int = 50, num_envs: int = 16) -> EvaluationResult:
    """Evaluate the script on packed scenes; success is the target in the region, without a grasp."""
    env = make_env(make_config(scenes), split="test")
    result = evaluate_policy(env, make_steer(env), episodes=scenes, num_envs=num_envs, with_grasp=False)
    low, high = wilson_interval(result.successes, scenes)
    print(f"paddle: {result.successes} of {scenes} targets in its region, {low:.0%} to {high:.0%}")
    print(f"failures: {result.failures or 'none'}")
    return result


if __name__ == "__main__":
    tyro.cli(main)
