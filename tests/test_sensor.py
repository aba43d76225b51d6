"""Sensor effects, each against hand numbers or a plain loop, and the seed that pairs them."""

import dataclasses
import functools
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from fake_training import make_config
from heightmap_oracle import box_cloud, make_instances

from pregrasp_jax import heightmap
from pregrasp_jax.assets import spread
from pregrasp_jax.assets.catalogue import builtin_bank
from pregrasp_jax.heightmap import sensor
from pregrasp_jax.heightmap.views import project_upward
from pregrasp_jax.sensors import SENSORS, Sensor, camera_sensor, get_sensor
from pregrasp_jax.training import session
from pregrasp_jax.training.run_folder import RunFolder
from pregrasp_jax.types import ROBOT_ID

KEY = jax.random.key(0)


def test_names_and_files(tmp_path: Path):
    assert get_sensor("clean") == Sensor() != get_sensor("d455")
    path = tmp_path / "mine.yaml"
    path.write_text("base: d455\nbaseline: 0.2\nshadow: false\n")
    assert get_sensor(str(path)) == dataclasses.replace(SENSORS["d455"], baseline=0.2, shadow=False)
    for text, said in (
        ("base: d999", "base = 'd999' does not exist"),
        ("base: [d455]", r"base = \['d455'\] does not exist"),
        ("noise: 3", "unknown config key noise"),
        ("drop: 2.0", "drop = 2.0 is out of range"),
        ("cell: min", "cell = 'min' is unknown"),
        ("[]", "must be a mapping"),
    ):
        path.write_text(text)
        with pytest.raises(ValueError, match=said):
            get_sensor(str(path))
    with pytest.raises(ValueError, match=r"allowed: clean, d435, d455, or a \.yaml file"):
        get_sensor("kinect")
    with pytest.raises(ValueError, match="allowed with it is pinhole"):
        camera_sensor("d435", "orthographic")
    assert camera_sensor("d435", "pinhole") == SENSORS["d435"]


def test_a_run_is_not_resumed_once_its_sensor_file_says_something_else(tmp_path: Path):
    file, config = tmp_path / "mine.yaml", make_config()
    with RunFolder.create(tmp_path / "run", config) as folder:
        for text in ("drop: 0.1", "drop: 0.10  # the same"):
            file.write_text(text)
            folder.begin_session(config, session._hashes(_env_seen_by(get_sensor(str(file)))))
        file.write_text("drop: 0.2")
        with pytest.raises(ValueError, match=r"began with another sensor \(\w+, now \w+\)"):
            folder.begin_session(config, session._hashes(_env_seen_by(get_sensor(str(file)))))


def _env_seen_by(sensor: Sensor) -> Any:
    part = SimpleNamespace(content_hash="same")
    return SimpleNamespace(sensor=sensor, bank=part, scenes=part, workspace=part)


