import jax
import jax.numpy as jnp
import numpy as np
import pytest
from fake_env import fake_rules, is_open, make_outcome

from pregrasp_jax.config import TaskConfig
from pregrasp_jax.task.rules import end_reason, in_region, reward_terms
from pregrasp_jax.types import MAX_OBJECTS, OBSTRUCTIONS, REASONS, Outcome

GOAL, OTHER = 2, 5
RULES = fake_rules(TaskConfig())


def only(slot) -> jax.Array:
    return jnp.zeros(MAX_OBJECTS, bool).at[MAX_OBJECTS if slot is None else slot].set(True, mode="drop")


def outcome(
    *, coverage=None, closer=0.0, toppled=None, off_table=None, slipped=None, unreachable=False, aperture=1.0, **flags
) -> Outcome:
    """A push that changed nothing but what is named; `closer` applies to the goal, decoys move the other way."""
    before = jnp.linspace(0.1, 0.3, MAX_OBJECTS)
    after = (before + 0.02).at[GOAL].set(before[GOAL] - closer)
    names = ("no_action", "diverged")
    return make_outcome(
        coverage=jnp.zeros(MAX_OBJECTS)
        .at[jnp.array(list(coverage or {0: 0.0}))]
        .set(jnp.array(list((coverage or {0: 0.0}).values()))),
        distance_before=before,
        distance_after=after,
        toppled=only(toppled),
        off_table=only(off_table),
        slipped=only(slipped),
        aperture=jnp.float32(aperture),
        obstruction=jnp.int32(OBSTRUCTIONS.index("no_ik") if unreachable else 0),
        **{name: jnp.asarray(flags.get(name, False)) for name in names},
    )


CASES = {
    "nothing": (outcome(), 0.0, "running"),
    "a closed hand has no region": (outcome(coverage={GOAL: 1.0, OTHER: 0.99}, aperture=0.0), 0.0, "running"),
    "a closed hand approaches": (outcome(coverage={GOAL: 1.0}, closer=0.1, aperture=0.0), 0.5, "running"),
    "approach": (outcome(closer=0.0011), 0.5, "running"),
    "too small an approach": (outcome(closer=0.0009), 0.0, "running"),
    "retreat": (outcome(closer=-0.05), 0.0, "running"),
    "target in region": (outcome(coverage={GOAL: 0.951}), 2.0, "target_in_region"),
    "target in region, and approach": (outcome(coverage={GOAL: 0.951}, closer=0.1), 2.0, "target_in_region"),
    "target almost in region": (outcome(coverage={GOAL: 0.95}, closer=0.1), 0.5, "running"),
    "both in region": (outcome(coverage={GOAL: 0.96, OTHER: 0.99}), 2.0, "target_in_region"),
    "obstacle in region, approach does not count": (
        outcome(coverage={OTHER: 0.96, GOAL: 0.9}, closer=0.1),
        0.0,
        "obstacle_in_region",
    ),
    "target toppled inside the region": (
        outcome(coverage={GOAL: 0.99}, toppled=GOAL),
        0.0,
        "target_toppled",
    ),
    "an obstacle toppled": (outcome(toppled=OTHER, closer=0.1), 0.5, "running"),
    "off the table while in region": (outcome(coverage={GOAL: 0.99}, off_table=GOAL), 0.0, "off_table"),
    "an obstacle off the table": (outcome(coverage={GOAL: 0.99}, off_table=OTHER), 0.0, "off_table"),
    "unreachable before off the table": (outcome(unreachable=True, off_table=OTHER), 0.0, "unreachable"),
    "nan before all": (
        outcome(diverged=True, unreachable=True, off_table=GOAL, toppled=GOAL, coverage={GOAL: 1.0}, no_action=True),
        0.0,
        "nan",
    ),
    "no action left, approach does not count": (outcome(no_action=True, closer=0.1), 0.0, "no_action"),
    "success with no action left": (outcome(no_action=True, coverage={GOAL: 1.0}), 2.0, "target_in_region"),
    "target slipped out of the grasp": (outcome(coverage={GOAL: 1.0}, closer=0.1, slipped=GOAL), 0.0, "grasp_failed"),
    "another object slipped": (outcome(coverage={GOAL: 1.0}, slipped=OTHER), 2.0, "target_in_region"),
    "target slipped beside an obstacle in the region": (
        outcome(coverage={GOAL: 1.0, OTHER: 1.0}, slipped=GOAL),
        0.0,
        "obstacle_in_region",
    ),
    "slipped where nothing is in the region": (outcome(closer=0.1, slipped=GOAL), 0.5, "running"),
}


