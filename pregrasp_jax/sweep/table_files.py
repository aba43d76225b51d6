"""The table of a sweep as text, JSON and CSV."""

import csv
import io as text_io
from collections.abc import Sequence
from typing import Any

from pregrasp_jax import io
from pregrasp_jax.sweep.folder import SweepFolder
from pregrasp_jax.sweep.table import Row, Table, Tested


def format_table(table: Table) -> str:
    """Return the table as text."""
    header = ["rank", "setting", "seeds", "env steps", table.metric, "95 % interval", "seeds' range", "pushes"]
    names = list(dict.fromkeys(name for row in table.rows for name in row.tests))
    header += [*(f"test: {name}" for name in names), "hours", "state"]
    lines = [header, *(_cells(row, names) for row in table.rows)]
    widths = [max(len(line[i]) for line in lines) for i in range(len(header))]
    text = ["  ".join(cell.ljust(width) for cell, width in zip(line, widths, strict=True)).rstrip() for line in lines]
    return "\n".join([*text, *notes(table)])


def notes(table: Table) -> list[str]:
    """Return the sentences below a table."""
    said = []
    if table.noise is not None:
        said.append(f"Differences within {100 * table.noise:.0f} points are noise (95 %, {table.noise_of}).")
    for name, of_test in table.differences.items():
        for label, found in of_test.items():
            low, high = found.interval
            said.append(
                f"{name}: {label} minus {table.reference} = {100 * found.difference:+.1f} points, 95 % interval "
                f"{100 * low:+.1f} to {100 * high:+.1f}, p = {found.p_value:.2g}"
                f"{' (Holm)' if len(of_test) > 1 else ''}, better in {100 * found.improvement:.0f} % of pairs of seeds"
            )
    return said


def _cells(row: Row, names: Sequence[str]) -> list[str]:
    spread = f"{min(row.scores):.3g} to {max(row.scores):.3g}" if len(row.scores) > 1 else ""
    between = "{:.0%} to {:.0%}".format(*row.interval) if row.interval else ""
    tests = [tested_text(row.tests[name]) if name in row.tests else "" for name in names]
    return [
        f"{row.rank}" if not row.final else "final",
        row.label,
        " ".join(str(member.trial.seed) for member in row.members),
        f"{row.env_steps}",
        "" if row.score is None else f"{row.score:.3g}",
        between,
        spread,
        "" if row.motions is None else f"{row.motions:.2f}",
        *tests,
        f"{row.hours:.2f}",
        row.word,
    ]


def tested_text(tested: Tested) -> str:
    """Return success on test scenes with its interval, and pushes."""
    low, high = tested.interval
    pushes = "" if tested.motions is None else f", {tested.motions:.2f}"
    return f"{100 * tested.rate:.1f} % ({100 * low:.0f} to {100 * high:.0f}){pushes}"


def write_table(folder: SweepFolder, table: Table) -> None:
    """Write table.json and table.csv."""
    io.write_json(folder.path / "table.json", to_dict(table))
    text = text_io.StringIO()
    varied = list(dict.fromkeys(key for row in table.rows for key in row.varied))
    writer = csv.writer(text)
    about = ("trial", "seed", "env_steps", "score", "pushes", "hours", "state")
    writer.writerow(["rank", "final", "setting", *varied, *about])
    for row in table.rows:
        for member, word in zip(row.members, row.words, strict=True):
            values = [row.varied.get(key, "") for key in varied]
            numbers = [member.env_steps, member.score, member.motions, round(member.seconds / 3600, 4)]
            who = (member.trial.id, member.trial.seed)
            writer.writerow([row.rank, row.final, row.label, *values, *who, *numbers, word])
    io.write_bytes(folder.path / "table.csv", text.getvalue().encode())


def to_dict(table: Table) -> dict[str, Any]:
    """Return the table as plain data."""
    return {
        "metric": table.metric,
        "noise": table.noise,
        "noise_of": table.noise_of,
        "reference": table.reference,
        "rows": [
            {
                "rank": row.rank,
                "final": row.final,
                "setting": row.label,
                "varied": dict(row.varied),
                "seeds": [member.trial.seed for member in row.members],
                "trials": [member.trial.id for member in row.members],
                "env_steps": row.env_steps,
                "scores": list(row.scores),
                "score": row.score,
                "interval": row.interval,
                "pushes": row.motions,
                "hours": round(row.hours, 4),
                "state": row.word,
                "tests": {
                    name: {"rate": t.rate, "interval": t.interval, "pushes": t.motions, "rates": t.rates}
                    for name, t in row.tests.items()
                },
            }
            for row in table.rows
        ],
        "differences": {
            name: {label: vars(found) for label, found in of_test.items()}
            for name, of_test in table.differences.items()
        },
    }
