"""Environments in which nothing can be computed: one line that says what to set, whatever was asked for.

Programs run in processes of their own, since jax and Python read most of this once; each ends before it compiles.
"""

import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import jax
import pytest
import trimesh

from pregrasp_jax import io, startup
from pregrasp_jax.cli import commands, doctor, replay, report
from pregrasp_jax.config import Config
from pregrasp_jax.evaluation import player
from pregrasp_jax.evaluation_config import EvaluationConfig
from pregrasp_jax.task.assembly import make_env
from pregrasp_jax.training import session

ROOT = Path(__file__).parent.parent

EVALUATE = [str(ROOT / "evaluate.py"), "--policy", "pretrained", "--episodes", "2"]

NO_PASSWD = """
import os, pwd, runpy, sys
def getpwuid(uid): raise KeyError(f"getpwuid(): uid not found: {uid}")
pwd.getpwuid = getpwuid
os.environ.pop("HOME")
sys.argv = sys.argv[1:]
runpy.run_path(sys.argv[0], run_name="__main__")
"""
"""What Python finds in a container that was started with --user: no home, neither in the environment nor in passwd."""

ENVIRONMENTS = [
    (
        {"JAX_ENABLE_X64": "1"},
        [],
        "error: JAX_ENABLE_X64 is on, but networks, checkpoints and ",
        "allowed is to unset it",
    ),
    (
        {"JAX_PLATFORMS": "cuda"},
        [],
        "error: jax finds no device of JAX_PLATFORMS = 'cuda' (",
        "allowed is to unset it, or",
    ),
    (
        {},
        ["-c", NO_PASSWD],
        "error: this user has no home folder that could hold a cache; allowed is to set PREGRASP_JAX_",
    ),
    (
        {"HOME": "{f}/file"},
        [],
        "is not a writable folder; allowed is one that is; PREGRASP_JAX_CACHE names another folder",
    ),
]


def run_python(*arguments: str, stdin: str = "", **environment: str) -> subprocess.CompletedProcess:
    """Run Python without the caches that the tests' environment may name."""
    own = {name: value for name, value in os.environ.items() if name not in ("PREGRASP_JAX_CACHE", "XDG_CACHE_HOME")}
    return subprocess.run(
        [sys.executable, *arguments], env=own | environment, input=stdin, capture_output=True, text=True, timeout=120
    )


@pytest.mark.parametrize("row", ENVIRONMENTS, ids=lambda row: " ".join(row[0]) or "no home")
def test_an_environment_without_means_is_one_line(tmp_path, row):
    environment, interpreter, *said = row
    (tmp_path / "file").write_text("")
    found = run_python(*interpreter, *EVALUATE, **{key: value.format(f=tmp_path) for key, value in environment.items()})
    assert found.returncode == 2 and not found.stdout
    assert found.stderr.count("\n") == 1 and all(part in found.stderr for part in said), found.stderr


ENTRY_POINTS = {
    "train": lambda path: session.train(Config(), path / "run"),
    "resume": lambda path: session.resume(Config(), path / "run"),
    "evaluate, show, demo": lambda path: player.make_player(EvaluationConfig(policy="pretrained")),
    "assets": lambda path: commands.assets(png=path / "a.png"),
    "scenes": lambda path: commands.scenes(),
    "replay-dump": lambda path: replay.replay_dump(path / "dump.npz"),
    "a script": lambda path: make_env(Config(), split="test"),
}


@pytest.mark.parametrize("name", ENTRY_POINTS)
def test_everything_that_computes_asks_first(tmp_path, name):
    with jax.enable_x64(True), pytest.raises(ValueError, match="JAX_ENABLE_X64 is on"):
        ENTRY_POINTS[name](tmp_path)
    assert not list(tmp_path.iterdir())


def test_a_report_asks_first(tmp_path, monkeypatch):
    monkeypatch.setattr(report, "read_run", lambda path: None)
    monkeypatch.setattr(report, "load_evaluations", lambda *_: [])
    with jax.enable_x64(True), pytest.raises(ValueError, match="JAX_ENABLE_X64 is on"):
        report.report(tmp_path)


def test_doctor_says_what_the_others_refuse():
    assert dict(doctor.describe())["environment"] == "usable"
    with jax.enable_x64(True):
        assert "JAX_ENABLE_X64 is on" in dict(doctor.describe())["environment"]


@pytest.fixture
def no_jax_cache() -> Iterator[None]:
    """Take back that these tests have chosen a folder for compiled programs."""
    chosen = jax.config.values["jax_compilation_cache_dir"]
    jax.config.update("jax_compilation_cache_dir", None)
    yield
    jax.config.update("jax_compilation_cache_dir", chosen)


def test_no_programs_are_kept_where_nothing_can_be_written(tmp_path, monkeypatch, no_jax_cache):
    (tmp_path / "file").write_text("")
    monkeypatch.setenv(io.CACHE, str(tmp_path / "file" / "cache"))
    assert startup.compilation_cache_dir() is None
    assert dict(doctor.describe())["compiled programs"] == "not kept (cache not writable)"
    monkeypatch.setenv(io.CACHE, str(tmp_path / "cache"))
    assert startup.compilation_cache_dir() == tmp_path / "cache" / "jax"


LOAD = """
from pregrasp_jax.assets.meshes import load_object_dir
bank = load_object_dir({folder!r}, "seen").bank
print(bank.names)
"""


def test_a_script_from_standard_input_decomposes_meshes(tmp_path):
    """Workers do not run it again, so one in a file needs no guard around its entry point either."""
    (tmp_path / "meshes").mkdir()
    trimesh.creation.box((0.06, 0.07, 0.15)).export(tmp_path / "meshes" / "box.stl")
    script = LOAD.format(folder=str(tmp_path / "meshes"))
    found = run_python(stdin=script, PREGRASP_JAX_CACHE=str(tmp_path / "cache"))
    assert (found.stdout, found.stderr) == ("('box',)\n", "")


TALKS = """
from pregrasp_jax.cli.command_line import one_line_errors
with one_line_errors():
    print("first", flush=True)
    input()
    print("x" * {size})
    {after}
"""


def exit_code_without_reader(program: str) -> int:
    """Run a program whose reader goes after the first line, and return how it ends; it must say nothing of that."""
    command, pipe = [sys.executable, "-c", program], subprocess.PIPE
    with subprocess.Popen(command, stdin=pipe, stdout=pipe, stderr=pipe, text=True, cwd=ROOT) as process:
        assert process.stdin and process.stdout and process.stderr
        assert process.stdout.readline() == "first\n"
        process.stdout.close()
        process.stdin.write("go on\n")
        process.stdin.flush()
        assert process.stderr.read() == ""
        return process.wait(timeout=60)


@pytest.mark.parametrize("size", [1, 10**6])
@pytest.mark.parametrize("after", ["", "raise SystemExit(0)", "raise ValueError('no')"])
def test_a_reader_that_goes_ends_a_command_quietly(size, after):
    assert exit_code_without_reader(TALKS.format(size=size, after=after)) == 141


TRAINS = """
from pregrasp_jax.cli.command_line import one_line_errors
from pregrasp_jax.training.console import Console
with one_line_errors():
    console = Console()
    console.say("first")
    input()
    for _ in range(1000):
        console.say("step " * 20)
"""


def test_a_training_does_not_end_because_its_reader_has_gone():
    assert exit_code_without_reader(TRAINS) == 0
