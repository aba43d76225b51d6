"""The training loop: collect, learn, log, evaluate, checkpoint."""

import math
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from pregrasp_jax import exploration
from pregrasp_jax.checkpoint import Restored, restore, save, save_policy
from pregrasp_jax.config import Config
from pregrasp_jax.learning.learner import Params
from pregrasp_jax.learning.replay import forget
from pregrasp_jax.training import collect, learn, processes
from pregrasp_jax.training.console import Console, announced_compilation, format_time
from pregrasp_jax.training.dump import DumpFn
from pregrasp_jax.training.mishap import NONE
from pregrasp_jax.training.program import IterateFn, Program, TrainState
from pregrasp_jax.training.run_folder import RunFolder

EvaluateFn = Callable[[Params], dict[str, Any]]
"""``params -> {"success_rate": ..., ...}`` on the validation scenes."""

CompileFn = Callable[[Params], None]
"""Compiles an `EvaluateFn` for parameters like these."""

PHASES = ("collect", "learn", "evaluate", "checkpoint")


@dataclass
class Progress:
    """What the host knows of a run; saved with every checkpoint.

    Attributes:
        env_steps: pushes so far.
        episodes: ended so far.
        seconds: by phase, over all sessions; compilation and start-up are not training time.
        best: success rate of the best policy so far.
        evaluated_at: env steps of the last evaluation.
    """

    env_steps: int = 0
    episodes: int = 0
    seconds: dict[str, float] = field(default_factory=lambda: dict.fromkeys(PHASES, 0.0))
    best: float | None = None
    evaluated_at: int | None = None

    @property
    def total_seconds(self) -> float:
        """Training time."""
        return sum(self.seconds.values())

    @contextmanager
    def timed(self, phase: str) -> Iterator[None]:
        """Count the time of a block, as the host sees it, for a phase."""
        start = time.perf_counter()
        try:
            yield
        finally:
            self.seconds[phase] += time.perf_counter() - start

    def share_done(self, config: Config) -> float:
        """Return how much of the run is done, 0 to 1, by the limit that comes first."""
        by_time = self.total_seconds / (60 * config.train.minutes) if config.train.minutes else 0.0
        return min(1.0, max(by_time, self.episodes / config.train.episodes))


