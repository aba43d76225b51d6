"""The training loop: collect, learn, log, evaluate, checkpoint."""

import time
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

from pregrasp_jax.checkpoint import Restored, restore
from pregrasp_jax.learning.q_function import Params
from pregrasp_jax.learning.replay import forget
from pregrasp_jax.machine import announced_compilation
from pregrasp_jax.messages import command
from pregrasp_jax.policies.exploration import linear_schedule
from pregrasp_jax.training import learn, processes, schedules
from pregrasp_jax.training.console import Console, format_time
from pregrasp_jax.training.program import IterateFn, Program, TrainState
from pregrasp_jax.training.recorder import Counters, Recorder
from pregrasp_jax.training.run_folder import RunFolder

CompileFn = Callable[[Params], None]
"""Compiles an evaluation for parameters like these."""


class Trainer:
    """One session of a run: from a state to a limit or an interruption."""

    def __init__(
        self,
        program: Program,
        recorder: Recorder,
        state: TrainState,
        *,
        compile_evaluation: CompileFn = lambda params: None,
    ):
        """Compile nothing yet.

        Args:
            program: not compiled.
            recorder: of the run.
            state: where the session begins, from `begin` or `resume`.
            compile_evaluation: called before the training, so that none of its time is compilation.
        """
        self.program, self.recorder, self.state = program, recorder, state
        self.config = recorder.config
        self.compile_evaluation = compile_evaluation
        self._clock: tuple[int, float] | None = None
        self._settle(schedules.known_length(self.config))

    def run(self, stop: Callable[[], bool]) -> str:
        """Train until a limit is reached or `stop`, asked before every step, returns True.

        Returns:
            One line that says why it ended.
        """
        recorder, counters, train = self.recorder, self.recorder.counters, self.config.train
        if counters.share_done(self.config) >= 1.0 and counters.evaluated_at == counters.env_steps:
            return "the run is complete; a higher --train.episodes, --train.env-steps or --train.minutes extends it"
        start = time.perf_counter()
        with announced_compilation(recorder.console.say):
            program = self.program.compile(self.state)
            self.compile_evaluation(self.average())
        recorder.compiled_in = time.perf_counter() - start
        recorder.console.start()
        while processes.agreed(counters.share_done(self.config) < 1.0):
            if processes.agreed(stop()):
                return self._interrupted()
            self.step(program)
            self._measure_length()
            if self._crossed(train.log_every):
                self.state = recorder.log(self.state)
            if self._crossed(train.evaluate_every):
                recorder.evaluate(self.average())
            if processes.agreed(recorder.seconds_unsaved >= 60 * train.checkpoint_minutes):
                recorder.save(self.state)
        recorder.dump(self.state)
        recorder.evaluate(self.average())
        recorder.save(self.state)
        return f"done: {counters.episodes} episodes in {format_time(counters.total_seconds)}"

    def _interrupted(self) -> str:
        self.recorder.dump(self.state)
        self.recorder.save(self.state)
        step, path = self.recorder.counters.env_steps, self.recorder.folder.path
        return f"interrupted at step {step}; continue with `{command('train', 'resume', path)}`"

    def step(self, program: Program) -> None:
        """Push in every scene and learn from it: once, or as often as a compiled program does without the host."""
        counters = self.recorder.counters
        steps = counters.env_steps + self.config.train.num_envs * np.arange(self._iterations + 1)
        updates = np.diff([learn.num_updates(int(step), self.config.learner) for step in steps])
        betas = [self._beta(int(step)) for step in steps[1:]]
        counters.env_steps = int(steps[-1])
        if program.iterate is not None:
            self._iterate(program.iterate, updates, betas)
        else:
            self._push_and_learn(program, updates[0], betas[0])

    def _iterate(self, iterate: IterateFn, updates: np.ndarray, betas: list[float]) -> None:
        """Run one program of several iterations; all its time counts as collecting."""
        counters = self.recorder.counters
        with counters.timed("collect"):
            self.state = iterate(self.state, updates.astype(np.int32), np.array(betas, np.float32), self.pace)
            counters.episodes = int(self.state.actors.tally.episodes)

    def _push_and_learn(self, program: Program, updates: int, beta: float) -> None:
        """Push once in every scene and learn from it."""
        counters, state = self.recorder.counters, self.state
        with counters.timed("collect"):
            actors, experience = program.collect(state.actors, state.learning.learner.params, self.pace)
            counters.episodes = int(experience.episodes)
        with counters.timed("learn"):
            learning = program.remember(state.learning, experience)
            for _ in range(updates if updates and learning.replay.num_alive else 0):
                learning = program.update(learning, np.float32(beta), self.pace)
            jax.block_until_ready(learning.updates)
        self.state = TrainState(actors, learning)

    def average(self) -> Params:
        """Return the parameters that are measured and kept: the average is the better policy, it jumps less."""
        # One device evaluates, in every process the same.
        return self.program.layout.one_copy(self.state.learning.learner.target_params)

    @property
    def _iterations(self) -> int:
        """How many pushes of every scene a step is."""
        return max(1, self.program.fused_iterations)

    def _beta(self, env_steps: int) -> float:
        """Return the importance exponent."""
        steps = schedules.importance_steps(self.config, self.recorder.counters.length)
        start = self.config.replay.importance_exponent
        return float(linear_schedule(env_steps, start=start, end=1.0, steps=steps))

    def _settle(self, length: int | None) -> None:
        """Take the length of the run, in env steps, unless it was settled before."""
        counters = self.recorder.counters
        counters.length = length if counters.length is None else counters.length
        self.pace = schedules.make_pace(self.config, counters.length)

    def _measure_length(self) -> None:
        """Settle the length of a run that a clock ends, by its speed after the warm-up."""
        counters, num_envs = self.recorder.counters, self.config.train.num_envs
        if counters.length is not None or counters.env_steps < self.config.learner.warmup:
            return
        now = counters.env_steps, counters.total_seconds
        self._clock = self._clock or now
        steps, seconds = now[0] - self._clock[0], now[1] - self._clock[1]
        if steps < schedules.MEASURED_STEPS * num_envs:
            return
        speed = steps / max(seconds, 1e-9)
        length = schedules.measured_length(self.config, env_steps=now[0], seconds=now[1], steps_per_second=speed)
        self._settle(processes.agreed_number(length))
        if schedules.depends_on_length(self.config):
            self.recorder.console.say(
                f"{speed:.1f} steps per second: schedules are those of a run of {counters.length} steps"
            )

    def _crossed(self, interval: int) -> bool:
        """Return whether the last step reached a multiple of `interval` env steps (0: never)."""
        now = self.recorder.counters.env_steps
        return interval > 0 and now // interval > (now - self._iterations * self.config.train.num_envs) // interval


