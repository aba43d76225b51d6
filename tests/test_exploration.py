"""Guided actions follow their density inside the mask; schedules and epsilon-greedy by hand."""

import functools
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from fake_env import ACTIONS, hand_at

from pregrasp_jax.config import ExplorationConfig
from pregrasp_jax.policies import exploration
from pregrasp_jax.policies.scripts import nearest_action
from pregrasp_jax.spaces.actions import ActionSpace, Choice
from pregrasp_jax.training.collect import epsilon_at

R_IN, R_OUT = 0.04, 0.15
P1 = (-0.05, 0.02)
NUM_ACTIONS = 20_000


def ring(*, full: bool = False) -> np.ndarray:
    """Cells about P1 by a plain loop over the definition."""
    mask = np.zeros((100, 100), bool)
    for row in range(100):
        for col in range(100):
            dx, dy = -0.25 + 0.005 * (col + 0.5) - P1[0], -0.25 + 0.005 * (row + 0.5) - P1[1]
            mask[row, col] = R_IN <= np.hypot(dx, dy) <= R_OUT and (full or dx >= 0)
    return mask


def both(cells: jax.Array | np.ndarray) -> jax.Array:
    """Return the mask [H, W, 2] of cells that are allowed with either choice."""
    return jnp.broadcast_to(jnp.asarray(cells)[..., None], ACTIONS.shape)


def draw_many(draw_one: Callable[[jax.Array], jax.Array], keys: jax.Array) -> jax.Array:
    """Return one draw per key, some hundred at a time: each takes a number for every cell of the map."""
    return jax.lax.map(draw_one, keys, batch_size=500)


@functools.partial(jax.jit, static_argnames="angle_std")
def guided(keys: jax.Array, target: jax.Array, mask: jax.Array, angle_std: float) -> jax.Array:
    options: dict = {"actions": ACTIONS, "angle_std": angle_std, "open_probability": 0.7}
    hand, allowed = hand_at(P1), both(mask)
    return draw_many(lambda key: exploration.guided_action(key, hand, target, allowed, **options), keys)


def draw(dx: float, dy: float, *, angle_std: float = 0.5, mask: np.ndarray | None = None, number: int = 500):
    """Return angle and radius about P1 and the aperture of guided actions for a target at P1 + (dx, dy)."""
    mask = ring() if mask is None else mask
    target = jnp.array([P1[0] + dx, P1[1] + dy])
    actions = np.asarray(guided(jax.random.split(jax.random.key(0), number), target, jnp.asarray(mask), angle_std))
    row, col, aperture = actions // 200, actions // 2 % 100, actions % 2
    assert mask[row, col].all()
    x, y = -0.25 + 0.005 * (col + 0.5) - P1[0], -0.25 + 0.005 * (row + 0.5) - P1[1]
    return np.arctan2(y, x), np.hypot(x, y), aperture


def test_guided_actions_follow_angle_radius_and_aperture():
    angle, radius, aperture = draw(0.1, 0.02, number=3000)
    assert np.mean(angle) == pytest.approx(np.arctan2(0.02, 0.1), abs=0.03)
    assert np.std(angle) == pytest.approx(0.5, abs=0.03)
    counts, _ = np.histogram(radius, bins=4, range=(R_IN, R_OUT))
    np.testing.assert_allclose(counts / len(radius), 0.25, atol=0.04, err_msg="r is uniform, not its area")
    assert np.mean(aperture) == pytest.approx(0.7, abs=0.03)


def test_rows_are_y_and_columns_are_x():
    angle, _, _ = draw(0.0, 0.2, angle_std=0.2)
    assert np.mean(angle) == pytest.approx(np.pi / 2, abs=0.2)
    angle, _, _ = draw(0.0, -0.2, angle_std=0.2)
    assert np.mean(angle) == pytest.approx(-np.pi / 2, abs=0.2)


def test_a_target_behind_the_hand_is_truncated_not_mirrored():
    angle, _, _ = draw(-0.1, 0.1, angle_std=0.2)
    assert np.all(angle <= np.pi / 2 + 1e-6) and np.mean(angle) > 1.2


def test_the_wrap_at_pi_is_continuous():
    above, _, _ = draw(-0.1, 1e-4, mask=ring(full=True))
    below, _, _ = draw(-0.1, -1e-4, mask=ring(full=True))
    assert np.mean(np.cos(above)) == pytest.approx(np.mean(np.cos(below)), abs=0.03)


