"""Intervals and the paired test, against scipy, published numbers, and hand counts."""

import math

import numpy as np
import pytest
from scipy import stats

from pregrasp_jax.evaluation import statistics
from pregrasp_jax.evaluation.statistics import compare, mcnemar_exact, paired_difference_interval, wilson_interval


@pytest.mark.parametrize(("successes", "trials"), [(0, 1), (0, 30), (1, 1), (93, 100), (67, 100), (15, 15), (81, 263)])
def test_wilson_agrees_with_scipy(successes: int, trials: int) -> None:
    expected = stats.binomtest(successes, trials).proportion_ci(method="wilson")
    assert wilson_interval(successes, trials) == pytest.approx((expected.low, expected.high), abs=1e-12)


def test_wilson_published_number() -> None:
    # Newcombe (1998), "Two-sided confidence intervals for the single proportion", Table I, method 3.
    assert [round(x, 4) for x in wilson_interval(81, 263)] == [0.2553, 0.3662]
    # The normal approximation, the likely bug, gives [0.2522, 0.3638].
    assert wilson_interval(0, 10)[0] == 0.0
    assert wilson_interval(10, 10)[1] == 1.0


@pytest.mark.parametrize(("successes", "trials"), [(0, 0), (3, 2), (-1, 2)])
def test_wilson_refuses(successes: int, trials: int) -> None:
    with pytest.raises(ValueError, match=f"got {successes} successes of {trials} trials"):
        wilson_interval(successes, trials)


@pytest.mark.parametrize("only_a", [0, 1, 5, 12, 40])
@pytest.mark.parametrize("only_b", [0, 1, 5, 13])
def test_mcnemar_agrees_with_scipy(only_a: int, only_b: int) -> None:
    trials = only_a + only_b
    expected = stats.binomtest(only_a, trials).pvalue if trials else 1.0
    assert mcnemar_exact(only_a, only_b) == pytest.approx(expected, rel=1e-9)


def test_mcnemar_by_hand() -> None:
    # 1 against 5: 2 (1 + 6) / 64. One-sided would be 7/64; the chi-square test gives 0.10.
    assert mcnemar_exact(1, 5) == mcnemar_exact(5, 1) == 14 / 64


def test_paired_interval_published_number() -> None:
    # Newcombe (1998), paired data, Table II (36, 12, 2, 0), method 10. Without the correlation: [0.0645, 0.3372].
    assert [round(x, 4) for x in paired_difference_interval(36, 12, 2, 0)] == [0.0569, 0.3404]


def test_paired_interval_is_antisymmetric_and_narrower_than_unpaired() -> None:
    low, high = paired_difference_interval(60, 20, 5, 15)
    assert paired_difference_interval(60, 5, 20, 15) == pytest.approx((-high, -low))
    # The same margins without correlation are wider.
    independent = paired_difference_interval(52, 28, 13, 7)
    assert high - low < independent[1] - independent[0]


@pytest.mark.parametrize("counts", [(30, 0, 0, 0), (0, 0, 0, 30), (0, 30, 0, 0), (15, 0, 0, 15)])
def test_paired_interval_at_the_corners(counts: tuple[int, int, int, int]) -> None:
    low, high = paired_difference_interval(*counts)
    difference = (counts[1] - counts[2]) / 30
    assert -1 <= low <= difference <= high <= 1
    assert math.isfinite(low) and low < high


def test_paired_interval_covers_95_percent() -> None:
    probabilities = np.array([0.6, 0.2, 0.08, 0.12])
    tables = np.random.default_rng(0).multinomial(100, probabilities, size=2000)
    intervals = [paired_difference_interval(*map(int, table)) for table in tables]
    share = np.mean([low <= 0.12 <= high for low, high in intervals])
    assert 0.935 <= share <= 0.975


def _evaluation(policy: str, successes: list[bool], **changes: object) -> dict:
    rows = [
        {"scene": scene, "target": f"can{scene}", "success": success, "reason": "x", "motions": 1}
        for scene, success in enumerate(successes)
    ]
    header = {"object_set": "seen", "scene_bank_hash": "s", "hull_bank_hash": "h", "camera": "orthographic"}
    return {"policy": policy, "physics": "native", "seed": 0, "rows": rows, **header, **changes}


A = _evaluation("a", [True, True, True, True, False, False, True])
B = _evaluation("b", [True, False, False, False, True, False, True])


def test_compare_counts_pairs() -> None:
    result = compare(A, B)
    assert (result.both, result.only_a, result.only_b, result.neither) == (2, 3, 1, 1)
    assert result.success_rates == (5 / 7, 3 / 7)
    assert result.difference == 2 / 7
    assert result.p_value == 2 * (1 + 4) / 16
    assert result.difference_ci95[0] < 2 / 7 < result.difference_ci95[1]


def test_compare_pairs_by_scene_not_by_position() -> None:
    assert compare(A, {**B, "rows": B["rows"][::-1]}) == compare(A, B)


def test_compare_reports_settings_that_may_differ() -> None:
    result = compare(A, {**B, "camera": "pinhole"})
    assert result.settings == ("camera: orthographic | pinhole",)
    text = statistics.format_comparison(result)
    assert "A - B = +28.6 points" in text
    assert "succeeded: both 2, only A 3, only B 1, neither 1" in text
    assert "p = 0.625" in text
    assert "camera: orthographic | pinhole" in text


def test_two_places_are_paired_only_when_asked_to() -> None:
    there = {**B, "workspace": "shelf", "workspace_hash": "v", "config": {"task": {"place": {"back": 0.3}}}}
    refused = "workspace is table in the first file and shelf in the second; allowed are equal ones, or --across-work"
    with pytest.raises(ValueError, match=refused):
        compare(A, there)
    result = compare(A, there, across_workspaces=True)
    assert (result.only_a, result.only_b) == (3, 1) and result.settings == ("workspace: table | shelf",)
    wider = {**there, "workspace_hash": "w", "config": {"task": {"place": {"back": 0.4}}}}
    with pytest.raises(ValueError, match="workspace is shelf v in the first file and shelf w in the second"):
        compare(there, wider)
    settings = compare(there, wider, across_workspaces=True).settings
    assert settings == ("workspace: shelf v | shelf w", "task.place.back: 0.3 | 0.4")
    assert compare(there, there).settings == ()
    # An evaluation of an earlier version names no place, or no dimensions.
    assert compare(A, {**B, "workspace": "table", "workspace_hash": "u"}).settings == ()


def test_how_target_ppg_plays_is_named_and_how_it_was_trained_is_not():
    a, b = (
        {**B, "config": {"task": {}, "strokes": {"free_space": name, "width": width}}}
        for name, width in (("feasible", 0.25), ("cluster", 1.0))
    )
    assert compare(a, b).settings == ("strokes.free_space: feasible | cluster",)


@pytest.mark.parametrize(
    ("other", "message"),
    [
        ({**B, "scene_bank_hash": "t"}, "scene_bank_hash is s in the first file and t in the second"),
        ({**B, "hull_bank_hash": "i"}, "hull_bank_hash is h in the first file and i in the second"),
        ({**B, "object_set": "unseen"}, "object_set is seen in the first file and unseen"),
        ({**B, "rows": B["rows"][:5]}, "2 scenes are in one file only, the first is scene 5"),
        ({**B, "rows": [*B["rows"][:-1], {**B["rows"][6], "target": "mug"}]}, "target of scene 6 is can6"),
        ({**B, "rows": [*B["rows"], B["rows"][0]]}, "scene 0 occurs twice"),
    ],
)
def test_compare_refuses_what_cannot_be_paired(other: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        compare(A, other)
