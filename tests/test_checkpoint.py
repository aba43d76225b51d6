"""Checkpoints restore bit for bit, append only what is new, and survive damage to any of their files."""

import json
import shutil
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from pregrasp_jax.checkpoint import chunks, policy, read_config, state, trees, write_config
from pregrasp_jax.checkpoint.chunks import Ring
from pregrasp_jax.config import Config
from pregrasp_jax.presets import PRESETS
from pregrasp_jax.training.program import POLICY

CAPACITY = 10


def make_params(step: int) -> dict:
    return {"conv": {"kernel": jnp.full((3, 2), step + 0.1), "bias": jnp.zeros(2)}}


def make_tree(step: int) -> dict:
    return {
        "learning": {"learner": {"target_params": make_params(step)}},
        "key": jax.random.split(jax.random.key(step), 2),
        "steps": jnp.int32(step),
        "ended": jnp.array([True, False]),
    }


def make_ring(written: int) -> Ring:
    """Observation n is filled with n, in slot n % CAPACITY; unwritten slots are 0."""
    slots = np.zeros(CAPACITY, np.uint8)
    for n in range(written):
        slots[n % CAPACITY] = n
    height = np.broadcast_to(slots[:, None, None], (CAPACITY, 4, 5))
    return Ring({"height": jnp.array(height), "ids": jnp.array(height + np.uint8(100))}, written)


def empty_ring(written: int) -> Ring:
    ring = make_ring(written)
    ids = np.where(np.arange(CAPACITY)[:, None, None] < written, ring.contents["ids"], 0)
    return ring._replace(contents=ring.contents | {"ids": jnp.array(ids, jnp.uint8)})


def save(folder: Path, step: int, written: int) -> Path:
    return state.save(
        folder,
        step,
        make_tree(step),
        empty_ring(written),
        {"seconds": step / 3},
        policy=POLICY,
    )


def restore(folder: Path) -> state.Restored:
    return state.restore(folder, jax.eval_shape(make_tree, 0), make_ring(0).contents)


def flip_byte(path: Path, position: int = -20) -> None:
    data = bytearray(path.read_bytes())
    data[position] ^= 1
    path.write_bytes(data)


@pytest.mark.parametrize("written", [0, 3, CAPACITY, 14, 57])
def test_restores_bit_for_bit(tmp_path, written):
    save(tmp_path, 7, written)
    restored = restore(tmp_path)
    assert trees.checksum(restored.tree) == trees.checksum(make_tree(7))
    assert trees.checksum(restored.ring) == trees.checksum(empty_ring(written).contents)
    assert (restored.step, restored.extra, restored.problems) == (7, {"seconds": 7 / 3}, ())
    assert jnp.issubdtype(restored.tree["key"].dtype, jax.dtypes.prng_key)


def test_checksum_sees_one_bit_and_one_name():
    tree = make_tree(3)
    assert trees.checksum(tree) == trees.checksum(make_tree(3))
    assert trees.checksum(tree) != trees.checksum(tree | {"steps": jnp.int32(2)})
    assert trees.checksum({"a": jnp.zeros(1)}) != trees.checksum({"b": jnp.zeros(1)})


def test_strided_arrays_are_stored_in_their_own_order():
    strided = np.arange(12, dtype=np.float32).reshape(3, 4).T[::2]
    assert not strided.flags["C_CONTIGUOUS"]
    stored = trees.decode(trees.encode(trees.named_leaves({"a": strided})), origin="test")
    np.testing.assert_array_equal(stored["a"], strided)


def test_a_checkpoint_writes_only_new_observations(tmp_path):
    save(tmp_path, 1, 4)
    before = {path.name: path.stat().st_mtime_ns for path in (tmp_path / "replay").iterdir()}
    assert list(before) == ["000000000000-000000000004.npz"]
    save(tmp_path, 2, 9)
    after = {path.name: path.stat().st_mtime_ns for path in (tmp_path / "replay").iterdir()}
    assert sorted(after.keys() - before.keys()) == ["000000000004-000000000009.npz"]
    assert before.items() <= after.items()


def test_long_stretches_are_split(tmp_path, monkeypatch):
    monkeypatch.setattr(chunks, "CHUNK_LENGTH", 4)
    save(tmp_path, 1, 9)
    assert len(list((tmp_path / "replay").iterdir())) == 3
    assert trees.checksum(restore(tmp_path).ring) == trees.checksum(empty_ring(9).contents)


def test_old_checkpoints_and_their_chunks_go(tmp_path):
    for step in range(1, 7):
        save(tmp_path, step, 6 * step)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["000000004", "000000005", "000000006", "replay"]
    # Checkpoint 4 holds the observations 14 to 23; the chunk [6, 12) is of no use to it.
    assert min(path.name for path in (tmp_path / "replay").iterdir()).startswith("000000000012-")
    for newest in ("000000006", "000000005"):
        shutil.rmtree(tmp_path / newest)
    restored = restore(tmp_path)
    assert restored.step == 4
    np.testing.assert_array_equal(restored.ring["height"], make_ring(24).contents["height"])


