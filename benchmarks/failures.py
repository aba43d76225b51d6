"""How the episodes of evaluations failed, by reason and by the width of their target; prints one JSON object.

    python benchmarks/failures.py FILE [FILE ...] [--edges 75 90 100]

Files are those of `pregrasp-jax evaluate --json`, whose objects must be where they were then.
"""

import pregrasp_jax  # noqa: F401  (sets NPROC before jax is imported)

# isort: split
import argparse
import json
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np

from pregrasp_jax.assets.bank import HullBank
from pregrasp_jax.config import Config
from pregrasp_jax.evaluation.results import load_evaluation
from pregrasp_jax.task.assembly import load_split_bank


def widest(bank: HullBank) -> dict[str, float]:
    """Return how wide objects are from above where they are widest, mm, by name."""
    vertices = np.asarray(bank.full.vertices)
    found = {}
    for name, hulls in zip(bank.names, np.asarray(bank.object_hulls), strict=True):
        xy = vertices[hulls[hulls >= 0]].reshape(-1, 3)[:, :2]
        found[name] = 1000 * float(np.linalg.norm(xy[:, None] - xy, axis=-1).max())
    return found


def table(rows: list[tuple[float, dict[str, Any]]], edges: list[float]) -> dict[str, dict[str, Any]]:
    """Return scenes, successes and reasons of failures for targets between two of the `edges`, mm."""
    found = {}
    for low, high in zip([0.0, *edges], [*edges, np.inf], strict=True):
        chosen = [row for width, row in rows if low <= width < high]
        name = f"from {low:g} mm" if high == np.inf else f"{low:g} to {high:g} mm"
        failures = Counter(row["reason"] for row in chosen if not row["success"])
        successes = sum(row["success"] for row in chosen)
        found[name] = {"scenes": len(chosen), "successes": successes, "failures": dict(failures.most_common())}
    return found


def main() -> None:
    """Read, count and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("files", nargs="+", type=Path, help="evaluation files; all of their episodes count together")
    parser.add_argument("--edges", nargs="+", type=float, default=[75.0, 90.0, 100.0], help="mm, between two rows")
    arguments = parser.parse_args()
    rows, by_target = [], dict[str, list[int]]()
    for file in arguments.files:
        document = load_evaluation(file)
        widths = widest(load_split_bank(Config.from_dict(document["config"]), "test"))
        rows += [(widths[row["target"]], row) for row in document["rows"]]
    for _, row in rows:
        counts = by_target.setdefault(row["target"], [0, 0])
        counts[0] += not row["success"]
        counts[1] += 1
    hardest = sorted(by_target.items(), key=lambda item: item[1][0], reverse=True)[:8]
    targets = [{"target": name, "failures": failures, "scenes": scenes} for name, (failures, scenes) in hardest]
    print(json.dumps({"by_width": table(rows, sorted(arguments.edges)), "hardest_targets": targets}))


if __name__ == "__main__":
    main()
