"""The environment as it is: native engine, built-in objects. One batch of hand-made scenes, pushed once, tells most."""

import dataclasses
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from pregrasp_jax.assets.catalogue import builtin_bank
from pregrasp_jax.config import Config, SceneConfig
from pregrasp_jax.physics import make_engine
from pregrasp_jax.robot import get_robot
from pregrasp_jax.robot.ur5e_rg2 import FINGER_CLOSED, FINGER_OPEN
from pregrasp_jax.scene.model import hull_points, parking_poses
from pregrasp_jax.scene.spec import compile_spec, scene_spec
from pregrasp_jax.spaces.workspace import TABLE
from pregrasp_jax.task.assembly import make_env, with_task
from pregrasp_jax.task.env import Env
from pregrasp_jax.types import MAX_OBJECTS, OBSTRUCTIONS, REASONS, ROBOT_ID, SceneParams

ROBOT = get_robot("ur5e_rg2")
NAMES = builtin_bank("seen").names
CLOSED, OPEN = 0, 1
FINGERS = (FINGER_CLOSED, FINGER_OPEN)
"""Choices of a push, and the drive angle of either."""

START, PALM = np.array([-0.30, 0.0]), -0.0264
"""m: the grasp point at the start, and the palm's face relative to it (MJCF of the RG2)."""

TARGET, OBSTACLE = 2, 6
"""Slots; those around them are empty."""

SHORT = (50, 0, OPEN)
"""To x = -0.2475, y = 0.0025 m, the free cell that is nearest to the start: 0.78 s."""

TOO_LONG = (50, 60, CLOSED)
"""0.35 m, while rows are planned for 0.20 m and half a second of fingers."""


@dataclass(frozen=True)
class Case:
    """A target and an obstacle, each an object and a pose, a push, and how it must end (None: a reward left open).

    Without `execute` neither the push nor the grasp is made.
    """

    target: tuple[str, list[float]]
    obstacle: tuple[str, list[float]]
    action: tuple[int, int, int] = SHORT
    reason: str = "running"
    reward: float | None = 0.0
    execute: bool = True


def pose(x: float, y: float, z: float = 0.0, *, tilt: float = 0.0, about: float = 0.0) -> list[float]:
    """Return a pose that is turned about z by 1 rad, then tilted about the horizontal axis at angle `about`."""
    quat, lean, turn = np.zeros(4), np.zeros(4), np.zeros(4)
    mujoco.mju_axisAngle2Quat(turn, [0, 0, 1], 1.0)
    mujoco.mju_axisAngle2Quat(lean, [np.cos(about), np.sin(about), 0], tilt)
    mujoco.mju_mulQuat(quat, lean, turn)
    return [x, y, z, *quat]


def falling(x: float, y: float, tilt: float, about: float = 0.0) -> list[float]:
    """Start 4 m up: 0.78 s later the object is still 1 m above the table, and what falls freely keeps its tilt."""
    return pose(x, y, 4.0, tilt=tilt, about=about)


def closer_by(gain: float) -> list[float]:
    """Return where an object, out of the way, sees the grasp point come nearer by `gain` m in the push to `SIDEWAYS`.

    Points of equal difference of distances are a hyperbola with start and end of the push as foci.
    """
    end = np.array([-0.2475, 0.1025])
    along = (end - START) / np.linalg.norm(end - START)
    a, c, t = gain / 2, np.linalg.norm(end - START) / 2, 0.3
    point = (START + end) / 2 + along * a * np.sqrt(1 + t**2 / (c**2 - a**2)) + t * np.array([along[1], -along[0]])
    return pose(*point)


SIDEWAYS = (70, 0, OPEN)
BOTTLE = ("ycb_mustard_bottle", pose(0.1, -0.15))
BLOCK = ("ycb_wood_block", pose(0.0, 0.18))
CAN_AT_PALM = ("kit_salt_cylinder", pose(START[0] + PALM + 0.001 + 0.039, 0.0))
"""A cylinder of 78 mm, 1 mm from the palm."""

