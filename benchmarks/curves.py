"""Draw the learning curves of runs, validation success against pushes and against time; prints one JSON object.

    python benchmarks/curves.py runs/A runs/B --png docs/curves.png [--line "clear=58"] [--after runs/A]

Points are the evaluations of `metrics.jsonl` with their 95 % intervals; a run's name is that of its folder. `--after`
names the run whose parameters the last one began with (`--init-from`): it is drawn where that one ends.
"""

import argparse
import json
from pathlib import Path

import matplotlib

matplotlib.use("Agg")

# isort: split
import matplotlib.pyplot as plt

from pregrasp_jax.report import read_run
from pregrasp_jax.report.record import SECONDS, RunRecord

AXES = {"env_steps": ("environment steps (pushes)", 1.0), SECONDS: ("training time (min)", 1 / 60)}


def evaluations(run: RunRecord) -> list[dict]:
    """Return the rows of a run in which the policy was evaluated."""
    return [row for row in run.metrics if "eval/success_rate" in row]


def draw(runs: list[RunRecord], lines: dict[str, float], png: Path, *, after: RunRecord | None = None) -> None:
    """Write the two figures side by side; the last run begins where `after` ends."""
    figure, panels = plt.subplots(1, 2, figsize=(9, 3.4), sharey=True, layout="constrained")
    for panel, (x, (label, scale)) in zip(panels, AXES.items(), strict=True):
        for run in runs:
            rows = evaluations(run)
            rates = [100 * row["eval/success_rate"] for row in rows]
            bounds = [[100 * bound for bound in row["eval/success_ci95"]] for row in rows]
            errors = [[abs(rate - b[side]) for rate, b in zip(rates, bounds, strict=True)] for side in (0, 1)]
            start = evaluations(after)[-1][x] if after and run is runs[-1] else 0
            panel.errorbar(
                [scale * (start + row[x]) for row in rows], rates, errors, marker="o", capsize=3, label=run.name
            )
        for style, (name, percent) in zip(("--", ":", "-."), lines.items(), strict=False):
            panel.axhline(percent, color="gray", linestyle=style, linewidth=1, label=name)
        panel.set(xlabel=label, ylim=(0, 100), xlim=(0, None))
        panel.grid(alpha=0.3)
    panels[0].set_ylabel("success on validation scenes (%)")
    panels[1].legend(loc="lower right")
    figure.savefig(png, dpi=130)


def main() -> None:
    """Draw and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", type=Path, nargs="+")
    parser.add_argument("--png", type=Path, required=True)
    parser.add_argument("--line", action="append", default=[], metavar="NAME=PERCENT", help="a policy to compare with")
    parser.add_argument("--after", type=Path, metavar="RUN", help="the run that the last one began with")
    args = parser.parse_args()
    runs = [read_run(path) for path in args.runs]
    lines = {name: float(percent) for name, percent in (line.split("=") for line in args.line)}
    draw(runs, lines, args.png, after=args.after and read_run(args.after))
    best = {run.name: max(row["eval/success_rate"] for row in evaluations(run)) for run in runs}
    print(json.dumps({"best_validation_success": best, "png": str(args.png)}))


if __name__ == "__main__":
    main()
