"""Grasp every eligible object at the palm under six yaws; prints one JSON object.

    python benchmarks/grasp.py [--object-set seen] [--object-dir DIR] [--scatter] [--like-mjx]

The object stands alone against the palm of the open hand, centred between the fingers, as a perfect push would
leave it. The fingers close with constant force, lift 0.2 m and hold 5 s. `--scatter` moves it away at random as real
pushes do, `--like-mjx` simulates with the hulls and options of the `mjx` engine.
"""

import pregrasp_jax  # noqa: F401  (sets NPROC before jax is imported)
from pregrasp_jax.physics import mjx_version  # noqa: F401  (imports MJX without its print about Warp)

# isort: split
import argparse
import dataclasses
import json

import jax
import jax.numpy as jnp
import numpy as np

from pregrasp_jax.config import AssetsConfig
from pregrasp_jax.physics import native
from pregrasp_jax.physics.mjx_model import make_reference_model
from pregrasp_jax.presets import PRESETS
from pregrasp_jax.robot.description import palm_to_grasp_point
from pregrasp_jax.scene.model import parking_poses
from pregrasp_jax.task.assembly import make_env
from pregrasp_jax.task.env import Env
from pregrasp_jax.types import MAX_OBJECTS, EnvState, SceneParams

NUM_YAWS = 6
GAP = 0.001
"""m between palm and object."""

SCATTER = (0.010, 0.008)
"""m; how far scattered objects stand before the palm and, either way, beside its middle, at most."""


def scene_at_palm(env: Env, obj: int, yaw: float, offset: np.ndarray) -> SceneParams:
    """Return a scene of one object at an offset [2] m from the palm of the hand at the start pose."""
    hulls = np.asarray(env.bank.object_hulls[obj])
    points = np.asarray(env.bank.full.vertices)[hulls[hulls >= 0]].reshape(-1, 3)[:, :2]
    turn = np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]])
    points = points @ turn.T
    x = float(env.robot.start.xy[0]) - palm_to_grasp_point() + GAP - points[:, 0].min()
    y = -(points[:, 1].min() + points[:, 1].max()) / 2
    poses = parking_poses()
    poses[0] = [x + offset[0], y + offset[1], 0, np.cos(yaw / 2), 0, 0, np.sin(yaw / 2)]
    object_ids = np.full(MAX_OBJECTS, -1)
    object_ids[0] = obj
    return SceneParams(jnp.asarray(object_ids), jnp.asarray(poses, jnp.float32), jnp.int32(0))


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--object-set", choices=["seen", "unseen"], default="seen", help="which objects")
    parser.add_argument("--object-dir", help="folder of meshes instead of the built-in catalogue")
    parser.add_argument("--scatter", action="store_true", help="offsets of up to 1 cm and 8 mm instead of none")
    parser.add_argument("--like-mjx", action="store_true", help="hulls and options of the mjx engine")
    arguments = parser.parse_args()
    assets = AssetsConfig(object_dir=arguments.object_dir, object_set=arguments.object_set)
    config = dataclasses.replace(PRESETS["ci"], assets=assets)
    env = make_env(config, split="test")
    if arguments.like_mjx:
        place = env.bank, env.robot, env.workspace
        env = dataclasses.replace(env, engine=native.make_engine(*place, model=make_reference_model(*place)))
    objects = [int(i) for i in np.flatnonzero(env.eligible)]
    cases = [(i, yaw) for i in objects for yaw in np.pi / NUM_YAWS * np.arange(NUM_YAWS)]
    forward, aside = SCATTER if arguments.scatter else (0.0, 0.0)
    offsets = np.random.default_rng(0).uniform((0, -aside), (forward, aside), (len(cases), 2))
    scenes = [scene_at_palm(env, *case, offset) for case, offset in zip(cases, offsets, strict=True)]

    def attempt(scene: SceneParams) -> jax.Array:
        state: EnvState = env.start(scene)
        return env.grasp(state).held

    held = np.asarray(jax.jit(jax.vmap(attempt))(jax.tree.map(lambda *leaves: jnp.stack(leaves), *scenes)))
    held = held.reshape(len(objects), NUM_YAWS)
    by_object = {env.bank.names[i]: float(rate) for i, rate in zip(objects, held.mean(axis=1), strict=True)}
    print(json.dumps({"grasp_rate": float(held.mean()), "grasps": int(held.size), "by_object": by_object}))


if __name__ == "__main__":
    main()
