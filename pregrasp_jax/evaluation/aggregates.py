"""How sure a success rate is that several seeds and many scenes give, and whether two settings differ.

A setting is a matrix of outcomes, a row for every seed (training) and a column for every scene. Both were drawn: other
seeds and other scenes would give another rate. Intervals are therefore those of a bootstrap that draws seeds and,
within every stratum (a set of objects), scenes. Scenes are the same for all settings, so differences are paired by
them.

Source: Agarwal et al. (2021), "Deep reinforcement learning at the edge of the statistical precipice", and its library
rliable, which draws the seeds of every task (stratum); here scenes are drawn as well, since they are few.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from pregrasp_jax.evaluation.statistics import wilson_interval

DRAWS = 2000
"""Of the bootstrap: the ends of a 95 % interval then repeat within about a tenth of its width."""

_ENDS = (2.5, 97.5)


@dataclass(frozen=True)
class Outcomes:
    """What the trainings of one setting did.

    Attributes:
        successes: [S, N] bool, seed by scene.
        strata: [N] int, the stratum of every scene; all strata have equal weight, as tasks have for rliable.
    """

    successes: np.ndarray
    strata: np.ndarray

    def __post_init__(self):
        if self.successes.ndim != 2 or self.strata.shape != self.successes.shape[1:] or 0 in self.successes.shape:
            raise ValueError(f"outcomes {self.successes.shape} and strata {self.strata.shape} do not fit")

    @property
    def rates(self) -> np.ndarray:
        """Success rate of every seed, [S]."""
        return np.mean([self.successes[:, self.strata == s].mean(axis=1) for s in np.unique(self.strata)], axis=0)

    @property
    def rate(self) -> float:
        """Mean success rate."""
        return float(self.rates.mean())


@dataclass(frozen=True, kw_only=True)
class Difference:
    """Two settings on the same scenes.

    Attributes:
        difference: rate(a) - rate(b).
        interval: 95 %, over seeds and scenes.
        p_value: two-sided, of no difference; corrected where several are compared, see `against`.
        improvement: probability that a training of a is better than one of b.
    """

    difference: float
    interval: tuple[float, float]
    p_value: float
    improvement: float

    @property
    def half_width(self) -> float:
        """Half of the interval."""
        return (self.interval[1] - self.interval[0]) / 2


def pooled(documents: Mapping[str, Sequence[Mapping[str, Any]]]) -> Outcomes:
    """Return the outcomes of evaluation files.

    Args:
        documents: stratum -> one document per seed, all of the same scenes.

    Raises:
        ValueError: strata with different numbers of seeds, or seeds that met different scenes.
    """
    if len({len(of_seeds) for of_seeds in documents.values()}) != 1:
        raise ValueError("every stratum needs an evaluation of every seed")
    columns, strata = [], []
    for index, of_seeds in enumerate(documents.values()):
        scenes = [scene_of(document) for document in of_seeds]
        if any(own != scenes[0] for own in scenes):
            raise ValueError("the evaluations are not of the same scenes; allowed are those of one sweep")
        columns.append(np.array([[row["success"] for row in by_scene(document)] for document in of_seeds], bool))
        strata += [index] * len(of_seeds[0]["rows"])
    return Outcomes(np.concatenate(columns, axis=1), np.array(strata))


def scene_of(document: Mapping[str, Any]) -> list[Any]:
    """Return what two evaluations must share so that they can be paired."""
    return [document["scene_bank_hash"], *((row["scene"], row["target"]) for row in by_scene(document))]


def by_scene(document: Mapping[str, Any]) -> list[Mapping[str, Any]]:
    """Return the rows of an evaluation by scene."""
    return sorted(document["rows"], key=lambda row: row["scene"])


def interval(outcomes: Outcomes, *, seed: int = 0) -> tuple[float, float]:
    """Return the 95 % interval of a success rate over seeds and scenes; of one seed over scenes alone.

    It is never narrower than Wilson's of all episodes: a bootstrap of nothing but successes has no width.
    """
    generator = np.random.default_rng(seed)
    draws = _draw_rates(outcomes, _draw_scenes(outcomes.strata, generator), generator)
    return _at_least_wilson(_percentiles(np.clip(draws, 0.0, 1.0)), outcomes.rate, outcomes.successes.size)


def compare_settings(a: Outcomes, b: Outcomes, *, seed: int = 0) -> Difference:
    """Return the difference of two settings on the same scenes.

    Scenes are drawn once for both, seeds for each. The p-value is the share of draws on the other side of zero, twice;
    it cannot be less than one draw.

    Raises:
        ValueError: they did not run the same scenes.
    """
    if not np.array_equal(a.strata, b.strata):
        raise ValueError("two settings can be compared on the same scenes only")
    generator = np.random.default_rng(seed)
    scenes = _draw_scenes(a.strata, generator)
    draws = _draw_rates(a, scenes, generator) - _draw_rates(b, scenes, generator)
    draws = np.round(draws, 9)  # ties are ties
    tail = min((draws <= 0).mean(), (draws >= 0).mean())
    return Difference(
        difference=a.rate - b.rate,
        interval=_percentiles(draws) if np.ptp(draws) else _unpaired(a, b),
        p_value=float(min(1.0, max(2 * tail, 1 / DRAWS))),
        improvement=probability_of_improvement(a.rates, b.rates),
    )


def against(reference: Outcomes, others: Mapping[str, Outcomes]) -> dict[str, Difference]:
    """Return other - reference for several settings, their p-values corrected by Holm's method."""
    found = {name: compare_settings(other, reference) for name, other in others.items()}
    corrected = holm([difference.p_value for difference in found.values()])
    return {
        name: Difference(difference=old.difference, interval=old.interval, p_value=p_value, improvement=old.improvement)
        for (name, old), p_value in zip(found.items(), corrected, strict=True)
    }


