"""How sure a success rate is, and whether two policies differ on the same scenes.

Host-side arithmetic on counts; nothing here needs jax.
"""

import math
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import asdict, dataclass
from typing import Any, TypeGuard

from pregrasp_jax.config import TaskConfig
from pregrasp_jax.settings import flatten

_Z95 = 1.959963984540054
"""Normal quantile of a two-sided 95 % interval."""

_OUTCOMES = ("both", "only A", "only B", "neither")

_SAME = ("object_set", "scene_bank_hash", "hull_bank_hash")
"""What two evaluations must share before their episodes can be paired."""

_OF_TARGET_PPG = ("strokes.free_space", "strokes.mask_radius")
"""What an evaluation may choose of strokes; everything else of them belongs to the training."""


def policy_name(document: Mapping[str, Any]) -> str:
    """Return what decided in an evaluation: a policy, or a search or the arm's reach together with it."""
    if document.get("planning"):
        return document["policy"] + " with planning"
    return document["policy"] + (", reachable" if document.get("reachable") else "")


def sensor_of(document: Mapping[str, Any]) -> str:
    """Return the sensor of an evaluation, if it gets anything wrong."""
    sensor = document.get("sensor", {}).get("name", "clean")
    return "" if sensor == "clean" else f"sensor {sensor}"


def counting_of(document: Mapping[str, Any]) -> str:
    """Return what was allowed of obstacles, if anything: rates that were counted differently are not compared."""
    allowed = document.get("config", {}).get("task", {}).get("obstacles_may_leave", False)
    return "obstacles may leave" if allowed else ""


def decides_alone(document: Mapping[str, Any]) -> bool:
    """Return whether a policy's best push was executed, come what may."""
    return not document.get("planning") and not document.get("reachable")


def is_number(value: Any) -> TypeGuard[float]:
    """Return whether a JSON value is a finite number."""
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


def is_interval(value: Any) -> TypeGuard[list[float]]:
    """Return whether a JSON value is a pair of finite numbers."""
    return isinstance(value, list) and len(value) == 2 and all(map(is_number, value))


def wilson_interval(successes: int, trials: int) -> tuple[float, float]:
    """Return the 95 % Wilson score interval of a success rate.

    Unlike the normal approximation it stays inside [0, 1] and has width at 0 and `trials` successes.

    Raises:
        ValueError: no trials, or more successes than trials.

    Source: Wilson (1927); `scipy.stats.binomtest(...).proportion_ci(method="wilson")`.
    """
    if not 0 <= successes <= trials or trials == 0:
        raise ValueError(
            f"got {successes} successes of {trials} trials; allowed is 0 <= successes <= trials, trials >= 1"
        )
    rate, shrink = successes / trials, _Z95**2 / trials
    center = (rate + shrink / 2) / (1 + shrink)
    half = _Z95 * math.sqrt(rate * (1 - rate) / trials + shrink / (4 * trials)) / (1 + shrink)
    # Exact at the ends, where rounding would otherwise leave 1e-17.
    low = 0.0 if successes == 0 else center - half
    high = 1.0 if successes == trials else center + half
    return low, high


def mcnemar_exact(only_a: int, only_b: int) -> float:
    """Return the two-sided exact p-value that discordant pairs fall either way equally often.

    Args:
        only_a: scenes in which only the first policy succeeded.
        only_b: scenes in which only the second did. Concordant scenes say nothing about the difference.

    Source: McNemar (1947) with the binomial instead of the chi-square distribution.
    """
    discordant = only_a + only_b
    tail = sum(math.comb(discordant, k) for k in range(min(only_a, only_b) + 1))
    return min(1.0, 2 * tail / 2**discordant)


def paired_difference_interval(both: int, only_a: int, only_b: int, neither: int) -> tuple[float, float]:
    """Return the 95 % interval of rate(a) - rate(b) measured on the same scenes.

    Two Wilson intervals joined with the correlation between the policies, which shared scenes make positive
    and which narrows the interval.

    Source: Newcombe (1998), "Improved confidence intervals for the difference between binomial proportions
    based on paired data", method 10.
    """
    trials = both + only_a + only_b + neither
    a, b = both + only_a, both + only_b
    rate_a, rate_b = a / trials, b / trials
    low_a, high_a = wilson_interval(a, trials)
    low_b, high_b = wilson_interval(b, trials)
    phi = _correlation(both, only_a, only_b, neither)

    def distance(error_a: float, error_b: float) -> float:
        return math.sqrt(max(0.0, error_a**2 - 2 * phi * error_a * error_b + error_b**2))

    difference = rate_a - rate_b
    return (
        difference - distance(rate_a - low_a, high_b - rate_b),
        difference + distance(high_a - rate_a, rate_b - low_b),
    )


