"""What is refused before a sweep starts, in one line; which settings there are; what becomes of them, as a function."""

import dataclasses
import math
import random
import re
import sys
from pathlib import Path
from typing import Any

import pytest

from pregrasp_jax import yaml_file
from pregrasp_jax.cli import sweep as sweep_command
from pregrasp_jax.cli.main import main
from pregrasp_jax.sweep import checks, launchers, parameters
from pregrasp_jax.sweep.folder import SweepFolder
from pregrasp_jax.sweep.spec import PROGRAM, Resources, Spec, read_spec, spec_from, to_plain
from pregrasp_jax.sweep.trials import flags, make_trial, train_command, trial_config

FULL: dict[str, Any] = {
    "preset": "cpu",
    "set": {"train.env_steps": 8000, "train.minutes": 0, "train.evaluate_every": 2000, "replay.capacity": 10_000},
    "parameters": {"learner.learning_rate": {"log": [1e-4, 1e-2]}, "task.r_out": {"values": [0.15, 0.2]}},
    "seeds": [0, 1],
    "search": {"method": "random", "trials": 6, "seed": 3},
    "stop": {"method": "halving", "rungs": [2000, 4000], "keep": 0.5},
    "resources": {"cores": 1, "memory_gb": 2},
    "final": {"seeds": [10, 11], "episodes": 50},
    "tests": {"unseen": {"assets.object_set": "unseen", "episodes": 20}},
    "slurm": {"partition": "short"},
}


def changed(**keys: Any) -> dict[str, Any]:
    return {key: value for key, value in {**FULL, **keys}.items() if value is not None}


def test_a_spec_is_read_and_written_back(tmp_path):
    (tmp_path / "spec.yaml").write_bytes(yaml_file.dump(FULL))
    spec = read_spec(tmp_path / "spec.yaml")
    checks.check(spec)
    assert spec.stop.rungs == (2000, 4000) and spec.final.seeds == (10, 11) and spec.program == PROGRAM
    assert spec_from(to_plain(spec)) == spec


VARIANTS = {"parameters": None, "search": None, "stop": None, "final": None}


