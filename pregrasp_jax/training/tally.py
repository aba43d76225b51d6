"""What happened in training, counted on the device and printed now and then."""

from collections.abc import Sequence
from typing import Any

import flax.struct as struct
import jax
import jax.numpy as jnp
import numpy as np

from pregrasp_jax.types import OBSTRUCTIONS, PUSH_REASONS, StepResult

RECENT_EPISODES = 200
"""Episodes behind `train/success_rate`, or one per scene where there are more scenes."""


class Tally(struct.PyTreeNode):
    """What happened, counted on the device, so that the loop need not wait for numbers it only prints.

    Attributes:
        env_steps: () int32 pushes ever.
        episodes: () int32 ended ever.
        recent: [W] int8 reasons of the last W episodes, a ring; -1 where there was none yet.
        pushes: () int32 since the last report.
        reward: () float32 summed over them.
        explored: () int32 of them were random.
        overflowed: () int32 pushes since the last report, branches included, in which the engine dropped contacts.
        diverged: () int32 pushes since the last report, branches included, after which the physics made no sense.
        reasons: [len(PUSH_REASONS)] int32 why episodes ended since the last report.
        obstructions: [len(OBSTRUCTIONS)] int32 what made the last push of those unreachable that ended so.
    """

    env_steps: jax.Array
    episodes: jax.Array
    recent: jax.Array
    pushes: jax.Array
    reward: jax.Array
    explored: jax.Array
    overflowed: jax.Array
    diverged: jax.Array
    reasons: jax.Array
    obstructions: jax.Array

    def begin_report(self) -> "Tally":
        """Return the tally with the counts since the last report at 0."""
        return self.replace(
            pushes=jnp.zeros_like(self.pushes),
            reward=jnp.zeros_like(self.reward),
            explored=jnp.zeros_like(self.explored),
            overflowed=jnp.zeros_like(self.overflowed),
            diverged=jnp.zeros_like(self.diverged),
            reasons=jnp.zeros_like(self.reasons),
            obstructions=jnp.zeros_like(self.obstructions),
        )

    def count(
        self,
        results: StepResult,
        ended: jax.Array,
        random: jax.Array,
        overflowed: jax.Array,
        diverged: jax.Array,
    ) -> "Tally":
        """Return the tally after one more push of E scenes.

        Args:
            results: [E] of the scenes; branches are not counted among them.
            ended: [E] bool, whether the episode did.
            random: [E] bool, whether the action was.
            overflowed: [E (1 + branches)] bool.
            diverged: [E (1 + branches)] bool.
        """
        window = self.recent.shape[0]
        order = jnp.cumsum(ended, dtype=jnp.int32) - 1
        unreachable = ended & (results.reason == PUSH_REASONS.index("unreachable"))
        slots = jnp.where(ended, (self.episodes + order) % window, window)
        return Tally(
            env_steps=self.env_steps + ended.shape[0],
            episodes=self.episodes + jnp.sum(ended, dtype=jnp.int32),
            recent=self.recent.at[slots].set(results.reason.astype(jnp.int8), mode="drop"),
            pushes=self.pushes + ended.shape[0],
            reward=self.reward + jnp.sum(results.reward),
            explored=self.explored + jnp.sum(random, dtype=jnp.int32),
            overflowed=self.overflowed + jnp.sum(overflowed, dtype=jnp.int32),
            diverged=self.diverged + jnp.sum(diverged, dtype=jnp.int32),
            reasons=self.reasons.at[results.reason].add(ended.astype(jnp.int32)),
            obstructions=self.obstructions.at[results.outcome.obstruction].add(unreachable.astype(jnp.int32)),
        )

    def metrics(self, successes: Sequence[int]) -> dict[str, Any]:
        """Return the row of metrics () of the tally, on the host; shares without a case are None.

        Args:
            successes: reasons that count as success.
        """
        counts = jax.device_get(self)
        recent = counts.recent[counts.recent >= 0]
        episodes = int(counts.reasons.sum())
        return {
            "env_steps": int(counts.env_steps),
            "episodes": int(counts.episodes),
            "train/success_rate": float(np.isin(recent, successes).mean()) if len(recent) else None,
            "train/reward": float(counts.reward / counts.pushes) if counts.pushes else None,
            "train/episode_length": float(counts.pushes / episodes) if episodes else None,
            "train/explored": float(counts.explored / counts.pushes) if counts.pushes else None,
            "physics/overflows": int(counts.overflowed),
            "physics/diverged": int(counts.diverged),
            **{f"reasons/{k}": int(n) for k, n in zip(PUSH_REASONS, counts.reasons, strict=True) if k != "running"},
            **{
                f"unreachable/{k}": int(n)
                for k, n in zip(OBSTRUCTIONS, counts.obstructions, strict=True)
                if k != "none"
            },
        }


def new_tally(num_envs: int, *, recent: int = RECENT_EPISODES) -> Tally:
    """Return the tally of a run of `num_envs` scenes that begins, which remembers at least `recent` episodes."""
    return Tally(
        env_steps=jnp.int32(0),
        episodes=jnp.int32(0),
        recent=jnp.full(max(recent, num_envs), -1, jnp.int8),
        pushes=jnp.int32(0),
        reward=jnp.float32(0),
        explored=jnp.int32(0),
        overflowed=jnp.int32(0),
        diverged=jnp.int32(0),
        reasons=jnp.zeros(len(PUSH_REASONS), jnp.int32),
        obstructions=jnp.zeros(len(OBSTRUCTIONS), jnp.int32),
    )