def _correlation(both: int, only_a: int, only_b: int, neither: int) -> float:
    """Return Newcombe's continuity-corrected correlation of the 2 x 2 table; 0 if a margin is empty."""
    margins = (both + only_a) * (only_b + neither) * (both + only_b) * (only_a + neither)
    if margins == 0:
        return 0.0
    covariance = both * neither - only_a * only_b
    if covariance > 0:
        covariance = max(covariance - (both + only_a + only_b + neither) / 2, 0)
    return covariance / math.sqrt(margins)


@dataclass(frozen=True, kw_only=True)
class Comparison:
    """Two policies on the same scenes.

    Attributes:
        policies: what the two are called.
        episodes: scenes run by both.
        success_rates: share of scenes each grasped.
        success_ci95: Wilson interval of each.
        both: scenes grasped by both policies, and so on for `only_a`, `only_b`, `neither`.
        difference: rate(a) - rate(b).
        difference_ci95: its paired interval.
        p_value: exact McNemar test of no difference.
        settings: evaluation settings in which the two differ, ``name: a | b``.
    """

    policies: tuple[str, str]
    episodes: int
    success_rates: tuple[float, float]
    success_ci95: tuple[tuple[float, float], tuple[float, float]]
    both: int
    only_a: int
    only_b: int
    neither: int
    difference: float
    difference_ci95: tuple[float, float]
    p_value: float
    settings: tuple[str, ...]

    def to_dict(self) -> dict[str, Any]:
        """Return the fields as plain values for JSON."""
        return asdict(self)


def compare(a: Mapping[str, Any], b: Mapping[str, Any], *, across_workspaces: bool = False) -> Comparison:
    """Pair two evaluations (the JSON of `pregrasp-jax evaluate`) by scene and test their difference.

    Args:
        a: one evaluation.
        b: another.
        across_workspaces: the same scenes may have been run in two places.

    Raises:
        ValueError: the two did not run the same scenes with the same targets, or not in one place; one line names what
            differs.
    """
    if not across_workspaces and (places := _places(a, b)):
        raise ValueError(
            f"cannot pair: workspace is {places[0]} in the first file and {places[1]} in the second; allowed are equal "
            "ones, or --across-workspaces True"
        )
    for key in _SAME:
        if a[key] != b[key]:
            raise ValueError(
                f"cannot pair: {key} is {a[key]} in the first file and {b[key]} in the second; allowed are equal ones"
            )
    rows_a, rows_b = _by_scene(a["rows"]), _by_scene(b["rows"])
    if alone := sorted(rows_a.keys() ^ rows_b.keys()):
        raise ValueError(f"cannot pair: {len(alone)} scenes are in one file only, the first is scene {alone[0]}")
    for scene, row in rows_a.items():
        if row["target"] != rows_b[scene]["target"]:
            raise ValueError(
                f"cannot pair: the target of scene {scene} is {row['target']} in the first file and "
                f"{rows_b[scene]['target']} in the second"
            )
    return _compare_pairs(a, b, [(rows_a[scene]["success"], rows_b[scene]["success"]) for scene in sorted(rows_a)])


def workspace_of(document: Mapping[str, Any]) -> str:
    """Return the name of the place of an evaluation; before there were several, all were of the open table."""
    return document.get("workspace", TaskConfig().workspace)


def world_of(document: Mapping[str, Any]) -> list[Any]:
    """Return on what objects and scenes, and where, an evaluation was run."""
    return [*(document.get(key) for key in _SAME), workspace_of(document), document.get("workspace_hash", "")]


def _places(a: Mapping[str, Any], b: Mapping[str, Any]) -> tuple[str, ...]:
    """Return the places of two evaluations if they differ, in name or dimensions; older files name none."""
    names = tuple(map(workspace_of, (a, b)))
    hashes = tuple(document.get("workspace_hash", "") for document in (a, b))
    if names[0] != names[1]:
        return names
    if all(hashes) and hashes[0] != hashes[1]:
        return tuple(f"{name} {digest}" for name, digest in zip(names, hashes, strict=True))
    return ()


