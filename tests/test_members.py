"""Several networks as one policy: a value is their mean, and each learns for itself."""

import dataclasses
import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from bundles import ACTIONS, random_params, random_policy
from test_learner import OPTIONS, first_row, make_batch, run_update, table

from pregrasp_jax.checkpoint import load_policy
from pregrasp_jax.checkpoint.policy import save_policy
from pregrasp_jax.cli.main import main
from pregrasp_jax.config import Config, NetworkConfig
from pregrasp_jax.learning import learner
from pregrasp_jax.learning.members import join, split
from pregrasp_jax.learning.q_function import make_q_function
from pregrasp_jax.training import session
from pregrasp_jax.types import HandPose, Observation

NETWORK = NetworkConfig(architecture="compact", width=1 / 32, mirror=True)
CONFIG = Config(network=NETWORK)


def of(config: Config, members: int | None) -> Config:
    return dataclasses.replace(config, network=dataclasses.replace(config.network, members=members))


def observation() -> Observation:
    rng = np.random.default_rng(0)
    height, ids = (jnp.asarray(rng.integers(0, top, (100, 100)).astype(np.uint8)) for top in (256, 3))
    return Observation(height, ids, HandPose(jnp.array([-0.1, 0.02]), *jnp.zeros(3)))


def values_of(params: Any, config: Config) -> np.ndarray:
    q = make_q_function(config.network, config.task, ACTIONS)
    return np.asarray(jax.jit(q.values)(params, observation(), jnp.int32(0)))


def test_one_network_stays_as_it_is_and_several_come_back():
    networks = [{"stem": np.full(2, k)} for k in range(3)]
    assert join(networks[:1]) is networks[0] and split(networks[0], 1)[0] is networks[0]
    assert split(join(networks), 3) == networks


def test_a_value_is_the_mean_of_the_members():
    single = make_q_function(NETWORK, CONFIG.task, ACTIONS)
    networks = [random_params(single, seed) for seed in range(3)]
    apart = [values_of(params, CONFIG) for params in networks]
    assert np.abs(apart[0] - apart[1]).max() > 0.01
    np.testing.assert_allclose(values_of(join(networks), of(CONFIG, 3)), np.mean(apart, axis=0), atol=1e-5)


@pytest.mark.parametrize("count", [1, 2, 5])
def test_the_first_members_speak_for_themselves(count: int):
    whole = make_q_function(of(CONFIG, 3).network, CONFIG.task, ACTIONS)
    params = whole.init(jax.random.key(0))
    some, theirs = whole.first(params, count)
    assert some.fits(theirs) and some.members == min(count, 3)
    for found, wanted in zip(some.networks(theirs), whole.networks(params), strict=False):
        jax.tree.map(np.testing.assert_array_equal, found, wanted)


def test_members_start_apart_and_fit_only_a_network_of_as_many():
    assert NETWORK.members is None and NETWORK.num_members == 1
    q = make_q_function(of(CONFIG, 2).network, CONFIG.task, ACTIONS)
    params = jax.jit(q.init)(jax.random.key(0, impl="rbg"))
    first, second = q.networks(params)
    assert np.abs(first["stem"]["kernel"] - second["stem"]["kernel"]).max() > 0.1
    assert q.fits(params)
    single = make_q_function(NETWORK, CONFIG.task, ACTIONS)
    assert single.fits(first) and not single.fits(params) and not q.fits(first)


def test_each_member_learns_as_if_it_were_alone():
    """One table each, all pushes final, so that targets are the rewards; Adam takes no notice of the mean's 1/2."""
    tables = [jnp.zeros((2, 2, 3, 2)), jnp.full((2, 2, 3, 2), 5.0)]
    batch = make_batch(
        [0, 1], [0, 0], action=jnp.array([3, 8], jnp.int32), reward=jnp.array([2.0, 0.5]), terminated=jnp.ones(2, bool)
    )
    optimizer = optax.adam(0.1)
    alone = [run_update(params, batch, optimizer)[0].params for params in tables]
    together, errors, _, metrics = update_together(tables, batch, optimizer)
    for found, wanted, before in zip(together.params, alone, tables, strict=True):
        np.testing.assert_allclose(found, wanted, rtol=1e-5)
        assert np.abs(wanted - before).max() > 0.05
    np.testing.assert_allclose(errors[:, 0], [2.5 - 2.0, 2.5 - 0.5], rtol=1e-6)
    assert float(metrics["train/q_taken"]) == pytest.approx(2.5)
    # Linear branch of the loss, slope 0.1: errors of -2, 3 and -0.5, 4.5.
    assert float(metrics["train/loss"]) == pytest.approx(0.1 * (np.mean([2, 3, 0.5, 4.5]) - 0.05))


