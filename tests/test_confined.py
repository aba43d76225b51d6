"""Confined places: what they are, the arm's mirror image, what keeps a hand from a wall, and what is refused."""

import dataclasses
import inspect
import math
from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from pregrasp_jax.config import Config, NetworkConfig, PlaceConfig, TaskConfig
from pregrasp_jax.evaluation_config import TaskOverrides, _task
from pregrasp_jax.robot import clearance, get_robot
from pregrasp_jax.robot.base import Robot
from pregrasp_jax.robot.description import arm
from pregrasp_jax.robot.kinematics import hand_inverse_kinematics
from pregrasp_jax.robot.ur5e_rg2 import moving
from pregrasp_jax.scene.spec import compile_spec, scene_spec
from pregrasp_jax.spaces import grid
from pregrasp_jax.spaces.workspace import TABLE, WORKSPACES, Box, Workspace, get_workspace
from pregrasp_jax.task.env import Env
from pregrasp_jax.task.grasp import plan_grasp
from pregrasp_jax.task.place import refuse_blocked, refuse_scenes
from pregrasp_jax.task.primitive import Primitive
from pregrasp_jax.task.push import make_push
from pregrasp_jax.task.rules import _jammed
from pregrasp_jax.training.session import refuse_mirror
from pregrasp_jax.types import OBSTRUCTIONS

ROBOT = get_robot("ur5e_rg2")
SHELF = get_workspace("shelf", {"half_width": 0.27, "back": 0.28})
NONE, WALL = OBSTRUCTIONS.index("none"), OBSTRUCTIONS.index("wall")


# -- Places


def test_the_walls_of_a_shelf():
    back, left, right = SHELF.walls
    assert back.corners().min(axis=0) == pytest.approx([0.28, -0.29, 0.0])
    assert back.corners().max(axis=0) == pytest.approx([0.30, 0.29, 0.3])
    assert left.corners().min(axis=0) == pytest.approx([-0.25, 0.27, 0.0])
    assert left.corners().max(axis=0) == pytest.approx([0.28, 0.29, 0.3])
    assert right.corners().max(axis=0) == pytest.approx([0.28, -0.27, 0.3])
    points = np.array([[-0.251, 0.0, 0.1], [0.4, 0.0, 0.1], [0.0, 0.4, 0.1], [0.0, 0.0, -0.01]], np.float32)
    assert SHELF.has_left(points).tolist() == [True, False, False, True], "objects leave at the front only"


def test_a_narrow_table_ends_at_its_sides():
    narrow = get_workspace("narrow", {"half_width": 0.21, "front": None})
    points = np.array([[0.0, 0.209, 0.1], [0.0, -0.211, 0.1], [0.251, 0.0, 0.1], [-0.249, 0.0, 0.1]], np.float32)
    assert not narrow.walls and narrow.has_left(points).tolist() == [False, True, True, False]


@pytest.mark.parametrize(
    ("name", "dimension", "allowed"),
    [
        ("narrow", "back", "half_width$"),
        ("table", "half_width", "none$"),
        ("shelf", "depth", "half_width, back, front"),
    ],
)
def test_a_dimension_that_a_place_does_not_have_is_refused(name, dimension, allowed):
    line = rf"task\.place\.{dimension} = 0\.3: workspace '{name}' has no such dimension; allowed: {allowed}"
    with pytest.raises(ValueError, match=line):
        get_workspace(name, {dimension: 0.3})


def test_every_dimension_of_every_place_is_a_setting():
    makers = [place for place in WORKSPACES.values() if callable(place)]
    dimensions = {name for make in makers for name in inspect.signature(make).parameters}
    assert dimensions == {field.name for field in dataclasses.fields(PlaceConfig)}
    with pytest.raises(ValueError, match=r"task\.place\.half_width = 3\.0 is out of range"):
        Config(task=TaskConfig(place=PlaceConfig(half_width=3.0))).validate()
    with pytest.raises(ValueError, match=r"workspace 'shelf': front = 0\.4 must be below back = 0\.25"):
        get_workspace("shelf", {"front": 0.4})


