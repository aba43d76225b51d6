"""Run folders, evaluations and films as the report finds them."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from pregrasp_jax.cli.main import main
from pregrasp_jax.presets import PRESETS
from pregrasp_jax.report import Film, Step
from pregrasp_jax.settings import to_dict

HOSTILE = "<script>alert(\"x\")</script> & 'y'"


def log_row(env_steps: int, seconds: float, **values: Any) -> dict[str, Any]:
    ends = {"reasons/target_in_region": 5, "reasons/off_table": 3, "reasons/truncated": 2, "reasons/nan": 0}
    times = {"time/seconds": seconds, "time/collect": 0.75 * seconds, "time/learn": 0.25 * seconds}
    return {"env_steps": env_steps, "episodes": env_steps // 4, **ends, **times, **values}


def evaluation_row(env_steps: int, seconds: float, success: float, ci95: list[float]) -> dict[str, Any]:
    times = {"env_steps": env_steps, "episodes": env_steps // 4, "time/seconds": seconds}
    return times | {"eval/success_rate": success, "eval/success_ci95": ci95}


ROWS = [
    log_row(100, 10.0, **{"train/loss": None, "train/success_rate": 0.2, "train/epsilon": 1.0}),
    log_row(200, 30.0, **{"train/loss": 0.5, "train/q_taken": 0.4, "train/target_mean": 0.6}),
    evaluation_row(200, 30.0, 0.25, [0.1, 0.5]),
    log_row(400, 90.0, **{"train/loss": 0.25, "train/q_taken": 0.5, "train/target_mean": 0.5}),
    evaluation_row(300, 60.0, 0.75, [0.5, 0.9]),
]


def write_run(path: Path, rows: list[dict[str, Any]] | None = None, **config: Any) -> Path:
    path.mkdir(parents=True, exist_ok=True)
    (path / "config.yaml").write_text(yaml.safe_dump(to_dict(PRESETS["ci"]) | config))
    session = {"started": "now", "versions": {"jax": "9.8.7"}, "machine": {"cores": 2, "devices": ["cpu"]}}
    (path / "manifest.json").write_text(json.dumps({"hashes": {"hull bank": "abc"}, "sessions": [session]}))
    (path / "metrics.jsonl").write_text("".join(json.dumps(row) + "\n" for row in (ROWS if rows is None else rows)))
    (path / "best").mkdir(exist_ok=True)
    best = {"env_steps": 300, "success_rate": 0.75, "success_ci95": [0.5, 0.9], "failures": {"off_table": 10}}
    (path / "best" / "evaluation.json").write_text(json.dumps(best))
    return path


def write_evaluation(path: Path, policy: str, successes: list[int], **changes: Any) -> Path:
    rate = sum(successes) / len(successes)
    document = {
        "format": "pregrasp_jax evaluation 1",
        **{"policy": policy, "object_set": "seen", "camera": "orthographic", "physics": "native", "seed": 0},
        **{"episodes": len(successes), "success_rate": rate, "success_ci95": [0.123, 0.877]},
        **{"mean_motions": 2.34567, "std_motions": 0.5, "failures": {"off_table": len(successes) - sum(successes)}},
        **{"hull_bank_hash": "h", "scene_bank_hash": "s"},
        "rows": [{"scene": i, "target": "can", "success": bool(s)} for i, s in enumerate(successes)],
    }
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(document | changes))
    return path


def make_films() -> list[Film]:
    image = np.random.default_rng(0).integers(0, 255, (30, 40, 3)).astype(np.uint8)
    pictures = tuple((name, image) for name in ("scene", "height", "segmentation", "Q closed", "Q open"))
    steps = tuple(Step(f"push {i}", pictures) for i in range(8))
    return [Film("scene 3, target can", True, steps), Film(f"scene 4, target {HOSTILE}", False, steps)]


def run_main(*arguments: str) -> int:
    """Return the exit code of `pregrasp-jax` with these arguments."""
    try:
        return main(arguments)
    except SystemExit as error:
        return int(error.code or 0)