@pytest.mark.parametrize("cell", ["max", "second", "median"])
def test_the_height_of_a_cell_is_that_of_a_plain_loop(cell: str):
    rng = np.random.default_rng(1)
    points = np.column_stack([rng.uniform(-0.27, -0.2, (400, 2)), rng.uniform(0, 0.3, 400)]).astype(np.float32)
    points[:3] = [[-0.2475, -0.2475, z] for z in (0.1, 0.2, 0.2)]  # two equal ones
    points[3] = [0.1, 0.1, 0.05]  # alone in its cell
    labels, valid = rng.integers(1, 9, 400).astype(np.uint8), rng.random(400) < 0.9
    valid[:4] = True
    height, ids = project_upward(jnp.asarray(points), jnp.asarray(labels), jnp.asarray(valid), cell=cell)
    wanted = {}
    for (x, y, z), label, known in zip(points, labels, valid, strict=True):
        row, col = int(np.floor((y + 0.25) / 0.005)), int(np.floor((x + 0.25) / 0.005))
        if known and row >= 0 and col >= 0:
            wanted.setdefault((row, col), []).append((z, label))
    for (row, col), held in wanted.items():
        held.sort()
        z, label = {"max": held[-1], "second": held[max(len(held) - 2, 0)], "median": held[len(held) // 2]}[cell]
        assert height[row, col] == pytest.approx(z, abs=1e-6) and ids[row, col] == label
    assert int((ids > 0).sum()) == len(wanted)


def test_shadows_lie_on_one_side_and_are_as_wide_as_they_should_be():
    focal, baseline = 600.0, 0.1
    depth = np.full((3, 400), 1.0, np.float32)
    depth[:, 200:250] = 0.8  # an object 0.2 m tall
    seen = np.asarray(sensor._seen_by_both(jnp.asarray(depth), jnp.float32(focal * baseline), 0))
    dark = np.flatnonzero(~seen[1])
    border, beside = dark[dark < 100], dark[dark >= 100]
    assert len(border) == focal * baseline and beside.max() == 199
    assert abs(len(beside) - focal * baseline * (1 / 0.8 - 1 / 1.0)) <= 1


def test_noise_has_the_deviation_of_the_formula():
    camera = heightmap.overhead_camera()
    given = Sensor(baseline=0.095, subpixel=0.08)
    depth = jnp.full(camera.shape, 0.9, jnp.float32)
    told = np.asarray(sensor._measured(depth, given, camera, KEY, KEY, border=0))
    wanted = 0.9**2 * 0.08 / (425 * 0.095)
    assert told.std() == pytest.approx(wanted, rel=0.02) and abs(told.mean() - 0.9) < 0.02 * wanted
    blocks = told.reshape(160, 3, -1)[:, :, :639].reshape(160, 3, 213, 3)
    assert np.ptp(blocks, axis=(1, 3)).max() == 0, "blocks share their error"
    steps = np.asarray(sensor._measured(depth, dataclasses.replace(given, quantum=0.001), camera, KEY, KEY, border=0))
    off = np.abs(steps - np.round(told / 0.001) * 0.001)
    assert (off > 1e-6).mean() < 1e-3 and off.max() < 1.1e-3, "but for what lies between two steps"


def test_pixels_fly_at_edges_only():
    depth = jnp.asarray(np.where(np.arange(100) < 50, 1.0, 0.8)[None].repeat(400, 0), jnp.float32)
    drawn = jax.random.uniform(KEY, depth.shape)
    flown = np.asarray(sensor._with_flying(depth, 0.3, drawn))
    moved = flown != np.asarray(depth)
    assert set(np.flatnonzero(moved.any(axis=0))) <= {49, 50}
    assert moved[:, 49:51].mean() == pytest.approx(0.3, abs=0.05)
    assert flown.min() >= 0.8 and flown.max() <= 1.0


@pytest.fixture(scope="module")
def hulls() -> heightmap.HullInstances:
    """Three boxes in a row, in slots 0, 1 and 3, and one of the robot; the third stands apart.

    No side lies between two rows of cells: to which of them its points belong would depend on how a program rounds.
    """
    places = ((-0.0987, 0.0017), (-0.0187, 0.0017), (0.1513, 0.1017), (0.0013, -0.1483))
    clouds = [box_cloud((x - 0.03, y - 0.03, 0.0), (x + 0.03, y + 0.03, 0.2)) for x, y in places]
    return make_instances(clouds, labels=[1, 2, 4, ROBOT_ID])


def ids_of(hulls: heightmap.HullInstances, target: int = 0, push: int = 0, **effects) -> np.ndarray:
    return np.asarray(run(Sensor(**effects), hulls, jnp.int32(target), jnp.int32(push))[1])


@functools.partial(jax.jit, static_argnums=0)
def run(given: Sensor, hulls: heightmap.HullInstances, target: jax.Array, push: jax.Array) -> tuple:
    return heightmap.sense(given, hulls, heightmap.overhead_camera(), episode=KEY, num_pushes=push, target=target)


def test_an_exact_sensor_is_the_pinhole(hulls):
    own = run(Sensor(), hulls, jnp.int32(0), jnp.int32(0))
    pinhole = jax.jit(lambda h: heightmap.pinhole(h, heightmap.overhead_camera()))(hulls)
    np.testing.assert_allclose(own[0], pinhole[0], atol=1e-5)
    np.testing.assert_array_equal(own[1], pinhole[1])


def test_masks_are_dropped_merged_and_eroded_but_never_the_target_or_the_robot(hulls):
    plain = ids_of(hulls)
    assert set(np.unique(plain)) == {0, 1, 2, 4, ROBOT_ID}
    dropped = ids_of(hulls, target=1, drop=1.0)
    assert set(np.unique(dropped)) == {0, 2, ROBOT_ID}
    eroded = ids_of(hulls, erode=6)
    for label in (1, 2, 4):
        before, after = (plain == label).sum(), (eroded == label).sum()
        assert 0 < after < before and not ((eroded == label) & (plain != label)).any()
    assert (eroded == ROBOT_ID).sum() == (plain == ROBOT_ID).sum()
    seen = set()
    for push in range(12):
        merged = ids_of(hulls, target=1, push=push, merge=1.0)
        assert (merged == 2).any(), "the target's mask stays"
        seen.add(frozenset(np.unique(merged).tolist()))
    assert frozenset({0, 2, 4, ROBOT_ID}) in seen, "its neighbour in slot 0 becomes part of it"


def test_masks_grow_over_the_table_only():
    labels = np.zeros((9, 9), np.uint8)
    labels[4, 4], labels[4, 6] = 3, ROBOT_ID
    grown = np.asarray(sensor._masks(jnp.asarray(labels), None, Sensor(dilate=1), KEY, jnp.int32(0)))  # pyright: ignore[reportArgumentType]
    wanted = labels.copy()
    wanted[3, 4] = wanted[5, 4] = wanted[4, 3] = wanted[4, 5] = 3
    np.testing.assert_array_equal(grown, wanted)


def test_the_same_episode_has_the_same_noise_whatever_else_is_on(hulls):
    poses = jnp.zeros((8, 7)).at[:, 0].set(jnp.arange(8) * 0.01)
    data = [
        jax.random.key_data(sensor.episode_key(given, places, jnp.int32(target)))
        for given, places, target in (
            (SENSORS["d435"], poses, 1),
            (SENSORS["d455"], poses + 1e-7, 1),
            (SENSORS["d455"], poses, 2),
            (SENSORS["d455"], poses.at[3, 1].add(0.01), 1),
            (dataclasses.replace(SENSORS["d455"], seed=5), poses, 1),
        )
    ]
    assert (data[0] == data[1]).all()
    assert all((data[0] != other).any() for other in data[2:])


@pytest.mark.slow
def test_the_robot_stays_exact_under_every_effect(hulls):
    height, ids = (np.asarray(x) for x in run(SENSORS["d435"], hulls, jnp.int32(0), jnp.int32(0)))
    plain_height, plain = (np.asarray(x) for x in run(Sensor(), hulls, jnp.int32(0), jnp.int32(0)))
    both = (ids == ROBOT_ID) & (plain == ROBOT_ID)
    assert both.sum() >= 0.97 * (plain == ROBOT_ID).sum()
    assert (np.abs(height - plain_height)[both] < 1e-4).mean() > 0.9, "but where its sides come into view"
    assert np.abs(height - plain_height)[plain > 0].max() > 1e-3, "the others do not"


def test_variants_differ_in_mass_and_friction_only():
    bank = builtin_bank("seen")
    varied = spread.vary(bank, mass_spread=0.2, friction_spread=0.1, seed=3)
    count = len(bank.names)
    assert varied.names[:count] == bank.names == varied.names[-count:] and len(varied.names) == 16 * count
    ratio = np.asarray(varied.mass).reshape(16, count) / np.asarray(bank.mass)
    np.testing.assert_allclose(np.log(ratio).mean(axis=0), 0.0, atol=1e-5)
    assert np.log(ratio).std() == pytest.approx(0.2, rel=0.1)
    inertia = np.asarray(varied.inertia).reshape(16, count, 3) / np.asarray(bank.inertia)
    np.testing.assert_allclose(inertia, ratio[..., None].repeat(3, -1), rtol=1e-5)
    np.testing.assert_array_equal(varied.object_hulls[count : 2 * count], bank.object_hulls)