@pytest.mark.parametrize(
    ("keys", "said"),
    [
        ({"preset": "cup"}, "preset = 'cup' does not exist; allowed: ci, cpu, demo, paper"),
        ({"preset": None}, "preset is missing"),
        ({"sed": [1]}, "unknown key sed; allowed here: final, parameters"),
        ({"search": {"methods": "grid"}}, "unknown key search.methods; allowed here: method, seed, trials"),
        ({"search": {"method": "bayes"}}, "search.method = 'bayes' is unknown; allowed: grid, random, tpe"),
        ({"stop": {"rungs": [2000.5]}}, "stop.rungs = [2000.5] is no list of whole numbers"),
        ({"seeds": [1, 1]}, "seeds = [1, 1] has a number twice"),
        ({"seeds": []}, "seeds is empty"),
        ({"seeds": [0, 2**32]}, "seeds has 4294967296, which is out of range; allowed is 0 to 4294967295"),
        ({"set": {"train.envsteps": 3}}, "this version knows no setting train.envsteps; allowed here: "),
        ({"set": {**FULL["set"], "train": 3}}, "this version knows no setting train;"),
        ({"set": {**FULL["set"], "learner.discount": "high"}}, "learner.discount = 'high' has the wrong type"),
        ({"set": {**FULL["set"], "learner.discount": 1.5}}, "learner.discount = 1.5 is out of range"),
        ({"set": {**FULL["set"], "task.workspace": "shelves"}}, "task.workspace = 'shelves' does not exist"),
        ({"set": {**FULL["set"], "assets.object_dir": "nowhere"}}, "assets.object_dir = 'nowhere' is no folder"),
        ({"set": {**FULL["set"], "task.camera": "pinhole", "task.sensor": "d1"}}, "task.sensor = 'd1' does not exist"),
        ({"set": {**FULL["set"], "task.r_out": 0.2}}, "task.r_out stands in set and in parameters"),
        ({"set": {**FULL["set"], "seed": 2}}, "seed is decided by seeds"),
        ({"set": {**FULL["set"], "physics.threads": 2}}, "physics.threads is decided by resources.cores"),
        ({"parameters": {"task.r_out": {"log": [0.3, 0.1]}}}, "parameters.task.r_out.log = [0.3, 0.1] is no range"),
        ({"parameters": {"task.r_out": {"log": [0, 0.1]}}}, "both above 0"),
        ({"parameters": {"task.r_out": [0.1]}}, "is no parameter; allowed: {values: [..]}"),
        ({"parameters": {"task.r_out": {"values": [0.1, 0.1]}}}, "has a value twice"),
        ({"parameters": {"task.r_out": {"uniform": [0.1, 0.9]}}}, "task.r_out = 0."),
        ({"search": {"method": "random", "trials": 60}, "parameters": {"task.r_out": {"values": [0.1, 0.2]}}},
         "there are only 2 settings to draw"),
        ({"search": {"method": "random"}}, "search.method random needs parameters, and search.trials"),
        ({"search": {"method": "grid"}}, "parameters.learner.learning_rate is a range, which a grid cannot try"),
        ({"search": {"method": "grid", "trials": 3}, "parameters": {"task.r_out": {"values": [0.1]}}},
         "search.trials: a grid tries all combinations"),
        ({"search": {"method": "tpe", "trials": 3}}, "allowed with search.method tpe: none"),
        ({"stop": {"method": "halving", "rungs": [2500]}}, "allowed are multiples of train.evaluate_every = 2000"),
        ({"stop": {"method": "halving", "rungs": [4000, 2000]}}, "in ascending order"),
        ({"stop": {"method": "halving", "rungs": [2000, 8000]}}, "halving needs train.env_steps above that"),
        ({"stop": {"method": "halving", "rungs": [2000], "keep": 1.0}}, "stop.keep = 1.0 is out of range"),
        ({"stop": {"rungs": [2000]}}, "stop.rungs belong to stop.method halving"),
        ({"stop": {"keep": 0.25}}, "stop.keep belongs to stop.method halving"),
        ({"stop": {"metric": "train/loss"}}, "stop.metric = 'train/loss' is not of validation scenes"),
        ({"stop": {"metric": "eval/succes_rate"}}, "stop.metric = 'eval/succes_rate' is not known; allowed: eval/succ"),
        ({"set": {"train.evaluate_every": 2000, "train.minutes": 0}, "parameters": {
            "train.env_steps": {"values": [6000, 8000]}, "task.r_out": {"values": [0.1]}},
          "search": {"method": "grid"}}, "train.env_steps may change when a run goes on"),
        ({"resources": {"cores": 0}}, "resources.cores = 0 is out of range"),
        ({"resources": {"gpu": 1.5}}, "resources.gpu = 1.5 is out of range"),
        ({"resources": {"memory_gb": 0}}, "resources.memory_gb = 0.0 is out of range"),
        ({"resources": {"gpu": math.nan}}, "resources.gpu = nan is out of range"),
        ({"resources": {"memory_gb": math.nan}}, "resources.memory_gb = nan is out of range"),
        ({"program": ["nosuchprogram", "x.py"]}, "'nosuchprogram' is not found; allowed is one that can be run"),
        ({"final": {"top": 2}}, "final has no seeds, so nothing is trained again"),
        ({"final": {"seeds": [2**32]}}, "final.seeds has 4294967296, which is out of range"),
        ({**VARIANTS, "variants": {"a": {}, "b": {"policy": "clear"}}, "final": {"seeds": [9], "top": 2}},
         "final.top = 2, but 1 settings are trained; allowed is at most that"),
        ({"final": {"seeds": [1, 12]}}, "final.seeds has 1, with which settings were chosen"),
        ({"final": {"seeds": [10], "top": 0}}, "final.top = 0 is out of range"),
        ({"tests": {"far": {"camera": "pinhole"}}}, "tests.far: this version's evaluate knows no camera"),
        ({"tests": {"far": {"task.camera": "pin"}}}, "tests.far.task.camera = 'pin' is unknown"),
        ({"tests": {"far": {"episodes.foo": 3}}}, "tests.far: this version's evaluate knows no episodes.foo"),
        ({"tests": {"far": {"planning": {"depth": 1}}}}, "tests.far: this version's evaluate knows no planning;"),
        ({"tests": {"far": {"episodes": 0}}}, "tests.far: episodes = 0 is out of range; allowed is 1 and more"),
        ({"tests": {"../far": {"episodes": 3}}}, "tests has '../far', which is to name a file"),
        ({"tests": {"far": {"task.r_out": -2.0}}}, "tests.far: task.r_out = -2.0 is out of range"),
        ({"tests": {"far": {"task.sensor": "d455"}}}, "tests.far: task.sensor = 'd455' is what a pinhole"),
        ({"tests": {"far": {"task.place.half_width": 0.3}}}, "tests.far: task.place.half_width"),
        ({"tests": {"far": {"task.robot": "barrett"}}}, "tests.far: task.robot = 'barrett': the policy was trained"),
        ({"tests": {"far": {"scene.test_scenes": 5, "episodes": 6}}}, "tests.far: scene.test_scenes = 5 are fewer"),
        ({"tests": {"far": {"planning.depth": 1}}}, "tests.far: planning.* is set, but plan = False"),
        ({"tests": {"far": {"assets.object_dir": "nowhere"}}}, "tests.far: assets.object_dir = 'nowhere' is no folder"),
        ({"tests": {"far": {"policy": "pin"}}}, "tests.far.policy is decided by the trial"),
        ({**VARIANTS, "variants": {"shelf": {"task.shelf": 1}}}, "this version knows no setting task.shelf"),
        ({**VARIANTS, "variants": {"a": {"policy": "clear", "task.r_out": 1}}}, "variants.a names a policy"),
        ({**VARIANTS, "variants": {"a": {"init_from": "nowhere"}}}, "variants.a.init_from = 'nowhere' does not exist"),
        ({**VARIANTS, "preset": "paper", "variants": {"a": {"init_from": "cpu-1"}}},
         "variants.a.init_from = 'cpu-1' has network.architecture = compact, but is to go on with paper"),
        ({**VARIANTS, "variants": {"a": {"init_from": "pretrained", "network.members": 2}}},
         "variants.a.init_from = 'pretrained' has network.members = 6, but is to go on with 2"),
        ({**VARIANTS, "variants": {"a": {"init_from": 3}}}, "variants.a.init_from = 3 has the wrong type"),
        ({**VARIANTS, "variants": {"a": {"task.r_out": 0.1}, "b": {"task.r_out": 0.1}}}, "variants.b is the same as "),
        ({**VARIANTS, "variants": {"a": {"policy": "clear"}, "b": {"policy": "straight"}},
          "stop": {"method": "halving", "rungs": [2000]}}, "halving needs two settings that are trained"),
        ({"variants": {"a": {}}}, "variants are not searched"),
    ],
)  # fmt: skip
def test_what_is_wrong_is_one_line(keys, said, tmp_path, capsys):
    (tmp_path / "spec.yaml").write_bytes(yaml_file.dump(changed(**keys)))
    with pytest.raises(SystemExit) as exit_info:
        main(["sweep", "start", str(tmp_path / "spec.yaml"), "--dir", str(tmp_path / "sweep"), "--dry-run", "True"])
    error = capsys.readouterr().err
    assert exit_info.value.code == 2 and said in error and len(error.splitlines()) == 1
    assert not (tmp_path / "sweep").exists()


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--parallel", "0"], "parallel = 0 is out of range; allowed is 1 and more"),
        (["--parallel", "-1"], "parallel = -1 is out of range"),
    ],
)
def test_options_that_cannot_be_are_one_line(options, said, tmp_path, capsys):
    (tmp_path / "spec.yaml").write_text("preset: ci\n")
    for command in (
        ["sweep", "start", str(tmp_path / "spec.yaml"), "--dir", str(tmp_path / "x")],
        ["reproduce", "table2"],
    ):
        with pytest.raises(SystemExit) as exit_info:
            main([*command, "--dry-run", "True", *options])
        assert exit_info.value.code == 2 and said in capsys.readouterr().err


