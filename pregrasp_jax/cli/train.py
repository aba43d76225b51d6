"""`pregrasp-jax train`: start a run from a preset, or continue one."""

import functools
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Annotated

import tyro

from pregrasp_jax.config import Config
from pregrasp_jax.messages import command
from pregrasp_jax.presets import PRESETS

Session = Callable[[], int]
"""Trains and returns the exit code."""


def sessions(arguments: Sequence[str]) -> dict[str, Callable[..., Session]]:
    """Return one parser per preset, and `resume`, whose options start from what the run has stored.

    Args:
        arguments: what follows `train` on the command line.
    """
    return {name: _start(preset) for name, preset in PRESETS.items()} | {"resume": _resume(_stored_config(arguments))}


def _start(preset: Config) -> Callable[..., Session]:
    def start(
        run_dir: Path,
        config: Annotated[Config, tyro.conf.arg(name="")] = preset,
        init_from: Path | None = None,
        distributed: bool = False,
        films: bool = True,
    ) -> Session:
        """Start a run. A session leaves a report behind, RUN_DIR/report.html.

        The report of a run that has trained for ten minutes or more shows episodes in pictures, which take a minute or
        two when the session ends, unless a signal has ended it; `pregrasp-jax report RUN_DIR` makes them at any time.
        They stay on the page as long as the policy does.

        Args:
            run_dir: New or empty folder of the run.
            config: Settings.
            init_from: Run or policy folder, `pretrained` or `cpu-1`, whose parameters are the initial ones.
            distributed: Train with the processes of other hosts, started with the same options (docs/devices.md).
            films: Whether the report shows episodes.
        """
        from pregrasp_jax.training.session import train

        session = functools.partial(train, config.validate(), run_dir, init_from=init_from)
        return _with_report(session, run_dir, distributed=distributed, films=films)

    return start


def _resume(stored: Config) -> Callable[..., Session]:
    def resume(
        run_dir: Annotated[Path, tyro.conf.Positional],
        config: Annotated[Config, tyro.conf.arg(name="")] = stored,
        distributed: bool = False,
        films: bool = True,
    ) -> Session:
        """Continue a run from its newest intact checkpoint; its report is written as after the first session.

        Only train.minutes, train.episodes, train.env_steps, train.tensorboard, assets.object_dir and physics.threads
        may change, here or in config.yaml. Schedules stay those of the length that the run had at first.

        Args:
            run_dir: Folder of the run.
            config: Settings, as stored in the run.
            distributed: Train with the processes of other hosts, started with the same options (docs/devices.md).
            films: Whether the report shows episodes.
        """
        from pregrasp_jax.training.session import resume

        session = functools.partial(resume, config.validate(), run_dir)
        return _with_report(session, run_dir, distributed=distributed, films=films)

    return resume


def _with_report(session: Session, run_dir: Path, *, distributed: bool, films: bool) -> Session:
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
            _report(run_dir, finished=code == 0 and films and not distributed)
        return code

    return run


def _report(run_dir: Path, *, finished: bool) -> None:
    """Write the report; see `report_session`. Ctrl-C ends only that."""
    try:
        from pregrasp_jax.cli.report import report_session

        report_session(run_dir, finished=finished)
    except KeyboardInterrupt:
        text = f"`{command('report', run_dir)}` writes the report"
        print(f"interrupted while the report was written; the training is saved, {text}", file=sys.stderr)


def _stored_config(arguments: Sequence[str]) -> Config:
    """Return the configuration of the run that is to be resumed, or the default to print help with."""
    if list(arguments[:1]) != ["resume"] or len(arguments) < 2 or {"-h", "--help"} & set(arguments):
        return Config()
    from pregrasp_jax.training.run_folder import stored_config

    runs = [argument for argument in arguments[1:] if (Path(argument) / "config.yaml").is_file()]
    return stored_config(Path(runs[0] if runs else arguments[1]))
