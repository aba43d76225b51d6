"""A planner: what it reads, what it proposes, and what an evaluation says of it."""

# Host arrays stand for device arrays here, and every shape is known.
# pyright: reportArgumentType=false, reportOptionalMemberAccess=false

import dataclasses
import math
from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from pregrasp_jax import io
from pregrasp_jax.checkpoint import load_policy
from pregrasp_jax.cli.main import main
from pregrasp_jax.config import Config, PhysicsConfig, SceneConfig, TaskConfig
from pregrasp_jax.evaluation import format_evaluation, load_evaluation
from pregrasp_jax.evaluation.deliberation import Deliberation
from pregrasp_jax.evaluation.learned import play
from pregrasp_jax.evaluation.player import make_player, run_evaluation
from pregrasp_jax.evaluation.statistics import compare
from pregrasp_jax.evaluation_config import EvaluationConfig, PlanningConfig
from pregrasp_jax.learning.members import join
from pregrasp_jax.learning.q_function import make_q_function
from pregrasp_jax.planning import planner
from pregrasp_jax.planning.memory import NOTHING, Sight
from pregrasp_jax.planning.planner import Planned, Planner, spread_best
from pregrasp_jax.planning.promise import promise_of
from pregrasp_jax.planning.rollout import Rollout
from pregrasp_jax.planning.search import Choice
from pregrasp_jax.planning.simulation import make_simulations
from pregrasp_jax.robot.base import hand_pose_of
from pregrasp_jax.task.assembly import make_env, with_task
from pregrasp_jax.types import EnvState, Observation, PhysicsObservation, SceneParams


def make_states(seed: int = 0) -> EnvState:
    """Three states whose hidden parts depend on `seed`; their pictures do not."""
    rng, fixed = np.random.default_rng(seed), np.random.default_rng(99)
    picture = fixed.integers(0, 3, (3, 100, 100)).astype(np.uint8)
    hand = jax.tree.map(lambda leaf: np.stack([leaf] * 3), hand_pose_of((-0.3, 0.0), z=0.1, yaw=0.0, aperture=1.2))
    return EnvState(
        physics=rng.standard_normal((3, 50)),
        scene=SceneParams(rng.integers(0, 9, (3, 8)), rng.standard_normal((3, 8, 7)), np.array([1, 0, 1])),
        scene_index=np.array([4, 2, 4]),
        physics_obs=PhysicsObservation(
            rng.standard_normal((3, 8, 7)),
            fixed.standard_normal((3, 8)),
            rng.standard_normal((3, 7)),
            rng.integers(0, 2, 3) > 0,
            rng.integers(0, 9, 3),
        ),
        obs=Observation(picture, picture, hand),
        centroids=rng.standard_normal((3, 8, 3)),
        num_pushes=np.zeros(3, np.int32),
    )


class Recorder:
    """A planner that says what it was told."""

    def __init__(self):
        self.told: list[tuple[Sight, Any, np.ndarray]] = []

    def decide(self, sight: Sight, memory: Any, key: jax.Array) -> Planned:
        self.told.append((sight, memory, np.asarray(jax.random.key_data(key))))
        return Planned(len(self.told), ("memory", len(self.told)))


def test_a_planner_is_told_what_the_camera_sees_and_where_the_joints_are():
    told = []
    for seed in (0, 1):
        recorder = Recorder()
        actions = Deliberation(recorder, jax.random.key(3))(make_states(seed), np.ones(3, bool))
        told.append(recorder.told)
        assert actions.tolist() == [1, 2, 1]  # scene 4 stands there twice
    assert Sight._fields == ("obs", "joint_pos", "target", "pushes")
    jax.tree.map(np.testing.assert_array_equal, *told)
    assert [memory for _, memory, _ in told[0]] == [NOTHING] * 2


def test_every_episode_has_its_own_memory_and_forgets_it_at_the_end():
    recorder, states = Recorder(), make_states()
    deliberation = Deliberation(recorder, jax.random.key(0))
    deliberation(states, np.array([True, True, False]))
    assert deliberation(states.replace(num_pushes=np.ones(3, np.int32)), np.array([True, True, False])).tolist()[2] == 0
    assert [memory for _, memory, _ in recorder.told[2:]] == [("memory", 1), ("memory", 2)]
    deliberation(states, np.array([True, False, False]))
    assert recorder.told[-1][1] is NOTHING
    keys = [tuple(key) for _, _, key in recorder.told]
    assert len(set(keys[:4])) == 4 and keys[4] == keys[0]  # scene and number of the push, nothing else


