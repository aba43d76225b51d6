"""Run a benchmark of this tree and of another one at once and compare what they print; prints one JSON object.

    git worktree add ../before COMMIT
    python benchmarks/pairs.py ../before env --rounds 4 -- --scenes 8

Each has a core of its own, swapped from round to round, so that both always meet the same load. Ratios are this tree's
number over the other's, for every number that both print: their geometric mean and those of the rounds. Linux only.
"""

import argparse
import json
import os
import statistics
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

HERE = Path(__file__).resolve().parent.parent


def start(tree: Path, name: str, options: list[str], core: int) -> subprocess.Popen:
    """Start a benchmark of a tree on one core."""
    paths = os.pathsep.join((str(tree), str(tree / "benchmarks")))
    command = [sys.executable, f"benchmarks/{name}.py", *options]
    process = subprocess.Popen(
        command, cwd=tree, env=os.environ | {"PYTHONPATH": paths, "NPROC": "1"}, stdout=subprocess.PIPE, text=True
    )
    os.sched_setaffinity(process.pid, {core})
    return process


def numbers(value: Any, name: str = "") -> Iterator[tuple[str, float]]:
    """Return the numbers in what a benchmark prints, by their path."""
    if isinstance(value, dict):
        for key, inner in value.items():
            yield from numbers(inner, f"{name}/{key}" if name else key)
    elif isinstance(value, list):
        for index, inner in enumerate(value):
            yield from numbers(inner, f"{name}/{index}")
    elif isinstance(value, int | float) and not isinstance(value, bool):
        yield name, value


def run_round(trees: tuple[Path, Path], name: str, options: list[str], cores: list[int]) -> dict[str, float]:
    """Return this tree's numbers over the other's."""
    running = [start(tree, name, options, core) for tree, core in zip(trees, cores, strict=True)]
    printed = [process.communicate()[0] for process in running]
    for tree, process in zip(trees, running, strict=True):
        if process.returncode:
            raise SystemExit(f"error: benchmarks/{name}.py of {tree} ended with {process.returncode}")
    ours, theirs = (dict(numbers(json.loads(text))) for text in printed)
    return {key: ours[key] / theirs[key] for key in ours if ours[key] > 0 and theirs.get(key, 0) > 0}


def main() -> None:
    """Parse arguments, run, print JSON."""
    parser = argparse.ArgumentParser(
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
        epilog="Options of the benchmark follow after --.",
    )
    parser.add_argument("other", type=Path, help="another checkout of this project")
    parser.add_argument("name", help="of a benchmark that both have")
    parser.add_argument("--rounds", type=int, default=4)
    given = sys.argv[1:]
    end = given.index("--") if "--" in given else len(given)
    args, options = parser.parse_args(given[:end]), given[end + 1 :]
    cores = sorted(os.sched_getaffinity(0))[:2]
    if len(cores) < 2:
        parser.error("two trees need two cores")
    trees = HERE, args.other.resolve()
    for tree in trees:
        if not (tree / "benchmarks" / f"{args.name}.py").is_file():
            parser.error(f"{tree} has no benchmarks/{args.name}.py")
    rounds = [run_round(trees, args.name, options, cores[:: (-1) ** turn]) for turn in range(args.rounds)]
    ratios = {
        key: {
            "mean": round(statistics.geometric_mean(r[key] for r in rounds), 4),
            "rounds": [round(r[key], 4) for r in rounds],
        }
        for key in rounds[0]
        if all(key in r for r in rounds)
    }
    print(json.dumps({"benchmark": args.name, "options": options, "ratios": ratios}, indent=2))


if __name__ == "__main__":
    main()
