"""A run of PPG that learns from another run's grasps, is stopped, and goes on as if it had not been."""

import dataclasses
import errno
import shutil
import types
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from pregrasp_jax.checkpoint import load_policy
from pregrasp_jax.checkpoint.chunks import Ring
from pregrasp_jax.checkpoint.policy import SHIPPED
from pregrasp_jax.checkpoint.state import save
from pregrasp_jax.cli.main import main
from pregrasp_jax.config import StrokesConfig
from pregrasp_jax.evaluation import load_evaluation
from pregrasp_jax.evaluation.clearing import Cleared, summary
from pregrasp_jax.presets import PRESETS
from pregrasp_jax.task.push_grasp import stroke_actions
from pregrasp_jax.training import imitation, session
from pregrasp_jax.training.demonstrations import copy_positives, split
from pregrasp_jax.training.run_folder import RunFolder
from pregrasp_jax.training.stroke_collection import blank_positives

ACTIONS = stroke_actions()
STROKES = StrokesConfig(positives=8, width=1 / 32, epochs=2, batch_size=2, validation_share=0.25)


class Silent:
    def say(self, line):
        pass

    def start(self):
        pass

    def show(self, text, *, share):
        pass


SILENT: Any = Silent()


def make_config(**changes):
    return dataclasses.replace(PRESETS["ppg"], strokes=dataclasses.replace(STROKES, **changes))


def grasps(count, capacity=8):
    rng, positives = np.random.default_rng(0), blank_positives(capacity)
    positives.height[:count] = rng.integers(0, 200, (count, 100, 100))
    positives.index[:count] = rng.integers(0, 160_000, count)
    positives.aperture[:count] = rng.uniform(0.6, 1.1, count)
    positives.gain[:count] = np.arange(count) * 0.005
    return positives


@pytest.fixture
def collection(tmp_path):
    path = tmp_path / "collection"
    with RunFolder.create(path, make_config()) as folder:
        save(folder.checkpoints, 6, {"best": jnp.zeros(1)}, Ring(grasps(6), 6), {}, policy="best/")
    return path


def test_grasps_of_another_run_are_copied_as_far_as_there_is_room(collection):
    for capacity, expected in ((8, 6), (4, 4)):
        into = blank_positives(capacity)
        assert copy_positives(collection, into) == expected
        for name in ("height", "index", "aperture", "gain"):
            np.testing.assert_array_equal(getattr(into, name)[:expected], getattr(grasps(6), name)[:expected])
        assert not into.height[expected:].any()


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"collection": "nowhere"}, "nowhere"),
        ({"singulation": True, "positives": 4}, "0 of 4 stable grasps can be learnt from"),
    ],
)
def test_a_collection_that_cannot_be_learnt_from_leaves_no_run(changes, said, collection, tmp_path, monkeypatch):
    monkeypatch.setattr(session, "_load", lambda *_: pytest.fail("nothing is built for it"))
    config = make_config(**{"collection": str(collection), **changes})
    with pytest.raises(ValueError, match=said):
        session.train(config, tmp_path / "new", console=SILENT)
    assert not (tmp_path / "new").exists()


def test_grasps_are_kept_though_too_few_can_be_learnt_from(tmp_path, monkeypatch):
    """They are saved before they are divided, and another run can take them over."""
    config = make_config(positives=3, singulation=True)

    def collect(self) -> bool:
        self.positives, self.counters.written = grasps(3, capacity=3), 3
        return True

    monkeypatch.setattr(imitation._Session, "collect", collect)
    monkeypatch.setattr(imitation, "begin", lambda *_: jnp.zeros(1))
    env: Any = types.SimpleNamespace(primitive=types.SimpleNamespace(actions=ACTIONS))
    with RunFolder.create(tmp_path / "run", config) as folder, pytest.raises(ValueError, match="0 of 3 stable grasps"):
        imitation.run(config, env, folder, SILENT, resumed=False, stop=lambda: False)
    assert copy_positives(tmp_path / "run", blank_positives(3)) == 3