CASES = {
    "towards the target": Case(BOTTLE, BLOCK, reward=0.5),
    "with a closed hand": Case(BOTTLE, BLOCK, (50, 0, CLOSED), reward=0.5),
    "1.4 mm nearer": Case(("ycb_mustard_bottle", closer_by(0.0014)), BLOCK, SIDEWAYS, reward=0.5),
    "0.6 mm nearer": Case(("ycb_mustard_bottle", closer_by(0.0006)), BLOCK, SIDEWAYS),
    "away": Case(("ycb_mustard_bottle", closer_by(-0.01)), BLOCK, SIDEWAYS),
    "too long": Case(BOTTLE, BLOCK, TOO_LONG, "unreachable"),
    "too long, and below the table": Case(("ycb_mustard_bottle", pose(0.1, 0, -0.16)), BLOCK, TOO_LONG, "unreachable"),
    "not executed": Case(CAN_AT_PALM, BLOCK, reason="unreachable", execute=False),
    "target beyond the edge": Case(("ycb_mustard_bottle", pose(0.1, -0.26)), BLOCK, reason="off_table"),
    "obstacle beyond the edge": Case(BOTTLE, ("ycb_wood_block", pose(0.26, 0.1)), reason="off_table"),
    "both just inside": Case(("ycb_mustard_bottle", pose(0.1, -0.24)), ("ycb_wood_block", pose(0.24, 0.1)), reward=0.5),
    # Centre of mass 0.126 m up: a tilt of 0.6 rad moves it by 0.071 m.
    "only the base inside": Case(BOTTLE, ("ycb_chips_can", falling(0.1, 0.2, -0.6)), reason="off_table"),
    "only the base outside": Case(BOTTLE, ("ycb_chips_can", falling(0.1, 0.27, 0.6)), reward=0.5),
    "target tilted by 0.71": Case(("ycb_mustard_bottle", falling(0.1, -0.1, 0.71)), BLOCK, reason="target_toppled"),
    "target tilted by 0.69": Case(("ycb_mustard_bottle", falling(0.1, -0.1, 0.69)), BLOCK, reward=0.5),
    "target tilted by 0.71 another way": Case(
        ("ycb_mustard_bottle", falling(0.1, -0.1, 0.71, 2.0)), BLOCK, reason="target_toppled"
    ),
    "obstacle tilted by 0.71": Case(BOTTLE, ("ycb_wood_block", falling(0.0, 0.1, 0.71)), reward=0.5),
    "target at the palm": Case(CAN_AT_PALM, BLOCK, reason="target_in_region", reward=2.0),
    "target between the fingers after the push": Case(
        ("kit_salt_cylinder", pose(CAN_AT_PALM[1][0] + 0.054, 0.0)), BLOCK, reason="target_in_region", reward=2.0
    ),
    "obstacle at the palm": Case(BOTTLE, CAN_AT_PALM, reason="obstacle_in_region"),
    # The fingers squeeze the can about 1 mm nearer to the palm, so that this reward is left open.
    "target at the palm of a closing hand": Case(CAN_AT_PALM, BLOCK, (50, 0, CLOSED), reward=None),
    "nan": Case(("ycb_mustard_bottle", [np.nan, *BOTTLE[1][1:]]), BLOCK, reason="nan"),
}


def make_scene(case: Case) -> SceneParams:
    object_ids, poses = np.full(MAX_OBJECTS, -1, np.int32), parking_poses()
    for slot, (name, where) in ((TARGET, case.target), (OBSTACLE, case.obstacle)):
        object_ids[slot], poses[slot] = NAMES.index(name), where
    return SceneParams(jnp.asarray(object_ids), jnp.asarray(poses, jnp.float32), jnp.int32(TARGET))


def encode(row: int, col: int, aperture: int) -> int:
    return 2 * (100 * row + col) + aperture


def stack(trees: list[Any]) -> Any:
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *trees)


def unstack(tree: Any, names: Iterable[Any]) -> dict[Any, Any]:
    host = jax.tree.map(np.asarray, tree)
    return {name: jax.tree.map(lambda leaf, i=i: leaf[i], host) for i, name in enumerate(names)}