def test_targets_are_of_the_mean():
    """The best of the mean is neither member's best."""
    tables = [jnp.zeros((1, 2, 3, 2)).at[0, 0, 0].set(jnp.array(pair)) for pair in ([4.0, 3.0], [0.0, 3.0])]
    _, _, values, _ = update_together(tables, make_batch([0], [0]), optax.sgd(0.0))
    assert float(values[0, 0]) == 3.0


def update_together(tables: list[jax.Array], batch: Any, optimizer: Any) -> Any:
    """Return what `learner.update` does to several tables as one network."""
    q = table(lambda params, inputs: sum(table().apply(member, inputs) for member in params) / len(params))
    q.networks = list
    state = learner.init(tables, optimizer)
    options = OPTIONS | {"q": q, "mask_fn": first_row, "optimizer": optimizer}
    return jax.jit(functools.partial(learner.update, **options))(state, batch)


def test_combined_policies_have_the_mean_of_their_values(tmp_path, capsys):
    policies = [random_policy(tmp_path / f"p{seed}", CONFIG, seed) for seed in range(3)]
    assert main(["combine", str(tmp_path / "p0"), str(tmp_path / "p1"), "--out", str(tmp_path / "two")]) in (0, None)
    assert "mean of 2 networks" in capsys.readouterr().out
    main(["combine", str(tmp_path / "two"), str(tmp_path / "p2"), "--out", str(tmp_path / "three")])
    three = load_policy(tmp_path / "three")
    assert three.config == of(CONFIG, 3)
    apart = [values_of(policy.params, CONFIG) for policy in policies]
    np.testing.assert_allclose(values_of(three.params, three.config), np.mean(apart, axis=0), atol=1e-5)


def test_the_first_networks_of_a_policy_are_a_policy(tmp_path, capsys):
    policies = [random_policy(tmp_path / f"p{seed}", CONFIG, seed) for seed in range(3)]
    main(["combine", *(str(tmp_path / f"p{seed}") for seed in range(3)), "--out", str(tmp_path / "three")])
    for first, policy, members in ((1, "three", 1), (2, "three", 2), (8, "three", 3), (1, "p2", 1)):
        out = tmp_path / f"{first} of {policy}"
        assert main(["combine", str(tmp_path / policy), "--first", str(first), "--out", str(out)]) in (0, None)
        made = load_policy(out)
        wanted = policies[2:] if policy == "p2" else policies[:members]
        assert made.config.network.num_members == members
        np.testing.assert_array_equal(
            values_of(made.params, made.config), values_of(join([p.params for p in wanted]), of(CONFIG, members))
        )
    main(["combine", str(tmp_path / "three"), str(tmp_path / "p2"), "--first", "1", "--out", str(tmp_path / "two")])
    assert load_policy(tmp_path / "two").config.network.num_members == 2
    capsys.readouterr()
    with pytest.raises(SystemExit):
        main(["combine", str(tmp_path / "three"), "--first", "-1", "--out", str(tmp_path / "out")])
    assert "first = -1 is out of range; allowed is 1 and more, or 0" in capsys.readouterr().err


def changed(config: Config, change: dict[str, Any]) -> Config:
    for name, value in change.items():
        group, key = name.split(".")
        config = dataclasses.replace(config, **{group: dataclasses.replace(getattr(config, group), **{key: value})})
    return config


def save_random(folder: Any, config: Config) -> None:
    save_policy(folder, random_params(make_q_function(config.network, config.task, ACTIONS)), config, {})


REWARDS = [{"task.approach_reward": 0.0}, {"learner.discount": 0.7}, {"train.try_grasps": True}]
OTHERS = [
    {"network.width": 1 / 16},
    {"network.mirror": False},
    {"network.path_channels": 2},
    {"task.workspace": "narrow"},
    {"train.method": "imitation"},
]