def test_an_evaluation_may_change_the_place():
    trained = TaskConfig(workspace="shelf", place=PlaceConfig(half_width=0.27, back=0.28))
    kept = _task(trained, TaskOverrides(place=PlaceConfig(back=0.35)))
    assert kept.place == PlaceConfig(half_width=0.27, back=0.35)
    elsewhere = _task(trained, TaskOverrides(workspace="narrow"))
    assert (elsewhere.workspace, elsewhere.place) == ("narrow", PlaceConfig()), "with dimensions of its own"
    assert _task(trained, TaskOverrides(mirrored_start=False)).mirrored_start is False


def test_a_place_is_told_by_all_that_makes_it():
    wall = Box(center=(0.0, 0.4, 0.1), half_size=(0.2, 0.01, 0.1))
    places = [TABLE, SHELF, get_workspace("shelf"), Workspace(name="table", walls=(wall,))]
    assert len({place.content_hash for place in places}) == len(places)
    assert get_workspace("shelf").content_hash == get_workspace("shelf", {"half_width": 0.25}).content_hash


@pytest.mark.parametrize(
    ("walls", "symmetric"),
    [
        ((), True),
        ((Box(center=(0.4, 0.0, 0.1), half_size=(0.01, 0.3, 0.1)),), True),
        ((Box(center=(0.4, 0.0, 0.1), half_size=(0.01, 0.3, 0.1), yaw=0.1),), False),
        ((Box(center=(0.4, 0.0, 0.1), half_size=(0.3, 0.01, 0.1), yaw=math.pi / 2),), True),
        ((Box(center=(0.0, 0.4, 0.1), half_size=(0.2, 0.01, 0.1)),), False),
        (tuple(Box(center=(0.0, y, 0.1), half_size=(0.2, 0.01, 0.1), yaw=y) for y in (-0.4, 0.4)), True),
        (tuple(Box(center=(0.0, y, 0.1), half_size=(0.2, 0.01, 0.1), yaw=0.4) for y in (-0.4, 0.4)), False),
    ],
)
def test_which_places_are_their_own_mirror_image(walls, symmetric):
    assert Workspace(name="room", walls=walls).symmetric is symmetric
    assert not Workspace(name="room", walls=walls, high=(0.25, math.inf)).symmetric


# -- The arm's mirror image


def test_the_other_posture_is_the_mirror_image_of_the_arm():
    postures = []
    for home in ROBOT.homes:
        matrices = np.asarray(ROBOT.links.matrices(jnp.asarray(home)))
        geoms = [(geom, matrices[geom.link]) for geom in ROBOT.links.geoms]
        postures.append([(geom.points @ pose[:3, :3].T + pose[:3, 3], geom.radius) for geom, pose in geoms])
    for points, radius in postures[0]:
        gaps = [
            np.linalg.norm(points[:, None] - (other * [1, -1, 1])[None], axis=-1)
            for other, of_other in postures[1]
            if of_other == radius and len(other) == len(points)
        ]
        nearest = min(max(gap.min(axis=0).max(), gap.min(axis=1).max()) for gap in gaps)
        assert nearest < 1e-4, "every geom has its image; left and right fingers are each other's"
    poses = [np.asarray(ROBOT.hand_pose(jnp.asarray(home))) for home in ROBOT.homes]
    np.testing.assert_allclose(poses[0], poses[1], atol=1e-5)
    assert np.abs(ROBOT.homes[0] - ROBOT.homes[1]).max() > 1


@pytest.fixture(scope="module")
def obstructions():
    """What is in the way of pushes from the start, after one to a first cell: (posture, first, second) -> codes."""
    push = make_push(ROBOT, SHELF, TaskConfig(), max_distance=0.6)
    rng = np.random.default_rng(0)
    rows, cols = rng.integers(0, grid.GRID_SIZE, 300), rng.integers(0, grid.GRID_SIZE, 300)
    actions = push.actions.encode(jnp.asarray(rows), jnp.asarray(cols), jnp.asarray(rng.integers(0, 2, 300)))
    start = jax.tree.map(jnp.asarray, ROBOT.start)

    @jax.jit
    @jax.vmap
    def code(action: jax.Array, home: jax.Array) -> jax.Array:
        return push.plan(home, push.decode(start, action)).obstruction

    return push.actions, actions, code


