"""The compiled parts of a training and the state that they share."""

import dataclasses
import functools
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, cast

import flax.struct as struct
import jax
import jax.numpy as jnp
import numpy as np

from pregrasp_jax.checkpoint.chunks import Ring
from pregrasp_jax.config import Config
from pregrasp_jax.learning.networks import with_path_readout
from pregrasp_jax.learning.q_function import Params, QFunction, make_q_function
from pregrasp_jax.task.stages import Stages
from pregrasp_jax.training.collect import Actors, Environment, Experience, init_actors, make_collect
from pregrasp_jax.training.learn import (
    Learning,
    RememberFn,
    UpdateFn,
    init_learning,
    make_optimizer,
    make_remember,
    make_update,
)
from pregrasp_jax.training.schedules import Pace, known_length, make_pace
from pregrasp_jax.training.sharding import Layout

POLICY = "learning/learner/target_params/"
"""How the names of the leaves of a `TrainState` begin that a policy needs: the average is the better policy."""


class TrainState(struct.PyTreeNode):
    """Everything that a training must remember; two equal ones continue equally.

    Attributes:
        actors: the scenes.
        learning: the learner and its memory.
    """

    actors: Actors
    learning: Learning

    def split(self) -> tuple["TrainState", Any]:
        """Return the state without the observations of the replay, and those."""
        replay = self.learning.replay
        rest = self.replace(learning=self.learning.replace(replay=replay.replace(observations=None)))
        return rest, replay.observations

    def join(self, observations: Any) -> "TrainState":
        """Inverse of `split`."""
        replay = self.learning.replay.replace(observations=observations)
        return self.replace(learning=self.learning.replace(replay=replay))

    def ring(self) -> Ring:
        """Return the observations as a checkpoint saves them."""
        replay = self.learning.replay
        return Ring(replay.observations, int(replay.observations_written))


IterateFn = Callable[[TrainState, Any, Any, Pace], TrainState]
"""``(state, updates [K] int32, beta [K] float32, pace) -> state`` after K iterations, with so many updates in each."""


FUSED_ITERATIONS = 4
"""What `TrainConfig.fused_iterations` chooses: few, since signals, logs and limits wait for the end of a program."""


@dataclass(frozen=True)
class Program:
    """What a training runs.

    Attributes:
        init: ``key -> TrainState``.
        collect: pushes once in every scene; donates the actors.
        remember: adds a push of every scene to the memory; donates the learning state.
        update: samples and updates once; donates the learning state.
        successes: reasons that count as success.
        pace: where the schedules end, as far as the configuration says so.
        fused_iterations: how many iterations `compile` puts into one program, see `make_iterate`; 0 compiles the parts.
        iterate: that program.
        layout: which device holds what of all this.
    """

    init: Callable[[jax.Array], TrainState]
    collect: Callable[..., Any]
    remember: RememberFn
    update: UpdateFn
    successes: tuple[int, ...]
    pace: Pace
    fused_iterations: int = 0
    iterate: IterateFn | None = None
    layout: Layout = field(default_factory=Layout)

    def shapes(self) -> TrainState:
        """Return the shapes of the state without making one."""
        return jax.eval_shape(self.init, jax.random.key(0))

    def begin(self, key: jax.Array) -> TrainState:
        """Return the state that a key begins with."""
        return jax.jit(self.init, out_shardings=self._shardings)(key)

    def place(self, state: TrainState) -> TrainState:
        """Return a state that was read from a checkpoint, every part where it belongs."""
        return self.layout.place(state, self._shardings)

    @property
    def _shardings(self) -> Any:
        """How a state lies, as a prefix of it: scenes are split over the devices, all else is copied."""
        split, copied = self.layout.split, self.layout.copied
        return TrainState(Actors(split, copied, copied, copied), copied)  # pyright: ignore[reportArgumentType]

    def compile(self, state: TrainState) -> "Program":
        """Return the program compiled for a state.

        Compiled ahead, a function that would need a second trace fails instead of compiling in silence.
        """
        state = _shapes(state)
        of_state, copied = self._shardings, self.layout.copied
        pace = _shapes(self.pace)
        if self.fused_iterations:
            due = (jax.ShapeDtypeStruct((self.fused_iterations,), dtype) for dtype in (jnp.int32, jnp.float32))
            iterate = _compile(make_iterate(self), (state, *due, pace), (of_state, copied, copied, copied), of_state)
            return dataclasses.replace(self, iterate=iterate)
        arguments = (state.actors, state.learning.learner.params, pace)
        experience = jax.eval_shape(self.collect, *arguments)[1]

        def compile_collect(function: Callable[..., Any], arguments: tuple[Any, ...]) -> Any:
            return _compile(function, arguments, (of_state.actors, copied, copied), (of_state.actors, copied))

        parts = {
            "collect": cast(Stages, self.collect).compile(*arguments, compile_fn=compile_collect),
            "remember": _compile(self.remember, (state.learning, experience), (copied, copied), copied),
            "update": _compile(self.update, (state.learning, np.float32(0), pace), (copied, copied, copied), copied),
        }
        return dataclasses.replace(self, **parts)