def test_a_folder_that_cannot_be_is_refused_by_a_dry_run(tmp_path, capsys):
    (tmp_path / "spec.yaml").write_text("preset: ci\n")
    with pytest.raises(SystemExit) as exit_info:
        inside = tmp_path / "spec.yaml" / "sweep"
        main(["sweep", "start", str(tmp_path / "spec.yaml"), "--dir", str(inside), "--dry-run", "True"])
    assert exit_info.value.code == 2 and "cannot be written" in capsys.readouterr().err


def test_a_key_that_stands_twice_is_refused_with_its_line(tmp_path, capsys):
    (tmp_path / "spec.yaml").write_text("preset: ci\nset: {train.minutes: 1, train.minutes: 2}\n")
    with pytest.raises(SystemExit):
        main(["sweep", "start", str(tmp_path / "spec.yaml"), "--dir", str(tmp_path / "sweep")])
    assert "line 2: 'train.minutes' stands here and in line 2" in capsys.readouterr().err


def test_what_cannot_work_is_said_with_its_file(tmp_path, capsys):
    file = tmp_path / "spec.yaml"
    file.write_bytes(yaml_file.dump(changed(seeds=[0, 0])))
    with pytest.raises(SystemExit):
        main(["sweep", "start", str(file), "--dir", str(tmp_path / "sweep")])
    assert capsys.readouterr().err.startswith(f"error: {file}: seeds")
    folder = SweepFolder.create(tmp_path / "begun", spec_from(FULL))
    (folder.path / "spec.yaml").write_bytes(yaml_file.dump(changed(resources={"cores": 0})))
    with pytest.raises(SystemExit):
        main(["sweep", "resume", str(folder.path)])
    assert capsys.readouterr().err.startswith(f"error: {folder.path / 'spec.yaml'}: resources")


