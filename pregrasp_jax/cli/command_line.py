"""Errors of a command line in one line, exit code 2, no traceback."""

import contextlib
import functools
import io as text_io
import re
import sys
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from typing import TypeVar

from pregrasp_jax import io

T = TypeVar("T")

USAGE_ERROR, INTERRUPTED = 2, 130
"""Exit codes of a command that was asked for something impossible, and of one that Ctrl-C has ended."""

READER_GONE = 128 + 13
"""The same of one whose reader has gone: what a shell says of a program that SIGPIPE has ended."""


def parse(parser: Callable[[], T]) -> T:
    """Return what a tyro parser returns; its boxed error message becomes one line.

    Raises:
        SystemExit: the arguments are wrong (2), or help was asked for (0).
    """
    complaint = text_io.StringIO()
    try:
        with contextlib.redirect_stderr(complaint):
            return parser()
    except SystemExit as error:
        if error.code:
            print(f"error: {unbox(complaint.getvalue())}", file=sys.stderr)
        raise


def refuse_repeated(options: Sequence[str]) -> None:
    """Refuse an option that is given more than once, in either spelling: tyro would drop all but the last.

    Raises:
        ValueError: the name, and how often it is there.
    """
    names = (option.partition("=")[0].replace("_", "-") for option in options if option.startswith("--"))
    for name, times in Counter(names).items():
        if times > 1:
            raise ValueError(f"{name} is given {times} times; allowed is once")


def deferred(function: Callable[..., int | None]) -> Callable[..., Callable[[], int | None]]:
    """Return a function with the same options that returns the call instead of making it."""

    @functools.wraps(function)
    def bind(*args: object, **options: object) -> Callable[[], int | None]:
        return functools.partial(function, *args, **options)

    return bind


def unbox(text: str) -> str:
    """Return what a tyro error box (of lines, or of dashes where the encoding is poor) says, in one line.

    The frame, the title and the help text go; of suggestions, the first stays.
    """
    lines = [line.strip("│╭╮╰╯─ ") for line in text.splitlines()]
    sections = _sections([line if line.strip("-") else "" for line in lines])
    message = " ".join(sections[0]) if sections else "the arguments cannot be read"
    offers = [" ".join(lines) for lines in sections[1:] if lines[0].startswith("Available")]
    offers += [line for section in sections[1:] for line in section if re.match(r"--[a-z]", line)]
    return f"{message} ({offers[0]})" if offers and "nrecognized" in message else message


@contextlib.contextmanager
def one_line_errors() -> Iterator[None]:
    """Turn a refusal (ValueError, FileNotFoundError, ...) into one line on standard error and exit code 2.

    Errors of several lines come from libraries, not from this package's checks, and keep their traceback. Where the
    reader of the output has gone (`| head`), the command ends without a word, as others do.
    """
    try:
        try:
            yield
        finally:
            sys.stdout.flush()
    except BrokenPipeError:
        io.discard(sys.stdout)
        sys.exit(READER_GONE)
    except (ValueError, OSError, FloatingPointError) as error:
        if "\n" in str(error):
            raise
        print(f"error: {error}", file=sys.stderr)
        sys.exit(USAGE_ERROR)


def _sections(lines: list[str]) -> list[list[str]]:
    """Return the groups of lines between empty ones, without the title, which comes first."""
    sections: list[list[str]] = [[]]
    title = next((i for i, line in enumerate(lines) if line), len(lines))
    for line in lines[title + 1 :]:
        if line:
            sections[-1].append(line)
        else:
            sections.append([])
    return [section for section in sections if section]