@pytest.mark.parametrize("angle_std", [0.0, 1e-6])
def test_no_spread_means_the_direction_itself(angle_std):
    angle, _, _ = draw(0.1, 0.0, angle_std=angle_std)
    assert np.all(np.abs(angle) < 0.07)


def test_a_single_allowed_cell_is_found_however_unlikely():
    mask = np.zeros((100, 100), bool)
    mask[17, 31] = True
    draw(0.1, 0.1, angle_std=1e-6, mask=mask)


def test_an_empty_mask_still_gives_an_action():
    action = exploration.guided_action(
        jax.random.key(0),
        hand_at((0.0, 0.0)),
        jnp.ones(2),
        jnp.zeros(ACTIONS.shape, bool),
        ACTIONS,
        angle_std=0.5,
        open_probability=0.7,
    )
    assert 0 <= int(action) < NUM_ACTIONS and action.dtype == jnp.int32


def test_random_actions_cover_the_whole_map_or_what_the_network_values_of_it():
    everywhere, keys = jnp.ones(ACTIONS.shape, bool), jax.random.split(jax.random.key(1), 20_000)
    draw = jax.jit(lambda keys, mask: draw_many(lambda key: exploration.random_action(key, mask, ACTIONS), keys))
    few = everywhere.at[:, :98].set(False)
    assert set(np.asarray(draw(keys[:1000], few)) % 200) == {196, 197, 198, 199}
    actions = np.asarray(draw(keys, everywhere))
    assert actions.min() < 20 and actions.max() >= NUM_ACTIONS - 20
    counts, _ = np.histogram(actions, bins=20, range=(0, NUM_ACTIONS))
    assert np.all(np.abs(counts - 1000) < 160)
    assert np.mean(actions % 2) == pytest.approx(0.5, abs=0.02)


@pytest.mark.parametrize(("step", "value"), [(0, 1.0), (5_000, 0.775), (20_000, 0.1), (90_000, 0.1)])
def test_linear_schedule(step, value):
    for given in (step, jnp.int32(step)):
        schedule = exploration.linear_schedule(given, start=1.0, end=0.1, steps=20_000)
        assert schedule.dtype == jnp.float32 and float(schedule) == pytest.approx(value)


def test_the_warm_up_explores_as_the_start_does():
    config = ExplorationConfig(epsilon_start=0.5, epsilon_end=0.1)
    values = [float(epsilon_at(step, config, warmup=50, decay=100)) for step in (0, 49, 50, 100)]
    assert values == pytest.approx([0.5, 0.5, 0.3, 0.1])


def test_softmax_action_follows_its_distribution_inside_the_mask():
    mask = np.zeros((100, 100), bool)
    mask[3, 4] = mask[50, 60] = True
    q = jnp.full((100, 100, 2), 9.0).at[3, 4].set(jnp.array([0.1, 0.3])).at[50, 60].set(jnp.array([0.0, 0.2]))
    draw = functools.partial(exploration.softmax_action, q=q, mask=both(mask), temperature=0.1)
    actions = np.asarray(draw_many(draw, jax.random.split(jax.random.key(0), 2000)))
    assert actions.dtype == np.int32
    weights = np.exp(np.array([1.0, 3.0, 0.0, 2.0]))
    cells = [2 * (3 * 100 + 4), 2 * (3 * 100 + 4) + 1, 2 * (50 * 100 + 60), 2 * (50 * 100 + 60) + 1]
    shares = [(actions == cell).mean() for cell in cells]
    assert sum(shares) == pytest.approx(1.0)
    np.testing.assert_allclose(shares, weights / weights.sum(), atol=0.03)


def choices(*apertures: float) -> ActionSpace:
    made = [Choice(name=str(k), z=0.1, yaw=0.0, aperture=angle) for k, angle in enumerate(apertures)]
    return ActionSpace(tuple(made), mirrored=tuple(range(len(made))))