def test_between_walls_the_mirrored_push_of_the_mirrored_arm_meets_the_same(obstructions):
    actions, drawn, code = obstructions
    here = np.asarray(code(drawn, jnp.broadcast_to(jnp.asarray(ROBOT.homes[0]), (len(drawn), 8))))
    there = np.asarray(code(actions.mirror(drawn), jnp.broadcast_to(jnp.asarray(ROBOT.homes[1]), (len(drawn), 8))))
    same_arm = np.asarray(code(actions.mirror(drawn), jnp.broadcast_to(jnp.asarray(ROBOT.homes[0]), (len(drawn), 8))))
    assert (here == WALL).sum() > 30 and (here == NONE).sum() > 100
    assert (here != there).sum() <= 1, "up to rounding at the margin"
    assert (here != same_arm).sum() > 10, "the wrist is on one side"


# -- Clearance along a motion


def test_what_a_wall_refuses_is_what_mujoco_finds_too_near():
    """Every row of a push, all moving geoms, against `mj_geomDistance`; between checked rows 5 mm may be missed."""
    mj_model = compile_spec(scene_spec(ROBOT, SHELF))
    data = mujoco.MjData(mj_model)
    push = make_push(ROBOT, SHELF, TaskConfig(), max_distance=0.6)
    start = jax.tree.map(jnp.asarray, ROBOT.start)
    geoms = [mj_model.geom(geom.name).id for geom in moving(ROBOT.links)]
    walls = [mj_model.geom(f"wall_{i}").id for i in range(3)]
    tips = [mj_model.joint(name).qposadr[0] for name in ("hand_left_tip", "hand_right_tip")]
    plan = jax.jit(lambda home, action: push.plan(home, push.decode(start, action)))
    rng, refused = np.random.default_rng(1), []
    for trial in range(16):
        home = ROBOT.homes[trial % 2]
        row, col = int(rng.choice([4, 12, 20, 50, 80, 88, 96])), int(rng.integers(40, 100))
        found = plan(jnp.asarray(home), push.actions.encode(jnp.int32(row), jnp.int32(col), jnp.int32(trial // 2 % 2)))
        nearest = math.inf
        for joints in np.asarray(found.ctrl)[::4]:
            data.qpos[ROBOT.joint_qpos_ids(mj_model)] = np.append(joints, joints[-1])
            data.qpos[tips] = -joints[-1]
            mujoco.mj_kinematics(mj_model, data)
            pairs = [(wall, geom) for wall in walls for geom in geoms]
            nearest = min(nearest, *(mujoco.mj_geomDistance(mj_model, data, *pair, 0.05, None) for pair in pairs))
        code = OBSTRUCTIONS[int(found.obstruction)]
        if code in ("none", "wall"):
            # Commands lead the motion by the feed-forward, a few mm at full speed.
            assert nearest > (0.008 if code == "none" else -math.inf) and (code == "none" or nearest < 0.021), trial
            refused.append(code == "wall")
    assert 3 <= sum(refused) <= len(refused) - 3


def test_walls_are_seen_all_along_a_motion():
    """A post in the middle of the way of a finger, far from where it starts and ends."""
    post = Workspace(name="post", walls=(Box(center=(0.0, 0.3, 0.2), half_size=(0.005, 0.005, 0.2)),))
    poses = np.zeros((400, 7), np.float32)
    poses[:, 0], poses[:, 2], poses[:, 3] = -0.1 + 0.2 * np.clip(np.linspace(-1, 2, 400), 0, 1), 0.1, 1.0
    finger = ROBOT.links.geoms[-1]

    def matrices(joint_pos: jax.Array) -> jax.Array:
        one = jnp.eye(4).at[:3, 3].set(jnp.array([0.0, 0.3, 0.1]) + joint_pos * jnp.array([1.0, 0.0, 0.0]))
        return jnp.broadcast_to(one, (len(ROBOT.links.names), 4, 4))

    links: Any = SimpleNamespace(matrices=matrices)

    @jax.jit
    def measured(path: jax.Array) -> tuple[jax.Array, jax.Array]:
        near = clearance.near_walls(links, (finger,), path, jnp.asarray(poses), jnp.zeros(len(path)), post)
        return near, jax.vmap(lambda q: clearance.distance_to_walls(links, (finger,), q, post))(path)

    near, distances = map(np.asarray, measured(jnp.asarray(poses[:, :1])))
    assert near.any() and not near[0] and not near[-1]
    # Of 133 rows that move, every sixth or so is measured, and counts for those before it.
    first, truly = np.flatnonzero(near)[0], np.flatnonzero(distances < clearance.CLEARANCE_MARGIN)[0]
    assert abs(first - truly) <= 133 / (clearance.CHECKED_POSES - 1) + 1


def test_the_lift_keeps_clear_of_walls_too():
    """A board above the hand is far enough from where the arm stands, and in the way of what it lifts."""
    board = Workspace(name="board", walls=(Box(center=(-0.25, 0.0, 0.33), half_size=(0.05, 0.3, 0.01)),))
    hand = jax.tree.map(jnp.asarray, ROBOT.start)
    state: Any = SimpleNamespace(hand=hand, physics_obs=SimpleNamespace(joint_pos=jnp.asarray(ROBOT.home)))
    plan = jax.jit(lambda place: plan_grasp(ROBOT, place, state).obstruction, static_argnums=0)
    assert float(jax.jit(lambda q: ROBOT.clearance(q, board))(ROBOT.home)) > clearance.CLEARANCE_MARGIN
    assert [OBSTRUCTIONS[int(plan(place))] for place in (SHELF, board)] == ["none", "wall"]


def test_fingers_that_will_close_on_the_target_need_no_room_to_close_all_the_way():
    """Closed they reach 34 mm farther ahead: into the back wall."""
    hand = ROBOT.start.replace(xy=jnp.array([0.22, 0.0]))
    pose = jnp.array([*hand.xy, hand.z, 1.0, 0.0, 0.0, 0.0])
    branches = jax.jit(lambda pose: hand_inverse_kinematics(arm(), pose))(pose)
    posture = branches[jnp.argmin(jnp.linalg.norm(branches - ROBOT.home[None, :6], axis=1))]

    def clear(aperture):
        joints = jnp.concatenate([posture, jnp.full(2, aperture)])
        return float(jax.jit(lambda q: ROBOT.clearance(q, SHELF))(joints)) > clearance.CLEARANCE_MARGIN

    assert clear(hand.aperture) and not clear(ROBOT.grasp_aperture)
    state: Any = SimpleNamespace(hand=hand, physics_obs=SimpleNamespace(joint_pos=jnp.append(posture, jnp.zeros(2))))
    plan = jax.jit(lambda: plan_grasp(ROBOT, SHELF, state))()
    assert OBSTRUCTIONS[int(plan.obstruction)] == "none"
    assert float(plan.ctrl[0, 6]) == pytest.approx(ROBOT.grasp_aperture), "they are told to close all the same"


# -- Rules


@pytest.mark.parametrize(
    ("workspace", "value", "jammed"), [(SHELF, 0.0, True), (SHELF, np.nan, False), (TABLE, 0.0, False)]
)
def test_objects_pressed_against_walls_are_no_error_of_the_physics(workspace, value, jammed):
    seen: Any = SimpleNamespace(diverged=jnp.array(True), object_poses=jnp.full((8, 7), value), joint_pos=jnp.zeros(8))
    assert bool(_jammed(workspace, seen)) is jammed
    seen.diverged = jnp.array(False)
    assert not _jammed(workspace, seen)


# -- What is refused


def scenes_up_to(radius: float) -> Any:
    poses = np.zeros((2, 8, 7), np.float32)
    poses[1, 3, :2], poses[0, 5, :2] = (0.6 * radius, -0.8 * radius), (9.0, 9.0)
    object_ids = np.zeros((2, 8), np.int32)
    object_ids[0, 5] = -1
    return SimpleNamespace(poses=poses, object_ids=object_ids, split="test")


def test_scenes_that_do_not_fit_a_place_under_every_yaw_are_refused():
    narrow = get_workspace("narrow", {"half_width": 0.2})
    refuse_scenes(narrow, scenes_up_to(0.199))
    refuse_scenes(SHELF, scenes_up_to(0.24))
    line = r"'narrow': objects leave 0\.2 m from the centre, but in test scenes they stand up to 0\.201 m from it"
    with pytest.raises(ValueError, match=line):
        refuse_scenes(narrow, scenes_up_to(0.201))


def test_a_place_in_which_no_push_can_be_executed_is_refused():
    gate = tuple(Box(center=(-0.33, y, 0.2), half_size=(0.05, 0.01, 0.2)) for y in (-0.19, 0.19))
    place = Workspace(name="gate", walls=(*gate, Box(center=(-0.2, 0.25, 0.2), half_size=(0.02, 0.05, 0.2))))
    refuse_blocked(ROBOT, SHELF, push_in(SHELF), mirrored=True)
    blocked = dataclasses.replace(
        place, walls=(*place.walls, Box(center=(-0.205, 0.0, 0.2), half_size=(0.005, 0.2, 0.2)))
    )
    with pytest.raises(ValueError, match=r"workspace 'gate': none of \d+ pushes from the start pose .* \(wall \d+"):
        refuse_blocked(ROBOT, blocked, push_in(blocked), mirrored=True)


def test_pushes_with_the_open_hand_are_tried_too():
    """Closed fingers are longer: of the shares of the radii alone an even stride would meet closed ones only."""
    tried: list[int] = []
    push = push_in(SHELF)

    def decode(hand: Any, action: jax.Array) -> Any:
        jax.debug.callback(lambda a: tried.append(int(a)), action)
        return push.decode(hand, action)

    refuse_blocked(ROBOT, SHELF, dataclasses.replace(push, decode=decode), mirrored=False)
    jax.effects_barrier()
    choices = np.array(tried) % push.actions.shape[-1]
    assert len(tried) == 64 and 16 < choices.sum() < 48


def test_a_place_that_only_the_mirrored_arm_is_stuck_in_is_refused_if_it_starts_there():
    walls = tuple(Box(center=(x, y, 0.3), half_size=(0.02, 0.01, 0.3)) for x, y in ((-0.55, 0.12), (-0.2, -0.2)))
    place = Workspace(name="left", walls=walls)
    refuse_blocked(ROBOT, place, push_in(place), mirrored=False)
    line = r"'left': none of \d+ pushes from the mirrored start pose .*, or --task.mirrored-start False$"
    with pytest.raises(ValueError, match=line):
        refuse_blocked(ROBOT, place, push_in(place), mirrored=True)


def push_in(workspace: Workspace) -> Primitive:
    return make_push(ROBOT, workspace, TaskConfig(), max_distance=0.2)


def env_in(workspace: Workspace, robot: Robot = ROBOT, **task: Any) -> Env:
    """An environment of which only robot and place are asked."""
    nothing: Any = None
    names = ("primitive", "rules", "bank", "eligible", "scenes", "engine")
    rest: dict[str, Any] = dict.fromkeys(names, nothing)
    return Env(task=TaskConfig(**task), workspace=workspace, robot=robot, max_distance=0.2, **rest)


def test_mirror_images_that_are_no_scenes_are_not_learned_from():
    mirrored = Config(network=NetworkConfig(mirror=True))
    one_sided = Workspace(name="side", walls=SHELF.walls[:2])
    for env in (env_in(TABLE), env_in(TABLE, mirrored_start=False), env_in(SHELF)):
        refuse_mirror(mirrored, env)
    with pytest.raises(
        ValueError, match=r"network\.mirror = True in workspace 'side': it is not its own mirror image;"
    ):
        refuse_mirror(mirrored, env_in(one_sided))
    posture = (
        r"'shelf': robot ur5e_rg2 starts in one posture .*mirrored_start = False\); allowed is False, also with --i"
    )
    with pytest.raises(ValueError, match=posture):
        refuse_mirror(mirrored, env_in(SHELF, mirrored_start=False))
    with pytest.raises(ValueError, match="starts in one posture"):
        refuse_mirror(mirrored, env_in(SHELF, robot=dataclasses.replace(ROBOT, mirrored_home=None)))
    refuse_mirror(Config(), env_in(one_sided))


@pytest.mark.parametrize(
    ("workspace", "mirrored_start", "y", "mirrored"),
    [(SHELF, True, -0.01, True), (SHELF, True, 0.01, False), (SHELF, False, -0.01, False), (TABLE, True, -0.01, False)],
)
def test_between_walls_the_arm_starts_on_the_roomier_side(workspace, mirrored_start, y, mirrored):
    poses = jnp.zeros((8, 7)).at[:, 1].set(0.1 if y < 0 else -0.1).at[2, 1].set(y)
    scene: Any = SimpleNamespace(poses=poses, target=jnp.int32(2))
    assert bool(env_in(workspace, mirrored_start=mirrored_start)._starts_mirrored(scene)) is mirrored
