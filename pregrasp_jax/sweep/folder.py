"""The folder of a sweep: what is to be done and what was done, as a file to which lines are only ever added.

DIR/: spec.yaml; trials.jsonl, one event a line; runs/ID, ordinary run folders; logs/ID.log, what they said; locks/;
stop, while the sweep has been asked to stop; optuna.log of a search that learns; table.json, table.csv, report.html.

Several processes add to trials.jsonl, perhaps on several hosts. Who works on a trial holds its lock, and so does the
training that it started: a lock is free when both have ended, however that happened.
"""

import dataclasses
import fcntl
import json
import os
import socket
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TextIO

from pregrasp_jax import io, yaml_file
from pregrasp_jax.messages import command
from pregrasp_jax.sweep.spec import Spec, read_spec, spec_from, to_plain
from pregrasp_jax.sweep.state import Record, TrialState, read_states
from pregrasp_jax.sweep.trials import Trial, evaluation_files

SPEC, TRIALS, STOP = "spec.yaml", "trials.jsonl", "stop"

_FOR_EVER = 600.0
"""s; nobody holds the lock of trials.jsonl longer than it takes to write a line."""

CHANGEABLE = ("resources", "slurm", "final", "tests", "program")
"""Parts of a spec that may change when a sweep goes on: they change no trial that there is."""


