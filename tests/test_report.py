"""The report: its numbers and curves by hand, escaping, what is missing or damaged, and the page itself."""

import html.parser
import importlib.util
import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest
import yaml
from fake_env import fake_env

from pregrasp_jax import __main__ as main_module
from pregrasp_jax.checkpoint import save_policy
from pregrasp_jax.cli import player
from pregrasp_jax.cli.report import report, report_session
from pregrasp_jax.config import PRESETS, to_dict
from pregrasp_jax.learning.networks import QNetwork
from pregrasp_jax.report import Film, Step, build_page, load_evaluations, read_run, write_report
from pregrasp_jax.report.charts import duration, failure_figures, learning_figures, time_figures
from pregrasp_jax.report.films import data_uri
from pregrasp_jax.report.markup import Markup, element, join
from pregrasp_jax.report.results import BASELINES, missing
from pregrasp_jax.report.svg import Series, bar_chart, format_tick, interval_mark, line_chart, thin, ticks
from pregrasp_jax.training.trainer import PHASES

ROOT = Path(__file__).parent.parent
HOSTILE = "<script>alert(\"x\")</script> & 'y'"


def _log_row(env_steps: int, seconds: float, **values: Any) -> dict[str, Any]:
    ends = {"reasons/target_in_region": 5, "reasons/off_table": 3, "reasons/truncated": 2, "reasons/nan": 0}
    times = {"time/seconds": seconds, "time/collect": 0.75 * seconds, "time/learn": 0.25 * seconds}
    return {"env_steps": env_steps, "episodes": env_steps // 4, **ends, **times, **values}


ROWS = [
    _log_row(100, 10.0, **{"train/loss": None, "train/success_rate": 0.2, "train/epsilon": 1.0}),
    _log_row(200, 30.0, **{"train/loss": 0.5, "train/q_taken": 0.4, "train/target_mean": 0.6}),
    {"env_steps": 200, "episodes": 50, "eval/success_rate": 0.25, "eval/success_ci95": [0.1, 0.5]},
    _log_row(400, 90.0, **{"train/loss": 0.25, "train/q_taken": 0.5, "train/target_mean": 0.5}),
    {"env_steps": 300, "episodes": 90, "eval/success_rate": 0.75, "eval/success_ci95": [0.5, 0.9]},
]


def _write_run(path: Path, rows: list[dict[str, Any]] | None = None, **config: Any) -> Path:
    path.mkdir(parents=True, exist_ok=True)
    (path / "config.yaml").write_text(yaml.safe_dump(to_dict(PRESETS["ci"]) | config))
    session = {"started": "now", "versions": {"jax": "9.8.7"}, "machine": {"cores": 2, "devices": ["cpu"]}}
    (path / "manifest.json").write_text(json.dumps({"hashes": {"hull bank": "abc"}, "sessions": [session]}))
    (path / "metrics.jsonl").write_text("".join(json.dumps(row) + "\n" for row in (ROWS if rows is None else rows)))
    (path / "best").mkdir(exist_ok=True)
    best = {"env_steps": 300, "success_rate": 0.75, "success_ci95": [0.5, 0.9], "failures": {"off_table": 10}}
    (path / "best" / "evaluation.json").write_text(json.dumps(best))
    return path


def _write_evaluation(path: Path, policy: str, successes: list[int], **changes: Any) -> Path:
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


def _films() -> list[Film]:
    image = np.random.default_rng(0).integers(0, 255, (30, 40, 3)).astype(np.uint8)
    pictures = tuple((name, image) for name in ("scene", "height", "segmentation", "Q closed", "Q open"))
    steps = tuple(Step(f"push {i}", pictures) for i in range(8))
    return [Film("scene 3, target can", True, steps), Film(f"scene 4, target {HOSTILE}", False, steps)]


@pytest.fixture
def run_dir(tmp_path: Path) -> Path:
    return _write_run(tmp_path / "runs" / "first")


def _texts(page: str) -> list[str]:
    """Return the text of every table cell."""
    return [re.sub(r"<[^>]*>", "", cell) for cell in re.findall(r"<t[hd]\b[^>]*>(.*?)</t[hd]>", page, re.S)]


# --- results ---------------------------------------------------------------------------------------------------------


def test_the_table_shows_the_numbers_of_the_files(run_dir: Path) -> None:
    _write_evaluation(run_dir / "evaluations" / "a.json", "clear", [0, 0, 0, 0, 0, 0, 1, 0])
    _write_evaluation(run_dir / "evaluations" / "b.json", "elsewhere/first", [1, 1, 1, 1, 1, 1, 0, 0])
    other = _write_evaluation(run_dir / "evaluations" / "c.json", "random", [0, 1], scene_bank_hash="t")
    other.write_text(other.read_text().replace("2.34567", "null").replace('"std_motions": 0.5', '"std_motions": null'))
    run = read_run(run_dir)
    cells = _texts(build_page(run, load_evaluations(run), []))
    table = cells[: cells.index("this run minus it") + 1 + 3 * 9]
    own, chance, clear = table[9:18], table[18:27], table[27:36]
    assert own == [
        *("this run (elsewhere/first)", "seen", "orthographic", "8", "75 %", "12.3 % to 87.7 %", "", "2.35 ± 0.50", "")
    ]
    assert chance[4:] == ["50 %", "12.3 % to 87.7 %", "", "no success", "not on the same scenes"]
    # 6 scenes only this run, 1 only clear: +62.5 points, McNemar 2 (1 + 7) / 2^7 = 0.125.
    assert clear[0] == "clear" and clear[4] == "12.5 %"
    assert clear[8].startswith("+62 points (") and clear[8].endswith("p = 0.12")


def test_files_named_on_the_command_line_replace_those_of_the_folder(run_dir: Path, tmp_path: Path) -> None:
    _write_evaluation(run_dir / "evaluations" / "a.json", "clear", [1, 0])
    named = _write_evaluation(tmp_path / "b.json", "lookahead", [1, 1])
    assert [document["policy"] for document in load_evaluations(read_run(run_dir), (named,))] == ["lookahead"]


def test_missing_evaluations_are_named_with_their_command(run_dir: Path) -> None:
    run = read_run(run_dir)
    assert [what for what, _ in missing(run, [])] == [f"{who} on seen objects" for who in ("this run", *BASELINES)]
    _write_evaluation(run_dir / "evaluations" / "a.json", "clear", [1, 0] * 20)
    _write_evaluation(run_dir / "evaluations" / "b.json", "first", [1, 0] * 20)
    lacking = dict(missing(run, load_evaluations(run)))
    assert list(lacking) == ["random on seen objects", "straight on seen objects", "lookahead on seen objects"]
    assert lacking["straight on seen objects"] == (
        "python evaluate.py --policy straight --object-set seen --episodes 40 --json "
        f"{run_dir}/evaluations/seen-straight.json"
    )
    page = build_page(run, load_evaluations(run), [])
    assert "random on seen objects, straight on seen objects, lookahead on seen objects" in page


def test_commands_keep_the_task_of_the_run(tmp_path: Path) -> None:
    settings = to_dict(PRESETS["ci"])
    settings["assets"] |= {"object_dir": "my meshes", "object_set": "unseen"}
    settings["task"]["r_out"] = 0.12
    commands = [command for _, command in missing(read_run(_write_run(tmp_path / "a run", **settings)), [])]
    assert all("--object-set unseen --episodes 100 --object-dir 'my meshes'" in command for command in commands)
    assert ["--r-out 0.12" in command for command in commands] == [False, True, True, True, True]
    assert f"--policy '{tmp_path}/a run' " in commands[0]


# --- escaping --------------------------------------------------------------------------------------------------------


def test_text_is_escaped_and_markup_is_not() -> None:
    assert element("p", "a < b & c", Markup("<b>"), title='"') == '<p title="&quot;">a &lt; b &amp; c<b></p>'
    assert element("img", alt="", class_="x", aria_label=None, width=1.50) == '<img alt="" class="x" width="1.5">'
    assert join(["<", element("i")], ", ") == "&lt;, <i></i>"


def test_no_name_or_setting_gets_into_the_page_as_markup(tmp_path: Path) -> None:
    settings = to_dict(PRESETS["ci"])
    settings["assets"] |= {"object_dir": HOSTILE, "object_set": HOSTILE}
    run_dir = _write_run(tmp_path / "<script>x", [*ROWS, _log_row(500, 100, **{f"reasons/{HOSTILE}": 4})], **settings)
    manifest = {"sessions": [{"versions": {HOSTILE: HOSTILE}}], "hashes": {HOSTILE: HOSTILE}}
    (run_dir / "manifest.json").write_text(json.dumps(manifest))
    for policy in (HOSTILE, "<script>x"):
        file = run_dir / "evaluations" / f"{len(policy)}.json"
        _write_evaluation(file, policy, [0, 1], object_set=HOSTILE, camera=HOSTILE, failures={HOSTILE: 1})
    run = read_run(run_dir)
    page = build_page(run, load_evaluations(run), _films(), films_note=HOSTILE)
    assert "<script" not in page and page.count("&lt;script&gt;") > 10
    assert _Page.of(page).open == []


# --- curves ----------------------------------------------------------------------------------------------------------


def test_the_path_of_a_tiny_curve_by_hand() -> None:
    # The box is 440 x 260 with margins 66, 14, 12, 48: x 0..4 is 66..426, y 0..100 is 212..12.
    line = Series(label="a", points=[(0, 0), (1, 50), (4, 100)], intervals=[(0, 0), (25, 75), (100, 100)], markers=True)
    chart = line_chart([line], title="T", x_label="pushes", y_label="success (%)", y_limits=(0, 100))
    assert '<path d="M66,212 L156,112 L426,12" class="curve s0"></path>' in chart
    assert '<line x1="156" y1="162" x2="156" y2="62" class="error s0">' in chart
    assert chart.count("<circle") == 3 and "a: 50 at 1" in chart
    assert 'aria-label="T. success (%) against pushes: a from 0 at 0 to 100 at 4"' in chart
    assert ">pushes</text>" in chart and ">success (%)</text>" in chart


def test_axes_end_at_round_numbers_and_begin_at_zero() -> None:
    line = Series(label="a", points=[(1, 0.3), (2, 1.1)])
    chart = line_chart([line], title="T", x_label="x", y_label="y")
    # y goes to 1.2, so 0.3 lies at 212 - 200 / 4 and 1.1 at 212 - 200 * 11 / 12; x goes from 0 to 2.
    assert '"M246,162 L426,28.7"' in chart
    flat = line_chart([Series(label="a", points=[(0, 0.0)])], title="T", x_label="x", y_label="y")
    assert '"M66,212"' in flat and flat.count("<circle") == 1


def test_ticks_are_round() -> None:
    assert ticks(0, 100) == [0, 20, 40, 60, 80, 100]
    assert ticks(0, 7) == [0, 2, 4, 6]
    assert np.allclose(ticks(-0.31, 0.29), [-0.3, -0.2, -0.1, 0, 0.1, 0.2])
    assert [format_tick(t) for t in (0.1 + 0.2, 8000, 12500, 2.5e6)] == ["0.3", "8000", "12.5k", "2.5M"]


def test_many_points_are_averaged_in_groups() -> None:
    assert thin([(0, 1), (2, 3), (4, 5), (6, 7), (8, 9)], most=3) == [(1, 2), (5, 6), (8, 9)]
    assert thin([(0, 1)]) == [(0, 1)] and thin([]) == []


def test_bars_by_hand() -> None:
    # Bars begin at 186 and the axis of 50 ends at 440 - 94 = 346, so 25 is 80 wide; longer ones are cut at the axis.
    chart = bar_chart([("half", 25.0, "25 %"), ("more", 60.0, "60 %")], title="T", x_label="share (%)", x_limit=50)
    assert '<rect x="186" y="4" width="80" ' in chart and '<rect x="186" y="31" width="160" ' in chart
    assert 'aria-label="T: half 25 %, more 60 %"' in chart
    mark = interval_mark(0.5, 0.25, 1.0)
    assert 'cx="60"' in mark and 'd="M32,8 L116,8"' in mark and "50%, interval 25% to 100%" in mark


def test_evaluations_get_the_training_time_of_their_step(run_dir: Path) -> None:
    run = read_run(run_dir)
    # 300 steps lie half way between the rows of 30 s and 90 s.
    assert run.curve("eval/success_rate", "time/seconds") == [(30.0, 0.25), (60.0, 0.75)]
    assert run.curve("train/loss") == [(200, 0.5), (400, 0.25)]
    figures = "".join(learning_figures(run))
    # The time axis ends at 60 s.
    assert "training time (s)" in figures and "M246,162 L426,62" in figures
    # Without a curve there is no figure: this run has no motions.
    assert re.findall(r"<figcaption>(.*?)</figcaption>", figures) == [
        *("Success against pushes", "Success against time", "Loss", "Q-values", "Exploration")
    ]


def test_failures_and_times_are_counted(run_dir: Path) -> None:
    file = _write_evaluation(run_dir / "a.json", "first", [1, 1, 1, 0])
    run = read_run(run_dir)
    best, test, training = failure_figures(run, load_evaluations(run, [file]))
    # 10 failures are a quarter of the scenes; three training rows with 5 successes and 5 failures each.
    assert "Validation, best policy, 40 scenes" in best and "25 % (10)" in best
    assert "4 scenes" in test and "25 % (1)" in test
    assert "last 30 episodes" in training and "30 % (9)" in training and "20 % (6)" in training
    assert "target" not in training and "not a number" not in training
    times = time_figures(run)[0]
    assert "75 %, 67.5 s" in times and "25 %, 22.5 s" in times and "90 s in all" in times
    assert [duration(s) for s in (0, 100, 600, 36000)] == ["0 s", "100 s", "10 min", "10 h"]
    assert all(f"time/{phase}" for phase in PHASES)


# --- damaged and young runs ------------------------------------------------------------------------------------------


def test_a_young_run_has_a_page(tmp_path: Path) -> None:
    (tmp_path / "config.yaml").write_text("seed: 3\n")
    page = build_page(read_run(tmp_path), [], [])
    assert "Nothing has been measured yet" in page and "seed 3" in page and "No episodes were played" in page


def test_a_line_that_a_crash_cut_is_left_out(run_dir: Path) -> None:
    with (run_dir / "metrics.jsonl").open("a") as file:
        file.write('{"env_steps": 50')
    assert len(read_run(run_dir).metrics) == len(ROWS)


@pytest.mark.parametrize(
    ("file", "content", "said"),
    [
        ("config.yaml", None, "is not a run folder (it has no config.yaml)"),
        ("config.yaml", "- 1\n", "config.yaml: not the settings of a run"),
        ("config.yaml", "a: [", "config.yaml: while parsing"),
        ("manifest.json", "{", "manifest.json: damaged, not JSON"),
        ("manifest.json", "[]", "manifest.json: damaged, not a JSON object"),
        ("metrics.jsonl", '{"env_steps": 1}\n{"env\n{"env_steps": 2}\n', "metrics.jsonl: line 2 is damaged, not JSON"),
        ("metrics.jsonl", '{"env_steps": "many"}\n', "metrics.jsonl: line 1 is damaged, it has no env_steps"),
        ("best/evaluation.json", "", "evaluation.json: damaged, not JSON"),
        ("evaluations/x.json", "{}", "x.json: not an evaluation; wanted a file written by evaluate.py --json"),
        ("evaluations/x.json", '{"format": "pregrasp_jax evaluation 1"}', "x.json: damaged evaluation (policy, object"),
    ],
)
def test_what_is_damaged_is_one_line(run_dir: Path, monkeypatch, capsys, file: str, content: str | None, said: str):
    if content is None:
        (run_dir / file).unlink()
    else:
        (run_dir / file).parent.mkdir(exist_ok=True)
        (run_dir / file).write_text(content)
    assert _main(monkeypatch, "report", str(run_dir), "--films", "0") == 2
    error = capsys.readouterr().err
    assert error.startswith("error: ") and error.count("\n") == 1 and said in error
    assert not (run_dir / "report.html").exists()


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--films", "-1"], "films = -1 is out of range; allowed is 0 and more"),
        (["--scenes", "0"], "scenes = 0 is out of range; allowed is 1 and more"),
        (["--evaluations", "absent.json"], "absent.json: No such file or directory; wanted a file written by"),
        (["--html", "."], ". is a folder; wanted the name of a file"),
        ([], "is neither a run folder nor a policy folder"),
    ],
)
def test_what_cannot_be_done_is_one_line(run_dir: Path, monkeypatch, capsys, arguments: list[str], said: str) -> None:
    assert _main(monkeypatch, "report", str(run_dir), *arguments) == 2
    error = capsys.readouterr().err
    assert error.startswith("error: ") and error.count("\n") == 1 and said in error


