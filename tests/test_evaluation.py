"""The evaluator against a plain loop over one scene at a time, and the file it writes against hand counts."""

import dataclasses
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from fake_env import ACTIONS, OPEN, FakeEnv, fake_env, make_scenes
from jax.tree_util import Partial

from pregrasp_jax.cli.main import main
from pregrasp_jax.config import Config, SceneConfig, TaskConfig
from pregrasp_jax.evaluation import Episode, EvaluationResult, Evaluator, evaluate_policy, results
from pregrasp_jax.evaluation.statistics import compare, decides_alone
from pregrasp_jax.policies import scripts
from pregrasp_jax.policies.learned import make_learned
from pregrasp_jax.sweep.checks import METRICS
from pregrasp_jax.task.assembly import make_env
from pregrasp_jax.task.primitive import Plan
from pregrasp_jax.types import REASONS, EnvState, GraspResult, Observation

ENV = fake_env()


def _reference(env: Any, policy: scripts.Policy, episodes: int, seed: int, with_grasp: bool) -> list[Episode]:
    """One scene after the other, unbatched, from the definitions."""
    step, policy, rows = jax.jit(env.step), jax.jit(policy), []
    for scene in range(episodes):
        state, motions, total, seconds = env.reset_to(jnp.int32(scene)), 0, 0.0, 0.0
        scene_key = jax.random.fold_in(jax.random.key(seed), scene)
        while True:
            before = state
            state, result = step(state, policy(state, jax.random.fold_in(scene_key, motions)))
            total += float(result.reward)
            if REASONS[int(result.reason)] != "unreachable":
                motions += 1
                seconds += float(np.linalg.norm(state.hand.xy - before.hand.xy)) / env.task.push_speed + 0.25
                seconds += 0.5 * bool(state.hand.aperture != before.hand.aperture)
            if result.terminated or result.truncated:
                break
        reason = REASONS[int(result.reason)]
        if reason == "target_in_region" and with_grasp and not env.grasp(state).held:
            reason = "grasp_failed"
        name = env.bank.names[env.scenes.object_ids[scene, env.scenes.target[scene]]]
        rows.append(_episode(scene, reason, motions, seconds, target=name, return_=total))
    return rows


@dataclass(frozen=True)
class _Shaky(FakeEnv):
    """Grasps of odd scenes make no sense afterwards; in scene 2 contacts are dropped, and it holds."""

    def conclude_grasp(self, state: EnvState, plan: Plan, physics: Any) -> GraspResult:
        odd = state.scene_index % 2 == 1
        return GraspResult(~odd, odd, jnp.where(state.scene_index == 2, 7, 0), plan.obstruction)


def test_what_happens_during_a_grasp_is_not_silent() -> None:
    env: Any = _Shaky()
    result = evaluate_policy(env, scripts.SCRIPTS["straight"](ENV), episodes=12, num_envs=5)
    grasped = [e for e in result.episodes if e.reason in ("target_in_region", "nan")]
    assert {e.reason for e in grasped if e.scene % 2} == {"nan"}
    assert {e.reason for e in grasped if not e.scene % 2} == {"target_in_region"}
    assert [e.scene for e in result.episodes if e.overflows] == [2] and result.summary()["overflows"] == 1


def _assert_equal(result: EvaluationResult, expected: list[Episode]) -> None:
    assert [dataclasses.replace(e, seconds=0.0) for e in result.episodes] == [
        dataclasses.replace(e, seconds=0.0) for e in expected
    ]
    np.testing.assert_allclose([e.seconds for e in result.episodes], [e.seconds for e in expected], atol=1e-3)


@pytest.mark.parametrize(("name", "with_grasp"), [("straight", True), ("clear", False), ("random", True)])
def test_agrees_with_a_loop_over_single_scenes(name: str, with_grasp: bool) -> None:
    policy = scripts.SCRIPTS[name](ENV)
    expected = _reference(ENV, policy, 12, 3, with_grasp)
    _assert_equal(evaluate_policy(ENV, policy, episodes=12, seed=3, with_grasp=with_grasp, num_envs=5), expected)


def test_reference_scenes_cover_what_matters() -> None:
    reasons = {e.reason for e in evaluate_policy(ENV, scripts.make_straight(ENV), episodes=12).episodes}
    assert {"target_in_region", "grasp_failed"} <= reasons, reasons
    reasons = {e.reason for e in evaluate_policy(ENV, scripts.make_random(ENV), episodes=12).episodes}
    assert {"obstacle_in_region", "truncated", "unreachable"} <= reasons, reasons


