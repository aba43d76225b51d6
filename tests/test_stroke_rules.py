"""How a stroke is judged, on touches and poses written by hand."""

import types

import jax.numpy as jnp
import numpy as np
import pytest

from pregrasp_jax.config import TaskConfig
from pregrasp_jax.robot import get_robot
from pregrasp_jax.scene.model import parking_poses
from pregrasp_jax.spaces.workspace import TABLE
from pregrasp_jax.task import registry
from pregrasp_jax.task.push_grasp import LIFTED, TILTED, push_grasp
from pregrasp_jax.task.stroke_rules import GraspOutcome, end_reason, stable
from pregrasp_jax.types import MAX_OBJECTS, OBSTRUCTIONS, REASONS, Touch

LEANING = 0.01
"""rad beyond or short of `TILTED`."""


def touching(*pairs, links=13):
    contacts = np.zeros((links, MAX_OBJECTS), bool)
    for link, slot in pairs:
        contacts[link, slot] = True
    return Touch(*[jnp.zeros(())] * 3, jnp.asarray(contacts), jnp.zeros(MAX_OBJECTS, bool))  # pyright: ignore


def test_a_grasp_is_stable_if_one_object_is_touched_not_by_tips_alone():
    is_tip = np.arange(13) >= 10
    assert stable(touching((4, 2), (11, 2)), is_tip).tolist() == [i == 2 for i in range(8)]
    for unstable in (touching(), touching((10, 2), (11, 2)), touching((4, 2), (11, 3)), touching((10, 2), (4, 3))):
        assert not stable(unstable, is_tip).any()


def outcome(**changes):
    none = jnp.zeros(MAX_OBJECTS, bool)
    blank = GraspOutcome(
        collided=jnp.bool_(False),
        held=none,
        stable=none,
        toppled=none,
        off_table=none,
        final=jnp.bool_(False),
        obstruction=jnp.int32(0),
        diverged=jnp.bool_(False),
    )
    slots = {name: none.at[jnp.array(value)].set(True) for name, value in changes.items() if isinstance(value, list)}
    return blank.replace(**{**changes, **slots})


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({}, "running"),
        ({"held": [1], "stable": [1]}, "running"),  # an obstacle, by PPG's own choice
        ({"held": [1], "stable": [1], "final": jnp.bool_(True)}, "obstacle_grasped"),
        ({"held": [0], "stable": [0]}, "target_held"),
        ({"held": [0], "stable": [0], "off_table": [3], "toppled": [2]}, "target_held"),
        ({"held": [0]}, "target_not_alone"),
        ({"held": [0, 1], "final": jnp.bool_(True)}, "target_not_alone"),
        ({"off_table": [0]}, "off_table"),
        ({"off_table": [1], "toppled": [2]}, "running"),
        ({"toppled": [0]}, "target_toppled"),
        ({"held": [0], "stable": [0], "diverged": jnp.bool_(True)}, "nan"),
        ({"obstruction": jnp.int32(2)}, "unreachable"),
    ],
)
def test_reasons(changes, reason):
    assert REASONS[int(end_reason(outcome(**changes), jnp.int32(0)))] == reason


@pytest.fixture(scope="module")
def measure():
    robot = get_robot("barrett")
    return registry.get_kind("push_grasp").make_rules(robot, TABLE, None, None, TaskConfig()).measure  # pyright: ignore


def lean(angle):
    return [np.cos(angle / 2), np.sin(angle / 2), 0.0, 0.0]


ENDS = {  # where an object may be at the end of a stroke: x, y, z, quaternion
    "stands": [0.1, 0.1, 0.0, *lean(TILTED - LEANING)],
    "lifted": [0.0, 0.0, LIFTED + 0.01, *lean(0.0)],
    "lifted, leaning": [0.0, 0.0, LIFTED + 0.01, *lean(TILTED + LEANING)],
    "not high enough": [0.0, 0.0, LIFTED - 0.01, *lean(0.0)],
    "toppled": [0.1, -0.1, 0.0, *lean(TILTED + LEANING)],
    "off": [0.1, 0.4, -0.5, *lean(0.0)],
    "off, leaning": [0.1, 0.4, -0.5, *lean(1.0)],
}


