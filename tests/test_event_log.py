"""Event files for TensorBoard, read back record by record."""

import struct
from pathlib import Path
from typing import Any

import pytest

from pregrasp_jax.training import event_log
from pregrasp_jax.training.event_log import EventLog

events: Any = pytest.importorskip("tensorboardX.proto.event_pb2")


def _read(folder: Path) -> list[Any]:
    """Return the events of the only file: each is a length, its checksum, the message, and its checksum."""
    (file,) = folder.iterdir()
    data, found = file.read_bytes(), []
    while data:
        (length,) = struct.unpack("<Q", data[:8])
        found.append(events.Event.FromString(data[12 : 12 + length]))
        data = data[16 + length :]
    return found


def test_rows_become_scalars_at_their_steps(tmp_path):
    log = EventLog(tmp_path / "new")
    log.append({"env_steps": 200, "train/loss": 0.25, "train/reward": None, "episodes": 7, "eval/success_ci95": [0, 1]})
    log.append({"env_steps": 400, "train/loss": 0.125})
    _, first, second = _read(tmp_path / "new")  # the first of all names the format
    assert (first.step, second.step) == (200, 400) and first.wall_time > 1.7e9
    assert {v.tag: v.simple_value for v in first.summary.value} == {"train/loss": 0.25, "episodes": 7}
    assert [v.simple_value for v in second.summary.value] == [0.125]


def test_a_resumed_run_voids_what_came_after_its_checkpoint(tmp_path):
    EventLog(tmp_path, resumed_at=300)
    _, start = _read(tmp_path)
    assert start.session_log.status == events.SessionLog.START and start.step == 301


def test_without_the_extra_one_line_says_how_to_get_it(monkeypatch):
    event_log.require_module()
    monkeypatch.setattr(event_log, "MODULE", "no_such_module")
    with pytest.raises(ValueError, match=r"needs no_such_module; install it with `pip install"):
        event_log.require_module()
