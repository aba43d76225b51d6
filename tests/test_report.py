"""The report: its numbers and curves by hand, what is missing or damaged, and the command."""

import re
from pathlib import Path

import pytest
from report_files import ROWS, evaluation_row, log_row, run_main, write_evaluation, write_run

from pregrasp_jax.presets import PRESETS
from pregrasp_jax.report import build_page, load_evaluations, read_run
from pregrasp_jax.report.charts import duration, failure_figures, learning_figures, time_figures
from pregrasp_jax.report.results import SCRIPTS, _paired, is_of_run, missing, of_run
from pregrasp_jax.settings import to_dict


@pytest.fixture
def run_dir(tmp_path: Path) -> Path:
    return write_run(tmp_path / "runs" / "first")


def _texts(page: str) -> list[str]:
    """Return the text of every table cell."""
    return [re.sub(r"<[^>]*>", "", cell) for cell in re.findall(r"<t[hd]\b[^>]*>(.*?)</t[hd]>", page, re.S)]


def test_a_run_is_not_what_ships_under_the_same_name(tmp_path: Path) -> None:
    run = read_run(write_run(tmp_path / "ppg"))
    policies = ("elsewhere/ppg", "target-ppg:elsewhere/ppg", "ppg", "target-ppg", "strokes")
    assert [is_of_run(run, {"policy": policy}) for policy in policies] == [True, True, False, False, False]


# --- results ---------------------------------------------------------------------------------------------------------


def test_the_table_shows_the_numbers_of_the_files(run_dir: Path) -> None:
    write_evaluation(run_dir / "evaluations" / "a.json", "clear", [0, 0, 0, 0, 0, 0, 1, 0])
    write_evaluation(run_dir / "evaluations" / "b.json", "elsewhere/first", [1, 1, 1, 1, 1, 1, 0, 0])
    other = write_evaluation(run_dir / "evaluations" / "c.json", "random", [0, 1], scene_bank_hash="t")
    other.write_text(other.read_text().replace("2.34567", "null").replace('"std_motions": 0.5', '"std_motions": null'))
    run = read_run(run_dir)
    cells = _texts(build_page(run, load_evaluations(run)))
    table = cells[: cells.index("this run minus it") + 1 + 3 * 10]
    own, chance, clear = table[10:20], table[20:30], table[30:40]
    assert own == [
        *("this run (elsewhere/first)", "seen", "table", "orthographic", "8", "75 %", "12.3 % to 87.7 %", ""),
        *("2.35 ± 0.50", ""),
    ]
    assert chance[5:] == ["50 %", "12.3 % to 87.7 %", "", "no success", "not on the same scenes"]
    # 6 scenes only this run, 1 only clear: +62.5 points, McNemar 2 (1 + 7) / 2^7 = 0.125.
    assert clear[0] == "clear" and clear[5] == "12.5 %"
    assert clear[9].startswith("+62 points (") and clear[9].endswith("p = 0.12")


def test_evaluations_in_another_place_are_told_apart(tmp_path: Path) -> None:
    task = to_dict(PRESETS["ci"].task) | {"workspace": "shelf", "place": {"half_width": 0.25, "back": None}}
    run_dir = write_run(tmp_path / "first", task=task)
    there = {"workspace": "shelf", "workspace_hash": "w"}
    write_evaluation(run_dir / "evaluations" / "a.json", "first", [1, 0], **there)
    write_evaluation(run_dir / "evaluations" / "b.json", "pretrained", [0, 0])
    write_evaluation(run_dir / "evaluations" / "c.json", "clear", [0, 0])
    run = read_run(run_dir)
    cells = _texts(build_page(run, load_evaluations(run)))
    assert cells.count("in another place") == 2 and "shelf" in cells
    lacking = dict(missing(run, load_evaluations(run)))
    assert "clear on seen objects" in lacking, "it was run on the open table only"
    assert "--workspace shelf --task.place.half-width 0.25 --json" in lacking["clear on seen objects"]


def test_rates_that_were_counted_or_seen_differently_are_told_apart(tmp_path: Path) -> None:
    """Strict against lenient is never paired; the run that saw through the same sensor is paired first."""
    run_dir = write_run(tmp_path / "first")
    lenient = {"config": {"task": {"obstacles_may_leave": True}}}
    d455 = {"camera": "pinhole", "sensor": {"name": "d455"}}
    write_evaluation(run_dir / "evaluations" / "a.json", "first", [1, 1, 1, 1])
    write_evaluation(run_dir / "evaluations" / "b.json", "first", [1, 1, 0, 0], **d455)
    write_evaluation(run_dir / "evaluations" / "c.json", "clear", [0, 0, 0, 0], **lenient)
    write_evaluation(run_dir / "evaluations" / "d.json", "pretrained", [1, 0, 0, 0], **d455)
    run = read_run(run_dir)
    cells = _texts(build_page(run, load_evaluations(run)))
    rows = {cells[i]: cells[i + 1 : i + 10] for i, cell in enumerate(cells) if cell in ("clear", "pretrained")}
    assert rows["clear"][1] == "table, obstacles may leave" and rows["clear"][-1] == "counted in another way"
    assert rows["pretrained"][2] == "pinhole, sensor d455" and rows["pretrained"][-1].startswith("+25 points")