def _main(monkeypatch: pytest.MonkeyPatch, *arguments: str) -> int:
    monkeypatch.setattr(sys, "argv", ["program", *arguments])
    try:
        main_module.main()
    except SystemExit as error:
        return int(error.code or 0)
    return 0


# --- the command, and training ---------------------------------------------------------------------------------------


def test_the_command_plays_until_it_has_enough(run_dir: Path, monkeypatch: pytest.MonkeyPatch, capsys) -> None:
    config = PRESETS["ci"]
    params = QNetwork(width=config.network.width).init(jax.random.key(0), np.zeros((1, 100, 100, 2), np.float32))
    save_policy(run_dir / "best", params["params"], config, {})
    monkeypatch.setattr(player, "make_env", lambda config, **_: fake_env(task=config.task))
    # Drawing needs real hulls, which the world without physics has not.
    tiles = [(name, np.zeros((8, 8, 3), np.uint8)) for name in ("scene", "height", "Q closed")]
    monkeypatch.setattr("pregrasp_jax.cli.report.draw_tiles", lambda *_: tiles)
    report(run_dir, films=1, scenes=4)
    page = (run_dir / "report.html").read_text()
    counted = re.search(r"test scenes 0 to (\d) of the seen objects, (\d) with success", page)
    assert counted
    played, successes = int(counted[1]) + 1, int(counted[2])
    shown = page.count('class="good"'), page.count('class="bad"')
    assert shown == (min(1, successes), min(1, played - successes))
    assert played == 4 or shown == (1, 1)
    assert page.count("<img ") == 3 * page.count("<li>") and page.count("<li>") >= 2
    assert "wrote" in capsys.readouterr().out