@dataclass
class Pushes:
    """All cases before and after their push."""

    batch: Any
    before: dict[str, Any]
    after: dict[str, Any]
    result: dict[str, Any]
    step: Any
    traces: list[str]


def executed(cases: dict[str, Case]) -> jax.Array:
    return jnp.array([case.execute for case in cases.values()])


def push_all(env: Env, cases: dict[str, Case]) -> Pushes:
    traces = []

    def step(state, action, execute):
        traces.append("step")
        return env.step(state, action, execute=execute)

    jitted = jax.jit(jax.vmap(step))
    before = jax.jit(jax.vmap(env.start))(stack([make_scene(case) for case in cases.values()]))
    actions = jnp.array([encode(*case.action) for case in cases.values()])
    after, result = jitted(before, actions, executed(cases))
    return Pushes(
        after, unstack(before, cases), unstack(after, cases), unstack(result, cases), step=jitted, traces=traces
    )


@pytest.fixture(scope="module")
def env() -> Env:
    return make_env(Config(scene=SceneConfig(test_scenes=3)), split="test")


@pytest.fixture(scope="module")
def pushes(env) -> Pushes:
    return push_all(env, CASES)


@pytest.mark.parametrize("name", CASES)
def test_how_a_push_ends(pushes, name):
    result, case = pushes.result[name], CASES[name]
    assert REASONS[result.reason] == case.reason
    assert case.reward is None or result.reward == case.reward
    assert result.terminated == (case.reason != "running") and not result.truncated


@pytest.mark.parametrize("name", [name for name in CASES if name != "nan"])
def test_what_is_measured_agrees_with_mujoco_and_numpy(env, pushes, name):
    before, after, outcome = pushes.before[name], pushes.after[name], pushes.result[name].outcome
    for slot in (TARGET, OBSTACLE):
        centroids, up = [], np.zeros(9)
        for state in (before, after):
            seen, centroid = state.physics_obs.object_poses[slot].astype(np.float64), np.zeros(3)
            mujoco.mju_rotVecQuat(
                centroid, np.asarray(env.bank.com[state.scene.object_ids[slot]], np.float64), seen[3:]
            )
            centroids.append(centroid + seen[:3])
            np.testing.assert_allclose(state.centroids[slot], centroids[-1], atol=1e-6)
            mujoco.mju_quat2Mat(up, seen[3:])
        start, (*end_xy, end_z) = centroids[0][:2], centroids[1]
        assert outcome.off_table[slot] == (np.abs(end_xy).max() > 0.25 or end_z < 0)
        assert outcome.toppled[slot] == (np.arccos(min(up[8], 1.0)) > 0.7)
        np.testing.assert_allclose(outcome.distance_before[slot], np.linalg.norm(start - START), atol=1e-5)
        row, col, _ = CASES[name].action
        end = np.array([-0.25 + 0.005 * (col + 0.5), -0.25 + 0.005 * (row + 0.5)])
        if outcome.unreachable:
            end = START
        np.testing.assert_allclose(outcome.distance_after[slot], np.linalg.norm(np.subtract(end_xy, end)), atol=3e-4)
    empty = np.delete(np.arange(MAX_OBJECTS), [TARGET, OBSTACLE])
    assert not outcome.toppled[empty].any() and not outcome.off_table[empty].any() and not outcome.coverage[empty].any()


def test_a_push_moves_hand_and_fingers_to_where_it_was_told(pushes):
    for name, fingers in (("towards the target", FINGER_OPEN), ("with a closed hand", FINGER_CLOSED)):
        after = pushes.after[name]
        np.testing.assert_allclose(after.physics_obs.hand_pose[:3], [-0.2475, 0.0025, 0.1], atol=5e-4)
        np.testing.assert_allclose(after.physics_obs.joint_pos[6:], fingers, atol=0.01)
        np.testing.assert_allclose(after.hand.xy, [-0.2475, 0.0025], atol=1e-6)
        np.testing.assert_allclose(after.hand.aperture, FINGERS[CASES[name].action[2]], atol=1e-6)
        assert after.num_pushes == 1 and after.hand.z == np.float32(0.1) and after.hand.yaw == 0
    assert abs(FINGER_OPEN - FINGER_CLOSED) > 0.3


