"""What a run needs, and what the machine has."""

import bisect
import contextlib

import numpy as np
import pytest
from fake_training import make_config, make_program

from pregrasp_jax import io, machine
from pregrasp_jax.training import resources


def test_what_a_run_needs_is_estimated(tmp_path, monkeypatch):
    rest, ring = make_program(make_config()).shapes().split()
    assert resources.num_bytes(ring) == 70 * (2 * 100 * 100 + 5 * 4)
    resources.check(rest, ring, tmp_path / "new" / "run")
    assert not (tmp_path / "new").exists()
    monkeypatch.setattr(resources, "available_memory", lambda: 10**6)
    with pytest.raises(
        ValueError, match=r"needs about 1.0\d GB of memory, 0.00 GB are free; allowed is more room: 1.0"
    ):
        resources.check(rest, ring, tmp_path)


def test_a_resumed_run_needs_only_the_disk_that_it_does_not_hold(tmp_path, monkeypatch):
    state, ring = np.zeros(1_000_000, np.uint8), np.zeros(8_000_000, np.uint8)

    def needed() -> int:
        """Find by bisection what must be free: 4 states and a quarter of the ring at first."""
        return bisect.bisect_left(range(8_000_000), True, key=fits)

    def fits(free: int) -> bool:
        monkeypatch.setattr(resources, "available_disk", lambda _: free)
        with contextlib.suppress(ValueError):
            resources.check(state, ring, tmp_path)
            return True
        return False

    assert needed() == 6_000_000
    for name, size in {
        "000000007/state": 1_000_000,
        "replay/0.npz": 500_000,
        "000000008.damaged/state": 900_000,
    }.items():
        io.write_bytes(tmp_path / "checkpoints" / name, bytes(size))
    assert needed() == 4_500_000
    io.write_bytes(tmp_path / "checkpoints" / "replay" / "1.npz", bytes(5_000_000))
    assert needed() == 1_000_000, "there must always be room for the next state"


def test_memory_is_read_from_machine_and_control_group(tmp_path, monkeypatch):
    monkeypatch.setattr(machine, "_MEMINFO", tmp_path / "meminfo")
    monkeypatch.setattr(machine, "_CGROUP", tmp_path)
    assert resources.available_memory() is None
    (tmp_path / "meminfo").write_text("MemTotal: 900 kB\nMemAvailable:   500 kB\nHugePages_Total:   0\n")
    (tmp_path / "memory.max").write_text("max\n")
    (tmp_path / "memory.current").write_text("100\n")
    assert resources.available_memory() == 500 * 1024
    (tmp_path / "memory.max").write_text("1000\n")
    assert resources.available_memory() == 900
    # Cached files that nobody uses are given back when they are in the way.
    (tmp_path / "memory.stat").write_text("anon 20\nfile 70\ninactive_file 60\nactive_file 10\n")
    assert resources.available_memory() == 960
