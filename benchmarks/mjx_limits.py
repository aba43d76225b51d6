"""How many pairs and contacts pushes through packed scenes have at once; prints one JSON object.

    python benchmarks/mjx_limits.py [--scenes 100] [--pushes 3] [--every 5] [--object-set seen] [--object-dir DIR]

The sizes of the `mjx` engine's broadphase are chosen from this. Guided pushes run in `native`; every few control rows
the state is given to the collisions of `mjx`, with room for every pair.
"""

import pregrasp_jax  # noqa: F401  (sets NPROC before jax is imported)

# isort: split
import argparse
import dataclasses
import json
import sys
from collections.abc import Iterator
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from pregrasp_jax.config import AssetsConfig, Config, SceneConfig
from pregrasp_jax.physics.mjx import LIMITS
from pregrasp_jax.physics.mjx_model import make_mjx_slot_model
from pregrasp_jax.policies import scripts
from pregrasp_jax.task.assembly import make_env
from pregrasp_jax.task.env import Env
from pregrasp_jax.task.rules import RUNNING

sys.path.append(str(Path(__file__).parent.parent / "tests"))
from mjx_contacts import AMPLE, make_contacts_of

PERCENTILES = (50, 99, 99.9, 100)


def states_of_pushes(env: Env, scenes: int, pushes: int, every: int) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Yield object ids [S, MAX_OBJECTS] and qpos [S, nq] float32 of the scenes that move, every so many rows."""
    act = jax.jit(jax.vmap(scripts.SCRIPTS["guided"](env)))
    run, coordinates = (jax.jit(jax.vmap(f)) for f in (env.engine.run, env.engine.coordinates))
    plan, conclude = (jax.jit(jax.vmap(f)) for f in (env.plan, env.conclude))
    states = jax.jit(jax.vmap(env.reset_to))(jnp.arange(scenes))
    runs = np.ones(scenes, bool)
    object_ids = np.asarray(states.scene.object_ids)
    yield object_ids, np.asarray(coordinates(states.physics)[0])
    for keys in jax.random.split(jax.random.key(0), (pushes, scenes)):
        actions = act(states, keys)
        plans = plan(states, actions)
        left = np.where(runs & np.asarray(plans.reachable), np.asarray(plans.num_ctrl), 0)
        physics, rows = states.physics, np.arange(plans.ctrl.shape[1])
        for first in range(0, left.max(), every):
            ctrl = plans.ctrl[:, np.minimum(first + rows, rows[-1])]
            count = np.clip(left - first, 0, every)
            physics = run(physics, ctrl, jnp.asarray(count, jnp.int32))
            yield object_ids[count > 0], np.asarray(coordinates(physics)[0])[count > 0]
        states, result = conclude(states, plans.replace(ctrl=None), physics)
        runs &= np.asarray(result.reason) == RUNNING


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", type=int, default=100, help="packed test scenes")
    parser.add_argument("--pushes", type=int, default=3, help="pushes in each, at most")
    parser.add_argument("--every", type=int, default=5, help="control rows (20 ms) between two states")
    parser.add_argument("--object-set", choices=["seen", "unseen"], default="seen", help="which objects")
    parser.add_argument("--object-dir", help="folder of meshes instead of the built-in catalogue")
    arguments = parser.parse_args()
    config = dataclasses.replace(
        Config(),
        assets=AssetsConfig(object_dir=arguments.object_dir, object_set=arguments.object_set),
        scene=SceneConfig(test_scenes=max(arguments.scenes, 3)),
    )
    env = make_env(config, split="test")
    moments = states_of_pushes(env, arguments.scenes, arguments.pushes, arguments.every)
    object_ids, qpos = (np.concatenate(part) for part in zip(*moments, strict=True))
    contacts_of = make_contacts_of(make_mjx_slot_model(env.bank, env.robot, env.workspace, limits=AMPLE))
    counts = []
    for first in range(0, len(qpos), arguments.scenes):
        index = np.minimum(np.arange(first, first + arguments.scenes), len(qpos) - 1)
        counts.append(contacts_of(object_ids[index], qpos[index])[1])
    found = jax.tree.map(lambda *x: np.concatenate(x)[: len(qpos)], *counts)
    table = {}
    for name, values, ample, limit in (
        ("hull_pairs", found.hull_pairs, AMPLE.max_hull_pairs, LIMITS.max_hull_pairs),
        ("robot_pairs", found.robot_pairs, AMPLE.max_robot_pairs, LIMITS.max_robot_pairs),
        ("contacts", found.contacts, AMPLE.max_contact_points, LIMITS.max_contact_points),
    ):
        assert values.max() <= ample
        shares = dict(zip(map(str, PERCENTILES), np.percentile(values, PERCENTILES).tolist(), strict=True))
        table[name] = {"percentiles": shares, "limit": limit, "margin": limit / shares["99.9"]}
        table[name]["states_beyond"] = int((values > limit).sum())
    print(json.dumps({"states": len(qpos), "scenes": arguments.scenes, **table}))


if __name__ == "__main__":
    main()
