"""The bank as a container, and its files."""

import jax
import mujoco
import numpy as np
import pytest
import trimesh

from pregrasp_jax.assets.bank import (
    ConvexObject,
    concatenate,
    load_bank,
    make_bank,
    save_bank,
    select,
)
from pregrasp_jax.assets.catalogue import SEEN, UNSEEN, builtin_bank, process
from pregrasp_jax.assets.meshes import MIN_TIP_ANGLE, tip_angle
from pregrasp_jax.robot import closing_region, get_robot
from pregrasp_jax.types import MAX_HULLS


def box(size: tuple[float, float, float], center: tuple[float, float, float]) -> np.ndarray:
    return np.asarray(trimesh.creation.box(size).vertices) + center


@pytest.fixture(scope="module")
def bank():
    return make_bank(
        [
            ConvexObject("plain", [box((0.05, 0.08, 0.15), (0.3, 0.2, 0.5))], density=500.0, friction=0.4),
            ConvexObject("wide", [box((0.12, 0.12, 0.2), (0.0, 0.0, 0.0))], mass=0.2),
            ConvexObject("two", [box((0.08, 0.08, 0.1), (0, 0, 0.05)), box((0.04, 0.04, 0.1), (0.02, 0, 0.15))]),
        ]
    )


def test_object_frame_mass_and_inertia(bank):
    vertices = np.asarray(bank.full.vertices[0])
    np.testing.assert_allclose(vertices.min(axis=0), [-0.025, -0.04, 0.0], atol=1e-5)
    np.testing.assert_allclose(vertices.max(axis=0), [0.025, 0.04, 0.15], atol=1e-5)
    np.testing.assert_allclose(bank.mass, [500 * 6e-4, 0.2, 300 * 8e-4], rtol=3e-3)
    np.testing.assert_allclose(bank.com[0], [0.0, 0.0, 0.075], atol=1e-5)
    np.testing.assert_allclose(bank.height, [0.15, 0.2, 0.2], atol=1e-6)
    np.testing.assert_allclose(bank.friction, [0.4, 0.25, 0.25])
    np.testing.assert_allclose(bank.min_width, [0.05, 0.12, 0.08], atol=1e-5)


def test_two_boxes_have_the_com_of_their_volumes(bank):
    """The upper box (a fifth of the volume) stands 0.02 m aside: the frame moves by 0.004 m."""
    np.testing.assert_allclose(bank.com[2], [0.0, 0.0, 0.8 * 0.05 + 0.2 * 0.15], atol=2e-4)
    np.testing.assert_allclose(np.asarray(bank.full.vertices[2])[:, 0].max(), 0.04 - 0.004, atol=2e-4)


def test_principal_axes_rebuild_the_inertia_of_muJoCo(bank):
    """MuJoCo composes the inertia of the same boxes; moments and axes must agree."""
    spec = mujoco.MjSpec()
    body = spec.worldbody.add_body()
    for size, center in (((0.04, 0.04, 0.05), (-0.004, 0, 0.05)), ((0.02, 0.02, 0.05), (0.016, 0, 0.15))):
        body.add_geom(type=mujoco.mjtGeom.mjGEOM_BOX, size=size, pos=center, density=300)
    model = spec.compile()
    rotation, expected = np.zeros(9), np.zeros(9)
    mujoco.mju_quat2Mat(rotation, np.asarray(bank.inertia_quat[2], np.float64))
    rotation = rotation.reshape(3, 3)
    mujoco.mju_quat2Mat(expected, model.body_iquat[1])
    expected = expected.reshape(3, 3)
    found = rotation @ np.diag(np.asarray(bank.inertia[2])) @ rotation.T
    reference = expected @ np.diag(model.body_inertia[1]) @ expected.T
    np.testing.assert_allclose(found, reference, atol=5e-3 * reference.max())
    assert np.linalg.det(rotation) == pytest.approx(1.0, abs=1e-5)


def test_eligibility_and_its_reason(bank):
    eligible, reasons = get_robot("ur5e_rg2").eligibility(bank)
    np.testing.assert_array_equal(eligible, [True, False, True])
    assert reasons[0] == reasons[2] == ""
    assert "narrowest width 120.0 mm, must be < 105" in reasons[1] and "best coverage" in reasons[1]


@pytest.mark.parametrize(("coverage", "said"), [(0.96999, "0.969"), (0.9651, "0.965"), (0.5, "0.500")])
def test_rounding_does_not_hide_why_a_coverage_is_too_small(bank, coverage, said, monkeypatch):
    monkeypatch.setattr(closing_region, "best_coverage", lambda *_, **__: coverage)
    assert get_robot("ur5e_rg2").eligibility(bank).reasons[0] == f"best coverage {said}, must be > 0.97"


def test_select_keeps_every_field_of_the_object_together(bank):
    picked = select(bank, [2, 0])
    assert picked.names == ("two", "plain")
    np.testing.assert_array_equal(picked.object_hulls, [[0, 1, -1, -1, -1, -1], [2, -1, -1, -1, -1, -1]])
    np.testing.assert_array_equal(picked.full.vertices, np.asarray(bank.full.vertices)[[2, 3, 0]])
    np.testing.assert_array_equal(picked.coarse.planes, np.asarray(bank.coarse.planes)[[2, 3, 0]])
    np.testing.assert_array_equal(picked.mass, np.asarray(bank.mass)[[2, 0]])
    assert picked.content_hash != bank.content_hash
    with pytest.raises(ValueError, match="object index 3 is outside the bank; allowed are 0 to 2"):
        select(bank, [0, 3])