def test_only_an_open_hand_has_a_closing_region(pushes):
    open_hand = pushes.result["target at the palm"].outcome.coverage
    assert open_hand[TARGET] > 0.95 and open_hand[OBSTACLE] == 0
    assert pushes.result["obstacle at the palm"].outcome.coverage[OBSTACLE] > 0.95
    closing = pushes.result["target at the palm of a closing hand"]
    assert closing.outcome.aperture == FINGER_CLOSED and closing.outcome.coverage[TARGET] > 0.95
    assert REASONS[closing.reason] == "running", "coverage is measured, and there is no region"


@pytest.mark.parametrize("name", ["too long", "not executed"])
def test_a_push_that_is_not_made_changes_nothing(pushes, name):
    before, after = pushes.before[name], pushes.after[name]
    jax.tree.map(np.testing.assert_array_equal, before, after)
    outcome = pushes.result[name].outcome
    assert outcome.unreachable and pushes.result[name].seconds == 0
    assert OBSTRUCTIONS[outcome.obstruction] == {"too long": "too_long", "not executed": "no_ik"}[name]
    np.testing.assert_array_equal(outcome.distance_before, outcome.distance_after)
    assert pushes.result["too long, and below the table"].outcome.off_table.any()


def test_a_diverged_scene_harms_no_other(pushes):
    diverged = [name for name in CASES if pushes.result[name].outcome.diverged]
    assert diverged == ["nan"]
    for name in CASES.keys() - {"nan"}:
        for leaf in jax.tree.leaves((pushes.after[name], pushes.result[name])):
            assert np.isfinite(leaf).all(), name


def test_pushes_follow_one_another_in_one_trace(pushes):
    """The second push starts where the first one ended; whatever the actions, the step is traced once."""
    actions = jnp.array([encode(50, 10, OPEN)] * len(CASES))
    state, result = pushes.step(pushes.batch, actions, jnp.ones(len(CASES), bool))
    again, result = unstack(state, CASES), unstack(result, CASES)
    for name in ("towards the target", "with a closed hand"):
        np.testing.assert_allclose(again[name].physics_obs.hand_pose[:2], [-0.1975, 0.0025], atol=5e-4)
        np.testing.assert_allclose(again[name].physics_obs.joint_pos[6:], FINGER_OPEN, atol=0.01)
        assert again[name].num_pushes == 2 and again[name].hand.aperture == np.float32(FINGER_OPEN)
        np.testing.assert_array_equal(result[name].outcome.distance_before, pushes.result[name].outcome.distance_after)
    assert again["too long"].num_pushes == again["not executed"].num_pushes == 1, "the first was not executed"
    assert REASONS[result["nan"].reason] == "nan"
    assert pushes.traces == ["step"]


def test_grasp_holds_the_target_between_the_fingers_and_nothing_else(env, pushes):
    """A target that was thrown is 6 m above the table by then, higher than a grasped one is lifted."""
    states = [pushes.before[name] for name in CASES]
    thrown = pushes.before["towards the target"]
    qpos, qvel = env.engine.coordinates(thrown.physics)
    upwards = qvel.at[10 + 6 * TARGET + 2].set(40.0)
    physics = env.engine.place(thrown.scene.object_ids, qpos, upwards)
    states[list(CASES).index("too long, and below the table")] = thrown.replace(physics=physics)
    before = stack(states)
    grasp = jax.vmap(lambda state, execute: env.grasp(state, execute=execute))
    results = jax.jit(grasp)(before, executed(CASES))
    dropped = {name for name, case in CASES.items() if 4.0 in (case.target[1][2], case.obstacle[1][2])}  # they hit hard
    diverged = {name for name, did in unstack(results.diverged, CASES).items() if did}
    assert {"nan"} <= diverged <= {"nan"} | dropped
    held = unstack(results.held, CASES)
    del held["target between the fingers after the push"]  # at the tips, where a round can is held by luck
    expected = {name: CASES[name].target == CAN_AT_PALM and CASES[name].execute for name in held}
    assert held == expected and sum(expected.values()) == 2


