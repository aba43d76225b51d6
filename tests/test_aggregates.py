"""Intervals over seeds and scenes, paired differences, Holm: against hand numbers, simulation and scipy."""

import numpy as np
import pytest
from scipy import stats

from pregrasp_jax.evaluation import aggregates
from pregrasp_jax.evaluation.aggregates import Outcomes


def outcomes(successes, strata=None) -> Outcomes:
    successes = np.asarray(successes, bool)
    return Outcomes(successes, np.zeros(successes.shape[1], int) if strata is None else np.asarray(strata))


def draw(generator, *, seeds: int, scenes: int, rate: float, between: float) -> np.ndarray:
    """Draw outcomes of seeds that differ by `between` (std) on scenes that differ in difficulty."""
    difficulty = generator.normal(0, 0.15, scenes)
    skill = rate + generator.normal(0, between, seeds)
    return generator.random((seeds, scenes)) < np.clip(skill[:, None] + difficulty[None], 0, 1)


def test_holm_by_hand():
    assert aggregates.holm([0.01, 0.04, 0.03]) == pytest.approx([0.03, 0.06, 0.06])
    assert aggregates.holm([0.5, 0.9]) == pytest.approx([1.0, 1.0])
    assert aggregates.holm([]) == []


def test_probability_of_improvement_by_hand():
    assert aggregates.probability_of_improvement(np.array([0.8, 0.6]), np.array([0.7, 0.6])) == (1 + 1 + 0 + 0.5) / 4
    a, b = np.random.default_rng(0).random((2, 9))
    expected = stats.mannwhitneyu(a, b).statistic / 81
    assert aggregates.probability_of_improvement(a, b) == pytest.approx(expected)


def test_strata_have_equal_weight_whatever_their_size():
    found = outcomes([[1, 1, 1, 0], [1, 0, 1, 0]], [0, 0, 0, 1])
    assert found.rates == pytest.approx([0.5, 1 / 3]) and found.rate == pytest.approx(5 / 12)


def test_one_seed_is_a_bootstrap_over_scenes():
    sample = np.arange(200) < 150
    low, high = aggregates.interval(outcomes([sample]))
    expected = stats.bootstrap((sample.astype(float),), np.mean, n_resamples=2000, method="percentile", rng=0)
    assert (low, high) == pytest.approx(tuple(expected.confidence_interval), abs=2 / 200 + 1e-9)  # two scenes


@pytest.mark.parametrize(("seeds", "least"), [(3, 0.86), (6, 0.9)])
def test_the_interval_holds_the_truth_nearly_as_often_as_it_says(seeds, least, monkeypatch):
    """Seeds that differ by six points: an interval of the pooled episodes holds it far less often."""
    monkeypatch.setattr(aggregates, "DRAWS", 300)
    generator, inside, pooled_inside, times = np.random.default_rng(1), 0, 0, 150
    for _ in range(times):
        sample = draw(generator, seeds=seeds, scenes=150, rate=0.7, between=0.06)
        low, high = aggregates.interval(outcomes(sample))
        inside += low <= 0.7 <= high
        n = sample.size
        half = 1.96 * np.sqrt(sample.mean() * (1 - sample.mean()) / n)
        pooled_inside += abs(sample.mean() - 0.7) <= half
    assert inside / times >= least > pooled_inside / times


def test_nothing_but_successes_or_failures_is_not_certainty():
    all_good, all_bad = outcomes(np.ones((2, 20))), outcomes(np.zeros((2, 20)))
    expected = stats.binomtest(40, 40).proportion_ci(method="wilson")
    assert aggregates.interval(all_good) == pytest.approx((expected.low, 1.0), abs=1e-6)
    same = aggregates.compare_settings(all_good, all_good)
    assert same.interval[0] < -0.05 and same.interval[1] > 0.05 and same.p_value == 1
    assert aggregates.compare_settings(all_good, all_bad).p_value < 0.01
    low, high = aggregates.measured_interval([0.0], 2)
    assert low == 0 and high == pytest.approx(stats.binomtest(0, 2).proportion_ci(method="wilson").high, abs=1e-6)


@pytest.mark.parametrize(("one", "other"), [(1, 1), (1, 3), (3, 3), (2, 5)])
def test_draws_that_tie_are_ties_whatever_the_number_of_seeds(one, other):
    success = np.random.default_rng(5).random((1, 100)) < 0.7
    a, b = (outcomes(np.repeat(success, seeds, axis=0)) for seeds in (one, other))
    assert aggregates.compare_settings(a, b).p_value == 1
    perfect, once_bad = np.ones((one, 100), bool), np.ones((other, 100), bool)
    once_bad[:, 0] = False
    share_without_it = (99 / 100) ** 100
    found = aggregates.compare_settings(outcomes(perfect), outcomes(once_bad))
    assert found.p_value == pytest.approx(2 * share_without_it, abs=0.06) and found.interval[0] == 0
    clear = aggregates.compare_settings(outcomes(perfect), outcomes(np.zeros((other, 100))))
    assert 0.9 < clear.interval[0] < 1