def begin(program: Program, recorder: Recorder) -> TrainState:
    """Return the state that the seed begins with, and write the checkpoint of step 0.

    Raises:
        ValueError: it cannot be written, so no later one could.
    """
    state = program.begin(jax.random.key(recorder.config.seed))
    if recorder.config.train.tensorboard:
        recorder.folder.begin_event_log()
    recorder.save(state)
    if not recorder.saved:
        path = recorder.folder.path
        raise ValueError(f"no checkpoint can be written to {path}; allowed is a disk with room for it")
    return state


def resume(program: Program, folder: RunFolder, console: Console, *, tensorboard: bool) -> tuple[TrainState, Counters]:
    """Return state and counters of the newest intact checkpoint.

    Raises:
        ValueError: there is none, or it does not fit the configuration.
    """
    template, ring = program.shapes().split()
    with processes.first_goes_first("restore"):  # it sets damaged checkpoints aside
        restored = restore(folder.checkpoints, template, ring)
    for problem in restored.problems:
        console.say(f"warning: {problem}; going on from the checkpoint of step {restored.step}")
    state, counters = program.place(_without_lost(restored, console)), Counters(**restored.extra)
    folder.forget_metrics_after(restored.step, evaluated_at=counters.evaluated_at)
    if tensorboard:
        folder.begin_event_log(resumed_at=restored.step)
    console.say(f"resuming {folder.path} at step {restored.step}, episode {counters.episodes}")
    return state, counters


def _without_lost(restored: Restored, console: Console) -> TrainState:
    """Return the state of a checkpoint; what refers to observations that are lost is forgotten."""
    state: TrainState = restored.tree.join(restored.ring)
    if not restored.lost.any():
        return state
    replay = forget(state.learning.replay, jnp.asarray(restored.lost))
    rows = int(state.learning.replay.num_alive - replay.num_alive)
    console.say(
        f"warning: {restored.lost.sum()} observations are lost, and {rows} transitions with them; the run goes on, "
        "but not as it would have"
    )
    return state.replace(learning=state.learning.replace(replay=replay))
