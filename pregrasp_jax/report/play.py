"""Pictures of policies at work: one decision, whole episodes, and the scenes of a bank."""

import collections
import dataclasses
import functools
import itertools
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from PIL import Image, ImageDraw

from pregrasp_jax import drawing
from pregrasp_jax.evaluation.player import Player
from pregrasp_jax.evaluation.runner import MIN_BATCH, Decision, Evaluator
from pregrasp_jax.heightmap import HullInstances, scene_hulls
from pregrasp_jax.spaces.workspace import Box, Workspace
from pregrasp_jax.task.env import Env
from pregrasp_jax.types import EnvState, HandPose

SECONDS_PER_FRAME = 1.5
"""s; a panel holds five pictures to look at."""

_CUT_HEIGHT = 0.01
"""m, what is left of walls that would hide the scene."""

_COLUMNS, _TILE = 4, (240, 320)

Tiles = list[tuple[str, np.ndarray]]
"""Pictures of one decision, each with its caption."""


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
    reset, hulls_of = jax.jit(env.reset_to), jax.jit(functools.partial(env_hulls, env))
    tiles = []
    for index in indices:
        state = reset(jnp.int32(index))
        hulls = hulls_of(state)
        view = drawing.draw_camera(hulls, target_slot=int(state.scene.target), camera=drawing.side_view(_TILE))
        picture = Image.fromarray(view)
        ImageDraw.Draw(picture).text((6, 4), f"{index}: {_target_name(env, state)}", fill=(30, 30, 30))
        tiles.append(np.asarray(picture))
    tiles += [np.full_like(tiles[0], 255)] * (-len(tiles) % _COLUMNS)
    return np.concatenate([np.concatenate(tiles[i : i + _COLUMNS], axis=1) for i in range(0, len(tiles), _COLUMNS)])


def make_play(player: Player, seed: int) -> Callable[[int], Iterator[Decision]]:
    """Return the function scene -> its decisions, one at a time, the last of which is the end of the episode.

    What is drawn is what an evaluation counts: the programs are the same.
    """
    return functools.partial(Evaluator(player.env, num_envs=MIN_BATCH).play, player.policy, seed=seed)


def in_batch(function: Callable[..., Any]) -> Callable[..., Any]:
    """Return the compiled function of one scene that rounds as in a batch (see `evaluation.runner.MIN_BATCH`)."""
    batched = jax.jit(jax.vmap(function))

    def call(*args: Any) -> Any:
        copies = jax.tree.map(lambda leaf: jnp.stack([leaf] * MIN_BATCH), args)
        return jax.tree.map(lambda leaf: leaf[0], batched(*copies))

    return call


def draw_panel(player: Player, decision: Decision) -> np.ndarray:
    """Return scene | height | segmentation | one Q map per choice, with what is allowed and the chosen push."""
    return make_panel(player.env, decision, draw_tiles(player, decision))


def make_panel(env: Env, decision: Decision, tiles: Tiles) -> np.ndarray:
    """Return the pictures of a decision side by side under a title."""
    return drawing.make_panel(tiles, title=" | ".join(describe_decision(env, decision)))


def draw_tiles(player: Player, decision: Decision) -> Tiles:
    """Return the pictures of `draw_panel`, each with its caption."""
    env, state = player.env, decision.state
    return drawing.make_tiles(
        env_hulls(env, state),
        state.obs,
        int(state.scene.target),
        actions=env.primitive.actions,
        mask=np.asarray(env.action_mask(state.hand)),
        q_values=None if player.q_values is None else np.asarray(player.q_values(state)),
        taken=None if decision.action is None else taken_action(env, state.hand, decision.action),
    )


def describe_decision(env: Env, decision: Decision) -> tuple[str, str, str]:
    """Return which scene, which target, and what is done or how it ended."""
    state = decision.state
    scene, target = f"scene {int(state.scene_index)}", f"target {_target_name(env, state)}"
    if decision.action is None:
        return scene, target, f"{decision.ending} after {int(state.num_pushes)} pushes"
    return scene, target, f"push {int(state.num_pushes) + 1}: {describe_action(env, state.hand, decision.action)}"


def describe_action(env: Env, hand: HandPose, action: Any) -> str:
    """Return how the hand is held and where it is sent."""
    taken, aperture = taken_action(env, hand, action), float(env.primitive.decode(hand, action).end.aperture)
    actions, (x, y) = env.primitive.actions, taken.end
    free = f" at {aperture:.2f} {actions.free[0].unit}" if actions.free else ""
    return f"{actions.choices[taken.choice].name}{free} to x {x:.2f} m, y {y:.2f} m"


def taken_action(env: Env, hand: HandPose, action: Any) -> drawing.Taken:
    """Return what is drawn of an action in its normal form; `hand` is where it was before."""
    stroke = env.primitive.decode(hand, action)
    start, end = (tuple(np.asarray(pose.xy, float).tolist()) for pose in (stroke.start, stroke.end))
    return drawing.Taken(int(env.primitive.choice(action)), start, end)


def env_hulls(env: Env, state: EnvState) -> HullInstances:
    """Return what stands on the table of a scene, robot and walls included; see `_cut_away`."""
    return scene_hulls(env.bank, env.robot, state.scene, state.physics_obs, _cut_away(env.workspace))


def _cut_away(workspace: Workspace) -> Workspace:
    """Return a place whose walls on the viewer's side (y < 0) are low, so that they hide nothing in pictures."""

    def lowered(wall: Box) -> Box:
        low = min(wall.half_size[2], _CUT_HEIGHT / 2)
        return dataclasses.replace(wall, center=(*wall.center[:2], low), half_size=(*wall.half_size[:2], low))

    walls = tuple(lowered(wall) if wall.corners()[:, 1].max() < 0 else wall for wall in workspace.walls)
    return dataclasses.replace(workspace, walls=walls)


def _target_name(env: Env, state: EnvState) -> str:
    return env.bank.names[int(state.scene.object_ids[state.scene.target])]
