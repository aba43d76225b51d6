"""Evaluation by the paper's protocol (Sec. IV-A): fixed test scenes, ten pushes, one grasp.

`num_envs` scenes run side by side and a scene that ends hands its place to the next one of the queue, so
every scene runs to its end and with `native` no result depends on `num_envs`: keys derive from scene and push number.
(`mjx` rounds batches of other sizes differently in the last bit, and contacts amplify that.)
"""

from collections.abc import Callable, Hashable, Iterator
from typing import Any, NamedTuple

import flax.struct as struct
import jax
import jax.numpy as jnp
import numpy as np
from jax.tree_util import Partial

from pregrasp_jax.evaluation.deliberation import Deliberation
from pregrasp_jax.evaluation.results import GRASP_FAILED, Episode, EvaluationResult
from pregrasp_jax.planning.planner import Planner
from pregrasp_jax.policies.scripts import Policy
from pregrasp_jax.task.env import Env
from pregrasp_jax.task.primitive import Plan
from pregrasp_jax.task.rules import RUNNING
from pregrasp_jax.task.stages import Stages, make_stages
from pregrasp_jax.types import OBSTRUCTIONS, REASONS, EnvState, GraspResult

EpisodeCallback = Callable[[int, int, int], None]
"""(episodes ended, episodes in all, successes so far) -> None."""

MIN_BATCH = 2
"""Scenes compiled side by side at the least. XLA rounds a batch of one differently in the last bit, contacts amplify
it, and a scene could end otherwise than beside others; from two on results are the same bits (measured up to 16)."""


class _Run(struct.PyTreeNode):
    """One scene under way; the last push that was executed left it as it is.

    Attributes:
        state: where it stands.
        reason: () int32, `RUNNING` until the episode ends.
        obstruction: () int32 index into `OBSTRUCTIONS`, what kept the hand from the end of the last push.
        return_: () float32, rewards so far.
        seconds: () float32 s, time spent on motions so far.
        action: the last one decided, in the normal form of the primitive; meaningless before the first.
    """

    state: EnvState
    reason: jax.Array
    obstruction: jax.Array
    return_: jax.Array
    seconds: jax.Array
    action: Any


class Decision(NamedTuple):
    """A state and what was done in it.

    Attributes:
        state: unbatched, on the host.
        action: the chosen one in its normal form, a flat index or more, on the host; None after the last one.
        reason: why the episode has ended, as in `Episode.reason`; empty while it goes on.
        success: whether it has ended in one.
    """

    state: EnvState
    action: Any
    reason: str = ""
    success: bool = False

    @property
    def ending(self) -> str:
        """Return how the episode has ended, in words."""
        return f"{self.reason}, grasped" if self.success else self.reason