def test_concatenate_inverts_select(bank):
    again = concatenate([select(bank, [0]), select(bank, [1, 2])])
    assert again.content_hash == bank.content_hash
    jax.tree.map(np.testing.assert_array_equal, again, bank)
    assert concatenate([]).object_hulls.shape == (0, MAX_HULLS)
    with pytest.raises(ValueError, match="'plain' is used twice"):
        concatenate([bank, select(bank, [0])])


def test_too_many_parts_are_refused():
    part = box((0.05, 0.05, 0.1), (0, 0, 0))
    with pytest.raises(ValueError, match="'x' has 7 convex parts; allowed are 1 to 6"):
        make_bank([ConvexObject("x", [part] * 7)])


def test_file_round_trip(bank, tmp_path):
    save_bank(tmp_path / "b.npz", bank)
    again = load_bank(tmp_path / "b.npz")
    jax.tree.map(np.testing.assert_array_equal, again, bank)
    assert (again.names, again.content_hash) == (bank.names, bank.content_hash)


def test_damaged_foreign_and_pickled_files_are_one_clear_error(bank, tmp_path):
    path = tmp_path / "b.npz"
    save_bank(path, bank)
    good = path.read_bytes()
    for data in (good[: len(good) // 2], b"", b"not a zip"):
        path.write_bytes(data)
        with pytest.raises(ValueError, match=r"not a readable .* delete it and build it again"):
            load_bank(path)
    np.savez(path, format=np.array("something else"))
    with pytest.raises(ValueError, match="format differs"):
        load_bank(path)
    np.savez(path, format=np.array([{"a": 1}], dtype=object), allow_pickle=True)
    with pytest.raises(ValueError, match="not a readable"):
        load_bank(path)
    with pytest.raises(FileNotFoundError):
        load_bank(tmp_path / "absent.npz")


def test_a_changed_number_fails_the_hash(bank, tmp_path):
    path = tmp_path / "b.npz"
    save_bank(path, bank)
    with np.load(path) as file:
        arrays = dict(file)
    arrays["mass"] = arrays["mass"] * 1.01
    np.savez(path, **arrays)
    with pytest.raises(ValueError, match="content hash differs"):
        load_bank(path)


def test_catalogue_sets():
    seen, unseen = builtin_bank("seen"), builtin_bank("unseen")
    assert (len(seen.names), len(unseen.names)) == (17, 9)
    assert not set(seen.names) & set(unseen.names)
    for catalogue in (seen, unseen):
        assert (np.asarray(catalogue.height) >= 0.11).all()
        assert (np.asarray(catalogue.height) <= 0.30).all()
        assert ((np.asarray(catalogue.mass) > 0.08) & (np.asarray(catalogue.mass) < 0.61)).all()
        assert get_robot("ur5e_rg2").eligibility(catalogue).eligible.mean() > 0.75
        assert min(tip_angle(catalogue, i) for i in range(len(catalogue.names))) > MIN_TIP_ANGLE
    assert (np.asarray(seen.object_hulls) >= 0).sum(axis=1).max() >= 4
    with pytest.raises(ValueError, match="'test' is unknown; allowed are seen, unseen"):
        builtin_bank("test")


@pytest.mark.parametrize("name", ["ycb_wood_block", "kit_salt_cylinder", "kit_melfor_bottle"])
def test_shipped_catalogue_is_what_the_recipes_make(name):
    recipes = {recipe.name: recipe for recipe in (*SEEN, *UNSEEN)}
    made = make_bank([process(recipes[name])])
    catalogue = builtin_bank("seen" if name in [r.name for r in SEEN] else "unseen")
    shipped = select(catalogue, [catalogue.names.index(name)])
    jax.tree.map(
        lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-5, atol=1e-7), shipped.full.vertices, made.full.vertices
    )
    np.testing.assert_array_equal(shipped.object_hulls, made.object_hulls)
    np.testing.assert_allclose(shipped.inertia, made.inertia, rtol=1e-4)


def standing_tilt(bank, index: int, level: str) -> tuple[float, float]:
    """Tilt (rad) and height change (m) of one object after 1 s on a plane."""
    spec = mujoco.MjSpec()
    spec.option.timestep = 0.004
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    spec.option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_PLANE, size=[1, 1, 1], friction=[0.1, 0.005, 1e-4])
    body = spec.worldbody.add_body()
    body.add_freejoint()
    body.explicitinertial = True
    body.mass, body.ipos = float(bank.mass[index]), np.asarray(bank.com[index])
    body.inertia, body.iquat = np.asarray(bank.inertia[index]), np.asarray(bank.inertia_quat[index])
    vertices = np.asarray(getattr(bank, level).vertices, np.float64)
    for hull in np.asarray(bank.object_hulls[index]):
        if hull >= 0:
            spec.add_mesh(name=str(hull), uservert=vertices[hull].ravel())
            body.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname=str(hull), friction=[0.25, 0.005, 1e-4])
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_step(model, data, 250)
    return float(np.arccos(min(1.0, data.xmat[1, 8]))), float(abs(data.qpos[2]))


@pytest.mark.parametrize("object_set", ["seen", "unseen"])
@pytest.mark.parametrize(("level", "allowed"), [("full", 5e-4), ("coarse", 1e-3)])
def test_every_built_in_object_stands(object_set, level, allowed):
    """C MuJoCo keeps four neighbouring contacts under a mesh, so light objects rock by some 1e-4 rad."""
    bank = builtin_bank(object_set)
    for index, name in enumerate(bank.names):
        tilt, drop = standing_tilt(bank, index, level)
        assert tilt < allowed, f"{name} tilts by {tilt:.4f} rad"
        assert drop < 2e-4, f"{name} moves by {drop * 1e3:.2f} mm"
