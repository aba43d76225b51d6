"""Progress of an evaluation: a live bar on a terminal, plain lines elsewhere."""

import sys
import time
from types import TracebackType
from typing import TextIO

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn

from pregrasp_jax.training.console import format_time

PLAIN_INTERVAL = 10.0
"""s between plain lines."""


class EpisodeProgress:
    """Shows episodes done, successes and the time left; call it with what an `evaluation.Progress` is told."""

    def __init__(self, stream: TextIO | None = None):
        """Choose live or plain.

        Args:
            stream: standard error if None, so that standard output holds results only.
        """
        self._console = Console(file=stream or sys.stderr, highlight=False, soft_wrap=True)
        self._progress = Progress(
            TextColumn("{task.percentage:3.0f} %"),
            BarColumn(bar_width=24),
            TextColumn("{task.description}", markup=False),
            console=self._console,
            disable=not self._console.is_terminal,
            transient=True,
        )
        self._task = self._progress.add_task("waiting for the first episodes", total=1.0)
        self._last_line = time.monotonic()
        self._first: tuple[float, int] | None = None

    def __enter__(self) -> "EpisodeProgress":
        """Show the bar."""
        self._progress.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Remove the bar."""
        self._progress.stop()

    def say(self, line: str) -> None:
        """Print one line above the bar."""
        self._console.print(line, markup=False)

    def __call__(self, done: int, total: int, successes: int) -> None:
        """Report that `done` of `total` episodes have ended, `successes` of them well."""
        now = time.monotonic()
        # Timed from the first report, so that compilation is not mistaken for slow episodes.
        self._first = self._first or (now, done)
        text = describe(done, total, successes, time_left(now, done, total, self._first))
        self._progress.update(self._task, completed=done / total, description=text)
        if not self._console.is_terminal and (done == total or now - self._last_line >= PLAIN_INTERVAL):
            self._last_line = now
            self.say(text)


def time_left(now: float, done: int, total: int, first: tuple[float, int]) -> float | None:
    """Return the s left if episodes go on like those since the `first` (time, done); None if there are none."""
    start, done_before = first
    return None if done == done_before else (now - start) * (total - done) / (done - done_before)


def describe(done: int, total: int, successes: int, left: float | None) -> str:
    """Return one line; `left` in s."""
    return f"episode {done} of {total} | success {100 * successes / done:.0f} % | left {format_time(left)}"
