"""Command lines: what they accept, print and write."""

import json
import os
import platform
import re
import sys
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest
import trimesh
from bad_files import InlineExecutor
from drawn_params import drawn_params
from fake_env import fake_env
from PIL import Image
from report_files import write_evaluation

import pregrasp_jax
from pregrasp_jax import io, startup
from pregrasp_jax.assets import meshes
from pregrasp_jax.checkpoint import save_policy
from pregrasp_jax.cli import commands, doctor, progress
from pregrasp_jax.cli import evaluate as evaluate_module
from pregrasp_jax.cli.evaluate import evaluate
from pregrasp_jax.cli.main import main
from pregrasp_jax.config import AssetsConfig, Config, PhysicsConfig, SceneConfig, TaskConfig
from pregrasp_jax.evaluation import player
from pregrasp_jax.evaluation.player import EvaluationConfig, make_player, run_evaluation
from pregrasp_jax.evaluation_config import TaskOverrides
from pregrasp_jax.learning.networks import QNetwork
from pregrasp_jax.physics import mjx_version
from pregrasp_jax.presets import PRESETS
from pregrasp_jax.report import play as report_play
from pregrasp_jax.scene.bank import SceneBank
from pregrasp_jax.training import resources


@pytest.fixture
def run(capsys: pytest.CaptureFixture[str]) -> Any:
    """Return a function arguments -> exit code, standard output, standard error."""

    def call(*arguments: str) -> tuple[int, str, str]:
        try:
            code = main(arguments)
        except SystemExit as error:
            code = int(error.code or 0)
        captured = capsys.readouterr()
        return code, captured.out, captured.err

    return call


@pytest.fixture
def requests(monkeypatch: pytest.MonkeyPatch) -> list[tuple[EvaluationConfig, dict]]:
    """Collect what `evaluate` asks for, instead of doing it."""
    calls: list[tuple[EvaluationConfig, dict]] = []
    monkeypatch.setattr(evaluate_module, "evaluate", lambda request, **files: calls.append((request, files)))
    return calls


def test_evaluate_understands_the_documented_line(run: Any, requests: list) -> None:
    code, _, _ = run(
        "evaluate",
        *("--policy", "straight", "--object-set", "unseen", "--assets.object-dir", "meshes", "--camera", "pinhole"),
        *("--physics.engine", "native", "--episodes", "30", "--seed", "4", "--json", "a.json", "--video", "v.gif"),
    )
    assert code == 0
    request, files = requests[0]
    assert request == EvaluationConfig(
        policy="straight",
        assets=AssetsConfig(object_dir="meshes", object_set="unseen"),
        task=TaskOverrides(camera="pinhole"),
        physics=PhysicsConfig(engine="native"),
        episodes=30,
        seed=4,
    )
    assert files == {"json_file": Path("a.json"), "video": Path("v.gif"), "video_episodes": None}


def test_evaluate_has_a_short_spelling_and_defaults(run: Any, requests: list) -> None:
    run("evaluate", "--policy", "runs/a", "--object-dir", "meshes", "--scene.test-scenes", "7")
    request, files = requests[0]
    assert request.assets == AssetsConfig(object_dir="meshes") and request.scene.test_scenes == 7
    assert (request.episodes, request.task.camera, request.task.r_out) == (100, None, None)
    assert files["json_file"] is None


@pytest.fixture
def fake_world(monkeypatch: pytest.MonkeyPatch) -> list[Config]:
    """Let players play in the world without physics, and collect the configurations it is made from."""
    configs: list[Config] = []

    def make(config: Config, **_: Any) -> Any:
        configs.append(config)
        return fake_env(task=config.task)

    monkeypatch.setattr(player, "make_env", make)
    monkeypatch.setattr(player, "with_task", lambda env, **_: env)
    return configs


@pytest.mark.parametrize("name", ["straight", "random", "lookahead"])
def test_a_script_is_evaluated_by_name(fake_world: list[Config], name: str) -> None:
    request = EvaluationConfig(policy=name, episodes=6, seed=2)
    said: list[str] = []
    document = run_evaluation(request, make_player(request), say=said.append)
    assert said[0] == "compiling ..." and re.fullmatch(r"compiled in \d+\.\d s", said[1]) and len(said) == 2
    assert document["policy"] == name and len(document["rows"]) == 6
    assert document["hull_bank_hash"] == "hulls" and document["scene_bank_hash"] == "scenes"
    assert json.loads(json.dumps(document, allow_nan=False)) == document


def test_evaluate_says_that_it_compiles_before_the_first_episode(fake_world: list[Config], capsys: Any) -> None:
    evaluate(EvaluationConfig(policy="straight", episodes=2))
    out, err = capsys.readouterr()
    assert out.startswith("straight on 2 seen scenes")
    assert [line.split()[0] for line in err.splitlines()] == ["compiling", "compiled", "episode"]