def judged(measure, ends, *, away=(), links=(), collided=False, obstruction="none", final=False):
    """Return the outcome of a stroke whose objects ended so; those `away` had been taken before it."""
    robot, poses = get_robot("barrett"), parking_poses()
    before, object_ids = parking_poses(), np.full(MAX_OBJECTS, -1)
    for slot, end in enumerate(ends):
        object_ids[slot], poses[slot] = slot, ENDS[end]
        if slot not in away:
            before[slot] = [0.05 * slot, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0]
    contacts = np.zeros((len(robot.links.names), MAX_OBJECTS), bool)
    for name, slot in links:
        contacts[robot.links.names.index(name), slot] = True
    touch = Touch(
        collided=jnp.bool_(collided),
        rows=jnp.int32(100),
        poses=jnp.asarray(np.stack([before, before, poses]), jnp.float32),
        contacts=jnp.asarray(contacts),
        gone=jnp.zeros(MAX_OBJECTS, bool),
    )
    state = types.SimpleNamespace(
        physics_obs=types.SimpleNamespace(object_poses=jnp.asarray(before, jnp.float32)),
        scene=types.SimpleNamespace(object_ids=jnp.asarray(object_ids)),
    )
    after = types.SimpleNamespace(physics_obs=types.SimpleNamespace(touch=touch, diverged=jnp.bool_(False)))
    plan = types.SimpleNamespace(
        stroke=push_grasp(jnp.zeros(2), 0.0, 0.8, final=final),
        reachable=jnp.bool_(obstruction == "none"),
        obstruction=jnp.int32(OBSTRUCTIONS.index(obstruction)),
    )
    return measure(state, after, plan)


def slots(flags):
    return np.flatnonzero(np.asarray(flags)).tolist()


def test_every_object_is_counted_once_by_where_it_ended(measure):
    outcome = judged(measure, list(ENDS))
    assert slots(outcome.held) == [1, 2], "what is lifted is held, however it leans"
    assert slots(outcome.toppled) == [4, 6] and slots(outcome.off_table) == [5, 6]
    assert not outcome.stable.any() and not outcome.final and not outcome.collided


def test_stable_is_what_is_lifted_and_held_alone_by_more_than_tips(measure):
    robot = get_robot("barrett")
    tip, inner = robot.fingertips[0], next(n for n in robot.links.names if n not in robot.fingertips)
    ends = ["stands", "lifted"]
    assert slots(judged(measure, ends, links=[(inner, 1), (tip, 1)]).stable) == [1]
    assert not judged(measure, ends, links=[(tip, 1)]).stable.any()
    assert not judged(measure, ends, links=[(inner, 1), (tip, 0)]).stable.any()
    assert not judged(measure, ends, links=[(inner, 0)]).stable.any(), "touched, alone, but still on the table"
    assert judged(measure, ends, final=True).final


def test_what_was_taken_before_and_what_was_not_executed_count_for_nothing(measure):
    ends = ["lifted", "toppled", "off"]
    outcome = judged(measure, ends, away=(0, 2))
    assert slots(outcome.held) == [] and slots(outcome.toppled) == [1] and slots(outcome.off_table) == []
    refused = judged(measure, ends, collided=True, obstruction="no_ik")
    for flags in (refused.held, refused.stable, refused.toppled, refused.off_table, refused.collided):
        assert not flags.any()
    assert OBSTRUCTIONS[int(refused.obstruction)] == "no_ik"


def test_a_hand_that_met_something_on_its_way_down_holds_nothing(measure):
    outcome = judged(measure, ["lifted", "toppled"], collided=True)
    assert outcome.collided and not outcome.held.any() and slots(outcome.toppled) == [1]