def test_the_split_is_disjoint_and_keeps_to_the_singulation_condition():
    learnt, held_out = split(grasps(8), 8, make_config())
    assert sorted([*learnt, *held_out]) == list(range(8)) and len(held_out) == 2
    learnt, held_out = split(grasps(8), 8, make_config(singulation=True))
    assert sorted([*learnt, *held_out]) == [4, 5, 6, 7], "those that gained more than 15 mm"
    with pytest.raises(ValueError, match=r"0 of 3 stable grasps can be learnt from .* raise strokes\.positives"):
        split(grasps(3), 3, make_config(singulation=True))


def test_what_a_run_has_no_use_for_is_refused_when_it_goes_on_too(collection):
    changed = dataclasses.replace(PRESETS["ppg"], train=dataclasses.replace(PRESETS["ppg"].train, minutes=30.0))
    with pytest.raises(ValueError, match=r"train\.minutes = 30\.0 is not known to"):
        session.resume(changed, collection, console=SILENT)


def test_it_is_one_process(tmp_path, monkeypatch):
    monkeypatch.setattr(session, "_load", lambda *_: pytest.fail("nothing is built for it"))
    monkeypatch.setattr(jax, "process_count", lambda: 2)
    with pytest.raises(ValueError, match="--distributed True is not known to"):
        session.train(make_config(), tmp_path / "new", console=SILENT)


def test_rows_that_were_lost_are_not_learnt_from():
    positives = grasps(8)
    for field in (positives.height, positives.index, positives.aperture, positives.gain):
        field[2:5] = 0  # as a damaged checkpoint leaves them
    learnt, held_out = split(positives, 8, make_config())
    assert sorted([*learnt, *held_out]) == [0, 1, 5, 6, 7]
    learnt, held_out = split(positives, 8, make_config(singulation=True))
    assert sorted([*learnt, *held_out]) == [5, 6, 7]


def test_a_full_disk_costs_a_file_and_not_the_run(collection, tmp_path, monkeypatch):
    """Metrics, the best policy and a checkpoint under way; the first and the last checkpoint have to be written."""
    config, said = make_config(collection=str(collection), epochs=1), []
    env: Any = types.SimpleNamespace(primitive=types.SimpleNamespace(actions=ACTIONS))
    full = {"is": False}

    def cram(owner: Any, name: str) -> None:
        write = getattr(owner, name)

        def crammed(*args: Any, **options: Any) -> Any:
            if full["is"]:
                raise OSError(errno.ENOSPC, "No space left on device")
            return write(*args, **options)

        monkeypatch.setattr(owner, name, crammed)

    def learn(session: Any) -> bool:
        full["is"] = True
        session._validate(np.arange(2))
        session.try_to_save()
        full["is"] = False
        return True

    cram(imitation, "save")
    cram(imitation, "save_policy")
    monkeypatch.setattr(imitation._Session, "learn", learn)
    console: Any = types.SimpleNamespace(say=said.append, start=lambda: None)
    with RunFolder.create(tmp_path / "run", config) as folder:
        cram(folder, "append_metrics")
        ending = imitation.run(config, env, folder, console, resumed=False, stop=lambda: False)
    warnings = [line for line in said if line.startswith("warning: no ")]
    assert ending.startswith("done:") and load_policy(tmp_path / "run" / "best").evaluation["start_loss"] > 0
    assert [line.split()[2] for line in warnings] == ["policy", "metrics", "checkpoint"]
    assert all("(No space left on device: " in line and line.endswith("the run goes on") for line in warnings)


@pytest.mark.parametrize("size", [1, 4, 8, 10, 16])
def test_every_grasp_counts_once_in_a_validation_loss(size):
    rows, losses = np.arange(3, 13), np.random.default_rng(0).normal(size=(2, 13))

    def losses_of(chunk: np.ndarray) -> np.ndarray:
        assert chunk.shape == (size,)
        return losses[:, chunk]

    np.testing.assert_allclose(imitation.mean_losses(losses_of, rows, size), losses[:, 3:].mean(axis=1))


def test_the_measures_of_ppgs_own_protocol():
    scenes = [
        Cleared(scene=0, objects=5, removed=4, stable=(True, False, True), collided=1),
        Cleared(scene=1, objects=8, removed=3, stable=(False, True), collided=0),
    ]
    found = summary(scenes)
    assert found["sr_1"] == 0.5 and found["sr_n"] == 3 / 5 and found["clearance"] == (5 / 5 + 4 / 8) / 2
    two_at_once = Cleared(scene=2, objects=2, removed=2, stable=(False,), collided=0)
    assert summary([two_at_once])["clearance"] == 1
    assert found["strokes"] == 5 and found["collided"] == 1 and found["sr_1_ci95"][0] > 0


