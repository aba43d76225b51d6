"""Rebuilt objects in the slots: the written model against one compiled with the very same hulls."""

# Host arrays stand for device arrays here, and every shape is known.
# pyright: reportArgumentType=false, reportOptionalMemberAccess=false

import jax
import mujoco
import numpy as np
import pytest

from pregrasp_jax.physics import native
from pregrasp_jax.planning import simulation
from pregrasp_jax.planning.solids import Frustums, directions, hull_bank
from pregrasp_jax.robot import get_robot
from pregrasp_jax.scene.model import make_slot_model, parking_poses, write_slots
from pregrasp_jax.spaces.workspace import TABLE
from pregrasp_jax.types import MAX_HULLS, MAX_OBJECTS, HullBank

ROBOT = get_robot("ur5e_rg2")


def random_bank(seed: int, *, variants: int = 1) -> HullBank:
    """Two towers per variant of one to three elliptic frustums; the other slots are empty."""
    rng = np.random.default_rng(seed)
    count = variants * MAX_OBJECTS
    x, y = directions(np.float64(0.0)).T
    axes = rng.uniform(0.025, 0.04, (2, count, MAX_HULLS, 1))
    bottom = np.hypot(axes[0] * x, axes[1] * y)
    support = np.stack([bottom, rng.uniform(0.7, 1.0, (count, MAX_HULLS, 1)) * bottom], axis=2)
    levels = 0.06 * np.arange(MAX_HULLS + 1)
    height = np.broadcast_to(np.stack([levels[:-1], levels[1:]], axis=1), (count, MAX_HULLS, 2))
    present = np.arange(MAX_HULLS) < rng.integers(1, 4, (count, 1))
    solids = Frustums(support, height, np.repeat(rng.uniform(0, 0.39, (count, 1)), MAX_HULLS, axis=1), present)
    bank = hull_bank(solids, density=rng.uniform(200, 400, count), friction=np.full(count, 0.25))
    standing = np.arange(count) % MAX_OBJECTS < 2
    return bank.replace(object_hulls=np.where(standing[:, None], bank.object_hulls, -1))


def fall(simulations: native.Simulations, object_ids: np.ndarray) -> np.ndarray:
    """Let one tower fall on the other, beside the robot; return all poses [MAX_OBJECTS, 7]."""
    qpos = simulations.coordinates(simulations.home_states()[0])[0].copy()
    poses = parking_poses()
    poses[0] = [0.1, 0.0, 0.0005, 1, 0, 0, 0]
    poses[1] = [0.1, 0.16, 0.035, 0.966, 0.259, 0, 0]
    qpos[simulations.model.slot_qpos_ids] = poses
    engine = native.engine_of(simulations, ROBOT)
    nv = simulations.model.mj_model.nv
    state = jax.tree.map(lambda leaf: np.asarray(leaf)[None], engine.place(object_ids, np.float32(qpos), np.zeros(nv)))
    ctrl = np.tile(np.append(ROBOT.home[:6], 1.2).astype(np.float32), (1, 40, 1))
    assert engine.advance is not None
    after = engine.advance(state, ctrl, np.array([40]))
    assert not after.diverged.any()
    return after.object_poses[0]


def two_towers(simulations: native.Simulations) -> np.ndarray:
    """A state [nstate] in which one tower leans toward the other."""
    state, poses = simulations.home_states()[0], parking_poses()
    poses[:2] = [[0.1, 0, 0.0005, 1, 0, 0, 0], [0.1, 0.16, 0.035, 0.966, 0.259, 0, 0]]
    simulations.coordinates(state)[0][simulations.model.slot_qpos_ids] = poses
    return state


@pytest.fixture(scope="module")
def simulations() -> simulation.Simulations:
    return simulation.make_simulations(ROBOT, TABLE, num_variants=2, threads=1)


