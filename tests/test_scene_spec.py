"""Table, walls and robot as MuJoCo compiles them."""

import mujoco
import numpy as np
import pytest

from pregrasp_jax.robot import get_robot
from pregrasp_jax.scene.spec import compile_spec, scene_spec, table_model, table_spec
from pregrasp_jax.spaces.workspace import TABLE, Box, Workspace

ROBOT = get_robot("ur5e_rg2")
ROOM = Workspace(
    name="room",
    walls=(
        Box(center=(0.4, 0.0, 0.1), half_size=(0.02, 0.3, 0.1)),
        Box(center=(0.0, 0.5, 0.2), half_size=(0.3, 0.01, 0.2), yaw=0.5),
    ),
)


def test_walls_stand_where_the_workspace_says_and_stop_robot_and_objects():
    mj_model = compile_spec(scene_spec(ROBOT, ROOM))
    data = mujoco.MjData(mj_model)
    mujoco.mj_kinematics(mj_model, data)
    table = mj_model.geom("table")
    moving = mj_model.geom_bodyid > 0
    for index, wall in enumerate(ROOM.walls):
        geom = mj_model.geom(f"wall_{index}")
        signs = np.array([(x, y, z) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
        corners = signs * geom.size @ data.geom_xmat[geom.id].reshape(3, 3).T + data.geom_xpos[geom.id]
        np.testing.assert_allclose(corners, wall.corners(), atol=1e-9)
        assert (geom.contype[0], geom.conaffinity[0]) == (table.contype[0], table.conaffinity[0])
        assert ((mj_model.geom_contype[moving] & geom.conaffinity[0]) > 0).all()
    assert mj_model.geom("table").id < mj_model.geom("wall_0").id
    plain = compile_spec(scene_spec(ROBOT, TABLE))
    assert plain.ngeom == mj_model.ngeom - 2
    assert plain.nq == mj_model.nq == len(ROBOT.joints) + 2


def test_an_object_slides_against_a_wall_and_stops():
    for workspace, stopped in ((ROOM, True), (TABLE, False)):
        spec = table_spec(workspace)
        body = spec.worldbody.add_body(pos=[0.25, 0, 0.05])
        body.add_freejoint(name="free")
        body.add_geom(type=mujoco.mjtGeom.mjGEOM_BOX, size=[0.05] * 3, mass=0.3)
        mj_model = compile_spec(spec)
        data = mujoco.MjData(mj_model)
        data.joint("free").qvel[0] = 1.0
        mujoco.mj_step(mj_model, data, 200)
        reached = data.joint("free").qpos[0]
        assert (reached < 0.34) == stopped and reached > 0.27


def test_the_table_alone_is_compiled_once_and_has_the_camera():
    assert table_model() is table_model()
    assert table_model().camera("overhead").id >= 0
    with pytest.raises(KeyError):
        table_model().geom("wall_0")
