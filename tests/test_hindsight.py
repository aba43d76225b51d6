import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from fake_env import fake_rules, hand_at, make_outcome

from pregrasp_jax.config import TaskConfig
from pregrasp_jax.learning import hindsight, replay
from pregrasp_jax.types import MAX_OBJECTS, REASONS, Observation, Outcome

MAX_PUSHES = 5
RULES = fake_rules(TaskConfig())


def random_outcome(rng: np.random.Generator, *, enclosed: int | None = None, toppled=()) -> Outcome:
    """Host arrays, which are quicker to make by the hundred than device arrays."""
    coverage = rng.uniform(0, 0.9, MAX_OBJECTS).astype(np.float32)
    if enclosed is not None:
        coverage[enclosed] = 0.97
    before = rng.uniform(0.1, 0.2, MAX_OBJECTS).astype(np.float32)
    fields: dict[str, Any] = {
        "coverage": coverage,
        "distance_before": before,
        "distance_after": before + rng.uniform(-0.003, 0.003, MAX_OBJECTS).astype(np.float32),
        "toppled": np.isin(np.arange(MAX_OBJECTS), list(toppled)),
    }
    fields["off_table"] = np.zeros(MAX_OBJECTS, bool)
    plain = {"aperture": np.float32(1.0), "obstruction": np.int32(0)}
    plain |= dict.fromkeys(("no_action", "diverged"), np.zeros((), bool))
    return make_outcome(**fields, **plain)


def stack(items):
    return jax.tree.map(lambda *leaves: jnp.stack([jnp.asarray(leaf) for leaf in leaves]), *items)


compiled_judge = jax.jit(RULES.judge)


def loop_relabel(outcomes: list[Outcome], goal: int) -> list[tuple[float, bool]]:
    """The plain reading: judge every push, stop at the first end."""
    rows = []
    for outcome in outcomes:
        reward, terminated, _ = compiled_judge(outcome, jnp.int32(goal))
        rows.append((float(reward), bool(terminated)))
        if terminated:
            break
    return rows


def test_relabel_agrees_with_a_plain_loop():
    rng = np.random.default_rng(0)
    relabel = jax.jit(functools.partial(hindsight.relabel, RULES))
    lengths = set()
    for trial in range(60):
        length, goal = int(rng.integers(1, MAX_PUSHES + 1)), int(rng.integers(MAX_OBJECTS))
        topples_at = int(rng.integers(length + 3))
        episode = [
            random_outcome(
                rng,
                enclosed=goal if step == length - 1 else None,
                toppled=(goal,) if step >= topples_at else (),
            )
            for step in range(length)
        ]
        # Whatever lies behind the end of the episode must not matter.
        behind = [random_outcome(rng, enclosed=goal) for _ in range(MAX_PUSHES - length)]
        verdicts, valid = jax.device_get(relabel(stack(episode + behind), length, goal))
        reward, terminated = verdicts.reward, verdicts.terminated
        expected = loop_relabel(episode, goal)
        assert valid.tolist() == [step < len(expected) for step in range(MAX_PUSHES)], trial
        assert list(zip(reward[valid].tolist(), terminated[valid].tolist(), strict=True)) == expected
        lengths.add(length - len(expected))
    assert len(lengths) >= 3  # some relabelled episodes ended one or more pushes before the real one


ELIGIBLE = np.ones(MAX_OBJECTS, bool)


@pytest.mark.parametrize(
    ("coverage", "flags", "eligible", "expected"),
    [
        ({4: 0.96}, {}, ELIGIBLE, 4),
        ({4: 0.96, 6: 0.98}, {}, ELIGIBLE, 6),
        ({4: 0.96, 6: 0.98}, {}, np.arange(MAX_OBJECTS) == 4, 4),
        ({4: 0.96}, {}, np.arange(MAX_OBJECTS) != 4, None),
        ({4: 0.95}, {}, ELIGIBLE, None),
        ({4: 0.96, 1: 0.99}, {}, ELIGIBLE, None),
        ({4: 0.96}, {"off_table": np.arange(MAX_OBJECTS) == 6}, ELIGIBLE, None),
        ({4: 0.96}, {"no_action": True}, ELIGIBLE, 4),
        ({4: 0.96}, {"aperture": jnp.float32(0.0)}, ELIGIBLE, None),
        ({1: 0.99, 4: 0.97}, {"slipped": np.arange(MAX_OBJECTS) == 1}, ELIGIBLE, 4),
    ],
    ids=[
        "one",
        "two",
        "larger not eligible",
        "not eligible",
        "at the bound",
        "target too",
        "off table",
        "no action",
        "closed hand",
        "target too, which slipped",
    ],
)
def test_enclosed_obstacle(coverage, flags, eligible, expected):
    result = random_outcome(np.random.default_rng(1))
    shares = np.array([coverage.get(slot, 0.1) for slot in range(MAX_OBJECTS)], np.float32)
    result = result.replace(coverage=shares, **{name: jnp.asarray(value) for name, value in flags.items()})
    slot, found = RULES.hindsight_goal(result, jnp.int32(1), jnp.asarray(eligible))
    assert bool(found) == (expected is not None)
    if expected is not None:
        assert int(slot) == expected


