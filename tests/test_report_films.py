"""The command `report`, what a training session leaves behind, and the demo: films of policies in the fake world."""

import contextlib
import json
import os
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from drawn_params import drawn_params
from fake_env import fake_env
from PIL import Image, ImageSequence
from report_files import evaluation_row, make_films, run_main, write_evaluation, write_run

from pregrasp_jax.checkpoint import save_policy
from pregrasp_jax.cli import demo as demo_module
from pregrasp_jax.cli import report as report_module
from pregrasp_jax.cli.main import main
from pregrasp_jax.cli.report import report, report_session
from pregrasp_jax.evaluation import player
from pregrasp_jax.learning.networks import QNetwork
from pregrasp_jax.presets import PRESETS
from pregrasp_jax.report.play import SECONDS_PER_FRAME

LONG = [evaluation_row(300, report_module.WORTH_FILMS, 0.75, [0.5, 0.9])]
"""Metrics of a training after which films are made."""


@pytest.fixture
def run_dir(tmp_path: Path) -> Path:
    return write_run(tmp_path / "runs" / "first", LONG)


@pytest.fixture
def drawn(monkeypatch: pytest.MonkeyPatch) -> list[Any]:
    """Let policies play in the world without physics, and collect the players whose decisions are drawn."""
    players: list[Any] = []

    def draw(player: Any, _: Any) -> list[tuple[str, np.ndarray]]:
        players.append(player)
        return [(name, np.zeros((8, 8, 3), np.uint8)) for name in ("scene", "height", "Q closed")]

    monkeypatch.setattr(player, "make_env", lambda config, **_: fake_env(task=config.task))
    # Drawing needs real hulls, which that world has not.
    for module in (report_module, demo_module):
        monkeypatch.setattr(module, "draw_tiles", draw)
    return players


def _save_policy(run_dir: Path, seed: int = 0, width: float = PRESETS["ci"].network.width) -> None:
    params = drawn_params(QNetwork(width=width).init, np.zeros((1, 100, 100, 2), np.float32), seed=seed)
    save_policy(run_dir / "best", params["params"], PRESETS["ci"], {})


# --- the command -----------------------------------------------------------------------------------------------------


def test_the_command_plays_until_it_has_enough(run_dir: Path, drawn: list[Any], capsys) -> None:
    _save_policy(run_dir)
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


def test_films_stay_as_long_as_the_policy(run_dir: Path, drawn: list[Any]) -> None:
    _save_policy(run_dir)
    report(run_dir, films=1, scenes=1)
    page, played = run_dir / "report.html", len(drawn)
    episodes = re.findall(r"<section data-policy=.*?</section>", page.read_text(), re.DOTALL)
    assert len(episodes) == 1 and played >= 2
    write_run(run_dir, [*LONG, evaluation_row(999, 5000.0, 0.8, [0.7, 0.9])])
    _save_policy(run_dir)
    report_session(run_dir, finished=True)
    report_session(run_dir, finished=False)
    assert episodes[0] in page.read_text() and "999 pushes" in page.read_text() and len(drawn) == played
    _save_policy(run_dir, seed=1)
    report(run_dir, films=0)
    assert "<article" not in page.read_text() and "No episodes of this policy were played" in page.read_text()


def test_films_belong_to_the_policy_that_was_played(run_dir: Path, drawn: list[Any], monkeypatch) -> None:
    def film(*_: Any, **__: Any) -> Any:
        _save_policy(run_dir, seed=1)  # a training that goes on finds a better one meanwhile
        return make_films(), "Two of them."

    _save_policy(run_dir)
    monkeypatch.setattr(report_module, "film_run", film)
    report(run_dir)
    assert "Two of them." in (run_dir / "report.html").read_text()
    report(run_dir, films=0)
    assert "Two of them." not in (run_dir / "report.html").read_text()


def test_a_run_with_the_name_of_a_script_plays_its_own_policy(run_dir: Path, drawn: list[Any], monkeypatch) -> None:
    _save_policy(write_run(run_dir.with_name("clear")))
    monkeypatch.chdir(run_dir.parent)
    report(Path("clear"), films=1, scenes=1)
    assert drawn[0].q_values is not None, "a learned policy has Q-values"


