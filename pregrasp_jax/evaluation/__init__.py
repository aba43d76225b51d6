"""Evaluation by the paper's protocol: run policies on fixed scenes, count, and describe the result."""

from pregrasp_jax.evaluation.results import (
    Episode,
    EvaluationResult,
    evaluation_document,
    format_evaluation,
    format_evaluations,
    load_evaluation,
)
from pregrasp_jax.evaluation.runner import Evaluator, Progress, evaluate_policy

__all__ = [
    "Episode",
    "EvaluationResult",
    "Evaluator",
    "Progress",
    "evaluate_policy",
    "evaluation_document",
    "format_evaluation",
    "format_evaluations",
    "load_evaluation",
]
