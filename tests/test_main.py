"""The program `pregrasp-jax`: its commands, the ways to start it, and how soon it answers."""

import pkgutil
import subprocess
import sys
from pathlib import Path

import pytest

import pregrasp_jax
from pregrasp_jax.cli import main as program
from pregrasp_jax.cli.main import COMMANDS, Command, main
from pregrasp_jax.config import Config
from pregrasp_jax.presets import PRESETS
from pregrasp_jax.training import run_folder, session

ROOT = Path(__file__).parent.parent

HEAVY = ("jax", "mujoco", "scipy", "matplotlib")
"""Modules that take seconds to import."""


def run(*command: str) -> str:
    done = subprocess.run([sys.executable, *command], cwd=ROOT, capture_output=True, text=True, check=True)
    assert not done.stderr
    return done.stdout


@pytest.mark.parametrize(
    ("ours", "same"),
    [
        (["-m", "pregrasp_jax", "--version"], ["-c", "import pregrasp_jax.cli.main as m; m.main(['--version'])"]),
        (["train.py", "--help"], ["-m", "pregrasp_jax", "train", "--help"]),
        (["evaluate.py", "--help"], ["-m", "pregrasp_jax", "evaluate", "--help"]),
    ],
)
def test_there_are_several_ways_to_start_it(ours: list[str], same: list[str]):
    assert run(*ours) == run(*same)


def test_it_says_its_version(capsys: pytest.CaptureFixture[str]):
    assert main(["--version"]) == 0
    assert capsys.readouterr().out == f"pregrasp-jax {pregrasp_jax.__version__}\n"


def test_every_command_is_listed_with_what_it_does(capsys: pytest.CaptureFixture[str]):
    with pytest.raises(SystemExit) as exit_info:
        main(["--help"])
    text = " ".join(capsys.readouterr().out.replace("│", " ").split())
    assert exit_info.value.code == 0
    assert all(f"• {name} {command.summary}" in text for name, command in COMMANDS.items())


@pytest.mark.parametrize("name", COMMANDS)
def test_every_command_exists_and_explains_itself(name: str, capsys: pytest.CaptureFixture[str]):
    assert callable(pkgutil.resolve_name(COMMANDS[name].target))
    with pytest.raises(SystemExit) as exit_info:
        main([name, "--help"])
    assert exit_info.value.code == 0
    assert capsys.readouterr().out.startswith(f"usage: pregrasp-jax {name} ")


@pytest.mark.parametrize("line", [["--help"], ["--version"], ["train", "cpu", "--help"], ["evaluate", "--help"], ["x"]])
def test_it_answers_without_what_takes_seconds_to_import(line: list[str]):
    code = f"""
import contextlib, sys
from pregrasp_jax.cli.main import main
with contextlib.suppress(SystemExit):
    main({line})
print("loaded:", *(set(sys.modules) & set({HEAVY})))
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.endswith("loaded:\n")


def test_without_a_command_it_lists_them(capsys: pytest.CaptureFixture[str]):
    with pytest.raises(SystemExit) as exit_info:
        main([])
    assert exit_info.value.code == 2
    assert capsys.readouterr().err == f"error: Expected one of {{{', '.join(COMMANDS)}}}.\n"


def test_ctrl_c_is_one_line_and_its_exit_code(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]):
    def interrupted() -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(pkgutil, "resolve_name", lambda _: interrupted)
    assert main(["doctor"]) == 130
    assert capsys.readouterr().err == "interrupted\n"


def test_a_command_that_fails_tells_the_shell(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setitem(program.COMMANDS, "fail", Command("Fail.", f"{__name__}:fail"))
    assert main(["fail", "--code", "3"]) == 3


def fail(*, code: int) -> int:
    """Return a code."""
    return code


def test_a_resumed_run_starts_from_its_stored_settings(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    with run_folder.RunFolder.create(tmp_path / "run", PRESETS["ci"]):
        pass
    asked: list[tuple[Config, Path]] = []
    monkeypatch.setattr(session, "resume", lambda config, run_dir: asked.append((config, run_dir)) or 3)
    monkeypatch.setattr("pregrasp_jax.cli.report.report_session", lambda *_, **__: None)
    assert main(["train", "resume", "--train.minutes", "7", str(tmp_path / "run")]) == 3
    config, run_dir = asked[0]
    assert run_dir == tmp_path / "run" and config.train.minutes == 7
    assert config.scene == PRESETS["ci"].scene != Config().scene
