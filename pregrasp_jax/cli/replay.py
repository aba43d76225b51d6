"""`pregrasp-jax replay-dump`: repeat a push on which the physics of a training diverged."""

import dataclasses
import functools
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np

from pregrasp_jax import drawing
from pregrasp_jax.cli.outputs import refuse_unwritable
from pregrasp_jax.report.play import describe_action, env_hulls, in_batch, taken_action
from pregrasp_jax.scene.bank import SceneBank
from pregrasp_jax.startup import prepare
from pregrasp_jax.task.assembly import assemble, load_split_bank
from pregrasp_jax.task.env import Env
from pregrasp_jax.task.primitive import Plan
from pregrasp_jax.training.dump import Dump, load_dump
from pregrasp_jax.training.mishap import Mishap
from pregrasp_jax.types import CTRL_DT, REASONS, EnvState, StepResult


@dataclass(frozen=True)
class RepeatedPush:
    """What a push did when it was repeated.

    Attributes:
        before: the scene before it.
        after: and afterwards.
        result: how it was judged.
        duration: s, how long the push was planned to take; 0 if it was refused.
        speeds: [n] largest generalized speed (m/s or rad/s) after each control row, `CTRL_DT` apart, up to the first
            one at which the physics made no sense.
        identical: whether the engine reports the same numbers as in the training, to the last bit.
    """

    before: EnvState
    after: EnvState
    result: StepResult
    duration: float
    speeds: np.ndarray
    identical: bool


def replay_dump(
    dump: Path,
    /,
    *,
    engine: Literal["native", "mjx"] | None = None,
    object_dir: str | None = None,
    png: Path | None = None,
) -> None:
    """Repeat a push on which the physics of a training diverged, and say what happens.

    Args:
        dump: file that a training wrote to RUN_DIR/dumps.
        engine: push on this engine; the one of the training if left out.
        object_dir: where the meshes of the training lie now; where they lay then if left out.
        png: draw the scene before and after the push here; .png, .jpg, .jpeg or .webp.
    """
    refuse_unwritable(png, "image")
    prepare()
    loaded = load_dump(dump)
    env = make_replay_env(loaded, engine or loaded.engine, object_dir)
    mishap = loaded.mishap(env)
    print(f"compiling and pushing on {env.engine.name} ...")
    replay = make_replay(env)(mishap)
    print("\n".join(describe_replay(env, loaded, mishap, replay)))
    if png:
        drawing.save_image(png, draw_replay(env, mishap, replay))
        print(f"wrote {png}")


def make_replay_env(dump: Dump, engine: str, object_dir: str | None = None) -> Env:
    """Return the environment of a dump, whose only scene is that of the dump.

    Raises:
        ValueError: the objects are others, or the engine cannot be used here.
    """
    config = dump.config
    assets = dataclasses.replace(config.assets, object_dir=object_dir or config.assets.object_dir)
    bank = load_split_bank(dataclasses.replace(config, assets=assets), "train")
    if bank.content_hash != dump.hull_bank_hash:
        raise ValueError(
            f"{dump.path} is of other objects (hull bank {dump.hull_bank_hash}, {assets.object_dir or 'the built-in'} "
            f"{assets.object_set} objects have {bank.content_hash}); wanted are those of the training: --object-dir"
        )
    config = dataclasses.replace(config, physics=dataclasses.replace(config.physics, engine=engine))
    return assemble(config, bank, _one_scene(dump))


def make_replay(env: Env) -> Callable[[Mishap], RepeatedPush]:
    """Return the function that repeats a push; it compiles once.

    The push is run twice by the same program: as a whole, which is what is judged, and row by row to watch it.
    """
    look, plan, run, conclude = (in_batch(f) for f in (env.look, env.plan, env.engine.run, env.conclude))

    def replay(mishap: Mishap) -> RepeatedPush:
        before = look(mishap.state, mishap.hand)
        planned = plan(before, mishap.action)
        num_ctrl = planned.num_ctrl
        physics = run(before.physics, planned.ctrl, num_ctrl)
        after, result = conclude(before, planned, physics)
        pairs = zip(jax.tree.leaves(after.physics_obs), jax.tree.leaves(mishap.seen), strict=True)
        return RepeatedPush(
            before=before,
            after=after,
            result=result,
            duration=CTRL_DT * int(num_ctrl),
            speeds=_watch(env, run, before.physics, planned, int(num_ctrl)),
            identical=all(np.array_equal(new, old, equal_nan=True) for new, old in pairs),
        )

    return replay


