"""Hulls against their mesh, solids as columns, and which side is the base."""

import numpy as np
import pytest
import trimesh

from pregrasp_jax.assets import columns, decompose, fit
from pregrasp_jax.assets.decompose import finish, repair
from pregrasp_jax.assets.fit import Fit, compare, fit_parts
from pregrasp_jax.assets.standing import better_axes, doubt


def revolve(*profile: tuple[float, float]) -> trimesh.Trimesh:
    """Return a solid of revolution of (radius, z) in mm."""
    return trimesh.creation.revolve(np.array(profile) / 1000, sections=24)


def box(size: tuple[float, float, float], center: tuple[float, float, float]) -> trimesh.Trimesh:
    mesh = trimesh.creation.box(size)
    mesh.apply_translation(center)
    return mesh


def join(*meshes: trimesh.Trimesh) -> trimesh.Trimesh:
    return trimesh.util.concatenate(meshes)  # pyright: ignore[reportReturnType]


def cut(mesh: trimesh.Trimesh) -> tuple[columns.Columns, float]:
    """Return the columns of a mesh, and the area of each."""
    x, y = columns.grid(mesh.bounds[0, :2], mesh.bounds[1, :2])
    return columns.cut(np.asarray(mesh.vertices), np.asarray(mesh.faces), x, y), float((x[1] - x[0]) * (y[1] - y[0]))


FOLDED_CAN = [(0, 6), (45, 6), (45, 0), (51, 0), (51, 140), (49, 140), (51.6, 133), (47, 126), (0, 126)]
"""Closed, but its inner wall runs out through the outer one and back: CoACD remeshes that, and inflates it."""


@pytest.mark.parametrize(
    ("mesh", "volume"),
    [
        (trimesh.creation.box((0.06, 0.08, 0.1)), 480e-6),
        (revolve((0, 0), (40, 0), (40, 100), (0, 100)), 499.9e-6),
        # Overlapping bodies count once: 0.1^3 twice, half of it shared; 2000 is what the faces sum up to.
        (join(box((0.1, 0.1, 0.1), (0, 0, 0)), box((0.1, 0.1, 0.1), (0, 0, 0.05))), 1500e-6),
        # A cavity is none of it.
        (revolve((0, 10), (30, 10), (30, 100), (40, 100), (40, 0), (0, 0)), 248.4e-6),
    ],
)
def test_columns_hold_the_volume(mesh, volume):
    mesh.fix_normals()
    found, area = cut(mesh)
    assert found.known.all()
    assert found.length.sum() * area == pytest.approx(volume, rel=0.02)


def test_the_floor_closes_a_base_that_is_missing():
    """As scans are that stood on a table; with the wrong sign the box would be hollow."""
    mesh = trimesh.creation.box((0.1, 0.1, 0.1))
    mesh.update_faces(~(mesh.triangles[:, :, 2] < 0).all(axis=1))
    found, _ = cut(mesh)
    assert found.known.all() and found.length == pytest.approx(0.1)
    parts, fitted = fit_parts(mesh)
    assert len(parts) == 1 and fitted.is_good


def test_columns_below_a_hole_are_not_known():
    mesh = trimesh.creation.box((0.1, 0.1, 0.1))
    top = np.flatnonzero((mesh.triangles[:, :, 2] > 0.04).all(axis=1))
    mesh.update_faces(np.arange(len(mesh.faces)) != top[0])
    found, _ = cut(mesh)
    assert found.known.mean() == pytest.approx(0.5, abs=0.02)
    assert found.length[found.known] == pytest.approx(0.1)
    assert np.isnan(compare(mesh, (np.asarray(mesh.vertices) + np.array([0, 0, 0.05]),)).volume)


def test_comparison_by_hand():
    """A box 3 mm too wide and a tenth too high, against columns of a coarser grid than its own."""
    mesh = trimesh.creation.box((0.06, 0.06, 0.1))
    part = np.asarray(trimesh.creation.box((0.063, 0.06, 0.11)).vertices) + np.array([0, 0, 0.055])
    found = compare(mesh, (part,))
    np.testing.assert_allclose(found.hulls - found.mesh, [0.003, 0.0, 0.01], atol=1e-9)
    assert found.volume == pytest.approx(1.05 * 1.1, rel=0.01)
    assert found.difference == pytest.approx(1.05 * 1.1 - 1, abs=0.012)
    assert found.remark() == "hulls 63 x 60 x 110 mm, mesh 60 x 60 x 100 mm; volume 1.15 x that of the mesh"


def test_a_notch_that_a_bulge_outweighs_is_a_difference():
    """Half of a box twice as wide has its volume; what differs is all of it, once more."""
    mesh = box((0.1, 0.1, 0.1), (0, 0, 0.05))
    part = np.asarray(trimesh.creation.box((0.05, 0.1, 0.2)).vertices) + np.array([0.025, 0, 0.1])
    found = compare(mesh, (part,))
    assert found.volume == pytest.approx(1.0, abs=0.02) and found.difference == pytest.approx(1.0, abs=0.03)