class Evaluator:
    """Runs policies on the scenes of one environment; compiles once per kind of policy."""

    def __init__(self, env: Env, *, num_envs: int = 16):
        """Compile nothing yet.

        Args:
            env: the test (or validation) environment.
            num_envs: scenes side by side; with `native` results do not depend on it.
        """
        self._env = env
        self._num_envs = max(num_envs, MIN_BATCH)
        self._start = jax.jit(jax.vmap(self._start_one))
        self._replace = jax.jit(jax.vmap(_where))
        decide, conclude = jax.vmap(self._decide_one, in_axes=(None, 0, None)), jax.vmap(self._conclude_one)
        self._push = make_stages(env.engine, decide, conclude)
        self._act = make_stages(env.engine, jax.vmap(self._plan_one), conclude)
        self._grasp = make_stages(env.engine, jax.vmap(self._plan_grasp_one), jax.vmap(self._conclude_grasp_one))
        self._compiled: dict[Hashable, Callable[..., Any]] = {}

    def compile(self, policy: Policy | Planner, *, episodes: int) -> None:
        """Compile now what `run` compiles on its way otherwise; it may take minutes.

        Args:
            policy: the one that will run, or one of the same kind.
            episodes: as many as will run.
        """
        num_envs = self._batch_size(episodes)
        runs = self._program(self._start, np.zeros(num_envs, np.int32)).out_info
        enclosed = jax.tree.map(lambda leaf: jax.ShapeDtypeStruct((self._num_envs, *leaf.shape[1:]), leaf.dtype), runs)
        if isinstance(policy, Planner):
            self._program(self._act, runs, np.zeros(num_envs, np.int32))
        else:
            self._program(self._push, _bound(policy), runs, jax.random.key(0))
        self._program(self._replace, np.zeros(num_envs, bool), runs, runs)
        if self._env.rules.asks_for_grasp:
            self._program(self._grasp, enclosed.state, np.ones(self._num_envs, bool))

    def run(
        self,
        policy: Policy | Planner,
        *,
        episodes: int,
        seed: int = 0,
        with_grasp: bool = True,
        progress: EpisodeCallback | None = None,
    ) -> EvaluationResult:
        """Run scenes 0 to `episodes` - 1 to their ends.

        Args:
            policy: see `policies`.
            episodes: at most the number of scenes.
            seed: of the policy's own randomness; scenes, yaws and targets are fixed.
            with_grasp: execute the grasp and count it; otherwise a target in the region is a success.
            progress: told when episodes end.

        Raises:
            ValueError: more episodes than scenes, or none.
        """
        num_scenes = len(self._env.scenes)
        if not 1 <= episodes <= num_scenes:
            raise ValueError(f"episodes = {episodes} is out of range; this scene bank allows 1 to {num_scenes}")
        finished: list[Episode] = []
        enclosed: list[_Run] = []

        def finish(episodes_now: list[Episode]) -> None:
            finished.extend(episodes_now)
            if progress and episodes_now:
                progress(len(finished), episodes, sum(episode.success for episode in finished))

        for run in self._run_to_ends(policy, episodes, jax.random.key(seed)):
            if self._asks_for_grasp(run, with_grasp):
                enclosed.append(run)
            else:
                finish([self._episode(run)])
            if len(enclosed) == self._num_envs:
                finish(self._grasp_all(enclosed))
                enclosed.clear()
        finish(self._grasp_all(enclosed))
        return EvaluationResult(tuple(sorted(finished, key=lambda episode: episode.scene)))

    def play(
        self, policy: Policy | Planner, scene: int, *, seed: int = 0, with_grasp: bool = True
    ) -> Iterator[Decision]:
        """Yield the decisions of one scene, the last of which is the end of the episode: exactly what `run` counts.

        Args:
            policy: see `policies.scripts`.
            scene: row of the scene bank.
            seed: as in `run`.
            with_grasp: as in `run`.
        """
        push = self._pusher(policy, jax.random.key(seed))
        runs = self._call(self._start, np.full(MIN_BATCH, scene, np.int32))
        run = _first(runs)
        while run.reason == RUNNING:
            runs, before = push(runs), run
            run = _first(runs)
            yield Decision(before.state, run.action)
        (episode,) = self._grasp_all([run]) if self._asks_for_grasp(run, with_grasp) else [self._episode(run)]
        yield Decision(run.state, None, episode.reason, episode.success)

    def _asks_for_grasp(self, run: _Run, with_grasp: bool) -> bool:
        return with_grasp and self._env.rules.asks_for_grasp and int(run.reason) in self._env.rules.successes

    def _run_to_ends(self, policy: Policy | Planner, episodes: int, key: jax.Array) -> Iterator[_Run]:
        """Yield every scene when its pushes have ended, as host arrays."""
        push, num_envs = self._pusher(policy, key), self._batch_size(episodes)
        waiting = iter(range(num_envs, episodes))
        busy = np.arange(num_envs) < episodes
        runs = self._call(self._start, np.where(busy, np.arange(num_envs), 0).astype(np.int32))
        while busy.any():
            runs = push(runs)
            ended = np.flatnonzero(busy & (np.asarray(runs.reason) != RUNNING))
            if ended.size == 0:
                continue
            host = jax.device_get(runs)
            yield from (jax.tree.map(lambda leaf, slot=slot: leaf[slot], host) for slot in ended)
            following = np.full(num_envs, -1, np.int32)
            following[ended] = [next(waiting, -1) for _ in ended]
            busy[ended] = following[ended] >= 0
            if busy.any():
                fresh = self._call(self._start, np.maximum(following, 0))
                runs = self._call(self._replace, following >= 0, fresh, runs)

    def _pusher(self, policy: Policy | Planner, key: jax.Array) -> Callable[[_Run], _Run]:
        """Return the function that lets a policy decide once more in every scene of a batch, and pushes."""
        if isinstance(policy, Planner):
            deliberation = Deliberation(policy, key)
            return lambda runs: self._call(
                self._act, runs, deliberation(runs.state, np.asarray(runs.reason) == RUNNING)
            )
        bound = _bound(policy)
        return lambda runs: self._call(self._push, bound, runs, key)

    def _batch_size(self, episodes: int) -> int:
        """Return how many scenes are pushed side by side."""
        return max(min(self._num_envs, episodes), MIN_BATCH)

    def _program(self, function: Any, *args: Any) -> Any:
        """Return a jitted or staged function compiled for arguments like these; it is compiled once."""
        leaves, structure = jax.tree.flatten(args)
        kind = (function, structure, *((leaf.shape, leaf.dtype) for leaf in leaves))
        if kind not in self._compiled:
            staged = isinstance(function, Stages)
            self._compiled[kind] = function.compile(*args) if staged else function.lower(*args).compile()
        return self._compiled[kind]

    def _call(self, function: Any, *args: Any) -> Any:
        return self._program(function, *args)(*args)

    def _grasp_all(self, runs: list[_Run]) -> list[Episode]:
        """Execute the grasp in up to `num_envs` scenes; the batch is filled up with copies of the last, at no cost."""
        if not runs:
            return []
        padded = runs + runs[-1:] * (self._num_envs - len(runs))
        states = jax.tree.map(lambda *leaves: np.stack(leaves), *(run.state for run in padded))
        grasps = jax.device_get(self._call(self._grasp, states, np.arange(self._num_envs) < len(runs)))
        return [self._episode(run, jax.tree.map(lambda leaf, i=i: leaf[i], grasps)) for i, run in enumerate(runs)]

    def _episode(self, run: _Run, grasp: GraspResult | None = None) -> Episode:
        scene, reason, overflows = run.state.scene, REASONS[int(run.reason)], run.state.physics_obs.overflows
        success = int(run.reason) in self._env.rules.successes
        obstruction = run.obstruction if grasp is None else grasp.obstruction
        if grasp is not None:
            success = bool(grasp.held)
            if not success:
                reason = "nan" if grasp.diverged else GRASP_FAILED
            overflows = grasp.overflows
        return Episode(
            scene=int(run.state.scene_index),
            target=self._env.bank.names[int(scene.object_ids[scene.target])],
            reason=reason,
            success=success,
            motions=int(run.state.num_pushes) * self._env.primitive.motions,
            motions_per_attempt=self._env.primitive.motions,
            return_=float(run.return_),
            seconds=float(run.seconds),
            overflows=int(overflows),
            obstruction=OBSTRUCTIONS[int(obstruction)],
        )

    def _start_one(self, index: jax.Array) -> _Run:
        zero, none = jnp.float32(0.0), jnp.int32(OBSTRUCTIONS.index("none"))
        blank = self._env.primitive.normal(jnp.int32(-1))
        return _Run(self._env.reset_to(index), jnp.int32(RUNNING), none, zero, zero, blank)

    def _decide_one(self, policy: Policy, run: _Run, key: jax.Array) -> tuple[Any, Plan, Any]:
        """Let the policy decide, and plan."""
        state = run.state
        key = jax.random.fold_in(jax.random.fold_in(key, state.scene_index), state.num_pushes)
        return self._plan_one(run, self._env.primitive.normal(policy(state, key)))

    def _plan_one(self, run: _Run, action: jax.Array) -> tuple[Any, Plan, Any]:
        """Plan a push that is decided; an ended run stays where it is."""
        plan = self._env.plan(run.state, action).unless(run.reason != RUNNING, "no_ik")
        return run.state.physics, plan, run.replace(action=action)

    def _conclude_one(self, run: _Run, plan: Plan, physics: Any) -> _Run:
        """Return the run after a push; an ended run stays as it is."""
        state, result = self._env.conclude(run.state, plan, physics)
        pushed = run.replace(
            state=state,
            reason=result.reason,
            obstruction=result.outcome.obstruction,
            return_=run.return_ + result.reward,
            seconds=run.seconds + result.seconds,
        )
        return _where(run.reason == RUNNING, pushed, run)

    def _plan_grasp_one(self, state: EnvState, execute: jax.Array) -> tuple[Any, Plan, Any]:
        return state.physics, self._env.plan_grasp(state).unless(~execute, "no_ik"), state

    def _conclude_grasp_one(self, state: EnvState, plan: Plan, physics: Any) -> GraspResult:
        return self._env.conclude_grasp(state, plan, physics)


def evaluate_policy(
    env: Env,
    policy: Policy,
    *,
    episodes: int,
    seed: int = 0,
    with_grasp: bool = True,
    num_envs: int = 16,
    progress: EpisodeCallback | None = None,
) -> EvaluationResult:
    """Run one policy once; see `Evaluator.run`. Keep an `Evaluator` to run several without compiling again."""
    return Evaluator(env, num_envs=num_envs).run(
        policy, episodes=episodes, seed=seed, with_grasp=with_grasp, progress=progress
    )


def _bound(policy: Policy) -> Partial:
    """Return a policy as a pytree."""
    return policy if isinstance(policy, Partial) else Partial(policy)


def _first(runs: _Run) -> _Run:
    """Return the first run of a batch, on the host."""
    return jax.tree.map(lambda leaf: leaf[0], jax.device_get(runs))


def _where(condition: jax.Array, when: Any, otherwise: Any) -> Any:
    """Select between two pytrees by one () bool."""
    return jax.tree.map(lambda a, b: jnp.where(condition, a, b), when, otherwise)
