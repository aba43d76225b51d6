"""The process of `pregrasp-jax train` in the world without physics, in which something happens at a chosen moment.

    python driver.py {kill,wait} MOMENT COUNT ARGUMENTS_OF_TRAIN

MOMENT is `collect`, `update`, or how the name of a file ends; COUNT says which call or which such file. A file is
half written when the process kills itself or waits for a line on standard input; a computation is under way.
"""

import conftest  # noqa: F401  (the settings and the compiled programs of the tests)

# isort: split
import dataclasses
import io as text_io
import itertools
import os
import signal
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import fake_training

from pregrasp_jax import io
from pregrasp_jax.cli import main as program
from pregrasp_jax.training import session
from pregrasp_jax.training.program import Program


def kill() -> None:
    os.kill(os.getpid(), signal.SIGKILL)


def wait() -> None:
    print("waiting", flush=True)
    sys.stdin.readline()


def break_call(function: Callable[..., Any], count: int, happen: Callable[[], None]) -> Callable[..., Any]:
    """Let something happen right after the call number `count` was dispatched."""
    calls = itertools.count(1)

    def call(*args: Any) -> Any:
        result = function(*args)
        if next(calls) == count:
            happen()
        return result

    return call


def break_program(moment: str, count: int, happen: Callable[[], None]) -> None:
    compile_program = Program.compile

    def compile_broken(self: Program, state: Any) -> Program:
        program = compile_program(self, state)
        broken: Any = {moment: break_call(getattr(program, moment), count, happen)}
        return dataclasses.replace(program, **broken)

    Program.compile = compile_broken  # pyright: ignore[reportAttributeAccessIssue]


def break_file(ending: str, count: int, happen: Callable[[], None]) -> None:
    write_atomic, files = io.write_atomic, itertools.count(1)

    def write_broken(path: Path, write: Callable[[Any], object]) -> None:
        def write_half(file: Any) -> None:
            whole = text_io.BytesIO()
            write(whole)
            file.write(whole.getvalue()[: len(whole.getvalue()) // 2])
            file.flush()
            happen()

        broken = path.name.endswith(ending) and next(files) == count
        write_atomic(path, write_half if broken else write)

    io.write_atomic = write_broken


def main() -> int:
    what, moment, count, *arguments = sys.argv[1:]
    happen = {"kill": kill, "wait": wait}[what]
    (break_program if moment in ("collect", "update") else break_file)(moment, int(count), happen)
    world: Any = session
    world.make_env = lambda config, **_: fake_training.PictureEnv()
    world.make_program = lambda env, config, **_: fake_training.make_program(config, env)
    world.make_evaluate = lambda env, config: (fake_training.evaluate, lambda params: None)
    return program.main(["train", *arguments])


if __name__ == "__main__":
    sys.exit(main())
