"""What a run leaves on disk: metrics, the best policy, dumps of diverged pushes, checkpoints; and its counters."""

import math
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

from pregrasp_jax.checkpoint import save, save_policy
from pregrasp_jax.config import Config
from pregrasp_jax.learning.q_function import Params
from pregrasp_jax.training import collect, learn, processes, schedules
from pregrasp_jax.training.console import Console
from pregrasp_jax.training.dump import DumpFn
from pregrasp_jax.training.mishap import NONE
from pregrasp_jax.training.program import POLICY, Program, TrainState
from pregrasp_jax.training.run_folder import RunFolder

EvaluateFn = Callable[[Params], dict[str, Any]]
"""``params -> {"success_rate": ..., ...}`` on the validation scenes."""

PHASES = ("collect", "learn", "evaluate", "checkpoint")


@dataclass
class Counters:
    """What the host knows of a run; saved with every checkpoint.

    Attributes:
        env_steps: pushes so far.
        episodes: ended so far.
        seconds: by phase, over all sessions; compilation and start-up are not training time.
        best: success rate of the best policy so far.
        evaluated_at: env steps of the last evaluation.
        length: env steps of the run that its schedules refer to, see `schedules`; None until it is settled.
    """

    env_steps: int = 0
    episodes: int = 0
    seconds: dict[str, float] = field(default_factory=lambda: dict.fromkeys(PHASES, 0.0))
    best: float | None = None
    evaluated_at: int | None = None
    length: int | None = None

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
        train = config.train
        by_time = self.total_seconds / (60 * train.minutes) if train.minutes else 0.0
        by_steps = self.env_steps / train.env_steps if train.env_steps else 0.0
        return min(1.0, max(by_time, by_steps, self.episodes / train.episodes))

    def seconds_left(self, config: Config) -> float | None:
        """Return the training time still to come, s; None while nothing is known of it."""
        share = self.share_done(config)
        return self.total_seconds * (1 - share) / share if share > 0 else None