def test_a_grasp_is_tried_where_something_is_enclosed_and_a_target_that_slips_is_no_success(env, pushes):
    results = stack([pushes.result[name] for name in CASES])
    plan = jax.jit(jax.vmap(env.plan_trial))(pushes.batch, results)
    enclosed = [name for name in CASES if CASES[name].reason in ("target_in_region", "obstacle_in_region")]
    assert [name for name, moves in zip(CASES, np.asarray(plan.num_ctrl) > 0, strict=True) if moves] == enclosed
    lifted = jax.jit(jax.vmap(env.engine.run))(pushes.batch.physics, plan.ctrl, plan.num_ctrl)
    judge = jax.jit(jax.vmap(env.conclude_trial))
    tried, dropped = (
        unstack(judge(pushes.batch, results, physics), CASES) for physics in (lifted, pushes.batch.physics)
    )
    for name, case in CASES.items():
        if name == "target between the fingers after the push":
            continue  # at the tips, where a round can is held by luck
        assert REASONS[tried[name].reason] == case.reason and tried[name].reward == pushes.result[name].reward
        assert tried[name].outcome.slipped.any() == (name in enclosed), "at least the objects that are not enclosed"
        slips = case.reason == "target_in_region"
        assert REASONS[dropped[name].reason] == ("grasp_failed" if slips else case.reason)
        assert dropped[name].reward == (0.0 if slips else pushes.result[name].reward)
    assert not tried["target at the palm"].outcome.slipped[TARGET]
    assert not tried["obstacle at the palm"].outcome.slipped[OBSTACLE], "so that hindsight takes it for a success"


def test_a_case_is_seen_where_mujoco_sees_it(env, pushes):
    """Rays from above on the MJCF's robot and the objects; capsules and polyhedra differ at the robot's outline."""
    state = pushes.after["towards the target"]
    spec = scene_spec(ROBOT, TABLE)
    for slot in (TARGET, OBSTACLE):
        body = spec.worldbody.add_body(name=f"slot_{slot}")
        body.add_freejoint()
        for hull in np.asarray(env.bank.object_hulls[state.scene.object_ids[slot]]):
            if hull >= 0:
                spec.add_mesh(name=f"hull_{hull}").uservert = hull_points(env.bank, hull).ravel()
                body.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname=f"hull_{hull}")
    mj_model = compile_spec(spec)
    data = mujoco.MjData(mj_model)
    ROBOT.set_home(mj_model, data)
    data.qpos[ROBOT.joint_qpos_ids(mj_model)] = state.physics_obs.joint_pos
    labels = np.full(mj_model.nbody, ROBOT_ID)
    labels[0] = 0
    for slot in (TARGET, OBSTACLE):
        body = mj_model.body(f"slot_{slot}")
        labels[body.id] = slot + 1
        address = mj_model.jnt_qposadr[body.jntadr[0]]
        data.qpos[address : address + 7] = state.physics_obs.object_poses[slot]
    mujoco.mj_kinematics(mj_model, data)
    expected, geom = np.zeros((100, 100), int), np.zeros(1, np.int32)
    for row in range(100):
        for col in range(100):
            above = [-0.25 + 0.005 * (col + 0.5), -0.25 + 0.005 * (row + 0.5), 2.0]
            mujoco.mj_ray(mj_model, data, above, [0, 0, -1], None, 1, -1, geom)
            expected[row, col] = labels[mj_model.geom_bodyid[geom[0]]]
    seen = state.obs.instance_ids
    assert set(np.unique(expected)) == {0, TARGET + 1, OBSTACLE + 1, ROBOT_ID}
    of_robot = (seen == ROBOT_ID) | (expected == ROBOT_ID)
    assert (seen == expected)[~of_robot].mean() > 0.999 and (seen == expected).mean() > 0.99
    assert seen[20, 70] == TARGET + 1 and seen[86, 50] == OBSTACLE + 1, "row is y, column is x"
    assert seen[50, 1] == 0 and seen[50, 0] == 0, "the open hand does not hide what is between its fingers"