@pytest.mark.parametrize(
    ("damage", "said"),
    [
        (lambda new: flip_byte(new / "state.safetensors"), "state.safetensors is cut short or altered"),
        (lambda new: flip_byte(new / "state.safetensors", 40), "state.safetensors is cut short or altered"),
        (lambda new: (new / "state.safetensors").write_bytes(b"cut"), "state.safetensors is cut short"),
        (lambda new: (new / "state.safetensors").unlink(), "state.safetensors cannot be read"),
        (lambda new: (new / "manifest.json").write_bytes(b""), "manifest.json is damaged"),
        (lambda new: flip_byte(new / "manifest.json"), "manifest.json is"),
        (lambda new: flip_byte(new.parent / "replay" / "000000000004-000000000009.npz"), "000000000009.npz is cut"),
        (lambda new: (new.parent / "replay" / "000000000004-000000000009.npz").unlink(), "000000000009.npz cannot"),
    ],
)
def test_damage_falls_back_to_the_previous_checkpoint_and_says_so(tmp_path, damage, said):
    save(tmp_path, 1, 4)
    damage(save(tmp_path, 2, 9))
    restored = restore(tmp_path)
    assert restored.step == 1 and len(restored.problems) == 1 and said in restored.problems[0]
    assert trees.checksum(restored.tree) == trees.checksum(make_tree(1))
    assert (tmp_path / "000000002.damaged").is_dir()
    assert restore(tmp_path).problems == ()


@pytest.mark.parametrize("victim", range(4))
def test_every_single_byte_matters(tmp_path, victim):
    """A flipped bit anywhere in any file of the newest checkpoint is noticed."""
    rng = np.random.default_rng(victim)
    save(tmp_path, 1, 4)
    newest = save(tmp_path, 2, 9)
    for path in [*newest.iterdir(), tmp_path / "replay" / "000000000004-000000000009.npz"]:
        original = path.read_bytes()
        flip_byte(path, int(rng.integers(len(original))))
        assert restore(tmp_path).step == 1, path
        if (aside := tmp_path / "000000002.damaged").exists():
            aside.rename(newest)
        path.write_bytes(original)
    assert restore(tmp_path).step == 2


def test_a_checkpoint_without_manifest_does_not_exist(tmp_path):
    save(tmp_path, 1, 4)
    (save(tmp_path, 2, 9) / "manifest.json").unlink()
    assert (restore(tmp_path).step, restore(tmp_path).problems) == (1, ())


def test_training_goes_on_after_a_fall_back(tmp_path):
    save(tmp_path, 1, 4)
    flip_byte(save(tmp_path, 2, 9) / "state.safetensors")
    restore(tmp_path)
    save(tmp_path, 3, 12)
    np.testing.assert_array_equal(restore(tmp_path).ring["height"], make_ring(12).contents["height"])


def test_a_lost_chunk_is_written_again_while_the_ring_still_holds_it(tmp_path):
    save(tmp_path, 1, 4)
    (tmp_path / "replay" / "000000000000-000000000004.npz").unlink()
    save(tmp_path, 2, 9)
    assert trees.checksum(restore(tmp_path).ring) == trees.checksum(empty_ring(9).contents)


@pytest.mark.parametrize("damage", [flip_byte, Path.unlink], ids=["altered", "missing"])
def test_a_lost_chunk_that_all_checkpoints_share_costs_its_observations_and_no_checkpoint(tmp_path, damage):
    """The first chunk holds the observations 0 to 3; at 12 observations the ring of 10 has overwritten two of them."""
    for step, written in ((1, 4), (2, 9), (3, 12)):
        save(tmp_path, step, written)
    shared = tmp_path / "replay" / "000000000000-000000000004.npz"
    damage(shared)
    restored = restore(tmp_path)
    assert (restored.step, len(restored.problems)) == (3, 1) and str(shared) in restored.problems[0]
    assert list(np.flatnonzero(restored.lost)) == [2, 3]
    expected = np.array(make_ring(12).contents["height"])
    expected[[2, 3]] = 0
    np.testing.assert_array_equal(restored.ring["height"], expected)
    again = restore(tmp_path)
    np.testing.assert_array_equal(again.lost, restored.lost)
    for step, written in ((4, 12), (5, 13), (6, 13)):
        ring = Ring({name: jnp.asarray(leaf) for name, leaf in restored.ring.items()}, written)
        state.save(tmp_path, step, make_tree(step), ring, {}, policy=POLICY)
    final = restore(tmp_path)
    assert final.step == 6 and final.problems == () and not final.lost.any()


def test_what_was_lost_does_not_stop_a_newer_state_from_being_damaged_too(tmp_path):
    _, _, newest = (save(tmp_path, step, written) for step, written in ((1, 4), (2, 9), (3, 12)))
    (tmp_path / "replay" / "000000000000-000000000004.npz").unlink()
    flip_byte(newest / "state.safetensors")
    restored = restore(tmp_path)
    assert restored.step == 2 and restored.lost.sum() == 4
    state_problem, chunk_problem = restored.problems
    assert "state.safetensors is cut" in state_problem and "replay chunk" in chunk_problem
    assert not newest.exists() and (tmp_path / "000000001").exists()


