"""The paper's Table I: PPG, Target-PPG, ours and random strokes on the same test scenes; prints a table.

    python benchmarks/table1.py --out runs/table1 [--sets seen unseen DIR] [--policies ppg target-ppg pretrained ...]

A set is `seen`, `unseen`, or a folder of meshes, whose files begin with `folder-` and its name. Every evaluation is a
file in --out; those that are there are not made again, so that a run that was stopped goes on. Counted as in the paper:
obstacles may leave. A stroke and the way back are two motions; `held in any way` also counts targets that were lifted
together with another object.
"""

import pregrasp_jax  # noqa: F401  (sets NPROC before jax is imported)

# isort: split
import argparse
import dataclasses
import sys
from pathlib import Path
from typing import Any

from pregrasp_jax import io
from pregrasp_jax.config import AssetsConfig, PhysicsConfig
from pregrasp_jax.evaluation import load_evaluation
from pregrasp_jax.evaluation.player import make_player, run_evaluation
from pregrasp_jax.evaluation_config import EvaluationConfig, TaskOverrides
from pregrasp_jax.policies.ppg import STROKE_SCRIPTS

BUILTIN = ("seen", "unseen")

POLICIES = ("ppg", "target-ppg", "pretrained", "strokes", "target-strokes")

HEADER = ("set", "policy", "success", "held in any way", "attempts", "motions", "s per success", "most failures")


def evaluate(policy: str, object_set: str, episodes: int, threads: int) -> dict[str, Any]:
    """Return the evaluation of a policy on a set."""
    assets = AssetsConfig(object_set=object_set) if object_set in BUILTIN else AssetsConfig(object_dir=object_set)  # pyright: ignore[reportArgumentType]
    task = TaskOverrides(obstacles_may_leave=True)
    if policy in STROKE_SCRIPTS:
        task = dataclasses.replace(task, robot="barrett", primitive="push_grasp")
    request = EvaluationConfig(
        policy=policy,
        assets=assets,
        physics=PhysicsConfig(threads=threads),
        task=task,
        episodes=episodes,
    )

    def say(line: str) -> None:
        print(f"{policy} on {object_set}: {line}", file=sys.stderr)

    def progress(done: int, total: int, successes: int) -> None:
        if done % 20 == 0 or done == total:
            say(f"{done} of {total}, {successes} successes")

    return run_evaluation(request, make_player(request, say=say), progress=progress, say=say)


def row(object_set: str, document: dict[str, Any]) -> tuple[str, ...]:
    """Return the cells of an evaluation."""
    low, high = document["success_ci95"]
    good = [episode["seconds"] for episode in document["rows"] if episode["success"]]
    failures = ", ".join(f"{reason} {count}" for reason, count in list(document["failures"].items())[:3])
    motions = f"{document['mean_motions']:.2f} +- {document['std_motions']:.2f}" if good else "none"
    return (
        Path(object_set).name,
        document["policy"],
        f"{document['success_rate']:.1%} ({low:.0%} to {high:.0%})",
        f"{document['lenient_rate']:.1%}",
        f"{document['mean_attempts']:.2f}" if good else "none",
        motions,
        f"{sum(good) / len(good):.1f}" if good else "none",
        failures or "none",
    )


def named(given: str) -> str:
    """Return a name for a set or a policy that no other one has; of a folder also a hash of its place."""
    style, _, path = given.rpartition(":")
    if not Path(path).is_dir():
        return given.replace(":", "-")
    return "-".join(filter(None, [style, Path(path).name, io.content_hash(str(Path(path).resolve()))[:6]]))


def main() -> None:
    """Evaluate what is missing, and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True, help="folder of the evaluations")
    parser.add_argument("--sets", nargs="+", default=BUILTIN, help="seen, unseen, or folders of meshes")
    parser.add_argument("--policies", nargs="+", default=POLICIES, help="as for pregrasp-jax evaluate")
    parser.add_argument("--episodes", type=int, default=200, help="test scenes, from the first")
    parser.add_argument("--threads", type=int, default=0, help="of physics; 0 takes every core")
    arguments = parser.parse_args()
    rows: list[tuple[str, ...]] = [HEADER]
    for object_set in arguments.sets:
        for policy in arguments.policies:
            path = arguments.out / f"{named(object_set)}-{named(policy)}-{arguments.episodes}.json"
            if not path.exists():
                io.write_json(path, evaluate(policy, object_set, arguments.episodes, arguments.threads))
            rows.append(row(object_set, load_evaluation(path)))
    widths = [max(len(cells[column]) for cells in rows) for column in range(len(HEADER))]
    for cells in rows:
        print("| " + " | ".join(cell.ljust(width) for cell, width in zip(cells, widths, strict=True)) + " |")
        if cells is rows[0]:
            print("| " + " | ".join("-" * width for width in widths) + " |")


if __name__ == "__main__":
    main()
