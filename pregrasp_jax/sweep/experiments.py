"""The tables and figures of the paper as sweeps: `experiments/*.yaml`, part of the package."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from pregrasp_jax import yaml_file
from pregrasp_jax.messages import lookup
from pregrasp_jax.sweep.spec import Spec, spec_from

FOLDER = Path(__file__).parent.parent / "experiments"


@dataclass(frozen=True, kw_only=True)
class Experiment:
    """A table or a figure.

    Attributes:
        name: of its file.
        title: heading of its page.
        about: what it shows, in a few sentences.
        runs: name of the experiment whose trainings it shows; its own if that is itself.
        differs: where the setting is not the paper's, a sentence each.
        reference: variant that the others are compared with.
        minutes: of training of each trial, unless told otherwise.
        seeds: of every variant.
        sizes: name -> preset and settings.
        variants: as in a sweep.
        tests: as in a sweep.
        paper: test -> variant -> success (%) and motions.
    """

    name: str
    title: str
    about: str
    runs: str
    differs: Sequence[str] = ()
    reference: str = ""
    minutes: float = 60.0
    seeds: Sequence[int] = (0,)
    sizes: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    variants: Mapping[str, Any] = field(default_factory=dict)
    tests: Mapping[str, Any] = field(default_factory=dict)
    paper: Mapping[str, Mapping[str, Mapping[str, float]]] = field(default_factory=dict)


def names() -> list[str]:
    """Return the names of all experiments."""
    return sorted(path.stem for path in FOLDER.glob("*.yaml"))


def read_experiment(name: str) -> Experiment:
    """Return an experiment; one that shows the trainings of another has all that it does not say from there.

    Raises:
        ValueError: there is none of this name; the line lists those that exist.
    """
    files = {path.stem: path for path in FOLDER.glob("*.yaml")}
    values = yaml_file.read(lookup(files, name, key="experiment"))
    runs = values.get("runs", name)
    shared = yaml_file.read(lookup(files, runs, key="runs")) if runs != name else {}
    return Experiment(**{**shared, **values, "name": name, "runs": runs})


def make_spec(
    experiment: Experiment,
    *,
    size: str = "budget",
    minutes: float | None = None,
    env_steps: int | None = None,
    seeds: Sequence[int] | None = None,
    object_dir: Path | None = None,
    resources: Mapping[str, Any] | None = None,
) -> Spec:
    """Return the sweep of an experiment.

    Args:
        experiment: which.
        size: `budget` for minutes of CPUs, `paper` for what the paper did.
        minutes: of training of each trial; those of the experiment, and for `paper` no limit, if None.
        env_steps: of each trial instead of minutes, so that what runs beside it changes nothing.
        seeds: of every variant; those of the experiment if None.
        object_dir: folder of meshes of one's own, on which every variant is tested, too.
        resources: of a trial, as in a spec.

    Raises:
        ValueError: no such size, a length that is none, or this version does not know a setting of the experiment.
    """
    chosen = lookup(experiment.sizes, size, key="size")
    if minutes is not None and env_steps is not None:
        raise ValueError(f"budget = {minutes:g} and env_steps = {env_steps} both say how long; allowed is one of them")
    for name, length in (("budget", minutes), ("env_steps", env_steps)):
        if length is not None and length <= 0:
            raise ValueError(f"{name} = {length} is out of range; allowed is more than 0")
    if minutes is None and size != "paper":
        minutes = experiment.minutes
    if env_steps is not None:
        chosen = {**chosen, "set": {**chosen["set"], "train.env_steps": env_steps, "train.minutes": 0}}
    elif minutes is not None:
        chosen = {**chosen, "set": {**chosen["set"], "train.minutes": minutes}}
    tests = dict(experiment.tests)
    if object_dir is not None:
        meshes = object_dir.resolve()
        tests[f"folder {meshes.name}"] = {"assets.object_dir": str(meshes), "episodes": 200}
    plain = {
        **chosen,
        "seeds": list(seeds if seeds is not None else experiment.seeds),
        "variants": experiment.variants,
        "tests": tests,
        "resources": dict(resources or {}),
    }
    return spec_from(plain)
