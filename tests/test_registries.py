"""Robots, places, tasks and engines are chosen by name; a name that nobody knows is one line."""

import dataclasses

import pytest

from pregrasp_jax.physics import make_engine
from pregrasp_jax.robot import ROBOTS, get_robot
from pregrasp_jax.spaces.workspace import TABLE
from pregrasp_jax.task.registry import KINDS, get_kind


def test_a_robot_is_made_once(monkeypatch):
    robot = get_robot("ur5e_rg2")
    assert get_robot("ur5e_rg2") is robot and robot.name == "ur5e_rg2"
    monkeypatch.setitem(ROBOTS, "another", lambda: dataclasses.replace(robot, name="another"))
    assert get_robot("another").name == "another"
    get_robot.cache_clear()


def test_unknown_names_are_refused_in_one_line():
    robot = get_robot("ur5e_rg2")
    with pytest.raises(ValueError, match=r"task\.robot = 'arm' does not exist; allowed: barrett, ur5e_rg2$"):
        get_robot("arm")
    with pytest.raises(ValueError, match=r"task\.primitive = 'pull' does not exist; allowed: push, push_grasp$"):
        get_kind("pull")
    with pytest.raises(ValueError, match=r"physics\.engine = 'bullet' does not exist; allowed: native, mjx$"):
        make_engine("bullet", None, robot, TABLE)  # pyright: ignore[reportArgumentType]


def test_a_kind_of_task_can_be_added(monkeypatch):
    monkeypatch.setitem(KINDS, "shove", KINDS["push"])
    assert get_kind("shove") is KINDS["push"]
