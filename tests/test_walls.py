"""Walls: how far a robot is from them against MuJoCo, what heightmaps show of them, and which are refused."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from pregrasp_jax.heightmap.observation import wall_hulls
from pregrasp_jax.heightmap.views import orthographic
from pregrasp_jax.robot import clearance, get_robot
from pregrasp_jax.robot.ur5e_rg2 import moving
from pregrasp_jax.scene.spec import compile_spec, scene_spec
from pregrasp_jax.spaces import grid
from pregrasp_jax.spaces.workspace import Box, Workspace
from pregrasp_jax.task.place import refuse_walls
from pregrasp_jax.types import TABLE_ID

WALLS = Workspace(
    name="walls",
    walls=(
        Box(center=(0.0, 0.26, 0.06), half_size=(0.20, 0.014, 0.06)),
        Box(center=(0.25, 0.25, 0.15), half_size=(0.06, 0.02, 0.15), yaw=-0.8),
    ),
)


def test_the_distance_to_walls_is_mujocos():
    robot = get_robot("ur5e_rg2")
    mj_model = compile_spec(scene_spec(robot, WALLS))
    data = mujoco.MjData(mj_model)
    distance = jax.jit(lambda q: clearance.distance_to_walls(robot.links, moving(robot.links), q, WALLS))
    rng, compared = np.random.default_rng(0), 0
    for _ in range(12):
        joint_pos = np.asarray(robot.home) + rng.uniform(-0.5, 0.5, 8).astype(np.float32)
        joint_pos[7] = joint_pos[6]
        data.qpos[robot.joint_qpos_ids(mj_model)] = joint_pos
        data.joint("hand_left_tip").qpos[0] = data.joint("hand_right_tip").qpos[0] = -joint_pos[6]
        mujoco.mj_kinematics(mj_model, data)
        expected = min(
            mujoco.mj_geomDistance(mj_model, data, mj_model.geom(geom.name).id, mj_model.geom(f"wall_{i}").id, 2, None)
            for geom in moving(robot.links)
            for i in range(len(WALLS.walls))
        )
        if expected > 0:
            compared += 1
            assert float(distance(jnp.asarray(joint_pos))) == pytest.approx(expected, abs=1e-4)
    assert compared >= 8


def test_a_wall_inside_the_grid_has_its_height_and_the_id_of_the_table():
    height, ids = jax.jit(lambda: orthographic(wall_hulls(WALLS)))()
    centers = np.asarray(grid.cell_centers())
    inside = np.zeros((grid.GRID_SIZE, grid.GRID_SIZE))
    for wall in WALLS.walls:
        x, y = centers[None, :] - wall.center[0], centers[:, None] - wall.center[1]
        along, across = np.cos(wall.yaw) * x + np.sin(wall.yaw) * y, np.cos(wall.yaw) * y - np.sin(wall.yaw) * x
        held = (np.abs(along) < wall.half_size[0]) & (np.abs(across) < wall.half_size[1])
        inside = np.maximum(inside, held * (wall.center[2] + wall.half_size[2]))
    assert (inside[99] > 0).sum() >= 80 and (inside == 0.30).sum() > 10
    np.testing.assert_allclose(height, inside, atol=1e-5)
    assert (np.asarray(ids) == TABLE_ID).all()


@pytest.mark.parametrize(
    ("wall", "line"),
    [
        (Box(center=(0.0, 0.22, 0.1), half_size=(0.1, 0.01, 0.1)), "within 0.210 m of the centre"),
        (Box(center=(-0.45, 0.0, 0.1), half_size=(0.02, 0.2, 0.1)), "m from wall 0 or the table; allowed is 0.015 m"),
    ],
)
def test_a_wall_in_the_way_is_refused(wall, line):
    with pytest.raises(ValueError, match=line):
        refuse_walls(get_robot("ur5e_rg2"), Workspace(name="blocked", walls=(wall,)))