def test_a_dry_run_says_what_would_be_done_and_does_nothing(tmp_path, capsys):
    (tmp_path / "spec.yaml").write_bytes(yaml_file.dump(changed(resources={"memory_gb": 0.01})))
    main(["sweep", "start", str(tmp_path / "spec.yaml"), "--dir", str(tmp_path / "s"), "--parallel", "1",
          "--dry-run", "True"])  # fmt: skip
    said = capsys.readouterr().out
    assert "6 settings, 12 trials, then 2 with fresh seeds; each takes 1 core" in said and "1 at a time" in said
    # 12 x (2000 + 2000 / 2 + 4000 / 4) / 8000 trainings and 2 whole ones, of 8000 steps at 7.1 a second and a start.
    assert f"about {(12 / 2 + 2) * (8000 / 7.1 + 100) / 3600:.1f} hours" in said
    assert "--learner.learning-rate 0.0" in said and "--train.env-steps 8000" in said
    assert not (tmp_path / "s").exists()


def test_a_dry_run_looks_at_the_folder_too(tmp_path, capsys):
    (tmp_path / "spec.yaml").write_bytes(yaml_file.dump(FULL))
    used = tmp_path / "my sweep"
    SweepFolder.create(used, spec_from(FULL))
    with pytest.raises(SystemExit):
        main(["sweep", "start", str(tmp_path / "spec.yaml"), "--dir", str(used), "--dry-run", "True"])
    assert f"already holds a sweep; go on with `pregrasp-jax sweep resume '{used}'`" in capsys.readouterr().err