def describe_replay(env: Env, dump: Dump, mishap: Mishap, replay: RepeatedPush) -> list[str]:
    """Return what was pushed, how it ended, and whether it did so in the training."""
    kind = f"branch {int(mishap.branch)}" if mishap.branch else "the real one"
    ended = "diverged" if replay.result.outcome.diverged else "did not diverge"
    lines = {
        "push": f"{describe_action(env, mishap.hand, mishap.action)} in {replay.duration:.2f} s; number "
        f"{int(mishap.state.num_pushes) + 1} of its episode, {kind}",
        "training": f"scene {int(mishap.scene)} at step {int(mishap.env_steps)} on {dump.engine}",
        "reason": f"{REASONS[int(replay.result.reason)]}; the physics {ended}",
        "moved": _describe_moves(env, replay),
        "speed": _describe_speeds(replay),
        "same": _describe_difference(env, dump, mishap, replay),
    }
    return [f"{name:<9} {text}" for name, text in lines.items()]


def draw_replay(env: Env, mishap: Mishap, replay: RepeatedPush) -> np.ndarray:
    """Return scene | height | segmentation | push before, and the scene afterwards if it is finite."""
    target, before = int(mishap.state.scene.target), replay.before
    hulls_of = jax.jit(functools.partial(env_hulls, env))
    tiles = drawing.make_tiles(
        hulls_of(before),
        before.obs,
        target,
        actions=env.primitive.actions,
        mask=np.asarray(env.action_mask(before.hand)),
        taken=taken_action(env, before.hand, mishap.action),
    )
    seen = replay.after.physics_obs
    if all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(seen)):
        hulls = hulls_of(replay.after)
        view = drawing.draw_camera(hulls, target_slot=target, camera=drawing.side_view(tiles[0][1].shape[:2]))
        tiles.append(("scene afterwards", view))
    return drawing.make_panel(tiles, title=f"step {int(mishap.env_steps)} | {REASONS[int(replay.result.reason)]}")


def _watch(env: Env, run: Callable[..., Any], physics: Any, plan: Plan, num_ctrl: int) -> np.ndarray:
    """Run one row after the other; see `RepeatedPush.speeds`.

    The `native` engine wakes what sleeps whenever it is called, so the last digits are not those of the whole push.
    """
    rows, speeds, observe = np.arange(len(plan.ctrl)), [], jax.jit(env.engine.observe)
    for row in range(num_ctrl):
        physics = run(physics, plan.ctrl[np.minimum(row + rows, rows[-1])], jnp.int32(1))
        speeds.append(np.abs(env.engine.coordinates(physics)[1]).max())
        if observe(physics).diverged:
            break
    return np.array(speeds)


def _describe_moves(env: Env, replay: RepeatedPush) -> str:
    before, after = (np.asarray(s.physics_obs.object_poses)[:, :3] for s in (replay.before, replay.after))
    moves = np.linalg.norm(after - before, axis=1)
    ids = np.asarray(replay.before.scene.object_ids)
    text = [f"{env.bank.names[i]} {move:.3f} m" for i, move in zip(ids, moves, strict=True) if i >= 0]
    return ", ".join(text)


def _describe_speeds(replay: RepeatedPush) -> str:
    if not len(replay.speeds):
        return "no motion"
    finite = np.where(np.isfinite(replay.speeds), replay.speeds, np.inf)
    when, end = CTRL_DT * (1 + np.argmax(finite)), CTRL_DT * len(finite)
    return f"at most {finite.max():.3g} m/s or rad/s, after {when:.2f} s; watched for {end:.2f} s"


def _describe_difference(env: Env, dump: Dump, mishap: Mishap, replay: RepeatedPush) -> str:
    if env.engine.name != dump.engine:
        return f"not comparable: on {env.engine.name}, from rounded coordinates"
    if replay.identical:
        return "every number as in the training"
    new, old = (np.asarray(seen.object_poses)[:, :3] for seen in (replay.after.physics_obs, mishap.seen))
    return f"no: objects end up to {np.abs(new - old).max():.2g} m elsewhere; the training had {dump.versions}"


def _one_scene(dump: Dump) -> SceneBank:
    """Return a bank that holds nothing but the scene of a dump, as the episode began."""
    names = ("object_ids", "poses", "target")
    try:
        ids, poses, target = (dump.arrays[f"state/scene/{name}"][None] for name in names)
    except KeyError as error:
        raise ValueError(f"{dump.path}: {error.args[0]} is missing; wanted is a file of RUN_DIR/dumps") from None
    zero = np.zeros(1)
    return SceneBank(
        object_ids=ids,
        poses=poses,
        yaw=zero.astype(np.float32),
        target=target,
        seeds=zero.astype(np.int64),
        split="train",
        tries=1,
        content_hash=dump.scene_bank_hash,
    )
