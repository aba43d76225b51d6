"""The program `pregrasp-jax`: its subcommands by name, each of which is imported when it is asked for."""

import pkgutil
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import tyro

import pregrasp_jax
from pregrasp_jax.cli.command_line import INTERRUPTED, deferred, one_line_errors, parse, refuse_repeated

PROGRAM = "pregrasp-jax"

_DESCRIPTION = """Train policies that rearrange clutter before grasping, evaluate them, and look at what they do.
`pregrasp-jax COMMAND --help` explains a command, `pregrasp-jax --version` says which version this is."""


@dataclass(frozen=True)
class Command:
    """A subcommand.

    Attributes:
        summary: one sentence of help.
        target: "module:function" whose parameters are the options, or, if `nested`, which returns such functions by
            name from the arguments.
        nested: whether the command has subcommands of its own.
        aliases: "module:dictionary" of other names of options.
    """

    summary: str
    target: str
    nested: bool = False
    aliases: str = ""


COMMANDS = {
    "assets": Command("List and draw the objects of a mesh folder.", "pregrasp_jax.cli.commands:assets"),
    "calibrate-check": Command("Say how well a calibration fits the table.", "pregrasp_jax.cli.deploy:calibrate_check"),
    "combine": Command("Make one policy of several.", "pregrasp_jax.cli.commands:combine"),
    "compare": Command("Compare two evaluations on the same scenes.", "pregrasp_jax.cli.commands:compare"),
    "contract": Command("Print what a bundle says about itself.", "pregrasp_jax.cli.export:contract"),
    "demo": Command("See the shipped policy at work, then train for minutes.", "pregrasp_jax.cli.demo:demo"),
    "deploy": Command("Run a bundle on a robot, or in simulation.", "pregrasp_jax.cli.deploy:deploy"),
    "doctor": Command("Say what this machine offers.", "pregrasp_jax.cli.commands:doctor"),
    "evaluate": Command(
        "Evaluate a policy on fixed test scenes.",
        "pregrasp_jax.cli.evaluate:evaluate_options",
        aliases="pregrasp_jax.cli.evaluate:ALIASES",
    ),
    "export": Command("Write a policy as a bundle that runs without JAX.", "pregrasp_jax.cli.export:export"),
    "replay-dump": Command("Repeat a push on which the physics diverged.", "pregrasp_jax.cli.replay:replay_dump"),
    "report": Command("Write the page of a run.", "pregrasp_jax.cli.report:report"),
    "reproduce": Command("Make a table or figure of the paper.", "pregrasp_jax.cli.reproduce:reproduce"),
    "scenes": Command("Describe and draw a bank of packed scenes.", "pregrasp_jax.cli.commands:scenes"),
    "show": Command("Draw one decision of a policy.", "pregrasp_jax.cli.commands:show"),
    "sweep": Command("Train many settings, and find the best.", "pregrasp_jax.cli.sweep:commands", nested=True),
    "train": Command("Train a policy, or continue a run.", "pregrasp_jax.cli.train:sessions", nested=True),
    "verify": Command("Compare every file of a bundle with its golden answers.", "pregrasp_jax.cli.export:verify"),
}


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a subcommand.

    Args:
        arguments: of the command line; those of this process if None.

    Returns:
        The exit code.

    Raises:
        SystemExit: help was asked for (0), or something impossible (2).
    """
    name, *options = (sys.argv[1:] if arguments is None else arguments) or [""]
    try:
        with one_line_errors():
            if name == "--version":
                print(f"{PROGRAM} {pregrasp_jax.__version__}")
                return 0
            if name not in COMMANDS:
                summaries = {known: _summary(command) for known, command in COMMANDS.items()}
                return _parse_nested(summaries, [name, *options] if name else [], PROGRAM, _DESCRIPTION)()
            return _bind(COMMANDS[name], options, f"{PROGRAM} {name}")() or 0
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        return INTERRUPTED


def _bind(command: Command, options: list[str], prog: str) -> Callable[[], int | None]:
    """Import a command and return its call with these options."""
    target = pkgutil.resolve_name(command.target)
    if command.aliases:
        options = _spelled_out(options, pkgutil.resolve_name(command.aliases))
    refuse_repeated(options)
    if command.nested:
        return _parse_nested(target(options), options, prog, command.summary)
    return parse(lambda: tyro.cli(deferred(target), prog=prog, args=options, config=(tyro.conf.FlagConversionOff,)))


def _spelled_out(options: list[str], aliases: Mapping[str, str]) -> list[str]:
    """Return the options with other names replaced; a value may follow after a space or after `=`."""
    split = (option.partition("=") for option in options)
    return ["".join([aliases.get(name.replace("_", "-"), name), equals, value]) for name, equals, value in split]


def _parse_nested(
    parsers: dict[str, Callable[..., Any]], arguments: list[str], prog: str, description: str
) -> Callable[[], Any]:
    """Return what one of the functions, which is named by the first argument, returns for the others."""
    return parse(
        lambda: tyro.extras.subcommand_cli_from_dict(
            parsers, prog=prog, args=arguments, description=description, config=(tyro.conf.FlagConversionOff,)
        )
    )


def _summary(command: Command) -> Callable[[], Any]:
    """Return a stand-in for a command in the list of all."""

    def stand_in() -> None:
        raise AssertionError("no command was named")

    stand_in.__doc__ = command.summary
    return stand_in