def test_others_are_compared_with_the_policy_alone(tmp_path: Path) -> None:
    """Not with its search, though that saw through the same camera, and no row with itself."""
    run = read_run(write_run(tmp_path / "mine"))
    own, other = [0, 0, 1, 0] * 10, [1, 1, 0, 0] * 10
    files = [
        write_evaluation(tmp_path / "alone.json", "runs/mine", own, camera="pinhole"),
        write_evaluation(tmp_path / "planned.json", "runs/mine", [1] * 40, planning={"depth": 2}),
        write_evaluation(tmp_path / "straight.json", "straight", other),
    ]
    alone, planned, straight = load_evaluations(run, files)
    mine = of_run(run, [alone, planned, straight])
    assert _paired(mine, straight).startswith("\N{MINUS SIGN}25 points")
    assert _paired(mine, planned).startswith("\N{MINUS SIGN}75 points") and _paired([planned], planned) == ""


def test_files_named_on_the_command_line_replace_those_of_the_folder(run_dir: Path, tmp_path: Path) -> None:
    write_evaluation(run_dir / "evaluations" / "a.json", "clear", [1, 0])
    named = write_evaluation(tmp_path / "b.json", "lookahead", [1, 1])
    assert [document["policy"] for document in load_evaluations(read_run(run_dir), (named,))] == ["lookahead"]


def test_missing_evaluations_are_named_with_their_command(run_dir: Path) -> None:
    run = read_run(run_dir)
    assert [what for what, _ in missing(run, [])] == [
        f"{who} on seen objects" for who in ("this run", *SCRIPTS["q_learning"])
    ]
    write_evaluation(run_dir / "evaluations" / "a.json", "clear", [1, 0] * 20)
    write_evaluation(run_dir / "evaluations" / "b.json", "first", [1, 0] * 20)
    lacking = dict(missing(run, load_evaluations(run)))
    assert list(lacking) == ["random on seen objects", "straight on seen objects", "lookahead on seen objects"]
    assert lacking["straight on seen objects"] == (
        "pregrasp-jax evaluate --policy straight --object-set seen --episodes 40 --json "
        f"{run_dir}/evaluations/seen-straight.json"
    )
    page = build_page(run, load_evaluations(run))
    assert "random on seen objects, straight on seen objects, lookahead on seen objects" in page


def test_commands_keep_the_task_of_the_run(tmp_path: Path) -> None:
    settings = to_dict(PRESETS["ci"])
    settings["assets"] |= {"object_dir": "my meshes", "object_set": "unseen"}
    settings["task"]["r_out"] = 0.12
    commands = [command for _, command in missing(read_run(write_run(tmp_path / "a run", **settings)), [])]
    assert all("--object-set unseen --episodes 100 --object-dir 'my meshes'" in command for command in commands)
    assert ["--r-out 0.12" in command for command in commands] == [False, True, True, True, True]
    assert f"--policy '{tmp_path}/a run' " in commands[0]


def test_a_run_is_called_by_its_name_from_wherever_it_is_named(run_dir: Path, monkeypatch) -> None:
    monkeypatch.chdir(run_dir)
    run = read_run(Path("."))
    assert run.path == run_dir
    write_evaluation(run_dir / "evaluations" / "a.json", "first", [1, 0])
    assert not [what for what, _ in missing(run, load_evaluations(run)) if what.startswith("this run")]


# --- curves ----------------------------------------------------------------------------------------------------------


def test_curves_against_steps_and_time(run_dir: Path) -> None:
    run = read_run(run_dir)
    assert run.curve("eval/success_rate", "time/seconds") == [(30.0, 0.25), (60.0, 0.75)]
    assert run.curve("train/loss") == [(200, 0.5), (400, 0.25)]
    figures = "".join(learning_figures(run))
    # The time axis ends at 60 s.
    assert "training time (s)" in figures and "M246,162 L426,62" in figures
    # Without a curve there is no figure: this run has no motions.
    assert re.findall(r"<figcaption>(.*?)</figcaption>", figures) == [
        *("Success against pushes", "Success against time", "Loss", "Q-values", "Exploration")
    ]


def test_an_interval_stays_with_its_row_where_another_row_has_no_time(tmp_path: Path) -> None:
    rows = [evaluation_row(100, 10.0, 0.5, [0.25, 0.75]), evaluation_row(200, 40.0, 0.5, [0.0, 1.0])]
    del rows[0]["time/seconds"]
    pushes, time = learning_figures(read_run(write_run(tmp_path / "mixed", rows)))
    assert pushes.count('class="error s0"') == 2 and time.count('class="error s0"') == 1
    # 0 to 100 % is the whole height of the plotting area.
    assert 'y1="212" x2="426" y2="12" class="error s0"' in time


