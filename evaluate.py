"""Evaluate a policy by the paper's protocol: fixed test scenes, at most ten pushes, one grasp.

python evaluate.py --policy runs/NAME --object-set seen --episodes 100 --json result.json
"""

import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro

from pregrasp_jax.cli.evaluate import evaluate
from pregrasp_jax.command_line import one_line_errors, parse
from pregrasp_jax.config import AssetsConfig, Camera, ObjectSet, PhysicsConfig, SceneConfig
from pregrasp_jax.evaluation.player import EvaluationConfig


@dataclass(frozen=True, kw_only=True)
class Assets:
    """Which objects."""

    object_dir: Annotated[str | None, tyro.conf.arg(aliases=["--object-dir"])] = None
    """Folder of .obj/.stl/.ply/.glb meshes (DIR/seen and DIR/unseen if present); None is the built-in catalogue."""


@dataclass(frozen=True, kw_only=True)
class Arguments:
    """Evaluate a policy on the fixed test scenes, print a table, and write a JSON file."""

    policy: str
    """random, guided, straight, clear, lookahead, pretrained, or a run folder of train.py."""
    object_set: ObjectSet = "seen"
    """Objects used in training, or objects kept for evaluation."""
    assets: Assets = field(default_factory=Assets)
    camera: Camera | None = None
    """What the policy sees through; None is the camera it was trained with (orthographic for scripts)."""
    r_out: float | None = None
    """m, outer radius of the half ring; None is the one it was trained with."""
    obstacles_may_leave: bool = False
    """True counts failures as the paper does: an obstacle may leave the workspace, and stands beside it then."""
    physics: PhysicsConfig = field(default_factory=PhysicsConfig)
    scene: SceneConfig = field(default_factory=SceneConfig)
    episodes: int = 100
    """Test scenes to run, from the first; all policies meet the same."""
    seed: int = 0
    """Seed of the policy's own randomness; scenes, yaws and targets are fixed."""
    num_envs: int = 0
    """Scenes side by side, 0 chooses; with `native` results do not depend on it."""
    json: Path | None = None
    """Write the result here; `python -m pregrasp_jax compare A.json B.json` pairs two of them."""
    video: Path | None = None
    """Write a GIF of some episodes here."""
    video_episodes: int = 3
    """Episodes in the GIF, from the first scene."""


def main() -> None:
    """Parse, evaluate, print."""
    with one_line_errors():
        arguments = parse(lambda: tyro.cli(Arguments, description=__doc__, config=(tyro.conf.FlagConversionOff,)))
        request = EvaluationConfig(
            policy=arguments.policy,
            assets=AssetsConfig(object_dir=arguments.assets.object_dir, object_set=arguments.object_set),
            scene=arguments.scene,
            physics=arguments.physics,
            camera=arguments.camera,
            r_out=arguments.r_out,
            obstacles_may_leave=arguments.obstacles_may_leave,
            episodes=arguments.episodes,
            seed=arguments.seed,
            num_envs=arguments.num_envs,
        )
        evaluate(request, json_file=arguments.json, video=arguments.video, video_episodes=arguments.video_episodes)


if __name__ == "__main__":
    try:
        main()
    except KeyboardInterrupt:
        sys.exit("interrupted")
