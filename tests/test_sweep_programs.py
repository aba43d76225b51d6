"""What a sweep makes of programs that do not do what they should: it ends, and says why."""

import json
import sys
from pathlib import Path
from typing import Any

import pytest
from test_sweep import LENGTH, STUB, Here, drive, keep_signals, make_spec  # noqa: F401  (a fixture of all tests here)

from pregrasp_jax.sweep.driver import LOST_WORKERS
from pregrasp_jax.sweep.folder import SweepFolder
from pregrasp_jax.sweep.spec import Spec
from pregrasp_jax.sweep.state import DONE, FAILED, REFUSED

SILENT_ABOUT_SIGNALS = """
import runpy, sys
del sys.argv[0]
try:
    runpy.run_path(sys.argv[0], run_name="__main__")
except SystemExit as exit:
    sys.exit(0 if exit.code == 143 else exit.code)
"""


def begin(path: Path, **keys: Any) -> tuple[SweepFolder, Spec]:
    spec = make_spec(**{"parameters": None, **keys})
    return SweepFolder.create(path / "sweep", spec), spec


def test_a_program_that_is_not_there_is_refused_once(tmp_path):
    folder, spec = begin(tmp_path, program=["nosuchprogram", "x.py"])
    assert drive(folder, spec, Here(folder, spec)) == 1
    (known,) = folder.states()
    assert known.outcome == REFUSED and known.endings == 1
    assert known.message == "error: nosuchprogram cannot be run (No such file or directory); allowed is a program"


@pytest.mark.parametrize("code", [0, 1, 2])
def test_workers_that_write_nothing_down_are_given_up(code, tmp_path):
    """As when somebody has spoilt spec.yaml meanwhile."""
    folder, spec = begin(tmp_path)
    launcher = Here(folder, spec, code=lambda job: code)
    with pytest.raises(ValueError, match=rf"{LOST_WORKERS} workers of trial 0 ended without a word .exit code {code}"):
        drive(folder, spec, launcher)
    assert len(launcher.order) == LOST_WORKERS


def test_a_test_that_writes_nothing_is_a_failure(tmp_path):
    folder, spec = begin(tmp_path, program=[sys.executable, "-c", "pass"], tests={"far": {"episodes": 2}})
    assert drive(folder, spec, Here(folder, spec)) == 1
    (known,) = folder.states()
    assert known.outcome == FAILED and known.endings == 3 and "the test far has ended well, and not" in known.message


def test_a_program_that_does_not_say_that_it_was_stopped_goes_on_after_a_rung(tmp_path):
    script = tmp_path / "own.py"
    script.write_text(SILENT_ABOUT_SIGNALS)
    folder, spec = begin(
        tmp_path,
        program=[sys.executable, str(script), str(STUB)],
        parameters={"task.r_out": {"values": [0.15, 0.2]}},
        stop={"method": "halving", "rungs": [100]},
    )
    assert drive(folder, spec, Here(folder, spec)) == 0
    winner, other = sorted(folder.states(), key=lambda s: -s.env_steps)
    rows = [json.loads(line) for line in (folder.run(winner.trial) / "metrics.jsonl").read_text().splitlines()]
    assert winner.outcome == DONE and winner.env_steps == rows[-1]["env_steps"] == LENGTH and other.env_steps < LENGTH
