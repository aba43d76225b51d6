"""The driver: starts workers as long as there is something to do.

It decides by trials.jsonl and the locks alone, so it may be killed.
"""

import signal
import time
from collections import Counter
from collections.abc import Callable, Sequence
from types import FrameType

from pregrasp_jax.messages import command
from pregrasp_jax.sweep import checks, estimate, state
from pregrasp_jax.sweep.folder import SweepFolder
from pregrasp_jax.sweep.launchers import Launcher
from pregrasp_jax.sweep.spec import Spec
from pregrasp_jax.sweep.state import Job, TrialState
from pregrasp_jax.sweep.study import Study
from pregrasp_jax.sweep.trials import Trial, final_trials, setting_trials, trial_config
from pregrasp_jax.sweep.worker import BUSY, UNWRITTEN
from pregrasp_jax.training.console import format_time

Say = Callable[[str], None]

POLL = 0.2
"""s between two looks at the workers."""

SAY_EVERY = 30.0
"""s between two lines of progress, unless something has ended."""

LOST_WORKERS = 5
"""Workers in a row that end without a word before the driver gives up."""


class Driver:
    """Drives a sweep on a launcher until nothing is left to do, or it is asked to stop."""

    def __init__(self, folder: SweepFolder, spec: Spec, launcher: Launcher, *, say: Say = print):
        """Start nothing yet.

        Args:
            folder: of the sweep.
            spec: of the sweep.
            launcher: where to.
            say: told about progress.
        """
        self.folder, self.spec, self.launcher, self.say = folder, spec, launcher, say
        self._study = Study(folder.path, spec) if spec.search.method == "tpe" else None
        self._submitted: dict[str, int] = {}  # trial id -> how often it had ended
        self._lost: Counter[str] = Counter()
        self._signal = 0
        self._said = 0.0

    def run(self) -> int:
        """Return 0 when all is done, 1 if trials have failed, 128 + signal (143 for `sweep stop`) if asked to stop.

        Raises:
            ValueError: another driver is at work, or nothing can be written.
        """
        old = {number: signal.signal(number, self._listen) for number in (signal.SIGTERM, signal.SIGINT)}
        try:
            with self.folder.drive():
                plan(self.folder, self.spec)
                return self._loop()
        finally:
            self.launcher.close()
            for number, handler in old.items():
                signal.signal(number, handler)

    def _loop(self) -> int:
        while True:
            states = self._collect()
            if self._signal or self.folder.stopping:
                return self._stop()
            jobs = [job for job in self._jobs(states) if job.trial.id not in self._submitted]
            others = {job.trial.id for job in jobs if self.folder.is_running(job.trial)}
            ready = [job for job in jobs if job.trial.id not in others]
            room, endings = self._room(len(others), states), {s.trial.id: s.endings for s in states}
            for job in ready[:room]:
                self._submitted[job.trial.id] = endings[job.trial.id]
                self.launcher.submit(job)
            idle = room - len(ready)
            if idle > 0 and self._propose(states):
                continue
            if not (jobs or self._submitted):
                if plan_finals(self.folder, self.spec):
                    continue
                self._tell(states, ended=True)
                return 1 if any(s.failed for s in states) else 0
            time.sleep(POLL)

    def _jobs(self, states: Sequence[TrialState]) -> list[Job]:
        """Return what can be done now; at the end, tests that finished trials lack."""
        done = (s.trial for s in states if s.outcome == state.DONE)
        return state.next_jobs(self.spec, states) or [
            Job(trial, None) for trial in done if self.folder.lacks_tests(self.spec, trial)
        ]

    def _collect(self) -> list[TrialState]:
        """Take note of the workers that have ended, and return the states."""
        ended = self.launcher.ended()
        states = self.folder.states()
        for trial_id, code in ended:
            self._note_lost(trial_id, code, states)
        self._tell(states, ended=bool(ended))
        return states

    def _note_lost(self, trial_id: str, code: int, states: Sequence[TrialState]) -> None:
        """Give up where workers end again and again without writing anything down."""
        before, now = self._submitted.pop(trial_id), next(s.endings for s in states if s.trial.id == trial_id)
        spoke = now > before or code == BUSY or (code == 143 and self._signal)
        self._lost[trial_id] = 0 if spoke else self._lost[trial_id] + 1
        if code == UNWRITTEN and self._lost[trial_id] > 1:
            raise ValueError(
                f"nothing can be written to {self.folder.path}: the disk is full; nothing is lost, "
                f"`{command('sweep', 'resume', self.folder.path)}` goes on when there is room"
            )
        if self._lost[trial_id] >= LOST_WORKERS:
            trial = next(s.trial for s in states if s.trial.id == trial_id)
            raise ValueError(f"{LOST_WORKERS} workers of trial {trial.number} ended without a word (exit code {code})")

    def _room(self, others: int, states: Sequence[TrialState]) -> int:
        """Return how many workers may be started; until the first training runs, one: the next ones find its cache."""
        under_way = len(self._submitted) + others
        warm = any(s.outcome for s in states) or any(self._has_metrics(s.trial) for s in states if s.begun)
        slots = self.launcher.slots if warm else min(1, self.launcher.slots)
        return max(0, slots - under_way)

    def _has_metrics(self, trial: Trial) -> bool:
        return (self.folder.run(trial) / "metrics.jsonl").exists()

    def _propose(self, states: Sequence[TrialState]) -> bool:
        """Plan one more setting of a search that learns; return whether there was one."""
        if self._study is None:
            return False
        self._study.learn(states)
        varied, proposal = self._study.propose(states)
        if varied is None:
            return False
        self.folder.plan(lambda _: setting_trials(self.spec, varied, proposal=proposal))
        return True

    def _stop(self) -> int:
        """Ask the workers to stop, wait for them, and return the exit code."""
        self.say("stopping: trainings finish their step and write a checkpoint")
        self.launcher.stop()
        while self._submitted:
            for trial_id, _ in self.launcher.ended():
                self._submitted.pop(trial_id)
            time.sleep(POLL)
        self.say(f"stopped; `{command('sweep', 'resume', self.folder.path)}` goes on")
        return 128 + (self._signal or signal.SIGTERM)

    def _tell(self, states: Sequence[TrialState], *, ended: bool) -> None:
        now = time.monotonic()
        if ended or now - self._said >= SAY_EVERY:
            self._said = now
            self.say(progress_line(self.spec, states, running=len(self._submitted), slots=self.launcher.slots))

    def _listen(self, number: int, frame: FrameType | None) -> None:
        self._signal = number
        signal.signal(number, signal.SIG_DFL)  # a second one ends the driver at once; the workers stop by themselves


