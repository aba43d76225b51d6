"""Pictures of policies at work: one decision, whole episodes, and the scenes of a bank."""

import collections
import itertools
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from PIL import Image, ImageDraw

from pregrasp_jax import drawing, grid
from pregrasp_jax.cli.player import Player
from pregrasp_jax.env import Env
from pregrasp_jax.evaluation.runner import MIN_BATCH
from pregrasp_jax.heightmap import scene_hulls
from pregrasp_jax.judge import TARGET_IN_REGION
from pregrasp_jax.types import OPEN, REASONS, EnvState

SECONDS_PER_FRAME = 1.5
"""s; a panel holds five pictures to look at."""

_COLUMNS, _TILE = 4, (240, 320)

_GRASPED = f"{REASONS[TARGET_IN_REGION]}, grasped"

_hulls = jax.jit(scene_hulls)

Tiles = list[tuple[str, np.ndarray]]
"""Pictures of one decision, each with its caption."""


class Decision(NamedTuple):
    """A state and what was done in it.

    Attributes:
        state: unbatched.
        action: the chosen push, None after the last one.
        ending: what became of the episode, empty while it goes on.
    """

    state: EnvState
    action: int | None
    ending: str

    @property
    def success(self) -> bool:
        """Whether the episode has ended with the target in the hand."""
        return self.ending == _GRASPED


def film_episodes(path: Path, player: Player, *, episodes: int, seed: int) -> None:
    """Write the first scenes as a film with one panel per decision, the same episodes as an evaluation's."""
    play = make_play(player, seed)
    frames = [draw_panel(player, decision) for scene in range(episodes) for decision in play(scene)]
    drawing.save_film(path, frames, seconds_per_frame=SECONDS_PER_FRAME)


def draw_decision(player: Player, *, scene: int, pushes: int, seed: int = 0) -> np.ndarray:
    """Return the panel of a scene after `pushes` pushes, or of its end if that comes first."""
    decisions = itertools.islice(make_play(player, seed)(scene), pushes + 1)
    return draw_panel(player, collections.deque(decisions, maxlen=1)[0])


def draw_scenes(env: Env, indices: Iterable[int]) -> np.ndarray:
    """Return views of scenes side by side, each with its number and target."""
    reset = jax.jit(env.reset_to)
    tiles = []
    for index in indices:
        state = reset(jnp.int32(index))
        hulls = _hulls(env.bank, state.scene, state.physics_obs)
        view = drawing.draw_camera(hulls, target_slot=int(state.scene.target), camera=drawing.side_view(_TILE))
        picture = Image.fromarray(view)
        ImageDraw.Draw(picture).text((6, 4), f"{index}: {_target_name(env, state)}", fill=(30, 30, 30))
        tiles.append(np.asarray(picture))
    tiles += [np.full_like(tiles[0], 255)] * (-len(tiles) % _COLUMNS)
    return np.concatenate([np.concatenate(tiles[i : i + _COLUMNS], axis=1) for i in range(0, len(tiles), _COLUMNS)])


def make_play(player: Player, seed: int) -> Callable[[int], Iterator[Decision]]:
    """Return the function scene -> its decisions, one at a time, the last of which is the end of the episode.

    Keys and rounding are those of `evaluation.Evaluator`, so what is drawn is what was counted.
    """
    env = player.env
    reset, step, decide, grasp = (in_batch(f) for f in (env.reset_to, env.step, player.policy, env.grasp))

    def play(scene: int) -> Iterator[Decision]:
        state = reset(jnp.int32(scene))
        scene_key = jax.random.fold_in(jax.random.key(seed), scene)
        while True:
            action = decide(state, jax.random.fold_in(scene_key, state.num_pushes))
            yield Decision(state, int(action), "")
            state, result = step(state, action)
            if result.terminated | result.truncated:
                break
        ending = REASONS[int(result.reason)]
        if result.reason == TARGET_IN_REGION:
            ending = _GRASPED if grasp(state).held else f"{ending}, grasp failed"
        yield Decision(state, None, ending)

    return play


def in_batch(function: Callable[..., Any]) -> Callable[..., Any]:
    """Return the compiled function of one scene that rounds as in a batch (see `evaluation.runner.MIN_BATCH`)."""
    batched = jax.jit(jax.vmap(function))

    def call(*args: Any) -> Any:
        copies = jax.tree.map(lambda leaf: jnp.stack([leaf] * MIN_BATCH), args)
        return jax.tree.map(lambda leaf: leaf[0], batched(*copies))

    return call


def draw_panel(player: Player, decision: Decision) -> np.ndarray:
    """Return scene | height | segmentation | Q closed | Q open, with the half ring and the chosen push."""
    return make_panel(player.env, decision, draw_tiles(player, decision))


def make_panel(env: Env, decision: Decision, tiles: Tiles) -> np.ndarray:
    """Return the pictures of a decision side by side under a title."""
    return drawing.make_panel(tiles, title=" | ".join(describe_decision(env, decision)))


def draw_tiles(player: Player, decision: Decision) -> Tiles:
    """Return the pictures of `draw_panel`, each with its caption."""
    env, state = player.env, decision.state
    return drawing.make_tiles(
        _hulls(env.bank, state.scene, state.physics_obs),
        state.obs,
        int(state.scene.target),
        p1=tuple(np.asarray(state.p1, float)),
        mask=np.asarray(env.action_mask(state.p1)),
        q_values=None if player.q_values is None else np.asarray(player.q_values(state)),
        action=decision.action,
    )


def describe_decision(env: Env, decision: Decision) -> tuple[str, str, str]:
    """Return which scene, which target, and what is done or how it ended."""
    state = decision.state
    scene, target = f"scene {int(state.scene_index)}", f"target {_target_name(env, state)}"
    if decision.action is None:
        return scene, target, f"{decision.ending} after {int(state.num_pushes)} pushes"
    row, col, aperture = grid.decode_action(jnp.int32(decision.action))
    x, y = np.asarray(grid.cell_to_world(row, col))
    hand = "open" if aperture == OPEN else "closed"
    return scene, target, f"push {int(state.num_pushes) + 1}: {hand} to x {x:.2f} m, y {y:.2f} m"


def _target_name(env: Env, state: EnvState) -> str:
    return env.bank.names[int(state.scene.object_ids[state.scene.target])]
