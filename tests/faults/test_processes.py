"""Trainings that are killed or interrupted, as processes: what is lost, what is said, and how they go on.

Every step ends with a checkpoint here, so that at most the step under way may be lost.
"""

import io
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from fake_training import make_config, run, timeless

from pregrasp_jax.checkpoint import checksum
from pregrasp_jax.training.run_folder import RunFolder
from pregrasp_jax.training.trainer import Trainer

TESTS = Path(__file__).parents[1]
CONFIG = make_config(episodes=24, checkpoint_minutes=0.0)
STEP = CONFIG.train.num_envs


@pytest.fixture(scope="module")
def whole(tmp_path_factory) -> Trainer:
    """The run that nothing happens to."""
    return run(tmp_path_factory.mktemp("runs") / "whole", CONFIG)


@contextmanager
def training(path: Path, *what_happens: str) -> Iterator[subprocess.Popen[str]]:
    """Begin a run in a process of its own, or go on with it."""
    if not path.exists():
        RunFolder.create(path, CONFIG).__exit__()
    python = os.pathsep.join([str(TESTS.parent), str(TESTS)])
    command = [sys.executable, str(TESTS / "faults" / "driver.py"), *what_happens, "resume", str(path)]
    process = subprocess.Popen(
        command,
        env=os.environ | {"PYTHONPATH": python},
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    try:
        yield process
    finally:
        process.kill()
        process.communicate()


def go_on(path: Path) -> tuple[Trainer, list[str]]:
    """Resume in this process, to the end; return what it said first."""
    said = io.StringIO()
    trainer = run(path, CONFIG, resume=True, said=said)
    return trainer, said.getvalue().splitlines()


def assert_equal_runs(trainer: Trainer, whole: Trainer) -> None:
    assert checksum(trainer.state) == checksum(whole.state)
    assert timeless(trainer.recorder.folder.path) == timeless(whole.recorder.folder.path)


# The warm-up is 9 pushes, so that updates are due in the steps 5 and 6 of 3 pushes. The checkpoint of step 0 has no
# observations; the first manifest is that of the run.
@pytest.mark.parametrize(
    ("moment", "count", "steps_kept"),
    [
        ("collect", 6, 5),
        pytest.param("update", 2, 5, marks=pytest.mark.slow),
        pytest.param(".npz", 4, 3, marks=pytest.mark.slow),
        pytest.param("state.safetensors", 1, None, marks=pytest.mark.slow),
        pytest.param("manifest.json", 6, 3, marks=pytest.mark.slow),
    ],
)
def test_a_killed_run_loses_the_step_under_way_and_nothing_else(tmp_path, whole, moment, count, steps_kept):
    path = tmp_path / "run"
    with training(path, "kill", moment, str(count)) as process:
        _, error = process.communicate(timeout=300)
    assert process.returncode == -signal.SIGKILL, error
    trainer, said = go_on(path)
    if steps_kept is None:
        assert said[0] == "compiling ..."
    else:
        assert said[0].startswith(f"resuming {path} at step {steps_kept * STEP}, episode ")
    assert not any("warning" in line for line in said)
    assert_equal_runs(trainer, whole)
    assert not list(path.rglob("*.partial")), "what the killed process was writing is swept up"


def read_until(process: subprocess.Popen[str], end: str) -> list[str]:
    """Return the lines up to one that begins so."""
    assert process.stdout
    lines = []
    for line in process.stdout:
        lines.append(line.rstrip("\n"))
        if line.startswith(end):
            return lines
    raise AssertionError(f"ended without {end!r}: {lines}")


STOPPING = "stopping: this step is finished and a checkpoint is written; a second signal ends at once"


@pytest.mark.slow
def test_sigterm_ends_with_a_checkpoint_and_says_how_to_go_on(tmp_path, whole):
    path = tmp_path / "run"
    with training(path, "wait", "collect", "4") as process:
        read_until(process, "waiting")
        process.send_signal(signal.SIGTERM)
        output, error = process.communicate("go on\n", timeout=300)
    assert process.returncode == 128 + signal.SIGTERM and error == ""
    ending = f"interrupted at step {4 * STEP}; continue with `pregrasp-jax train resume {path}`"
    assert output.splitlines() == [STOPPING, ending]
    trainer, said = go_on(path)
    assert said[0].startswith(f"resuming {path} at step {4 * STEP}, episode ")
    assert_equal_runs(trainer, whole)


def test_a_second_ctrl_c_ends_at_once_and_until_then_nobody_else_may_use_the_folder(tmp_path, whole):
    path = tmp_path / "run"
    with training(path, "wait", "collect", "4") as process:
        read_until(process, "waiting")
        with pytest.raises(ValueError) as refusal:
            RunFolder.open(path, CONFIG)
        process.send_signal(signal.SIGINT)
        assert read_until(process, "stopping") == [STOPPING]
        process.send_signal(signal.SIGINT)
        output, error = process.communicate(timeout=20)
    expected = f"run folder {path} is in use by process {process.pid}; allowed is one process at a time"
    assert str(refusal.value) == expected
    assert (process.returncode, output, error) == (128 + signal.SIGINT, "", "")
    trainer, said = go_on(path)
    assert said[0].startswith(f"resuming {path} at step {3 * STEP}, episode "), "the step under way is lost"
    assert_equal_runs(trainer, whole)
