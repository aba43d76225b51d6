"""The task by Gymnasium's conventions, for learners that live elsewhere (extra `gymnasium`).

Importing this module registers `pregrasp_jax/PreGrasp-v0`:

    import gymnasium
    import pregrasp_jax.gymnasium
    envs = gymnasium.make_vec("pregrasp_jax/PreGrasp-v0", num_envs=16)

Both kinds are the same computation as `task.env.Env`: episode n (from 0) of scene i after `reset(seed=s)` begins with
`env.reset(jax.random.fold_in(jax.random.key(s + i), n))`.
"""

import importlib.util
from collections.abc import Sequence
from typing import Any

if importlib.util.find_spec("gymnasium") is None:
    raise ImportError('pregrasp_jax.gymnasium needs gymnasium; install it with `pip install "pregrasp_jax[gymnasium]"`')

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space

from pregrasp_jax.config import Config
from pregrasp_jax.scene.bank import Split
from pregrasp_jax.spaces import grid
from pregrasp_jax.task.assembly import make_env
from pregrasp_jax.task.env import Env
from pregrasp_jax.task.primitive import Plan
from pregrasp_jax.task.stages import make_stages
from pregrasp_jax.types import MAX_OBJECTS, ROBOT_ID, EnvState, StepResult

ENV_ID = "pregrasp_jax/PreGrasp-v0"

_INTEGER = (int, np.integer)


def _drawn_seed() -> int:
    return int(np.random.SeedSequence().generate_state(1)[0] >> 1)


def observation_space() -> spaces.Dict:
    """Return what one scene shows.

    `height` and `instance_ids` are as in `types.Observation`, `target` is the slot of the target (its instance id less
    1), `hand` is where the hand has been sent: x, y, z in m, yaw and aperture in rad.
    """
    shape = (grid.GRID_SIZE, grid.GRID_SIZE)
    return spaces.Dict(
        {
            "height": spaces.Box(0, 255, shape, np.uint8),
            "instance_ids": spaces.Box(0, ROBOT_ID, shape, np.uint8),
            "target": spaces.Discrete(MAX_OBJECTS),
            "hand": spaces.Box(-np.inf, np.inf, (5,), np.float32),
        }
    )


def observe(state: EnvState) -> dict[str, jax.Array]:
    """Return a member of `observation_space` for one scene."""
    hand = state.hand
    return {
        "height": state.obs.height,
        "instance_ids": state.obs.instance_ids,
        "target": state.scene.target,
        "hand": jnp.append(hand.xy, jnp.stack([hand.z, hand.yaw, hand.aperture])),
    }


