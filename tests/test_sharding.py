"""Four devices and two processes train as one device does; what they cannot do is refused."""

import dataclasses
import json
import os
import socket
import subprocess
import sys
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest
from fake_training import PictureEnv, make_trainer, never, run, timeless
from sharded_training import EPISODES, make_config

from pregrasp_jax.checkpoint import trees
from pregrasp_jax.config import PhysicsConfig
from pregrasp_jax.training import processes, sharding
from pregrasp_jax.training.run_folder import RunFolder, WatchedFolder

SCRIPT = Path(__file__).with_name("sharded_training.py")
RTOL, ATOL = 1e-3, 1e-5
"""Between sums in another order, after a hundred pushes of learning from them."""


def _environment(*, devices: int) -> dict[str, str]:
    """Return the environment of a process with so many devices."""
    flags = f"{os.environ.get('XLA_FLAGS', '')} --xla_force_host_platform_device_count={devices}"
    folders = os.pathsep.join(map(str, (SCRIPT.parent.parent, SCRIPT.parent)))
    return os.environ | {"XLA_FLAGS": flags, "JAX_PLATFORMS": "cpu", "NPROC": "4", "PYTHONPATH": folders}


def _train(run_dir: Path, fused_iterations: int, *, devices: int, **cluster: str) -> subprocess.Popen:
    """Start sharded_training.py in a process of its own."""
    command = [sys.executable, str(SCRIPT), str(run_dir), str(fused_iterations)]
    environment = _environment(devices=devices) | cluster
    return subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, text=True)


def _train_on_one_device(run_dir: Path, fused_iterations: int) -> Path:
    """Train half-way and resume, here, and return the run folder."""
    for half, episodes in enumerate(EPISODES):
        run(run_dir, make_config(episodes, fused_iterations), resume=half > 0)
    return run_dir


def _assert_equal_runs(got: Path, expected: Path) -> None:
    """Compare every row of the metrics, and every array of the last checkpoint: parameters, replay, scenes."""
    rows = [timeless(path) for path in (got, expected)]
    assert len(rows[0]) == len(rows[1]) > 10 and rows[0][-1]["episodes"] >= EPISODES[-1]
    for row, wanted in zip(*rows, strict=True):
        for name, value in wanted.items():
            assert row[name] == (value if value is None else pytest.approx(value, rel=RTOL, abs=ATOL)), name
    files = [max(path.glob("checkpoints/*/state.safetensors")) for path in (got, expected)]
    arrays, wanted = (trees.decode(file.read_bytes(), origin=str(file)) for file in files)
    assert arrays.keys() == wanted.keys() and int(wanted["learning/learner/gradient_steps"]) > 20
    for name, value in wanted.items():
        if value.dtype == np.float32:
            np.testing.assert_allclose(arrays[name], value, rtol=RTOL, atol=ATOL, err_msg=name)
        else:
            np.testing.assert_array_equal(arrays[name], value, err_msg=name)


@pytest.mark.slow
def test_four_devices_split_scenes_and_batches_and_learn_what_one_learns(tmp_path):
    """Started, checkpointed and resumed; the memory starts the next batch from the errors of the last."""
    process = _train(tmp_path / "four" / "run", 0, devices=4)
    expected = _train_on_one_device(tmp_path / "one", 0)
    said, _ = process.communicate(timeout=600)
    assert process.returncode == 0 and "training on 4 of 4 devices" in said
    assert json.loads((tmp_path / "four" / "facts.json").read_text()) == {
        "devices": 4,
        "processes": 1,
        "shares of scenes": [2],
        "devices with scenes": [4],
        "devices with copies": [4],
        "all copied": True,
        "gradients are added up": True,
        "traces of a push": 1,
        "loops wait for each other": False,
    }
    _assert_equal_runs(tmp_path / "four" / "run", expected)
    goes_on = make_trainer(tmp_path / "four" / "run", make_config(EPISODES[-1], 0), resume=True)
    with goes_on.recorder.folder:
        assert goes_on.recorder.counters.share_done(goes_on.config) == 1.0, "one device reads what four have written"


@pytest.mark.slow
def test_two_processes_of_two_devices_learn_what_one_learns_and_one_of_them_writes(tmp_path):
    """Two pushes of every scene in one program, as accelerators do it."""
    with socket.socket() as free:
        free.bind(("localhost", 0))
        address = f"localhost:{free.getsockname()[1]}"
    cluster = {"JAX_COORDINATOR_ADDRESS": address, "JAX_NUM_PROCESSES": "2"}
    both = [_train(tmp_path / "two" / "run", 2, devices=2, **cluster, JAX_PROCESS_ID=str(i)) for i in range(2)]
    expected = _train_on_one_device(tmp_path / "one", 2)
    said = [process.communicate(timeout=600)[0] for process in both]
    assert [process.returncode for process in both] == [0, 0]
    assert "training on 4 of 4 devices" in said[0]
    assert "done: " in said[0] and not [word for word in ("training", "compil", "done") if word in said[1]]
    facts = json.loads((tmp_path / "two" / "facts.json").read_text())
    assert (facts["devices"], facts["processes"], facts["shares of scenes"]) == (4, 2, [2])
    assert facts["all copied"] and facts["gradients are added up"]
    _assert_equal_runs(tmp_path / "two" / "run", expected)


