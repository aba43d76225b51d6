"""Train a policy: `python train.py {ci,demo,cpu,paper} --run-dir runs/NAME`, `python train.py resume runs/NAME`."""

import functools
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Annotated

import tyro

from pregrasp_jax.command_line import one_line_errors, parse
from pregrasp_jax.config import PRESETS, Config

Command = Callable[[], int]


def main() -> int:
    """Parse the command line and train."""
    with one_line_errors():
        command = parse(lambda: tyro.extras.subcommand_cli_from_dict(commands(), config=(tyro.conf.FlagConversionOff,)))
        return command()


def commands() -> dict[str, Callable[..., Command]]:
    """Return one parser per preset, and `resume`, whose options start from what the run has stored."""
    return {name: _start(preset) for name, preset in PRESETS.items()} | {"resume": _resume(_stored_config())}


def _start(preset: Config) -> Callable[..., Command]:
    def start(
        run_dir: Path, config: Annotated[Config, tyro.conf.arg(name="")] = preset, init_from: Path | None = None
    ) -> Command:
        """Start a run.

        Args:
            run_dir: New or empty folder of the run.
            config: Settings.
            init_from: Run or policy folder whose parameters are the initial ones (fine-tuning).
        """
        from pregrasp_jax.training.session import train

        return _reported(functools.partial(train, config.validate(), run_dir, init_from=init_from), run_dir)

    return start


def _resume(stored: Config) -> Callable[..., Command]:
    def resume(
        run_dir: Annotated[Path, tyro.conf.Positional], config: Annotated[Config, tyro.conf.arg(name="")] = stored
    ) -> Command:
        """Continue a run from its newest intact checkpoint. Only train.minutes and train.episodes may change.

        Args:
            run_dir: Folder of the run.
            config: Settings, as stored in the run.
        """
        from pregrasp_jax.training.session import resume

        return _reported(functools.partial(resume, config.validate(), run_dir), run_dir)

    return resume


def _reported(session: Command, run_dir: Path) -> Command:
    """Return a session that leaves the report of the run behind; one that is refused leaves nothing."""

    def run() -> int:
        code = session()
        from pregrasp_jax.cli.report import report_session

        report_session(run_dir)
        return code

    return run


def _stored_config() -> Config:
    """Return the configuration of the run that the command line resumes, or the default to print help with."""
    if sys.argv[1:2] != ["resume"] or len(sys.argv) < 3 or {"-h", "--help"} & set(sys.argv):
        return Config()
    from pregrasp_jax.training.run_folder import stored_config

    runs = [argument for argument in sys.argv[2:] if (Path(argument) / "config.yaml").is_file()]
    return stored_config(Path(runs[0] if runs else sys.argv[2]))


if __name__ == "__main__":
    try:
        sys.exit(main())
    except KeyboardInterrupt:
        sys.exit("interrupted before the training began")