def test_pairing_by_scene_narrows_the_interval_of_a_difference():
    generator = np.random.default_rng(2)
    hard = generator.random(200) < 0.4
    a = np.stack([~hard & (generator.random(200) < 0.97) for _ in range(3)])
    b = np.stack([~hard & (generator.random(200) < 0.90) for _ in range(3)])
    found = aggregates.compare_settings(outcomes(a), outcomes(b))
    alone = [aggregates.interval(outcomes(x)) for x in (a, b)]
    (low_a, high_a), (low_b, high_b) = alone
    unpaired = np.hypot((high_a - low_a) / 2, (high_b - low_b) / 2)
    assert found.half_width < 0.6 * unpaired
    assert found.difference == pytest.approx(a.mean() - b.mean())
    opposite = aggregates.compare_settings(outcomes(b), outcomes(a))
    assert opposite.difference == pytest.approx(-found.difference) and opposite.improvement == 1 - found.improvement


def test_no_difference_is_called_one_about_as_often_as_it_should_be(monkeypatch):
    monkeypatch.setattr(aggregates, "DRAWS", 300)
    generator, times = np.random.default_rng(3), 150
    called = 0
    for _ in range(times):
        a, b = (draw(generator, seeds=4, scenes=100, rate=0.7, between=0.05) for _ in range(2))
        called += aggregates.compare_settings(outcomes(a), outcomes(b)).p_value < 0.05
    assert called / times < 0.13


def test_a_clear_difference_is_found_and_corrected():
    generator = np.random.default_rng(4)
    reference, worse = (draw(generator, seeds=3, scenes=200, rate=r, between=0.02) for r in (0.85, 0.6))
    same = draw(generator, seeds=3, scenes=200, rate=0.85, between=0.02)
    found = aggregates.against(outcomes(reference), {"worse": outcomes(worse), "same": outcomes(same)})
    assert found["worse"].p_value < 0.01 and found["worse"].interval[1] < 0 and found["worse"].improvement == 0
    assert found["same"].p_value > 0.05
    widest = aggregates.noise(list(found.values()))
    assert widest == max(d.half_width for d in found.values()) and aggregates.noise([]) is None


def document(success, *, bank="a", target="mug") -> dict:
    rows = [{"scene": i, "target": target, "success": bool(s)} for i, s in enumerate(success)]
    return {"scene_bank_hash": bank, "rows": rows[::-1]}


def test_evaluations_are_pooled_by_scene_and_object_set():
    found = aggregates.pooled({"seen": [document([1, 0]), document([1, 1])], "unseen": [document([0]), document([1])]})
    np.testing.assert_array_equal(found.successes, [[1, 0, 0], [1, 1, 1]])
    np.testing.assert_array_equal(found.strata, [0, 0, 1])


def test_other_scenes_or_missing_seeds_are_refused():
    with pytest.raises(ValueError, match="not of the same scenes"):
        aggregates.pooled({"seen": [document([1, 0]), document([1, 0], bank="b")]})
    with pytest.raises(ValueError, match="every seed"):
        aggregates.pooled({"seen": [document([1])], "unseen": [document([1]), document([1])]})
    with pytest.raises(ValueError, match="same scenes only"):
        aggregates.compare_settings(outcomes([[1, 0]]), outcomes([[1, 0, 1]]))
    with pytest.raises(ValueError, match="do not fit"):
        Outcomes(np.zeros((2, 3), bool), np.zeros(2, int))


def test_a_band_is_over_the_points_that_all_curves_have():
    rows = aggregates.band([[(1, 0.2), (2, 0.5), (3, 0.9)], [(1, 0.4), (2, 0.5)], [(1, 0.3), (2, 0.5), (3, 1.0)]])
    assert [row[0] for row in rows] == [1, 2]
    (_, first, low, high), (_, second, low2, high2) = rows
    assert first == pytest.approx(0.3) and low < 0.3 < high and (second, low2, high2) == pytest.approx((0.5,) * 3)


def test_rates_alone_give_the_wider_of_two_intervals():
    low, high = aggregates.measured_interval([0.7], 100)
    assert (low, high) == pytest.approx((0.61, 0.79), abs=0.02)
    wide = aggregates.measured_interval([0.5, 0.9], 100)
    assert wide[1] - wide[0] > 1.5 * (high - low)