def test_a_trained_policy_keeps_its_task_and_meets_everybodys_scenes(fake_world: list[Config], tmp_path: Path) -> None:
    trained = Config(
        scene=SceneConfig(test_scenes=2, bank_seed=9),
        task=TaskConfig(r_out=0.12, full_ring=True, camera="pinhole"),
        network=PRESETS["ci"].network,
    )
    network = QNetwork(width=trained.network.width)
    params = drawn_params(network.init, np.zeros((1, 100, 100, 2), np.float32))["params"]
    save_policy(tmp_path, params, trained, {})
    request = EvaluationConfig(policy=str(tmp_path), episodes=3)
    made = make_player(request)
    document = run_evaluation(request, made)
    assert fake_world[0].task == trained.task and fake_world[0].scene == SceneConfig()
    assert document["camera"] == "pinhole" and document["episodes"] == 3
    state = jax.jit(made.env.reset_to)(np.int32(0))
    assert made.q_values is not None
    q = np.where(jax.jit(made.env.action_mask)(state.hand), jax.jit(made.q_values)(state), -np.inf)
    assert callable(made.policy) and int(jax.jit(made.policy)(state, jax.random.key(0))) == q.argmax()


def test_requests_override_the_camera_and_more_episodes_need_more_scenes(fake_world: list[Config]) -> None:
    make_player(EvaluationConfig(policy="clear", task=TaskOverrides(camera="pinhole", r_out=0.2), episodes=300))
    assert fake_world[0].task == TaskConfig(camera="pinhole", r_out=0.2)
    assert fake_world[0].scene.test_scenes == 300


def test_a_smaller_ring_changes_where_the_shipped_policy_may_push_not_what_it_sees(fake_world: list[Config]) -> None:
    tasks = (TaskOverrides(r_out=r_out) for r_out in (None, 0.12))
    usual, narrow = (make_player(EvaluationConfig(policy="pretrained", task=task)) for task in tasks)
    state = jax.jit(usual.env.reset_to)(np.int32(0))
    assert usual.q_values is not None and narrow.q_values is not None
    np.testing.assert_array_equal(*(jax.jit(q_values)(state) for q_values in (usual.q_values, narrow.q_values)))
    assert narrow.env.action_mask(state.hand).sum() < usual.env.action_mask(state.hand).sum()
    with pytest.raises(ValueError, match=r"r_out = 0.25 is out of range; allowed for this policy, .* is 0.04 to 0.2"):
        make_player(EvaluationConfig(policy="pretrained", task=TaskOverrides(r_out=0.25)))


def test_the_shipped_policy_has_a_name(fake_world: list[Config]) -> None:
    assert make_player(EvaluationConfig(policy="pretrained")).q_values is not None
    assert fake_world[0].network.architecture == "compact"


@pytest.mark.parametrize(
    ("policy", "ends"), [("random", {"truncated"}), ("straight", {"grasp_failed", "target_in_region"})]
)
def test_a_film_shows_the_episodes_that_are_counted(fake_world: list[Config], policy: str, ends: set[str]) -> None:
    request = EvaluationConfig(policy=policy, episodes=6, seed=5)
    made = make_player(request)
    rows = run_evaluation(request, made)["rows"]
    assert ends <= {row["reason"] for row in rows}, "or nothing would be said about how these look"
    play = report_play.make_play(made, seed=5)
    for row in rows:
        *pushes, last = play(row["scene"])
        assert all(decision.ending == "" for decision in pushes) and last.action is None
        assert int(last.state.num_pushes) == row["motions"]
        assert last.ending == row["reason"] + (", grasped" if row["success"] else "")


def test_progress_line() -> None:
    assert progress.describe(25, 100, 20, 180.0) == "episode 25 of 100 | success 80 % | left 0:03:00"
    # 20 episodes in 60 s since the first report; the 40 s of compilation before it do not count.
    assert progress.time_left(100.0, 25, 100, (40.0, 5)) == 60.0 * 75 / 20
    assert progress.time_left(40.0, 5, 100, (40.0, 5)) is None


def test_plain_progress_ends_with_a_line(capsys: pytest.CaptureFixture[str]) -> None:
    with progress.EpisodeProgress() as report:
        for done in range(1, 5):
            report(done, 4, done)
    captured = capsys.readouterr()
    assert captured.out == ""
    assert captured.err == "episode 4 of 4 | success 100 % | left 0:00:00\n"