def test_a_policy_of_another_network_is_one_line(run_dir: Path, drawn: list[Any], capsys) -> None:
    _save_policy(run_dir, width=0.125)
    assert run_main("report", str(run_dir)) == 2
    error = capsys.readouterr().err
    assert error.startswith("error: ") and error.count("\n") == 1 and "does not fit its network" in error


def test_a_damaged_policy_is_one_line_and_films_0_does_without(run_dir: Path, capsys) -> None:
    (run_dir / "best" / "params.safetensors").write_bytes(b"damaged")
    assert run_main("report", str(run_dir)) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1 and "params.safetensors" in error and "--films 0" in error
    assert run_main("report", str(run_dir), "--films", "0") == 0


def test_an_evaluation_older_than_the_policy_is_called_outdated(run_dir: Path) -> None:
    _save_policy(run_dir)
    old, new, script = (run_dir / "evaluations" / f"{name}.json" for name in ("old", "new", "clear"))
    for file, policy in ((old, "first"), (new, "first"), (script, "clear")):
        write_evaluation(file, policy, [1, 0])
    saved = (run_dir / "best" / "params.safetensors").stat().st_mtime
    for file, time in ((old, saved - 60), (new, saved + 60), (script, saved - 60)):
        os.utime(file, (time, time))
    report(run_dir, films=0)
    assert "Outdated</strong>: old.json is older than the run" in (run_dir / "report.html").read_text()
    report(run_dir, films=0, evaluations=(new, script))
    assert "Outdated" not in (run_dir / "report.html").read_text()


def test_help_says_where_the_table_comes_from(capsys) -> None:
    assert run_main("report", "--help") == 0
    text = " ".join(capsys.readouterr().out.replace("│", " ").split())
    assert "pregrasp-jax evaluate --policy NAME --json RUN_DIR/evaluations/NAME.json" in text


# --- training --------------------------------------------------------------------------------------------------------


@pytest.fixture
def session(run_dir: Path, monkeypatch: pytest.MonkeyPatch) -> Any:
    """Return a function that runs `train`, whose training ends at once with the given code, and returns its own."""

    def call(code: int) -> int:
        monkeypatch.setattr("pregrasp_jax.training.session.train", lambda *_, **__: code)
        return main(["train", "ci", "--run-dir", str(run_dir)])

    return call


def test_a_session_leaves_a_report_and_no_problem_of_it_hurts(run_dir: Path, session: Any, monkeypatch, capsys) -> None:
    assert session(130) == 130 and "first" in (run_dir / "report.html").read_text()
    (run_dir / "metrics.jsonl").write_text("damaged\n")
    before = (run_dir / "report.html").read_bytes()
    assert session(130) == 130 and (run_dir / "report.html").read_bytes() == before
    error = capsys.readouterr().err
    assert error.count("\n") == 1 and "warning: no report was written" in error and "line 1 is damaged" in error
    monkeypatch.setattr("pregrasp_jax.cli.report.read_run", lambda _: 1 / 0)
    report_session(run_dir, finished=True)
    assert "division by zero" in capsys.readouterr().err


def test_a_long_training_that_ends_by_itself_is_filmed(
    run_dir: Path, session: Any, drawn: list[Any], monkeypatch
) -> None:
    _save_policy(run_dir)
    monkeypatch.setattr(report_module, "MOST_SCENES", 2)
    assert session(143) == 143 and not drawn, "a signal is not kept waiting"
    write_run(run_dir)
    assert session(0) == 0 and not drawn, "nor is a training of 90 s"
    write_run(run_dir, LONG)
    assert session(0) == 0 and drawn
    assert "<article>" in (run_dir / "report.html").read_text()


def test_films_that_fail_cost_a_line(run_dir: Path, session: Any, drawn: list[Any], monkeypatch, capsys) -> None:
    _save_policy(run_dir)
    monkeypatch.setattr(report_module, "make_player", lambda *_, **__: 1 / 0)
    assert session(0) == 0 and "No episodes of this policy" in (run_dir / "report.html").read_text()
    error = capsys.readouterr().err
    assert f"warning: {run_dir}/report.html shows no episodes (division by zero)" in error and "Traceback" not in error


