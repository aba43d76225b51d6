import mujoco
import numpy as np
import pytest

from pregrasp_jax.assets.catalogue import builtin_bank
from pregrasp_jax.config import SceneConfig
from pregrasp_jax.robot import get_robot
from pregrasp_jax.scene import bank as scene_bank
from pregrasp_jax.scene import packing
from pregrasp_jax.scene.bank import SceneBank
from pregrasp_jax.scene.model import hull_points, parking_poses
from pregrasp_jax.scene.spec import table_spec
from pregrasp_jax.spaces.workspace import TABLE
from pregrasp_jax.types import HullBank

ROBOT = get_robot("ur5e_rg2")
CONFIG = SceneConfig(train_scenes=12, validation_scenes=4, test_scenes=4)


@pytest.fixture(scope="module")
def bank() -> HullBank:
    return builtin_bank("seen")


@pytest.fixture(scope="module")
def eligible(bank) -> np.ndarray:
    return ROBOT.eligibility(bank).eligible


@pytest.fixture(scope="module")
def scenes(bank, eligible) -> SceneBank:
    return scene_bank.build(bank, eligible, CONFIG, "train")


def compile_scene(bank: HullBank, object_ids: np.ndarray) -> mujoco.MjModel:
    """Compile the objects of one scene the ordinary way; nothing is shared with the code under test."""
    spec = table_spec(TABLE)
    for obj in object_ids[object_ids >= 0]:
        body = spec.worldbody.add_body(name=f"body_{obj}")
        body.add_freejoint()
        body.explicitinertial = True
        body.mass, body.ipos = float(bank.mass[obj]), np.asarray(bank.com[obj], np.float64)
        body.inertia, body.iquat = (np.asarray(x[obj], np.float64) for x in (bank.inertia, bank.inertia_quat))
        for hull in np.asarray(bank.object_hulls[obj]):
            if hull >= 0:
                spec.add_mesh(name=f"hull_{hull}").uservert = hull_points(bank, hull).ravel()
                body.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname=f"hull_{hull}", friction=[0.25, 0.005, 1e-4])
    return spec.compile()


def body_gap(mj_model, data, a: int, b: int) -> float:
    geoms = [range(mj_model.body_geomadr[i], mj_model.body_geomadr[i] + mj_model.body_geomnum[i]) for i in (a, b)]
    return min(mujoco.mj_geomDistance(mj_model, data, g, h, 0.5, None) for g in geoms[0] for h in geoms[1])


def test_every_scene_is_packed_as_defined(bank, scenes):
    for object_ids, poses in zip(scenes.object_ids, scenes.poses, strict=True):
        count = int((object_ids >= 0).sum())
        mj_model = compile_scene(bank, object_ids)
        data = mujoco.MjData(mj_model)
        data.qpos[:] = poses[:count].ravel()
        mujoco.mj_forward(mj_model, data)
        bodies = range(1, 1 + count)
        gaps = np.array([[body_gap(mj_model, data, a, b) if a != b else np.inf for b in bodies] for a in bodies])
        assert gaps.min(axis=1).max() <= 3e-3, "every object is within 3 mm of another"
        assert gaps.min() >= -1e-3, "none interpenetrate by more than 1 mm"
        up = data.xmat.reshape(-1, 3, 3)[1:, 2, 2]
        assert np.arccos(np.clip(up, -1, 1)).max() <= 0.1, "none is tilted by more than 0.1 rad"
        before = data.qpos.copy()
        mujoco.mj_step(mj_model, data, nstep=125)
        drift = np.abs(data.qpos - before).reshape(-1, 7)[:, :3].max()
        assert drift < 2e-3, f"a scene at rest moved {drift * 1e3:.1f} mm in half a second"


def test_scenes_keep_clear_of_the_hand_under_any_yaw(bank, scenes):
    radius = np.linalg.norm(scenes.poses[..., :2], axis=-1) + packing.footprint_radius(bank)[scenes.object_ids]
    nearest = ROBOT.start.xy[0] + 0.0311 + 0.02  # fingertips of the open hand
    assert radius[scenes.object_ids >= 0].max() < -nearest


