"""Progress of a training on the console: a live bar on a terminal, plain lines elsewhere."""

import sys
import time
from collections.abc import Callable
from typing import Any, TextIO

from rich.console import Console as RichConsole
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

from pregrasp_jax import io

PLAIN_INTERVAL = 10.0
"""s between plain lines: a log file is read, not watched."""


class _Forgiving:
    """A stream on which nothing fails: a log on a full disk, or a reader that has gone, must not stop a training."""

    def __init__(self, stream: TextIO):
        self._stream = stream

    def write(self, text: str) -> int:
        self._try(lambda: self._stream.write(text))
        return len(text)

    def flush(self) -> None:
        self._try(self._stream.flush)

    def _try(self, use: Callable[[], object]) -> None:
        try:
            use()
        except BrokenPipeError:
            io.discard(self._stream)
        except OSError:
            pass

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)


class Console:
    """Says what a training does, as long as somebody can hear it."""

    def __init__(self, stream: TextIO | None = None):
        """Choose live or plain.

        Args:
            stream: standard output if None.
        """
        heard: Any = _Forgiving(stream or sys.stdout)
        self._rich = RichConsole(file=heard, highlight=False, soft_wrap=True)
        self._last_line = -PLAIN_INTERVAL
        self._progress = Progress(
            TextColumn("{task.percentage:3.0f} %"),
            BarColumn(bar_width=24),
            TextColumn("{task.description}", markup=False),
            TimeElapsedColumn(),
            console=self._rich,
            disable=not self._rich.is_terminal,
            transient=True,
        )
        self._task = self._progress.add_task("waiting for the first episodes", total=1.0)

    def say(self, line: str) -> None:
        """Print one line above the bar."""
        self._rich.print(line, markup=False)

    def start(self) -> None:
        """Show the bar."""
        self._progress.start()

    def update(self, row: dict[str, Any], *, share: float, eta: float | None) -> None:
        """Show a row of metrics.

        Args:
            row: of metrics.jsonl.
            share: of the run that is done, 0 to 1.
            eta: s left; None if unknown.
        """
        self.show(describe(row, eta), share=share)

    def show(self, text: str, *, share: float) -> None:
        """Show how far a run is, `share` from 0 to 1, and any text beside it."""
        self._progress.update(self._task, completed=share, description=text)
        if not self._rich.is_terminal and time.monotonic() - self._last_line >= PLAIN_INTERVAL:
            self._last_line = time.monotonic()
            self.say(f"{100 * share:3.0f} % {text}")

    def close(self) -> None:
        """Remove the bar and give the cursor back."""
        self._progress.stop()


def describe(row: dict[str, Any], eta: float | None) -> str:
    """Return what matters of a row of metrics in one line."""
    parts = [
        f"step {row['env_steps']}",
        f"episode {row['episodes']}",
        f"success {_percent(row['train/success_rate'])}",
        f"epsilon {row['train/epsilon']:.2f}",
        f"loss {_number(row['train/loss'])}",
        f"{row['time/env_steps_per_second']:.1f} steps/s",
        f"left {format_time(eta)}",
    ]
    return " | ".join(parts)


def format_time(seconds: float | None) -> str:
    """Return seconds as h:mm:ss, or a question mark."""
    if seconds is None:
        return "?"
    minutes, second = divmod(round(seconds), 60)
    return f"{minutes // 60}:{minutes % 60:02d}:{second:02d}"


def _percent(share: float | None) -> str:
    return "?" if share is None else f"{100 * share:.0f} %"


def _number(value: float | None) -> str:
    return "?" if value is None else f"{value:.2g}"
