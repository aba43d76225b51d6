"""Results of an evaluation: episodes, what follows from them, and the file that two runs are compared by."""

import dataclasses
import json
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from pregrasp_jax import io
from pregrasp_jax.config import Config
from pregrasp_jax.evaluation.statistics import (
    counting_of,
    is_interval,
    is_number,
    policy_name,
    sensor_of,
    wilson_interval,
    workspace_of,
)
from pregrasp_jax.machine import versions
from pregrasp_jax.sensors import get_sensor
from pregrasp_jax.settings import to_dict

FORMAT = "pregrasp_jax evaluation 1"
"""Marks an evaluation file, so that a foreign JSON is not taken for one."""

_TEXTS = ("policy", "object_set", "camera", "physics", "hull_bank_hash", "scene_bank_hash")

_WANTED = "wanted a file written by pregrasp-jax evaluate --json"

GRASP_FAILED = "grasp_failed"
"""Reason of an episode whose target was in the closing region but not held; the others are `REASONS`."""


NOT_ALONE = "target_not_alone"
"""Reason of an episode whose target was lifted and held, but not as strokes count success: stably, and alone."""


@dataclass(frozen=True, kw_only=True)
class Episode:
    """How one scene went.

    Attributes:
        scene: row of the scene bank.
        target: name of the target object.
        reason: why it ended: `target_in_region` (and grasped, if a grasp was asked for), `grasp_failed`, or
            another of `types.REASONS`.
        success: whether the episode counts as one.
        motions: executed pushes, or strokes and retreats; what was refused before the hand moved is none.
        motions_per_attempt: 2 where an attempt is a stroke and the way back.
        return_: sum of rewards, undiscounted.
        seconds: s, time the robot spent on its motions.
        overflows: physics steps in which the engine had no room for every contact.
        obstruction: what kept the hand from where it was sent last, of `types.OBSTRUCTIONS`.
    """

    scene: int
    target: str
    reason: str
    success: bool
    motions: int
    return_: float
    seconds: float
    overflows: int = 0
    obstruction: str = "none"
    motions_per_attempt: int = 1

    @property
    def attempts(self) -> int:
        """Executed actions."""
        return self.motions // self.motions_per_attempt

    def to_dict(self) -> dict[str, Any]:
        """Return the row of the evaluation file."""
        return {
            "scene": self.scene,
            "target": self.target,
            "reason": self.reason,
            "obstruction": self.obstruction,
            "success": self.success,
            "motions": self.motions,
            "attempts": self.attempts,
            "return": round(self.return_, 4),
            "seconds": round(self.seconds, 4),
        }


@dataclass(frozen=True)
class EvaluationResult:
    """Episodes, in scene order, and what follows from them."""

    episodes: tuple[Episode, ...]

    @property
    def successes(self) -> int:
        """Episodes that succeeded."""
        return sum(episode.success for episode in self.episodes)

    @property
    def success_rate(self) -> float:
        """Share of episodes that succeeded."""
        return self.successes / len(self.episodes)

    @property
    def failures(self) -> dict[str, int]:
        """Failed episodes by reason, most frequent first."""
        return dict(Counter(episode.reason for episode in self.episodes if not episode.success).most_common())

    @property
    def obstructions(self) -> dict[str, dict[str, int]]:
        """What kept the hand from where it was sent in failed episodes, by reason and then by obstruction."""
        found: dict[str, Counter[str]] = {}
        for episode in self.episodes:
            if not episode.success and episode.obstruction != "none":
                found.setdefault(episode.reason, Counter())[episode.obstruction] += 1
        return {reason: dict(counts.most_common()) for reason, counts in found.items()}

    def summary(self) -> dict[str, Any]:
        """Return the measured keys of the evaluation file, without rows.

        Motions are counted over successful episodes (Table I) and are None without one; their standard deviation is
        that of these episodes, not an estimate for more of them. The robot's seconds per motion are over all motions.
        The lenient rate also counts targets that are held in any other way.
        """
        total = len(self.episodes)
        motions, attempts = (
            [getattr(episode, kind) for episode in self.episodes if episode.success] for kind in ("motions", "attempts")
        )
        executed = sum(episode.motions for episode in self.episodes)
        return {
            "success_rate": self.success_rate,
            "success_ci95": list(wilson_interval(self.successes, total)),
            "in_region_rate": (self.successes + self.failures.get(GRASP_FAILED, 0)) / total,
            "mean_motions": float(np.mean(motions)) if motions else None,
            "std_motions": float(np.std(motions)) if motions else None,
            "mean_attempts": float(np.mean(attempts)) if attempts else None,
            "lenient_rate": (self.successes + self.failures.get(NOT_ALONE, 0)) / total,
            "mean_return": sum(episode.return_ for episode in self.episodes) / total,
            "failures": self.failures,
            "obstructions": self.obstructions,
            "overflows": sum(episode.overflows > 0 for episode in self.episodes),
            "seconds_per_motion": sum(e.seconds for e in self.episodes) / executed if executed else None,
        }