class PreGraspVectorEnv(VectorEnv):
    """Scenes side by side.

    A scene that has ended starts anew with the next step, whose action and reward are not its own
    (`AutoresetMode.NEXT_STEP`). Infos have `action_mask` [E, A] int8, the flat actions that are allowed, and `reason`
    [E] int32, why the episode has ended (an index into `types.REASONS`).
    """

    metadata = {"autoreset_mode": AutoresetMode.NEXT_STEP, "render_modes": []}  # noqa: RUF012  (Gymnasium's)

    def __init__(
        self, num_envs: int = 1, *, config: Config | None = None, split: Split = "train", env: Env | None = None
    ):
        """Load or pack the scenes, and compile.

        Args:
            num_envs: scenes side by side.
            config: objects, scenes, task and physics; the rest of it is not used. The defaults if None.
            split: which scenes.
            env: instead of the two before, an environment at hand; not through `gymnasium.make`, which copies what it
                is given.

        Raises:
            ValueError: the objects or settings cannot be used; one line says why.
        """
        if num_envs < 1:
            raise ValueError(f"num_envs = {num_envs} is out of range; allowed is 1 and more")
        self.num_envs = num_envs
        self.jax_env = env or make_env((config or Config()).validate(), split=split)
        self.single_observation_space = observation_space()
        self._num_actions = int(np.prod(self.jax_env.primitive.actions.shape))
        self.single_action_space = spaces.Discrete(self._num_actions)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._keys = jax.random.split(jax.random.key(0), num_envs)
        self._episodes = np.zeros(num_envs, np.int32)
        self._state: EnvState | None = None
        self._ended = np.zeros(num_envs, bool)
        self._begin = jax.jit(jax.vmap(self._begin_one))
        self._show = jax.jit(jax.vmap(self._show_one))
        stages = make_stages(self.jax_env.engine, jax.vmap(self._plan_one), jax.vmap(self._conclude_one))
        state = jax.eval_shape(self._begin, self._keys, self._episodes)
        actions = jax.ShapeDtypeStruct((num_envs,), jnp.int32)
        self._push = stages.compile(state, actions, self._ended, self._keys, self._episodes)

    def reset(self, *, seed: int | Sequence[int | None] | None = None, options: dict[str, Any] | None = None) -> Any:
        """Start an episode in every scene.

        Args:
            seed: scene i gets `seed + i`, or the i-th of a list, in which one is drawn for None. None alone goes on
                with the next episodes of the last seed; the first time it draws one.
            options: none exist.
        """
        if options:
            raise ValueError(f"options {', '.join(options)} of reset do not exist; allowed are none")
        if seed is None and self._state is None:
            seed = _drawn_seed()
        if seed is not None:
            seeds = [seed + i for i in range(self.num_envs)] if isinstance(seed, _INTEGER) else list(seed)
            seeds = [_drawn_seed() if number is None else number for number in seeds]
            numbers = [int(number) for number in seeds if isinstance(number, _INTEGER)]
            known = all(0 <= number < 2**32 for number in numbers)
            if not (known and len(numbers) == len(seeds) == self.num_envs):
                raise ValueError(f"seed = {seed}; allowed is an int from 0 to 2**32 - 1, or a list of {self.num_envs}")
            if isinstance(seed, _INTEGER):
                super().reset(seed=int(seed))
            self._keys = jnp.stack([jax.random.key(number) for number in numbers])
            self._episodes = np.zeros(self.num_envs, np.int32)
        else:
            self._episodes = self._episodes + 1
        self._state = self._begin(self._keys, self._episodes)
        self._ended = np.zeros(self.num_envs, bool)
        obs, mask = jax.device_get(self._show(self._state))
        return _of_spaces(obs), self._infos(action_mask=mask, reason=np.zeros(self.num_envs, np.int32))

    def step(self, actions: Any) -> Any:
        """Push in every scene; scenes that have ended start anew instead."""
        if self._state is None:
            raise gymnasium.error.ResetNeeded("no episode is running; call reset before step")
        actions = np.asarray(actions)
        whole = np.issubdtype(actions.dtype, np.integer) and actions.shape == (self.num_envs,)
        if not whole or actions.min() < 0 or actions.max() >= self._num_actions:
            raise ValueError(f"actions {actions}; allowed are {self.num_envs} of 0 to {self._num_actions - 1}")
        self._episodes = self._episodes + self._ended
        self._state, shown, result = self._push(
            self._state, actions.astype(np.int32), self._ended, self._keys, self._episodes
        )
        (obs, mask), result = jax.device_get((shown, result))
        reward, terminated, truncated, reason = result
        self._ended = terminated | truncated
        return _of_spaces(obs), reward, terminated, truncated, self._infos(action_mask=mask, reason=reason)

    def _infos(self, **values: np.ndarray) -> dict[str, np.ndarray]:
        """Return infos that every scene has."""
        return values | {f"_{name}": np.ones(self.num_envs, bool) for name in values}

    def _begin_one(self, key: jax.Array, episode: jax.Array) -> EnvState:
        return self.jax_env.reset(jax.random.fold_in(key, episode))

    def _show_one(self, state: EnvState) -> tuple[dict[str, jax.Array], jax.Array]:
        return observe(state), self.jax_env.action_mask(state.hand).ravel().astype(jnp.int8)

    def _plan_one(
        self, state: EnvState, action: jax.Array, ended: jax.Array, key: jax.Array, episode: jax.Array
    ) -> tuple[Any, Plan, Any]:
        plan = self.jax_env.plan(state, action).unless(ended, "no_ik")
        return state.physics, plan, (state, ended, key, episode)

    def _conclude_one(self, kept: Any, plan: Plan, physics: Any) -> tuple[EnvState, Any, Any]:
        state, ended, key, episode = kept
        pushed, result = self.jax_env.conclude(state, plan, physics)
        outcome = _of_push(result)
        fresh = self._begin_one(key, episode), jax.tree.map(jnp.zeros_like, outcome)
        state, outcome = jax.tree.map(lambda new, old: jnp.where(ended, new, old), fresh, (pushed, outcome))
        return state, self._show_one(state), outcome


class PreGraspEnv(gymnasium.Env):
    """One scene; spaces and infos are those of `PreGraspVectorEnv` for one."""

    metadata = {"render_modes": []}  # noqa: RUF012  (Gymnasium's)

    def __init__(self, *, config: Config | None = None, split: Split = "train", env: Env | None = None):
        """Load or pack the scenes, and compile; see `PreGraspVectorEnv`."""
        self._envs = PreGraspVectorEnv(1, config=config, split=split, env=env)
        self._running = False
        self.observation_space = self._envs.single_observation_space
        self.action_space = self._envs.single_action_space

    @property
    def jax_env(self) -> Env:
        """The environment behind this one."""
        return self._envs.jax_env

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        """Start an episode; without a seed the next one of the last seed."""
        super().reset(seed=seed)
        self._running = True
        obs, infos = self._envs.reset(seed=seed, options=options)
        return _first(obs), _info(infos)

    def step(self, action: Any) -> Any:
        """Push; an episode that has ended must be reset first."""
        if not self._running:
            raise gymnasium.error.ResetNeeded("no episode is running; call reset before step")
        obs, reward, terminated, truncated, infos = self._envs.step(np.asarray(action)[None])
        self._running = not (terminated[0] or truncated[0])
        return _first(obs), float(reward[0]), bool(terminated[0]), bool(truncated[0]), _info(infos)


def _of_push(result: StepResult) -> tuple[jax.Array, ...]:
    return result.reward, result.terminated, result.truncated, result.reason


def _of_spaces(obs: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Return observations in the types of the spaces: Gymnasium's discrete ones are int64, which JAX has not."""
    return obs | {"target": obs["target"].astype(np.int64)}


def _first(obs: dict[str, Any]) -> dict[str, Any]:
    """Return the observation of the only scene."""
    return {name: values[0] for name, values in obs.items()}


def _info(infos: dict[str, np.ndarray]) -> dict[str, Any]:
    return {"action_mask": infos["action_mask"][0], "reason": int(infos["reason"][0])}


gymnasium.register(
    ENV_ID,
    entry_point=f"{__name__}:{PreGraspEnv.__name__}",
    vector_entry_point=f"{__name__}:{PreGraspVectorEnv.__name__}",
)
