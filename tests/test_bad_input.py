"""Every way to ask for something impossible: one line that says what, where and what is allowed; exit code 2;
nothing written.
"""

import os
from pathlib import Path
from typing import Any

import fake_training
import numpy as np
import pytest
import trimesh
from bad_files import InlineExecutor, make_bad_files

from pregrasp_jax.assets import decompose, mesh_file, meshes
from pregrasp_jax.assets.settings import ObjectSettings
from pregrasp_jax.cli.main import main
from pregrasp_jax.training import resources, session

PROGRAMS = {"train": ["train"], "evaluate": ["evaluate"], "pregrasp_jax": []}
"""Arguments of the program that the first word of a line stands for."""

COMMAND_LINES = [
    ("train", "Expected one of {ci, demo, cpu, paper, ppg, resume}"),
    ("train foo", "Unrecognized options: foo (Available subcommands: ci, demo, cpu, paper, ppg, resume)"),
    ("train ci", "Missing from", "--run-dir PATH"),
    ("train ci --run-dir {w}/new --physics.enginee mjx", "--physics.enginee, mjx (--physics.engine {native,mjx})"),
    ("train ci --run-dir {w}/new --physics.engine bullet", "Expected one of ('native', 'mjx')"),
    ("train ci --run-dir {w}/new --seed 1.5", "Error parsing --seed: invalid literal for int"),
    ("train ci --run-dir {w}/new --replay.hindsight maybe", "'maybe'", "Expected one of ('True', 'False')"),
    ("train ci --run-dir {w}/new --no-replay.hindsight", "Unrecognized options: --no-replay.hindsight (--replay.hind"),
    ("train ci --run-dir {w}/new --task.r-in 3", "task.r_in = 3.0 is out of range; allowed is 0.005 to 0.5"),
    ("train ci --run-dir {w}/new --learner.learning-rate nan", "learner.learning_rate = nan is out of range; allowed"),
    ("train ci --run-dir {w}/new --scene.min-objects 7 --scene.max-objects 6", "scene.min_objects = 7 must not exceed"),
    (
        "train ci --run-dir {w}/new --network.width 1 --replay.capacity 64 --train.num-envs 3",
        "replay capacity = 64 is too small for 3 scenes and episodes of 10 pushes; allowed is 66 or more",
    ),
    ("train ci --run-dir {w}/new --seed 1 --seed=2", "--seed is given 2 times; allowed is once"),
    ("train ci --run-dir {w}/new --task.r-in 0.1 --task.r_in 0.1", "--task.r-in is given 2 times; allowed is once"),
    ("evaluate --policy clear --camera pinhole --task.camera pinhole", "--task.camera is given 2 times; allowed is"),
    ("evaluate", "Missing from", "--policy STR"),
    ("evaluate --policy clear --object-set old", "Expected one of ('seen', 'unseen')"),
    ("evaluate --policy clear --episode x", "Unrecognized options: --episode, x (--episodes INT)"),
    ("evaluate --policy clear --episodes 0", "episodes = 0 is out of range; allowed is 1 and more"),
    ("evaluate --policy clear --num-envs -1", "num_envs = -1 is out of range; allowed is 1 and more, or 0"),
    ("evaluate --policy clear --r-out 0.01", "task.r_in = 0.04 must be below task.r_out = 0.01"),
    ("evaluate --policy clear --physics.threads -3", "physics.threads = -3 is out of range; allowed is 0 to 1024"),
    (
        "evaluate --policy clear --video {w}/v.gif --video-episodes 0",
        "video_episodes = 0 is out of range; allowed is 1",
    ),
    (
        "evaluate --policy clear --video-episodes 2",
        "video_episodes = 2 needs a film; allowed with it is --video FILE",
    ),
    (
        "train ppg --run-dir {w}/new --train.try-grasps True",
        "train.try_grasps = True is not known to train.method = imitation; allowed is False",
    ),
    (
        "train ppg --run-dir {w}/new --train.tight-targets 3",
        "train.tight_targets = 3.0 is not known to train.method = imitation; allowed is 1.0",
    ),
    (
        "train ppg --run-dir {w}/new --learner.optimizer muon",
        "learner.optimizer = muon is not known to train.method = imitation; allowed is adam",
    ),
    (
        "train ppg --run-dir {w}/new --train.minutes 3",
        "train.minutes = 3.0 is not known to train.method = imitation; allowed is 0.0",
    ),
    (
        "train ci --run-dir {w}/new --strokes.epochs 3",
        "strokes.epochs = 3 is not known to train.method = q_learning; allowed is",
    ),
    (
        "pregrasp_jax dokter",
        "Unrecognized options: dokter (Available subcommands: assets, calibrate-check, combine, compare, contract, ",
        "scenes, show, sweep, train, verify)",
    ),
    ("pregrasp_jax demo --episodes 0 --run-dir {w}/new", "episodes = 0 is out of range; allowed is 1 and more"),
    ("pregrasp_jax show --pushes -1", "pushes = -1 is out of range; allowed is 0 and more"),
    ("pregrasp_jax scenes --scene.max-objects 9", "scene.max_objects = 9 is out of range; allowed is 2 to 8"),
    ("pregrasp_jax report {w}/run --films -1", "films = -1 is out of range; allowed is 0 and more"),
]