def _by_scene(rows: Iterable[Mapping[str, Any]]) -> dict[int, Mapping[str, Any]]:
    """Return evaluation rows by scene, refusing a scene that occurs twice."""
    by_scene: dict[int, Mapping[str, Any]] = {}
    for row in rows:
        if row["scene"] in by_scene:
            raise ValueError(f"cannot pair: scene {row['scene']} occurs twice in one file")
        by_scene[row["scene"]] = row
    return by_scene


def _compare_pairs(a: Mapping[str, Any], b: Mapping[str, Any], pairs: list[tuple[bool, bool]]) -> Comparison:
    both, only_a, only_b, neither = (
        sum(pair == kind for pair in pairs) for kind in ((True, True), (True, False), (False, True), (False, False))
    )
    trials = len(pairs)
    return Comparison(
        policies=(policy_name(a), policy_name(b)),
        episodes=trials,
        success_rates=((both + only_a) / trials, (both + only_b) / trials),
        success_ci95=(wilson_interval(both + only_a, trials), wilson_interval(both + only_b, trials)),
        both=both,
        only_a=only_a,
        only_b=only_b,
        neither=neither,
        difference=(only_a - only_b) / trials,
        difference_ci95=paired_difference_interval(both, only_a, only_b, neither),
        p_value=mcnemar_exact(only_a, only_b),
        settings=tuple(_differences(a, b)),
    )


def _differences(a: Mapping[str, Any], b: Mapping[str, Any]) -> Iterator[str]:
    """Yield one line for every setting in which two paired evaluations differ."""
    if places := _places(a, b):
        yield f"workspace: {places[0]} | {places[1]}"
    for key in ("camera", "physics", "seed"):
        if a[key] != b[key]:
            yield f"{key}: {a[key]} | {b[key]}"
    if (chosen := [bool(document.get("reachable")) for document in (a, b)])[0] != chosen[1]:
        yield f"reachable: {chosen[0]} | {chosen[1]}"
    sensors = [document.get("sensor", {}) for document in (a, b)]
    if sensors[0].get("name") == sensors[1].get("name"):  # else the task's own line says so
        for key in sorted(set(sensors[0]) & set(sensors[1])):
            if sensors[0][key] != sensors[1][key]:
                yield f"sensor.{key}: {sensors[0][key]} | {sensors[1][key]}"
    searches = [(document.get("planning") or {}).get("settings", {}) for document in (a, b)]
    for key in sorted(set(searches[0]) | set(searches[1])):
        if searches[0].get(key) != searches[1].get(key):
            yield f"planning.{key}: {searches[0].get(key, 'off')} | {searches[1].get(key, 'off')}"
    played = [flatten(document.get("config", {})) for document in (a, b)]
    for key in sorted(set(played[0]) & set(played[1]) - {"task.camera", "task.workspace"}):
        if (key.startswith("task.") or key in _OF_TARGET_PPG) and played[0][key] != played[1][key]:
            yield f"{key}: {played[0][key]} | {played[1][key]}"


def format_comparison(comparison: Comparison) -> str:
    """Return the lines that `pregrasp-jax compare` prints."""
    lines = [f"{comparison.episodes} scenes, paired"]
    for letter, name, rate, (low, high) in zip(
        "AB", comparison.policies, comparison.success_rates, comparison.success_ci95, strict=True
    ):
        lines.append(f"  {letter}  {name:<24} success {rate:6.1%}   95 % interval {low:.1%} to {high:.1%}")
    lines += [f"  differs in {setting}" for setting in comparison.settings]
    low, high = comparison.difference_ci95
    counts = {name: getattr(comparison, name.replace(" ", "_").lower()) for name in _OUTCOMES}
    lines += [
        "  succeeded: " + ", ".join(f"{name} {count}" for name, count in counts.items()),
        f"  A - B = {100 * comparison.difference:+.1f} points, 95 % interval {100 * low:+.1f} to {100 * high:+.1f}",
        f"  McNemar exact test: p = {comparison.p_value:.3g}",
    ]
    return "\n".join(lines)
