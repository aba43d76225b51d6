"""Pictures of decisions and scenes as the commands write them, of the real environment and built-in objects."""

import dataclasses
import typing
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from PIL import Image

from pregrasp_jax import drawing
from pregrasp_jax.cli import commands
from pregrasp_jax.cli.main import main
from pregrasp_jax.config import Config, SceneConfig
from pregrasp_jax.evaluation import player
from pregrasp_jax.evaluation.player import EvaluationConfig, Player, make_player
from pregrasp_jax.report import play as report_play
from pregrasp_jax.spaces import grid
from pregrasp_jax.task.assembly import make_env
from pregrasp_jax.task.env import Env

TOP, LEFT, MAP, GAP = 26, 8, 300, 8
"""Pixels of a panel: where its first picture begins, the size of a map, the space between pictures."""


@pytest.fixture(scope="module")
def env() -> Env:
    return make_env(Config(scene=SceneConfig(test_scenes=3)), split="test")


@pytest.fixture(scope="module")
def targets(env: Env) -> np.ndarray:
    """Return where the targets stand [3, 2], which are turned about the middle of the table at a reset."""
    reset = jax.jit(env.reset_to)
    states = [reset(jnp.int32(scene)) for scene in range(3)]
    return np.array([state.target_xy for state in states])


@pytest.fixture
def cached(env: Env, monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Let commands use the small environment, and count that they keep what they compile."""
    calls: list[str] = []
    for module in (commands, player):
        monkeypatch.setattr(module, "make_env", lambda *_, **__: env)
        monkeypatch.setattr(module, "prepare", lambda: calls.append("kept"))
    return calls


@pytest.fixture
def straight(cached: list[str]) -> Player:
    return make_player(EvaluationConfig(policy="straight"))


def _run(*arguments: str) -> None:
    assert main(arguments) == 0


def _pixel(xy: np.ndarray) -> np.ndarray:
    """Return (row, column) of a point on a map, which has x to the right and y up."""
    return MAP * np.array([0.5 - xy[1] / 0.5, 0.5 + xy[0] / 0.5])


def _centroid(image: np.ndarray, color: np.ndarray) -> np.ndarray:
    """Return the mean (row, column) of the pixels that have the hue of a colour, whatever the light."""
    direction = image / np.maximum(np.linalg.norm(image, axis=-1, keepdims=True), 1e-9)
    mask = direction @ (color / np.linalg.norm(color)) > 0.995
    assert mask.sum() > 20
    return np.argwhere(mask).mean(axis=0)


def test_show_draws_the_target_where_it_stands_and_the_push_towards_it(
    targets: np.ndarray, cached: list[str], tmp_path: Path
) -> None:
    _run("show", "--policy", "straight", "--scene", "2", "--png", str(tmp_path / "scene.png"))
    assert cached == ["kept"]
    panel = np.asarray(Image.open(tmp_path / "scene.png")).astype(float)
    starts = LEFT + 400 + GAP + (MAP + GAP) * np.arange(4)
    height, segmentation, closed, open_ = (panel[TOP : TOP + MAP, start : start + MAP] for start in starts)
    target = targets[2]
    assert target[0] < -0.03 and target[1] < -0.05, "far from the middle, or the mirror image would do too"
    np.testing.assert_allclose(_centroid(segmentation, drawing.TARGET_COLOR), _pixel(target), atol=6)
    assert np.ptp(height[:20], axis=(0, 1)).max() == 0 < np.ptp(height, axis=(0, 1)).min(), (
        "objects stand on an empty table, far from its edge"
    )
    # `straight` opens the hand: the arrow is all in which the two last maps differ, and its tip is rightmost.
    row, col = max(np.argwhere((closed != open_).any(axis=-1)), key=lambda pixel: pixel[1])
    tip = np.array([0.5 * (col / MAP - 0.5), 0.5 * (0.5 - row / MAP)])
    start = np.array([-0.30, 0.0])
    assert abs(np.arctan2(*(tip - start)[::-1]) - np.arctan2(*(target - start)[::-1])) < 0.05
    scene = panel[TOP : TOP + 300, LEFT : LEFT + 400]
    assert _centroid(scene, drawing.TARGET_COLOR)[1] < 220, "left of the middle of the table"


def test_q_values_are_drawn_where_they_belong(straight: Player) -> None:
    decision = next(report_play.make_play(straight, 0)(0))
    row, col = 40, 20  # x = -0.1475 m, y = -0.0475 m: in reach, and below the middle of the map
    q_values = np.zeros((100, 100, 2))
    q_values[row, col, 1] = 1.0
    learned = dataclasses.replace(straight, q_values=lambda _: q_values)
    names, tiles = zip(*report_play.draw_tiles(learned, decision._replace(action=None)), strict=True)
    assert names == ("scene", "height, 0 to 0.30 m", "segmentation", "Q closed 0.00 to 1.00", "Q open 0.00 to 1.00")
    brightest = np.argwhere((tiles[4] != tiles[3]).any(axis=-1))
    center = _pixel(np.asarray(grid.cell_to_world(jnp.int32(row), jnp.int32(col))))
    np.testing.assert_allclose(brightest.mean(axis=0), center, atol=1)


def test_scenes_are_drawn_side_by_side(
    targets: np.ndarray,
    cached: list[str],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    _run("scenes", "--png", str(tmp_path / "sheet.png"))
    assert cached == ["kept"]
    out = capsys.readouterr().out
    assert out.startswith("3 test scenes") and out.endswith(f"wrote {tmp_path}/sheet.png\n")
    sheet = np.asarray(Image.open(tmp_path / "sheet.png")).astype(float)
    assert sheet.shape == (240, 4 * 320, 3) and (sheet[:, 960:] == 255).all()
    seen = np.array([_centroid(sheet[:, 320 * i : 320 * (i + 1)], drawing.TARGET_COLOR) for i in range(3)])
    # x goes to the right and y away from the viewer, who looks from -y.
    np.testing.assert_array_equal(np.argsort(seen[:, 1]), np.argsort(targets[:, 0]))
    np.testing.assert_array_equal(np.argsort(seen[:, 0]), np.argsort(-targets[:, 1]))


@pytest.mark.parametrize(("pushes", "drawn"), [(0, 0), (1, 1), (99, 3)])
def test_a_decision_is_drawn_after_some_pushes_or_at_the_end(monkeypatch: pytest.MonkeyPatch, pushes: int, drawn: int):
    monkeypatch.setattr(report_play, "make_play", lambda *_: lambda scene: iter(range(4)))
    monkeypatch.setattr(report_play, "draw_panel", lambda _, decision: decision)
    assert report_play.draw_decision(typing.cast(Any, None), scene=0, pushes=pushes) == drawn
