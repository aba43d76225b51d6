"""Maps are turned as PPG's reference turns its images, cell by cell, although rows are y here and -y there."""

import numpy as np
import pytest

from pregrasp_jax.spaces.turned_grid import PAD, SIZE, turning, turning_back, window_offsets

HEADINGS = 16


def reference_turn(image, angle, *, outside):
    """Turn an image [row = -y, col] by the published formula: output (x, y) reads (cos x + sin y, -sin x + cos y)."""
    turned = np.zeros_like(image)
    for row in range(SIZE):
        for col in range(SIZE):
            x, y = 2 * col / (SIZE - 1) - 1, 2 * row / (SIZE - 1) - 1
            u, v = np.cos(angle) * x + np.sin(angle) * y, -np.sin(angle) * x + np.cos(angle) * y
            c, r = (round(round((w + 1) / 2 * (SIZE - 1), 9)) for w in (u, v))
            if outside is None or (0 <= r < SIZE and 0 <= c < SIZE):
                turned[row, col] = image[min(max(r, 0), SIZE - 1), min(max(c, 0), SIZE - 1)]
            else:
                turned[row, col] = outside
    return turned


@pytest.fixture(scope="module")
def image():
    return np.random.default_rng(0).normal(size=(SIZE, SIZE))


@pytest.mark.parametrize("heading", [0, 1, 6, 12])
def test_turning_and_back_are_the_published_formula_on_a_flipped_image(image, heading):
    angle = 2 * np.pi * heading / HEADINGS
    flipped = image[::-1]
    turned = image.ravel()[turning(HEADINGS)[heading]].reshape(SIZE, SIZE)
    np.testing.assert_array_equal(turned[::-1], reference_turn(flipped, angle, outside=None))
    table, inside = (array[heading] for array in turning_back(HEADINGS))
    back = np.where(inside, image.ravel()[table], 0.0).reshape(SIZE, SIZE)
    np.testing.assert_array_equal(back[::-1], reference_turn(flipped, -angle, outside=0.0))


def test_a_heading_points_to_plus_column_in_the_turned_map():
    rows, cols = np.indices((SIZE, SIZE)) - (SIZE - 1) / 2
    for heading in range(HEADINGS):
        angle = 2 * np.pi * heading / HEADINGS
        along = cols * np.cos(angle) + rows * np.sin(angle)
        turned = along.ravel()[turning(HEADINGS)[heading]].reshape(SIZE, SIZE)
        inner = slice(SIZE // 2 - 40, SIZE // 2 + 40)
        np.testing.assert_allclose(turned[inner, inner], cols[inner, inner], atol=0.75)


def test_right_angles_are_exact_and_others_return_most_inner_cells():
    cells = np.arange(SIZE * SIZE).reshape(SIZE, SIZE)
    for heading in range(HEADINGS):
        turned = cells.ravel()[turning(HEADINGS)[heading]]
        table, inside = (array[heading].reshape(SIZE, SIZE) for array in turning_back(HEADINGS))
        inner = slice(PAD, SIZE - PAD)
        assert inside[inner, inner].all()
        same = (turned[table] == cells)[inner, inner].mean()
        assert same == 1.0 if heading % 4 == 0 else 0.80 < same < 0.90


@pytest.mark.parametrize("heading", range(HEADINGS))
def test_the_window_lies_ahead_of_the_start(heading):
    offsets = window_offsets(HEADINGS, 64)[heading]
    assert offsets.shape == (64, 64, 2) and not offsets[32, 0].any()
    angle = 2 * np.pi * heading / HEADINGS
    np.testing.assert_allclose(offsets[32, 40], [40 * np.sin(angle), 40 * np.cos(angle)], atol=0.5)
    np.testing.assert_allclose(offsets[42, 0], [10 * np.cos(angle), -10 * np.sin(angle)], atol=0.5)