PLACES = [
    ("train ci --run-dir {w}/full", "run folder {w}/full is not empty and holds no run; allowed is a new or empty"),
    ("train ci --run-dir {w}/file", "run folder {w}/file is a file; allowed is a new or empty folder"),
    (
        "train ci --run-dir {w}/file/run",
        "{w}/file/run/config.yaml cannot be written: {w}/file is not a writable folder",
    ),
    ("train ci --run-dir {w}/run", "{w}/run already holds a run; continue it with `pregrasp-jax train resume {w}/run`"),
    ("pregrasp_jax demo --run-dir {w}/full", "run folder {w}/full is not empty and holds no run; allowed is a new"),
    ("train resume {w}/nothing", "{w}/nothing is not a run folder (it has no config.yaml); allowed is the --run-dir"),
    (
        "pregrasp_jax report {w}/nothing",
        "{w}/nothing is not a run folder (it has no config.yaml); wanted the --run-dir",
    ),
    ("evaluate --policy clear --json {w}", "{w} is a folder; allowed is the name of a file"),
    ("evaluate --policy clear --json {w}/file/a.json", "{w}/file/a.json cannot be written: {w}/file is not a writable"),
    ("pregrasp_jax compare {w}/a.json {w}/a.json --json {w}", "{w} is a folder; allowed is the name of a file"),
    ("pregrasp_jax show --png {w}", "{w} is a folder; allowed is the name of a file"),
]

RUNS = [
    ("train resume {w}/typo", "{w}/typo/config.yaml: unknown config key sead; allowed here: assets, exploration"),
    ("train resume {w}/range", "{w}/range/config.yaml: task.r_in = 3.0 is out of range; allowed is 0.005 to 0.5"),
    ("train resume {w}/run --seed 4", "a changed configuration (seed: 0 -> 4); allowed to change: train.minutes"),
    (
        "train resume {w}/other",
        "run {w}/other began with another hull bank (of yesterday, now hulls); resume it with the",
    ),
    ("train resume {w}/cut", "{w}/cut/manifest.json is damaged", "Put a copy back, or delete it"),
    ("train resume {w}/list", "{w}/list/manifest.json is damaged", "Put a copy back, or delete it"),
    ("train resume {w}/foreign", "{w}/foreign/checkpoints/000000007/state.safetensors: ", "allowed is a checkpoint of"),
    (
        "train resume {w}/damaged",
        "{w}/damaged/checkpoints: none of 1 checkpoints is intact",
        "--init-from starts a new",
    ),
]