def test_failures_and_times_are_counted(run_dir: Path) -> None:
    file = write_evaluation(run_dir / "a.json", "first", [1, 1, 1, 0])
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


def test_what_was_in_the_way_stands_under_its_reason(tmp_path: Path) -> None:
    more = {"reasons/unreachable": 4, "unreachable/wall": 3, "unreachable/end_error": 1, "unreachable/no_ik": 0}
    run_dir = write_run(tmp_path / "first", [log_row(100, 10.0, **more), log_row(200, 20.0, **more)])
    stopped = {"failures": {"unreachable": 1}, "obstructions": {"unreachable": {"wall": 1}}, "workspace": "shelf"}
    file = write_evaluation(run_dir / "a.json", "first", [1, 1, 1, 0], **stopped)
    run = read_run(run_dir)
    _, test, training = failure_figures(run, load_evaluations(run, [file]))
    assert (
        "seen objects, shelf, orthographic camera, 4 scenes" in test
        and "push out of reach 25 % (1), · wall 25 % (1)" in test
    )
    assert "push out of reach 29 % (8), · wall 21 % (6), · end not reached 7 % (2)" in training


# --- damaged and young runs ------------------------------------------------------------------------------------------


def test_a_young_run_has_a_page(tmp_path: Path) -> None:
    (tmp_path / "config.yaml").write_text("seed: 3\n")
    page = build_page(read_run(tmp_path), [])
    assert (
        "Nothing has been measured yet" in page
        and "seed 3" in page
        and "No episodes of this policy were played" in page
    )


def test_a_line_that_a_crash_cut_is_left_out(run_dir: Path) -> None:
    with (run_dir / "metrics.jsonl").open("a") as file:
        file.write('{"env_steps": 50')
    assert len(read_run(run_dir).metrics) == len(ROWS)


@pytest.mark.parametrize(
    ("file", "content", "said"),
    [
        ("config.yaml", None, "is not a run folder (it has no config.yaml)"),
        ("config.yaml", "- 1\n", "config.yaml: not the settings of a run"),
        ("config.yaml", "a: [", "config.yaml: line 1: while parsing"),
        ("manifest.json", "{", "manifest.json: damaged, not JSON"),
        ("manifest.json", "[]", "manifest.json: damaged, not a JSON object"),
        ("metrics.jsonl", '{"env_steps": 1}\n{"env\n{"env_steps": 2}\n', "metrics.jsonl: line 2 is damaged, not JSON"),
        ("metrics.jsonl", '{"env_steps": "many"}\n', "metrics.jsonl: line 1 is damaged, it has no env_steps"),
        ("best/evaluation.json", "", "evaluation.json: damaged, not JSON"),
        ("best/evaluation.json", '{"success_rate": 1, "success_ci95": 7}', "evaluation.json: damaged (success_ci95)"),
        ("best/evaluation.json", '{"success_ci95": [0.5, "x"]}', "evaluation.json: damaged (success_ci95)"),
        ("best/evaluation.json", '{"success_rate": "all"}', "evaluation.json: damaged (success_rate)"),
        (
            "evaluations/x.json",
            "{}",
            "x.json: not an evaluation; wanted a file written by pregrasp-jax evaluate --json",
        ),
        ("evaluations/x.json", '{"format": "pregrasp_jax evaluation 1"}', "x.json: damaged evaluation (policy, object"),
    ],
)
def test_what_is_damaged_is_one_line(run_dir: Path, capsys, file: str, content: str | None, said: str):
    if content is None:
        (run_dir / file).unlink()
    else:
        (run_dir / file).parent.mkdir(exist_ok=True)
        (run_dir / file).write_text(content)
    assert run_main("report", str(run_dir), "--films", "0") == 2
    error = capsys.readouterr().err
    assert error.startswith("error: ") and error.count("\n") == 1 and said in error
    assert not (run_dir / "report.html").exists()


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--films", "-1"], "films = -1 is out of range; allowed is 0 and more"),
        (["--scenes", "0"], "scenes = 0 is out of range; allowed is 1 and more"),
        (["--evaluations", "absent.json"], "absent.json: No such file or directory; wanted a file written by"),
        (["--html", "."], ". is a folder; allowed is the name of a file"),
        ([], "has no policy to play: its first checkpoint is still to come; --films 0 writes the report without"),
    ],
)
def test_what_cannot_be_done_is_one_line(run_dir: Path, capsys, arguments: list[str], said: str) -> None:
    assert run_main("report", str(run_dir), *arguments) == 2
    error = capsys.readouterr().err
    assert error.startswith("error: ") and error.count("\n") == 1 and said in error
