"""The command `evaluate.py`: run, print the table, write the JSON and the film."""

from pathlib import Path

from pregrasp_jax import io
from pregrasp_jax.cli.film import film_episodes
from pregrasp_jax.cli.outputs import refuse_unwritable
from pregrasp_jax.cli.player import EvaluationConfig, make_player, run_evaluation
from pregrasp_jax.cli.progress import EpisodeProgress
from pregrasp_jax.evaluation import format_evaluation


def evaluate(
    request: EvaluationConfig, *, json_file: Path | None = None, video: Path | None = None, video_episodes: int = 3
) -> None:
    """Evaluate a policy; see `evaluate.py --help`.

    Args:
        request: what to evaluate.
        json_file: where the evaluation document goes.
        video: where a film of the first `video_episodes` episodes goes.
        video_episodes: at most `request.episodes`.

    Raises:
        ValueError: something of the request cannot be used, or a file could not be written afterwards.
    """
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
