"""Ctrl-C and SIGTERM: the first asks the loop to stop, the second ends the process at once."""

import os
import signal
import socket
import threading
from collections.abc import Callable
from types import FrameType

SIGNALS = (signal.SIGINT, signal.SIGTERM)

SECONDS_TO_ANSWER = 1.0
"""How long the end of a loop, or of the process, waits for the console; one that takes nothing is left then."""

_ANSWER = "stopping: this step is finished and a checkpoint is written; a second signal ends at once"


class Interrupt:
    """Listens for signals while it is entered (in the main thread).

    Python runs signal handlers between bytecodes, so a compilation or a batch of pushes would delay an answer
    by seconds. The interpreter's wake-up file descriptor is written by the C handler itself: a thread that reads it
    answers immediately. What it says has a thread of its own: a terminal that is paused, or a pipe that nobody reads,
    must not keep the second signal from being heard. Ending at once is safe because every file of a run is written
    beside and renamed.
    """

    def __init__(self, say: Callable[[str], None], before_exit: Callable[[], None] = lambda: None):
        """Listen to nothing yet.

        Args:
            say: tells the user that the signal was understood.
            before_exit: restores the terminal before the process ends at the second signal.
        """
        self._say = say
        self._before_exit = before_exit
        self._signal: int | None = None
        self._answer: threading.Thread | None = None

    @property
    def exit_code(self) -> int | None:
        """128 + the signal that asked to stop; None if none did."""
        return None if self._signal is None else 128 + self._signal

    def __enter__(self) -> "Interrupt":
        """Start to listen."""
        self._reader, self._writer = socket.socketpair()
        self._writer.setblocking(False)
        self._old_handlers = {number: signal.signal(number, _ignore) for number in SIGNALS}
        self._old_fd = signal.set_wakeup_fd(self._writer.fileno(), warn_on_full_buffer=False)
        self._thread = threading.Thread(target=self._listen, daemon=True)
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        """Stop listening; an answer under way is finished, lest the interpreter ends while its line is written."""
        signal.set_wakeup_fd(self._old_fd)
        for number, handler in self._old_handlers.items():
            signal.signal(number, handler)
        self._writer.close()
        self._thread.join(SECONDS_TO_ANSWER)
        if self._answer is not None:
            self._answer.join(SECONDS_TO_ANSWER)

    def _listen(self) -> None:
        with self._reader:
            while number := self._reader.recv(1):
                if number[0] in SIGNALS:
                    self._obey(number[0])

    def _obey(self, number: int) -> None:
        if self._signal is not None:
            _start(self._before_exit).join(SECONDS_TO_ANSWER)
            os._exit(128 + number)
        self._signal = number
        self._answer = _start(lambda: self._say(_ANSWER))


def _start(call: Callable[[], None]) -> threading.Thread:
    thread = threading.Thread(target=call, daemon=True)
    thread.start()
    return thread


def _ignore(number: int, frame: FrameType | None) -> None:
    """Python-level handler; without one the C handler would not write to the file descriptor."""
