"""The worker: brings one trial to a rung or to its end, in a process that any launcher can start anywhere.

It starts the training, or lets it go on, follows its metrics, and stops it by SIGTERM where a rung is reached. It can
be killed at any moment: the training then stops by itself, and the next worker goes on with it.
"""

import ctypes
import json
import math
import os
import signal
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import FrameType
from typing import Any, BinaryIO

from pregrasp_jax.sweep import state
from pregrasp_jax.sweep.folder import SweepFolder
from pregrasp_jax.sweep.spec import Spec
from pregrasp_jax.sweep.trials import Trial, evaluate_command, evaluation_files, train_command

BUSY = 75
"""Exit code of a worker whose trial another one works on."""

UNWRITTEN = 74
"""Exit code of a worker that could not write down how it ended."""

PATIENCE = 2.0
"""s in which a lock may become free: to ask whether a trial is running takes it for an instant."""

ATTEMPTS = 10
"""Times that a worker tries to write down how it ended, half a minute in all, before the driver hears of it."""

POLL = 0.2
"""s between two looks at a training."""

_SIGNALLED = (128 + signal.SIGTERM, 128 + signal.SIGINT, -signal.SIGTERM, -signal.SIGINT)
_EXIT_CODES = {state.DONE: 0, state.RUNG: 0, state.REFUSED: 2, state.STOPPED: 143, state.FAILED: 1}
_PR_SET_PDEATHSIG = 1


@dataclass
class _Ending:
    """How a session ended."""

    outcome: str
    code: int = 0
    message: str = ""


class Worker:
    """One session of one trial."""

    def __init__(self, folder: SweepFolder, spec: Spec, trial: Trial, *, rung: int | None, cores: Sequence[int] = ()):
        """Start nothing yet.

        Args:
            folder: of the sweep.
            spec: of the sweep.
            trial: which one.
            rung: env steps at which to stop; None trains to the end and runs the tests.
            cores: those that the trial may use; none leaves it to whoever started this process.
        """
        self.folder, self.spec, self.trial, self.rung = folder, spec, trial, rung
        self.run_dir = folder.run(trial)
        self._cores = cores
        self._asked_to_stop = False
        self._told = False
        self._lock_fd = -1
        self._size_seen = -1

    def run(self) -> int:
        """Return the exit code: 0 done or at the rung, 1 failed, 2 refused, 143 stopped, or `BUSY`, `UNWRITTEN`."""
        for number in (signal.SIGTERM, signal.SIGINT):
            signal.signal(number, self._ask_to_stop)
        try:
            with self.folder.hold(self.trial, patience=PATIENCE) as self._lock_fd:
                now = next(s for s in self.folder.states() if s.trial.id == self.trial.id)
                trained = now.outcome == state.DONE
                if now.settled(self.rung) and not (trained and self.folder.lacks_tests(self.spec, self.trial)):
                    return 0
                if self.folder.stopping:
                    return _EXIT_CODES[state.STOPPED]
                return self._session(trained)
        except BlockingIOError:
            return BUSY

    def _session(self, trained: bool) -> int:
        if self._cores and hasattr(os, "sched_setaffinity"):
            os.sched_setaffinity(0, self._cores)
        start = time.monotonic()
        if not self._record({"event": "started", "id": self.trial.id, "rung": self.rung}):
            return UNWRITTEN
        ending = self._work(trained)
        event = {"event": "ended", "id": self.trial.id, "rung": self.rung, "outcome": ending.outcome}
        event |= {"exit_code": ending.code, "message": ending.message, "seconds": round(time.monotonic() - start, 1)}
        rows, metric = read_metrics(self.run_dir), self.spec.stop.metric
        at = {str(rung): measured(rows, metric, rung)["score"] for rung in state.rungs(self.spec)}
        known = {"scores": {rung: score for rung, score in at.items() if score is not None}}
        written = self._record(event | measured(rows, metric, None) | known)
        return _EXIT_CODES[ending.outcome] if written else UNWRITTEN

    def _work(self, trained: bool) -> _Ending:
        if self.trial.policy is None and not trained:
            ending = self._train()
            if ending.outcome != state.DONE:
                return ending
        for name, file in evaluation_files(self.spec, self.trial, self.run_dir).items():
            if not file.exists():
                ending = self._ended(self._call(evaluate_command(self.spec, self.trial, name, self.run_dir)))
                if ending.outcome != state.DONE:
                    return ending
                if not file.exists():
                    return _Ending(state.FAILED, message=f"the test {name} has ended well, and not written {file}")
        return _Ending(state.DONE)

    def _train(self) -> _Ending:
        if self._at_rung():
            return _Ending(state.RUNG)
        code = self._call(train_command(self.spec, self.trial, self.run_dir), watched=True)
        stopped = code in _SIGNALLED or (self._told and code == 0)  # a program may not say that it was stopped
        if stopped and not self._asked_to_stop and self._at_rung():
            return _Ending(state.RUNG, code)
        return _Ending(state.STOPPED, code) if stopped else self._ended(code)

    def _ended(self, code: int) -> _Ending:
        if code == 0:
            return _Ending(state.DONE)
        if self._asked_to_stop or code in _SIGNALLED:
            return _Ending(state.STOPPED, code)
        return _Ending(state.REFUSED if code == 2 else state.FAILED, code, _last_words(self.folder.log(self.trial)))

    def _call(self, command: Sequence[str], *, watched: bool = False) -> int:
        """Run a command and return its exit code; ask it to stop once, at the rung or when this process is asked."""
        with self.folder.log(self.trial).open("ab") as log:
            try:
                child = self._open(command, log)
            except OSError as error:
                log.write(f"error: {command[0]} cannot be run ({error.strerror}); allowed is a program\n".encode())
                return 2
            self._told = False
            while (code := child.poll()) is None:
                stop = self._asked_to_stop or self.folder.stopping or (watched and self._grown() and self._at_rung())
                if stop and not self._told:
                    child.terminate()
                    self._told = True
                    self._asked_to_stop = self._asked_to_stop or self.folder.stopping
                time.sleep(POLL)
        return code

    def _open(self, command: Sequence[str], log: BinaryIO) -> subprocess.Popen[bytes]:
        return subprocess.Popen(
            command,
            stdin=subprocess.DEVNULL,
            stdout=log,
            stderr=subprocess.STDOUT,
            cwd=self.folder.cwd,
            env=environment(os.environ, self.spec),
            start_new_session=True,  # Ctrl-C is for the driver; a second signal would end a training at once
            pass_fds=(self._lock_fd,),
            preexec_fn=_die_with_parent if sys.platform == "linux" else None,
        )

    def _grown(self) -> bool:
        """Return whether there are new metrics since this was last asked."""
        file = self.run_dir / "metrics.jsonl"
        before, self._size_seen = self._size_seen, file.stat().st_size if file.is_file() else -1
        return self._size_seen != before

    def _at_rung(self) -> bool:
        metric = self.spec.stop.metric
        return self.rung is not None and measured(read_metrics(self.run_dir), metric, self.rung)["score"] is not None

    def _record(self, event: Mapping[str, Any]) -> bool:
        """Write an event down; a full disk is given half a minute. Return whether it was written."""
        for attempt in range(ATTEMPTS):
            try:
                self.folder.append(event)
                return True
            except OSError as error:
                print(
                    f"warning: {self.folder.path}: {error.strerror}; nothing is lost, the trial goes on",
                    file=sys.stderr,
                )
                time.sleep(min(attempt, 5) if not self._asked_to_stop else 0)
        return False

    def _ask_to_stop(self, number: int, frame: FrameType | None) -> None:
        self._asked_to_stop = True