def test_refusals_are_one_line(tmp_path):
    with pytest.raises(ValueError, match="holds no checkpoint"):
        restore(tmp_path)
    flip_byte(save(tmp_path, 1, 4) / "state.safetensors")
    with pytest.raises(ValueError, match="none of 1 checkpoints is intact"):
        restore(tmp_path)
    save(tmp_path, 2, 4)
    wider = make_tree(0) | {"steps": jnp.zeros(3, jnp.int32)}
    with pytest.raises(ValueError, match=r"steps is int32\[\], this configuration needs int32\[3\]") as error:
        state.restore(tmp_path, wider, make_ring(0).contents)
    assert "\n" not in str(error.value)
    with pytest.raises(ValueError, match="extra is missing"):
        state.restore(tmp_path, make_tree(0) | {"extra": jnp.zeros(1)}, make_ring(0).contents)
    with pytest.raises(ValueError, match="ended is not part of this configuration"):
        state.restore(tmp_path, {k: v for k, v in make_tree(0).items() if k != "ended"}, make_ring(0).contents)


def test_another_version_is_refused_not_skipped(tmp_path, monkeypatch):
    monkeypatch.setattr(state, "FORMAT", 99)
    save(tmp_path, 1, 4)
    monkeypatch.undo()
    with pytest.raises(ValueError, match="format 99"):
        restore(tmp_path)


def test_policy_round_trip_from_file_folder_and_run(tmp_path):
    params = make_params(5)
    config = PRESETS["ci"]
    policy.save_policy(tmp_path / "best", params, config, {"success_rate": 0.5, "env_steps": 80})
    for path in (tmp_path, tmp_path / "best", tmp_path / "best" / "params.safetensors"):
        loaded = policy.load_policy(path)
        assert trees.checksum(loaded.params) == trees.checksum(params)
        assert loaded.config == config and loaded.evaluation["success_rate"] == 0.5
    assert json.loads((tmp_path / "best" / "evaluation.json").read_text())["env_steps"] == 80
    assert read_config(tmp_path / "best" / "config.yaml") == config


def test_policies_of_the_first_format_still_load(tmp_path):
    """Their checksum covers the parameters alone."""
    arrays = trees.named_leaves(make_params(5))
    about = {"format": "pregrasp_jax policy 1", "config": "{}", "evaluation": "{}", "checksum": trees.checksum(arrays)}
    (tmp_path / "old.safetensors").write_bytes(trees.encode(arrays, about))
    loaded = policy.load_policy(tmp_path / "old.safetensors")
    assert loaded.config == Config() and trees.checksum(loaded.params) == trees.checksum(make_params(5))
    flip_byte(tmp_path / "old.safetensors", -1)
    with pytest.raises(trees.DamagedFileError, match=r"old\.safetensors is altered \(checksum differs\)"):
        policy.load_policy(tmp_path / "old.safetensors")


def test_every_byte_of_a_policy_matters(tmp_path):
    policy.save_policy(tmp_path, make_params(5), PRESETS["ci"], {"success_rate": 0.5})
    path = tmp_path / "params.safetensors"
    for position in range(0, path.stat().st_size, 7):
        flip_byte(path, position)
        with pytest.raises(ValueError) as error:
            policy.load_policy(path)
        assert "\n" not in str(error.value)
        flip_byte(path, position)
    assert policy.load_policy(path).config == PRESETS["ci"]


def test_parameters_that_are_not_finite_are_refused(tmp_path):
    params = make_params(5)
    params["conv"]["bias"] = jnp.array([0.0, jnp.nan])
    policy.save_policy(tmp_path, params, PRESETS["ci"], {})
    with pytest.raises(ValueError, match=r"params\.safetensors: conv/bias has values that are not finite.*; allowed"):
        policy.load_policy(tmp_path)


def test_a_run_without_best_policy_gives_its_latest_checkpoint(tmp_path):
    checkpoints = tmp_path / "checkpoints"
    write_config(tmp_path / "config.yaml", Config())
    save(checkpoints, 1, 4)
    flip_byte(save(checkpoints, 2, 9) / "state.safetensors")
    with pytest.warns(UserWarning, match=r"000000002.state\.safetensors is cut.*; the policy of 000000001 is used"):
        loaded = policy.load_policy(tmp_path)
    assert trees.checksum(loaded.params) == trees.checksum(make_params(1))
    assert (checkpoints / "000000002").is_dir(), "reading a policy must not change the run"


def test_the_latest_checkpoint_can_be_asked_for_beside_a_best_policy(tmp_path):
    write_config(tmp_path / "config.yaml", Config())
    policy.save_policy(tmp_path / "best", make_params(5), Config(), {})
    save(tmp_path / "checkpoints", 1, 4)
    for path, params in ((tmp_path, make_params(5)), (tmp_path / "checkpoints", make_params(1))):
        assert trees.checksum(policy.load_policy(path).params) == trees.checksum(params)
    (tmp_path / "other").mkdir()
    with pytest.raises(ValueError, match="allowed: pretrained, a run folder or its checkpoints"):
        policy.load_policy(tmp_path / "other")
