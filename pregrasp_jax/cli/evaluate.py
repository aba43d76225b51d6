"""`pregrasp-jax evaluate`: run a policy by the paper's protocol, print the table, write the JSON and the film."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from pregrasp_jax import io
from pregrasp_jax.config import AssetsConfig, Camera, ObjectSet, PhysicsConfig, SceneConfig

if TYPE_CHECKING:
    from pregrasp_jax.cli.player import EvaluationConfig


@dataclass(frozen=True, kw_only=True)
class Assets:
    """Which objects."""

    object_dir: Annotated[str | None, tyro.conf.arg(aliases=["--object-dir"])] = None
    """Folder of .obj/.stl/.ply/.glb meshes (DIR/seen and DIR/unseen if present); None is the built-in catalogue."""


@dataclass(frozen=True, kw_only=True)
class Options:
    """What the command line asks for."""

    policy: str
    """random, guided, straight, clear, lookahead, pretrained, or a run folder."""
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
    """Write the result here; `pregrasp-jax compare A.json B.json` pairs two of them."""
    video: Path | None = None
    """Write a film of some episodes here: .gif, .webp, or .mp4 (extra `video`)."""
    video_episodes: int = 3
    """Episodes in the film, from the first scene."""


def evaluate_options(options: Annotated[Options, tyro.conf.arg(name="")]) -> None:
    """Evaluate a policy by the paper's protocol: fixed test scenes, at most ten pushes, one grasp.

    Prints a table, and writes a JSON file and a film where asked for:
    `pregrasp-jax evaluate --policy runs/NAME --object-set seen --episodes 100 --json result.json`
    """
    from pregrasp_jax.cli.player import EvaluationConfig

    request = EvaluationConfig(
        policy=options.policy,
        assets=AssetsConfig(object_dir=options.assets.object_dir, object_set=options.object_set),
        scene=options.scene,
        physics=options.physics,
        camera=options.camera,
        r_out=options.r_out,
        obstacles_may_leave=options.obstacles_may_leave,
        episodes=options.episodes,
        seed=options.seed,
        num_envs=options.num_envs,
    )
    evaluate(request, json_file=options.json, video=options.video, video_episodes=options.video_episodes)


def evaluate(
    request: "EvaluationConfig", *, json_file: Path | None = None, video: Path | None = None, video_episodes: int = 3
) -> None:
    """Evaluate a policy; see `pregrasp-jax evaluate --help`.

    Args:
        request: what to evaluate.
        json_file: where the evaluation document goes.
        video: where a film of the first `video_episodes` episodes goes.
        video_episodes: at most `request.episodes`.

    Raises:
        ValueError: something of the request cannot be used, or a file could not be written afterwards.
    """
    from pregrasp_jax.cli.film import film_episodes
    from pregrasp_jax.cli.outputs import refuse_unwritable
    from pregrasp_jax.cli.player import make_player, run_evaluation
    from pregrasp_jax.cli.progress import EpisodeProgress
    from pregrasp_jax.evaluation import format_evaluation

    refuse_unwritable(json_file, "json")
    refuse_unwritable(video, "film")
    if video and not 1 <= video_episodes <= request.episodes:
        raise ValueError(f"video_episodes = {video_episodes} is out of range; allowed is 1 to {request.episodes}")
    with EpisodeProgress() as progress:
        player = make_player(request, say=progress.say)
        document = run_evaluation(request, player, progress=progress, say=progress.say)
        print(format_evaluation(document))
        if json_file:
            io.write_json(json_file, document)
        if video:
            progress.say(f"drawing {video_episodes} episodes")
            film_episodes(video, player, episodes=video_episodes, seed=request.seed)