def test_ctrl_c_in_the_report_is_said_to_be_there(run_dir: Path, session: Any, monkeypatch, capsys) -> None:
    def interrupted(*_: Any, **__: Any) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(report_module, "film_run", interrupted)
    _save_policy(run_dir)
    assert session(0) == 0
    error = capsys.readouterr().err.splitlines()[-1]
    assert error.startswith("interrupted while the report was written; the training is saved") and str(run_dir) in error
    assert (run_dir / "report.html").exists()


def test_the_demo_leaves_its_evaluations_and_a_report_with_films(
    run_dir: Path, drawn: list, monkeypatch, capsys
) -> None:
    _save_policy(run_dir)
    shipped: list[str] = []
    monkeypatch.setattr(demo_module, "show_shipped", lambda _: shipped.append("shown"))
    monkeypatch.setattr(demo_module, "resume", lambda *_: shipped.append("trained") or 0)
    monkeypatch.setattr(demo_module.RunFolder, "open", lambda *_: contextlib.nullcontext())
    # The shipped policy and the other scripts would only compile for longer.
    monkeypatch.setattr(demo_module, "_SCRIPTS", ("clear",))
    monkeypatch.setattr(demo_module, "_SHIPPED", "random")
    demo_module.demo(run_dir=run_dir, episodes=4)
    files = {file.stem: json.loads(file.read_text()) for file in (run_dir / "evaluations").glob("*.json")}
    assert sorted(files) == ["seen-clear", "seen-random", "seen-run"]
    assert files["seen-run"]["policy"] == str(run_dir) and files["seen-clear"]["policy"] == "clear"
    page = (run_dir / "report.html").read_text()
    successes = round(4 * files["seen-run"]["success_rate"])
    assert f"played test scenes 0 to 3 of the seen objects, {successes} with success" in page
    assert page.count("<article>") == min(3, successes) + min(3, 4 - successes) and "Outdated" not in page
    assert all(f'scope="row">{name}</th>' in page for name in ("random", "clear"))
    assert "Missing</strong>: straight on seen objects, lookahead on seen objects." in page
    last = capsys.readouterr().out.splitlines()[-1]
    assert last == f"wrote {run_dir}/report.html: results, learning curves and episodes of the run"
    assert shipped == ["shown", "trained"]


def test_the_demo_refuses_another_run_before_anything_is_played(run_dir: Path, monkeypatch) -> None:
    monkeypatch.setattr(demo_module, "show_shipped", lambda _: pytest.fail("played"))
    with pytest.raises(ValueError, match="a changed configuration"):
        demo_module.demo(run_dir=run_dir)


def test_the_demo_begins_with_the_shipped_policy_at_work(drawn: list[Any], tmp_path: Path, monkeypatch, capsys) -> None:
    monkeypatch.setattr(demo_module, "_SHIPPED", "straight")
    monkeypatch.setattr(demo_module, "resume", lambda *_: 3)
    with pytest.raises(SystemExit) as exit_info:
        demo_module.demo(run_dir=tmp_path / "run")
    assert exit_info.value.code == 3, "the training said so, after the pictures were there"
    gif, page = tmp_path / "run" / "demo.gif", tmp_path / "run" / "straight.html"
    assert capsys.readouterr().out.splitlines() == [
        f"wrote {gif}: straight at work",
        f"wrote {page}: the same episodes, push by push",
    ]
    text = page.read_text()
    with Image.open(gif) as film:
        # Equal panels, as they are here, become one that is shown longer.
        shown = sum(frame.info["duration"] for frame in ImageSequence.Iterator(film))
    assert shown == 1e3 * SECONDS_PER_FRAME * len(drawn)
    assert text.count("<article>") == 3 and text.count("<li>") == len(drawn)
    badges = re.findall(r'<span class="(good|bad)">', text)
    assert sorted(badges, reverse=True) == badges and {"good", "bad"} == set(badges)
