"""PPG's own protocol, in a world whose strokes are told beforehand: who is attempted, how often, what is counted."""

import types
from typing import Any

import flax.struct as struct
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from pregrasp_jax.evaluation import clearing
from pregrasp_jax.evaluation.clearing import MAX_ATTEMPTS, Cleared, clear_scenes, own_protocol
from pregrasp_jax.types import MAX_OBJECTS, SceneParams

STABLE, LOST, COLLIDED = (1, True, False), (1, False, False), (0, False, True)
"""What a stroke did: objects removed, whether the grasp was stable, whether the hand came down on something."""

STROKES = [
    (3, [STABLE, COLLIDED, STABLE]),
    (5, [(0, False, False)] * MAX_ATTEMPTS),
    (4, [(3, False, False)]),
    (4, [STABLE, "diverged"]),
    (2, [(2, False, True)]),
]
"""Of every scene how many objects it has, and its strokes, after which it must be over."""

EXPECTED = [
    Cleared(scene=0, objects=3, removed=2, stable=(True, False, True), collided=1),
    Cleared(scene=1, objects=5, removed=0, stable=(False,) * MAX_ATTEMPTS, collided=0),
    Cleared(scene=2, objects=4, removed=3, stable=(False,), collided=0),
    Cleared(scene=3, objects=4, removed=1, stable=(True, False), collided=0),
    Cleared(scene=4, objects=2, removed=2, stable=(False,), collided=1),
]


class State(struct.PyTreeNode):
    """A scene of which only the number of objects is known."""

    row: jax.Array
    left: jax.Array
    scene: SceneParams


def follow(policy, states, going, key, attempt):
    """Do the strokes that are told; a scene that is over stays as it is, though it says that it was stable."""
    left, stable, collided, diverged = np.array(states.left), [], [], []
    for index, row in enumerate(np.asarray(states.row)):
        told: Any = STROKES[row][1][int(attempt)] if going[index] else (0, True, True)
        diverged.append(told == "diverged")
        removed, is_stable, has_collided = (0, False, False) if told == "diverged" else told
        left[index] -= removed
        stable.append(np.arange(MAX_OBJECTS) == (2 if is_stable else MAX_OBJECTS))
        collided.append(has_collided)
    outcome = types.SimpleNamespace(stable=np.array(stable), collided=np.array(collided), diverged=np.array(diverged))
    return states.replace(left=left), outcome, left


class Scenes(types.SimpleNamespace):
    """A bank of which only the objects are asked for."""

    def __len__(self):
        return len(self.object_ids)


def make_env(counts) -> Any:
    ids = np.where(np.arange(MAX_OBJECTS) < np.array(counts)[:, None], 7, -1)

    def reset_to(row):
        object_ids = jnp.asarray(ids)[row]
        scene = SceneParams(object_ids, jnp.zeros((MAX_OBJECTS, 7)), jnp.int32(0))
        return State(row, jnp.sum(object_ids >= 0), scene)

    return types.SimpleNamespace(scenes=Scenes(object_ids=ids), reset_to=reset_to)


@pytest.fixture
def env(monkeypatch):
    monkeypatch.setattr(clearing, "_stages", lambda env: types.SimpleNamespace(compile=lambda *args: follow))
    return make_env([count for count, _ in STROKES])


@pytest.mark.parametrize("num_envs", [1, 2, 8])
def test_scenes_are_cleared_until_one_object_is_left(env, num_envs):
    told = []
    cleared = clear_scenes(
        env, lambda state, key: None, scenes=5, num_envs=num_envs, progress=lambda *counts: told.append(counts)
    )
    assert cleared == EXPECTED
    assert told[-1] == (5, 5) and len(told) == -(-5 // num_envs)


def test_only_the_scenes_that_are_asked_for(env):
    assert clear_scenes(env, lambda state, key: None, scenes=3, num_envs=2) == EXPECTED[:3]


def test_refusals(env):
    for scenes in (0, 6):
        with pytest.raises(ValueError, match=rf"scenes = {scenes} is out of range; this scene bank allows 1 to 5"):
            clear_scenes(env, lambda state, key: None, scenes=scenes)
    with pytest.raises(ValueError, match="scene 1 has 1 objects; allowed are two or more"):
        clear_scenes(make_env([3, 1]), lambda state, key: None, scenes=2)
    pushes: Any = types.SimpleNamespace(
        primitive=types.SimpleNamespace(actions=types.SimpleNamespace(free=())),
        task=types.SimpleNamespace(primitive="push"),
    )
    with pytest.raises(ValueError, match=r"task\.primitive = 'push' has no strokes with an aperture to choose"):
        own_protocol(pushes)
