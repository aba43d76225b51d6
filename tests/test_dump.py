"""Pushes that the physics does not survive: what training keeps of them, and that they can be repeated from a file."""

import dataclasses
import json
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from fake_training import PictureEnv, make_config, make_trainer
from PIL import Image

from pregrasp_jax import io
from pregrasp_jax.assets.catalogue import builtin_bank
from pregrasp_jax.cli.main import main
from pregrasp_jax.cli.replay import RepeatedPush, make_replay, make_replay_env
from pregrasp_jax.config import Config, ExplorationConfig
from pregrasp_jax.robot.ur5e_rg2 import FINGER_OPEN
from pregrasp_jax.scene.bank import SceneBank
from pregrasp_jax.scene.model import parking_poses
from pregrasp_jax.task.assembly import assemble
from pregrasp_jax.task.env import Env
from pregrasp_jax.training.dump import load_dump
from pregrasp_jax.training.mishap import NONE, no_mishap
from pregrasp_jax.types import MAX_OBJECTS, REASONS

SICK, SLOT, ROBOT_DOFS = 1, 0, 10
"""The scene that something happens to, the object, and how many coordinates come before those of the objects."""

FLUNG = 150.0
"""m/s, upwards: faster than a scene may be, before the push and after it."""


def test_the_first_push_that_diverges_is_kept_until_it_is_forgotten():
    """Three scenes with one branch each; row 4 is the branch of scene 1."""
    states = jax.jit(jax.vmap(PictureEnv().reset_to))(np.arange(3))
    ends = jax.tree.map(lambda leaf: np.concatenate([leaf, leaf]), states)
    poses = np.arange(6.0, dtype=np.float32)[:, None, None] + np.zeros((6, MAX_OBJECTS, 7), np.float32)
    ends = jax.device_put(ends.replace(physics_obs=ends.physics_obs.replace(object_poses=poses)))
    actions, fine = jnp.arange(70, 76), np.zeros(6, bool)
    only = np.eye(6, dtype=bool)

    @jax.jit
    def note(mishap: Any, diverged: jax.Array, env_steps: int) -> Any:
        return mishap.note(states, actions, ends, diverged, env_steps)

    none = note(jax.jit(no_mishap)(states), fine, 3)
    assert none.action == NONE
    for index, (scene, branch) in {4: (1, 1), 2: (2, 0)}.items():
        kept = note(none, only[index] | only[5], 6)
        assert (int(kept.scene), int(kept.branch), int(kept.action), int(kept.env_steps)) == (
            scene,
            branch,
            70 + index,
            6,
        )
        np.testing.assert_array_equal(kept.state.centroids, states.centroids[scene])
        np.testing.assert_array_equal(kept.seen.object_poses, poses[index])
        later = note(note(kept, ~fine, 9), fine, 12)
        jax.tree.map(np.testing.assert_array_equal, kept, later)
        assert note(kept.forget(), fine, 9).action == NONE
        assert note(kept.forget(), only[3], 9).env_steps == 9


@pytest.fixture(scope="module")
def env() -> Env:
    """Two scenes of two objects each, which are out of the way."""
    bank = builtin_bank("seen")
    ids = np.full((2, MAX_OBJECTS), -1, np.int32)
    ids[:, :2] = [bank.names.index(name) for name in ("ycb_mustard_bottle", "ycb_wood_block")]
    poses = np.stack([parking_poses()] * 2).astype(np.float32)
    poses[:, :2, :3] = [[0.1, -0.1, 0.0], [0.1, 0.1, 0.0]]
    zeros = np.zeros(2, np.int32)
    scenes = SceneBank(ids, poses, zeros.astype(np.float32), zeros, zeros, "train", 2, "made by hand")
    return assemble(Config(), bank, scenes, threads=1)


def config() -> Config:
    small = make_config(num_envs=2, log_every=2)
    return dataclasses.replace(
        small,
        exploration=ExplorationConfig(branches=1),
        replay=dataclasses.replace(small.replay, capacity=200),
    )


def broken(env: Env, states: Any, what: str) -> Any:
    """Return the scenes with a fault in one of them: an object flung up, or nowhere."""
    qpos, qvel = (np.array(x) for x in jax.vmap(env.engine.coordinates)(states.physics))
    if what == "flung":
        qvel[SICK, ROBOT_DOFS + 6 * SLOT + 2] = FLUNG
    else:
        qpos[SICK, ROBOT_DOFS + 7 * SLOT] = np.nan
    place = jax.vmap(env.engine.place)
    return states.replace(physics=place(states.scene.object_ids, jnp.asarray(qpos), jnp.asarray(qvel)))


@pytest.fixture(scope="module")
def dumps(env, tmp_path_factory) -> dict[str, Path]:
    """Dumps of a training into which a fault was put before its first push."""
    paths, program = {}, None
    for what in ("flung", "nan"):
        trainer = make_trainer(tmp_path_factory.mktemp("runs") / what, config(), env=env)
        trainer.program = program or trainer.program.compile(trainer.state)
        program = trainer.program
        actors = trainer.state.actors
        states = broken(env, actors.env_states, what)
        trainer.state = trainer.state.replace(actors=actors.replace(env_states=states))
        with trainer.recorder.folder:
            trainer.step(program)
            trainer.state = trainer.recorder.log(trainer.state)
        assert int(trainer.state.actors.mishap.action) == NONE
        (paths[what],) = trainer.recorder.folder.dumps.iterdir()
    return paths


@pytest.fixture(scope="module")
def replay(env) -> Any:
    return make_replay(env)


