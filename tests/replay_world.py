"""A world of recorded pushes for the tests of the replay, and a memory that is filled with it."""

import functools
import math

import jax
import jax.numpy as jnp
import numpy as np
from fake_env import ACTIONS, fake_rules, hand_at, make_outcome

from pregrasp_jax.config import TaskConfig
from pregrasp_jax.learning import hindsight, replay
from pregrasp_jax.types import MAX_OBJECTS, REASONS, Observation

NUM_ENVS, MAX_PUSHES = 3, 4
RULES = fake_rules(TaskConfig())


def image(ids) -> Observation:
    """Observations whose two pixels spell a number below 2^16 in each leaf, and so does the place of the hand."""
    ids = np.asarray(ids)
    pixels = jnp.asarray(np.stack([ids % 256, ids // 256], axis=-1)[..., None, :].astype(np.uint8))
    hands = jax.vmap(hand_at)(jnp.asarray(np.stack([ids, -ids], axis=-1)))
    return Observation(height=pixels, instance_ids=3 * pixels, hand=hands)


def read_image(obs: Observation) -> np.ndarray:
    height = np.asarray(obs.height, np.int64)
    np.testing.assert_array_equal(3 * height % 256, obs.instance_ids)
    return height[..., 0, 0] + 256 * height[..., 0, 1]


class World:
    """Scenes that count: the observation of scene e is a running number, every other field is derived from it."""

    def __init__(self, seed: int, enclose: float = 0.3):
        self.rng = np.random.default_rng(seed)
        self.enclose = enclose
        self.next_id = 1
        self.current = [self.new_id() for _ in range(NUM_ENVS)]
        self.pushes = [0] * NUM_ENVS
        self.history: list[list[dict]] = [[] for _ in range(NUM_ENVS)]
        self.transitions: list[dict] = []

    def new_id(self) -> int:
        self.next_id += 1
        return self.next_id - 1

    def step(self) -> replay.Steps:
        rows = [self.push(env) for env in range(NUM_ENVS)]
        self.transitions += rows

        def stack(name, dtype):
            return jnp.asarray(np.array([row[name] for row in rows], dtype))

        outcome = make_outcome(
            coverage=stack("coverage", np.float32),
            distance_before=stack("obs", np.float32)[:, None] + jnp.arange(8.0)[None],
            distance_after=stack("next_obs", np.float32)[:, None] + jnp.arange(8.0)[None],
            aperture=jnp.ones(NUM_ENVS),
            toppled=jnp.zeros((NUM_ENVS, MAX_OBJECTS), bool),
            off_table=jnp.zeros((NUM_ENVS, MAX_OBJECTS), bool),
            obstruction=jnp.zeros(NUM_ENVS, jnp.int32),
            no_action=jnp.zeros(NUM_ENVS, bool),
            diverged=stack("diverged", bool),
            slipped=jnp.zeros((NUM_ENVS, MAX_OBJECTS), bool),
        )
        return replay.Steps(
            root=jnp.arange(NUM_ENVS),
            obs=image([row["obs"] for row in rows]),
            action=stack("action", np.int32),
            goal=stack("goal", np.int32),
            outcome=outcome,
            reward=stack("reward", np.float32),
            terminated=stack("terminated", bool),
            reason=stack("reason", np.int32),
            truncated=stack("truncated", bool),
            next_obs=image([row["next_obs"] for row in rows]),
        )

    def push(self, env: int) -> dict:
        obs, next_obs = self.current[env], self.new_id()
        coverage = np.zeros(MAX_OBJECTS)
        goal = obs % 3
        enclosed = self.rng.random() < self.enclose
        if enclosed:
            coverage[3 + obs % 4] = 0.99
        self.pushes[env] += 1
        truncated = not enclosed and self.pushes[env] == MAX_PUSHES
        row = {
            "obs": obs,
            "next_obs": next_obs,
            "goal": goal,
            "action": obs % math.prod(ACTIONS.shape),
            "reward": float(obs) / 2,
            "terminated": enclosed,
            "reason": obs % len(REASONS),
            "truncated": truncated,
            "coverage": coverage,
            "diverged": False,
        }
        ended = enclosed or truncated
        self.current[env] = self.new_id() if ended else next_obs
        if ended:
            self.pushes[env] = 0
        return row


def goal_input(obs: Observation, goal: jax.Array) -> jax.Array:
    """The fused input of these tiny images: their pixels and the goal."""
    pixels = obs.height[0].astype(jnp.float32)
    return jnp.stack([pixels, jnp.full_like(pixels, goal)], axis=-1)[None]


def decode_input(inputs: jax.Array) -> tuple[np.ndarray, np.ndarray]:
    values = np.asarray(inputs, np.int64)
    return values[:, 0, 0, 0] + 256 * values[:, 0, 1, 0], values[:, 0, 0, 1]


add = jax.jit(replay.add, donate_argnums=0)
add_hindsight = jax.jit(functools.partial(hindsight.add_hindsight, rules=RULES), donate_argnums=0)
sample = jax.jit(
    functools.partial(replay.sample, batch_size=64, input_fn=goal_input), static_argnames="importance_exponent"
)
set_priorities = jax.jit(functools.partial(replay.set_priorities, priority_exponent=0.6))
ALL_ELIGIBLE = jnp.ones((NUM_ENVS, MAX_OBJECTS), bool)


def fill(world: World, memory: replay.Replay, steps: int, relabel: bool = True) -> replay.Replay:
    for _ in range(steps):
        memory = add(memory, world.step())
        if relabel:
            memory = add_hindsight(memory, ALL_ELIGIBLE)
    return memory


def empty(capacity: int = 37) -> replay.Replay:
    init = functools.partial(replay.init, capacity=capacity, max_pushes=MAX_PUSHES)
    return jax.jit(init)(World(0).step())


def alive_rows(memory: replay.Replay) -> list[tuple]:
    """(obs id, next obs id, goal, action, reward, terminated, hindsight) of every row that can be sampled."""
    alive = np.flatnonzero(np.asarray(memory.priorities.leaves) > 0)
    observations = read_image(memory.observations)
    rows = jax.tree.map(np.asarray, memory.rows)
    return [
        (
            int(observations[rows.obs_slot[i]]),
            int(observations[rows.next_obs_slot[i]]),
            int(rows.goal[i]),
            int(rows.action[i]),
            float(rows.reward[i]),
            bool(rows.terminated[i]),
            bool(rows.hindsight[i]),
        )
        for i in alive
    ]
