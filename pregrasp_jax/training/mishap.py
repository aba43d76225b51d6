"""A push that the physics did not survive, kept on the device until somebody writes it down.

The state before the push is what `step` starts from, so the push can be repeated. One row is copied out of the batch in
every step of the actors, some kilobytes, and nothing passes through the host.
"""

from typing import Any

import flax.struct as struct
import jax
import jax.numpy as jnp

from pregrasp_jax.types import EnvState, HandPose, PhysicsObservation

NONE = -1
"""The action of a mishap that did not happen."""


class Mishap(struct.PyTreeNode):
    """One push, unbatched.

    Attributes:
        state: before it, without what the camera saw (20 kB that follow from the rest).
        hand: where the hand had been sent before it.
        action: () int32 flat index of the push, `NONE` if nothing has happened.
        seen: what the engine reported afterwards.
        scene: () int32 which of the E scenes.
        branch: () int32 which push from that state: 0 the real one, others simulated only to learn from.
        env_steps: () int32 pushes so far, those beside it included.
    """

    state: EnvState
    hand: HandPose
    action: jax.Array
    seen: PhysicsObservation
    scene: jax.Array
    branch: jax.Array
    env_steps: jax.Array

    def note(
        self, states: EnvState, actions: jax.Array, ends: EnvState, diverged: jax.Array, env_steps: jax.Array
    ) -> "Mishap":
        """Return the first push that diverged, unless an earlier one is kept already.

        Args:
            states: of E scenes, before the pushes.
            actions: [E B] int32, scenes first, then their branches.
            ends: [E B] states after the pushes.
            diverged: [E B] bool.
            env_steps: () int32 pushes so far, these included.
        """
        num_envs = states.num_pushes.shape[0]
        first = jnp.argmax(diverged)
        scene, branch = first % num_envs, first // num_envs
        new = Mishap(
            state=_row(states.replace(obs=None), scene),
            hand=_row(states.hand, scene),
            action=actions[first],
            seen=_row(ends.physics_obs, first),
            scene=scene.astype(jnp.int32),
            branch=branch.astype(jnp.int32),
            env_steps=env_steps,
        )
        keep = (self.action != NONE) | ~jnp.any(diverged)
        return jax.tree.map(lambda old, new: jnp.where(keep, old, new), self, new)

    def forget(self) -> "Mishap":
        """Return none: the next one that happens is kept."""
        return self.replace(action=jnp.full_like(self.action, NONE))


def no_mishap(states: EnvState) -> Mishap:
    """Return one that did not happen, in the shapes of E `states`."""
    rows = _row((states.replace(obs=None), states.hand, states.physics_obs), 0)
    state, hand, seen = jax.tree.map(jnp.zeros_like, rows)
    action, scene, branch, env_steps = jnp.full(4, NONE)
    return Mishap(state, hand, action, seen, scene, branch, env_steps)


def _row(tree: Any, index: jax.Array | int) -> Any:
    return jax.tree.map(lambda leaf: leaf[index], tree)