PUSH = """
import conftest
import jax, jax.numpy as jnp, numpy as np
from jax.sharding import Mesh
from test_mjx_training import FEW, NUM_SLOTS, make_env
from pregrasp_jax.training.sharding import AXIS, Layout

env = make_env(NUM_SLOTS, FEW)
keys = jax.random.split(jax.random.key(0), 8)
actions = ((44 + 2 * jnp.arange(8)) * 100 + 25 + 2 * jnp.arange(8)) * 2 + 1  # eight cells ahead of the open hand
ends = []
for layout in (Layout(), Layout(Mesh(np.array(jax.devices()), (AXIS,)))):
    states = jax.jit(layout.vmap(env.reset), out_shardings=layout.split)(keys)
    start = np.asarray(states.physics_obs.object_poses)
    push = jax.jit(layout.vmap(env.step)).lower(states, jax.device_put(actions, layout.split)).compile()
    ends.append(push(states, jax.device_put(actions, layout.split)))
assert not [word for word in ("all-reduce", "all-gather", "all-to-all", "permute") if word in push.as_text()]
(one, judged), (four, judged_too) = ends
assert not one.physics.diverged.any() and len(four.physics.qpos.sharding.device_set) == 4
moved = np.abs(np.asarray(one.physics_obs.object_poses)[:, :NUM_SLOTS, :2] - start[:, :NUM_SLOTS, :2]).max()
difference = np.abs(np.asarray(one.physics.qpos) - np.asarray(four.physics.qpos))
assert difference[:, :6].max() < 1e-3, "the arm goes where it is told"
# XLA rounds batches of 2 and of 8 differently in the last bit, and contacts amplify it.
assert np.median(difference.max(axis=1)) < 1e-3
assert np.mean(np.asarray(judged.reason) == np.asarray(judged_too.reason)) > 0.7
print("moved", moved)
"""


@pytest.mark.slow
def test_four_devices_push_real_scenes_as_one_does_and_do_not_talk_meanwhile():
    environment = _environment(devices=4)
    done = subprocess.run(
        [sys.executable, "-c", PUSH], cwd=SCRIPT.parent, env=environment, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    assert float(done.stdout.split()[-1]) > 0.01, "objects were pushed"


@pytest.mark.parametrize(
    ("sizes", "said"),
    [
        ({"num_envs": 6}, "train.num_envs = 6 cannot be split over 4 devices; allowed are multiples of 4"),
        ({"batch_size": 10}, "learner.batch_size = 10 cannot be split over 4 devices; allowed are multiples of 4"),
    ],
)
def test_what_cannot_be_split_evenly_is_refused(monkeypatch, sizes, said):
    config = make_config(1, 0)
    for stage in ("train", "learner"):
        part = getattr(config, stage)
        known = {name: size for name, size in sizes.items() if hasattr(part, name)}
        config = dataclasses.replace(config, **{stage: dataclasses.replace(part, **known)})
    assert sharding.make_layout(config) == sharding.Layout(), "one device takes any number"
    monkeypatch.setattr(jax, "device_count", lambda: 4)
    with pytest.raises(ValueError) as refusal:
        sharding.make_layout(config)
    assert str(refusal.value) == said


def test_native_keeps_to_one_device_and_to_one_process(monkeypatch):
    config = dataclasses.replace(make_config(1, 0), physics=PhysicsConfig(engine="native"))
    monkeypatch.setattr(jax, "device_count", lambda: 3)
    assert sharding.make_layout(config).num_devices == 1
    monkeypatch.setattr(jax, "process_count", lambda: 3)
    with pytest.raises(ValueError, match=r"physics.engine = native .*; allowed with several processes .* is mjx"):
        sharding.make_layout(config)


@pytest.mark.parametrize(
    ("environment", "said"),
    [
        ({}, "coordinator_address should be defined"),
        ({"JAX_COORDINATOR_ADDRESS": "localhost:1"}, "Number of processes must be defined"),
        ({processes.PROCESS_ID: "first"}, "JAX_PROCESS_ID = 'first' is no number"),
    ],
)
def test_distributed_without_a_cluster_says_what_is_missing(monkeypatch, environment, said):
    monkeypatch.setattr("jax._src.xla_bridge.backends_are_initialized", lambda: False)
    for name, value in environment.items():
        monkeypatch.setenv(name, value)
    with pytest.raises(ValueError, match="allowed is to start every process by SLURM") as refusal:
        processes.join()
    assert said in str(refusal.value) and "\n" not in str(refusal.value)


def test_processes_that_were_told_something_else_are_refused(monkeypatch):
    processes.refuse_difference("abcd")
    told: Any = np.array([[1, 2], [1, 2], [1, 3]], np.uint8)
    monkeypatch.setattr(processes.multihost_utils, "process_allgather", lambda _: told)
    with pytest.raises(ValueError, match="process 2 has another configuration, other objects or other scenes"):
        processes.refuse_difference("ab")


def test_a_watched_folder_is_only_read(tmp_path):
    config = make_config(3, 0)
    with RunFolder.create(tmp_path / "run", config) as folder:
        folder.begin_session(config, {})
        before = {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*")}
        with WatchedFolder(folder.path) as watched:
            watched.begin_session(config, {"hull bank": "another"})
            trainer = make_trainer(tmp_path / "run", config, env=PictureEnv(), folder=watched)
            trainer.run(never)
            watched.forget_metrics_after(0, evaluated_at=None)
        assert trainer.recorder.saved and trainer.recorder.counters.best == 0.25
        assert {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*")} == before
