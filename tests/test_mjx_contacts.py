"""Contacts of the `mjx` engine against C MuJoCo on the same hulls and options, and against exact geometry."""

import dataclasses

import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from mjx_contacts import ALIKE, AMPLE, UNIQUE, Pair, make_contacts_of, random_states, touching_pairs
from mjx_oracle import ROBOT, CoarseModel
from mujoco import mjx as mujoco_mjx

from pregrasp_jax.assets.catalogue import builtin_bank
from pregrasp_jax.config import SceneConfig
from pregrasp_jax.physics import mjx, mjx_model
from pregrasp_jax.physics.base import MAX_PENETRATION
from pregrasp_jax.physics.hull_collision import ContactCounts, Limits
from pregrasp_jax.scene import bank as scene_bank
from pregrasp_jax.scene.model import parking_poses
from pregrasp_jax.spaces.workspace import TABLE
from pregrasp_jax.types import MAX_OBJECTS

NUM_STATES = 100
"""The benchmark mjx_agreement.py has 200."""

TIGHT = Limits(max_hull_pairs=6, max_robot_pairs=3, max_contact_points=24)
"""Less than the states of these tests need."""
NUM_TIGHT = 8

ROUNDING = 1e-6
"""m."""


@pytest.fixture(scope="module")
def bank():
    return builtin_bank("seen")


@pytest.fixture(scope="module")
def model(bank):
    return mjx_model.make_mjx_slot_model(bank, ROBOT, TABLE, limits=AMPLE)


@pytest.fixture(scope="module")
def oracle(bank):
    return CoarseModel(bank)


def test_c_gets_the_options_of_mjx(model, oracle):
    for name in ("cone", "impratio", "solver", "iterations", "ls_iterations", "jacobian", "integrator", "timestep"):
        assert getattr(oracle.model.opt, name) == getattr(model.mj_model.opt, name), name
    damped = mujoco.mjtDisableBit.mjDSBL_EULERDAMP
    assert oracle.model.opt.disableflags & damped == model.mj_model.opt.disableflags & damped
    assert set(oracle.model.geom_condim) == set(model.mj_model.geom_condim) == {3}
    for mj_model in (oracle.model, model.mj_model):
        pads = [mj_model.geom(f"hand_{side}_pad") for side in ("left", "right")]
        for pad in pads:
            assert pad.friction[0] == pytest.approx(2**0.5), "the pyramid around the cone of native's friction 1"
            np.testing.assert_allclose(pad.solimp[:2], [0.995, 0.9995])
        fixed = mj_model.geom_type != mujoco.mjtGeom.mjGEOM_MESH  # objects bring their own friction
        fixed[[pad.id for pad in pads]] = False
        assert mj_model.geom_friction[fixed, 0].max() < 1


@pytest.fixture(scope="module")
def scenes(bank):
    return scene_bank.load_or_build(bank, ROBOT.eligibility(bank).eligible, SceneConfig(test_scenes=3), "test")


@pytest.fixture(scope="module")
def contacts_of(model):
    return make_contacts_of(model)


@pytest.fixture(scope="module")
def pairs(model, oracle, contacts_of, scenes) -> list[Pair]:
    return touching_pairs(model, oracle, contacts_of, scenes, NUM_STATES)


def solid(pairs) -> list[Pair]:
    """Return pairs of hulls and boxes."""
    return [pair for pair in pairs if pair.normal is not None]


def test_the_same_pairs_touch(pairs):
    """All pairs that C finds deeper than 10 um, and none that it does not: no absent hull, no parked slot."""
    kinds = {"table": 0, "hulls": 0, "box": 0, "capsule": 0}
    for pair in pairs:
        kinds[pair.kind] += 1
        if (pair.ours is None) != (pair.reference is None):
            assert max(touch.dist for touch in pair[2:4] if touch) > -1e-5, pair
    assert min(kinds[kind] for kind in ("table", "hulls", "box")) > NUM_STATES
    assert kinds["capsule"] > NUM_STATES / 8


def test_contacts_with_the_table_agree_with_c(pairs):
    for pair in pairs:
        if pair.kind == "table" and pair.ours and pair.reference:
            assert pair.ours.dist == pytest.approx(pair.reference.dist, abs=1e-6)
            np.testing.assert_allclose(pair.ours.normal, pair.reference.normal, atol=1e-6)
            assert pair.ours.pos[2] == pytest.approx(pair.reference.pos[2], abs=1e-6), "half way between the two"


def test_contacts_with_capsules_agree_with_c(pairs):
    """With `mj_geomDistance` always, and with C's contacts where those do (48 of 56 in 200 states); normals too."""
    both = [pair for pair in pairs if pair.kind == "capsule" and pair.ours and pair.reference]
    for pair in both:
        assert pair.ours.dist == pytest.approx(-pair.least, abs=2e-5), pair
    exact = [pair for pair in both if pair.reference_is_exact]
    assert len(exact) > 0.8 * len(both)
    for pair in exact:
        assert pair.ours.normal @ pair.reference.normal > np.cos(ALIKE), pair


