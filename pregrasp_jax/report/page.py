"""The page: sections in the order in which one asks, in one file that needs nothing from anywhere else."""

import datetime
import importlib.resources
import re
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

from pregrasp_jax import io
from pregrasp_jax.evaluation.statistics import is_number
from pregrasp_jax.messages import command
from pregrasp_jax.report import charts, results
from pregrasp_jax.report.films import Film, film_strips
from pregrasp_jax.report.markup import Markup, code, element, join
from pregrasp_jax.report.record import SECONDS, RunRecord

REPORT = "report.html"
"""Name of the page in its run folder."""

_POLICY = "default-src 'none'; img-src data:; style-src 'unsafe-inline'"
"""Content security policy: the browser itself refuses scripts and anything from a network."""

_FILM_KEY = (
    "Before every push: the camera view, what the policy sees (height and segmentation, from above, robot left), and "
    "its Q-values for a push with the hand closed and open. They are drawn where the push may end, the half ring "
    "ahead of the hand; the arrow is the push that was chosen."
)

_STROKES_KEY = (
    "Before every stroke: the camera view, what the policy sees (height; Target-PPG sees the segmentation too), and "
    "its values for some of the headings, among them the chosen one. They are drawn where the stroke may begin; the "
    "arrow is the stroke that was chosen."
)


def write_report(
    run: RunRecord,
    documents: Sequence[dict[str, Any]] = (),
    films: Sequence[Film] = (),
    *,
    films_note: str = "",
    policy: str = "",
    outdated: Sequence[str] = (),
    path: Path | None = None,
) -> Path:
    """Write the report of a run, whole or not at all.

    Without new films, those of the page that is there stay if they are of the same policy.

    Args:
        run: see `read_run`.
        documents: see `load_evaluations`.
        films: episodes of the run's policy.
        films_note: how they were found, or why there are none.
        policy: checksum of the run's policy, empty if it has none.
        outdated: evaluation files that are older than the run's policy.
        path: of the page; `report.html` in the run folder if None.

    Returns:
        Where it lies.
    """
    path = path or run.path / REPORT
    key = _STROKES_KEY if _of_strokes(run) else _FILM_KEY
    episodes = _episodes(films, films_note, policy, key=key) if films else kept_episodes(path, policy)
    io.write_bytes(path, build_page(run, documents, episodes, outdated=outdated).encode())
    return path


def kept_episodes(path: Path, policy: str) -> Markup:
    """Return the section of a page that shows episodes of this policy; nothing if it shows none, or another's.

    Args:
        path: of a page, which may be absent.
        policy: checksum.
    """
    text = path.read_text(errors="replace") if policy and path.is_file() else ""
    # What a page shows is escaped and sections are not nested: the first end is that of this one.
    found = re.search(rf'<section data-policy="{re.escape(policy)}">.*?</section>', text, re.DOTALL)
    return Markup(found[0] if found else "")


def build_page(
    run: RunRecord, documents: Sequence[dict[str, Any]], episodes: str = "", *, outdated: Sequence[str] = ()
) -> str:
    """Return the page; see `write_report`. Without `episodes` it says how to get them."""
    sections = [
        section("Results", *_results(run, documents), *_outdated(outdated)),
        section("Learning curves", *_learning(run)),
        episodes or section("Episodes", *_how_to_film(run)),
        section("Why episodes fail", *_figures(charts.failure_figures(run, results.of_run(run, documents)))),
        section("Where the time went", *_figures(charts.time_figures(run))),
        section("Configuration and versions", *_settings(run)),
    ]
    return make_page(f"{run.name}: report of a run", _header(run), sections)


def write_films(path: Path, films: Sequence[Film], *, title: str, text: str, note: str) -> None:
    """Write a page that shows nothing but episodes, whole or not at all.

    Args:
        path: of the page.
        films: the episodes.
        title: heading.
        text: the sentence below it.
        note: which episodes these are.
    """
    header = [element("h1", title), element("p", text, class_="soft")]
    io.write_bytes(path, make_page(title, header, [_episodes(films, note)]).encode())


def make_page(title: str, header: Iterable[Markup], sections: Iterable[str]) -> str:
    """Return a page that needs nothing from anywhere else."""
    style = importlib.resources.files("pregrasp_jax.report").joinpath("style.css").read_text()
    head = element(
        "head",
        element("meta", charset="utf-8"),
        element("meta", http_equiv="Content-Security-Policy", content=_POLICY),
        element("meta", name="viewport", content="width=device-width, initial-scale=1"),
        element("meta", name="color-scheme", content="light dark"),
        element("title", title),
        element("style", Markup(style)),
    )
    body = element("body", element("header", *header), element("main", *sections))
    return "<!DOCTYPE html>\n" + element("html", head, body, lang="en") + "\n"


def section(title: str, *content: Markup, policy: str | None = None) -> Markup:
    """Return a section of a page; `policy` is the checksum of the one that it shows."""
    return element("section", element("h2", title), "\n", join(content, "\n"), data_policy=policy)