def test_compare_prints_and_writes(run: Any, tmp_path: Path) -> None:
    a = write_evaluation(tmp_path / "a.json", "mine", [1, 1, 1, 1, 1, 1, 0])
    b = write_evaluation(tmp_path / "b.json", "clear", [0, 0, 0, 0, 0, 0, 1])
    code, out, _ = run("compare", str(a), str(b), "--json", str(tmp_path / "c.json"))
    assert code == 0
    assert "mine" in out and "only A 6, only B 1" in out and "p = 0.125" in out
    written = json.loads((tmp_path / "c.json").read_text())
    assert written["p_value"] == 0.125 and written["policies"] == ["mine", "clear"]
    there = write_evaluation(tmp_path / "d.json", "clear", [0, 0, 0, 0, 0, 0, 1], workspace="shelf")
    code, _, err = run("compare", str(a), str(there))
    assert code == 2 and "workspace is table in the first file and shelf in the second" in err
    code, out, _ = run("compare", str(a), str(there), "--across-workspaces", "True")
    assert code == 0 and "differs in workspace: table | shelf" in out and "only A 6, only B 1" in out


def test_doctor_names_what_a_bug_report_needs(run: Any) -> None:
    code, out, _ = run("doctor")
    assert code == 0
    lines = dict(line.split(maxsplit=1) for line in out.splitlines())
    assert {"python", "mujoco", "jax", "cores", "NPROC", "cache", "free"} <= set(lines)
    found = dict(doctor.describe())
    assert found["engine native"] == "works"
    assert found["engine mjx"] == f"mujoco-mjx {mjx_version.SUPPORTED[0]}, supported"
    assert re.fullmatch(r".* \(\d+\.\d\d GB, \d+\.\d\d GB free\)", found["cache"])


def test_the_compilation_cache_has_an_off_switch(monkeypatch: pytest.MonkeyPatch) -> None:
    changed: list[tuple[str, Any]] = []
    monkeypatch.setattr(startup.jax.config, "update", lambda *change: changed.append(change))
    startup.enable_compilation_cache()
    assert not changed, "these tests have chosen a folder, which stays"
    assert dict(doctor.describe())["compiled programs"] == jax.config.values["jax_compilation_cache_dir"]
    monkeypatch.setenv(startup.CACHE_SWITCH, "0")
    startup.enable_compilation_cache()
    assert changed == [("jax_enable_compilation_cache", False)], "whatever folder is set"
    assert dict(doctor.describe())["compiled programs"] == "not kept (PREGRASP_JAX_COMPILATION_CACHE=0)"


def test_doctor_outlives_what_it_diagnoses(run: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: Any) -> Any:
        raise RuntimeError("no backend:\n  none at all")

    broken = {"jax devices": (jax, "devices"), "free memory": (resources, "available_memory")}
    broken |= {"free disk here": (Path, "cwd"), "cache": (io, "cache_dir"), "machine": (platform, "release")}
    for owner, name in broken.values():
        monkeypatch.setattr(owner, name, fail)
    monkeypatch.setattr(mjx_version, "installed", lambda: "3.16.0")
    code, _, _ = run("doctor")
    found = dict(doctor.describe())
    assert code == 0 and found["engine native"] == "works"
    assert {found[name] for name in broken} == {"failed (RuntimeError: no backend: none at all)"}
    assert "3.16.0 is installed; allowed: 3.17.0 (pip install mujoco-mjx==3.17.0)" in found["engine mjx"]


def test_doctor_says_where_an_error_without_words_comes_from(monkeypatch: pytest.MonkeyPatch) -> None:
    """So jax answers JAX_PLATFORMS=cuda where it was installed for the CPU."""

    def fail() -> Any:
        raise AssertionError

    monkeypatch.setattr(jax, "devices", fail)
    monkeypatch.setenv("JAX_PLATFORMS", "cuda")
    found = dict(doctor.describe())
    assert found["JAX_PLATFORMS"] == "cuda"
    assert re.fullmatch(r"failed \(AssertionError: in test_cli\.py, line \d+\)", found["jax devices"])


def test_doctor_measures_a_cache_that_is_being_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PREGRASP_JAX_CACHE", str(tmp_path))
    (tmp_path / "whole.npz").write_bytes(bytes(20_000_000))
    (tmp_path / ".gone.partial").symlink_to("nothing")
    monkeypatch.setattr(Path, "is_file", lambda _: True)  # as it was when the folder was listed
    assert dict(doctor.describe())["cache"].startswith(f"{tmp_path} (0.02 GB, ")


