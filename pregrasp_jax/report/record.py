"""What a run folder holds, read without any of the machinery that made it, so that older runs have reports too."""

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pregrasp_jax import yaml_file
from pregrasp_jax.evaluation.statistics import is_interval, is_number
from pregrasp_jax.report.svg import Point

SECONDS = "time/seconds"
"""Metric: training time, over all sessions, without start-up and compilation."""


@dataclass(frozen=True, kw_only=True)
class RunRecord:
    """A run as its files describe it.

    Attributes:
        path: of the folder.
        config: what the last session was made with: of manifest.json, or of config.yaml if that does not record it.
        manifest: content of manifest.json, empty if there is none.
        metrics: rows of metrics.jsonl.
        best: what was measured on the validation scenes when the best policy was saved, empty if none was.
    """

    path: Path
    config: dict[str, Any]
    manifest: dict[str, Any]
    metrics: Sequence[dict[str, Any]]
    best: dict[str, Any]

    @property
    def name(self) -> str:
        """Name of the folder."""
        return self.path.resolve().name

    def setting(self, stage: str, name: str, default: Any) -> Any:
        """Return one setting, or `default` if the run's config.yaml does not have it."""
        section = self.config.get(stage)
        return section.get(name, default) if isinstance(section, dict) else default

    def curve(self, y: str, x: str = "env_steps", *, scale: float = 1.0, x_scale: float = 1.0) -> list[Point]:
        """Return the points (x, y) of all rows that have both as finite numbers."""
        rows = [row for row in self.metrics if is_number(row.get(x)) and is_number(row.get(y))]
        return [(row[x] * x_scale, row[y] * scale) for row in rows]

    def last(self, metric: str) -> float | None:
        """Return the newest finite value of a metric."""
        return next((row[metric] for row in reversed(self.metrics) if is_number(row.get(metric))), None)


def read_run(path: Path) -> RunRecord:
    """Read a run folder; files that a young run does not have yet may be missing.

    Raises:
        ValueError: no run folder, or one of its files is damaged; one line says which.
    """
    if path.name != path.resolve().name:
        path = path.resolve()  # `.` is no name to show, nor one that an evaluation is found by
    config_file = path / "config.yaml"
    if not config_file.is_file():
        raise ValueError(f"{path} is not a run folder (it has no config.yaml); wanted the --run-dir of a training")
    manifest = _read_object(path / "manifest.json")
    config = manifest.get("config") or yaml_file.read(config_file)
    if not isinstance(config, dict):
        raise ValueError(f"{config_file}: not the settings of a run")
    return RunRecord(
        path=path,
        config=config,
        manifest=manifest,
        metrics=_read_rows(path / "metrics.jsonl"),
        best=_read_best(path / "best" / "evaluation.json"),
    )


def _read_best(path: Path) -> dict[str, Any]:
    """Return what was measured of the best policy, which may lack values but has none of a wrong type."""
    best = _read_object(path)
    checks = {"success_rate": is_number, "success_ci95": is_interval, "env_steps": is_number}
    if damaged := [key for key, is_good in checks.items() if best.get(key) is not None and not is_good(best[key])]:
        raise ValueError(f"{path}: damaged ({', '.join(damaged)})")
    return best


def _read_object(path: Path) -> dict[str, Any]:
    """Return a JSON object, empty if there is no such file."""
    if not path.exists():
        return {}
    try:
        value = json.loads(path.read_bytes())
    except ValueError:
        raise ValueError(f"{path}: damaged, not JSON") from None
    if not isinstance(value, dict):
        raise ValueError(f"{path}: damaged, not a JSON object")
    return value


def _read_rows(path: Path) -> list[dict[str, Any]]:
    """Return the rows of a JSON lines file; a last line without an end was cut by a crash, and is left out."""
    text = path.read_bytes().decode(errors="replace") if path.exists() else ""
    rows = []
    for index, line in enumerate(text.splitlines(keepends=True), start=1):
        try:
            row = json.loads(line)
        except ValueError:
            if not line.endswith("\n"):
                break
            raise ValueError(f"{path}: line {index} is damaged, not JSON") from None
        if not isinstance(row, dict) or not is_number(row.get("env_steps")):
            raise ValueError(f"{path}: line {index} is damaged, it has no env_steps")
        rows.append(row)
    return rows