def test_scenes_differ_in_count_objects_and_target(eligible, scenes):
    counts = (scenes.object_ids >= 0).sum(axis=1)
    assert set(counts) <= {5, 6, 7, 8} and len(set(counts)) > 1
    assert len({tuple(sorted(ids)) for ids in scenes.object_ids}) == len(scenes)
    targets = scenes.object_ids[np.arange(len(scenes)), scenes.target]
    assert eligible[targets].all()
    np.testing.assert_array_equal(
        scenes.poses[scenes.object_ids < 0],
        np.tile(parking_poses(), (12, 1, 1)).astype(np.float32)[scenes.object_ids < 0],
    )


def test_banks_do_not_depend_on_threads_and_splits_differ(bank, eligible, scenes):
    again = scene_bank.build(bank, eligible, CONFIG, "train", threads=1)
    np.testing.assert_array_equal(again.poses, scenes.poses)
    other = scene_bank.build(bank, eligible, CONFIG, "test")
    assert not any(np.array_equal(a, b) for a in other.poses for b in scenes.poses)
    assert other.content_hash != scenes.content_hash


def test_round_trip_and_cache(bank, eligible, scenes, tmp_path, monkeypatch):
    monkeypatch.setenv("PREGRASP_JAX_CACHE", str(tmp_path))
    built = scene_bank.load_or_build(bank, eligible, CONFIG, "train")
    monkeypatch.setattr(scene_bank, "build", lambda *_, **__: pytest.fail("the cache was not used"))
    loaded = scene_bank.load_or_build(bank, eligible, CONFIG, "train")
    for name in ("object_ids", "poses", "yaw", "target", "seeds"):
        np.testing.assert_array_equal(getattr(loaded, name), getattr(built, name))
    assert (loaded.split, loaded.tries, loaded.content_hash) == (built.split, built.tries, built.content_hash)


def test_a_damaged_cache_is_packed_anew(bank, eligible, scenes, tmp_path, monkeypatch):
    monkeypatch.setenv("PREGRASP_JAX_CACHE", str(tmp_path))
    monkeypatch.setattr(scene_bank, "build", lambda *_, **__: scenes)
    scene_bank.load_or_build(bank, eligible, CONFIG, "train")
    (path,) = (tmp_path / "scenes").iterdir()
    path.write_bytes(path.read_bytes()[:-100])
    with pytest.warns(UserWarning, match=rf"{path.name}: not a readable scene bank .*; its scenes are packed anew"):
        again = scene_bank.load_or_build(bank, eligible, CONFIG, "train")
    assert len(again) == len(scene_bank.load(path)) == len(scenes)


def test_foreign_and_broken_banks_are_refused(scenes, tmp_path):
    path = tmp_path / "bank.npz"
    scene_bank.save(path, scenes)
    with pytest.raises(ValueError, match=r"bank\.npz: made for other objects"):
        scene_bank.load(path, "0" * 16)
    path.write_bytes(path.read_bytes()[:-100])
    with pytest.raises(ValueError, match=r"bank\.npz: not a readable scene bank"):
        scene_bank.load(path)
    with pytest.raises(ValueError, match=r"none\.npz: not a readable scene bank"):
        scene_bank.load(tmp_path / "none.npz")


def test_sets_that_cannot_be_packed_are_refused(bank, eligible, monkeypatch):
    monkeypatch.setattr(scene_bank, "_MIN_TRIES", scene_bank._CHUNK)
    toppling = bank.replace(com=bank.com + np.array([[0.2, 0, 0]], np.float32))
    with pytest.raises(ValueError, match=rf"scene bank: only \d of {scene_bank._CHUNK} tries were packed"):
        scene_bank.build(toppling, eligible, CONFIG, "train")
    with pytest.raises(ValueError, match="no object is an eligible target"):
        scene_bank.build(bank, np.zeros_like(eligible), CONFIG, "train")


def test_placed_footprints_do_not_touch():
    radii = np.array([0.05, 0.04, 0.06, 0.03, 0.05, 0.05, 0.04, 0.06])
    for seed in range(20):
        poses = packing.place(radii, np.random.default_rng(seed))
        gaps = np.linalg.norm(poses[:, None, :2] - poses[None, :, :2], axis=-1) - radii[:, None] - radii
        assert gaps[~np.eye(8, dtype=bool)].min() > 0


def test_another_choice_of_targets_is_another_bank(bank, eligible):
    fewer = eligible.copy()
    fewer[np.flatnonzero(eligible)[0]] = False
    hashes = {scene_bank.bank_hash(bank, mask, CONFIG, "train") for mask in (eligible, fewer)}
    assert len(hashes) == 2
