"""`train`: help, how complaints are worded, signals; the real thing killed and resumed (slow)."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from pregrasp_jax.checkpoint.run_config import CHANGEABLE
from pregrasp_jax.cli.command_line import unbox
from pregrasp_jax.cli.main import main

ROOT = Path(__file__).parent.parent


def test_help_shows_the_defaults_of_the_preset(capsys):
    with pytest.raises(SystemExit) as exit_info:
        main(["train", "cpu", "--help"])
    text = " ".join(capsys.readouterr().out.split())
    assert exit_info.value.code == 0 and "(default: 0.25)" in text and "--replay.hindsight {True,False}" in text


def test_help_of_resume_names_all_that_may_change(capsys):
    with pytest.raises(SystemExit):
        main(["train", "resume", "--help"])
    text = capsys.readouterr().out.split("may change")[0]
    assert all(name in text for name in CHANGEABLE)


BOX = """
╭─ Unrecognized options ─────────╮
│ Unrecognized options: --sead,  │
│ 3                              │
│ ────────────────────────────── │
│ Perhaps you meant:             │
│     --seed INT                 │
│         Seed. (default: 0)     │
│ ────────────────────────────── │
│ For full helptext, run --help  │
╰────────────────────────────────╯
"""


@pytest.mark.parametrize("frame", [lambda box: box, lambda box: box.translate(str.maketrans("─│╭╮╰╯", "-     "))])
def test_a_box_becomes_one_line(frame):
    box = frame(BOX).replace(" - Unrecognized options -", "   Unrecognized options\n--")
    assert unbox(box) == "Unrecognized options: --sead, 3 (--seed INT)"


LISTENER = """
import hashlib, os, sys, time
from pregrasp_jax.training.interrupt import Interrupt

def say(line):
    if not line.startswith("ready"):
        time.sleep({"slow": 0.3, "stuck": 1e6}.get(sys.argv[1], 0))
    print(line + "\\n", end="", flush=True)  # in one piece: the signal is answered in a thread of its own

with Interrupt(say, lambda: say("cursor back")) as interrupt:
    say("ready")
    if sys.argv[1] == "busy":
        # One bytecode of a minute that gives the GIL away, as a compilation does: Python-level handlers have to wait.
        hashlib.pbkdf2_hmac("sha256", b"", b"", 10**8)
    while interrupt.exit_code is None:
        time.sleep(0.01)
    if sys.argv[1] == "deaf":
        os._exit(interrupt.exit_code)
    say("stopped by the loop")
    sys.exit(interrupt.exit_code)
"""


def _listener(mode: str) -> subprocess.Popen:
    process = subprocess.Popen([sys.executable, "-c", LISTENER, mode], cwd=ROOT, stdout=subprocess.PIPE, text=True)
    assert process.stdout and process.stdout.readline() == "ready\n"
    return process


@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_the_first_signal_asks_the_loop_to_stop(number, code):
    process = _listener("idle")
    process.send_signal(number)
    output, _ = process.communicate(timeout=20)
    # Two lines in either order: the signal counts before it is answered, which a thread of its own does.
    by_loop, answer = sorted(output.splitlines())
    assert process.returncode == code and by_loop == "stopped by the loop" and answer.startswith("stopping: this step")


def test_the_answer_to_a_signal_is_finished_though_the_loop_ends_before():
    process = _listener("slow")
    process.send_signal(signal.SIGTERM)
    output, _ = process.communicate(timeout=20)
    assert process.returncode == 143 and "stopping: this step is finished" in output


def test_a_signal_counts_though_it_cannot_be_answered():
    process = _listener("deaf")
    assert process.stdout
    process.stdout.close()
    process.send_signal(signal.SIGTERM)
    assert process.wait(timeout=20) == 143


def test_the_second_signal_is_heard_though_the_console_takes_nothing():
    """A paused terminal, or a pipe that nobody reads: a line takes for ever, and so does restoring it."""
    process = _listener("stuck")
    process.send_signal(signal.SIGTERM)
    time.sleep(0.5)
    process.send_signal(signal.SIGTERM)
    assert process.wait(timeout=10) == 143


def test_the_second_signal_ends_a_busy_process_at_once():
    process = _listener("busy")
    process.send_signal(signal.SIGINT)
    assert process.stdout and "stopping" in process.stdout.readline(), "it answers though the main thread is busy"
    assert process.poll() is None
    process.send_signal(signal.SIGINT)
    output, _ = process.communicate(timeout=20)
    assert process.returncode == 130 and output == "cursor back\n"


def _rows(path: Path) -> list[dict]:
    rows = [json.loads(line) for line in (path / "metrics.jsonl").read_text().splitlines()]
    return [{key: value for key, value in row.items() if not key.startswith("time/")} for row in rows]


def _train(*arguments: str) -> subprocess.Popen:
    return subprocess.Popen([sys.executable, str(ROOT / "train.py"), *arguments], cwd=ROOT, env=dict(os.environ))


@pytest.mark.slow
def test_killed_and_resumed_real_runs_measure_the_same(tmp_path):
    options = ["--train.minutes", "0", "--train.episodes", "16", "--train.checkpoint-minutes", "0.01"]
    assert _train("ci", "--run-dir", f"{tmp_path}/whole", *options).wait() == 0
    killed = _train("ci", "--run-dir", f"{tmp_path}/killed", *options)
    metrics = tmp_path / "killed" / "metrics.jsonl"
    while not (metrics.exists() and len(metrics.read_text().splitlines()) > 8):
        assert killed.poll() is None
        time.sleep(0.05)
    killed.kill()
    killed.wait()
    assert _train("resume", f"{tmp_path}/killed").wait() == 0
    assert _rows(tmp_path / "killed") == _rows(tmp_path / "whole")
