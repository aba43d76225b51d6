"""Hulls and measures against closed forms, trimesh, shapely and scipy."""

import numpy as np
import pytest
import shapely
import trimesh
from scipy.spatial import ConvexHull

from pregrasp_jax.assets.catalogue import builtin_bank
from pregrasp_jax.assets.hulls import make_hulls, polytope, simplify, volume
from pregrasp_jax.assets.measure import measure, min_width, projection
from pregrasp_jax.robot import closing_region
from pregrasp_jax.robot.closing_region import best_coverage
from pregrasp_jax.robot.ur5e_rg2 import CLOSING_REGION_SIZE, FINGER_OPEN, region
from pregrasp_jax.types import COARSE_TOPOLOGY, FULL_TOPOLOGY

REGION = region(np.float32(FINGER_OPEN))  # pyright: ignore[reportArgumentType]


def cylinder(radius: float = 0.04, height: float = 0.2) -> np.ndarray:
    points = trimesh.creation.cylinder(radius=radius, height=height, sections=256).vertices
    return np.asarray(points) + np.array([0.0, 0.0, height / 2])


def measured(*parts: np.ndarray):
    hulls = make_hulls(parts, FULL_TOPOLOGY)
    return measure(np.asarray(hulls.vertices), np.asarray(hulls.planes))


def box_points(size: tuple[float, float, float], center: tuple[float, float, float]) -> np.ndarray:
    return np.asarray(trimesh.creation.box(size).vertices) + center


def rectangle(width: float, depth: float, step: float = 5e-4) -> tuple[np.ndarray, np.ndarray]:
    """Cells and outline of a rectangle centred on the origin."""
    x = np.arange(-width / 2 + step / 2, width / 2, step)
    y = np.arange(-depth / 2 + step / 2, depth / 2, step)
    cells = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    return cells, np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * [width / 2, depth / 2]


def test_polytope_of_a_box_has_six_faces_and_twelve_edges():
    box = polytope(box_points((0.04, 0.06, 0.2), (0.0, 0.0, 0.1)))
    assert box.vertices.shape == (8, 3)
    assert box.planes.shape == (6, 4)  # twelve triangles would mean that coplanar ones were not merged
    lengths = np.linalg.norm(np.diff(box.vertices[box.edges], axis=1)[:, 0], axis=1)
    np.testing.assert_allclose(np.sort(lengths), np.repeat([0.04, 0.06, 0.2], 4))
    np.testing.assert_allclose(np.sort(box.planes[:, 3]), [0.0, 0.02, 0.02, 0.03, 0.03, 0.2], atol=1e-12)


@pytest.mark.parametrize(("topology", "share"), [(FULL_TOPOLOGY, 0.97), (COARSE_TOPOLOGY, 0.90)])
def test_simplified_cylinder_lies_inside_and_keeps_its_volume_and_base(topology, share):
    points = cylinder()
    kept = simplify(points, topology[0], {FULL_TOPOLOGY: 12, COARSE_TOPOLOGY: 8}[topology])
    assert len(kept) <= topology[0]
    assert {tuple(p) for p in kept} <= {tuple(p) for p in points}
    assert share * 0.99 < volume(kept) / volume(points) < 1.0
    assert (kept[:, 2] == 0.0).sum() >= 8


def test_rounding_does_not_choose_among_equally_far_points():
    """Processors differ in the last bits of a product, and a symmetric shape is full of ties."""
    angle = 2 * np.pi * np.arange(256) / 256
    circle = 0.04 * np.column_stack([np.cos(angle), np.sin(angle)])
    points = np.concatenate([np.column_stack([circle, np.full(256, z)]) for z in (0.0, 0.2)])
    expected = simplify(points, 32, 12)
    for seed in range(5):
        noise = np.random.default_rng(seed).normal(scale=1e-15, size=points.shape) * (points != 0.0)
        np.testing.assert_allclose(simplify(points + noise, 32, 12), expected, atol=1e-12)


