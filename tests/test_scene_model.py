import mujoco
import numpy as np
import pytest

from pregrasp_jax.assets.catalogue import builtin_bank
from pregrasp_jax.physics import native
from pregrasp_jax.physics.native import Simulations
from pregrasp_jax.robot import get_robot
from pregrasp_jax.scene.model import SlotModel, hull_points, make_slot_model, parking_poses
from pregrasp_jax.scene.spec import compile_spec
from pregrasp_jax.spaces.workspace import TABLE
from pregrasp_jax.types import HullBank

ROBOT = get_robot("ur5e_rg2")
NUM_STEPS = 300


@pytest.fixture(scope="module")
def bank() -> HullBank:
    return builtin_bank("seen")


@pytest.fixture(scope="module")
def slots(bank):
    return make_slot_model(native.native_spec(ROBOT, TABLE), bank)


def compile_separately(bank: HullBank, object_ids: np.ndarray, slots: SlotModel) -> mujoco.MjModel:
    """Build the same scene the ordinary way: one body per object, its hulls as meshes, nothing rewritten."""
    spec = native.native_spec(ROBOT, TABLE)
    spec.option.disableflags |= mujoco.mjtDisableBit.mjDSBL_MIDPHASE
    spec.option.jacobian = mujoco.mjtJacobian.mjJAC_SPARSE
    for slot, obj in enumerate(object_ids):
        body = spec.worldbody.add_body(name=f"object_{slot}")
        body.add_freejoint()
        if obj < 0:
            body.gravcomp = 1
        i = max(int(obj), 0)
        body.explicitinertial = True
        body.mass = float(bank.mass[i]) if obj >= 0 else 0.1
        body.inertia = np.asarray(bank.inertia[i], np.float64) if obj >= 0 else np.full(3, 1e-4)
        body.ipos = np.asarray(bank.com[i], np.float64) if obj >= 0 else np.zeros(3)
        body.iquat = np.asarray(bank.inertia_quat[i], np.float64) if obj >= 0 else np.array([1.0, 0, 0, 0])
        for hull in np.asarray(bank.object_hulls[i]) if obj >= 0 else []:
            if hull < 0:
                continue
            name = f"slot_{slot}_hull_{hull}"
            mesh = spec.add_mesh(name=name)
            mesh.uservert = hull_points(bank, hull).ravel()
            mesh.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_CONVEX
            friction = [float(bank.friction[i]), 0.005, 0.0001]
            body.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname=name, friction=friction)
    mj_model = compile_spec(spec)
    mj_model.stat.meaninertia = slots.mj_model.stat.meaninertia  # it scales the solver's tolerance
    mj_model.dof_length[:] = slots.mj_model.dof_length  # it scales the speed below which objects sleep
    return mj_model


def scene(bank: HullBank, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Draw objects that stand on a 3 x 3 lattice around the hand, some of them touching it and each other."""
    rng = np.random.default_rng(seed)
    object_ids = rng.choice(len(bank.names), 8, replace=False)
    object_ids[8 - seed :] = -1
    poses = parking_poses()
    for slot in range(8):
        if object_ids[slot] >= 0:
            yaw = rng.uniform(0, np.pi)
            xy = 0.07 * np.array([slot % 3 - 1, slot // 3 - 1]) - [0.12, 0]
            poses[slot] = [*xy, 0.001, np.cos(yaw / 2), 0, 0, np.sin(yaw / 2)]
    return object_ids, poses


def initial_state(simulations: Simulations, poses: np.ndarray) -> np.ndarray:
    """Return states [E, nstate] with the robot at the start and objects at poses [E, MAX_OBJECTS, 7]."""
    state = np.tile(simulations.home_states()[0], (len(poses), 1))
    simulations.coordinates(state)[0][:, simulations.model.slot_qpos_ids] = poses
    return state


def separate_rollout(bank, object_ids, poses, ctrl, slots) -> np.ndarray:
    mj_model = compile_separately(bank, object_ids, slots)
    data = mujoco.MjData(mj_model)
    ROBOT.set_home(mj_model, data)
    data.qpos[-56:] = poses.ravel()
    for row in ctrl:
        data.ctrl[:] = row
        mujoco.mj_step(mj_model, data)
    return data.qpos.copy()


@pytest.mark.parametrize("seed", [0, 1, 3])
def test_slots_equal_separately_compiled_models(bank, slots, seed):
    object_ids, poses = scene(bank, seed)
    simulations = Simulations(slots, ROBOT, threads=2)
    other_ids, other_poses = scene(bank, 2)
    num_rows = NUM_STEPS // simulations.num_substeps
    state = initial_state(simulations, np.stack([other_poses, poses]))
    hold = ROBOT.home[:7]
    ctrl = np.repeat(np.stack([hold, hold])[:, None], num_rows, axis=1)
    rows = np.full(2, num_rows)
    simulations.run(state, np.stack([object_ids, other_ids]), ctrl, rows)
    new_state, _ = simulations.run(state, np.stack([other_ids, object_ids]), ctrl, rows)  # some begin in each other
    expected = separate_rollout(bank, object_ids, poses, np.tile(hold, (NUM_STEPS, 1)), slots)
    object_poses, _ = simulations.describe(new_state)
    assert np.isfinite(new_state).all()
    np.testing.assert_array_equal(object_poses[1].ravel(), expected[-56:].astype(np.float32))
    moved = np.linalg.norm(object_poses[1, :, :2] - poses[:, :2], axis=1)
    assert moved.max() > 1e-3, "the scene must really collide"


def test_results_do_not_depend_on_threads(bank, slots):
    object_ids, poses = (np.stack(x) for x in zip(scene(bank, 0), scene(bank, 3), scene(bank, 1), strict=True))
    results = []
    for threads in (1, 2):
        simulations = Simulations(slots, ROBOT, threads=threads)
        state = initial_state(simulations, poses)
        ctrl = np.tile(ROBOT.home[:7], (3, 40, 1))
        results.append(simulations.run(state, object_ids, ctrl, np.array([40, 7, 23]))[0])
    np.testing.assert_array_equal(results[0], results[1])


def test_parked_slots_stay_where_they_are(bank, slots):
    simulations = Simulations(slots, ROBOT)
    poses = parking_poses()[None]
    state = initial_state(simulations, poses)
    ctrl = np.tile(ROBOT.home[:7], (1, 100, 1))
    state, _ = simulations.run(state, np.full((1, 8), -1), ctrl, np.array([100]))
    np.testing.assert_allclose(simulations.describe(state)[0], poses, atol=1e-6)