POLICIES = [
    ("evaluate --policy strait", "policy strait does not exist; allowed: random, guided, straight, clear, lookahead"),
    (
        "evaluate --policy {w}/full",
        "policy {w}/full is neither a run folder nor a policy folder; allowed: pretrained, a run folder",
    ),
    (
        "evaluate --policy {w}/noise",
        "{w}/noise is damaged or not safetensors",
        "; allowed: pretrained, a run folder",
    ),
    (
        "evaluate --policy {w}/foreign.safetensors",
        "foreign.safetensors was not written by this package",
        "allowed: pretrained, a run",
    ),
    ("evaluate --policy {w}/no_metadata.safetensors", "no_metadata.safetensors was not written by this package"),
    (
        "evaluate --policy {w}/newer.safetensors",
        "newer.safetensors was written by another version",
        "colour",
        "allowed",
    ),
    (
        "evaluate --policy {w}/newest.safetensors",
        "newest.safetensors was written by another version of this package: pregrasp_jax policy 3",
    ),
    (
        "evaluate --policy {w}/bf16.safetensors",
        "bf16.safetensors is damaged or not of this package (its arrays are BF16); allowed: pretrained, a run folder",
    ),
    (
        "evaluate --policy {w}/header",
        "{w}/header/params.safetensors is altered (checksum differs); allowed: pretrained, a run",
    ),
    (
        "evaluate --policy {w}/wide",
        "{w}/wide/params.safetensors was written by another version of this package: task.r_out = 30.0 is out of range",
    ),
    (
        "evaluate --policy {w}/altered",
        "{w}/altered/params.safetensors is altered (checksum differs); allowed: pretrained, a run",
    ),
    (
        "train ci --run-dir {w}/new --init-from {w}/nothing",
        "policy {w}/nothing does not exist; allowed: pretrained, a run folder",
    ),
    (
        "train ci --run-dir {w}/new --network.width 1 --init-from {w}/small",
        "(--init-from) are of another network; allowed is network.arch",
    ),
    (
        "train ci --run-dir {w}/new --network.width 1 --init-from pretrained",
        "(--init-from) are of another network; allowed is network.architecture = paper and network.width = 1",
    ),
    ("pregrasp_jax show --policy strait", "policy strait does not exist; allowed: random, guided, straight"),
    ("pregrasp_jax compare {w}/a.json {w}/c.json", "{w}/c.json: No such file or directory; wanted a file written by"),
    (
        "pregrasp_jax compare {w}/a.json {w}/noise",
        "{w}/noise: not JSON; wanted a file written by pregrasp-jax evaluate --json",
    ),
    (
        "pregrasp_jax compare {w}/a.json {w}/list.json",
        "list.json: not an evaluation; wanted a file written by pregrasp-jax evaluate",
    ),
    (
        "pregrasp_jax compare {w}/header.json {w}/a.json",
        "header.json: damaged evaluation (policy, object_set, camera, physics,",
        "seed, episodes, success_rate, success_ci95, failures, rows); wanted a file written by",
    ),
    ("pregrasp_jax compare {w}/no_rows.json {w}/no_rows.json", "no_rows.json: damaged evaluation (rows); wanted a"),
    ("pregrasp_jax compare {w}/a.json {w}/odd_rows.json", "odd_rows.json: damaged evaluation (rows); wanted a file"),
    ("pregrasp_jax compare {w}/a.json {w}/no_config.json", "no_config.json: damaged evaluation (config); wanted a"),
    ("pregrasp_jax compare {w}/a.json {w}/b.json", "cannot pair: scene_bank_hash is s in the first file and t in the"),
]

DUMPS = [
    ("pregrasp_jax replay-dump", "Missing from", "PATH file that a training wrote to RUN_DIR/dumps"),
    ("pregrasp_jax replay-dump {w}/others.npz --engine bullet", "invalid choice 'bullet'", "'native'"),
    ("pregrasp_jax replay-dump {w}/others.npz --png {w}", "{w} is a folder; allowed is the name of a file"),
    (
        "pregrasp_jax replay-dump {w}/nothing",
        "{w}/nothing does not exist or is no file; wanted is a file of RUN_DIR/du",
    ),
    ("pregrasp_jax replay-dump {w}/full", "{w}/full does not exist or is no file; wanted is a file of RUN_DIR/dumps"),
    ("pregrasp_jax replay-dump {w}/noise", "{w}/noise is damaged or no npz; wanted is a file of RUN_DIR/dumps that"),
    (
        "pregrasp_jax replay-dump {w}/cut.npz",
        "{w}/cut.npz is damaged or no npz; wanted is a file of RUN_DIR/dumps that",
    ),
    ("pregrasp_jax replay-dump {w}/numbers.npz", "{w}/numbers.npz is no dump of this version; wanted is a file of RUN"),
    ("pregrasp_jax replay-dump {w}/newer.npz", "{w}/newer.npz is no dump of this version; wanted is a file of RUN_DIR"),
    ("pregrasp_jax replay-dump {w}/typo.npz", "{w}/typo.npz: unknown config key sead; allowed here: assets"),
    (
        "pregrasp_jax replay-dump {w}/others.npz",
        "{w}/others.npz is of other objects (hull bank hulls, the built-in seen objects have ",
        "); wanted are those of the training: --object-dir",
    ),
    ("pregrasp_jax replay-dump {w}/others.npz --object-dir {w}/nothing", "{w}/nothing: no such folder; allowed is a"),
    ("pregrasp_jax replay-dump {w}/bullet.npz", "physics.engine = 'bullet' does not exist; allowed: native, mjx"),
    ("pregrasp_jax replay-dump {w}/builtin.npz", "{w}/builtin.npz: state/physics/", "wanted is a file of RUN_DIR"),
]

