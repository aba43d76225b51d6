"""PPG's own protocol: SR-1, SR-N and clearance of policies of strokes on packed scenes; prints one JSON object.

    python benchmarks/clearing.py --policy strokes ppg [--object-set seen] [--object-dir DIR] [--scenes 100]

Policies are named as for `pregrasp-jax evaluate`. Each is paired with the first one by the first stroke of every scene
(McNemar's exact test).
"""

import pregrasp_jax  # noqa: F401  (sets NPROC before jax is imported)

# isort: split
import argparse
import json
import sys

from pregrasp_jax.config import AssetsConfig, PhysicsConfig, SceneConfig
from pregrasp_jax.evaluation.clearing import Cleared, clear_scenes, own_protocol, summary
from pregrasp_jax.evaluation.player import make_player
from pregrasp_jax.evaluation.statistics import mcnemar_exact
from pregrasp_jax.evaluation_config import EvaluationConfig, TaskOverrides


def paired(a: list[Cleared], b: list[Cleared]) -> dict[str, float]:
    """Return in how many scenes only one of two policies began with a stable grasp, and the p-value."""
    pairs = [(x.stable[0], y.stable[0]) for x, y in zip(a, b, strict=True)]
    only_a, only_b = pairs.count((True, False)), pairs.count((False, True))
    return {"only_first": only_a, "only_this": only_b, "p": mcnemar_exact(only_a, only_b)}


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--policy", nargs="+", default=["strokes", "ppg"], help="policies of strokes")
    parser.add_argument("--object-set", choices=["seen", "unseen"], default="seen", help="which objects")
    parser.add_argument("--object-dir", help="folder of meshes instead of the built-in catalogue")
    parser.add_argument("--scenes", type=int, default=100, help="test scenes, from the first")
    parser.add_argument("--threads", type=int, default=0, help="of physics; 0 takes every core")
    arguments = parser.parse_args()
    found: dict[str, list[Cleared]] = {}
    for policy in arguments.policy:
        request = EvaluationConfig(
            policy=policy,
            assets=AssetsConfig(object_dir=arguments.object_dir, object_set=arguments.object_set),
            scene=SceneConfig(test_scenes=max(arguments.scenes, SceneConfig().test_scenes)),
            physics=PhysicsConfig(threads=arguments.threads),
            task=TaskOverrides(robot="barrett", primitive="push_grasp"),
        )
        player = make_player(request, say=lambda line: print(line, file=sys.stderr))
        found[policy] = clear_scenes(
            own_protocol(player.env),
            player.policy,  # pyright: ignore[reportArgumentType]
            scenes=arguments.scenes,
            progress=lambda done, total, name=policy: print(f"{name}: {done} of {total}", file=sys.stderr),
        )
    first = found[arguments.policy[0]]
    result = {name: {**summary(cleared), "paired": paired(first, cleared)} for name, cleared in found.items()}
    print(json.dumps({"object_set": arguments.object_set, "policies": result}))


if __name__ == "__main__":
    main()
