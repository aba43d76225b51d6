"""A training session: objects, scenes, program and run folder put together, then the loop of `trainer`."""

import dataclasses
import os
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import jax

from pregrasp_jax import io
from pregrasp_jax.checkpoint.combine import VALUES_DEPEND_ON
from pregrasp_jax.checkpoint.policy import load_policy
from pregrasp_jax.config import Config, with_absolute_paths
from pregrasp_jax.evaluation import Evaluator
from pregrasp_jax.evaluation.clearing import own_protocol
from pregrasp_jax.learning.q_function import Params, make_q_function
from pregrasp_jax.policies.learned import make_learned
from pregrasp_jax.sensors import CLEAN
from pregrasp_jax.settings import flatten, to_dict
from pregrasp_jax.startup import prepare
from pregrasp_jax.task.assembly import make_env
from pregrasp_jax.task.env import Env
from pregrasp_jax.training import demonstrations, imitation, processes, resources, trainer
from pregrasp_jax.training.console import Console
from pregrasp_jax.training.dump import DumpFn, make_dump
from pregrasp_jax.training.event_log import require_module
from pregrasp_jax.training.interrupt import Interrupt
from pregrasp_jax.training.program import Program, make_program
from pregrasp_jax.training.recorder import EvaluateFn, Recorder
from pregrasp_jax.training.run_folder import RunFolder, WatchedFolder, refuse_used
from pregrasp_jax.training.sharding import make_layout
from pregrasp_jax.training.trainer import CompileFn, Trainer

VALIDATION_ENVS = 16
"""Validation scenes side by side; the result does not depend on it."""


def train(config: Config, run_dir: Path, *, init_from: Path | None = None, console: Console | None = None) -> int:
    """Start a run.

    Nothing is written before objects, scenes, initial parameters, memory and disk have been found to do.

    Args:
        config: the run.
        run_dir: new or empty folder.
        init_from: run or policy (`load_policy`) whose parameters are the initial ones; drawn from the seed if None.
        console: told about progress.

    Returns:
        0 if the run is done, 1 if its last checkpoint could not be written, 128 + the signal that interrupted it.

    Raises:
        ValueError: one line says what cannot be used, and what is allowed.
    """
    prepare()
    if processes.is_first():
        refuse_used(run_dir)
    _refuse_unused(config)
    console, config, params = console or _console(), with_absolute_paths(config), None
    if init_from is not None:
        policy = load_policy(init_from)
        config, params = _like(config, policy.config), policy.params
        for line in _changed_values(config, policy.config):
            console.say(f"{init_from} was trained with {line}: its values will change")
    return _session(config, run_dir, None, params, console)


def _like(config: Config, started_from: Config) -> Config:
    """Return a configuration with as many networks and path channels as the initial parameters, unless it says."""
    here, there = config.network, started_from.network
    members = there.members if here.members is None and there.num_members > 1 else here.members
    path = there.path_channels if here.path_channels is None and there.num_path_channels else here.path_channels
    return dataclasses.replace(config, network=dataclasses.replace(here, members=members, path_channels=path))


def _changed_values(config: Config, started_from: Config) -> Iterator[str]:
    """Yield what makes a value mean something else than where the parameters come from."""
    now, before = flatten(to_dict(config)), flatten(to_dict(started_from))
    for name in VALUES_DEPEND_ON:
        if now[name] != before[name]:
            yield f"{name} = {before[name]}, this run has {now[name]}"


def resume(config: Config, run_dir: Path, *, console: Console | None = None) -> int:
    """Continue a run from its newest intact checkpoint; the rest is as in `train`.

    Args:
        config: of the run; only what `run_config.CHANGEABLE` names may differ.
        run_dir: folder of the run.
        console: told about progress.
    """
    prepare()
    _refuse_unused(config)
    config = with_absolute_paths(config)
    folder = RunFolder.open(run_dir, config) if processes.is_first() else WatchedFolder(run_dir)
    with folder:
        return _session(config, run_dir, folder, None, console or _console())


def _session(config: Config, run_dir: Path, folder: RunFolder | None, params: Params | None, console: Console) -> int:
    return METHODS[config.train.method](config.validate(), run_dir, folder, params, console)


def _learn_q(config: Config, run_dir: Path, folder: RunFolder | None, params: Params | None, console: Console) -> int:
    if config.train.tensorboard:
        require_module()
    layout = make_layout(config)
    if jax.device_count() > 1:
        console.say(f"training on {layout.num_devices} of {jax.device_count()} devices")
    env = _load(config, "train", console)
    refuse_mirror(config, env)
    if not env.rules.asks_for_grasp:
        raise ValueError(
            f"train.method = q_learning learns where to push before a grasp, but task.primitive = "
            f"{config.task.primitive!r} grasps by itself; allowed with it: imitation"
        )
    validation = _load(config, "validation", console)
    program = make_program(env, config, params=params, layout=layout)
    resources.check(*program.shapes().split(), run_dir)
    hashes = _hashes(env) | {"validation scenes": validation.scenes.content_hash}
    processes.refuse_difference(_digest(config, hashes))
    resumed, folder = folder is not None, folder or _create(run_dir, config)
    evaluate, compile_evaluation = make_evaluate(validation, config)
    dump = make_dump(env, config)
    with folder, Interrupt(console.say, console.close) as interrupt:
        folder.begin_session(config, hashes)
        session = make_trainer(
            config,
            folder,
            program,
            evaluate,
            dump,
            console,
            resumed=processes.agreed(resumed and folder.has_checkpoint),
            compile_evaluation=compile_evaluation,
        )
        try:
            ending = session.run(lambda: interrupt.exit_code is not None)
        finally:
            console.close()
        console.say(ending)
        return interrupt.exit_code or (0 if session.recorder.saved else 1)