@pytest.mark.parametrize("what", ["flung", "nan"])
def test_a_dump_repeats_the_push_bit_for_bit(env, dumps, replay, what):
    dump = load_dump(dumps[what])
    assert dump.path.name == "step-000002-scene-1.npz"
    assert dump.engine == "native" and dump.config == config() and dump.hull_bank_hash == env.bank.content_hash
    again: RepeatedPush = replay(dump.mishap(make_replay_env(dump, "native")))
    assert again.identical and again.duration > 0.3
    assert again.result.outcome.diverged and REASONS[int(again.result.reason)] == "nan"
    if what == "flung":
        assert again.speeds.max() == pytest.approx(FLUNG, rel=2e-3) and len(again.speeds) == 1
        rise = (again.after.physics_obs.object_poses - again.before.physics_obs.object_poses)[SLOT, 2]
        assert rise == pytest.approx(FLUNG * again.duration - 9.81 / 2 * again.duration**2, rel=0.01)
        assert again.before.obs.instance_ids.max() > 0, "the camera's view follows from the rest"


ALTERED = {
    "action": lambda action: action + 2 * (3 + 200 * np.sign(10000 - action)),
    "hand/xy": lambda xy: xy + 0.02,
    "hand/aperture": lambda aperture: FINGER_OPEN - aperture,
    "state/physics/bits": lambda bits: (
        np.roll(bits, 0) + (np.arange(len(bits)) == 2 * (1 + ROBOT_DOFS + 7) + 1) * 2**12
    ),
    "seen/object_poses": lambda poses: np.nextafter(poses, np.float32(np.inf)),
}


@pytest.mark.parametrize("name", ALTERED)
def test_what_is_not_the_push_of_the_training_is_noticed(env, dumps, replay, name):
    """Every array of the dump that a push depends on, one altered at a time."""
    dump = load_dump(dumps["flung"])
    array = dump.arrays[name]
    altered = np.asarray(ALTERED[name](array)).astype(array.dtype)
    assert not np.array_equal(altered, array)
    dump = dataclasses.replace(dump, arrays=dump.arrays | {name: altered})
    assert not replay(dump.mishap(env)).identical


@pytest.mark.slow
def test_another_engine_takes_the_scene_up(env, dumps):
    """Without a push, which takes MJX a minute to compile."""
    dump = load_dump(dumps["flung"])
    other = make_replay_env(dump, "mjx")
    scene, same = (dump.mishap(e).state for e in (other, env))
    qpos, qvel = other.engine.coordinates(scene.physics)
    assert qvel.max() == FLUNG and scene.physics.qpos.shape == qpos.shape
    for a, b in zip(
        *map(jax.tree.leaves, (other.engine.observe(scene.physics), env.engine.observe(same.physics))), strict=True
    ):
        np.testing.assert_allclose(np.asarray(a, float), np.asarray(b, float), atol=1e-6)


def run_command(*arguments: str) -> None:
    assert main(["replay-dump", *arguments]) == 0


def test_the_command_says_what_happened_and_draws_it(dumps, tmp_path, capsys):
    run_command(str(dumps["flung"]), "--png", str(tmp_path / "push.png"))
    _, *lines, wrote = capsys.readouterr().out.splitlines()
    said = dict(line.split(maxsplit=1) for line in lines)
    assert said["reason"] == "nan; the physics diverged" and said["same"] == "every number as in the training"
    assert said["training"] == "scene 1 at step 2 on native" and "the real one" in said["push"]
    assert said["speed"].startswith("at most 150 m/s or rad/s, after 0.02 s")
    moved = [part.split() for part in said["moved"].split(", ")]
    assert [name for name, *_ in moved] == ["ycb_mustard_bottle", "ycb_wood_block"]
    assert float(moved[0][1]) > 40 and float(moved[1][1]) < 0.3
    assert wrote == f"wrote {tmp_path / 'push.png'}" and np.asarray(Image.open(tmp_path / "push.png")).std() > 5


@pytest.mark.slow
def test_the_command_pushes_on_mjx_too(dumps, capsys):
    run_command(str(dumps["flung"]), "--engine", "mjx")
    said = dict(line.split(maxsplit=1) for line in capsys.readouterr().out.splitlines()[1:])
    assert said["reason"] == "nan; the physics diverged"
    assert said["same"] == "not comparable: on mjx, from rounded coordinates"


def test_a_file_of_numbers_only(dumps):
    """Readable without this package, and nothing in it is pickled."""
    with np.load(dumps["flung"], allow_pickle=False) as file:
        about, qvel = json.loads(str(file["about"])), file["qvel"]
        assert about["format"] == "pregrasp_jax dump 2" and qvel.max() == FLUNG
        assert file["state/physics_obs/object_poses"].shape == (MAX_OBJECTS, 7)
    assert dumps["flung"].stat().st_size < 20_000


def test_arrays_that_do_not_fit_are_named(env, dumps, tmp_path):
    dump = load_dump(dumps["flung"])
    for name, array in (("hand/xy", np.zeros(3, np.float32)), ("action", np.float32(3))):
        odd = dataclasses.replace(dump, arrays=dump.arrays | {name: array})
        with pytest.raises(ValueError, match=rf"scene-1\.npz: {name} is float32\["):
            odd.mishap(env)
    io.write_npz(tmp_path / "x.npz", about=np.array("{}"))
    with pytest.raises(ValueError, match=r"x\.npz is no dump of this version; wanted is a file of RUN_DIR/dumps"):
        load_dump(tmp_path / "x.npz")