def test_a_policy_of_another_network_is_one_line(run_dir: Path, monkeypatch: pytest.MonkeyPatch, capsys) -> None:
    params = QNetwork(width=0.125).init(jax.random.key(0), np.zeros((1, 100, 100, 2), np.float32))
    save_policy(run_dir / "best", params["params"], PRESETS["ci"], {})
    monkeypatch.setattr(player, "make_env", lambda config, **_: fake_env(task=config.task))
    assert _main(monkeypatch, "report", str(run_dir)) == 2
    error = capsys.readouterr().err
    assert error.startswith("error: ") and error.count("\n") == 1 and "does not fit its network" in error


def test_a_session_leaves_a_report_and_no_problem_of_it_hurts(run_dir: Path, monkeypatch, capsys) -> None:
    specification = importlib.util.spec_from_file_location("train_script", ROOT / "train.py")
    assert specification and specification.loader
    train = importlib.util.module_from_spec(specification)
    specification.loader.exec_module(train)
    monkeypatch.setattr("pregrasp_jax.training.session.train", lambda *_, **__: 130)
    monkeypatch.setattr(sys, "argv", ["train.py", "ci", "--run-dir", str(run_dir)])
    assert train.main() == 130 and "first" in (run_dir / "report.html").read_text()
    (run_dir / "metrics.jsonl").write_text("damaged\n")
    before = (run_dir / "report.html").read_bytes()
    assert train.main() == 130 and (run_dir / "report.html").read_bytes() == before
    error = capsys.readouterr().err
    assert error.count("\n") == 1 and "warning: no report was written" in error and "line 1 is damaged" in error
    monkeypatch.setattr("pregrasp_jax.cli.report.read_run", lambda _: 1 / 0)
    report_session(run_dir)
    assert "division by zero" in capsys.readouterr().err