def environment(base: Mapping[str, str], spec: Spec) -> dict[str, str]:
    """Return the environment of a trial: its share of a GPU, or as jax would have it."""
    if not 0 < spec.resources.gpu < 1:
        return dict(base)
    # jax would take three quarters of the device for each.
    return {**base, "XLA_PYTHON_CLIENT_MEM_FRACTION": f"{0.9 * spec.resources.gpu:.3f}"}


def read_metrics(run_dir: Path) -> list[dict[str, Any]]:
    """Return the rows of a run's metrics.jsonl so far, without what is cut or damaged."""
    file = run_dir / "metrics.jsonl"
    rows = []
    for line in file.read_text(errors="replace").splitlines() if file.is_file() else ():
        try:
            row = json.loads(line)
        except ValueError:
            continue
        if isinstance(row, dict) and isinstance(row.get("env_steps"), int):
            rows.append(row)
    return rows


def measured(rows: Sequence[Mapping[str, Any]], metric: str, rung: int | None) -> dict[str, Any]:
    """Return the best that was measured up to a rung, which is the policy that a run keeps.

    Args:
        rows: of metrics.jsonl.
        metric: which, more is better.
        rung: env steps; None takes all rows.

    Returns:
        score, None if the rung was not reached; its mean motions, and the env steps so far.
    """
    tested = [row for row in rows if _finite(row.get(metric))]
    at = next((i for i, row in enumerate(tested) if rung is not None and row["env_steps"] >= rung), None)
    steps = max((row["env_steps"] for row in rows), default=0)
    if rung is not None and at is None:
        return {"score": None, "motions": None, "env_steps": steps}
    known = tested if at is None else tested[: at + 1]
    best = max(known, key=lambda row: (row[metric], row["env_steps"]), default={})
    motions = best.get("eval/mean_motions")
    return {"score": best.get(metric), "motions": motions if _finite(motions) else None, "env_steps": steps}


def _finite(value: Any) -> bool:
    """Return whether a value of a row is a number; a program's own rows may hold NaN, which says nothing."""
    return isinstance(value, int | float) and math.isfinite(value)


def _last_words(log: Path) -> str:
    """Return the last line that a trial said, its error if it was one."""
    with log.open("rb") as file:
        file.seek(max(0, log.stat().st_size - 4096))
        lines = file.read().decode(errors="replace").split("\n")
    said = [line.strip() for line in lines if line.strip()]
    errors = [line for line in said if line.startswith("error:")]
    return (errors or said or ["it said nothing"])[-1][:500]


def _die_with_parent() -> None:
    """Have this process asked to stop when the one that started it is gone."""
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGTERM)