class Recorder:
    """Writes down what a training says it is; a full disk costs a file, never the run."""

    def __init__(
        self,
        config: Config,
        folder: RunFolder,
        program: Program,
        evaluate: EvaluateFn,
        dump: DumpFn,
        console: Console,
        counters: Counters | None = None,
    ):
        """Write nothing yet.

        Args:
            config: the run.
            folder: locked.
            program: says where a state lies, and what counts as success.
            evaluate: measures parameters on the validation scenes.
            dump: writes down a push that the physics did not survive.
            console: told about progress.
            counters: those of the checkpoint from which the run goes on; None for a new run.
        """
        self.config, self.folder, self.console = config, folder, console
        self.evaluate_fn, self.dump_fn = evaluate, dump
        self.counters = counters or Counters()
        self.compiled_in = 0.0
        self._layout, self._successes = program.layout, program.successes
        self._saved_at = -1 if counters is None else counters.env_steps
        self._unsaved = counters is None
        self._tried_to_save_at = self.counters.total_seconds
        self._logged_at = (self.counters.env_steps, self.counters.total_seconds)

    @property
    def saved(self) -> bool:
        """Whether the current step has a checkpoint."""
        return self._saved_at == self.counters.env_steps and not self._unsaved

    @property
    def seconds_unsaved(self) -> float:
        """Training time since a checkpoint was last tried."""
        return self.counters.total_seconds - self._tried_to_save_at

    def log(self, state: TrainState) -> TrainState:
        """Append a row to metrics.jsonl, show it, and return the state with everything counted anew.

        Raises:
            FloatingPointError: the loss is no longer finite; all checkpoints are.
        """
        counters = self.counters
        row = state.actors.tally.metrics(self._successes) | learn.metrics(state.learning)
        epsilon = collect.epsilon_at(
            counters.env_steps,
            self.config.exploration,
            warmup=self.config.learner.warmup,
            decay=schedules.epsilon_decay(self.config, counters.length),
        )
        steps, seconds = counters.env_steps - self._logged_at[0], counters.total_seconds - self._logged_at[1]
        row |= {"train/epsilon": float(epsilon), "time/seconds": counters.total_seconds}
        row |= {f"time/{phase}": counters.seconds[phase] for phase in PHASES}
        row |= {"time/compile": self.compiled_in, "time/env_steps_per_second": steps / max(seconds, 1e-9)}
        self.dump(state)
        self._refuse_non_finite(state)
        self._write("metrics", lambda: self.folder.append_metrics(row))
        self._logged_at = (counters.env_steps, counters.total_seconds)
        share = counters.share_done(self.config)
        self.console.update(row, share=share, eta=counters.seconds_left(self.config))
        return TrainState(state.actors.begin_report(), state.learning.begin_report())

    def dump(self, state: TrainState) -> None:
        """Write down the first push since the last report that the physics did not survive, if there is one."""
        mishap = state.actors.mishap
        if int(mishap.action) == NONE:
            return

        def write() -> None:
            if path := self.dump_fn(self.folder.dumps, mishap):
                self.console.say(
                    f"the physics diverged at step {int(mishap.env_steps)} in scene {int(mishap.scene)}; "
                    f"`pregrasp-jax replay-dump {path}` repeats the push"
                )

        self._write("dump", write)

    def evaluate(self, params: Params) -> None:
        """Measure parameters on the validation scenes, and keep them if they are the best (of equals, the newest)."""
        counters = self.counters
        if counters.evaluated_at == counters.env_steps:
            return
        counters.evaluated_at = counters.env_steps
        with counters.timed("evaluate"):
            measured = self.evaluate_fn(params)
        self._unsaved = True  # the best score is part of a checkpoint
        where = {"env_steps": counters.env_steps, "episodes": counters.episodes}
        row = where | {"time/seconds": counters.total_seconds}
        row |= {f"eval/{name}": value for name, value in measured.items()}
        self._write("metrics", lambda: self.folder.append_metrics(row))
        if counters.best is None or measured["success_rate"] >= counters.best:
            written = self._write(
                "policy", lambda: save_policy(self.folder.best, params, self.config, where | measured)
            )
            if processes.agreed(written):
                counters.best = measured["success_rate"]
        best = "none kept" if counters.best is None else f"best {counters.best:.0%}"
        self.console.say(f"validation at step {counters.env_steps}: success {measured['success_rate']:.0%} ({best})")

    def save(self, state: TrainState) -> None:
        """Write a checkpoint, unless this step has one."""
        counters = self.counters
        if self.saved:
            return
        self._refuse_non_finite(state)
        rest, ring = self._layout.gather(state.split()[0]), state.ring()
        with counters.timed("checkpoint"):
            written = self._write(
                "checkpoint",
                lambda: save(
                    self.folder.checkpoints, counters.env_steps, rest, ring, dict(vars(counters)), policy=POLICY
                ),
            )
        self._tried_to_save_at = counters.total_seconds
        if processes.agreed(written):
            self._saved_at, self._unsaved = counters.env_steps, False

    def _refuse_non_finite(self, state: TrainState) -> None:
        """Raise before a loss that is not finite is logged or saved; it stays in the sum, so none is missed."""
        loss = float(state.learning.metrics["train/loss"])
        if not math.isfinite(loss):
            raise FloatingPointError(
                f"the loss is {loss} at step {self.counters.env_steps}; the last checkpoint is of step "
                f"{self._saved_at}; a smaller learner.learning_rate may help"
            )

    def _write(self, what: str, write: Callable[[], object]) -> bool:
        """Write a file; a full disk is reported, and the training goes on. Return whether it was written."""
        last = "there is none yet" if self._saved_at < 0 else f"the last checkpoint is of step {self._saved_at}"
        return self.folder.attempt(what, write, step=self.counters.env_steps, say=self.console.say, consequence=last)