MESHES = {
    "nothing": "{f}: holds no mesh; allowed are .obj, .stl, .ply, .glb, .gltf, .off, .dae files",
    "flat": "m.stl: flat: 50 x 4 x 150 mm; allowed is at least 10 mm",
    "millimetres": "m.stl: wrong unit: 6e+04 x 7e+04 x 1.5e+05 mm, allowed are 0.01 to 1 m; set scale: 0.001",
    "kilometres": "set scale: 1000 if the file is in kilometres",
    "low": "m.stl: too low: 60 x 60 x 90 mm, up is z; allowed heights are 0.11 to 0.3 m",
    "tall": "m.stl: too tall: 80 x 80 x 310 mm",
    "wide": "m.stl: too wide: 210 x 50 x 150 mm, up is z; allowed is a width up to 0.2 m",
    "slanted": "m.stl: does not stand: tips over at",
    "nan": "vertices are NaN or infinite; allowed are finite",
    "empty": "m.ply: empty file; allowed is a triangle mesh",
    "points": "m.obj: a point cloud of 3 points without faces; allowed is a triangle mesh",
    "sheet": "m.obj: encloses no volume; allowed is the surface of a solid",
    "noise": "m.stl: not a readable .stl file",
    "folder": "m.obj: missing or not a file; allowed are files inside the folder",
    "link": "link.stl: link that leads out of the folder; allowed are files inside of it",
    "dangling": "m.stl: missing or not a file; allowed are files inside the folder",
    "loop": "m.stl: missing or not a file; allowed are files inside the folder",
    "outside": "../outside.stl: listed in objects.yaml but leads out of the folder",
    "missing": "gone.stl: listed in objects.yaml but missing; allowed are names of files",
    "many_bytes": "m.stl: file of 257 MB; allowed are 256 MB, decimate it first",
    "no_target": "{f}: none of 5 objects can be a target for robot ur5e_rg2; allowed is at least 1",
    "few": "{f}: 2 usable 'seen' objects; allowed are at least 5",
    "setting": "{f}/objects.yaml: m.stl: unknown setting 'colour'; allowed are scale, up, mass, density, friction",
}
TRAIN_ON = "train ci --run-dir {w}/new --assets.object-dir "
OBJECTS = [
    (TRAIN_ON + "{w}/nothing", "{w}/nothing: no such folder; allowed is a folder of .obj, .stl"),
    (
        "evaluate --policy clear --object-set unseen --object-dir {w}/meshes/flat",
        "has no 'unseen' set; allowed here are",
    ),
    ("pregrasp_jax assets {w}/nothing --png {w}/new.png", "{w}/nothing: no such folder; allowed is a folder of"),
    *((TRAIN_ON + f"{{w}}/meshes/{name}", said.format(f=f"{{w}}/meshes/{name}")) for name, said in MESHES.items()),
]

HINTS = (
    "allowed",
    "wanted",
    "must",
    "Expected",
    "Missing",
    "invalid literal",
    "(--",
    "(Available",
    " it with ",
    "or delete",
    "helps",
)
"""How a line goes on that says what would do."""


