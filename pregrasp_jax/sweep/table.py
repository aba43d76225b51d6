"""The table of a sweep: settings by rank, how sure their success is, and what of their differences is noise."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from pregrasp_jax.evaluation.aggregates import (
    Difference,
    Outcomes,
    against,
    interval,
    measured_interval,
    noise,
    pooled,
    scene_of,
)
from pregrasp_jax.evaluation.results import load_evaluation
from pregrasp_jax.evaluation.statistics import world_of
from pregrasp_jax.sweep import driver, state
from pregrasp_jax.sweep.folder import SweepFolder
from pregrasp_jax.sweep.spec import Spec
from pregrasp_jax.sweep.state import TrialState
from pregrasp_jax.sweep.trials import evaluation_files, trial_config

Interval = tuple[float, float]


@dataclass(frozen=True, kw_only=True)
class Tested:
    """A setting on test scenes.

    Attributes:
        outcomes: of all its seeds.
        rate: mean success.
        interval: 95 %, over seeds and scenes.
        motions: mean pushes per success.
        rates: of the seeds.
        met: what was met; only settings that met the same are compared.
    """

    outcomes: Outcomes
    rate: float
    interval: Interval
    motions: float | None
    rates: tuple[float, ...]
    met: list[Any]


@dataclass(frozen=True, kw_only=True)
class Row:
    """A setting.

    Attributes:
        rank: from 1.
        label: in words.
        varied: dotted name -> value.
        members: its trials.
        words: state of each of them.
        scores: best measured on validation scenes, of every seed that has been measured.
        interval: 95 % of their mean.
        motions: mean pushes of the policies with these scores.
        tests: by name.
        final: whether these are the fresh seeds of a winner.
    """

    rank: int
    label: str
    varied: Mapping[str, Any]
    members: Sequence[TrialState]
    words: Sequence[str]
    scores: Sequence[float]
    interval: Interval | None
    motions: float | None
    tests: Mapping[str, Tested] = field(default_factory=dict)
    final: bool = False

    @property
    def score(self) -> float | None:
        """Mean over the seeds."""
        return state.mean(self.scores) if self.scores else None

    @property
    def hours(self) -> float:
        """Wall-clock time of all its trials."""
        return sum(member.seconds for member in self.members) / 3600

    @property
    def env_steps(self) -> int:
        """Of the trial that went furthest."""
        return max(member.env_steps for member in self.members)

    @property
    def word(self) -> str:
        """State of the trials, once if it is the same of all."""
        return ", ".join(sorted(set(self.words)))


@dataclass(frozen=True, kw_only=True)
class Table:
    """A sweep so far.

    Attributes:
        metric: that settings are ranked by.
        rows: best first, then the fresh seeds of the winners.
        noise: points (0 to 1) of the metric within which settings do not differ, None if that is not known.
        noise_of: on what.
        differences: label -> difference from the reference on test scenes, corrected for their number, by test.
        reference: label of that setting.
    """

    metric: str
    rows: Sequence[Row]
    noise: float | None
    noise_of: str
    differences: Mapping[str, Mapping[str, Difference]]
    reference: str


def make_table(folder: SweepFolder, spec: Spec, *, reference: str | None = None) -> Table:
    """Return the table of a sweep, of what there is so far.

    Args:
        folder: of the sweep.
        spec: of the sweep.
        reference: label of the setting that others are compared with on test scenes; the best if None, or if that one
            has not been tested yet.

    Raises:
        ValueError: there is no such setting.
    """
    states = folder.states()
    running = [s.trial.id for s in states if not s.over and folder.is_running(s.trial)]
    words = driver.status(spec, states, running)
    finals = list(state.by_setting([s for s in states if s.trial.final]).values())
    groups = [*state.ranking(spec, states), *finals]
    rows = [_row(folder, spec, rank, members, words) for rank, members in enumerate(groups, start=1)]
    tested = [row for row in rows if row.tests and (row.final or not finals)]
    if reference and reference not in [row.label for row in rows]:
        raise ValueError(f"reference {reference!r} is no setting; allowed: {', '.join(repr(r.label) for r in rows)}")
    chosen = next((row for row in tested if row.label == reference), tested[0] if tested else None)
    differences = _differences(chosen, tested) if chosen else {}
    least, what = _noise(spec, rows, differences)
    return Table(
        metric=spec.stop.metric,
        rows=rows,
        noise=least,
        noise_of=what,
        differences=differences,
        reference=chosen.label if chosen else "",
    )


def _row(folder: SweepFolder, spec: Spec, rank: int, members: Sequence[TrialState], words: Mapping[str, str]) -> Row:
    scores = [member.score for member in members if member.score is not None]
    motions = [member.motions for member in members if member.motions is not None]
    is_rate = spec.stop.metric.endswith("rate")
    return Row(
        rank=rank,
        label=members[0].trial.label,
        varied=members[0].trial.varied,
        members=members,
        words=[words[member.trial.id] for member in members],
        scores=scores,
        interval=measured_interval(scores, _validation_scenes(spec, members)) if scores and is_rate else None,
        motions=state.mean(motions) if motions else None,
        tests=_tests(folder, spec, members),
        final=members[0].trial.final,
    )


def _validation_scenes(spec: Spec, members: Sequence[TrialState]) -> int:
    return trial_config(spec, members[0].trial.settings).scene.validation_scenes


def _tests(folder: SweepFolder, spec: Spec, members: Sequence[TrialState]) -> dict[str, Tested]:
    """Return the tests of a setting that all its seeds have gone through."""
    found = {}
    written = [evaluation_files(spec, member.trial, folder.run(member.trial)) for member in members]
    for name in written[0]:
        files = [of_member[name] for of_member in written]
        if all(file.exists() for file in files):
            found[name] = tested([load_evaluation(file) for file in files])
    return found


def tested(documents: Sequence[Mapping[str, Any]]) -> Tested:
    """Return what the evaluations of one setting on the same scenes, one a seed, come to."""
    outcomes = pooled({"": documents})
    motions = [document["mean_motions"] for document in documents if document["mean_motions"] is not None]
    return Tested(
        outcomes=outcomes,
        rate=outcomes.rate,
        interval=interval(outcomes),
        motions=state.mean(motions) if motions else None,
        rates=tuple(outcomes.rates.tolist()),
        met=[world_of(documents[0]), scene_of(documents[0])],
    )


def _differences(reference: Row, rows: Sequence[Row]) -> dict[str, dict[str, Difference]]:
    """Return test -> label -> difference from the reference, of the settings that met the same scenes."""
    found: dict[str, dict[str, Difference]] = {}
    for name, own in reference.tests.items():
        others = {row.label: row.tests[name] for row in rows if row is not reference and name in row.tests}
        same = {label: other.outcomes for label, other in others.items() if other.met == own.met}
        if same:
            found[name] = against(own.outcomes, same)
    return found


def _noise(
    spec: Spec, rows: Sequence[Row], differences: Mapping[str, Mapping[str, Difference]]
) -> tuple[float | None, str]:
    """Return within what settings do not differ: by the test scenes if there are some, else by validation."""
    if tests := [difference for of_test in differences.values() for difference in of_test.values()]:
        return noise(tests), "test scenes"
    halves = [(row.interval[1] - row.interval[0]) / 2 for row in rows if row.interval is not None]
    # Of a difference of two that are as sure as the least sure one.
    return (max(halves) * 2**0.5 if halves else None), "validation scenes"