def test_relative_paths_are_found_from_where_a_sweep_began(tmp_path, monkeypatch):
    for name in ("begun", "meshes", "elsewhere"):
        (tmp_path / name).mkdir()
    (tmp_path / "cell.yaml").write_text("base: d455\n")
    keys = {"variants": {"a": {"init_from": "begun"}}, "tests": {"far": {"assets.object_dir": "meshes"}}}
    given = {**FULL["set"], "task.camera": "pinhole", "task.sensor": "cell.yaml"}
    monkeypatch.chdir(tmp_path)
    folder = SweepFolder.create(tmp_path / "s", spec_from(changed(**VARIANTS, **keys, set=given)))
    monkeypatch.chdir(tmp_path / "elsewhere")
    monkeypatch.setattr(sweep_command, "drive", lambda *_, **__: 7)
    assert sweep_command.resume(folder.path) == 7
    with pytest.raises(ValueError, match="init_from = 'begun' does not exist"):
        checks.check(folder.spec())


def test_an_event_that_lacks_something_is_one_line(tmp_path):
    folder = SweepFolder.create(tmp_path / "s", spec_from(FULL))
    folder.append({"event": "ended"})
    with pytest.raises(ValueError, match=r"trials\.jsonl: event 2 is damaged: .*'ended'.*allowed is a copy of it"):
        folder.states()


def test_a_grid_is_whole_and_shuffled_and_draws_are_repeatable_typed_and_in_range():
    spec = {"a": {"values": [1, 2, 3]}, "b": {"values": [True, None]}}
    made = {name: parameters.read_parameter(value, name) for name, value in spec.items()}
    grid = parameters.grid(made, 0)
    assert len(grid) == 6 and {(g["a"], g["b"]) for g in grid} == {(a, b) for a in (1, 2, 3) for b in (True, None)}
    assert grid != sorted(grid, key=lambda g: g["a"]) and grid == parameters.grid(made, 0) != parameters.grid(made, 1)
    log = parameters.read_parameter({"log": [1e-4, 1e-2]}, "lr")
    drawn = [log.draw(generator) for generator in [random.Random(7)] for _ in range(400)]
    assert all(1e-4 <= x <= 1e-2 and float(f"{x:.4g}") == x for x in drawn)
    assert 0.42 < sum(x < 1e-3 for x in drawn) / 400 < 0.58, "half of them lie below the middle of the logarithm"
    whole = parameters.read_parameter({"int": [2, 4]}, "n")
    assert {whole.draw(random.Random(i)) for i in range(40)} == {2, 3, 4}


def test_command_lines_are_what_a_person_would_type(tmp_path):
    settings = {"replay.hindsight": False, "physics.engine": "native", "train.fused_iterations": None}
    spec = spec_from(changed(set=settings))
    trial = make_trial(spec, {"learner.learning_rate": 0.00025}, 3, init_from="pretrained")
    words = " ".join(train_command(spec, trial, tmp_path / "run")[3:])
    assert words == (
        f"train cpu --run-dir {tmp_path}/run --films False --init-from pretrained --seed 3 --physics.threads 1 "
        "--replay.hindsight False --physics.engine native --train.fused-iterations None --learner.learning-rate 0.00025"
    )
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "config.yaml").touch()
    wider = dataclasses.replace(spec, resources=Resources(cores=2))
    words = " ".join(train_command(wider, trial, tmp_path / "run")[3:])
    assert words == f"train resume {tmp_path}/run --films False --physics.threads 2"
    assert flags({"a.b_c": 1.5}) == ["--a.b-c", "1.5"]
    config = trial_config(spec, trial.settings)
    assert not config.replay.hindsight and config.learner.learning_rate == 0.00025 and config.network.width == 0.25