def _header(run: RunRecord) -> Iterator[Markup]:
    """Yield the name of the run and its numbers."""
    yield element("h1", run.name)
    written = datetime.datetime.now(datetime.UTC).strftime("%Y-%m-%d %H:%M UTC")
    camera, object_set = run.setting("task", "camera", "?"), run.setting("assets", "object_set", "?")
    where = f"{object_set} objects, {run.setting('task', 'workspace', 'table')}, {camera} camera"
    text = f"Report of a training run on {where}, seed {run.config.get('seed', '?')}."
    yield element("p", f"{text} Written {written}.", class_="soft")
    facts = []
    if is_number(run.best.get("success_rate")):
        interval = run.best.get("success_ci95")
        between = "95 % interval {} to {}".format(*map(results.percent, interval)) if interval else ""
        facts.append(("best validation success", results.percent(run.best["success_rate"]), between))
        if is_number(run.best.get("env_steps")):
            facts.append(("reached after", f"{run.best['env_steps']:,} pushes", ""))
    steps = "strokes and updates" if _of_strokes(run) else "pushes"
    for metric, title, unit in (("env_steps", "trained for", steps), ("gradient_steps", "updates", "")):
        if (value := run.last(metric)) is not None:
            episodes = run.last("episodes") if metric == "env_steps" else None
            facts.append((title, f"{value:,} {unit}", "" if episodes is None else f"{episodes:,} episodes"))
    if (seconds := run.last(SECONDS)) is not None:
        facts.append(("training time", charts.duration(seconds), "without start-up"))
    fact_list = [
        element("div", element("dt", title), element("dd", value, element("small", small) if small else ""))
        for title, value, small in facts
    ]
    yield element("dl", *fact_list, class_="facts")


def _of_strokes(run: RunRecord) -> bool:
    return run.setting("train", "method", "q_learning") == "imitation"


def _results(run: RunRecord, documents: Sequence[dict[str, Any]]) -> Iterator[Markup]:
    if documents:
        yield results.result_table(run, documents)
        text = (
            "Success is a grasp that holds; intervals are Wilson's. Pushes are means over successes, with their "
            "standard deviation. The last column pairs scene by scene: difference in success with its 95 % interval, "
            "and McNemar's exact test."
        )
        yield element("p", text, class_="soft")
    else:
        yield element("p", f"No evaluation of this run was found in its folder {results.EVALUATIONS}.")
    if lacking := results.missing(run, documents):
        names = ", ".join(what for what, _ in lacking)
        commands = [element("pre", code(command)) for _, command in lacking]
        summary = element("summary", f"Commands that make them ({len(lacking)})")
        yield element("p", element("strong", "Missing"), f": {names}.")
        yield element("details", summary, *commands, open=None if documents else "")


def _learning(run: RunRecord) -> Iterator[Markup]:
    if figures := charts.learning_figures(run):
        text = (
            "Validation is on stable grasps that are not learned from."
            if _of_strokes(run)
            else "Validation plays the averaged network greedily on fixed scenes, grasp included; training explores."
        )
        yield element("p", text, class_="soft")
    yield from _figures(figures)


def _figures(figures: Sequence[Markup]) -> Iterator[Markup]:
    if figures:
        yield element("div", *figures, class_="charts")
    else:
        yield element("p", "Nothing has been measured yet: metrics.jsonl has no such row.")


def _outdated(files: Sequence[str]) -> Iterator[Markup]:
    """Yield which evaluations of this run are of a policy that it had before."""
    if files:
        text = (
            f": {', '.join(files)} is older than the run's policy. What is said of this run from there is true of an "
            "earlier policy; the same command measures it anew."
        )
        yield element("p", element("strong", "Outdated"), text)


def _how_to_film(run: RunRecord) -> Iterator[Markup]:
    yield element("p", "No episodes of this policy were played. This command plays some and writes the page anew:")
    yield element("pre", code(command("report", run.path)))


def _episodes(films: Sequence[Film], note: str, policy: str | None = None, *, key: str = _FILM_KEY) -> Markup:
    """Return the section of films, which `key` explains, marked with their policy if a later page may keep it."""
    ramps = [
        element("span", class_=f"ramp {name}", role="img", aria_label="dark to bright") for name in ("height", "q")
    ]
    legend = ["height 0 ", ramps[0], " 0.30 m; Q-values lowest ", ramps[1], " highest (numbers under each map)"]
    texts = [element("p", key, class_="soft"), element("p", *legend, class_="soft"), element("p", note)]
    return section("Episodes", *texts, *film_strips(films), policy=policy)


def _settings(run: RunRecord) -> Iterator[Markup]:
    sessions = run.manifest.get("sessions")
    latest = sessions[-1] if isinstance(sessions, list) and sessions and isinstance(sessions[-1], dict) else {}
    count = f"{len(sessions)} session{'s' if len(sessions) > 1 else ''}" if latest and sessions else "no manifest.json"
    parts = {
        "Configuration": run.config,
        f"Versions and machine ({count}, the latest is shown)" if latest else f"Versions ({count})": latest,
        "Hashes": run.manifest.get("hashes"),
    }
    for title, values in parts.items():
        if isinstance(values, dict) and values:
            rows = [
                element("tr", element("th", code(key), scope="row"), element("td", value))
                for key, value in _flatten(values)
            ]
            yield element("details", element("summary", title), element("table", *rows, class_="settings"))


def _flatten(values: dict[str, Any], prefix: str = "") -> Iterator[tuple[str, str]]:
    """Yield (dotted key, value as text) of nested settings."""
    for key, value in values.items():
        if isinstance(value, dict):
            yield from _flatten(value, f"{prefix}{key}.")
        else:
            text = ", ".join(map(str, value)) if isinstance(value, list) else "none" if value is None else str(value)
            yield f"{prefix}{key}", text
