"""The examples run in short form and do what they say; the code of docs/extend.md runs as it stands."""

import importlib.util
import re
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest
from PIL import Image

from pregrasp_jax.checkpoint import load_policy
from pregrasp_jax.config import Config, SceneConfig
from pregrasp_jax.robot import ROBOTS, get_robot
from pregrasp_jax.spaces import grid
from pregrasp_jax.spaces.workspace import WORKSPACES
from pregrasp_jax.task.registry import KINDS
from pregrasp_jax.types import TABLE_ID

ROOT = Path(__file__).parent.parent
CODE = re.findall(r"^```python\n(.*?)^```", (ROOT / "docs" / "extend.md").read_text(), re.MULTILINE | re.DOTALL)


@pytest.fixture(autouse=True)
def registries():
    """Leave the registries as they were: what examples add must not reach other tests."""
    kept: list[tuple[Any, dict[str, Any]]] = [(registry, dict(registry)) for registry in (ROBOTS, WORKSPACES, KINDS)]
    yield
    for registry, items in kept:
        registry.clear()
        registry.update(items)
    get_robot.cache_clear()


def load(name: str):
    """Return an example as a module."""
    spec = importlib.util.spec_from_file_location(name, ROOT / "examples" / f"{name}.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_an_own_hand_brings_most_targets_into_its_region(capsys):
    result = load("own_hand").main(scenes=6, num_envs=6)
    assert result.successes >= 3, result.failures
    assert f"{result.successes} of 6 targets in its region" in capsys.readouterr().out
    assert all(episode.seconds > 0 for episode in result.episodes)


def test_an_own_policy_is_evaluated_with_a_grasp(capsys):
    result = load("own_policy").main(episodes=2, num_envs=2)
    assert [episode.scene for episode in result.episodes] == [0, 1]
    assert "of 2 scenes" in capsys.readouterr().out


def test_an_own_place_has_a_wall_and_a_nearer_edge(tmp_path):
    module, views = load("own_place"), []
    for name, left in (("table", [False, True]), ("ledge", [True, False])):
        place: Any = WORKSPACES[name]
        assert list(place.has_left(np.array([[0.0, -0.23, 0.1], [0.0, 0.26, 0.1]]))) == left
        module.draw(module.make_place(Config(scene=SceneConfig(test_scenes=2)), name), tmp_path / "place.png")
        views.append(np.asarray(Image.open(tmp_path / "place.png")).astype(int))
    changed = np.abs(views[1] - views[0]).max(axis=-1) > 8
    assert changed.mean() > 0.01, "the wall is not to be seen"


@pytest.mark.slow
def test_an_own_place_is_compared_with_the_table(tmp_path, capsys):
    results = load("own_place").main(scenes=2, num_envs=2, picture=tmp_path / "place.png")
    assert [[episode.scene for episode in result.episodes] for result in results.values()] == [[0, 1], [0, 1]]
    assert re.search(r"^ledge: \d+% of 2 scenes", capsys.readouterr().out, re.MULTILINE)
    assert (tmp_path / "place.png").is_file()


@pytest.mark.slow
def test_training_in_python_changes_parameters_and_keeps_them(tmp_path, capsys):
    module = load("train_in_python")
    module.main(preset="ci", updates=2, episodes=2, folder=tmp_path / "policy")
    out = capsys.readouterr().out
    moved = re.search(r"2 updates moved a parameter by up to (\S+)", out)
    assert moved and float(moved[1]) > 0
    assert load_policy(tmp_path / "policy").config.seed == 1
    assert "of 2 test scenes" in out


@pytest.mark.parametrize("code", CODE, ids=[f"block_{i}" for i in range(len(CODE))])
def test_the_code_of_the_page_runs(code, capsys):
    names = {}
    exec(compile(code, "docs/extend.md", "exec"), names)
    out = capsys.readouterr().out
    if names["config"].task.robot == "fork":
        hand = jax.device_get(names["state"].physics_obs.hand_pose)
        np.testing.assert_allclose(hand[:3], [*grid.cell_to_world(50, 10), 0.06], atol=2e-3)
        assert "hand at" in out
    elif names["config"].task.workspace == "corner":
        assert names["ids"][50, 99] == TABLE_ID and names["height"][50, 99] > 150
        assert names["ids"][50, 97] == TABLE_ID and names["height"][50, 97] == 0
    else:
        assert names["config"].task.primitive == "slanted"
        assert abs(float(names["state"].hand.yaw) - 0.4) < 1e-6 and not names["result"].outcome.unreachable


def test_the_page_has_a_hand_a_place_and_a_primitive():
    assert len(CODE) == 3
    assert all(code.count("\n") < 60 for code in CODE)
