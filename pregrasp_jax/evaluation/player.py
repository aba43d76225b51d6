"""An evaluation: find the policy, make the environment it belongs to, run it, describe the result."""

import dataclasses
import functools
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax

from pregrasp_jax.checkpoint import TrainedPolicy, load_policy
from pregrasp_jax.checkpoint.policy import PPG
from pregrasp_jax.config import PUSHING, STYLES, Config, with_absolute_paths
from pregrasp_jax.evaluation import EpisodeCallback, Evaluator, evaluation_document, learned
from pregrasp_jax.evaluation_config import EvaluationConfig, environment_config, given, refuse_other_hand
from pregrasp_jax.machine import announced_compilation
from pregrasp_jax.planning.planner import Planner
from pregrasp_jax.policies import scripts
from pregrasp_jax.policies.ppg import STROKE_SCRIPTS
from pregrasp_jax.policies.scripts import Policy
from pregrasp_jax.startup import prepare
from pregrasp_jax.task.assembly import make_env, with_task
from pregrasp_jax.task.env import Env

NUM_ENVS = 16
"""Scenes side by side, enough to keep the engine's threads busy."""

LOOKAHEAD_NUM_ENVS = 4
"""The same for `lookahead`, each of whose decisions simulates `scripts.LOOKAHEAD_CANDIDATES` scenes."""

_PACKING, _MAKING = 50, 25
"""Scenes, and objects, between two lines that say how many are packed or made."""


@dataclass(frozen=True)
class Player:
    """A policy with the environment that it plays in.

    Attributes:
        policy: who decides.
        q_values: EnvState -> Q [H, W, K] of a learned policy, None of a script.
        env: the test environment.
        config: what the environment was made from.
    """

    policy: Policy | Planner
    q_values: Callable[[Any], jax.Array] | None
    env: Env
    config: Config


def make_player(request: EvaluationConfig, *, say: Callable[[str], None] = print) -> Player:
    """Load the policy and make its environment.

    A learned policy keeps the task it was trained for (radii, horizon, speed); objects, scenes and physics come
    from the request, so that every policy meets the same scenes.

    Args:
        request: what is to be evaluated.
        say: told about slow steps.

    Raises:
        ValueError: there is no such policy, or something of the request is out of range.
    """
    prepare()
    trained = _load(request.policy)
    _check_deciders(request, trained)
    request.validate()
    _check_strokes(request)
    config = environment_config(request, Config() if trained is None else trained.config)
    if trained is not None:
        refuse_other_hand(config, trained.config)
        folders = [with_absolute_paths(made).assets.object_dir for made in (trained.config, config)]
        if folders[0] != folders[1]:
            names = (folder or "the built-in objects" for folder in folders)
            say("note: trained on {}, evaluated on {}".format(*names))

    def packed(done: int, total: int) -> None:
        if done == total or done % _PACKING < 16:
            say(f"packing test scenes: {done} of {total}")

    def made(done: int, total: int) -> None:
        if done == total or done % _MAKING == 0:
            say(f"making objects: {done} of {total}")

    env = make_env(config, split="test", progress=packed, making=made)
    if trained is None:
        return Player(_make_script(request.policy, env, config), None, env, config)
    if config.network.mirror and not env.symmetric:
        say(f"note: the policy averages mirror images, which are no scenes of workspace '{env.workspace.name}'")
    _, style = _named(request.policy)
    as_asked = dataclasses.replace(trained.config, strokes=config.strokes)
    played = learned.play(env, dataclasses.replace(trained, config=as_asked), style, request)
    if not played.fits:
        raise ValueError(f"policy {trained.origin} does not fit its network in this version of the package")
    return Player(played.policy, functools.partial(jax.jit(played.q_values), trained.params), env, config)