class Trainer:
    """One session of a run: from a fresh or restored state to a limit or an interruption."""

    def __init__(
        self,
        config: Config,
        folder: RunFolder,
        program: Program,
        evaluate: EvaluateFn,
        dump: DumpFn,
        console: Console,
        *,
        compile_evaluation: CompileFn = lambda params: None,
    ):
        """Compile nothing yet.

        Args:
            config: the run.
            folder: locked.
            program: not compiled.
            evaluate: measures parameters on the validation scenes.
            dump: writes down a push that the physics did not survive.
            console: told about progress.
            compile_evaluation: called before the training, so that none of its time is compilation.
        """
        self.config = config
        self.folder = folder
        self.program = program
        self.evaluate_fn = evaluate
        self.compile_evaluation = compile_evaluation
        self.dump_fn = dump
        self.console = console
        self.progress = Progress()
        self._saved_at = -1
        self._unsaved = True
        self._tried_to_save_at = 0.0
        self._logged_at = (0, 0.0)
        self._compiled_in = 0.0

    def begin(self) -> None:
        """Start from the seed, and write the checkpoint of step 0.

        Raises:
            ValueError: it cannot be written, so no later one could.
        """
        self.state = self.program.begin(jax.random.key(self.config.seed))
        if self.config.train.tensorboard:
            self.folder.begin_event_log()
        self.save()
        if not self.saved:
            raise ValueError(f"no checkpoint can be written to {self.folder.path}; allowed is a disk with room for it")

    def resume(self) -> None:
        """Continue from the newest intact checkpoint.

        Raises:
            ValueError: there is none, or it does not fit the configuration.
        """
        template, ring = self.program.shapes().split()
        with processes.first_goes_first("restore"):  # it sets damaged checkpoints aside
            restored = restore(self.folder.checkpoints, template, ring)
        for problem in restored.problems:
            self.console.say(f"warning: {problem}; going on from the checkpoint of step {restored.step}")
        self.state = self.program.place(self._without_lost(restored))
        self.progress = Progress(**restored.extra)
        self.folder.forget_metrics_after(restored.step, evaluated_at=self.progress.evaluated_at)
        if self.config.train.tensorboard:
            self.folder.begin_event_log(resumed_at=restored.step)
        self._saved_at, self._tried_to_save_at, self._unsaved = restored.step, self.progress.total_seconds, False
        self._logged_at = (restored.step, self.progress.total_seconds)
        self.console.say(f"resuming {self.folder.path} at step {restored.step}, episode {self.progress.episodes}")

    def _without_lost(self, restored: Restored) -> TrainState:
        """Return the state of a checkpoint; what refers to observations that are lost is forgotten."""
        state: TrainState = restored.tree.join(restored.ring)
        if not restored.lost.any():
            return state
        replay = forget(state.learning.replay, jnp.asarray(restored.lost))
        rows = int(state.learning.replay.num_alive - replay.num_alive)
        self.console.say(
            f"warning: {restored.lost.sum()} observations are lost, and {rows} transitions with them; the run goes on, "
            "but not as it would have"
        )
        return state.replace(learning=state.learning.replace(replay=replay))

    def run(self, stop: Callable[[], bool]) -> str:
        """Train until a limit is reached or `stop`, asked before every step, returns True.

        Returns:
            One line that says why it ended.
        """
        progress = self.progress
        if progress.share_done(self.config) >= 1.0 and progress.evaluated_at == progress.env_steps:
            return "the run is complete; a higher --train.episodes or --train.minutes extends it"
        start = time.perf_counter()
        with announced_compilation(self.console.say):
            program = self.program.compile(self.state)
            self.compile_evaluation(self._average())
        self._compiled_in = time.perf_counter() - start
        self.console.start()
        while processes.agreed(progress.share_done(self.config) < 1.0):
            if processes.agreed(stop()):
                return self._interrupted()
            self._step(program)
            if self._crossed(self.config.train.log_every):
                self.log()
            if self._crossed(self.config.train.evaluate_every):
                self.evaluate()
            if processes.agreed(self._seconds_unsaved >= 60 * self.config.train.checkpoint_minutes):
                self.save()
        self.dump()
        self.evaluate()
        self.save()
        return f"done: {progress.episodes} episodes in {format_time(progress.total_seconds)}"

    def _interrupted(self) -> str:
        self.dump()
        self.save()
        step, path = self.progress.env_steps, self.folder.path
        return f"interrupted at step {step}; continue with `pregrasp-jax train resume {path}`"

    def _step(self, program: Program) -> None:
        """Push in every scene and learn from it: once, or as often as the program does without the host."""
        steps = self.progress.env_steps + self.config.train.num_envs * np.arange(self._iterations + 1)
        updates = np.diff([learn.num_updates(int(step), self.config.learner) for step in steps])
        betas = [self._beta(int(step)) for step in steps[1:]]
        self.progress.env_steps = int(steps[-1])
        if program.iterate is not None:
            self._iterate(program.iterate, updates, betas)
        else:
            self._push_and_learn(program, updates[0], betas[0])

    def _iterate(self, iterate: IterateFn, updates: np.ndarray, betas: list[float]) -> None:
        """Run one program of several iterations; all its time counts as collecting."""
        with self.progress.timed("collect"):
            self.state = iterate(self.state, updates.astype(np.int32), np.array(betas, np.float32))
            self.progress.episodes = int(self.state.actors.tally.episodes)

    def _push_and_learn(self, program: Program, updates: int, beta: float) -> None:
        """Push once in every scene and learn from it."""
        progress, state = self.progress, self.state
        with progress.timed("collect"):
            actors, experience = program.collect(state.actors, state.learning.learner.params)
            progress.episodes = int(experience.episodes)
        with progress.timed("learn"):
            learning = program.remember(state.learning, experience)
            for _ in range(updates if updates and learning.replay.num_alive else 0):
                learning = program.update(learning, np.float32(beta))
            jax.block_until_ready(learning.updates)
        self.state = TrainState(actors, learning)

    @property
    def _iterations(self) -> int:
        """How many pushes of every scene a step is."""
        return max(1, self.program.fused_iterations)

    def _beta(self, env_steps: int) -> float:
        """Return the importance exponent."""
        replay = self.config.replay
        start, steps = replay.importance_exponent, replay.importance_steps
        return float(exploration.linear_schedule(env_steps, start=start, end=1.0, steps=steps))

    def log(self) -> None:
        """Append a row to metrics.jsonl, show it, and count anew.

        Raises:
            FloatingPointError: the loss is no longer finite; all checkpoints are.
        """
        progress, actors, learning = self.progress, self.state.actors, self.state.learning
        row = collect.report(actors.tally) | learn.report(learning)
        epsilon = collect.epsilon_at(progress.env_steps, self.config.exploration, warmup=self.config.learner.warmup)
        steps, seconds = progress.env_steps - self._logged_at[0], progress.total_seconds - self._logged_at[1]
        row |= {"train/epsilon": float(epsilon), "time/seconds": progress.total_seconds}
        row |= {f"time/{phase}": progress.seconds[phase] for phase in PHASES}
        row["time/compile"] = self._compiled_in
        row["time/env_steps_per_second"] = steps / max(seconds, 1e-9)
        self.dump()
        self._refuse_non_finite()
        self._write("metrics", lambda: self.folder.append_metrics(row))
        self.state = TrainState(actors.begin_report(), learning.begin_report())
        self._logged_at = (progress.env_steps, progress.total_seconds)
        share = progress.share_done(self.config)
        self.console.update(row, share=share, eta=self._seconds_left(share))

    def _refuse_non_finite(self) -> None:
        """Raise before a loss that is not finite is logged or saved; it stays in the sum, so none is missed."""
        loss = float(self.state.learning.metrics["train/loss"])
        if not math.isfinite(loss):
            raise FloatingPointError(
                f"the loss is {loss} at step {self.progress.env_steps}; the last checkpoint is of step "
                f"{self._saved_at}; a smaller learner.learning_rate may help"
            )

    def dump(self) -> None:
        """Write down the first push since the last report that the physics did not survive, if there is one."""
        mishap = self.state.actors.mishap
        if int(mishap.action) == NONE:
            return

        def write() -> None:
            if path := self.dump_fn(self.folder.dumps, mishap):
                self.console.say(
                    f"the physics diverged at step {int(mishap.env_steps)} in scene {int(mishap.scene)}; "
                    f"`pregrasp-jax replay-dump {path}` repeats the push"
                )

        self._write("dump", write)

    def evaluate(self) -> None:
        """Measure the policy on the validation scenes, and keep it if it is the best (of equals, the newest)."""
        progress = self.progress
        if progress.evaluated_at == progress.env_steps:
            return
        progress.evaluated_at = progress.env_steps
        params = self._average()
        with progress.timed("evaluate"):
            measured = self.evaluate_fn(params)
        self._unsaved = True  # the best score is part of a checkpoint
        where = {"env_steps": progress.env_steps, "episodes": progress.episodes}
        row = where | {"time/seconds": progress.total_seconds}
        row |= {f"eval/{name}": value for name, value in measured.items()}
        self._write("metrics", lambda: self.folder.append_metrics(row))
        if progress.best is None or measured["success_rate"] >= progress.best:
            written = self._write(
                "policy", lambda: save_policy(self.folder.best, params, self.config, where | measured)
            )
            if processes.agreed(written):
                progress.best = measured["success_rate"]
        best = "none kept" if progress.best is None else f"best {progress.best:.0%}"
        self.console.say(f"validation at step {progress.env_steps}: success {measured['success_rate']:.0%} ({best})")

    def _average(self) -> Params:
        """Return the parameters that are measured and kept: the average is the better policy, it jumps less."""
        # One device evaluates, in every process the same.
        return self.program.layout.one_copy(self.state.learning.learner.target_params)

    def save(self) -> None:
        """Write a checkpoint, unless this step has one."""
        progress = self.progress
        if self.saved:
            return
        self._refuse_non_finite()
        rest = self.program.layout.gather(self.state.split()[0])
        ring, extra = self.state.ring(), dict(vars(progress))
        with progress.timed("checkpoint"):
            written = self._write(
                "checkpoint",
                lambda: save(self.folder.checkpoints, progress.env_steps, rest, ring, extra),
            )
        self._tried_to_save_at = progress.total_seconds
        if processes.agreed(written):
            self._saved_at, self._unsaved = progress.env_steps, False

    @property
    def saved(self) -> bool:
        """Whether the current step has a checkpoint."""
        return self._saved_at == self.progress.env_steps and not self._unsaved

    def _write(self, what: str, write: Callable[[], object]) -> bool:
        """Write a file; a full disk is reported, and the training goes on. Return whether it was written."""
        if not self.folder.writes:
            return True
        try:
            write()
        except OSError as error:
            last = "there is none yet" if self._saved_at < 0 else f"the last checkpoint is of step {self._saved_at}"
            self.console.say(
                f"warning: no {what} written at step {self.progress.env_steps} ({error.strerror}: {self.folder.path}); "
                f"{last}"
            )
            return False
        return True

    @property
    def _seconds_unsaved(self) -> float:
        """Training time since a checkpoint was last tried."""
        return self.progress.total_seconds - self._tried_to_save_at

    def _crossed(self, interval: int) -> bool:
        """Return whether the last step reached a multiple of `interval` env steps (0: never)."""
        now = self.progress.env_steps
        return interval > 0 and now // interval > (now - self._iterations * self.config.train.num_envs) // interval

    def _seconds_left(self, share: float) -> float | None:
        return self.progress.total_seconds * (1 - share) / share if share > 0 else None