def test_the_least_translation_is_exact(pairs):
    """Distance and normal against the Minkowski difference: 20 um, of which 10 um are the preference for faces."""
    for pair in solid(pairs):
        if pair.ours:
            assert pair.ours.dist == pytest.approx(-pair.least, abs=2e-5), pair
            assert pair.along == pytest.approx(pair.least, abs=2e-5), pair


def test_contacts_of_hulls_agree_with_c_where_c_is_exact(pairs):
    """C stops before the least translation in some pairs, by up to 1 mm; in the others we agree."""
    both = [pair for pair in solid(pairs) if pair.ours and pair.reference]
    error = np.array([abs(pair.ours.dist - pair.reference.dist) for pair in both])
    exact = np.array([pair.reference_is_exact for pair in both])
    assert np.percentile(error, 50) < 1e-6
    assert np.percentile(error, 90) < 1e-4
    assert exact.mean() > 0.5
    assert error[exact].max() < 2e-5


def test_the_normal_is_that_of_the_least_translation_where_there_is_one(pairs):
    """Within 1 degree of the exact one, and of C's where C is exact, unless another way out is within 40 um.

    In 200 states C's normal is elsewhere in 255 of 1032 pairs: in 253 of them C is not exact (its distance is short by
    up to 0.7 mm, or moving along its normal does not part the two), the other 2 are ties.
    """
    unique = [pair for pair in solid(pairs) if pair.ours and pair.margin > UNIQUE]
    exact = [pair for pair in unique if pair.reference and pair.reference_is_exact]
    assert len(unique) > 0.7 * len(solid(pairs))
    assert len(exact) > 0.5 * len(unique)
    for pair in unique:
        assert pair.ours.normal @ pair.normal > np.cos(ALIKE), pair
    for pair in exact:
        assert pair.ours.normal @ pair.reference.normal > np.cos(ALIKE), pair


def test_contacts_lie_half_way_between_the_surfaces(pairs):
    """Within the overlap of the two unless they have diverged; where C is exact as far along the normal as its own."""
    both = [pair for pair in solid(pairs) if pair.ours]
    for pair in both:
        assert pair.outside < 5e-5 or pair.ours.dist < -MAX_PENETRATION, pair
    exact = [pair for pair in both if pair.reference and pair.reference_is_exact and pair.margin > UNIQUE]
    assert len(exact) > 0.3 * len(both)
    for pair in exact:
        assert (pair.ours.pos - pair.reference.pos) @ pair.reference.normal == pytest.approx(0, abs=2e-5), pair


def test_contacts_mix_friction_and_softness_as_c_does(pairs):
    for pair in pairs:
        if pair.ours and pair.reference:
            np.testing.assert_allclose(pair.ours.parameters, pair.reference.parameters, rtol=1e-6)


def test_a_slot_has_the_constants_of_a_separately_filled_model(model, oracle):
    """Everything that differs between objects, with eight of them at once; the compiled median object is a decoy."""
    object_ids = np.array([16, 3, -1, 13, 5, 0, 8, 6])
    oracle.fill(object_ids, parking_poses())
    filled, hull_ids = mjx_model.fill_slots(model, jnp.asarray(object_ids))
    for names, ours, theirs in (
        (mjx_model.BODY_FIELDS, model.body_ids, oracle.slots.slot_body_ids),
        (mjx_model.DOF_FIELDS, model.dof_ids, oracle.slots.slot_dof_ids),
        (("geom_friction",), model.geom_ids, oracle.slots.slot_geom_ids),
    ):
        for name in names:
            expected = getattr(oracle.model, name)[theirs]
            np.testing.assert_allclose(getattr(filled, name)[ours], expected, rtol=1e-5, atol=1e-9, err_msg=name)
    compiled = model.mj_model.body_invweight0[model.body_ids]
    assert np.abs(filled.body_invweight0[model.body_ids] / compiled - 1).max() > 0.5
    present = np.asarray(hull_ids)[model.geom_ids] >= 0
    np.testing.assert_array_equal(present, oracle.model.geom_contype[oracle.slots.slot_geom_ids] > 0)
    robot_bodies = np.setdiff1d(np.arange(model.mj_model.nbody), model.body_ids)
    np.testing.assert_array_equal(
        filled.body_invweight0[robot_bodies], model.mj_model.body_invweight0[robot_bodies].astype(np.float32)
    )