def test_does_not_depend_on_num_envs() -> None:
    policy = scripts.make_random(ENV)
    first, *others = (evaluate_policy(ENV, policy, episodes=11, seed=1, num_envs=n) for n in (1, 4, 32))
    assert all(other == first for other in others)
    assert [episode.scene for episode in first.episodes] == list(range(11))


@pytest.mark.slow
def test_real_scenes_do_not_depend_on_num_envs() -> None:
    # Contacts amplify the last bit: this fails if a batch size rounds differently, see `runner.MIN_BATCH`.
    env = make_env(Config(scene=SceneConfig(test_scenes=8)), split="test")
    first, *others = (evaluate_policy(env, scripts.make_clear(env), episodes=8, num_envs=n) for n in (1, 5, 8))
    assert all(other == first for other in others)


def test_seed_moves_only_the_policy() -> None:
    random, straight = scripts.make_random(ENV), scripts.make_straight(ENV)
    evaluator = Evaluator(ENV, num_envs=12)
    assert evaluator.run(random, episodes=12, seed=0) != evaluator.run(random, episodes=12, seed=1)
    assert evaluator.run(straight, episodes=12, seed=0) == evaluator.run(straight, episodes=12, seed=1)


def test_a_run_compiles_nothing_that_was_not_announced() -> None:
    """After `compile`, runs of policies of that kind find everything there, and end as they would without it."""
    straight = scripts.make_straight(ENV)

    def act(far: jax.Array, state: EnvState, key: jax.Array) -> jax.Array:
        return jnp.where(far > 0, straight(state, key), 0)

    evaluator = Evaluator(ENV, num_envs=5)
    evaluator.compile(Partial(act, jnp.float32(1)), episodes=12)
    compiled = dict(evaluator._compiled)
    results = [evaluator.run(Partial(act, jnp.float32(far)), episodes=12) for far in (1, 0)]
    assert evaluator._compiled == compiled and len(compiled) == 4
    assert results[0] == evaluate_policy(ENV, straight, episodes=12, num_envs=5) and results[0].successes
    assert results[1].failures == {"unreachable": 12}


def _scene_far_away(pushes: int) -> Any:
    """Return one scene whose target needs exactly `pushes` pushes along x: one onto the grid, then 40 mm each."""
    scenes = make_scenes(1)
    scenes.xy[:] = 0.24
    scenes.xy[0, 1] = (-0.2475 + 0.04 * (pushes - 1), -0.0025)
    scenes.target[0] = 1
    return fake_env(scenes=scenes, task=TaskConfig(r_in=0.035, r_out=0.1))


@pytest.mark.parametrize(("pushes", "reason"), [(1, "target_in_region"), (10, "target_in_region"), (12, "truncated")])
def test_success_on_the_last_push_counts(pushes: int, reason: str) -> None:
    env = _scene_far_away(pushes)

    def crawl(state: EnvState, key: jax.Array) -> jax.Array:
        del key
        ahead = state.hand.xy + jnp.array([0.04, 0.0])
        return scripts.nearest_action(env.action_mask(state.hand), ahead, jnp.int32(OPEN), ACTIONS)

    (episode,) = evaluate_policy(env, crawl, episodes=1).episodes
    assert (episode.reason, episode.motions) == (reason, min(pushes, 10))


def test_a_refused_push_is_not_a_motion() -> None:
    def step_then_dive(state: EnvState, key: jax.Array) -> jax.Array:
        del key
        mask = ENV.action_mask(state.hand)
        row, col, _ = ACTIONS.unravel(scripts.nearest_action(mask, jnp.array([-0.18, 0.0]), jnp.int32(0), ACTIONS))
        return ACTIONS.encode(jnp.where(state.num_pushes < 1, row, 0), col, jnp.int32(0))

    (episode,) = evaluate_policy(ENV, step_then_dive, episodes=1).episodes
    assert (episode.reason, episode.motions) == ("unreachable", 1)
    # One push of 0.12 m at 0.1 m/s, 0.25 s of settling and 0.5 s for closing the hand; nothing for the refusal.
    assert episode.seconds == pytest.approx(1.2 + 0.75, abs=0.05)


def test_progress_counts_every_episode_once() -> None:
    calls: list[tuple[int, int, int]] = []
    policy = scripts.make_straight(ENV)
    result = evaluate_policy(ENV, policy, episodes=12, num_envs=4, progress=lambda *args: calls.append(args))
    assert [done for done, _, _ in calls] == sorted(done for done, _, _ in calls)
    assert calls[-1] == (12, 12, result.successes)
    # Progress never runs ahead of the grasp.
    assert all(successes <= result.successes for _, _, successes in calls)


