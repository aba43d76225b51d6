"""What a sweep will take: trials, memory, hours."""

import math
import shlex
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from pregrasp_jax.config import Config
from pregrasp_jax.sweep import state
from pregrasp_jax.sweep.checks import Setting, num_settings, settings_to_check
from pregrasp_jax.sweep.launchers import share_out
from pregrasp_jax.sweep.spec import Spec
from pregrasp_jax.sweep.trials import make_trial, train_command, trial_config

_PROGRAM_MEMORY, _WIDE_MEMORY, _OBSERVATION_MEMORY = 1.2e9, 1.2e9, 20.2e3
"""Bytes of a training: all but its replay, what the paper's network takes beside that, an observation."""

_STEPS_PER_SECOND = {"ci": 49.0, "demo": 6.0, "cpu": 7.1, "paper": 1.8}
"""Env steps per second on two cores (docs/presets.md), for an estimate of hours."""

_START = 100.0
"""s until a training of a sweep makes its first push, compilation included."""


def describe(spec: Spec, *, launcher: str = "local", parallel: int | None = None) -> list[str]:
    """Return what a sweep will do, and refuse what does not fit here.

    Raises:
        ValueError: this machine or this launcher cannot run it.
    """
    settings, memory = num_settings(spec), memory_of(spec)
    trained = _trained(spec)
    scripts = len([variant for variant in spec.variants.values() if variant.policy is not None])
    trials = (settings - scripts) * len(spec.seeds) + scripts
    finals = spec.final.top * len(spec.final.seeds)
    one = max((seconds_of(spec, {**spec.set, **varied}) for varied, _ in trained), default=0.0)
    # Of halving, every rung is reached by fewer; what is left goes to the end.
    whole = trials * one * _share_trained(spec, trained) + finals * one
    slots = parallel or 1
    if launcher == "local":
        slots = len(share_out(spec, parallel=parallel, memory=memory))
    lines = [
        f"{settings} settings, {trials} trials{f', then {finals} with fresh seeds' if finals else ''}; each takes "
        f"{spec.resources.cores} core{'s' if spec.resources.cores > 1 else ''}, {memory / 1e9:.1f} GB"
        f"{f', {spec.resources.gpu:g} GPU' if spec.resources.gpu else ''}; {slots} at a time",
        f"about {whole / slots / 3600:.1f} hours, at the speed of two cores of docs/presets.md",
    ]
    for varied, about in trained[:1]:
        command = train_command(spec, make_trial(spec, varied, spec.seeds[0], **about), Path("RUN"))
        lines.append(f"the first: {shlex.join(command)}")
    return lines


def memory_of(spec: Spec) -> float:
    """Return the bytes that the largest trial takes, or is given."""
    if spec.resources.memory_gb is not None:
        return 1e9 * spec.resources.memory_gb
    trained = [trial_config(spec, {**spec.set, **varied}) for varied, about in _trained(spec)]
    return max((_memory(config) for config in trained), default=_PROGRAM_MEMORY)


def seconds_of(spec: Spec, settings: Mapping[str, Any]) -> float:
    """Return about how long a trial takes on the two cores of docs/presets.md."""
    config = trial_config(spec, settings)
    train = config.train
    steps = min(train.env_steps or math.inf, 4 * train.episodes) / _STEPS_PER_SECOND.get(spec.preset, 5.0)
    return _START + min(60 * train.minutes or math.inf, steps)


def _share_trained(spec: Spec, trained: Sequence[Setting]) -> float:
    """Return how much of all trainings is done, at most 1, if halving gives some up."""
    steps = state.rungs(spec)
    if not steps or not trained:
        return 1.0
    length = trial_config(spec, {**spec.set, **trained[0][0]}).train.env_steps
    ends = [*steps, length]
    parts = [spec.stop.keep**i * (end - start) for i, (start, end) in enumerate(zip([0, *ends], ends, strict=False))]
    return sum(parts) / length


def _trained(spec: Spec) -> list[Setting]:
    return [(varied, about) for varied, about in settings_to_check(spec) if about.get("policy") is None]


def _memory(config: Config) -> float:
    wide = config.network.architecture == "paper" and config.network.width >= 1
    return _PROGRAM_MEMORY + (_WIDE_MEMORY if wide else 0) + _OBSERVATION_MEMORY * config.replay.capacity
