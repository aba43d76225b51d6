"""A world without physics, in which every episode can be worked out by hand.

The hand jumps to the cell it is told. An object is in the closing region if the open hand ends within 12 mm
of it. Cells of the five lowest rows are out of reach: such a push is refused. Even scenes hold the grasp.
"""

from dataclasses import dataclass, field
from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from pregrasp_jax.config import TaskConfig
from pregrasp_jax.spaces import grid
from pregrasp_jax.task.rules import judge
from pregrasp_jax.types import (
    MAX_OBJECTS,
    OPEN,
    REASONS,
    EnvState,
    GraspResult,
    Observation,
    Outcome,
    PhysicsObservation,
    SceneParams,
    StepResult,
)

START = (-0.30, 0.0)
IN_REGION = 0.012
UNREACHABLE_ROWS = 5


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


@dataclass(frozen=True)
class FakeEnv:
    """Same interface as `pregrasp_jax.env.Env`."""

    scenes: FakeScenes = field(default_factory=lambda: make_scenes(12))
    task: TaskConfig = field(default_factory=TaskConfig)
    bank: Any = field(default_factory=lambda: SimpleNamespace(names=("mug", "can", "box"), content_hash="hulls"))

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
            obs=Observation(blank, blank, jnp.zeros(2)),
            centroids=jnp.asarray(self.scenes.xy)[index],
            p1=jnp.array(START),
            aperture=jnp.int32(OPEN),
            num_pushes=jnp.int32(0),
        )

    def action_mask(self, p1: jax.Array) -> jax.Array:
        centers = grid.cell_centers()
        dx, dy = centers[None, :] - p1[0], centers[:, None] - p1[1]
        distance = jnp.hypot(dx, dy)
        return (distance >= self.task.r_in - 1e-6) & (distance <= self.task.r_out + 1e-6) & (dx >= -1e-6)

    def step(
        self, state: EnvState, action: jax.Array, *, execute: jax.Array | bool = True
    ) -> tuple[EnvState, StepResult]:
        row, col, aperture = grid.decode_action(action)
        reachable = (row >= UNREACHABLE_ROWS) & execute
        p1 = jnp.where(reachable, grid.cell_to_world(row, col), state.p1)
        distance = jnp.linalg.norm(state.centroids - p1[None], axis=-1)
        present = state.scene.object_ids >= 0
        outcome = Outcome(
            coverage=jnp.where(present & (distance < IN_REGION) & (aperture == OPEN), 1.0, 0.0),
            distance_before=jnp.linalg.norm(state.centroids - state.p1[None], axis=-1),
            distance_after=distance,
            toppled=jnp.zeros(MAX_OBJECTS, bool),
            off_table=jnp.zeros(MAX_OBJECTS, bool),
            unreachable=~reachable,
            no_action=~jnp.any(self.action_mask(p1)),
            diverged=jnp.zeros((), bool),
        )
        num_pushes = state.num_pushes + reachable
        reward, terminated, reason = judge(outcome, state.scene.target)
        truncated = ~terminated & (num_pushes >= self.task.max_pushes)
        reason = jnp.where(truncated, REASONS.index("truncated"), reason)
        aperture = jnp.where(reachable, aperture, state.aperture)
        next_state = state.replace(p1=p1, aperture=aperture, num_pushes=num_pushes)
        return next_state, StepResult(outcome, reward, terminated, truncated, reason)

    def grasp(self, state: EnvState, *, execute: jax.Array | bool = True) -> GraspResult:
        return GraspResult((state.scene_index % 2 == 0) & execute, jnp.bool_(False), jnp.int32(0))


def fake_env(**fields: Any) -> Any:
    """Return a `FakeEnv`, typed as whatever the caller needs."""
    return FakeEnv(**fields)