def test_new_parameters_do_not_compile_again() -> None:
    traces = []

    def q_values(params: jax.Array, obs: Observation, target: jax.Array) -> jax.Array:
        del target
        traces.append(1)
        return params * jnp.ones((*obs.height.shape, 2))

    make = make_learned(ENV, q_values)
    evaluator = Evaluator(ENV, num_envs=3)
    for scale in (1.0, 2.0):
        evaluator.run(make(jnp.float32(scale)), episodes=5)
    assert len(traces) == 1


@pytest.mark.parametrize("episodes", [0, 13])
def test_refuses_more_episodes_than_scenes(episodes: int) -> None:
    with pytest.raises(ValueError, match=f"episodes = {episodes} is out of range; this scene bank allows 1 to 12"):
        evaluate_policy(ENV, scripts.make_straight(ENV), episodes=episodes)


def _episode(scene: int, reason: str, motions: int, seconds: float = 1.0, **fields: Any) -> Episode:
    fields = {"target": "can", "return_": 2.0, "success": reason == "target_in_region"} | fields
    return Episode(scene=scene, reason=reason, motions=motions, seconds=seconds, **fields)


RESULT = EvaluationResult(
    (
        _episode(0, "target_in_region", 2),
        _episode(1, "target_in_region", 5),
        _episode(2, "grasp_failed", 10, 7.0),
        _episode(3, "off_table", 3),
        _episode(4, "grasp_failed", 0, 0.0),
    )
)


def _document(result: EvaluationResult = RESULT, policy: str = "clear", **fields: Any) -> dict:
    return results.evaluation_document(
        result,
        policy=policy,
        config=Config(),
        seed=4,
        hull_bank_hash="h",
        scene_bank_hash="s",
        workspace_hash="w",
        wall_seconds=12.34,
        **fields,
    )


def test_files_and_comparisons_say_that_pushes_out_of_reach_were_passed_over(tmp_path: Path) -> None:
    reached, plain = _document(policy="run", reachable=True), _document(policy="run")
    assert (reached["reachable"], plain["reachable"]) == (True, False)
    assert not decides_alone(reached) and decides_alone(plain)
    assert results.format_evaluation(reached).startswith("run, reachable on 5 seen scenes")
    found = compare(reached, plain)
    assert found.policies == ("run, reachable", "run") and found.settings == ("reachable: True | False",)
    (tmp_path / "e.json").write_text(json.dumps(reached | {"reachable": "yes"}))
    with pytest.raises(ValueError, match=r"damaged evaluation \(reachable\)"):
        results.load_evaluation(tmp_path / "e.json")


def test_sweeps_rank_by_what_trainings_measure():
    assert all(isinstance(RESULT.summary()[name], float) for name in METRICS)


def test_files_and_comparisons_say_what_was_seen_and_how_it_was_counted(tmp_path: Path) -> None:
    plain = _document()
    sensor = {"name": "cell.yaml", "subpixel": 0.1}
    noisy = plain | {"camera": "pinhole", "sensor": sensor, "config": {"task": {"obstacles_may_leave": True}}}
    assert "(table, obstacles may leave, native physics, pinhole camera, sensor cell.yaml, seed 4" in (
        results.format_evaluation(noisy)
    )
    assert "(table, native physics, orthographic camera, seed 4" in results.format_evaluation(plain)
    edited = noisy | {"sensor": sensor | {"subpixel": 0.05}}
    assert compare(noisy, edited).settings == ("sensor.subpixel: 0.1 | 0.05",)
    for key, damaged in (("sensor", "d455"), ("planning", {"settings": 3})):
        (tmp_path / "e.json").write_text(json.dumps(plain | {key: damaged}))
        with pytest.raises(ValueError, match=rf"damaged evaluation \({key}\)"):
            results.load_evaluation(tmp_path / "e.json")


@pytest.mark.slow
def test_a_policy_that_takes_reachable_pushes_is_refused_none_by_a_wall(tmp_path: Path) -> None:
    """`cpu-1` ends its first and its third scene in the shelf by a push that a wall forbids."""
    files = {reachable: tmp_path / f"{reachable}.json" for reachable in ("True", "False")}
    for reachable, file in files.items():
        arguments = ["--policy", "cpu-1", "--workspace", "shelf", "--episodes", "3", "--reachable", reachable]
        assert main(["evaluate", *arguments, "--json", str(file)]) == 0
    walls = {r: [row["obstruction"] == "wall" for row in json.loads(f.read_text())["rows"]] for r, f in files.items()}
    assert walls == {"True": [False] * 3, "False": [True, False, True]}


