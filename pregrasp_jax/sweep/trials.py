"""Trials: a setting with a seed, named by a hash, and the command lines that train and test it."""

from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from pregrasp_jax import io
from pregrasp_jax.config import Config
from pregrasp_jax.presets import PRESETS
from pregrasp_jax.settings import to_dict
from pregrasp_jax.sweep.spec import Spec

EVALUATIONS = "evaluations"
"""Subfolder of a run in which its evaluations lie, where `pregrasp-jax report` finds them too."""


@dataclass(frozen=True, kw_only=True)
class Trial:
    """One training, or one evaluation of a policy that is there already.

    Attributes:
        id: hash of all that makes the trial, and the name of its run folder.
        name: of its variant; empty in a search.
        varied: dotted name -> value, what makes the setting differ from the others.
        settings: dotted name -> value, all that differs from the preset.
        seed: of the trial.
        policy: who is evaluated without a training.
        init_from: whose parameters the training begins with.
        final: whether it is one of the fresh seeds at the end.
        proposal: its number in the study of a search that learns.
        number: in the order of the sweep, from 0; -1 until the sweep plans it.
    """

    id: str
    name: str = ""
    varied: Mapping[str, Any] = field(default_factory=dict)
    settings: Mapping[str, Any] = field(default_factory=dict)
    seed: int = 0
    policy: str | None = None
    init_from: str | None = None
    final: bool = False
    proposal: int | None = None
    number: int = -1

    @property
    def group(self) -> str:
        """What the trials of one setting share, whatever their seed."""
        return io.content_hash(dict(self.settings), self.policy, self.init_from)

    @property
    def label(self) -> str:
        """The setting in words."""
        return self.name or ", ".join(f"{key}={_short(value)}" for key, value in self.varied.items()) or "as set"

    def to_dict(self) -> dict[str, Any]:
        """Return plain data that ``Trial(**data)`` takes."""
        return asdict(self)


def make_trial(spec: Spec, varied: Mapping[str, Any], seed: int, **about: Any) -> Trial:
    """Return a trial.

    Args:
        spec: the sweep.
        varied: what makes the setting differ from the others.
        seed: of the trial.
        about: further fields of `Trial`.
    """
    settings = {**spec.set, **varied}
    what = (spec.preset, settings, seed, about.get("policy"), about.get("init_from"))
    return Trial(id=io.content_hash(*what), varied=dict(varied), settings=settings, seed=seed, **about)


def setting_trials(spec: Spec, varied: Mapping[str, Any], **about: Any) -> list[Trial]:
    """Return the trials of one setting, one per seed; a policy that is not trained needs no more than one."""
    seeds = spec.seeds if about.get("policy") is None else spec.seeds[:1]
    return [make_trial(spec, varied, seed, **about) for seed in seeds]


def final_trials(spec: Spec, winners: Iterable[Trial]) -> list[Trial]:
    """Return the trials of the best settings with fresh seeds."""
    return [
        make_trial(spec, winner.varied, seed, name=winner.name, init_from=winner.init_from, final=True)
        for winner in winners
        for seed in spec.final.seeds
    ]


def trial_config(spec: Spec, settings: Mapping[str, Any]) -> Config:
    """Return the configuration of a trial, but for its seed and its threads.

    Raises:
        ValueError: an unknown name, or a value of the wrong type or out of range.
    """
    values = to_dict(PRESETS[spec.preset])
    for key, value in settings.items():
        *stages, name = key.split(".")
        section: Any = values
        for stage in stages:
            section = section.get(stage) if isinstance(section, dict) else None
        if not isinstance(section, dict) or name not in section or isinstance(section[name], dict):
            near = ", ".join(sorted(section)) if isinstance(section, dict) else ", ".join(sorted(values))
            raise ValueError(f"this version knows no setting {key}; allowed here: {near}")
        section[name] = value
    return Config.from_dict(values).validate()


def train_command(spec: Spec, trial: Trial, run: Path) -> list[str]:
    """Return the command line that starts a trial, or goes on with it."""
    if (run / "config.yaml").is_file():
        return [*spec.program, "train", "resume", str(run), "--films", "False", *flags(_cores(spec))]
    options = {"seed": trial.seed, **_cores(spec), **trial.settings}
    start = ["--init-from", trial.init_from] if trial.init_from else []
    return [*spec.program, "train", spec.preset, "--run-dir", str(run), "--films", "False", *start, *flags(options)]


def evaluate_command(spec: Spec, trial: Trial, name: str, run: Path) -> list[str]:
    """Return the command line of one of the evaluations of a trial."""
    options = {**_cores(spec), **evaluations_of(spec, trial)[name]}
    if trial.policy is not None:
        options = {"seed": trial.seed, **options}
    who = ["--policy", trial.policy or str(run), "--json", str(evaluation_files(spec, trial, run)[name])]
    return [*spec.program, "evaluate", *who, *flags(options)]


def evaluations_of(spec: Spec, trial: Trial) -> Mapping[str, Mapping[str, Any]]:
    """Return the evaluations that a finished trial gets, by name."""
    if spec.tests or not trial.final:
        return spec.tests
    given = {key: value for key, value in trial.settings.items() if key in ("assets.object_dir", "assets.object_set")}
    return {"test": {"episodes": spec.final.episodes, **given}}


def evaluation_files(spec: Spec, trial: Trial, run: Path) -> dict[str, Path]:
    """Return where the evaluations of a trial are written, by name; other options are another file."""
    return {
        name: run / EVALUATIONS / f"{name}-{io.content_hash(dict(options))[:8]}.json"
        for name, options in evaluations_of(spec, trial).items()
    }


def flags(options: Mapping[str, Any]) -> list[str]:
    """Return options as a command line has them."""
    return [word for key, value in options.items() for word in (f"--{key.replace('_', '-')}", str(value))]


def _cores(spec: Spec) -> dict[str, int]:
    return {"physics.threads": spec.resources.cores}


def _short(value: Any) -> str:
    return f"{value:.4g}" if isinstance(value, float) else str(value)
