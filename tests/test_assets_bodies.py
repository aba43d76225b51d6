"""Parts that hold together and parts that do not, against distances that are known."""

import numpy as np
import pytest
import trimesh

from pregrasp_jax.assets.bodies import TOUCHING, count_bodies, gap, remark
from pregrasp_jax.assets.catalogue import builtin_bank
from pregrasp_jax.assets.meshes import load_object_dir
from pregrasp_jax.assets.variants import known_parts


def block(x: float = 0.0, y: float = 0.0, z: float = 0.0, size: float = 0.06) -> np.ndarray:
    """Return the corners of a cube."""
    return np.array(trimesh.creation.box((size, size, size)).vertices) + np.array([x, y, z])


@pytest.mark.parametrize(
    ("offset", "distance"),
    [((0.12, 0, 0), 0.06), ((0.0, -0.07, 0.01), 0.01), ((0.08, 0.09, 0), 0.03), ((0.06, 0, 0), 0), ((0.01, 0, 0), 0)],
)
def test_the_gap_between_two_cubes(offset, distance):
    assert gap(block(), block(*offset)) == pytest.approx(distance, abs=1e-6)


def test_a_gap_is_between_faces_and_not_between_corners():
    """A plate above a cube: no corner of one is near to a corner of the other."""
    plate = np.array(trimesh.creation.box((1.0, 1.0, 0.01)).vertices) + np.array([0.2, 0.1, 0.055])
    assert gap(block(), plate) == pytest.approx(0.02, abs=1e-6)


def test_bodies_are_groups_of_parts_that_touch():
    chain = [block(), block(0.06), block(0.12)]
    assert count_bodies(chain[:1]) == 1 and count_bodies(chain) == 1
    assert count_bodies([chain[2], chain[0]]) == 2 and count_bodies([*chain, block(0, 0.2)]) == 2
    assert count_bodies([block(), block(0.06 + 0.9 * TOUCHING)]) == 1
    assert count_bodies([block(), block(0.06 + 1.1 * TOUCHING)]) == 2
    assert remark(chain) == "" and "holds 3 bodies" in remark([block(), block(0.2), block(0.4)])


@pytest.mark.parametrize("object_set", ["seen", "unseen"])
def test_the_built_in_objects_hold_together(object_set):
    counts = [count_bodies(parts) for parts in known_parts(builtin_bank(object_set)) if len(parts) > 1]
    assert len(counts) >= 2 and set(counts) == {1}


def test_a_file_with_two_things_in_it_is_told(tmp_path):
    (tmp_path / "set").mkdir()
    box = trimesh.creation.box((0.05, 0.05, 0.15))
    two = trimesh.util.concatenate([box, box.copy().apply_translation([0.07, 0, 0])])
    for name, mesh in (("one", box), ("two", two)):
        mesh.export(tmp_path / "set" / f"{name}.stl")  # pyright: ignore[reportAttributeAccessIssue]
    loaded = load_object_dir(tmp_path / "set", "seen")
    assert [(note.name, "holds 2 bodies" in note.text) for note in loaded.notes] == [("two.stl", True)]