# --- the page --------------------------------------------------------------------------------------------------------


class _Page(html.parser.HTMLParser):
    """Checks that elements are closed in order, and collects them."""

    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []
        self.elements: list[tuple[str, dict[str, str | None]]] = []

    @classmethod
    def of(cls, text: str) -> "_Page":
        page = cls()
        page.feed(text)
        page.close()
        return page

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.elements.append((tag, dict(attrs)))
        if tag not in {"meta", "img", "wbr"}:
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag


@pytest.fixture
def page(run_dir: Path) -> Path:
    for index, policy in enumerate(("first", "random", "a/policy/with/quite/a/long/path/that/is/no/use/on/a/phone")):
        _write_evaluation(run_dir / "evaluations" / f"{index}.json", policy, [1, 0, 1, 1])
    run = read_run(run_dir)
    return write_report(run, load_evaluations(run), _films(), films_note="Two of them.")


def test_the_page_is_whole_and_needs_nothing_else(page: Path) -> None:
    text = page.read_text()
    parsed = _Page.of(text)
    assert parsed.open == []
    assert text.startswith("<!DOCTYPE html>") and "prefers-color-scheme: dark" in text
    assert not re.search(r"https?:|url\(|@import|<script|<link|<iframe", text)
    for tag, attributes in parsed.elements:
        assert not {"onload", "onclick", "onerror"} & attributes.keys()
        if tag == "img":
            assert attributes["alt"] and attributes["width"] and attributes["height"]
            assert (attributes["src"] or "").startswith("data:image/")
        if tag == "svg":
            assert attributes["role"] == "img" and attributes["aria-label"]
    tags = [tag for tag, _ in parsed.elements]
    assert tags.count("img") == 2 * 8 * 5 and tags.count("h1") == 1 and tags.count("svg") >= 8
    assert "9.8.7" in text and "learner.<wbr>huber_<wbr>delta" in text and "Two of them." in text