def test_proposals_are_apart_and_allowed():
    values = np.full((100, 100, 2), -np.inf)
    values[40:60, 40:60] = np.random.default_rng(0).uniform(size=(20, 20, 2))
    found = spread_best(values, 12)
    assert found[0] == np.argmax(values)
    row, col, choice = np.unravel_index(found, values.shape)
    for i in range(12):
        for j in range(i):
            assert choice[i] != choice[j] or max(abs(row[i] - row[j]), abs(col[i] - col[j])) >= 4
    assert np.isfinite(values.flat[found]).all()
    values[:] = -np.inf
    values[3, 3, 1] = 0.5
    assert spread_best(values, 12) == [np.ravel_multi_index((3, 3, 1), values.shape)]


@pytest.mark.parametrize(
    ("arguments", "line"),
    [
        (["--policy", "clear", "--plan", "True"], "plan = True: policy clear is a script; allowed is pretrained"),
        (["--policy", "strokes", "--plan", "True"], "plan = True: policy strokes is a script; allowed is pretrained"),
        (["--policy", "clear", "--reachable", "True"], "reachable = True: policy clear is a script; allowed is pretr"),
        (["--policy", "ppg", "--reachable", "True"], "reachable = True: policy ppg chooses strokes; allowed is pretr"),
        (["--policy", "target-ppg", "--plan", "True"], "plan = True: policy target-ppg chooses strokes; allowed is pr"),
        (
            ["--policy", "pretrained", "--plan", "True", "--reachable", "True"],
            "reachable = True: plan = True takes no push that is out of reach; allowed is one of the two",
        ),
        (["--policy", "pretrained", "--planning.depth", "1"], "planning.* is set, but plan = False"),
        (
            ["--policy", "pretrained", "--plan", "True", "--planning.variants", "0"],
            "planning.variants = 0 is out of range; allowed is 1 to 8",
        ),
        (
            ["--policy", "pretrained", "--plan", "True", "--planning.budget-ms", "-1"],
            "planning.budget_ms = -1.0 is out",
        ),
    ],
)
def test_bad_settings_are_one_line(arguments: list[str], line: str, capsys: pytest.CaptureFixture[str]):
    with pytest.raises(SystemExit) as exit_:
        main(["evaluate", *arguments])
    error = capsys.readouterr().err
    assert exit_.value.code == 2 and error.startswith("error: ") and error.count("\n") == 1 and line in error


def test_scripts_join_one_proposal_and_compiling_takes_none_of_the_first_decisions_time(monkeypatch):
    searched: list[tuple[list[int], float]] = []

    def record(rollout, bank, roots, candidates, config, promise, *, left, deadline):
        searched.append((candidates, deadline))
        return Choice(candidates[-1], 3)

    values = np.full((9, 9, 2), -np.inf)
    values[4, 4, 1] = 0.5
    compiled: list[str] = []
    scripted = SimpleNamespace(
        values=lambda *_: values, script=lambda *_: [5, 6], compile_grasp=lambda *_: compiled.append("grasp")
    )
    stub: Any = object.__new__(Planner)
    vars(stub).update(
        {
            "_config": PlanningConfig(candidates=1, budget_ms=50),
            "_promise": promise_of(TaskConfig(), 0.7),
            "_rollout": scripted,
        },
        **{"_max_pushes": 10, "_camera": None, "_seconds": [], "_pushes": [], "_rebuild": lambda *_: (None, None)},
    )
    monkeypatch.setattr(planner, "search", record)
    monkeypatch.setattr(planner, "hidden_cells", lambda *_: None)
    monkeypatch.setattr(planner.remembering, "look", lambda *_, **__: ["target"])
    sight: Any = SimpleNamespace(obs=None, target=0, pushes=0)
    assert [stub.decide(sight, ("",), jax.random.key(0)).action for _ in range(2)] == [6, 6]
    best = (4 * 9 + 4) * 2 + 1
    assert [candidates for candidates, _ in searched] == [[best, 5, 6]] * 3 and compiled == ["grasp"]
    assert [math.isinf(deadline) for _, deadline in searched] == [True, False, False]


@pytest.mark.parametrize("discount", [0.7, 0.95])
def test_rebuilt_scenes_are_drawn_and_valued_as_in_training(discount: float, monkeypatch: pytest.MonkeyPatch):
    told: list[Any] = []
    monkeypatch.setattr(planner, "Planner", lambda env, *_, **about: told.append((env, about)))
    trained = load_policy("pretrained")
    learner = dataclasses.replace(trained.config.learner, discount=discount)
    trained = dataclasses.replace(trained, config=dataclasses.replace(trained.config, learner=learner))
    task = dataclasses.replace(trained.config.task, camera="pinhole", sensor="d455")
    env = make_env(Config(task=task, scene=SceneConfig(test_scenes=2)), split="test", threads=1)
    request = EvaluationConfig(policy="pretrained", plan=True, physics=PhysicsConfig(threads=1))
    play(env, trained, "", request)
    play(with_task(env, camera="orthographic", sensor="clean"), trained, "", request)
    (through_pinhole, about), (_, above) = told
    assert (through_pinhole.task.camera, through_pinhole.task.sensor) == ("orthographic", "clean")
    assert above["camera_m"] is None and about["camera_m"].shape == (3,) and about["camera_m"][2] > 0.9
    assert about["promise"] == promise_of(trained.config.task, discount) and about["threads"] == 1