def test_an_attempt_may_be_two_motions_and_a_target_held_in_any_way() -> None:
    """Strokes: two successes after 1 and 3 strokes with the way back, one target held with another object."""
    kinds = {"motions_per_attempt": 2, "target": "can", "return_": 0.0, "seconds": 1.0}
    episodes = [
        Episode(scene=0, reason="target_held", success=True, motions=2, **kinds),
        Episode(scene=1, reason="target_held", success=True, motions=6, **kinds),
        Episode(scene=2, reason="target_not_alone", success=False, motions=4, **kinds),
        Episode(scene=3, reason="truncated", success=False, motions=20, **kinds),
    ]
    summary = EvaluationResult(tuple(episodes)).summary()
    assert (summary["mean_motions"], summary["mean_attempts"]) == (4.0, 2.0)
    assert (summary["success_rate"], summary["lenient_rate"]) == (0.5, 0.75)
    assert [episode.to_dict()["attempts"] for episode in episodes] == [1, 3, 2, 10]


def test_summary_by_hand() -> None:
    document = _document()
    assert document["success_rate"] == 0.4
    assert document["in_region_rate"] == 0.8
    # Over the two successes only; over all five it would be 4.0.
    assert document["mean_motions"] == 3.5
    assert document["std_motions"] == 1.5
    assert document["failures"] == {"grasp_failed": 2, "off_table": 1}
    assert document["seconds_per_motion"] == 10.0 / 20
    assert document["mean_return"] == 2.0
    assert document["rows"][3] == {
        "scene": 3,
        "target": "can",
        "reason": "off_table",
        "obstruction": "none",
        "success": False,
        "motions": 3,
        "attempts": 3,
        "return": 2.0,
        "seconds": 1.0,
    }


def test_document_says_what_was_run(tmp_path: Path) -> None:
    document = _document()
    assert {k: document[k] for k in ("policy", "physics", "object_set", "camera", "episodes", "seed")} == {
        "policy": "clear",
        "physics": "native",
        "object_set": "seen",
        "camera": "orthographic",
        "episodes": 5,
        "seed": 4,
    }
    assert document["versions"]["mujoco"] and document["config_hash"]
    path = tmp_path / "e.json"
    path.write_text(json.dumps(document))
    assert results.load_evaluation(path) == document
    text = results.format_evaluation(document)
    assert "40.0%" in text and "grasp_failed 2, off_table 1" in text and "3.50 +- 1.50" in text


def test_what_was_in_the_way_is_counted_by_reason() -> None:
    blocked = [("unreachable", "wall"), ("unreachable", "end_error"), ("unreachable", "wall"), ("grasp_failed", "wall")]
    episodes = [
        dataclasses.replace(_episode(scene, reason, 1), obstruction=obstruction)
        for scene, (reason, obstruction) in enumerate([*blocked, ("grasp_failed", "none"), ("off_table", "none")])
    ]
    document = _document(EvaluationResult((*episodes, _episode(6, "target_in_region", 2))))
    assert document["obstructions"] == {"unreachable": {"wall": 2, "end_error": 1}, "grasp_failed": {"wall": 1}}
    assert [row["obstruction"] for row in document["rows"]][:2] == ["wall", "end_error"]
    text = results.format_evaluation(document)
    assert "unreachable 3 (wall 2, end_error 1), grasp_failed 2 (wall 1), off_table 1" in text
    assert "table, native physics" in text, "where it was run"


def test_nothing_succeeded() -> None:
    document = _document(EvaluationResult((_episode(0, "unreachable", 0),)))
    assert document["mean_motions"] is None and document["seconds_per_motion"] is None
    json.dumps(document, allow_nan=False)
    assert "no success" in results.format_evaluation(document)


@pytest.mark.parametrize("content", [None, "not json", "[]", '{"format": "something else"}'])
def test_load_refuses_foreign_files(tmp_path: Path, content: str | None) -> None:
    path = tmp_path / "e.json"
    if content is not None:
        path.write_text(content)
    with pytest.raises(ValueError, match=r"e\.json: .*pregrasp-jax evaluate --json"):
        results.load_evaluation(path)