@pytest.mark.slow
def test_the_least_overlapping_pairs_and_the_shallowest_contacts_are_dropped(bank, model, oracle, contacts_of, scenes):
    """Limits below the real counts, against the boxes of C's geoms and the contacts of which nothing was dropped."""
    object_ids, qpos = random_states(model, scenes, NUM_TIGHT)
    tight_model = mjx_model.make_mjx_slot_model(bank, ROBOT, TABLE, limits=TIGHT)
    everything, _ = contacts_of(object_ids, jnp.asarray(qpos, jnp.float32))
    left, counts = make_contacts_of(tight_model)(object_ids, jnp.asarray(qpos, jnp.float32))
    dropped = np.zeros(3, int)
    for s in range(NUM_TIGHT):
        state = oracle.fill(object_ids[s], qpos[s, model.qpos_ids])
        overlaps = overlapping_boxes(oracle, state)
        limits = {"hulls": TIGHT.max_hull_pairs, "box": TIGHT.max_robot_pairs, "capsule": TIGHT.max_robot_pairs}
        kept = {pair for kind, pairs in overlaps.items() for _, pair in sorted(pairs)[: limits[kind]]}
        contacts = [c for c in touching(model, everything, s) if "table" in c[1] or c[1] in kept]
        assert int(counts.hull_pairs[s]) == len(overlaps["hulls"])
        assert int(counts.robot_pairs[s]) == max(len(overlaps["box"]), len(overlaps["capsule"]))
        found, expected = distinct(touching(tight_model, left, s)), distinct(contacts)
        if int(counts.contacts[s]) <= TIGHT.max_contact_points:
            assert len(found) == len(expected)
        np.testing.assert_allclose(found, expected[: len(found)], atol=ROUNDING)
        assert int((np.asarray(left[1][s]) < 0).sum()) == min(int(counts.contacts[s]), TIGHT.max_contact_points)
        dropped += [
            len(overlaps["hulls"]) > TIGHT.max_hull_pairs,
            int(counts.robot_pairs[s]) > TIGHT.max_robot_pairs,
            int(counts.contacts[s]) > TIGHT.max_contact_points,
        ]
    assert (dropped > 0).all(), "nothing was dropped"


def overlapping_boxes(oracle, state) -> dict[str, list[tuple[float, tuple[str, str]]]]:
    """Return (gap m, names) of hulls and of hull and robot, by kind, whose world-aligned boxes overlap."""
    mujoco.mj_kinematics(oracle.model, state)
    names = [oracle.model.geom(g).name for g in range(oracle.model.ngeom) if oracle.model.geom_contype[g]]
    hulls = [name for name in names if name.startswith("slot")]
    corners = {name: oracle.corners(state, name) for name in names if is_solid(oracle, name)}
    boxes = {name: (points.min(axis=0), points.max(axis=0)) for name, points in corners.items()}
    for name in set(names) - set(boxes):
        geom = state.geom(name)
        radius, half = oracle.model.geom(name).size[:2]
        reach = np.abs(geom.xmat.reshape(3, 3)[:, 2]) * half + radius
        boxes[name] = geom.xpos - reach, geom.xpos + reach
    found = {"hulls": [], "box": [], "capsule": []}
    for i, hull in enumerate(hulls):
        for name in [*hulls[:i], *(n for n in names if n not in hulls)]:
            kind = "hulls" if name in hulls else "box" if is_solid(oracle, name) else "capsule"
            (low, high), (other_low, other_high) = boxes[hull], boxes[name]
            gap = np.maximum(low - other_high, other_low - high).max()
            if gap < 0 and name.split("_hull")[0] != hull.split("_hull")[0]:
                found[kind].append((gap, tuple(sorted((hull, name)))))
    return found


def is_solid(oracle, name: str) -> bool:
    """Return whether a geom is a hull or a box, not a capsule."""
    return oracle.model.geom(name).type[0] != mujoco.mjtGeom.mjGEOM_CAPSULE


def touching(model, contacts, s: int) -> list[tuple[float, tuple[str, str]]]:
    """Return (distance m, names) of the penetrating contacts of state s, deepest first."""
    geom, dist = np.asarray(contacts[0][s]), np.asarray(contacts[1][s])
    name = [model.mj_model.geom(g).name for g in range(model.mj_model.ngeom)]
    return sorted((float(d), tuple(sorted(name[g] for g in pair))) for d, pair in zip(dist, geom, strict=True) if d < 0)


def distinct(contacts) -> np.ndarray:
    """Return the different distances of sorted contacts; which of two at the same place remains is rounding."""
    distances = np.array([dist for dist, _ in contacts if dist < -ROUNDING])
    return distances[np.diff(distances, prepend=-np.inf) > ROUNDING]


def test_what_is_dropped_is_counted(model):
    """A step that had more pairs or contacts than fit is counted, once, and one at the limit is not."""
    limits = Limits(max_hull_pairs=2, max_robot_pairs=2, max_contact_points=4)
    small = dataclasses.replace(model, limits=limits)
    engine_state = mjx.MjxState(
        *(jnp.zeros(model.mj_model.nq), jnp.zeros(model.mj_model.nv), jnp.zeros(model.mj_model.nv)),
        *(jnp.full(MAX_OBJECTS, -1), jnp.array(False), *[jnp.int32(0)] * 4),
    )
    data = mujoco_mjx.make_data(model.mjx_model)
    for hulls, hand, contacts, overflows in ((2, 2, 4, 0), (3, 0, 4, 1), (0, 3, 4, 1), (0, 0, 5, 1), (0, 3, 5, 1)):
        counts = ContactCounts(jnp.int32(hulls), jnp.int32(hand), jnp.int32(contacts), jnp.float32(0))
        state = mjx.guarded(small, engine_state, data, counts)
        assert int(state.overflows) == overflows
        assert (int(state.max_hull_pairs), int(state.max_contacts)) == (hulls, contacts)
