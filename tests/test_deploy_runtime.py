"""The runtime without JAX: what it computes is what the package computes, and what it cannot use it refuses."""

import dataclasses
import functools
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from bundles import SMALL, small_bundle

from pregrasp_jax import heightmap
from pregrasp_jax.config import TaskConfig
from pregrasp_jax.deploy.decision import Decider, action_space, allowed_pushes, workspace_of
from pregrasp_jax.deploy.policy import load_values
from pregrasp_jax.deploy.projection import Maps, draw_robot, project, to_maps
from pregrasp_jax.geometry import rigid_inverse
from pregrasp_jax.heightmap.views import project_upward
from pregrasp_jax.robot import clearance, description, get_robot, kinematics
from pregrasp_jax.robot.following import follow
from pregrasp_jax.sensors import PointOfCell
from pregrasp_jax.spaces.workspace import TABLE, Box, Workspace
from pregrasp_jax.task.push import make_push
from pregrasp_jax.types import OBSTRUCTIONS

ROBOT = get_robot("ur5e_rg2")
WALLED = Workspace(name="walled", walls=(Box(center=(0.0, 0.32, 0.1), half_size=(0.3, 0.02, 0.1), yaw=0.1),))

DECIDE = """
import sys

class Forbidden:
    def find_spec(self, name, path=None, target=None):
        if name.split(".")[0] in ("jax", "jaxlib", "flax", "mujoco", "optax", "torch", "trimesh", "coacd"):
            raise AssertionError(f"{name} was imported")

sys.meta_path.insert(0, Forbidden())
import numpy as np
from pregrasp_jax.cli import deploy as _, export as _
from pregrasp_jax.deploy import build, calibrate, log, loop
from pregrasp_jax.deploy.bundle import read_bundle
from pregrasp_jax.deploy.cell import Cell
from pregrasp_jax.deploy.drivers import rg2, ur
from pregrasp_jax.deploy.golden import heightmap_agreement
from pregrasp_jax.deploy.projection import Maps
bundle = read_bundle(sys.argv[1])
golden = bundle.arrays("golden.npz")
print(*heightmap_agreement(bundle, golden))
decider = build.make_decider(bundle, Cell())
maps = Maps(golden["height_m"][0], golden["labels"][0], 1.0)
print(decider.decide(maps, decider.start(), np.array(bundle.contract.robot.home)).push.action, golden["action"][0])
"""