@pytest.mark.parametrize("case", CASES)
@pytest.mark.parametrize("compiled", [False, True])
def test_hand_cases(case, compiled):
    result, reward, reason = CASES[case]
    function = jax.jit(RULES.judge) if compiled else RULES.judge
    got_reward, got_terminated, got_reason = function(result, jnp.int32(GOAL))
    assert REASONS[int(got_reason)] == reason
    assert float(got_reward) == pytest.approx(reward)
    assert bool(got_terminated) == (reason != "running")


@pytest.mark.parametrize(
    ("what", "reward", "reason"),
    [
        ({"off_table": OTHER, "closer": 0.1}, 0.5, "running"),
        ({"off_table": OTHER, "coverage": {GOAL: 0.99}}, 2.0, "target_in_region"),
        ({"off_table": OTHER, "coverage": {OTHER: 0.99}}, 0.0, "obstacle_in_region"),
        ({"off_table": GOAL, "coverage": {GOAL: 0.99}}, 0.0, "off_table"),
    ],
)
def test_where_obstacles_may_leave_only_the_goal_must_stay(what, reward, reason):
    got_reward, terminated, got_reason = fake_rules(TaskConfig(obstacles_may_leave=True)).judge(
        outcome(**what), jnp.int32(GOAL)
    )
    assert (float(got_reward), REASONS[int(got_reason)]) == (reward, reason)
    assert bool(terminated) == (reason != "running")


def test_the_same_push_is_judged_per_goal():
    result = outcome(coverage={OTHER: 0.97}, toppled=GOAL)
    rewards, _, reasons = jax.vmap(RULES.judge, in_axes=(None, 0))(result, jnp.arange(MAX_OBJECTS))
    expected = ["obstacle_in_region"] * MAX_OBJECTS
    expected[GOAL], expected[OTHER] = "target_toppled", "target_in_region"
    assert [REASONS[int(reason)] for reason in reasons] == expected
    np.testing.assert_array_equal(rewards, [2.0 if slot == OTHER else 0.0 for slot in range(MAX_OBJECTS)])


def test_first_match_is_the_order_of_reasons():
    """A plain Python reading of DESIGN's list, over random outcomes."""
    rng = np.random.default_rng(0)
    compiled = jax.jit(RULES.judge)
    for _ in range(100):
        flags = {name: bool(rng.random() < 0.3) for name in ("diverged", "unreachable", "no_action")}
        fallen = int(rng.integers(MAX_OBJECTS)) if rng.random() < 0.3 else None
        coverage = {int(slot): float(rng.choice([0.2, 0.96])) for slot in rng.permutation(MAX_OBJECTS)[:2]}
        toppled = int(rng.integers(MAX_OBJECTS))
        inside = {slot for slot, share in coverage.items() if share > 0.95}
        expected = next(
            name
            for name, holds in [
                ("nan", flags["diverged"]),
                ("unreachable", flags["unreachable"]),
                ("off_table", fallen is not None),
                ("target_toppled", toppled == GOAL),
                ("target_in_region", GOAL in inside),
                ("obstacle_in_region", bool(inside - {GOAL})),
                ("no_action", flags["no_action"]),
                ("running", True),
            ]
            if holds
        )
        result = outcome(coverage=coverage, toppled=toppled, off_table=fallen, **flags)
        assert REASONS[int(compiled(result, jnp.int32(GOAL)).reason)] == expected


def test_a_diverged_push_is_judged_without_making_new_nans():
    result = outcome(diverged=True).replace(distance_after=jnp.full(MAX_OBJECTS, jnp.nan))
    with jax.debug_nans(True):
        reward, terminated, reason = jax.jit(RULES.judge)(result, jnp.int32(GOAL))
    assert float(reward) == 0.0 and bool(terminated) and REASONS[int(reason)] == "nan"


def test_terms_add_up_to_the_reward():
    for result, reward, _ in CASES.values():
        enclosed = in_region(result, is_open(result.aperture))
        terms = reward_terms(result, jnp.int32(GOAL), end_reason(result, jnp.int32(GOAL), enclosed))
        weights = {"target_in_region": 2.0, "approach": 0.5}
        assert {float(term) for term in terms.values()} <= {0.0, 1.0}
        assert sum(weights[name] * float(term) for name, term in terms.items()) == pytest.approx(reward)
        assert sum(float(term) != 0 for term in terms.values()) <= 1