def make_program(
    env: Environment,
    config: Config,
    *,
    params: Params | None = None,
    q_function: QFunction | None = None,
    layout: Layout = Layout(),  # noqa: B008  (frozen)
) -> Program:
    """Return the program of a configuration, not compiled.

    Args:
        env: the training scenes.
        config: the run.
        params: initial parameters; drawn from the seed if None.
        q_function: the one of the configuration if None.
        layout: where it will run; one device unless told otherwise.

    Raises:
        ValueError: `params` do not fit the network.
    """
    q = q_function or make_q_function(config.network, config.task, env.primitive.actions)
    pace = make_pace(config, known_length(config))
    stages = make_collect(
        env,
        q,
        config.exploration,
        warmup=config.learner.warmup,
        try_grasps=config.train.try_grasps,
        vmap=layout.vmap,
    )
    # Under jit, so that shapes, start and compilation share one trace: that of a physics engine takes seconds.
    collect = dataclasses.replace(stages, parts=tuple(map(jax.jit, stages.parts)), run=jax.jit(stages.run))

    @jax.jit
    def init(key: jax.Array) -> TrainState:
        network_key, actor_key, learner_key = jax.random.split(key, 3)
        actors = init_actors(actor_key, env, config.train.num_envs, vmap=layout.vmap)
        # XLA's own generator compiles four times faster than threefry, forty kernels long.
        fast_key = jax.random.wrap_key_data(jnp.tile(jax.random.key_data(network_key), 2), impl="rbg")
        drawn = q.init(fast_key)
        experience: Experience = jax.eval_shape(collect, *_shapes((actors, drawn, pace)))[1]
        learning = init_learning(
            learner_key,
            drawn if params is None else with_path_readout(params, drawn),
            experience.steps,
            config.replay,
            make_optimizer(config.learner),
            max_pushes=config.task.max_pushes,
            num_siblings=1 + config.exploration.branches if config.learner.siblings else 1,
        )
        return TrainState(actors, learning)

    update = make_update(
        q=q,
        mask_fn=env.action_mask,
        successes=env.rules.successes,
        config=config.learner,
        replay_config=config.replay,
        split_fn=layout.split_batch,
    )
    if params is not None and not q.fits(with_path_readout(params, q.shapes)):
        raise ValueError(
            f"the initial parameters (--init-from) are of another network; allowed is network.architecture = "
            f"{config.network.architecture} and network.width = {config.network.width}, network.members = "
            f"{config.network.num_members}, and network.path_channels = {config.network.num_path_channels} or none"
        )
    remember = make_remember(config.replay, env.rules)
    return Program(init, collect, remember, update, env.rules.successes, pace, _num_fused(config), layout=layout)


def _num_fused(config: Config) -> int:
    """Return how many iterations one program is; 0 leaves every step to the host."""
    if config.train.fused_iterations is not None:
        return config.train.fused_iterations
    return FUSED_ITERATIONS if config.physics.engine == "mjx" and jax.default_backend() != "cpu" else 0


def make_iterate(program: Program) -> IterateFn:
    """Return K iterations as one function: push in every scene, remember, update; donate the state.

    Nothing passes through the host, so this is for engines that run on the device, and for accelerators: inside a
    loop of XLA's CPU compiler an update takes several times as long. Counts are as in `Trainer`, which the host knows.
    """

    def iteration(pace: Pace, state: TrainState, due: tuple[jax.Array, jax.Array]) -> tuple[TrainState, None]:
        updates, beta = due
        actors, experience = program.collect(state.actors, state.learning.learner.params, pace)
        learning = program.remember(state.learning, experience)
        updates = jnp.where(learning.replay.num_alive > 0, updates, 0)
        learning = jax.lax.fori_loop(0, updates, lambda _, learning: program.update(learning, beta, pace), learning)
        return TrainState(actors, learning), None

    def iterate(state: TrainState, updates: Any, beta: Any, pace: Pace) -> TrainState:
        step = functools.partial(iteration, pace)
        return jax.lax.scan(step, state, (jnp.asarray(updates), jnp.asarray(beta)))[0]

    return iterate


def _shapes(tree: Any) -> Any:
    """Return the shapes of a tree without where it lies: arrays that lie elsewhere would have a push traced anew."""
    return jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype), tree)


def _compile(function: Callable[..., Any], arguments: tuple[Any, ...], shardings: tuple[Any, ...], result: Any) -> Any:
    """Return a function compiled for its arguments and for where they and the result lie; it donates the first."""
    jitted = jax.jit(function, donate_argnums=0, in_shardings=shardings, out_shardings=result)
    return jitted.lower(*arguments).compile()