def test_a_point_under_the_base_ring_is_not_lost():
    """Decoy: choosing the ring first must not keep the hull from growing below or beside it."""
    points = np.concatenate([cylinder(), [[0.09, 0.0, 0.1]]])
    assert (simplify(points, 32, 12)[:, 0] == 0.09).any()


def test_padding_repeats_the_last_element_and_planes_hold_every_vertex():
    hulls = make_hulls([cylinder(), box_points((0.05, 0.05, 0.1), (0.0, 0.0, 0.05))], FULL_TOPOLOGY)
    vertices, planes, edges = (np.asarray(a) for a in (hulls.vertices, hulls.planes, hulls.edges))
    assert [a.shape[1] for a in (vertices, planes, edges)] == list(FULL_TOPOLOGY)
    assert (vertices[1, 8:] == vertices[1, 7]).all()
    assert (planes[1, 6:] == planes[1, 5]).all()
    assert (edges[1, 12:] == edges[1, 11]).all()
    slack = np.einsum("mvk,mfk->mvf", vertices, planes[..., :3]) - planes[:, None, :, 3]
    assert slack.max() < 1e-7
    np.testing.assert_allclose(np.linalg.norm(planes[..., :3], axis=-1), 1.0, rtol=1e-6)
    # Independent volume: the divergence theorem over the half-spaces' own vertices.
    assert ConvexHull(vertices[0].astype(np.float64)).volume == pytest.approx(volume(cylinder()), rel=0.04)


def test_euler_holds_on_random_hulls():
    rng = np.random.default_rng(0)
    for _ in range(20):
        solid = polytope(simplify(rng.normal(size=(200, 3)) * 0.05, 32, 12))
        assert len(solid.vertices) - len(solid.edges) + len(solid.planes) == 2


def test_flat_points_are_refused():
    with pytest.raises(ValueError, match=r"flat: thinner than 0\.5 mm"):
        simplify(np.random.default_rng(0).random((50, 3)) * [0.1, 0.1, 1e-4], 32, 12)
    assert volume(np.random.default_rng(0).random((50, 3)) * [0.1, 0.1, 1e-4]) == 0.0


def test_mass_properties_of_a_shifted_box():
    found = measured(box_points((0.04, 0.06, 0.2), (0.3, -0.1, 0.15)))
    assert found.volume == pytest.approx(4.8e-4, rel=2e-3)
    np.testing.assert_allclose(found.com, [0.3, -0.1, 0.15], atol=1e-5)
    expected = 4.8e-4 / 12 * np.array([0.06**2 + 0.2**2, 0.04**2 + 0.2**2, 0.04**2 + 0.06**2])
    np.testing.assert_allclose(np.diag(found.inertia), expected, rtol=3e-3)


def test_overlapping_hulls_count_once():
    """Two 0.1 m boxes that share half: 1.5 boxes, not 2; the sum of both is the decoy."""
    found = measured(box_points((0.1, 0.1, 0.1), (0.0, 0.0, 0.05)), box_points((0.1, 0.1, 0.1), (0.0, 0.0, 0.10)))
    assert found.volume == pytest.approx(1.5e-3, rel=2e-3)
    assert found.com[2] == pytest.approx(0.075, abs=1e-4)


def test_a_gap_between_hulls_has_no_mass():
    found = measured(box_points((0.1, 0.1, 0.02), (0.0, 0.0, 0.01)), box_points((0.1, 0.1, 0.02), (0.0, 0.0, 0.19)))
    assert found.volume == pytest.approx(4e-4, rel=2e-3)
    expected = 4e-4 * (0.1**2 / 12 + 0.02**2 / 12 + 0.09**2)
    assert found.inertia[0, 0] == pytest.approx(expected, rel=3e-3)


