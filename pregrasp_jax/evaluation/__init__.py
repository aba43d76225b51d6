"""Evaluation by the paper's protocol: run policies on fixed scenes, count, and describe the result.

What plays is imported when it is asked for, so that what only counts, such as a sweep, does without JAX.
"""

from typing import TYPE_CHECKING, Any

from pregrasp_jax.evaluation.results import (
    Episode,
    EvaluationResult,
    evaluation_document,
    format_evaluation,
    format_evaluations,
    load_evaluation,
)

if TYPE_CHECKING:
    from pregrasp_jax.evaluation.runner import EpisodeCallback, Evaluator, evaluate_policy

__all__ = [
    "Episode",
    "EpisodeCallback",
    "EvaluationResult",
    "Evaluator",
    "evaluate_policy",
    "evaluation_document",
    "format_evaluation",
    "format_evaluations",
    "load_evaluation",
]


def __getattr__(name: str) -> Any:
    """Return what plays."""
    if name not in __all__:
        raise AttributeError(f"module {__name__} has no attribute {name}")
    from pregrasp_jax.evaluation import runner

    return getattr(runner, name)
