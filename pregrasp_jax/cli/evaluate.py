"""`pregrasp-jax evaluate`: run a policy by the paper's protocol, print the table, write the JSON and the film."""

from pathlib import Path
from typing import Annotated

import tyro

from pregrasp_jax import io
from pregrasp_jax.evaluation_config import EvaluationConfig

ALIASES = {
    "--object-dir": "--assets.object-dir",
    "--object-set": "--assets.object-set",
    "--workspace": "--task.workspace",
    "--camera": "--task.camera",
    "--sensor": "--task.sensor",
    "--r-out": "--task.r-out",
    "--obstacles-may-leave": "--task.obstacles-may-leave",
}
"""Short names of options."""

_VIDEO_EPISODES = 3
"""Episodes in a film unless it is told otherwise."""


def evaluate_options(
    request: Annotated[EvaluationConfig, tyro.conf.arg(name="")],
    json: Path | None = None,
    video: Path | None = None,
    video_episodes: int | None = None,
) -> None:
    """Evaluate a policy by the paper's protocol: fixed test scenes, at most ten pushes, one grasp.

    Prints a table, and writes a JSON file and a film where asked for:
    `pregrasp-jax evaluate --policy runs/NAME --object-set seen --episodes 100 --json result.json`

    The options are named as those of `train`. Short names: --object-dir, --object-set, --workspace, --camera,
    --sensor, --r-out, --obstacles-may-leave.

    Args:
        request: What to evaluate.
        json: Write the result here; `pregrasp-jax compare A.json B.json` pairs two of them.
        video: Write a film of some episodes here: .gif, .webp, or .mp4 (extra `video`).
        video_episodes: Episodes in the film, from the first scene; None is three, or all if there are fewer.
    """
    evaluate(request, json_file=json, video=video, video_episodes=video_episodes)


def evaluate(
    request: EvaluationConfig,
    *,
    json_file: Path | None = None,
    video: Path | None = None,
    video_episodes: int | None = None,
) -> None:
    """Evaluate a policy; see `pregrasp-jax evaluate --help`.

    Args:
        request: what to evaluate.
        json_file: where the evaluation document goes.
        video: where a film of the first `video_episodes` episodes goes.
        video_episodes: at most `request.episodes`; None is three, or all if there are fewer.

    Raises:
        ValueError: something of the request cannot be used, or a file could not be written afterwards.
    """
    from pregrasp_jax.cli.outputs import refuse_unwritable
    from pregrasp_jax.cli.progress import EpisodeProgress
    from pregrasp_jax.evaluation import format_evaluation
    from pregrasp_jax.evaluation.player import make_player, run_evaluation
    from pregrasp_jax.report.play import film_episodes

    refuse_unwritable(json_file, "json")
    refuse_unwritable(video, "film")
    if video_episodes is None:
        video_episodes = min(_VIDEO_EPISODES, request.episodes)
    elif video is None:
        raise ValueError(f"video_episodes = {video_episodes} needs a film; allowed with it is --video FILE")
    elif not 1 <= video_episodes <= request.episodes:
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