def refuse_mirror(config: Config, env: Env) -> None:
    """Refuse to learn from mirror images that are no scenes of the task.

    Raises:
        ValueError: one line says what breaks the symmetry.
    """
    if not config.network.mirror or env.symmetric:
        return
    why = (
        f"robot {env.robot.name} starts in one posture between its walls (task.mirrored_start = "
        f"{env.task.mirrored_start})"
        if env.workspace.symmetric
        else "it is not its own mirror image"
    )
    raise ValueError(
        f"network.mirror = True in workspace '{env.workspace.name}': {why}; allowed is False, also with --init-from, "
        "whose parameters fit either"
    )


def make_trainer(
    config: Config,
    folder: RunFolder,
    program: Program,
    evaluate: EvaluateFn,
    dump: DumpFn,
    console: Console,
    *,
    resumed: bool,
    compile_evaluation: CompileFn = lambda params: None,
) -> Trainer:
    """Return the trainer of a session: from the newest checkpoint if `resumed`, else from the seed.

    Raises:
        ValueError: the checkpoint cannot be read, or the first one cannot be written.
    """
    options = {"evaluate": evaluate, "dump": dump, "console": console}
    if resumed:
        state, counters = trainer.resume(program, folder, console, tensorboard=config.train.tensorboard)
        recorder = Recorder(config, folder, program, counters=counters, **options)
    else:
        recorder = Recorder(config, folder, program, **options)
        state = trainer.begin(program, recorder)
    return Trainer(program, recorder, state, compile_evaluation=compile_evaluation)


def make_evaluate(env: Env, config: Config) -> tuple[EvaluateFn, CompileFn]:
    """Return the function that measures parameters on all scenes of `env`, grasp included, and what compiles it."""
    make_policy = make_learned(env, make_q_function(config.network, config.task, env.primitive.actions).values)
    episodes = len(env.scenes)
    evaluator = Evaluator(env, num_envs=min(VALIDATION_ENVS, episodes))

    def evaluate(params: Params) -> dict[str, Any]:
        return evaluator.run(make_policy(params), episodes=episodes, seed=config.seed).summary()

    def compile_evaluation(params: Params) -> None:
        evaluator.compile(make_policy(params), episodes=episodes)

    return evaluate, compile_evaluation


def _refuse_unused(config: Config) -> None:
    """Refuse settings for which the method of a training has no use."""
    method = config.train.method
    given, unset = flatten(to_dict(config)), flatten(to_dict(Config()))
    for name, value in given.items():
        if name.startswith(_UNUSED[method]) and name not in _USED and value != unset[name]:
            raise ValueError(f"{name} = {value} is not known to train.method = {method}; allowed is {unset[name]}")


def _imitate(config: Config, run_dir: Path, folder: RunFolder | None, params: Params | None, console: Console) -> int:
    if params is not None:
        raise ValueError("--init-from is not known to train.method = imitation; allowed is to leave it out")
    if jax.process_count() > 1:
        raise ValueError("--distributed True is not known to train.method = imitation; allowed is one process")
    if folder is None and config.strokes.collection:
        demonstrations.refuse_collection(config)
    resumed = folder is not None
    env = own_protocol(_load(config, "train", console))
    folder = folder or _create(run_dir, config)
    hashes = _hashes(env)
    with folder, Interrupt(console.say, console.close) as interrupt:
        folder.begin_session(config, hashes)
        try:
            ending = imitation.run(
                config, env, folder, console, resumed=resumed, stop=lambda: interrupt.exit_code is not None
            )
        except OSError as error:
            console.say(f"the run ends, since nothing can be written ({error.strerror}: {folder.path})")
            return 1
        finally:
            console.close()
        console.say(ending)
        return interrupt.exit_code or 0


_UNUSED = {"q_learning": "strokes.", "imitation": ("network.", "replay.", "learner.", "exploration.", "train.")}
"""What settings begin with that a method has no use for, but for those of `_USED`."""

_USED = ("train.method", "train.num_envs", "train.checkpoint_minutes")

METHODS = {"q_learning": _learn_q, "imitation": _imitate}
"""Sessions by the name that `train.method` knows them by."""


def _console() -> Console:
    """Return a console that is heard in process 0 only."""
    return Console(None if processes.is_first() else Path(os.devnull).open("w"))


def _create(run_dir: Path, config: Config) -> RunFolder:
    return RunFolder.create(run_dir, config) if processes.is_first() else WatchedFolder(run_dir)


def _load(config: Config, split: Any, console: Console) -> Env:
    def tell(doing: str) -> Callable[[int, int], None]:
        def told(done: int, total: int) -> None:
            if done == total or done % max(1, total // 10) == 0:
                console.say(f"{doing}: {done} of {total}")

        return told

    packing, making = tell(f"packing {split} scenes"), tell(f"making objects for {split}")
    return make_env(config, split=split, progress=packing, making=making)


def _digest(config: Config, hashes: dict[str, str]) -> str:
    """Return what all processes of a run must agree on; where its meshes lie may differ between hosts."""
    somewhere = dataclasses.replace(config.assets, object_dir=None)
    return io.content_hash(to_dict(dataclasses.replace(config, assets=somewhere)), hashes)


def _hashes(env: Env) -> dict[str, str]:
    """Return what a run keeps for as long as it goes on; a sensor may be a file, which somebody may change."""
    sensor = {} if env.sensor == CLEAN else {"sensor": io.content_hash(dataclasses.asdict(env.sensor))}
    return sensor | {
        "hull bank": env.bank.content_hash,
        "training scenes": env.scenes.content_hash,
        "workspace": env.workspace.content_hash,
    }