@pytest.mark.parametrize(
    ("cores", "nproc", "by_guard", "finding"),
    [
        (2, "4", True, "4, set by pregrasp_jax: enough threads for XLA"),
        (2, "4", False, "4, set by the environment: enough threads for XLA"),
        (8, None, False, "unset: enough threads for XLA"),
        (8, "2", False, "2, set by the environment: MJX may deadlock; set NPROC=4 before Python starts"),
        (2, None, False, "unset: MJX may deadlock; set NPROC=4 before Python starts"),
        (2, "abc", False, "abc, set by the environment: MJX may deadlock; set NPROC=4 before Python starts"),
    ],
)
def test_doctor_says_who_set_nproc(
    monkeypatch: pytest.MonkeyPatch, cores: int, nproc: str | None, by_guard: bool, finding: str
) -> None:
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: set(range(cores)))
    monkeypatch.setattr(pregrasp_jax, "NPROC_BY_GUARD", by_guard, raising=False)
    monkeypatch.delenv("NPROC")
    if nproc:
        monkeypatch.setenv("NPROC", nproc)
    assert dict(doctor.describe())["NPROC"] == finding


@pytest.mark.parametrize(("cores", "nproc"), [(2, "abc"), (2, ""), (2, "2"), (2, None), (64, "2")])
def test_too_few_threads_are_guarded_against(monkeypatch: pytest.MonkeyPatch, cores: int, nproc: str | None) -> None:
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: set(range(cores)))
    monkeypatch.setenv("NPROC", nproc or "")
    if nproc is None:
        monkeypatch.delenv("NPROC")
    with pytest.warns(RuntimeWarning, match="jax was imported before pregrasp_jax"):
        assert not pregrasp_jax.guard_small_machine()
    monkeypatch.delitem(sys.modules, "jax")
    assert pregrasp_jax.guard_small_machine() and os.environ["NPROC"] == "4"
    assert not pregrasp_jax.guard_small_machine(), "it is enough already"


def test_assets_lists_and_draws_a_folder(run: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PREGRASP_JAX_CACHE", str(tmp_path / "cache"))
    monkeypatch.setattr(meshes, "WorkerPool", InlineExecutor)
    folder = tmp_path / "meshes"
    folder.mkdir()
    trimesh.creation.box((0.06, 0.06, 0.15)).export(folder / "carton.stl")
    trimesh.creation.box((60.0, 60.0, 150.0)).export(folder / "millimetres.stl")
    png = tmp_path / "sheet.png"
    code, out, err = run("assets", str(folder), "--png", str(png))
    assert code == 0, err
    assert "carton" in out and "refused: millimetres.stl" in out
    image = np.asarray(Image.open(png))
    assert image.ndim == 3 and image.std() > 5
    code, out, err = run("assets", str(folder), "--variants", "2", "--png", str(png))
    assert code == 0, err
    assert "made_0001" in out and "2 objects" in out and "refused: millimetres.stl" in out
    (folder / "carton.stl").unlink()
    code, _, err = run("assets", str(folder), "--variants", "2", "--png", str(png))
    assert code == 2 and "none of the 1 meshes of 'seen' is usable, so none can be made beside them" in err
    code, _, err = run("assets", "--variants", "-1", "--png", str(png))
    assert code == 2 and "assets.variants = -1 is out of range; allowed is 0 to 10000" in err


def test_no_sheet_is_written_before_both_sets_are_read(
    run: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PREGRASP_JAX_CACHE", str(tmp_path / "cache"))
    monkeypatch.setattr(meshes, "WorkerPool", InlineExecutor)
    for name in ("seen", "unseen"):
        (tmp_path / "meshes" / name).mkdir(parents=True)
        trimesh.creation.box((0.06, 0.06, 0.15)).export(tmp_path / "meshes" / name / "carton.stl")
    (tmp_path / "meshes" / "unseen" / "objects.yaml").write_text("carton.stl: {colour: red}")
    code, _, err = run("assets", str(tmp_path / "meshes"), "--png", str(tmp_path / "sheet.png"))
    assert code == 2 and "unknown setting 'colour'" in err
    assert not list(tmp_path.glob("*.png"))


def test_describe_scenes_counts() -> None:
    object_ids = np.full((3, 8), -1)
    object_ids[0, :2], object_ids[1, :2], object_ids[2, :3] = (0, 1), (1, 2), (2, 0, 1)
    scenes = SceneBank(
        object_ids=object_ids,
        poses=np.zeros((3, 8, 7), np.float32),
        yaw=np.zeros(3, np.float32),
        target=np.array([1, 0, 2]),
        seeds=np.arange(3),
        split="test",
        tries=4,
        content_hash="abc",
    )
    text = commands.describe_scenes(scenes, fake_env().bank)
    assert text.splitlines() == [
        "3 test scenes, 75% of 4 tries, hash abc",
        "objects per scene: 2: 2, 3: 1",
        "object  scenes  target",
        "mug          2       0",
        "can          3       3",
        "box          2       0",
    ]
