"""Processes that work on meshes, whatever program asked for them."""

import contextlib
import multiprocessing
import sys
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ProcessPoolExecutor
from types import ModuleType
from typing import Any


class WorkerPool(ProcessPoolExecutor):
    """A pool of spawned processes that do not run the main module of the program again.

    By default they would, which fails where it came from standard input, and starts everything anew in a script whose
    entry point is not guarded. What they are asked to do must live in a module.
    """

    def __init__(self, width: int):
        """Start no process yet."""
        super().__init__(width, mp_context=multiprocessing.get_context("spawn"))

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future:
        """Start a process if all are busy, and have it call a function."""
        with _hidden_main():
            return super().submit(fn, *args, **kwargs)


@contextlib.contextmanager
def _hidden_main() -> Iterator[None]:
    """Hide where the main module came from, which is what a spawned process is told to run."""
    main = sys.modules["__main__"]
    sys.modules["__main__"] = ModuleType("__main__")
    try:
        yield
    finally:
        sys.modules["__main__"] = main
