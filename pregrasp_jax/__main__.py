"""Look at objects, scenes and runs, compare evaluations, repeat what diverged, ask what the machine offers."""

import functools
import sys
from collections.abc import Callable

import tyro

from pregrasp_jax.cli import commands
from pregrasp_jax.cli.demo import demo
from pregrasp_jax.cli.replay import replay_dump
from pregrasp_jax.cli.report import report
from pregrasp_jax.command_line import one_line_errors, parse

COMMANDS = {
    "assets": commands.assets,
    "compare": commands.compare,
    "demo": demo,
    "doctor": commands.doctor,
    "replay-dump": replay_dump,
    "report": report,
    "scenes": commands.scenes,
    "show": commands.show,
}


def main() -> None:
    """Parse a subcommand, then run it."""
    with one_line_errors():
        parsers = {name: _deferred(command) for name, command in COMMANDS.items()}
        options = {"prog": "python -m pregrasp_jax", "description": __doc__, "config": (tyro.conf.FlagConversionOff,)}
        parse(lambda: tyro.extras.subcommand_cli_from_dict(parsers, **options))()


def _deferred(command: Callable[..., None]) -> Callable[..., Callable[[], None]]:
    """Return a function with the command's options that returns the call instead of making it."""

    @functools.wraps(command)
    def bind(*args: object, **options: object) -> Callable[[], None]:
        return functools.partial(command, *args, **options)

    return bind


if __name__ == "__main__":
    try:
        main()
    except KeyboardInterrupt:
        sys.exit("interrupted")