def depths(model: mujoco.MjModel, poses: np.ndarray) -> dict[tuple[str, str], float]:
    """Return the deepest contact, m, of every pair of bodies, with the objects at poses [MAX_OBJECTS, 7]."""
    data = mujoco.MjData(model)
    slots = [model.joint(f"slot_{slot}").qposadr[0] for slot in range(MAX_OBJECTS)]
    for start, pose in zip(slots, poses, strict=True):
        data.qpos[start : start + 7] = pose
    mujoco.mj_forward(model, data)
    found: dict[tuple[str, str], float] = {}
    for contact in data.contact[: data.ncon]:
        pair = tuple(model.body(model.geom_bodyid[geom]).name for geom in (contact.geom1, contact.geom2))
        found[pair] = min(found.get(pair, 1.0), contact.dist)
    return {pair: depth for pair, depth in found.items() if "slot" in pair[1]}


@pytest.mark.parametrize("seed", [0, 1])
def test_written_objects_touch_as_compiled_ones_do(simulations: simulation.Simulations, seed: int):
    bank, rng, pairs = random_bank(seed, variants=2), np.random.default_rng(seed), 0
    simulations.write(bank)
    filled = bank.replace(object_hulls=np.where(bank.object_hulls[:, :1] < 0, 0, bank.object_hulls))
    reference = make_slot_model(native.native_spec(ROBOT, TABLE), filled)
    for variant in range(2):
        ids = np.where(np.arange(MAX_OBJECTS) < 2, np.arange(MAX_OBJECTS) + variant * MAX_OBJECTS, -1)
        write_slots(reference, reference.mj_model, ids)
        written = simulations.model_of(variant)
        for name in ("body_mass", "body_inertia", "body_ipos", "dof_invweight0"):
            rows = (reference.slot_dof_ids if name.startswith("dof") else reference.slot_body_ids)[:2]
            found, wanted = (getattr(model, name)[rows] for model in (written, reference.mj_model))
            np.testing.assert_allclose(found, wanted, rtol=1e-5, atol=1e-9, err_msg=name)
        for _ in range(10):
            poses = parking_poses()
            quats = rng.standard_normal((2, 4)) * [1, 0.1, 0.1, 1]
            poses[:2, 3:] = quats / np.linalg.norm(quats, axis=1, keepdims=True)
            poses[0, :3], poses[1, :3] = [0.1, 0, rng.uniform(0, 0.01)], [0.1, rng.uniform(0.05, 0.07), 0.0]
            found, wanted = (depths(model, poses) for model in (written, reference.mj_model))
            assert found.keys() == wanted.keys()
            for pair, depth in wanted.items():  # what is deep has more than one way out
                assert found[pair] == pytest.approx(depth, abs=2e-5) or min(depth, found[pair]) < -5e-3
            pairs += ("slot_0", "slot_1") in found
    assert pairs > 5


def test_every_simulation_runs_on_the_variant_of_its_objects(simulations: simulation.Simulations):
    simulations.write(random_bank(0, variants=2))
    rows = [np.where(np.arange(MAX_OBJECTS) < 2, np.arange(MAX_OBJECTS) + v * MAX_OBJECTS, -1) for v in (1, 0)]
    one, other = (fall(simulations, row.astype(np.int32)) for row in rows)
    assert np.abs(one[:2] - other[:2]).max() > 1e-3