def test_a_bystander_that_left_spoils_no_hindsight_where_obstacles_may_leave():
    fallen, enclosed, target = 6, 4, 1
    result = random_outcome(np.random.default_rng(1), enclosed=enclosed)
    result = result.replace(off_table=np.arange(MAX_OBJECTS) == fallen)
    for may_fall in (False, True):
        rules = fake_rules(TaskConfig(obstacles_may_leave=may_fall))
        slot, found = rules.hindsight_goal(result, jnp.int32(target), jnp.asarray(ELIGIBLE))
        assert bool(found) == may_fall and int(slot) == enclosed
        outcomes = jax.tree.map(lambda leaf: jnp.asarray(leaf)[None], result)
        verdicts, _ = hindsight.relabel(rules, outcomes, jnp.int32(1), jnp.int32(enclosed))
        assert (float(verdicts.reward[0]), bool(verdicts.terminated[0])) == (2.0 if may_fall else 0.0, True)


def image(number: int) -> Observation:
    pixels = jnp.array([[number % 256, number // 256]], jnp.uint8)
    return Observation(pixels, pixels, hand_at((0.0, 0.0)))


def test_jitted_memory_agrees_with_a_plain_loop_over_the_shipped_judge():
    """Several scenes with episodes of random length; the expected hindsight rows come from Python lists."""
    rng = np.random.default_rng(5)
    num_envs = 4
    eligible = rng.random((num_envs, MAX_OBJECTS)) < 0.7
    episodes: list[list[tuple[int, Outcome]]] = [[] for _ in range(num_envs)]
    goals = rng.integers(MAX_OBJECTS, size=num_envs)
    expected, number, reasons = [], 0, set()
    memory, add = None, None
    for _ in range(40):
        pushes = []
        for env in range(num_envs):
            enclosed = int(rng.integers(MAX_OBJECTS)) if rng.random() < 0.3 else None
            outcome = random_outcome(rng, enclosed=enclosed, toppled=rng.integers(MAX_OBJECTS, size=rng.integers(2)))
            number += 1
            reward, terminated, reason = compiled_judge(outcome, jnp.int32(goals[env]))
            episodes[env].append((number, outcome))
            truncated = not terminated and len(episodes[env]) == MAX_PUSHES
            pushes.append(
                replay.Steps(
                    root=jnp.int32(env),
                    obs=image(0),
                    action=jnp.int32(number),
                    goal=jnp.int32(goals[env]),
                    outcome=outcome,
                    reward=reward,
                    terminated=terminated,
                    reason=reason,
                    truncated=jnp.asarray(truncated),
                    next_obs=image(0),
                )
            )
            reasons.add(REASONS[int(reason)])
            if terminated or truncated:
                inside = [s for s in range(MAX_OBJECTS) if outcome.coverage[s] > 0.95 and eligible[env, s]]
                if REASONS[int(reason)] == "obstacle_in_region" and inside:
                    rows = loop_relabel([o for _, o in episodes[env]], inside[0])
                    expected += [
                        (action, inside[0], *row) for (action, _), row in zip(episodes[env], rows, strict=False)
                    ]
                episodes[env], goals[env] = [], rng.integers(MAX_OBJECTS)
        steps = stack(pushes)
        if memory is None:
            memory = replay.init(steps, capacity=1000, max_pushes=MAX_PUSHES)
            add = jax.jit(
                lambda memory, steps: hindsight.add_hindsight(replay.add(memory, steps), jnp.asarray(eligible), RULES),
                donate_argnums=0,
            )
        assert add is not None
        memory = add(memory, steps)
    assert memory is not None
    rows = jax.tree.map(np.asarray, memory.rows)
    chosen = np.flatnonzero(rows.hindsight & (np.asarray(memory.priorities.leaves) > 0))
    got = [(int(rows.action[i]), int(rows.goal[i]), float(rows.reward[i]), bool(rows.terminated[i])) for i in chosen]
    assert got == expected and len(got) > 20
    assert {reward for _, _, reward, _ in got} == {0.0, 0.5, 2.0}
    assert {"target_toppled", "target_in_region", "obstacle_in_region"} <= reasons


def test_without_the_call_there_are_no_hindsight_rows():
    rng = np.random.default_rng(0)
    outcome = random_outcome(rng, enclosed=3)
    reward, terminated, reason = compiled_judge(outcome, jnp.int32(0))
    step = functools.partial(
        replay.Steps, root=jnp.int32(0), obs=image(0), next_obs=image(1), truncated=jnp.asarray(False)
    )
    judged = {"reward": reward, "terminated": terminated, "reason": reason}
    steps = stack([step(action=jnp.int32(0), goal=jnp.int32(0), outcome=outcome, **judged)])
    memory = jax.jit(replay.add)(replay.init(steps, capacity=20, max_pushes=MAX_PUSHES), steps)
    assert int(memory.hindsight_rows_written) == 0 and int(memory.num_alive) == 1
    eligible = jnp.ones((1, MAX_OBJECTS), bool)
    add_hindsight = jax.jit(functools.partial(hindsight.add_hindsight, rules=RULES))
    relabelled = add_hindsight(memory, eligible)
    assert int(relabelled.hindsight_rows_written) == 1
    assert REASONS[int(relabelled.rows.reason[0])] == "obstacle_in_region"
    assert REASONS[int(relabelled.rows.reason[1])] == "target_in_region", "as the relabelled goal is judged"
