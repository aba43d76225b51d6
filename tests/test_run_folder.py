"""Who may write to the folder of a run, and what a session finds there."""

import errno
import fcntl
import json

import pytest
from fake_training import make_config, rows

from pregrasp_jax.training.run_folder import RunFolder

CONFIG = make_config()


def test_a_folder_is_used_by_one_process(tmp_path):
    with (
        RunFolder.create(tmp_path / "run", CONFIG),
        pytest.raises(ValueError, match=r"in use by process \d+; allowed is one process at a time"),
    ):
        RunFolder.open(tmp_path / "run", CONFIG)
    RunFolder.open(tmp_path / "run", CONFIG)


def test_a_file_system_without_locks_is_called_that(tmp_path, monkeypatch):
    def flock(*_: object) -> None:
        raise OSError(errno.ENOLCK, "No locks available")

    monkeypatch.setattr(fcntl, "flock", flock)
    with pytest.raises(
        ValueError, match=r"cannot be locked \(No locks available\); allowed is a file system with locks"
    ):
        RunFolder.create(tmp_path / "run", CONFIG)


@pytest.mark.parametrize(
    ("now", "said"),
    [
        ({"hull bank": "a", "training scenes": "c"}, r"another training scenes \(b, now c\)"),
        ({"hull bank": "a"}, r"another training scenes \(b, now None\)"),
        ({"hull bank": "a", "training scenes": "b", "robot": "d"}, r"another robot \(None, now d\)"),
    ],
)
def test_a_run_keeps_its_objects_and_scenes(tmp_path, now, said):
    with RunFolder.create(tmp_path / "run", CONFIG) as folder:
        folder.begin_session(CONFIG, {"hull bank": "a", "training scenes": "b"})
        with pytest.raises(ValueError, match=said):
            folder.begin_session(CONFIG, now)


@pytest.mark.parametrize("left", ["metrics.jsonl", "best"])
def test_a_run_that_has_lost_its_checkpoints_does_not_begin_anew_over_what_is_left(tmp_path, left):
    path = tmp_path / "run"
    RunFolder.create(path, CONFIG).__exit__()
    RunFolder.open(path, CONFIG).__exit__()  # killed before its first checkpoint: nothing to lose
    (path / left).mkdir()
    with pytest.raises(ValueError, match=r"has lost its checkpoints; allowed is .*; --init-from starts a new run"):
        RunFolder.open(path, CONFIG)


@pytest.mark.parametrize(("evaluated_at", "kept"), [(6, [3, 6, 6]), (3, [3, 6]), (None, [3, 6])])
def test_rows_that_will_be_measured_again_are_dropped(tmp_path, evaluated_at, kept):
    """A run that is killed between its last evaluation and its last checkpoint measures again at the same step."""
    path = tmp_path / "run"
    with RunFolder.create(path, CONFIG) as folder:
        for row in ({"env_steps": 3}, {"env_steps": 6}, {"env_steps": 6, "eval/success_rate": 0.5}, {"env_steps": 9}):
            folder.append_metrics(row)
        with folder.metrics.open("a") as file:
            file.write(json.dumps({"env_steps": 2})[:-3])
        folder.forget_metrics_after(6, evaluated_at=evaluated_at)
    assert [row["env_steps"] for row in rows(path)] == kept