class SweepFolder:
    """A sweep on disk; `create` one or `open` it."""

    def __init__(self, path: Path):
        """Read nothing yet."""
        self.path = path.absolute()

    @staticmethod
    def refuse_used(path: Path) -> None:
        """Refuse a folder that no sweep can begin in.

        Raises:
            ValueError: it holds something, or cannot be written.
        """
        if (path / SPEC).exists():
            raise ValueError(f"{path} already holds a sweep; go on with `{command('sweep', 'resume', path)}`")
        if path.exists() and (not path.is_dir() or any(path.iterdir())):
            raise ValueError(f"{path} is not empty and holds no sweep; allowed is a new or empty folder")
        io.refuse_unwritable(path / SPEC)

    @classmethod
    def create(cls, path: Path, spec: Spec) -> "SweepFolder":
        """Begin a sweep.

        Raises:
            ValueError: the folder holds something, or cannot be written.
        """
        cls.refuse_used(path)
        folder = cls(path)
        for name in ("runs", "logs", "locks"):
            (folder.path / name).mkdir(parents=True, exist_ok=True)
        folder.append({"event": "sweep", "spec": to_plain(spec), "cwd": str(Path.cwd())})
        io.write_bytes(folder.path / SPEC, yaml_file.dump(to_plain(spec)))
        return folder

    @classmethod
    def open(cls, path: Path) -> "SweepFolder":
        """Return a sweep that is there.

        Raises:
            ValueError: there is none.
        """
        if not (path / SPEC).is_file():
            raise ValueError(f"{path} is not a sweep (it has no {SPEC}); allowed is the --dir of `sweep start`")
        return cls(path)

    def spec(self) -> Spec:
        """Return the spec, as it may have been edited.

        Raises:
            ValueError: it is damaged, or edited where it must not be.
        """
        spec, begun = read_spec(self.path / SPEC), self._first()["spec"]
        try:
            first = spec_from(begun)
        except ValueError as error:
            raise ValueError(f"{self.path / TRIALS}: {error}") from None
        for key in to_plain(spec).keys() | to_plain(first).keys():
            if key not in CHANGEABLE and getattr(spec, key) != getattr(first, key):
                raise ValueError(
                    f"{self.path / SPEC}: {key} is not what the sweep began with; allowed to change: "
                    f"{', '.join(CHANGEABLE)}; anything else is a new sweep"
                )
        return spec

    def edit(self, **parts: Any) -> None:
        """Change parts of the spec, of those that may change."""
        io.write_bytes(self.path / SPEC, yaml_file.dump(to_plain(dataclasses.replace(self.spec(), **parts))))

    @property
    def cwd(self) -> Path:
        """Where the sweep was started, to which relative paths refer."""
        there = Path(self._first()["cwd"])
        return there if there.is_dir() else self.path

    def run(self, trial: Trial) -> Path:
        """Return the run folder of a trial."""
        return self.path / "runs" / trial.id

    def log(self, trial: Trial) -> Path:
        """Return the file of what a trial has said."""
        return self.path / "logs" / f"{trial.id}.log"

    def lacks_tests(self, spec: Spec, trial: Trial) -> bool:
        """Return whether a trial that is done has tests to go through: of a spec that was edited since."""
        return any(not file.exists() for file in evaluation_files(spec, trial, self.run(trial)).values())

    def append(self, event: Mapping[str, Any]) -> None:
        """Add an event, whole or not at all; a last line that a crash has cut is removed first.

        Raises:
            OSError: the disk is full.
        """
        with self._locked_file("trials", patience=_FOR_EVER):
            self._append(event)

    def plan(self, trials_of: Callable[[Sequence[TrialState]], Iterable[Trial]]) -> bool:
        """Add the trials that are not planned yet, all or none of them, and number them; return whether there are any.

        Args:
            trials_of: makes trials from those that there are. Nobody else adds any meanwhile.

        Raises:
            OSError: the disk is full.
        """
        with self._locked_file("trials", patience=_FOR_EVER):
            states = self.states()
            known = {s.trial.id for s in states}
            new = [trial for trial in trials_of(states) if trial.id not in known]
            numbered = [dataclasses.replace(trial, number=len(states) + i) for i, trial in enumerate(new)]
            self._append(*({"event": "planned", "trial": trial.to_dict()} for trial in numbered))
        return bool(new)

    def _append(self, *events: Mapping[str, Any]) -> None:
        about = {"time": round(time.time(), 1), "host": socket.gethostname(), "pid": os.getpid()}
        _cut_partial_line(self.path / TRIALS)
        io.append_json_lines(self.path / TRIALS, *({**event, **about} for event in events))

    def events(self) -> list[Record]:
        """Return all events in order; a last line without an end is still being written."""
        file = self.path / TRIALS
        text = file.read_bytes() if file.is_file() else b""
        lines = text[: text.rfind(b"\n") + 1].splitlines()
        try:
            return [json.loads(line) for line in lines]
        except ValueError as error:
            raise ValueError(f"{file} is damaged ({error}); allowed is a copy of it") from None

    def states(self) -> list[TrialState]:
        """Return the trials in order and what became of them."""
        try:
            return read_states(self.events())
        except ValueError as error:
            raise ValueError(f"{self.path / TRIALS}: {error}; allowed is a copy of it that is whole") from None

    def is_running(self, trial: Trial) -> bool:
        """Return whether somebody works on a trial."""
        try:
            with self.hold(trial):
                return False
        except BlockingIOError:
            return True

    @contextmanager
    def hold(self, trial: Trial, *, patience: float = 0.0) -> Iterator[int]:
        """Hold the lock of a trial, and give its file descriptor for children that shall hold it too.

        Args:
            trial: which.
            patience: s to try for.

        Raises:
            BlockingIOError: another process holds it.
        """
        with self._locked_file(trial.id, patience=patience) as file:
            yield file.fileno()

    @contextmanager
    def drive(self) -> Iterator[None]:
        """Be the one that starts trials.

        Raises:
            ValueError: another process does.
        """
        try:
            with self._locked_file("driver") as file:
                file.truncate(0)
                file.write(f"process {os.getpid()} on {socket.gethostname()}")
                file.flush()
                yield
        except BlockingIOError:
            holder = (self.path / "locks" / "driver.lock").read_text().strip()
            raise ValueError(
                f"{self.path} is driven by {holder or 'another process'}; allowed is one at a time"
            ) from None

    @property
    def stopping(self) -> bool:
        """Whether the sweep has been asked to stop."""
        return (self.path / STOP).exists()

    def ask_to_stop(self, stop: bool) -> None:
        """Ask everybody who works on the sweep to stop, or take that back."""
        if stop:
            (self.path / STOP).touch()
        else:
            (self.path / STOP).unlink(missing_ok=True)

    def _first(self) -> Record:
        first = next(iter(self.events()), None)
        kinds = {"event": str, "spec": dict, "cwd": str}
        if not isinstance(first, dict) or any(not isinstance(first.get(key), kind) for key, kind in kinds.items()):
            raise ValueError(f"{self.path / TRIALS} is damaged: it does not begin with the sweep's settings")
        return first

    @contextmanager
    def _locked_file(self, name: str, *, patience: float = 0.0) -> Iterator[TextIO]:
        """Hold a file's lock, which comes back when the process ends, however it does.

        Raises:
            BlockingIOError: it is held, and was all the time.
        """
        file = self.path / "locks" / f"{name}.lock"
        file.parent.mkdir(parents=True, exist_ok=True)
        with file.open("a+") as opened:
            _lock(opened, patience)
            yield opened


def _lock(file: TextIO, patience: float) -> None:
    """Take a lock, trying again for `patience` seconds."""
    start = time.monotonic()
    while True:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            return
        except BlockingIOError:
            if time.monotonic() - start >= patience:
                raise
            time.sleep(0.02)


def _cut_partial_line(path: Path) -> None:
    if not path.exists() or not path.stat().st_size:
        return
    with path.open("rb+") as file:
        file.seek(-1, os.SEEK_END)
        if file.read(1) != b"\n":
            text = path.read_bytes()
            file.truncate(text.rfind(b"\n") + 1)