@pytest.mark.parametrize("networks", [2, 9])
def test_all_networks_value_the_real_picture_and_the_first_ones_a_rebuilt_one(networks: int):
    """Mirror images, too, count for the real picture only."""
    policy = load_policy("pretrained")
    env = make_env(dataclasses.replace(policy.config, scene=SceneConfig(test_scenes=2)), split="test", threads=1)
    whole = make_q_function(policy.config.network, policy.config.task, env.primitive.actions)
    simulations = make_simulations(env.robot, env.workspace, num_variants=1, threads=1)
    rollout = Rollout(env, simulations, whole, policy.params, networks=networks, batch=1)
    state = jax.device_get(env.reset_to(jnp.int32(0)))
    some = join(whole.networks(policy.params)[:networks])
    few = dataclasses.replace(whole, mirror_fn=None, members=min(networks, whole.members))
    best = []
    for q_function, params in ((whole, policy.params), (few, some)):
        values = jax.jit(q_function.values)(params, state.obs, state.scene.target)
        best.append(float(values[env.action_mask(state.hand)].max()))
    assert abs(best[0] - best[1]) > 1e-3
    assert rollout.values(state.obs, state.scene.target).max() == pytest.approx(best[0], abs=1e-5)
    assert rollout.propose([state]).values.tolist() == pytest.approx(best[1:], abs=1e-5)


@pytest.mark.slow
def test_hidden_state_cannot_leak():
    """The planner works without objects, scenes and engine of the task, and decides by picture, joints and memory."""
    policy = load_policy("pretrained")
    config = dataclasses.replace(policy.config, scene=SceneConfig(test_scenes=2))
    env = make_env(config, split="test", threads=1)
    q_function = make_q_function(config.network, policy.config.task, env.primitive.actions)
    blind = dataclasses.replace(env, bank=None, scenes=None, engine=None, eligible=None)
    promise = promise_of(policy.config.task, policy.config.learner.discount)
    planner = Planner(
        blind, q_function, policy.params, PlanningConfig(depth=0, variants=1), promise=promise, camera_m=None, threads=1
    )
    states = jax.device_get(jax.jit(jax.vmap(env.reset_to))(jnp.arange(2)))
    rng = np.random.default_rng(0)
    ids, poses = states.scene.object_ids, states.physics_obs.object_poses
    tampered = states.replace(
        physics=states.physics.replace(bits=states.physics.bits[:, ::-1], object_ids=ids[::-1]),
        scene=states.scene.replace(object_ids=ids[:, ::-1], poses=rng.standard_normal(poses.shape)),
        physics_obs=states.physics_obs.replace(
            object_poses=rng.standard_normal(poses.shape), hand_pose=rng.standard_normal((2, 7))
        ),
        centroids=rng.standard_normal(states.centroids.shape),
    )
    first, second = (Deliberation(planner, jax.random.key(0))(s, np.ones(2, bool)) for s in (states, tampered))
    np.testing.assert_array_equal(first, second)
    unlike = states.replace(obs=states.obs.replace(instance_ids=states.obs.instance_ids[::-1]))
    assert (Deliberation(planner, jax.random.key(0))(unlike, np.ones(2, bool)) != first).any()


@pytest.mark.slow
def test_an_evaluation_says_that_planning_was_used(tmp_path: Any):
    settings = PlanningConfig(candidates=1, depth=0, variants=1)
    requests = [
        EvaluationConfig(policy="pretrained", plan=plan, planning=settings if plan else PlanningConfig(), episodes=2)
        for plan in (True, False)
    ]
    documents = []
    for request in requests:
        player = make_player(request, say=lambda _: None)
        documents.append(run_evaluation(request, player))
    planned, plain = documents
    assert plain["planning"] is None and planned["planning"]["settings"] == dataclasses.asdict(settings)
    assert planned["planning"]["per_decision"]["pushes"] > 3, "scripts add to the one that the network proposes"
    assert "pretrained with planning on 2 seen scenes" in format_evaluation(planned)
    found = compare(planned, plain)
    assert found.policies == ("pretrained with planning", "pretrained")
    assert "planning.depth: 0 | off" in found.settings
    file = tmp_path / "planned.json"
    io.write_json(file, planned)
    assert load_evaluation(file) == planned
