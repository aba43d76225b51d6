"""Objects made for training, against volumes and widths that are known otherwise."""

import dataclasses

import numpy as np
import pytest
from scipy.spatial import ConvexHull

from pregrasp_jax.assets import shapes, variants
from pregrasp_jax.assets.catalogue import builtin_bank
from pregrasp_jax.assets.hulls import volume
from pregrasp_jax.assets.measure import min_width
from pregrasp_jax.config import AssetsConfig, Config
from pregrasp_jax.presets import PRESETS
from pregrasp_jax.task.assembly import load_split_bank

SEED = (5, 0)


@pytest.fixture(scope="module")
def known() -> list[shapes.Parts]:
    return variants.known_parts(builtin_bank("seen"))


@pytest.fixture(scope="module")
def many(known):
    return [variants.draw_variant(known, index, seed=SEED) for index in range(150)]


@pytest.fixture(autouse=True)
def own_cache(tmp_path_factory, monkeypatch):
    monkeypatch.setenv("PREGRASP_JAX_CACHE", str(tmp_path_factory.getbasetemp() / "variants"))


def frustum(radius: float, other: float, height: float) -> float:
    """Return the volume of a frustum whose circles are polygons of `SECTIONS` corners."""
    area = shapes.SECTIONS / 2 * np.sin(2 * np.pi / shapes.SECTIONS)
    return area * height / 3 * (radius**2 + radius * other + other**2)


def test_a_bottle_is_cut_where_it_is_not_convex_and_nowhere_else():
    profile = [(1.0, 0.0), (1.0, 0.1), (0.4, 0.13), (0.4, 0.2)]
    parts = shapes.solid(profile, shapes.superellipse(0.08, 0.08, 2.0, shapes.SECTIONS))
    assert [round(float(part[:, 2].max()), 3) for part in parts] == [0.13, 0.2]
    expected = [frustum(0.04, 0.04, 0.1) + frustum(0.04, 0.016, 0.03), frustum(0.016, 0.016, 0.07)]
    np.testing.assert_allclose([volume(part) for part in parts], expected, rtol=1e-6)


def test_objects_of_which_nothing_can_be_made_are_one_line():
    pencil = shapes.solid([(1.0, 0.0), (1.0, 0.12)], shapes.superellipse(0.02, 0.02, 2.0, shapes.SECTIONS))
    with pytest.raises(ValueError, match=r"no object of the kind 'scaled' can be made of these objects .*a base of"):
        for index in range(20):
            variants.draw_variant([pencil], index, seed=SEED)


def test_the_two_sides_of_a_cut_are_the_whole(known):
    for part in known[2]:
        for z in np.linspace(part[:, 2].min() + 0.01, part[:, 2].max() - 0.01, 4):
            sides = [shapes.cut(part, z, keep_above=above) for above in (False, True)]
            assert sides[0] is not None and sides[1] is not None
            assert sides[0][:, 2].max() <= z + 1e-12 and sides[1][:, 2].min() >= z - 1e-12
            assert volume(sides[0]) + volume(sides[1]) == pytest.approx(volume(part), rel=1e-9)


def test_a_cut_beside_a_part_keeps_it_or_nothing(known):
    part = known[0][0]
    np.testing.assert_array_equal(shapes.cut(part, 1.0, keep_above=False), part)
    assert shapes.cut(part, 1.0, keep_above=True) is None
    assert shapes.cut(part, part[:, 2].max() - 1e-4, keep_above=True) is None, "a sheet is no solid"


def test_all_families_are_made_and_all_could_stand(many):
    names = [item.name.split("_", 2)[2] for item in many]
    assert set(names) == set(shapes.FAMILIES)
    assert abs(names.count("scaled") / len(names) - shapes.FAMILIES["scaled"][1]) < 0.12
    for item in many:
        points = np.concatenate(item.parts)
        assert points[:, 2].min() == pytest.approx(0.0, abs=1e-9)
        assert shapes.HEIGHT[0] <= points[:, 2].max() <= shapes.HEIGHT[1]
        assert np.ptp(points[:, :2], axis=0).max() <= variants.MAX_SIDE
        assert variants.DENSITY[0] <= item.density <= variants.DENSITY[1]
        assert all(volume(part) > 0 for part in item.parts)


