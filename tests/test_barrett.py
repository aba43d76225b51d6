"""The Barrett hand is the one of the published tables, and MuJoCo's is where its kinematics say."""

import copy

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from pregrasp_jax.config import SceneConfig
from pregrasp_jax.robot import barrett, get_robot
from pregrasp_jax.scene.spec import compile_spec, scene_spec
from pregrasp_jax.spaces.workspace import TABLE

# mm between opposing fingertips, as the reference implementation's forward kinematics has them.
TIP_DISTANCES = {0.6: 201, 0.7: 179, 0.8: 157, 0.9: 135, 1.0: 113, 1.1: 91, 1.2: 69, 1.3: 49, 1.4: 30, 1.5: 12}
# mm, half width and farthest reach of the open hand's outline.
OUTLINE = {0.6: (121, 95), 0.7: (114, None), 0.8: (109, None), 0.9: (104, None), 1.0: (98, 109), 1.1: (91, 108)}
# mm, measured inner outlines (forward, half width).
REGIONS = {
    0.6: [(-5, 37), (9, 48), (21, 63), (33, 80), (45, 96), (85, 100)],
    0.85: [(-5, 37), (9, 45), (27, 59), (45, 75), (51, 82), (69, 77), (93, 72)],
    1.1: [(-5, 37), (9, 42), (27, 50), (45, 59), (57, 67), (75, 54), (99, 43)],
}

fingertip, front, region = (jax.jit(function) for function in (barrett.fingertip, barrett.front, barrett.region))


@pytest.fixture(scope="module")
def robot():
    return get_robot("barrett")


@pytest.fixture(scope="module")
def mj_model(robot):
    return compile_spec(scene_spec(robot, TABLE))


def posed(robot, mj_model, aperture):
    data = mujoco.MjData(mj_model)
    robot.set_home(mj_model, data)
    for finger in (1, 2, 3):
        data.joint(f"hand_proximal_{finger}").qpos[0] = aperture
        data.joint(f"hand_distal_{finger}").qpos[0] = aperture / 3
    mujoco.mj_kinematics(mj_model, data)
    return data


@pytest.mark.parametrize(("aperture", "distance"), TIP_DISTANCES.items())
def test_fingertips_are_as_far_apart_as_published(aperture, distance):
    assert 2e3 * float(fingertip(jnp.float32(aperture))[1]) == pytest.approx(distance, abs=0.5)


@pytest.mark.parametrize("aperture", [0.6, 0.9, 1.4])
def test_mujocos_fingertips_are_there_too_and_close_from_both_sides(robot, mj_model, aperture):
    data = posed(robot, mj_model, aperture)
    tip = np.asarray(fingertip(jnp.float32(aperture)))
    palm = data.body("hand_palm").xpos
    for finger, side, z in ((1, 1, -0.025), (2, 1, 0.025), (3, -1, 0.0)):
        found = data.site(f"hand_tip_{finger}").xpos - palm
        np.testing.assert_allclose(found, [tip[0], side * tip[1], z], atol=1e-5)


@pytest.mark.parametrize(("aperture", "expected"), OUTLINE.items())
def test_outline(aperture, expected):
    half_width, reach = expected
    y = np.linspace(-0.13, 0.13, 5201)
    found = np.asarray(front(jnp.float32(aperture), jnp.asarray(y, jnp.float32)))
    assert 1e3 * np.abs(y[np.isfinite(found)]).max() == pytest.approx(half_width, abs=1)
    if reach:
        assert 1e3 * found.max() == pytest.approx(reach, abs=1)
    assert found[np.abs(y) < 0.03] == pytest.approx(-0.005, abs=1e-6), "the palm's face, between the fingers"


def test_the_outline_is_that_of_mujocos_geoms(robot, mj_model):
    data = posed(robot, mj_model, 0.85)
    y = np.linspace(-0.12, 0.12, 49)
    found = np.asarray(front(jnp.float32(0.85), jnp.asarray(y, jnp.float32)))
    origin = data.body("hand_palm").xpos
    geoms = np.zeros(6, np.uint8)
    geoms[2] = 1
    for z, own in ((0.025, y > 0), (0.0, y < 0)):
        for line in np.flatnonzero(own & np.isfinite(found)):
            start = origin + np.array([0.3, y[line], z])
            hit = np.zeros(1, np.int32)
            distance = mujoco.mj_ray(mj_model, data, start, np.array([-1.0, 0, 0]), geoms, 1, -1, hit)
            assert 0.3 - distance == pytest.approx(found[line], abs=2e-4), (y[line], z)


@pytest.mark.parametrize(("aperture", "corners"), REGIONS.items())
def test_closing_region(aperture, corners):
    found = region(jnp.float32(aperture))
    x, half = np.asarray(found.x), np.asarray(found.half_width)
    assert (np.diff(x) > 0).all() and found.exists
    # The measured outlines are those of meshes; ours, of capsules, is 5 mm narrower at the most.
    for forward, half_width in corners:
        if forward / 1e3 <= x[-1]:
            assert 1e3 * np.interp(forward / 1e3, x, half) == pytest.approx(half_width, abs=5)
    measured = np.trapezoid([half for _, half in corners], [x for x, _ in corners]) / 1e6
    assert np.trapezoid(half, x) == pytest.approx(measured, rel=0.08)


def test_a_closed_hand_has_no_region():
    assert not region(jnp.float32(barrett.CLOSED)).exists


def test_joints_drives_and_mass(robot, mj_model):
    assert robot.joints == robot.actuators and len(robot.joints) == 4 + 6
    np.testing.assert_allclose(robot.home[4:], [0.6, 0.2] * 3, rtol=1e-6)
    for kind, upper in (("proximal", 2.44), ("distal", 0.84)):
        for finger in (1, 2, 3):
            assert mj_model.joint(f"hand_{kind}_{finger}").range.tolist() == [0, upper], "radians, not degrees"
            force = 3.4 if finger == 3 else 2.0
            assert mj_model.actuator(f"hand_{kind}_{finger}").forcerange.tolist() == [-force, force]
    hand = [mj_model.body(name).id for name in robot.links.names if name.startswith("hand_")]
    assert mj_model.body_mass[hand].sum() == pytest.approx(1.2, abs=0.01)
    assert robot.fingertips == ("hand_distal_1", "hand_distal_2", "hand_distal_3")
    assert set(robot.fingertips) < set(robot.links.names)


def test_a_blocked_proximal_link_does_not_stop_its_distal_link(robot, mj_model):
    mj_model = copy.copy(mj_model)
    mj_model.joint("hand_proximal_1").range[:] = 0.6, 0.61
    data = posed(robot, mj_model, 0.605)
    data.ctrl[:] = [data.joint(name).qpos[0] for name in robot.joints]
    data.ctrl[4:] = [1.8, 0.6] * 3
    mujoco.mj_step(mj_model, data, 250)
    assert data.joint("hand_proximal_1").qpos[0] == pytest.approx(0.605, abs=0.02)
    assert data.joint("hand_proximal_2").qpos[0] == pytest.approx(1.8, abs=0.01)
    assert data.joint("hand_distal_1").qpos[0] == pytest.approx(0.6, abs=0.01)


def test_scenes_and_targets_pair_with_those_of_the_rg2(robot):
    from pregrasp_jax.assets.sets import builtin_bank
    from pregrasp_jax.scene.bank import bank_hash

    bank = builtin_bank("unseen")
    hashes = {
        bank_hash(bank, r.eligibility(bank).eligible, SceneConfig(), "test") for r in (robot, get_robot("ur5e_rg2"))
    }
    assert len(hashes) == 1
