"""Packed scenes per second and the share of tries that succeed; prints one JSON object.

python benchmarks/scenes.py [--scenes 64] [--object-set seen] [--object-dir DIR]
"""

import pregrasp_jax  # noqa: F401  (sets NPROC before jax is imported)

# isort: split
import argparse
import json
import time

from pregrasp_jax.assets.sets import load_bank_for
from pregrasp_jax.config import SceneConfig, TaskConfig
from pregrasp_jax.robot import get_robot
from pregrasp_jax.scene import bank as scene_bank


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", type=int, default=64, help="scenes to pack, without the cache")
    parser.add_argument("--object-set", choices=["seen", "unseen"], default="seen", help="which objects")
    parser.add_argument("--object-dir", help="folder of meshes instead of the built-in catalogue")
    arguments = parser.parse_args()
    bank = load_bank_for(arguments.object_dir, arguments.object_set)
    eligible = get_robot(TaskConfig().robot).eligibility(bank).eligible
    start = time.perf_counter()
    scenes = scene_bank.build(bank, eligible, SceneConfig(train_scenes=arguments.scenes), "train")
    seconds = time.perf_counter() - start
    rates = {"scenes_per_second": len(scenes) / seconds, "accepted_share": len(scenes) / scenes.tries}
    print(json.dumps(rates | {"scenes": len(scenes), "tries": scenes.tries}))


if __name__ == "__main__":
    main()