def test_targets_of_every_width_that_the_hand_can_take_occur(many):
    """The palm lets 85 mm stand in the region, the fingers 105 mm; what is oblong fits one way only."""
    narrow, wide = [], []
    for item in many:
        outline = np.concatenate(item.parts)[:, :2]
        outline = outline[ConvexHull(outline).vertices]
        narrow.append(min_width(outline) * 1e3)
        wide.append(max(np.ptp(outline @ [np.cos(a), np.sin(a)]) for a in np.linspace(0, np.pi, 64)) * 1e3)
    counts, _ = np.histogram(narrow, bins=[35, 45, 55, 65, 75, 85, 95])
    assert counts.min() >= 5, counts
    fits_one_way = (np.array(narrow) < 85) & (np.array(wide) > 85) & (np.array(wide) < 112)
    assert fits_one_way.sum() >= 15


@pytest.mark.parametrize(
    ("parts", "reason"),
    [
        ([], "0 parts"),
        ([np.eye(3)] * 7, "7 parts"),
        (shapes.solid([(1.0, 0.0), (1.0, 0.3)], shapes.superellipse(0.08, 0.08, 2.0, 8)), "0.300 m high"),
        (shapes.solid([(1.0, 0.0), (1.0, 0.2)], shapes.superellipse(0.2, 0.08, 2.0, 8)), "0.200 m wide"),
        (shapes.solid([(0.3, 0.0), (1.0, 0.2)], shapes.superellipse(0.08, 0.08, 2.0, 8)), "a base of"),
        (shapes.solid([(1.0, 0.0), (1.0, 0.26)], shapes.superellipse(0.14, 0.14, 9.0, 8)), "a mass of"),
    ],
)
def test_what_could_not_stand_is_not_made(parts, reason):
    assert reason in variants.why_not(parts, 300.0)


def test_an_object_depends_on_its_seed_and_number_alone(known, many):
    again = variants.draw_variant(known, 7, seed=SEED)
    assert again.name == many[7].name and again.density == many[7].density
    for part, same in zip(again.parts, many[7].parts, strict=True):
        np.testing.assert_array_equal(part, same)
    other = variants.draw_variant(known, 7, seed=(5, 1))
    assert other.density != many[7].density


def test_splits_meet_different_objects_and_training_the_set_too():
    config = Config(assets=AssetsConfig(variants=3))
    train, validation = (load_split_bank(config, split) for split in ("train", "validation"))
    seen = builtin_bank("seen")
    assert train.names[:17] == seen.names and len(train.names) == 20 and len(validation.names) == 3
    assert not set(np.asarray(train.mass).tolist()) & set(np.asarray(validation.mass).tolist())
    assert load_split_bank(config, "train").content_hash == train.content_hash, "from the cache"
    reseeded = dataclasses.replace(config, scene=dataclasses.replace(config.scene, bank_seed=1))
    assert load_split_bank(reseeded, "train").content_hash != train.content_hash


def test_a_damaged_cache_is_made_anew(tmp_path, monkeypatch):
    monkeypatch.setenv("PREGRASP_JAX_CACHE", str(tmp_path))
    bank = variants.variant_bank(builtin_bank("seen"), 2, seed=SEED)
    (file,) = (tmp_path / "hulls").glob("variants-*.npz")
    file.write_bytes(b"no bank")
    with pytest.warns(UserWarning, match="made anew"):
        again = variants.variant_bank(builtin_bank("seen"), 2, seed=SEED)
    assert again.content_hash == bank.content_hash


def test_no_preset_makes_objects_unless_asked():
    assert {config.assets.variants for config in PRESETS.values()} == {0}
    assert load_split_bank(PRESETS["paper"], "train").content_hash == builtin_bank("seen").content_hash