def run_evaluation(
    request: EvaluationConfig,
    player: Player,
    *,
    progress: EpisodeCallback | None = None,
    say: Callable[[str], None] = lambda _: None,
) -> dict[str, Any]:
    """Run the episodes and return the evaluation document (see `evaluation.evaluation_document`).

    Args:
        request: what is evaluated.
        player: from `make_player`.
        progress: told when episodes end.
        say: told about compilation.

    Raises:
        ValueError: more episodes than scenes.
    """
    start = time.monotonic()
    default = LOOKAHEAD_NUM_ENVS if request.policy == "lookahead" else NUM_ENVS
    evaluator = Evaluator(player.env, num_envs=request.num_envs or default)
    with announced_compilation(say):
        evaluator.compile(player.policy, episodes=request.episodes)
    result = evaluator.run(player.policy, episodes=request.episodes, seed=request.seed, progress=progress)
    return evaluation_document(
        result,
        policy=request.policy,
        config=player.config,
        seed=request.seed,
        hull_bank_hash=player.env.bank.content_hash,
        scene_bank_hash=player.env.scenes.content_hash,
        workspace_hash=player.env.workspace.content_hash,
        wall_seconds=time.monotonic() - start,
        planning=player.policy.describe() if isinstance(player.policy, Planner) else None,
        reachable=request.reachable,
    )


def _named(spec: str) -> tuple[str, str]:
    """Return which folder (or name) a policy is in, and in what style it is played: `STYLE`, or `STYLE:FOLDER`."""
    style, colon, folder = spec.partition(":")
    if spec in STYLES:
        return PPG, spec
    return (folder, style) if colon and style in STYLES else (spec, "")


def _check_deciders(request: EvaluationConfig, trained: TrainedPolicy | None) -> None:
    """Refuse a search or a choice that has no network to ask."""
    for key in ("plan", "reachable"):
        if getattr(request, key) and (trained is None or trained.config.train.method == "imitation"):
            kind = "is a script" if trained is None else "chooses strokes"
            raise ValueError(
                f"{key} = True: policy {request.policy} {kind}; allowed is pretrained, or a run that learned pushes"
            )


def _check_strokes(request: EvaluationConfig) -> None:
    """Refuse settings of Target-PPG for a policy that has no use for them."""
    asked, random = given(request.strokes), request.policy in STROKE_SCRIPTS
    if asked and request.policy != "target-strokes" and _named(request.policy)[1] != "target-ppg":
        raise ValueError(
            f"strokes.{next(iter(asked))} is about Target-PPG, not about policy {request.policy}; allowed with it: "
            "target-ppg, target-ppg:FOLDER, target-strokes"
        )
    if random and request.strokes.mask_radius:
        raise ValueError(
            f"strokes.mask_radius = {request.strokes.mask_radius}: policy {request.policy} draws strokes everywhere; "
            "allowed with it: target-ppg, target-ppg:FOLDER"
        )


def _load(spec: str) -> TrainedPolicy | None:
    """Return the trained policy that `spec` names, None for a script."""
    refuse_unknown_policy(spec, key="policy")
    return None if spec in scripts.SCRIPTS or spec in STROKE_SCRIPTS else load_policy(_named(spec)[0])


def refuse_unknown_policy(spec: str, *, key: str) -> None:
    """Refuse a name of a policy that is none; see `EvaluationConfig.policy`.

    Args:
        spec: the name of a script, of a policy that ships, or a folder; `STYLE:FOLDER` plays it in that style.
        key: the setting that it was written for.

    Raises:
        ValueError: there is no such policy.
    """
    names = [*scripts.SCRIPTS, *STROKE_SCRIPTS, *PUSHING, *STYLES]
    if spec not in names and not Path(_named(spec)[0]).exists():
        raise ValueError(f"{key} {spec} does not exist; allowed: {', '.join(names)}, or a run folder")


def _make_script(name: str, env: Env, config: Config) -> Policy:
    """Return a script; `lookahead` gets an engine of its own, and no camera, which it would render for nothing."""
    if name in STROKE_SCRIPTS:
        if not env.primitive.actions.free:
            raise ValueError(
                f"policy {name} draws strokes, which task.primitive = {env.task.primitive!r} does not have; allowed is "
                "--task.robot barrett --task.primitive push_grasp"
            )
        return STROKE_SCRIPTS[name](env, config.strokes)
    if env.primitive.actions.free and name != "random":
        raise ValueError(
            f"policy {name} pushes, which task.primitive = {env.task.primitive!r} does not; allowed: random, "
            f"{', '.join(STROKE_SCRIPTS)}, or a trained policy of strokes"
        )
    if name == "lookahead":
        env = with_task(make_env(config, split="test"), camera="orthographic", sensor="clean")
    return scripts.SCRIPTS[name](env)