@pytest.mark.parametrize("threads", [1, 3])
def test_a_push_ends_as_it_does_alone_whoever_takes_it(threads: int):
    """Seven falls of unlike length in two variants, and one scene that stands still."""
    many = simulation.make_simulations(ROBOT, TABLE, num_variants=2, at_once=2, threads=threads)
    alone = simulation.make_simulations(ROBOT, TABLE, num_variants=2, threads=1)
    for simulations in (many, alone):
        simulations.write(random_bank(0, variants=2))
    start = two_towers(alone)
    rows = np.array([20, 5, 0, 12, 18, 1, 8, 16])
    ids = np.where(np.arange(MAX_OBJECTS) < 2, np.arange(MAX_OBJECTS) + np.arange(8)[:, None] % 2 * MAX_OBJECTS, -1)
    ctrl = np.tile(np.append(ROBOT.home[:6], 1.2), (8, 20, 1))
    states = np.tile(start, (8, 1))
    runs = [many.run(states, ids, ctrl, rows) for _ in range(2)]  # nothing is left of the first
    for scene in range(8):
        one = slice(scene, scene + 1)
        by_itself = alone.run(states[one], ids[one], ctrl[one], rows[one])
        for together in runs:
            for found, wanted in zip(together, by_itself, strict=True):
                np.testing.assert_array_equal(found[one], wanted)
    ends = runs[0][0]
    np.testing.assert_array_equal(ends[2], start)
    assert len({end.tobytes() for end in ends}) == 8, "variants and lengths differ"


def test_a_push_that_goes_wrong_spoils_no_other(simulations: simulation.Simulations):
    simulations.write(random_bank(0, variants=2))
    states = np.tile(two_towers(simulations), (2, 1))
    simulations.coordinates(states)[1][0, simulations.model.slot_dof_ids[0]] = 1e12
    ids = np.where(np.arange(MAX_OBJECTS) < 2, np.arange(MAX_OBJECTS), -1)[None].repeat(2, axis=0)
    ctrl = np.tile(np.append(ROBOT.home[:6], 1.2), (2, 5, 1))
    assert simulations.run(states, ids, ctrl, np.array([5, 5]))[1].tolist() == [True, False]


def test_an_error_takes_no_thread_with_it(simulations: simulation.Simulations, monkeypatch: pytest.MonkeyPatch):
    """Whatever a push raises is raised by `run`, and the next one runs."""
    simulations.write(random_bank(0, variants=2))
    ids = np.where(np.arange(MAX_OBJECTS) < 2, np.arange(MAX_OBJECTS), -1)[None]
    arguments = two_towers(simulations)[None], ids, np.tile(np.append(ROBOT.home[:6], 1.2), (1, 2, 1)), np.array([2])
    with monkeypatch.context() as broken:
        broken.setattr(simulations, "_roll", lambda *_: 1 / 0)
        with pytest.raises(ZeroDivisionError):
            simulations.run(*arguments)
    assert simulations._free.qsize() == 1
    assert not simulations.run(*arguments)[1].any()


def test_an_empty_slot_touches_nothing(simulations: simulation.Simulations):
    simulations.write(random_bank(0, variants=2))
    ids = np.where(np.arange(MAX_OBJECTS) < 2, np.arange(MAX_OBJECTS), -1).astype(np.int32)
    np.testing.assert_allclose(fall(simulations, ids)[2:, :3], parking_poses()[2:, :3], atol=1e-6)


def test_finger_tips_stand_where_their_drivers_want_them(simulations: simulation.Simulations):
    """The closed hand of a scene equals one that has closed by itself."""
    model = simulations.model.mj_model
    joint_pos = ROBOT.home.copy()
    joint_pos[6:] = 0.3
    poses = np.broadcast_to(parking_poses(), (1, MAX_OBJECTS, 7))
    qpos = simulations.place(poses, joint_pos)[0]
    engine = native.engine_of(simulations, ROBOT)
    ids = np.full(MAX_OBJECTS, -1, np.int32)
    state = engine.place(ids, qpos, np.zeros(model.nv))
    ctrl = np.tile(np.append(ROBOT.home[:6], 0.3).astype(np.float32), (1, 30, 1))
    batch = jax.tree.map(lambda leaf: np.asarray(leaf)[None], state)
    assert engine.advance is not None
    after = engine.advance(batch, ctrl, np.array([30]))
    settled = np.asarray(engine.coordinates(jax.tree.map(lambda leaf: leaf[0], after))[0])
    num_robot = model.nq - 7 * MAX_OBJECTS
    np.testing.assert_allclose(settled[:num_robot], qpos[:num_robot], atol=2e-3)