@pytest.fixture(scope="module")
def world(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("world")
    make_bad_files(folder)
    return folder


@pytest.fixture
def refusal(world, tmp_path, monkeypatch, capsys) -> Any:
    """Return a function that runs a command line and returns its one line of complaint."""
    make_env = session.make_env
    fakes: dict[str, Any] = {
        "make_env": lambda config, **options: (
            make_env(config, **options) if config.assets.object_dir else fake_training.PictureEnv()
        ),
        "make_program": lambda env, config, **options: fake_training.make_program(config, env, **options),
    }
    for name, fake in fakes.items():
        monkeypatch.setattr(session, name, fake)
    monkeypatch.setattr(meshes, "WorkerPool", InlineExecutor)
    monkeypatch.setenv("PREGRASP_JAX_CACHE", str(tmp_path / "cache"))
    monkeypatch.chdir(tmp_path)

    def call(command_line: str) -> str:
        program, *arguments = command_line.format(w=world).split()
        before = sorted(world.rglob("*"))
        with pytest.raises(SystemExit) as exit_info:
            main([*PROGRAMS[program], *arguments])
        error = capsys.readouterr().err
        assert exit_info.value.code == 2, error
        assert error.startswith("error: ") and error.count("\n") == 1
        assert any(hint in error for hint in HINTS), error
        written = {path.name for path in world.rglob("*")} - {path.name for path in before}
        assert written <= {"run.lock"}
        assert not [path for path in tmp_path.iterdir() if path.name != "cache"]
        return error

    return call


@pytest.mark.parametrize("row", [*COMMAND_LINES, *PLACES, *RUNS, *POLICIES, *DUMPS, *OBJECTS], ids=lambda row: row[0])
def test_what_is_wrong_is_one_line_and_nothing_is_written(world, refusal, row):
    command_line, *said = row
    error = refusal(command_line)
    for part in said:
        assert part.replace("{w}", str(world)) in error


NEW_RUN = "train ci --run-dir {w}/new --network.width 1"


@pytest.mark.parametrize(
    ("command_line", "what", "free", "advice"),
    [
        (
            NEW_RUN,
            "memory",
            0,
            "0.00 GB are free; allowed is more room: 1.00 GB are needed even without the replay's obs",
        ),
        (
            NEW_RUN,
            "disk",
            0,
            "0.00 GB are free; allowed is more room: 0.00 GB are needed even without the replay's obs",
        ),
        (NEW_RUN + " --replay.capacity 1000000", "memory", 3e9, "3.00 GB are free; a smaller replay.capacity helps"),
        (NEW_RUN + " --replay.capacity 1000000", "disk", 2e9, "2.00 GB are free; a smaller replay.capacity helps"),
        ("train resume {w}/large", "memory", 3e9, "3.00 GB are free; allowed is more room, or a new run (--init-from"),
        ("train resume {w}/large", "disk", 2e9, "2.00 GB are free; allowed is more room, or a new run (--init-from"),
    ],
)
def test_a_replay_that_does_not_fit_is_refused_before_the_start(refusal, monkeypatch, command_line, what, free, advice):
    monkeypatch.setattr(resources, f"available_{what}", lambda *_: int(free))
    other = {"memory": "disk", "disk": "memory"}[what]
    monkeypatch.setattr(resources, f"available_{other}", lambda *_: 10**15)
    said = refusal(command_line)
    assert f"GB of {what}" in said and advice in said


@pytest.mark.parametrize(
    ("command_line", "file"),
    [("pregrasp_jax scenes", "scenes/test-"), ("pregrasp_jax assets {w}/meshes/no_target", "hulls/")],
)
def test_a_cache_that_cannot_be_written_is_refused_before_the_work(world, refusal, monkeypatch, command_line, file):
    monkeypatch.setenv("PREGRASP_JAX_CACHE", str(world / "file" / "cache"))
    monkeypatch.setattr(meshes, "WorkerPool", None)
    said = refusal(command_line)
    assert f"error: {world}/file/cache/{file}" in said and f"{world}/file is not a writable folder" in said
    assert "PREGRASP_JAX_CACHE names another folder for the cache" in said


@pytest.mark.parametrize(
    ("command_line", "file"),
    [
        ("train ci --run-dir {w}/new", "{w}/new/config.yaml"),
        ("evaluate --policy clear --json {w}/new.json", "{w}/new.json"),
        ("pregrasp_jax show --png {w}/new.png", "{w}/new.png"),
        ("pregrasp_jax scenes", "/cache/scenes/test-"),
        ("pregrasp_jax assets {w}/meshes/no_target --png {w}/new.png", "{w}/new.png"),
    ],
)
def test_a_folder_without_the_right_to_write_is_refused(world, refusal, monkeypatch, command_line, file):
    """As root, who runs these tests in a container, there is none: the system's answer is a fake."""
    monkeypatch.setattr(os, "access", lambda _, mode: mode != os.W_OK)
    said = refusal(command_line)
    assert f"{file.format(w=world)}" in said and "is not a writable folder; allowed is one that is" in said


@pytest.mark.slow
def test_two_million_faces_are_not_bad(tmp_path):
    trimesh.creation.uv_sphere(radius=0.08, count=[1000, 1000]).export(tmp_path / "ball.stl")
    assert (tmp_path / "ball.stl").stat().st_size > 84 + 50 * 1_990_000
    ball = mesh_file.load_mesh(tmp_path / "ball.stl", ObjectSettings())
    assert len(ball.faces) <= decompose.MAX_FACES and ball.volume == pytest.approx(4 / 3 * np.pi * 0.08**3, rel=1e-2)