def test_an_id_is_of_what_a_trial_is_and_of_nothing_else():
    spec = spec_from(FULL)
    first = make_trial(spec, {"task.r_out": 0.15}, 0)
    assert first.id == make_trial(spec, {"task.r_out": 0.15}, 0, name="x", final=True).id
    others = [
        make_trial(spec, {"task.r_out": 0.2}, 0),
        make_trial(spec, {"task.r_out": 0.15}, 1),
        make_trial(spec, {"task.r_out": 0.15}, 0, init_from="pretrained"),
        make_trial(spec_from(changed(preset="demo")), {"task.r_out": 0.15}, 0),
    ]
    assert len({trial.id for trial in [first, *others]}) == 5
    assert first.group == make_trial(spec, {"task.r_out": 0.15}, 1).group != others[0].group


def test_cores_memory_and_gpus_are_shared_out(monkeypatch):
    monkeypatch.setattr(launchers, "_cores", lambda: [3, 4, 5, 8, 9])
    monkeypatch.setattr(launchers, "_gpus", lambda: ["0", "1"])
    monkeypatch.setattr(launchers, "free_memory", lambda: int(10e9))

    def shared(parallel: Any = None, memory: float = 1e9, **resources: Any) -> list[launchers.Slot]:
        spec = spec_from(changed(resources=resources))
        return launchers.share_out(spec, parallel=parallel, memory=memory)

    assert shared(cores=2) == [((3, 4), ()), ((5, 8), ())]
    assert shared(cores=1, memory=4e9) == [((3,), ()), ((4,), ())]
    assert [gpus for _, gpus in shared(cores=1, gpu=0.5)] == [("0",), ("1",), ("0",), ("1",)]
    assert [gpus for _, gpus in shared(cores=1, gpu=2.0)] == [("0", "1")]
    assert [gpus for _, gpus in shared(cores=1, gpu=0.4)] == [("0",), ("1",), ("0",), ("1",)], "three are too many"
    assert len(shared(parallel=3)) == 3
    for options, said in (
        ({"parallel": 6}, r"6 trials at a time do not fit: there are 5 cores of which a trial takes 1; .* at most 5"),
        ({"memory": 11e9}, r"10.0 GB of free memory of which a trial takes 11.0; .* at most 0"),
        ({"parallel": 3, "gpu": 1.0}, r"2 GPUs of which a trial takes 1; .* at most 2"),
        ({"cores": 6}, r"5 cores of which a trial takes 6"),
    ):
        with pytest.raises(ValueError, match=said):
            shared(**options)


def test_the_sweeps_of_the_docs_can_be_started(tmp_path):
    text = (Path(__file__).parent.parent / "docs" / "sweeps.md").read_text()
    codes = re.findall(r"```yaml\n(.*?)```", text, re.DOTALL)
    assert len(codes) == 2
    for code in codes:
        (tmp_path / "spec.yaml").write_text(code)
        checks.check(read_spec(tmp_path / "spec.yaml"))
    keys = {field.name for field in dataclasses.fields(Spec)}
    assert {key for key in keys if f"`{key}`" in text} == keys


@pytest.mark.parametrize(
    ("module", "keys", "options", "said"),
    [
        ("optuna", {"search": {"method": "tpe", "trials": 3}, "stop": None}, [], "pregrasp_jax[sweep]"),
        ("ray", {}, ["--launcher", "ray"], "pregrasp_jax[ray]"),
        ("ray", {}, ["--launcher", "slurm"], "needs sbatch"),
    ],
)
def test_what_is_not_installed_is_said_before_anything_is_written(
    module, keys, options, said, tmp_path, monkeypatch, capsys
):
    monkeypatch.setitem(sys.modules, module, None)
    monkeypatch.setenv("PATH", str(tmp_path))
    (tmp_path / "spec.yaml").write_bytes(yaml_file.dump(changed(**keys)))
    with pytest.raises(SystemExit) as exit_info:
        main(["sweep", "start", str(tmp_path / "spec.yaml"), "--dir", str(tmp_path / "sweep"), *options])
    error = capsys.readouterr().err
    assert exit_info.value.code == 2 and said in error and len(error.splitlines()) == 1
    assert not (tmp_path / "sweep").exists()