def evaluation_document(
    result: EvaluationResult,
    *,
    policy: str,
    config: Config,
    seed: int,
    hull_bank_hash: str,
    scene_bank_hash: str,
    workspace_hash: str,
    wall_seconds: float,
    planning: Mapping[str, Any] | None = None,
    reachable: bool = False,
) -> dict[str, Any]:
    """Return the content of an evaluation file (`pregrasp-jax evaluate --json`).

    Args:
        result: what was measured.
        policy: as the user named it.
        config: what the environment was made from.
        seed: of the policy's randomness.
        hull_bank_hash: which objects.
        scene_bank_hash: which scenes; two files can be paired only if both hashes agree.
        workspace_hash: which place; files of two places are paired only when that is asked for.
        wall_seconds: s, how long the evaluation took on this machine, compilation included.
        planning: settings of the search that decided and what it took, None without one.
        reachable: whether pushes out of reach were passed over.
    """
    return {
        "format": FORMAT,
        "policy": policy,
        "planning": None if planning is None else dict(planning),
        "reachable": reachable,
        "physics": config.physics.engine,
        "object_set": config.assets.object_set,
        "camera": config.task.camera,
        "sensor": {"name": config.task.sensor, **dataclasses.asdict(get_sensor(config.task.sensor))},
        "workspace": config.task.workspace,
        "robot": config.task.robot,
        "primitive": config.task.primitive,
        "episodes": len(result.episodes),
        "seed": seed,
        **result.summary(),
        "wall_seconds": round(wall_seconds, 1),
        "config_hash": io.content_hash(to_dict(config)),
        "hull_bank_hash": hull_bank_hash,
        "scene_bank_hash": scene_bank_hash,
        "workspace_hash": workspace_hash,
        "versions": versions(),
        "config": to_dict(config),
        "rows": [episode.to_dict() for episode in result.episodes],
    }


def load_evaluation(path: Path) -> dict[str, Any]:
    """Read an evaluation file that has all that comparisons and reports show.

    Raises:
        ValueError: missing, damaged, not JSON, or not written by `pregrasp-jax evaluate --json`.
    """
    try:
        document = json.loads(path.read_text())
    except OSError as error:
        raise ValueError(f"{path}: {error.strerror}; {_WANTED}") from None
    except ValueError:
        raise ValueError(f"{path}: not JSON; {_WANTED}") from None
    if not isinstance(document, dict) or document.get("format") != FORMAT:
        raise ValueError(f"{path}: not an evaluation; {_WANTED}")
    if damaged := _damaged_keys(document):
        raise ValueError(f"{path}: damaged evaluation ({', '.join(damaged)}); {_WANTED}")
    return document


def _damaged_keys(document: dict[str, Any]) -> list[str]:
    """Return the keys that are missing or of no use; only `config` may be missing, it is not needed to pair."""
    interval, rows, config = document.get("success_ci95"), document.get("rows"), document.get("config", {})
    motions = [document.get("mean_motions"), document.get("std_motions")]
    good = {key: isinstance(document.get(key), str) for key in _TEXTS}
    good["seed"] = isinstance(document.get("seed"), int)
    good["episodes"] = isinstance(document.get("episodes"), int) and document["episodes"] > 0
    good["success_rate"] = is_number(document.get("success_rate"))
    good["success_ci95"] = is_interval(interval)
    good["mean_motions"] = motions == [None, None] or all(map(is_number, motions))
    good["failures"] = isinstance(document.get("failures"), dict)
    good |= {key: isinstance(document.get(key, ""), str) for key in ("workspace", "workspace_hash")}
    found = document.get("obstructions", {})
    good["obstructions"] = isinstance(found, dict) and all(isinstance(counts, dict) for counts in found.values())
    good["rows"] = isinstance(rows, list) and len(rows) > 0 and all(map(_is_row, rows))
    planning = document.get("planning") or {}
    good["planning"] = isinstance(planning, dict) and isinstance(planning.get("settings", {}), dict)
    good["sensor"] = isinstance(document.get("sensor", {}), dict)
    good["reachable"] = isinstance(document.get("reachable", False), bool)
    good["config"] = isinstance(config, dict) and isinstance(config.get("task", {}), dict)
    return [key for key, is_good in good.items() if not is_good]


