"""The page of an experiment: our table with intervals beside the paper's numbers, tests in pairs, curves with bands."""

import datetime
from collections.abc import Iterable, Iterator
from pathlib import Path

from pregrasp_jax import io
from pregrasp_jax.report.markup import Markup, element
from pregrasp_jax.report.page import make_page, section
from pregrasp_jax.report.svg import interval_mark
from pregrasp_jax.sweep import charts, driver
from pregrasp_jax.sweep.experiments import Experiment
from pregrasp_jax.sweep.folder import SweepFolder
from pregrasp_jax.sweep.page import details
from pregrasp_jax.sweep.spec import Spec
from pregrasp_jax.sweep.table import Row, Table, make_table
from pregrasp_jax.sweep.worker import read_metrics

_HEADER = ("", "success (95 %)", "", "of each seed", "pushes", "paper", "difference, points", "p", "better in")


def write_paper_page(folder: SweepFolder, spec: Spec, experiment: Experiment, path: Path) -> Path:
    """Write the page of an experiment, of what there is so far, whole or not at all; return where it lies."""
    table = make_table(folder, spec, reference=experiment.reference)
    by_label = {row.label: row for row in table.rows}
    rows = [by_label[label] for label in experiment.variants if label in by_label]
    curves = {m.trial.id: read_metrics(folder.run(m.trial)) for row in rows for m in row.members}
    drawn = charts.curve_figures(table, curves)
    figures = section("Learning curves", element("div", *drawn, class_="charts"), *_about_curves()) if drawn else ""
    results = section("Results", *_results(table, rows, spec.tests, experiment))
    # A figure of the paper shows its curves first.
    first = [figures, results] if experiment.name.startswith("figure") else [results, figures]
    differences = [element("ul", *(element("li", sentence) for sentence in experiment.differs))]
    sections = [*first, section("What differs from the paper", *differences), section("The sweep", *details(spec))]
    io.write_bytes(path, make_page(experiment.title, _header(folder, spec, experiment), sections).encode())
    return path


def _header(folder: SweepFolder, spec: Spec, experiment: Experiment) -> Iterator[Markup]:
    yield element("h1", experiment.title)
    yield element("p", experiment.about)
    states = folder.states()
    words = list(driver.status(spec, states).values())
    minutes, steps = spec.set.get("train.minutes"), spec.set.get("train.env_steps")
    length = f"{minutes:g} minutes" if minutes else f"{steps} pushes" if steps else "a whole run"
    written = datetime.datetime.now(datetime.UTC).strftime("%Y-%m-%d %H:%M UTC")
    text = (
        f"Preset {spec.preset}, {length} for each training, seeds {', '.join(map(str, spec.seeds))}; "
        f"{words.count('done')} of {len(words)} trials are done. Written {written}."
    )
    yield element("p", text, class_="soft")


def _results(table: Table, rows: list[Row], tests: Iterable[str], experiment: Experiment) -> Iterator[Markup]:
    for test in tests:
        yield element("h3", f"Test: {test}")
        head = element("tr", *(element("th", name, scope="col") for name in _HEADER))
        body = [_result_row(test, row, table, experiment) for row in rows]
        whole = element("table", element("thead", head), element("tbody", *body))
        yield element("div", whole, class_="scroll", tabindex="0", role="region", aria_label=f"test: {test}")
        if of_test := table.differences.get(test):
            widest = max(difference.half_width for difference in of_test.values())
            yield element("p", f"Differences within {100 * widest:.0f} points are noise (95 %).")
    text = (
        "Success is the mean over seeds, on the same scenes for all; intervals are of a bootstrap over seeds and "
        "scenes. The paper's numbers are success and mean pushes. The difference is that from the reference, paired by "
        "scene, with its interval, p corrected by Holm for the rows of the table, and how often a training of this row "
        "is better than one of the reference."
    )
    yield element("p", text, class_="soft")


def _result_row(test: str, row: Row, table: Table, experiment: Experiment) -> Markup:
    found, paper = row.tests.get(test), experiment.paper.get(test, {}).get(row.label, {})
    trained = row.members[0].trial.policy is None
    if found is None:
        measured = [f"not yet ({row.word})", "", "", ""]
    else:
        measured = [
            "{:.1f} % ({:.0f} to {:.0f})".format(*(100 * share for share in (found.rate, *found.interval))),
            interval_mark(found.rate, *found.interval),
            ", ".join(f"{100 * rate:.0f}" for rate in found.rates) if trained else "as it is",
            "" if found.motions is None else f"{found.motions:.2f}",
        ]
    theirs = [f"{paper['success']:g} %"] if "success" in paper else []
    theirs += [f"{paper['motions']:.2f}"] if "motions" in paper else []
    own = row.label == table.reference
    cells = [*measured, ", ".join(theirs), *(["reference", "", ""] if own else _difference(test, row, table))]
    name = element("th", row.label, scope="row")
    return element("tr", name, *(element("td", cell) for cell in cells), class_="own" if own else None)


def _difference(test: str, row: Row, table: Table) -> list[str]:
    """Return the difference from the reference with its interval, p, and how often the row is the better one."""
    found = table.differences.get(test, {}).get(row.label)
    if found is None:
        return ["", "", ""]
    low, high = found.interval
    text = f"{100 * found.difference:+.1f} ({100 * low:+.1f} to {100 * high:+.1f})".replace("-", chr(0x2212))
    return [text, f"{found.p_value:.2g}", f"{100 * found.improvement:.0f} %"]


def _about_curves() -> Iterator[Markup]:
    text = (
        "Success on validation scenes, greedy and with the grasp. Lines are means over the seeds at the pushes that "
        "all of them have been measured at, bands hold 95 % (bootstrap over seeds)."
    )
    yield element("p", text, class_="soft")
