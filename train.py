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
        run_dir: Path,
        config: Annotated[Config, tyro.conf.arg(name="")] = preset,
        init_from: Path | None = None,
        distributed: bool = False,
    ) -> Command:
        """Start a run. A session leaves a report behind, RUN_DIR/report.html.

        The report of a run that has trained for ten minutes or more shows episodes in pictures, which take a minute or
        two when the session ends, unless a signal has ended it; `python -m pregrasp_jax report RUN_DIR` makes them at
        any time. They stay on the page as long as the policy does.

        Args:
            run_dir: New or empty folder of the run.
            config: Settings.
            init_from: Run or policy folder, or `pretrained`, whose parameters are the initial ones (fine-tuning).
            distributed: Train with the processes of other hosts, started with the same options (docs/devices.md).
        """
        from pregrasp_jax.training.session import train

        session = functools.partial(train, config.validate(), run_dir, init_from=init_from)
        return _command(session, run_dir, distributed=distributed)

    return start


def _resume(stored: Config) -> Callable[..., Command]:
    def resume(
        run_dir: Annotated[Path, tyro.conf.Positional],
        config: Annotated[Config, tyro.conf.arg(name="")] = stored,
        distributed: bool = False,
    ) -> Command:
        """Continue a run from its newest intact checkpoint; its report is written as after the first session.

        Only train.minutes, train.episodes, train.tensorboard and assets.object_dir may change, here or in config.yaml.

        Args:
            run_dir: Folder of the run.
            config: Settings, as stored in the run.
            distributed: Train with the processes of other hosts, started with the same options (docs/devices.md).
        """
        from pregrasp_jax.training.session import resume

        return _command(functools.partial(resume, config.validate(), run_dir), run_dir, distributed=distributed)

    return resume


def _command(session: Command, run_dir: Path, *, distributed: bool) -> Command:
    """Return a session, one of several processes if `distributed`, that leaves the report of the run behind.

    One that is refused leaves nothing.
    """

    def run() -> int:
        from pregrasp_jax.training import processes

        if distributed:
            processes.join()
        code = session()
        if processes.is_first():
            # Other processes would wait for this one while it plays.
            _report(run_dir, finished=code == 0 and not distributed)
        return code

    return run


def _report(run_dir: Path, *, finished: bool) -> None:
    """Write the report; see `report_session`. Ctrl-C ends only that."""
    try:
        from pregrasp_jax.cli.report import report_session

        report_session(run_dir, finished=finished)
    except KeyboardInterrupt:
        text = f"`python -m pregrasp_jax report {run_dir}` writes the report"
        print(f"interrupted while the report was written; the training is saved, {text}", file=sys.stderr)


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
