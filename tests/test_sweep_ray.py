"""Ray: a real cluster of two CPUs on this machine places the workers of a sweep (extra `ray`)."""

import logging
import os
import tempfile
from collections import Counter

import pytest
from test_sweep import drive, make_spec, sessions

from pregrasp_jax.sweep import driver
from pregrasp_jax.sweep.folder import SweepFolder

ray = pytest.importorskip("ray", reason="needs the extra ray: pip install 'pregrasp_jax[ray]'")

from pregrasp_jax.sweep.ray_launcher import RayLauncher  # noqa: E402


@pytest.fixture(scope="module")
def cluster():
    os.environ["RAY_USAGE_STATS_ENABLED"] = "0"
    with tempfile.TemporaryDirectory(prefix="ray-") as folder:  # pytest's are too long for the path of a socket
        ray.init(
            num_cpus=2,
            include_dashboard=False,
            log_to_driver=False,
            logging_level=logging.WARNING,
            object_store_memory=100 * 2**20,
            _memory=2 * 10**9,
            _temp_dir=folder,
        )
        yield
        ray.shutdown()


def test_a_sweep_is_pruned_survives_crashes_and_a_lost_worker_and_goes_on(cluster, tmp_path):
    spec = make_spec(
        parameters={"task.r_out": {"values": [0.15, 0.2]}, "task.r_in": {"values": [0.04, 0.07]}},
        set={"train.env_steps": 2000, "train.minutes": 0, "train.evaluate_every": 100},
        stop={"method": "halving", "rungs": [100], "keep": 0.5},
    )
    folder = SweepFolder.create(tmp_path / "sweep", spec)
    launcher = RayLauncher(folder, spec)
    assert launcher.slots == 2
    start, lost = launcher._start, []

    class LosesOne:
        @staticmethod
        def remote(command):
            if not lost:
                lost.append(command)
                command = ["sh", "-c", "kill -9 $PPID"]  # the process of Ray's task, as when a node goes
            return start.remote(command)

    launcher._start = LosesOne  # pyright: ignore[reportAttributeAccessIssue]
    assert drive(folder, spec, launcher) == 0
    states = folder.states()
    words = driver.status(spec, states)
    assert lost and Counter(words.values()) == {"done": 2, "dropped": 2}
    assert {known.trial.settings["task.r_out"] for known in states if words[known.trial.id] == "done"} == {0.15}
    crashed = [known for known in states if known.trial.settings["task.r_in"] == 0.07]
    assert all(len(sessions(folder, known)) >= 2 for known in crashed)
    assert not any((folder.run(known.trial) / "TWICE").exists() for known in states)


def test_what_does_not_fit_into_the_cluster_is_refused(cluster, tmp_path):
    spec = make_spec(resources={"cores": 4, "memory_gb": 0.01})
    folder = SweepFolder.create(tmp_path / "sweep", spec)
    with pytest.raises(ValueError, match=r"1 trials at a time do not fit into this cluster .* at most 0"):
        RayLauncher(folder, spec)
