"""The page of a sweep: what was found, how sure it is, and how to use it; in one file that needs nothing else."""

import datetime
import re
import shlex
from collections.abc import Iterator, Sequence
from pathlib import Path

from pregrasp_jax import io, yaml_file
from pregrasp_jax.machine import versions
from pregrasp_jax.report.charts import duration
from pregrasp_jax.report.markup import Markup, code, element
from pregrasp_jax.report.page import make_page, section
from pregrasp_jax.report.svg import interval_mark
from pregrasp_jax.sweep import charts, driver
from pregrasp_jax.sweep.folder import SweepFolder
from pregrasp_jax.sweep.spec import Spec, to_plain
from pregrasp_jax.sweep.table import Row, Table, Tested, make_table
from pregrasp_jax.sweep.table_files import notes, tested_text
from pregrasp_jax.sweep.trials import flags
from pregrasp_jax.sweep.worker import read_metrics

BEST = 3
"""Settings that are written out as command lines."""


def write_page(folder: SweepFolder, spec: Spec, path: Path) -> Path:
    """Write the page of a sweep, which may still be running, whole or not at all; return where it lies."""
    table = make_table(folder, spec)
    found = list(_curves(folder, spec, table))
    sections = [
        section("Settings by rank", *table_of(table), *_noted(table)),
        section("Settings against success", charts.parallel_coordinates(table)) if _searched(table) else "",
        section("Learning curves", element("div", *found, class_="charts")) if found else "",
        section("The best settings as command lines", *_commands(spec, table)),
        section("The sweep", *details(spec)),
    ]
    io.write_bytes(path, make_page(f"{folder.path.name}: a sweep", _header(folder, spec, table), sections).encode())
    return path


def table_of(table: Table) -> Iterator[Markup]:
    """Yield the table of a sweep."""
    tests = list(dict.fromkeys(name for row in table.rows for name in row.tests))
    header = ["rank", "setting", "seeds", "pushes trained", table.metric, "95 % interval", "", "pushes per success"]
    header += [*(f"test: {name}" for name in tests), "hours", "state"]
    head = element("tr", *(element("th", name, scope="col") for name in header))
    rows = [_table_row(row, table, tests) for row in table.rows]
    whole = element("table", element("thead", head), element("tbody", *rows))
    yield element("div", whole, class_="scroll", tabindex="0", role="region", aria_label="settings by rank")


def details(spec: Spec) -> Iterator[Markup]:
    """Yield what a sweep was asked for, and with which versions."""
    yield element("details", element("summary", "Spec"), element("pre", yaml_file.dump(to_plain(spec)).decode()))
    text = ", ".join(f"{name} {version}" for name, version in versions().items())
    yield element("p", f"Versions of this machine: {text}.", class_="soft")


def _header(folder: SweepFolder, spec: Spec, table: Table) -> Iterator[Markup]:
    yield element("h1", folder.path.name)
    written = datetime.datetime.now(datetime.UTC).strftime("%Y-%m-%d %H:%M UTC")
    yield element("p", f"Sweep of the preset {spec.preset}. Written {written}.", class_="soft")
    states = folder.states()
    words = list(driver.status(spec, states).values())
    done, dropped = words.count("done"), words.count("dropped")
    facts = [
        ("trials", f"{len(states)}", f"{done} done" + (f", {dropped} dropped" if dropped else "")),
        ("time", duration(sum(s.seconds for s in states)), "of all trials together"),
    ]
    best = next((row for row in table.rows if row.scores and not row.final), None)
    if best is not None and best.score is not None:
        facts.append((f"best {table.metric}", f"{best.score:.3g}", best.label))
    finals = [row for row in table.rows if row.final and row.tests]
    for row in finals[:1]:
        for name, found in row.tests.items():
            facts.append((f"fresh seeds, test: {name}", f"{100 * found.rate:.1f} %", _between(found)))
    fact_list = [
        element("div", element("dt", title), element("dd", value, element("small", small)))
        for title, value, small in facts
    ]
    yield element("dl", *fact_list, class_="facts")


def _between(found: Tested) -> str:
    return "95 % interval {:.0%} to {:.0%}".format(*found.interval)


def _table_row(row: Row, table: Table, tests: Sequence[str]) -> Markup:
    mark = interval_mark(row.score, *row.interval) if row.score is not None and row.interval else ""
    cells = [
        row.label,
        ", ".join(str(member.trial.seed) for member in row.members),
        f"{row.env_steps:,}",
        _score(row, table),
        "{:.0%} to {:.0%}".format(*row.interval) if row.interval else "",
        mark,
        "" if row.motions is None else f"{row.motions:.2f}",
        *(tested_text(row.tests[name]) if name in row.tests else "" for name in tests),
        f"{row.hours:.2f}",
        row.word,
    ]
    rank = "fresh seeds" if row.final else str(row.rank)
    own = "own" if row.final else None
    return element("tr", element("th", rank, scope="row"), *(element("td", cell) for cell in cells), class_=own)


def _score(row: Row, table: Table) -> str:
    if row.score is None:
        return ""
    return f"{100 * row.score:.1f} %" if table.metric.endswith("rate") else f"{row.score:.3g}"


def _noted(table: Table) -> Iterator[Markup]:
    for note in notes(table):
        yield element("p", re.sub(r" -(?=\d)", " \N{MINUS SIGN}", note))
    text = (
        f"{table.metric} is the best that each seed reached on validation scenes, so it flatters; intervals there are "
        "over seeds or scenes, whichever is wider. Tests are of scenes that no training and no choice has seen; their "
        "intervals are over seeds and scenes (stratified bootstrap), their p-values corrected by Holm."
    )
    yield element("p", text, class_="soft")


def _searched(table: Table) -> bool:
    return any(row.varied and not row.members[0].trial.name for row in table.rows)


def _curves(folder: SweepFolder, spec: Spec, table: Table) -> list[Markup]:
    rows = {m.trial.id: read_metrics(folder.run(m.trial)) for row in table.rows for m in row.members}
    return charts.curve_figures(table, rows)


def _commands(spec: Spec, table: Table) -> Iterator[Markup]:
    rows = [row for row in table.rows if row.scores and not row.final and row.members[0].trial.policy is None]
    if not rows:
        yield element("p", "Nothing has been measured yet.")
    for row in rows[:BEST]:
        trial = row.members[0].trial
        start = ["--init-from", trial.init_from] if trial.init_from else []
        words = ["pregrasp-jax", "train", spec.preset, "--run-dir", "runs/NAME", "--seed", "0", *start]
        yield element("p", f"{row.rank}. {row.label}")
        yield element("pre", code(shlex.join([*words, *flags(trial.settings)])))