def test_every_class_of_the_page_has_a_style_and_colours_are_equal_in_number(page: Path) -> None:
    text = page.read_text()
    style = text.split("<style>")[1].split("</style>")[0]
    used = {name for _, attributes in _Page.of(text).elements for name in (attributes.get("class") or "").split()}
    assert [name for name in sorted(used) if not re.search(rf"\.{name}\b", style)] == []
    light, dark = (set(re.findall(r"(--\w+):", block)) for block in re.findall(r":root \{(.*?)\}", style, re.S))
    assert light == dark == set(re.findall(r"var\((--\w+)\)", style))


def test_pictures_are_small_and_true() -> None:
    flat = np.full((300, 300, 3), (12, 200, 90), np.uint8)
    assert len(data_uri(flat, lossy=False)) < 1000 and data_uri(flat, lossy=False).startswith("data:image/png;base64,")
    assert data_uri(flat, lossy=True).startswith("data:image/jpeg;base64,")


PROBE = """<!DOCTYPE html><meta charset="utf-8"><pre id="found">not loaded</pre>
<iframe id="page" style="width:390px;height:844px;border:0" srcdoc="{page}"></iframe>
<script>
addEventListener("load", () => {{
  const page = document.getElementById("page").contentDocument, root = page.documentElement;
  const wide = [...page.querySelectorAll("body *")].filter(e => !e.closest(".scroll *, svg *")
    && e.getBoundingClientRect().right > root.clientWidth + 0.5).map(e => e.tagName + "." + e.className);
  const pictures = [...page.images];
  document.getElementById("found").textContent = JSON.stringify({{
    viewport: root.clientWidth, width: Math.max(root.scrollWidth, page.body.scrollWidth), wide,
    pictures: pictures.length, loaded: pictures.filter(i => i.complete && i.naturalWidth > 0).length,
    small: [...page.querySelectorAll(".chart svg text")].filter(t => t.getBoundingClientRect().height < 9).length,
  }});
}});
</script>"""