def plan(folder: SweepFolder, spec: Spec) -> None:
    """Write down all trials that are known from the start, once."""
    settings = checks.settings_of(spec) or ()
    folder.plan(lambda _: [trial for varied, about in settings for trial in setting_trials(spec, varied, **about)])


def plan_finals(folder: SweepFolder, spec: Spec) -> bool:
    """Write down the fresh seeds of the winners; return whether there are new ones."""
    if not spec.final.seeds:
        return False
    return folder.plan(lambda states: final_trials(spec, state.winners(spec, states)))


def progress_line(spec: Spec, states: Sequence[TrialState], *, running: int, slots: int) -> str:
    """Return how far a sweep is, in one line; `slots` trials are done at a time."""
    counts = Counter(status(spec, states).values())
    parts = [f"{counts['done']} of {len(states)} trials done", f"{running} running"]
    parts += [f"{counts[name]} {name}" for name in ("paused", "dropped", "failed", "refused") if counts[name]]
    best = max((s for s in states if s.score is not None), key=lambda s: s.score or 0.0, default=None)
    if best is not None:
        parts.append(f"best {spec.stop.metric} {best.score:.3g} ({best.trial.label}, seed {best.trial.seed})")
    parts.append(f"left about {format_time(seconds_left(spec, states) / max(1, slots))}")
    return " | ".join(parts)


def seconds_left(spec: Spec, states: Sequence[TrialState]) -> float:
    """Return the time that what is left takes, one trial after the other, by the speed of those that are done.

    Nothing is known of settings that halving will give up, nor of those that are not planned yet.
    """
    done = [s for s in states if s.outcome == state.DONE]
    gone = state.dropped(spec, states)
    left = 0.0
    for s in states:
        if s.over or s.trial.id in gone or s.trial.policy is not None:
            continue
        alike = [d.seconds for d in done if d.trial.policy is None]
        whole = state.mean(alike) if alike else estimate.seconds_of(spec, s.trial.settings)
        length = trial_config(spec, s.trial.settings).train.env_steps
        left += whole * (1 - min(1.0, s.env_steps / length) if length else 1.0)
    return left


def status(spec: Spec, states: Sequence[TrialState], running: Sequence[str] = ()) -> dict[str, str]:
    """Return one word for every trial, by id."""
    gone = state.dropped(spec, states)
    return {s.trial.id: "running" if s.trial.id in running else _word(s, s.trial.id in gone) for s in states}


def _word(now: TrialState, gone: bool) -> str:
    if gone:
        return "dropped"
    if now.outcome == state.REFUSED or now.outcome == state.DONE:
        return now.outcome
    if now.over:
        return "failed"
    if now.outcome in (state.RUNG, state.STOPPED, state.FAILED):
        return "paused"
    return "interrupted" if now.begun else "waiting"
