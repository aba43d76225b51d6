"""A planner on many scenes: it decides on the host, one scene after another, and remembers every episode."""

import jax
import numpy as np

from pregrasp_jax.planning.memory import NOTHING, Memory, Sight
from pregrasp_jax.planning.planner import Planner
from pregrasp_jax.types import EnvState


class Deliberation:
    """The decisions of a planner in one evaluation, with the memory of every episode under way."""

    def __init__(self, planner: Planner, key: jax.Array):
        """Remember nothing.

        Args:
            planner: who decides.
            key: keys of decisions derive from it, from the scene and from the number of the push.
        """
        self._planner, self._key = planner, key
        self._memories: dict[int, Memory] = {}

    def __call__(self, states: EnvState, running: np.ndarray) -> np.ndarray:
        """Return the pushes [E] int32 of a batch of states; 0 where nothing is `running` [E]."""
        seen = jax.device_get((states.scene_index, states.num_pushes, states.obs, states.physics_obs.joint_pos))
        targets = np.asarray(states.scene.target)
        actions, decided = np.zeros(len(running), np.int32), {}
        for i in np.flatnonzero(running):
            scene, pushes, obs, joint_pos = jax.tree.map(lambda leaf, i=i: leaf[i], seen)
            if scene not in decided:  # films show a scene beside its copy
                decided[scene] = self._decide(int(scene), Sight(obs, joint_pos, int(targets[i]), int(pushes)))
            actions[i] = decided[scene]
        return actions

    def _decide(self, scene: int, sight: Sight) -> int:
        key = jax.random.fold_in(jax.random.fold_in(self._key, scene), sight.pushes)
        memory = NOTHING if sight.pushes == 0 else self._memories.get(scene, NOTHING)
        planned = self._planner.decide(sight, memory, key)
        self._memories[scene] = planned.memory
        return planned.action
