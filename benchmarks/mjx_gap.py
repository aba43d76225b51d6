"""What a policy loses to each of the ways in which `mjx` is not `native`; prints one JSON object.

    python benchmarks/mjx_gap.py [--policy pretrained] [--episodes 200] [--object-set seen]

C MuJoCo plays the same test scenes with one difference after the other, then with all of them. Contacts amplify any
difference, so scenes that end otherwise say little by themselves: `shifted` is `native` with start poses moved at
random by a micrometre, and says how many of them are chance. p is McNemar's, against `native`.
"""

import pregrasp_jax  # noqa: F401  (sets NPROC before jax is imported)
from pregrasp_jax.physics import mjx_version  # noqa: F401  (imports MJX without its print about Warp)

# isort: split
import argparse
import dataclasses
import json
import sys
from collections.abc import Collection
from typing import Any

import numpy as np

from pregrasp_jax.config import AssetsConfig
from pregrasp_jax.evaluation.player import EvaluationConfig, Player, make_player, run_evaluation
from pregrasp_jax.evaluation.statistics import compare
from pregrasp_jax.physics import native
from pregrasp_jax.physics.mjx_model import DIFFERENCES, make_reference_model

SHIFT = 1e-6
"""m; standard deviation."""


def with_differences(player: Player, differences: Collection[str]) -> Player:
    """Return the player with an engine that differs from `native` so."""
    place = player.env.bank, player.env.robot, player.env.workspace
    engine = native.make_engine(*place, model=make_reference_model(*place, differences))
    return dataclasses.replace(player, env=dataclasses.replace(player.env, engine=engine))


def shifted(player: Player) -> Player:
    """Return the player with scenes whose objects are moved by `SHIFT`."""
    scenes = player.env.scenes
    poses = scenes.poses.copy()
    poses[..., :3] += np.random.default_rng(0).normal(scale=SHIFT, size=poses[..., :3].shape)
    return dataclasses.replace(
        player, env=dataclasses.replace(player.env, scenes=dataclasses.replace(scenes, poses=poses))
    )


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--policy", default="pretrained", help="script, `pretrained` or run folder")
    parser.add_argument("--episodes", type=int, default=200, help="test scenes")
    parser.add_argument("--object-set", choices=["seen", "unseen"], default="seen", help="which objects")
    arguments = parser.parse_args()
    assets = AssetsConfig(object_set=arguments.object_set)
    request = EvaluationConfig(policy=arguments.policy, assets=assets, episodes=arguments.episodes)
    own = make_player(request, say=lambda text: print(text, file=sys.stderr))
    players = {
        "native": own,
        "shifted": shifted(own),
        **{name: with_differences(own, [name]) for name in DIFFERENCES},
        "all": with_differences(own, DIFFERENCES),
    }
    table: dict[str, Any] = {}
    reference: dict[str, Any] = {}
    for name, player in players.items():
        document = run_evaluation(request, player)
        reference = reference or document
        pair = compare(reference, document)
        table[name] = {
            **{key: document[key] for key in ("success_rate", "success_ci95", "in_region_rate", "failures")},
            "only_native_succeeds": pair.only_a,
            "only_this_succeeds": pair.only_b,
            "p": pair.p_value,
        }
        print(f"{name}: {table[name]}", file=sys.stderr)
    print(json.dumps({"episodes": arguments.episodes, "policy": arguments.policy, "engines": table}))


if __name__ == "__main__":
    main()