def test_inertia_products_have_trimesh_signs():
    mesh = trimesh.creation.box((0.04, 0.06, 0.2))
    mesh.apply_transform(trimesh.transformations.rotation_matrix(0.4, [1.0, 2.0, 0.5]))
    mesh.density = 1.0
    found = measured(np.asarray(mesh.vertices))
    np.testing.assert_allclose(found.inertia, mesh.moment_inertia, atol=2e-3 * np.abs(mesh.moment_inertia).max())


def test_min_width_is_the_smallest_caliper():
    """A 3-4-5 triangle is 2.4 wide; its bounding box says 3."""
    assert min_width(np.array([[0.0, 0.0], [4.0, 0.0], [0.0, 3.0]])) == pytest.approx(2.4)


def test_coverage_of_rectangles_by_hand():
    depth, width = CLOSING_REGION_SIZE
    assert best_coverage(*rectangle(depth - 0.002, width - 0.002), REGION) == 1.0
    # Square to the hand, what sticks out is lost: 0.0855 of 0.12 m ahead of the palm, not 0.0855 of it centred.
    assert best_coverage(*rectangle(0.12, 0.108), REGION) == pytest.approx(0.0855 / 0.108 * 0.11 / 0.12, abs=0.01)
    assert best_coverage(*rectangle(0.2, 0.2), REGION) < 0.3


def test_coverage_is_the_share_that_shapely_finds():
    """A triangle, yaw by yaw, flush with the palm; a placement centred in depth is the decoy."""
    outline = np.array([[0.0, 0.0], [0.16, 0.0], [0.0, 0.12]])
    cells, _ = rectangle(0.4, 0.4)
    cells = cells[(cells >= 0).all(axis=1) & (cells[:, 0] / 0.16 + cells[:, 1] / 0.12 <= 1.0)]
    best = 0.0
    for yaw in np.arange(144) * 2.5:
        turned = shapely.affinity.rotate(shapely.Polygon(outline), -yaw, origin=(0, 0))
        x0, y0, _, y1 = turned.bounds
        middle = (y0 + y1) / 2
        square = shapely.box(x0, middle - 0.055, x0 + 0.0855, middle + 0.055)
        best = max(best, turned.intersection(square).area / turned.area)
    assert best_coverage(cells, outline, REGION) == pytest.approx(best, abs=0.005)
    assert 0.5 < best < 0.95


def test_the_search_that_stops_early_finds_the_maximum():
    """Against every yaw with every cell, over all built-in objects and random polygons; a bound ends it sooner."""
    rng = np.random.default_rng(5)
    shapes = [projection(bank, i) for bank in map(builtin_bank, ("seen", "unseen")) for i in range(len(bank.names))]
    for _ in range(20):
        points = rng.normal(size=(8, 2)) * rng.uniform(0.02, 0.08, 2)
        outline = points[ConvexHull(points).vertices]
        sides = ConvexHull(points).equations
        low, high = outline.min(axis=0), outline.max(axis=0)
        axes = [np.linspace(low[i], high[i], 193)[:-1] + (high[i] - low[i]) / 384 for i in range(2)]  # as objects have
        cells = np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, 2)
        shapes.append((cells[(cells @ sides[:, :2].T + sides[:, 2] <= 0).all(axis=1)], outline))
    yaws = np.arange(144) * (2 * np.pi / 144)
    found = []
    for cells, outline in shapes:
        every = closing_region._coverage_at(yaws, cells, outline, REGION)
        some = closing_region._coverage_at(yaws, cells[:: closing_region._SAMPLE], outline, REGION)
        assert np.abs(every - some).max() < closing_region._SAMPLE_ERROR, "by which yaws are left out"
        largest = float(every.max())
        assert best_coverage(cells, outline, REGION) == largest
        enough = best_coverage(cells, outline, REGION, enough=0.97)
        assert (enough > 0.97) == (largest > 0.97) and enough <= largest
        found.append(largest)
    assert min(found) < 0.9 and max(found) == 1.0