def test_nothing_of_it_imports_jax_or_mujoco():
    done = subprocess.run([sys.executable, "-c", DECIDE, small_bundle()], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    near, same, action, golden = done.stdout.split()
    assert float(near) >= 0.995 and float(same) >= 0.99 and action == golden


def random_joints(count: int) -> np.ndarray:
    return np.random.default_rng(1).uniform(-2.5, 2.5, (count, 8)).astype(np.float32)


def test_kinematics_of_numpy_are_those_of_jax():
    assert ROBOT.body
    joints, arm = random_joints(20), ROBOT.body.arm
    flange = np.stack([kinematics.forward_kinematics(SMALL.body.arm, row[:6])[-1] for row in joints])
    forward = jax.jit(jax.vmap(lambda q: kinematics.forward_kinematics(arm, q)[-1]))
    wanted = np.asarray(forward(jnp.asarray(joints[:, :6])))
    np.testing.assert_allclose(flange, wanted, atol=2e-6)
    found = kinematics.inverse_kinematics(SMALL.body.arm, flange)
    inverse = jax.jit(jax.vmap(lambda pose: kinematics.inverse_kinematics(arm, pose)))
    solved = np.asarray(inverse(jnp.asarray(flange, jnp.float32)))
    np.testing.assert_array_equal(np.isnan(found), np.isnan(solved))
    turn = np.angle(np.exp(1j * (found - solved)))
    assert np.nanmax(np.abs(turn)) < 5e-3, "float32 of jax near singular postures"
    links = jax.jit(ROBOT.links.matrices)(jnp.asarray(joints[0]))
    np.testing.assert_allclose(SMALL.body.links.matrices(joints.astype(float))[0], np.asarray(links), atol=2e-6)


def test_clearance_of_numpy_is_that_of_jax():
    joints = random_joints(12)
    for measure, geoms, rest in (
        (clearance.height_above_table, SMALL.body.above_table, ()),
        (clearance.distance_to_walls, SMALL.body.moving, (WALLED,)),
    ):
        own = measure(SMALL.body.links, geoms, joints.astype(float), *rest)
        of_jax = jax.jit(jax.vmap(lambda q, m=measure, r=rest, g=geoms: m(ROBOT.links, g, q, *r)))
        np.testing.assert_allclose(own, np.asarray(of_jax(jnp.asarray(joints))), atol=1e-5)


@pytest.mark.parametrize("place", [TABLE, WALLED], ids=lambda place: place.name)
def test_what_keeps_the_hand_from_a_path_is_the_same(place: Workspace):
    ends = [(0.1, 0.0, 0.1), (0.1, 0.26, 0.1), (0.4, 0.0, 0.1), (0.0, 0.0, 0.01), (0.9, 0.0, 0.1)]
    jitted = jax.jit(ROBOT.follow, static_argnums=3)
    for x, y, z in ends:
        poses = np.zeros((30, 7))
        share = np.linspace(0, 1, 30)[:, None]
        poses[:, :3], poses[:, 3] = np.array([-0.3, 0, 0.1]) + share * (np.array([x, y, z]) - [-0.3, 0, 0.1]), 1.0
        apertures = np.full(30, 1.2)
        found = follow(SMALL.body, np.array(ROBOT.home[:6], float), poses, apertures, place, dt=0.02)
        controls, code = jitted(
            jnp.asarray(ROBOT.home), jnp.asarray(poses, jnp.float32), jnp.asarray(apertures, jnp.float32), place
        )
        own = np.zeros(30, int)
        for name in reversed(found.holds):
            own = np.where(found.holds[name], OBSTRUCTIONS.index(name), own)
        np.testing.assert_array_equal(own, np.asarray(code))
        free, lead = own == 0, description.feed_forward()[:6]
        commanded = found.path + lead * found.velocity
        np.testing.assert_allclose(commanded[free], np.asarray(controls)[free, :6], atol=2e-3)


@functools.partial(jax.jit, static_argnames="cell")
def upward(depth: jax.Array, labels: jax.Array, *, cell: str = "max") -> tuple[jax.Array, jax.Array]:
    """Return what the package makes of a depth image; NaN is none."""
    points = heightmap.unproject(depth, heightmap.overhead_camera())
    return project_upward(jnp.nan_to_num(points), labels, jnp.isfinite(depth), cell=cell)


@pytest.mark.parametrize("cell", ["max", "second", "median"])
def test_projection_is_that_of_the_package(cell: PointOfCell):
    rng = np.random.default_rng(3)
    depth = (1.0 - rng.random(SMALL.camera.shape) * 0.3).astype(np.float32)
    depth[rng.random(depth.shape) < 0.3] = np.nan
    labels = rng.integers(0, 3, depth.shape).astype(np.uint8)
    maps = to_maps(SMALL.view.cut(depth), SMALL.view.cut(labels), view=SMALL.view, cell=cell)
    height, wanted = upward(jnp.asarray(depth), jnp.asarray(labels), cell=cell)
    off = np.abs(maps.height_m - np.asarray(height))
    assert (off <= 1e-5).mean() > 0.997, "but for pixels on the border of two cells"
    assert (maps.labels == np.asarray(wanted)).mean() > 0.997


@pytest.mark.parametrize(
    ("nearer", "label", "robot"),
    [
        (0.01, "obstacle", False),
        (0.01, "table", True),
        (0.002, "target", True),
        (-0.05, "obstacle", True),
        (0.04, "table", False),
    ],
)
def test_what_is_above_the_hand_stays_and_what_is_the_hand_becomes_it(nearer, label, robot):
    shape, joints = SMALL.view.rays.shape[1:], SMALL.golden["joint_pos"][-1]
    hand, nothing = (
        np.full(shape, np.nan, np.float32),
        np.full(shape, SMALL.bundle.contract.grid.labels["table"], np.uint8),
    )
    draw_robot(hand, nothing, view=SMALL.view, body=SMALL.body, joint_pos=joints, entry=SMALL.bundle.contract.grid)
    covered = nothing == SMALL.bundle.contract.grid.labels["robot"]
    assert covered.sum() > 1000
    depth, labels = hand - np.float32(nearer), np.full(shape, SMALL.bundle.contract.grid.labels[label], np.uint8)
    draw_robot(depth, labels, view=SMALL.view, body=SMALL.body, joint_pos=joints, entry=SMALL.bundle.contract.grid)
    assert (labels[covered] == SMALL.bundle.contract.grid.labels["robot" if robot else label]).all()
    np.testing.assert_allclose(depth[covered], hand[covered] - (0 if robot else nearer), atol=1e-6)


def test_the_robot_is_drawn_where_the_package_draws_it():
    def render(joint_pos: jax.Array) -> tuple[jax.Array, jax.Array]:
        return heightmap.render_pinhole(heightmap.robot_hulls(ROBOT, joint_pos), heightmap.overhead_camera())

    depth, ids = jax.jit(render)(jnp.asarray(SMALL.golden["joint_pos"][-1]))
    blank = np.full(SMALL.camera.shape, np.nan, np.float32)
    nothing = np.zeros(SMALL.camera.shape, np.uint8)
    joints = SMALL.golden["joint_pos"][-1]
    about = {"view": SMALL.view, "body": SMALL.body, "joint_pos": joints, "entry": SMALL.bundle.contract.grid}
    drawn = project(blank, nothing, **about)
    height, shown = upward(jnp.where(ids > 0, depth, jnp.nan), ids)
    robot, wanted = drawn.labels == SMALL.bundle.contract.grid.labels["robot"], np.asarray(shown) > 0
    assert wanted.sum() > 100 and (robot != wanted).sum() <= 0.02 * wanted.sum()
    both = robot & wanted
    assert (np.abs(drawn.height_m - np.asarray(height))[both] < 1e-3).mean() > 0.98


def test_an_object_above_the_robot_is_not_painted_over():
    joints = SMALL.golden["joint_pos"][-1]
    high = np.full(SMALL.camera.shape, 0.3, np.float32)  # 0.7 m above the table everywhere
    labels = np.full(SMALL.camera.shape, SMALL.bundle.contract.grid.labels["target"], np.uint8)
    about = {"view": SMALL.view, "body": SMALL.body, "joint_pos": joints, "entry": SMALL.bundle.contract.grid}
    maps = project(high, labels, **about)
    assert (maps.labels == SMALL.bundle.contract.grid.labels["target"]).any() and not (
        maps.labels == SMALL.bundle.contract.grid.labels["robot"]
    ).any()


@pytest.fixture(scope="module")
def decider() -> Decider:
    return Decider(
        contract=SMALL.bundle.contract,
        values=load_values(SMALL.bundle),
        body=SMALL.body,
        workspace=workspace_of(SMALL.bundle.contract),
    )


def golden_maps(index: int) -> Maps:
    return Maps(SMALL.golden["height_m"][index], SMALL.golden["labels"][index], 1.0)


def joints_of(index: int) -> np.ndarray:
    return SMALL.golden["joint_pos"][index]


def test_pushes_are_the_golden_ones(decider: Decider):
    for index in range(2):
        hand = decider.start()._replace(xy=SMALL.golden["p1_m"][index].astype(float))
        found = decider.decide(golden_maps(index), hand, joints_of(index))
        assert not found.close and found.push is not None and not found.refused
        assert found.push.action == SMALL.golden["action"][index]
        end = [*found.push.end.xy, found.push.end.z, found.push.end.yaw, found.push.end.aperture]
        np.testing.assert_allclose(end, SMALL.golden["push"][index], atol=1e-6)
        np.testing.assert_allclose(found.push.poses[-1, :2], found.push.end.xy, atol=1e-9)
        in_base = rigid_inverse(SMALL.body.arm.world_from_base) @ [*found.push.poses[-1, :3], 1.0]
        np.testing.assert_allclose(found.push.base_pose[:3], in_base[:3], atol=1e-6)


def test_allowed_pushes_are_those_of_the_primitive(decider: Decider):
    push = make_push(ROBOT, TABLE, TaskConfig(), max_distance=0.2)
    own = allowed_pushes(SMALL.bundle.contract.action, decider.start())
    np.testing.assert_array_equal(own, np.asarray(push.mask(jax.tree.map(jnp.asarray, ROBOT.start))))


def test_a_push_that_the_arm_cannot_make_is_passed_over(decider: Decider):
    best = decider.decide(golden_maps(0), decider.start(), joints_of(0)).push
    assert best is not None
    x, y = best.end.xy
    walls = (Box(center=(float(x), float(y), 0.2), half_size=(0.02, 0.06, 0.2)),)
    fenced = dataclasses.replace(decider, workspace=dataclasses.replace(TABLE, walls=walls))
    other = fenced.decide(golden_maps(0), decider.start(), joints_of(0))
    assert other.push is not None and other.push.action != best.action
    assert other.refused[0] == (best.action, "wall")
    space = action_space(SMALL.bundle.contract.action)
    tried = [action for action, _ in other.refused] + [other.push.action]
    ends, choices = space.decode(np.array(tried))
    apart = np.linalg.norm(ends[:, None] - ends, axis=-1) + (choices[:, None] != choices) + np.eye(len(tried))
    assert apart.min() > 0.02 - 1e-6, "what lies near to a refused push is not tried"
    assert other.q is not None
    left = other.allowed & ~np.any([space.near(action, 0.02) for action in tried[:-1]], axis=0)
    assert other.push.action == np.argmax(np.where(left, other.q, -np.inf)), "the best of the rest"


def test_where_the_arm_can_make_no_push_none_is_left(decider: Decider, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("pregrasp_jax.deploy.decision._obstruction", lambda _: "wall")
    found = decider.decide(golden_maps(0), decider.start(), joints_of(0))
    assert found.push is None and 20 < len(found.refused) < 400
    space = action_space(SMALL.bundle.contract.action)
    covered = np.any([space.near(action, 0.02) for action, _ in found.refused], axis=0)
    assert covered[found.allowed].all()


def test_a_value_that_is_no_number_decides_nothing(decider: Decider):
    nowhere = dataclasses.replace(decider, values=lambda *maps: np.full_like(decider.values(*maps), np.nan))
    found = nowhere.decide(golden_maps(0), decider.start(), joints_of(0))
    assert found.push is None and not found.close and not found.refused


def test_the_fingers_close_on_a_target_between_them(decider: Decider):
    pose = kinematics.grasp_pose(SMALL.body.arm, np.asarray(joints_of(0)[:6], float))
    for shift, close in ((0.0, True), (0.06, False)):
        labels = np.zeros((100, 100), np.uint8)
        row, col = int((pose[1] + 0.25 + shift) / 0.005), int((pose[0] + 0.25) / 0.005)
        maps = Maps(np.zeros((100, 100), np.float32), labels, 1.0)
        inside = slice(max(col - 2, 0), max(col + 3, 1))
        labels[row - 3 : row + 4, inside] = SMALL.bundle.contract.grid.labels["target"]
        if not (labels == SMALL.bundle.contract.grid.labels["target"]).any():
            pytest.skip("the hand is outside of the picture")
        hand = decider.start()._replace(xy=pose[:2])
        found = decider.decide(maps, hand, joints_of(0))
        assert found.close is close, (found.coverage, shift)
        closed = hand._replace(aperture=np.float64(0.0))
        assert not decider.decide(maps, closed, joints_of(0)).close, "a closed hand has no closing region"


def test_joints_that_cannot_be_are_refused(decider: Decider):
    for joints, said in (
        (np.zeros(6), "allowed are 8"),
        (np.full(8, np.nan), "NaN"),
        (np.rad2deg(joints_of(0)), "are these degrees?"),
    ):
        with pytest.raises(ValueError, match=said):
            decider.decide(golden_maps(0), decider.start(), joints)
    empty = Maps(SMALL.golden["height_m"][0], np.zeros((100, 100), np.uint8), 1.0)
    with pytest.raises(ValueError, match="no cell of the map shows the target"):
        decider.decide(empty, decider.start(), joints_of(0))
