"""Gymnasium's view of the task: its checker passes, and results are those of the JAX interface."""

import importlib.util
import warnings
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

gymnasium = pytest.importorskip("gymnasium")

from gymnasium.utils.env_checker import check_env  # noqa: E402
from gymnasium.vector import AutoresetMode  # noqa: E402

import pregrasp_jax.gymnasium as interface  # noqa: E402
from pregrasp_jax.config import Config, TaskConfig  # noqa: E402
from pregrasp_jax.presets import PRESETS  # noqa: E402
from pregrasp_jax.task.assembly import make_env  # noqa: E402
from pregrasp_jax.types import REASONS  # noqa: E402

SCENES, SEED, PUSHES = 2, 5, 3
CONFIG = Config(scene=PRESETS["ci"].scene, task=TaskConfig(max_pushes=2))


@pytest.fixture(scope="module")
def env():
    return make_env(CONFIG, split="train")


@pytest.fixture(scope="module")
def envs():
    return gymnasium.make_vec(interface.ENV_ID, num_envs=SCENES, config=CONFIG)


def allowed(infos, draw):
    """Return an allowed action of every scene."""
    return np.array([np.flatnonzero(mask)[draw % mask.sum()] for mask in infos["action_mask"]])


def test_same_seeds_and_actions_give_what_the_jax_interface_gives(env, envs):
    obs, infos = envs.reset(seed=SEED)
    reset = jax.jit(jax.vmap(lambda key, n: env.reset(jax.random.fold_in(key, n))))
    step, show = jax.jit(jax.vmap(env.step)), jax.jit(jax.vmap(interface.observe))
    mask_of = jax.jit(jax.vmap(env.action_mask))
    keys = jnp.stack([jax.random.key(SEED + i) for i in range(SCENES)])
    state, ended, episode = (
        reset(keys, jnp.zeros(SCENES, jnp.int32)),
        np.zeros(SCENES, bool),
        np.zeros(SCENES, np.int32),
    )
    ends = 0
    for push in range(PUSHES):
        jax.tree.map(np.testing.assert_array_equal, obs, jax.device_get(show(state)))
        masks = mask_of(state.hand)
        np.testing.assert_array_equal(infos["action_mask"], np.asarray(masks).reshape(SCENES, -1))
        actions = allowed(infos, 4321 + 1111 * push)
        obs, reward, terminated, truncated, infos = envs.step(actions)
        episode = episode + ended
        fresh = reset(keys, jnp.asarray(episode))
        pushed, result = step(state, jnp.asarray(actions, jnp.int32))
        state = jax.vmap(lambda e, a, b: jax.tree.map(lambda x, y: jnp.where(e, x, y), a, b))(
            jnp.asarray(ended), fresh, pushed
        )
        np.testing.assert_array_equal(reward, np.where(ended, 0.0, result.reward))
        np.testing.assert_array_equal(terminated, ~ended & np.asarray(result.terminated))
        np.testing.assert_array_equal(truncated, ~ended & np.asarray(result.truncated))
        np.testing.assert_array_equal(infos["reason"], np.where(ended, 0, result.reason))
        ended = terminated | truncated
        ends += ended.sum()
    assert ends > 0, "no episode ended, so that autoreset was not tested"


def test_episodes_without_a_seed_go_on_from_the_last(env, envs):
    envs.reset(seed=SEED)
    second, _ = envs.reset()
    again, _ = envs.reset(seed=SEED)
    expected = interface.observe(jax.jit(env.reset)(jax.random.fold_in(jax.random.key(SEED), 1)))
    np.testing.assert_array_equal(second["height"][0], expected["height"])
    assert (second["height"] != again["height"]).any()
    by_list, _ = envs.reset(seed=[SEED, SEED + 1])
    jax.tree.map(np.testing.assert_array_equal, by_list, again)


def test_spaces_hold_what_comes_out(envs):
    obs, infos = envs.reset(seed=0)
    assert obs in envs.observation_space
    assert envs.metadata["autoreset_mode"] is AutoresetMode.NEXT_STEP
    assert envs.single_action_space.n == 20_000
    mask = infos["action_mask"][0]
    assert mask[envs.single_action_space.sample(mask=mask)] == 1
    drawn = envs.action_space.sample(mask=tuple(infos["action_mask"]))
    assert all(infos["action_mask"][np.arange(SCENES), drawn] == 1)


def test_a_seed_that_is_left_open_is_drawn(envs):
    fixed, _ = envs.reset(seed=SEED)
    some, _ = envs.reset(seed=[SEED, None])
    again, _ = envs.reset(seed=[SEED, None])
    np.testing.assert_array_equal(some["height"][0], fixed["height"][0])
    assert not np.array_equal(some["height"][1], again["height"][1])


def test_refusals_say_what_is_allowed(envs):
    envs.reset(seed=0)
    with pytest.raises(ValueError, match="allowed are 2 of 0 to 19999"):
        envs.step(np.array([0, 20_000]))
    with pytest.raises(ValueError, match="allowed are 2 of 0 to 19999"):
        envs.step(np.array([0.5, 1.5]))
    with pytest.raises(ValueError, match="or a list of 2"):
        envs.reset(seed=[1])
    for seed in (-1, 2**32, [0, 2**40]):
        with pytest.raises(ValueError, match=r"allowed is an int from 0 to 2\*\*32 - 1, or a list of 2"):
            envs.reset(seed=seed)
    with pytest.raises(ValueError, match="allowed are none"):
        envs.reset(options={"scene": 1})
    with pytest.raises(ValueError, match="num_envs = 0"):
        interface.PreGraspVectorEnv(0)


def test_the_checker_of_gymnasium_passes():
    single = gymnasium.make(interface.ENV_ID, config=CONFIG)  # the checker makes more of them
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warnings.filterwarnings("ignore", message=".*Box.*(infinity|precision).*")
        check_env(single.unwrapped, skip_render_check=True)
    _, info = single.reset(seed=0)
    ended = False
    while not ended:
        _, _, terminated, truncated, info = single.step(int(np.flatnonzero(info["action_mask"])[0]))
        ended = terminated or truncated
    assert info["reason"] != REASONS.index("running")
    with pytest.raises(gymnasium.error.ResetNeeded, match="call reset before step"):
        single.unwrapped.step(0)


def test_one_line_says_what_to_install(monkeypatch):
    found = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda name, *a: None if name == "gymnasium" else found(name, *a))
    source = Path(interface.__file__).read_text()
    with pytest.raises(ImportError, match=r'pip install "pregrasp_jax\[gymnasium\]"'):
        exec(compile(source, interface.__file__, "exec"), {"__name__": "again"})
