"""What a run needs, and what the machine has."""

import pytest
from fake_training import make_config, make_program

from pregrasp_jax.training import resources


def test_what_a_run_needs_is_estimated(tmp_path, monkeypatch):
    rest, ring = make_program(make_config()).shapes().split()
    assert resources.num_bytes(ring) == 70 * (2 * 100 * 100 + 2 * 4)
    resources.check(rest, ring, tmp_path / "new" / "run")
    assert not (tmp_path / "new").exists()
    monkeypatch.setattr(resources, "available_memory", lambda: 10**6)
    with pytest.raises(ValueError, match=r"needs about 1.0\d GB of memory, 0.00 GB are free; a smaller replay.capac"):
        resources.check(rest, ring, tmp_path)


def test_memory_is_read_from_machine_and_control_group(tmp_path, monkeypatch):
    monkeypatch.setattr(resources, "_MEMINFO", tmp_path / "meminfo")
    monkeypatch.setattr(resources, "_CGROUP", tmp_path)
    assert resources.available_memory() is None
    (tmp_path / "meminfo").write_text("MemTotal: 900 kB\nMemAvailable:   500 kB\nHugePages_Total:   0\n")
    (tmp_path / "memory.max").write_text("max\n")
    (tmp_path / "memory.current").write_text("100\n")
    assert resources.available_memory() == 500 * 1024
    (tmp_path / "memory.max").write_text("1000\n")
    assert resources.available_memory() == 900