def _browser() -> str | None:
    names = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
    found = next((path for path in map(shutil.which, names) if path), None)
    folders = [os.environ.get("PLAYWRIGHT_BROWSERS_PATH"), Path.home() / ".cache" / "ms-playwright"]
    patterns = ("chromium-*/chrome-linux*/chrome", "chromium_headless_shell-*/*/*headless*shell")
    kept = [str(file) for folder in folders if folder for pattern in patterns for file in Path(folder).glob(pattern)]
    return found or next(iter(sorted(kept)), None)


@pytest.mark.skipif(_browser() is None, reason="no Chromium on this machine")
def test_a_phone_shows_the_page_without_error(page: Path, tmp_path: Path) -> None:
    # A headless window cannot be as narrow as a phone, a frame can; `srcdoc` makes it one origin with the probe.
    probe = tmp_path / "probe.html"
    probe.write_text(PROBE.format(page=page.read_text().replace("&", "&amp;").replace('"', "&quot;")))
    options = ["--headless", "--no-sandbox", "--disable-gpu", "--hide-scrollbars", "--enable-logging=stderr"]
    profile = f"--user-data-dir={tmp_path / 'profile'}"
    size, budget = "--window-size=1200,900", "--virtual-time-budget=5000"
    command = [str(_browser()), *options, profile, size, budget, "--dump-dom", probe.as_uri()]
    result = subprocess.run(command, capture_output=True, text=True, timeout=100, check=True)
    dumped = re.search(r'<pre id="found">(.*?)</pre>', result.stdout, re.S)
    assert dumped, result.stdout[:500]
    found = json.loads(dumped[1])
    assert found["width"] <= found["viewport"] <= 390
    assert {key: found[key] for key in ("wide", "pictures", "loaded", "small")} == {
        **{"wide": [], "pictures": 80, "loaded": 80, "small": 0}
    }
    assert "CONSOLE" not in result.stderr