def _is_row(row: Any) -> bool:
    """Return whether an episode can be paired by scene."""
    kinds = {"scene": int, "target": str, "success": bool}
    return isinstance(row, dict) and all(isinstance(row.get(key), kind) for key, kind in kinds.items())


def format_evaluation(document: dict[str, Any]) -> str:
    """Return the table that `pregrasp-jax evaluate` prints."""
    low, high = document["success_ci95"]
    title = f"{policy_name(document)} on {document['episodes']} {document['object_set']} scenes"
    lines = {
        "success": f"{document['success_rate']:.1%}   95 % interval {low:.1%} to {high:.1%}",
        "target in region": f"{document['in_region_rate']:.1%}",
        "motions": _spread(document["mean_motions"], document["std_motions"]),
        "robot time": _maybe(document["seconds_per_motion"], "{:.2f} s per motion"),
        "mean return": f"{document['mean_return']:.2f}",
        "failures": ", ".join(_failures(document)) or "none",
    }
    if planning := document.get("planning"):
        lines["decision"] = "{seconds:.2f} s, {pushes:.0f} simulated pushes".format(**planning["per_decision"])
    if document.get("mean_attempts", document["mean_motions"]) != document["mean_motions"]:
        lines["attempts"] = f"{document['mean_attempts']:.2f} per success"
    if document.get("lenient_rate", document["success_rate"]) != document["success_rate"]:
        lines["held in any way"] = f"{document['lenient_rate']:.1%}"
    if document.get("overflows"):
        lines["contacts dropped"] = f"in {document['overflows']} episodes: the limits of the physics engine are too low"
    where = workspace_of(document), counting_of(document)
    how = f"{document['physics']} physics", f"{document['camera']} camera", sensor_of(document)
    settings = ", ".join(filter(None, (*where, *how, f"seed {document['seed']}")))
    rows = [f"  {name:<18}{text}" for name, text in lines.items()]
    return "\n".join([f"{title} ({settings}, {document['wall_seconds']:.0f} s)", *rows])


def _failures(document: dict[str, Any]) -> Iterator[str]:
    """Yield reasons with their number, and what was in the way."""
    for reason, count in document["failures"].items():
        found = document.get("obstructions", {}).get(reason, {})
        details = ", ".join(f"{name} {number}" for name, number in found.items())
        yield f"{reason} {count} ({details})" if details else f"{reason} {count}"


def _spread(mean: float | None, std: float | None) -> str:
    return "no success to count" if mean is None else f"{mean:.2f} +- {std:.2f} per success"


def _maybe(value: float | None, template: str) -> str:
    return "no motion" if value is None else template.format(value)


def format_evaluations(documents: list[dict[str, Any]]) -> str:
    """Return a table of several evaluations, one line each."""
    header = ("policy", "scenes", "success", "95 % interval", "in region", "motions", "most frequent failure")
    rows = [header, *(_row(document) for document in documents)]
    widths = [max(len(row[column]) for row in rows) for column in range(len(header))]
    return "\n".join(
        "  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip() for row in rows
    )


def _row(document: dict[str, Any]) -> tuple[str, ...]:
    low, high = document["success_ci95"]
    mean, std = document["mean_motions"], document["std_motions"]
    return (
        policy_name(document),
        f"{document['episodes']} {document['object_set']}",
        f"{document['success_rate']:.1%}",
        f"{low:.0%} to {high:.0%}",
        f"{document['in_region_rate']:.1%}",
        "none" if mean is None else f"{mean:.2f} +- {std:.2f}",
        next((f"{reason} {count}" for reason, count in document["failures"].items()), "none"),
    )