OTHER_CASES = {
    "truncated": Case(BOTTLE, BLOCK, reason="truncated", reward=0.5),
    "success on the last push": Case(CAN_AT_PALM, BLOCK, reason="target_in_region", reward=2.0),
    "too long": Case(BOTTLE, BLOCK, (50, 99, CLOSED), "unreachable"),
    "nowhere to go": Case(BOTTLE, BLOCK, (50, 89, OPEN), "no_action"),
    "an obstacle beyond the edge": Case(BOTTLE, ("ycb_wood_block", pose(0.26, 0.1)), reason="truncated", reward=0.5),
    "the target beyond the edge": Case(("ycb_mustard_bottle", pose(0.1, -0.26)), BLOCK, reason="off_table"),
    "stopped": Case(("ycb_master_chef_can", pose(START[0] + PALM + 0.053, 0.0)), BLOCK, reason="unreachable"),
}
"""One push only, a ring of 0.3 to 0.5 m, a pinhole camera, coffee cans of 4 tonnes, and obstacles may leave."""


@pytest.fixture(scope="module")
def other(env) -> Pushes:
    heavy = np.where(np.array(NAMES) == "ycb_master_chef_can", 1e4, 1.0).astype(np.float32)
    bank = env.bank.replace(mass=env.bank.mass * heavy, inertia=env.bank.inertia * heavy[:, None])
    env = dataclasses.replace(env, bank=bank, engine=make_engine("native", bank, ROBOT, TABLE))
    return push_all(
        with_task(env, camera="pinhole", max_pushes=1, r_in=0.3, r_out=0.5, obstacles_may_leave=True), OTHER_CASES
    )


@pytest.mark.parametrize("change", [{"workspace": "shelf"}, {"robot": "barrett"}, {"primitive": "push_grasp"}])
def test_a_task_changes_neither_the_robot_nor_the_place_of_an_engine(env, change):
    with pytest.raises(ValueError, match=r"but these scenes are of .*; allowed is `make_env`"):
        with_task(env, **change)


@pytest.mark.parametrize("name", OTHER_CASES)
def test_how_a_push_ends_under_another_task(other, name):
    result, case = other.result[name], OTHER_CASES[name]
    assert REASONS[result.reason] == case.reason
    assert result.reward == case.reward
    assert result.truncated == (case.reason == "truncated") and result.terminated != result.truncated
    assert other.after[name].num_pushes == (name != "too long")


def test_a_stopped_push_was_executed(other):
    after = other.after["stopped"]
    assert 0.01 < np.linalg.norm(after.physics_obs.hand_pose[:2] - [-0.2475, 0.0025]) < 0.06
    np.testing.assert_allclose(after.hand.xy, [-0.2475, 0.0025], atol=1e-6)
    outcome = other.result["stopped"].outcome
    assert OBSTRUCTIONS[outcome.obstruction] == "end_error" and other.result["stopped"].seconds > 0.5


def test_the_pinhole_sees_the_same_but_for_what_perspective_hides(pushes, other):
    exact, seen = pushes.after["towards the target"].obs, other.after["truncated"].obs
    assert 0.9 < (exact.instance_ids == seen.instance_ids).mean() < 1
    assert 0.9 < (np.abs(exact.height.astype(int) - seen.height) <= 2).mean() < 1
    assert set(np.unique(seen.instance_ids)) == {0, TARGET + 1, OBSTACLE + 1, ROBOT_ID}


def test_action_mask_is_the_ring_of_the_task(env):
    for task, ends in ((env, (0.04, 0.2)), (with_task(env, r_in=0.1, r_out=0.2, full_ring=True), (0.1, 0.2))):
        mask = np.asarray(task.action_mask(ROBOT.start.replace(xy=jnp.array([0.0025, 0.0025]))))
        np.testing.assert_array_equal(mask[..., CLOSED], mask[..., OPEN])
        rows, cols = np.nonzero(mask[..., OPEN])
        radii = 0.005 * np.hypot(rows - 50, cols - 50)
        np.testing.assert_allclose([radii.min(), radii.max()], ends, atol=1e-6)
        assert cols.min() == (50 if task is env else 10)