def test_small_differences_need_no_remark():
    def made(width: float, volume: float) -> Fit:
        return Fit(np.array([0.06, 0.06, 0.1]), np.array([width, 0.06, 0.1]), volume, 0.01)

    assert made(0.0609, 1.04).remark() == ""
    assert made(0.0611, 1.0).remark().startswith("hulls 61 x 60 x 100 mm, mesh 60 x")
    assert made(0.06, 0.94).remark() == "size as the mesh, 60 x 60 x 100 mm; volume 0.94 x that of the mesh"
    assert "too open to have a volume" in made(0.06, np.nan).remark()
    again = Fit.from_numbers(made(0.0611, 0.9).as_numbers())
    assert again.remark() == made(0.0611, 0.9).remark()


@pytest.mark.slow  # and CoACD takes 2 GB and more for a mesh that it has to remesh
def test_a_closed_mesh_that_crosses_itself_keeps_its_size(monkeypatch):
    for quick, value in {"threshold": 0.3, "resolution": 200, "mcts_nodes": 5, "mcts_iterations": 5}.items():
        monkeypatch.setitem(decompose._COACD, quick, value)
    mesh = repair(revolve(*FOLDED_CAN))
    assert mesh.is_watertight and mesh.body_count == 1
    candidates = list(fit._candidates(mesh))
    assert len(candidates) == 3
    remeshed = compare(mesh, finish(candidates[1]))  # as CoACD returns them, and as `decompose` takes them
    assert remeshed.off > 1e-3
    monkeypatch.setattr(fit, "_candidates", lambda mesh: iter(candidates))
    parts, found = fit_parts(mesh)
    np.testing.assert_allclose(np.ptp(np.concatenate(parts), axis=0), mesh.extents, atol=1e-3)
    assert found.difference <= remeshed.difference


def test_each_body_that_is_convex_is_a_part():
    """Foot, stem and a bowl of a solid glass: no cutting, and nothing of its diameter is lost."""
    foot = revolve((0, 0), (35, 0), (35, 3), (6, 12), (0, 12))
    stem = revolve((0, 8), (5, 8), (5, 100), (0, 100))
    bowl = revolve((0, 95), (20, 100), (38, 130), (40, 160), (34, 200), (0, 200))
    mesh = repair(join(foot, stem, bowl))
    assert mesh.body_count == 3
    raw = list(zip(range(2), fit._candidates(mesh), strict=False))[1][1]
    assert len(raw) == 3
    parts = fit._stretched(tuple(raw), mesh.extents)
    np.testing.assert_allclose(compare(mesh, parts).hulls, mesh.extents, atol=1e-6)


def test_stretching_brings_back_what_simplification_lost_but_no_missing_part():
    part = np.asarray(trimesh.creation.box((0.06, 0.06, 0.1)).vertices) + np.array([0.01, 0, 0.05])
    (grown,) = fit._stretched((part,), np.array([0.0615, 0.08, 0.101]))
    np.testing.assert_allclose(np.ptp(grown, axis=0), [0.0615, 0.06, 0.101], atol=1e-12)
    assert grown[:, 2].min() == 0.0
    assert grown[:, 0].mean() == pytest.approx(0.01)


MUG = join(
    trimesh.creation.cylinder(0.045, 0.12, sections=48),
    trimesh.creation.box((0.03, 0.02, 0.08), trimesh.transformations.translation_matrix((0.055, 0, 0))),
)
CUP = revolve((0, 0), (28, 0), (42, 115), (0, 115))
BOTTLE = revolve((0, 0), (40, 0), (40, 100), (12, 130), (12, 200), (0, 200))


@pytest.mark.parametrize("mesh", [MUG, CUP, BOTTLE, trimesh.creation.box((0.04, 0.15, 0.2))])
def test_what_stands_is_left_standing(mesh):
    """A carton has a base on every side, and a cup a wider one on top."""
    assert doubt(np.asarray(mesh.vertices), np.asarray(mesh.faces), ".stl", None) == ""


@pytest.mark.parametrize("mesh", [MUG, BOTTLE])
@pytest.mark.parametrize(("axis", "shift"), [("x", 1), ("y", 2)])
def test_what_lies_on_its_side_is_doubted(mesh, axis, shift):
    vertices = np.roll(np.asarray(mesh.vertices), shift, axis=1)
    assert better_axes(vertices, np.asarray(mesh.faces)) == (axis,)
    said = doubt(vertices, np.asarray(mesh.faces), ".stl", None)
    assert said.startswith("may lie on its side: the base covers ") and f"with up: {axis}, -{axis}; set it in" in said


def test_a_format_is_believed_unless_the_shape_speaks_against_it():
    carton = trimesh.creation.box((0.04, 0.15, 0.2))
    said = doubt(np.asarray(carton.vertices), np.asarray(carton.faces), ".glb", "y")
    assert said.startswith("z is taken to be up, by its .glb format it is y; set up: y in objects.yaml")
    assert doubt(np.asarray(BOTTLE.vertices), np.asarray(BOTTLE.faces), ".glb", "y") == ""