@pytest.mark.parametrize(("change", "any_values"), [(c, False) for c in REWARDS] + [(c, True) for c in OTHERS])
def test_values_that_mean_something_else_are_not_averaged(change, any_values, tmp_path, capsys):
    save_random(tmp_path / "first", CONFIG)
    save_random(tmp_path / "other", changed(CONFIG, change))
    arguments = [str(tmp_path / "first"), str(tmp_path / "other"), "--out", str(tmp_path / "out")]
    with pytest.raises(SystemExit) as stopped:
        main(["combine", *arguments, "--any-values", str(any_values)])
    ((name, value),) = change.items()
    said, error = "learnt by imitation" if value == "imitation" else f"{name} = {value}", capsys.readouterr().err
    assert stopped.value.code == 2 and said in error and ("--any-values True" in error) == (not any_values)
    assert not (tmp_path / "out").exists()


def test_no_path_channels_and_none_said_are_one_network(tmp_path):
    said = changed(CONFIG, {"network.path_channels": 0})
    for name, config in (("first", CONFIG), ("other", said)):
        save_random(tmp_path / name, config)
    main(["combine", str(tmp_path / "first"), str(tmp_path / "other"), "--out", str(tmp_path / "out")])
    assert load_policy(tmp_path / "out").config == of(CONFIG, 2)


@pytest.mark.parametrize("change", REWARDS)
def test_what_is_to_be_trained_on_may_have_had_other_rewards(change, tmp_path):
    save_random(tmp_path / "first", CONFIG)
    save_random(tmp_path / "other", changed(CONFIG, change))
    arguments = [str(tmp_path / "first"), str(tmp_path / "other"), "--out", str(tmp_path / "out")]
    assert main(["combine", *arguments, "--any-values", "True"]) in (0, None)
    assert load_policy(tmp_path / "out").config == of(CONFIG, 2)


def test_combine_needs_two_policies_and_a_new_folder(tmp_path, capsys):
    random_policy(tmp_path / "first", CONFIG)
    first, fewer = str(tmp_path / "first"), str(tmp_path / "fewer")
    save_policy(tmp_path / "fewer", load_policy(first).params, of(CONFIG, 4), {})
    for arguments, named in (
        ([first, "--out", str(tmp_path / "out")], "at least two policies, got 1"),
        ([first, first, "--out", first], "exists already"),
        (
            [first, fewer, "--out", str(tmp_path / "out")],
            f"{fewer}: parameters of 4 networks are wanted; member0 is mis",
        ),
        ([first, first, "--out", str(tmp_path / "first" / "params.safetensors" / "x")], "is not a writable folder"),
        ([first, str(tmp_path / "none"), "--out", str(tmp_path / "out")], "does not exist"),
        ([first] * 17 + ["--out", str(tmp_path / "out")], "17 networks together; allowed are 16"),
    ):
        with pytest.raises(SystemExit):
            main(["combine", *arguments])
        assert named in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("setting", ["members", "path_channels"])
@pytest.mark.parametrize(
    ("asked", "started_from", "found"), [(None, 3, 3), (None, None, None), (2, 3, 2), (2, None, 2)]
)
def test_a_training_takes_as_many_as_it_begins_with_unless_it_says_how_many(setting, asked, started_from, found):
    asked, started_from, found = (
        dataclasses.replace(CONFIG, network=dataclasses.replace(NETWORK, **{setting: count}))
        for count in (asked, started_from, found)
    )
    assert session._like(asked, started_from) == found


def test_a_training_says_which_settings_give_the_values_another_meaning():
    changed = dataclasses.replace(
        CONFIG,
        learner=dataclasses.replace(CONFIG.learner, discount=0.7, batch_size=8),
        task=dataclasses.replace(CONFIG.task, approach_reward=0.0),
    )
    assert list(session._changed_values(CONFIG, CONFIG)) == []
    assert list(session._changed_values(changed, CONFIG)) == [
        "learner.discount = 0.5, this run has 0.7",
        "task.approach_reward = 0.5, this run has 0.0",
    ]