@pytest.mark.parametrize(
    ("apertures", "open_probability", "expected"),
    [
        ((0.0, 1.0), 0.7, (0.3, 0.7)),
        ((1.0, 0.0), 0.7, (0.7, 0.3)),
        ((0.0, 1.0), None, (0.5, 0.5)),
        ((0.4,), 0.7, (1.0,)),
        ((0.4, 0.4, 0.4), 0.7, (1 / 3, 1 / 3, 1 / 3)),
        ((0.0, 1.0, 0.5, 1.0, 0.0), 0.6, (0.4 / 3, 0.3, 0.4 / 3, 0.3, 0.4 / 3)),
        ((0.0, 1.0, 0.5, 1.0, 0.0), None, (0.2, 0.2, 0.2, 0.2, 0.2)),
        ((0.0, 0.5, 1.0), 0.0, (0.5, 0.5, 0.0)),
        ((0.0, 0.5, 1.0), 1.0, (0.0, 0.0, 1.0)),
    ],
)
def test_choices_of_the_widest_aperture_share_its_probability(apertures, open_probability, expected):
    draw = functools.partial(exploration.draw_choice, actions=choices(*apertures), open_probability=open_probability)
    drawn = np.asarray(jax.jit(jax.vmap(lambda key: draw(key)))(jax.random.split(jax.random.key(3), 4000)))
    assert drawn.dtype == np.int32
    shares = np.bincount(drawn, minlength=len(apertures)) / len(drawn)
    np.testing.assert_allclose(shares, expected, atol=0.03)
    np.testing.assert_array_equal(shares[np.array(expected) == 0], 0)


def test_a_cell_is_drawn_among_those_that_the_choice_allows():
    """Three choices, each allowed in a cell of its own: the cell of another would be a push that is not allowed."""
    actions = choices(0.0, 0.5, 1.0)
    cells = np.array([[3, 4], [50, 60], [97, 2]])
    mask = jnp.zeros(actions.shape, bool).at[cells[:, 0], cells[:, 1], jnp.arange(3)].set(True)
    keys = jax.random.split(jax.random.key(1), 300)
    guided = functools.partial(exploration.guided_action, actions=actions, angle_std=0.5, open_probability=0.4)
    drawn = [
        jax.vmap(lambda key: exploration.random_action(key, mask, actions))(keys),
        jax.vmap(lambda key: guided(key, hand_at(P1), jnp.zeros(2), mask))(keys),
    ]
    for flat in drawn:
        row, col, choice = (np.asarray(x) for x in actions.unravel(flat))
        assert set(choice) == {0, 1, 2}
        np.testing.assert_array_equal(np.stack([row, col], axis=-1), cells[choice])


def test_a_choice_with_which_nothing_is_allowed_is_not_drawn():
    actions = choices(0.0, 0.5, 1.0)
    mask = jnp.zeros(actions.shape, bool).at[50, 60, 1].set(True)
    keys = jax.random.split(jax.random.key(1), 50)
    guided = functools.partial(exploration.guided_action, actions=actions, angle_std=0.5, open_probability=0.4)
    drawn = [
        jax.vmap(lambda key: exploration.random_action(key, mask, actions))(keys),
        jax.vmap(lambda key: guided(key, hand_at(P1), jnp.zeros(2), mask))(keys),
        jax.vmap(lambda choice: nearest_action(mask, jnp.zeros(2), choice, actions))(jnp.arange(3)),
    ]
    for flat in drawn:
        assert set(np.asarray(flat)) == {(50 * 100 + 60) * 3 + 1}


def best_apart(q: np.ndarray, mask: np.ndarray, *, count: int, spacing: float) -> list[tuple[int, int, int]]:
    found = exploration.best_apart(jnp.asarray(q), jnp.asarray(mask), ACTIONS, count=count, spacing=spacing)
    row, col, choice = ACTIONS.unravel(np.asarray(found))
    return [(int(r), int(c), int(k)) for r, c, k in zip(row, col, choice, strict=True)]


def test_the_best_pushes_apart_against_a_plain_loop():
    rng = np.random.default_rng(3)
    q, mask = rng.normal(size=ACTIONS.shape).astype(np.float32), np.array(both(ring()))
    expected: list[tuple[int, int, int]] = []
    for flat in np.argsort(-np.where(mask, q, -np.inf), axis=None):
        row, col, choice = (int(i) for i in np.unravel_index(flat, q.shape))
        near = [(r, c) for r, c, k in expected if k == choice and 0.005 * np.hypot(r - row, c - col) < 0.02 - 1e-6]
        if not near:
            expected.append((row, col, choice))
        if len(expected) == 12:
            break
    assert best_apart(q, mask, count=12, spacing=0.02) == expected
    assert q[expected[0]] == q[mask].max()


def test_pushes_apart_begin_anew_where_there_are_no_more():
    mask = np.zeros(ACTIONS.shape, bool)
    mask[50, 50:53, 0] = True
    mask[50, 50, 1] = True
    q = np.zeros(ACTIONS.shape, np.float32)
    q[50, 51, 0], q[50, 50, 1], q[50, 53, 0] = 2.0, -1.0, 9.0
    assert best_apart(q, mask, count=4, spacing=0.05) == [(50, 51, 0), (50, 50, 1), (50, 51, 0), (50, 50, 1)]
