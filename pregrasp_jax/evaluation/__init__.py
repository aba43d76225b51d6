"""Evaluation by the paper's protocol: run policies on fixed scenes, count, and describe the result."""

from pregrasp_jax.evaluation.results import (
    Episode,
    EvaluationResult,
    evaluation_document,
    format_evaluation,
    format_evaluations,
    load_evaluation,
)
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