@pytest.mark.slow
def test_a_run_that_was_stopped_ends_as_one_that_was_not(collection, tmp_path):
    config = make_config(collection=str(collection))
    env: Any = types.SimpleNamespace(primitive=types.SimpleNamespace(actions=ACTIONS))

    def part(path, steps, *, resumed):
        left = iter([False] * steps)
        folder = RunFolder.open(path, config) if resumed else RunFolder.create(path, config)
        with folder:
            return imitation.run(
                config,
                env,
                folder,
                SILENT,
                resumed=resumed,
                stop=lambda: next(left, True),  # pyright: ignore
            )

    assert "done: 4 stable grasps" in part(tmp_path / "whole", 100, resumed=False)
    assert "interrupted at step 3" in part(tmp_path / "parts", 3, resumed=False)
    assert "done" in part(tmp_path / "parts", 100, resumed=True)
    whole, parts = (load_policy(tmp_path / name) for name in ("whole", "parts"))
    for a, b in zip(jax.tree.leaves(whole.params), jax.tree.leaves(parts.params), strict=True):
        np.testing.assert_array_equal(a, b)
    assert whole.evaluation["start_loss"] > 0 and whole.config == config


@pytest.mark.slow
def test_the_preset_collects_grasps_learns_from_them_and_is_evaluated(tmp_path, capfd):
    settings = {
        "scene.train-scenes": 4,
        "scene.validation-scenes": 2,
        "train.num-envs": 4,
        "physics.threads": 1,
        "strokes.positives": 4,
        "strokes.width": 1 / 32,
        "strokes.epochs": 1,
        "strokes.batch-size": 2,
    }
    options = [word for name, value in settings.items() for word in (f"--{name}", str(value))]
    assert main(["train", "ppg", "--run-dir", str(tmp_path / "run"), *options]) == 0
    assert "done: 4 stable grasps learnt from" in capfd.readouterr().out
    policy = f"target-ppg:{tmp_path / 'run'}"
    played = ["--strokes.free-space", "cluster", "--strokes.mask-radius", "0.1", "--json", str(tmp_path / "two.json")]
    assert main(["evaluate", "--policy", policy, "--episodes", "2", "--scene.test-scenes", "2", *played]) == 0
    assert "on 2 seen scenes" in capfd.readouterr().out
    strokes = load_evaluation(tmp_path / "two.json")["config"]["strokes"]
    assert (strokes["free_space"], strokes["mask_radius"], strokes["width"]) == ("cluster", 0.1, 1 / 32)


@pytest.mark.parametrize(
    ("policy", "settings", "message"),
    [
        (
            "pretrained",
            ["free-space", "cluster"],
            "strokes.free_space is about Target-PPG, not about policy pretrained",
        ),
        ("ppg", ["mask-radius", "0.1"], "strokes.mask_radius is about Target-PPG, not about policy ppg"),
        ("target-strokes", ["mask-radius", "0.1"], "policy target-strokes draws strokes everywhere"),
        ("target-ppg", ["mask-radius", "-1"], "strokes.mask_radius = -1.0 is out of range"),
        ("target-ppg", ["free-space", "wide"], "feasible"),
    ],
)
def test_how_target_ppg_plays_is_refused_where_it_means_nothing(policy, settings, message, capsys):
    with pytest.raises(SystemExit) as exit_:
        main(["evaluate", "--policy", policy, "--episodes", "1", f"--strokes.{settings[0]}", settings[1]])
    error = capsys.readouterr().err
    assert exit_.value.code == 2 and error.startswith("error: ") and error.count("\n") == 1 and message in error


def test_a_folder_is_not_target_ppg_for_its_name(tmp_path, monkeypatch, capsys):
    shutil.copytree(SHIPPED["pretrained"], tmp_path / "target-runs")
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit):
        main(["evaluate", "--policy", "target-runs", "--episodes", "1", "--strokes.free-space", "cluster"])
    assert "strokes.free_space is about Target-PPG, not about policy target-runs" in capsys.readouterr().err