def holm(p_values: Sequence[float]) -> list[float]:
    """Return p-values that may be compared with 0.05 although there are several of them.

    Source: Holm (1979), "A simple sequentially rejective multiple test procedure".
    """
    order = sorted(range(len(p_values)), key=lambda i: p_values[i])
    corrected, largest = [0.0] * len(p_values), 0.0
    for rank, i in enumerate(order):
        largest = max(largest, (len(p_values) - rank) * p_values[i])
        corrected[i] = min(1.0, largest)
    return corrected


def probability_of_improvement(a: np.ndarray, b: np.ndarray) -> float:
    """Return the share of pairs of trainings in which one of `a` [S] is better than one of `b` [T]; ties are halves."""
    difference = np.asarray(a)[:, None] - np.asarray(b)[None, :]
    return float(np.mean((difference > 1e-12) + 0.5 * (np.abs(difference) <= 1e-12)))


def noise(differences: Sequence[Difference]) -> float | None:
    """Return the difference that is noise in a table: half of its widest interval; None without one."""
    return max((difference.half_width for difference in differences), default=None)


def band(curves: Sequence[Sequence[tuple[float, float]]], *, seed: int = 0) -> list[tuple[float, float, float, float]]:
    """Return (x, mean, low, high) of several curves at every x that all have: 95 % over the curves."""
    shared = sorted(set.intersection(*({x for x, _ in curve} for curve in curves))) if curves else []
    generator = np.random.default_rng(seed)
    rows = []
    for x in shared:
        values = np.array([dict(curve)[x] for curve in curves])
        drawn = _seed_part(values[None], generator)[0] if len(values) > 1 else np.zeros(1)
        low, high = _percentiles(values.mean() + drawn)
        rows.append((x, float(values.mean()), low, high))
    return rows


def measured_interval(rates: Sequence[float], scenes: int, *, seed: int = 0) -> tuple[float, float]:
    """Return the 95 % interval of a mean rate of which only the seeds' own rates are known, each over `scenes` scenes.

    What the seeds differ by holds the chance of the scenes too, but for what all seeds share: the wider of the two
    is taken.
    """
    values, generator = np.asarray(rates, float), np.random.default_rng(seed)
    by_scenes = generator.binomial(scenes, values.mean(), DRAWS) / scenes - values.mean()
    by_seeds = _seed_part(values[None], generator)[0] if len(values) > 1 else np.zeros(DRAWS)
    spread = max((by_scenes, by_seeds), key=np.std)
    bootstrap = _percentiles(np.clip(values.mean() + spread, 0.0, 1.0))
    return _at_least_wilson(bootstrap, float(values.mean()), scenes * len(values))


def _draw_scenes(strata: np.ndarray, generator: np.random.Generator) -> np.ndarray:
    """Return weights [DRAWS, N] of the scenes, which add up to one: every stratum drawn for itself."""
    weights = np.zeros((DRAWS, len(strata)))
    kinds = np.unique(strata)
    for kind in kinds:
        (own,) = np.nonzero(strata == kind)
        counts = generator.multinomial(len(own), np.full(len(own), 1 / len(own)), size=DRAWS)
        weights[:, own] = counts / (len(own) * len(kinds))
    return weights


def _draw_rates(outcomes: Outcomes, weights: np.ndarray, generator: np.random.Generator) -> np.ndarray:
    """Return rates [DRAWS] of drawn scenes and drawn seeds."""
    by_seed = weights @ outcomes.successes.T.astype(float)
    if by_seed.shape[1] == 1:
        return by_seed[:, 0]
    return by_seed.mean(axis=1) + _seed_part(by_seed, generator).ravel()


def _seed_part(by_seed: np.ndarray, generator: np.random.Generator) -> np.ndarray:
    """Return by how much the mean moves when seeds are drawn: [DRAWS] for [DRAWS, S], [1, DRAWS] for [1, S].

    The spread of so few is widened by sqrt(S / (S - 1)): a bootstrap takes theirs for that of all seeds.
    """
    num_seeds = by_seed.shape[1]
    picked = generator.integers(0, num_seeds, size=(DRAWS, num_seeds))
    if len(by_seed) == 1:
        drawn = by_seed[0][picked].mean(axis=1)[None]
        center: Any = by_seed.mean()
    else:
        drawn, center = np.take_along_axis(by_seed, picked, axis=1).mean(axis=1), by_seed.mean(axis=1)
    return (drawn - center) * np.sqrt(num_seeds / (num_seeds - 1))


def _at_least_wilson(bootstrap: tuple[float, float], rate: float, episodes: int) -> tuple[float, float]:
    low, high = wilson_interval(round(rate * episodes), episodes)
    return min(low, bootstrap[0]), max(high, bootstrap[1])


def _unpaired(a: Outcomes, b: Outcomes) -> tuple[float, float]:
    """Return the interval of a difference from both intervals alone. Source: Newcombe (1998), method 10."""
    (low_a, high_a), (low_b, high_b) = interval(a), interval(b)
    difference = a.rate - b.rate
    below = np.hypot(a.rate - low_a, high_b - b.rate)
    above = np.hypot(high_a - a.rate, b.rate - low_b)
    return float(difference - below), float(difference + above)


def _percentiles(draws: np.ndarray) -> tuple[float, float]:
    low, high = np.percentile(draws, _ENDS)
    return float(low), float(high)
