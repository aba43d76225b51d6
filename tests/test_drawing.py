import functools

import jax.numpy as jnp
import numpy as np
import pytest
import trimesh
from fake_env import ACTIONS, OPEN, hand_at
from heightmap_oracle import box_cloud, make_instances, pad
from PIL import Image

from pregrasp_jax import drawing
from pregrasp_jax.assets.bank import ConvexObject, make_bank, select
from pregrasp_jax.assets.catalogue import builtin_bank
from pregrasp_jax.drawing import shaded
from pregrasp_jax.spaces.actions import ActionSpace, Choice
from pregrasp_jax.types import ROBOT_ID, Observation

SHAPE = (60, 80)


def color_of(image: np.ndarray, color: np.ndarray) -> np.ndarray:
    """Return where the hue of an image is that of a colour, whatever the light."""
    direction = image / np.maximum(np.linalg.norm(image, axis=-1, keepdims=True), 1e-9)
    return direction @ (color / np.linalg.norm(color)) > 0.995


def centroid(mask: np.ndarray) -> np.ndarray:
    assert mask.any()
    return np.argwhere(mask).mean(axis=0)


def test_view_from_the_side_is_not_mirrored():
    """The target is at +x and near the viewer (-y): right of and below the middle of the picture."""
    cube = functools.partial(box_cloud, (0.15, -0.2, 0), (0.2, -0.15, 0.05))
    hulls = make_instances([cube(), box_cloud((-0.2, 0.15, 0), (-0.15, 0.2, 0.05))], [4, 1])
    image = drawing.draw_camera(hulls, target_slot=3, camera=drawing.side_view(SHAPE))
    assert image.shape == (*SHAPE, 3) and image.dtype == np.uint8
    row, col = centroid(color_of(image, drawing.TARGET_COLOR))
    assert row > 35 and col > 45
    # Highlighting another slot moves the colour to the far left.
    image = drawing.draw_camera(hulls, target_slot=0, camera=drawing.side_view(SHAPE))
    row, col = centroid(color_of(image, drawing.TARGET_COLOR))
    assert row < 25 and col < 35


def test_light_comes_from_above_and_casts_shadows():
    hulls = make_instances([box_cloud((-0.05, -0.05, 0), (0.05, 0.05, 0.15))], [1])
    camera = drawing.look_at((0.0, -0.02, 1.2), (0.0, 0.0, 0.0), fovy=np.deg2rad(30.0), shape=SHAPE)
    lit, empty = (
        drawing.draw_camera(h, camera=camera).astype(float) for h in (hulls, hulls.replace(present=jnp.zeros(1, bool)))
    )
    darker = (empty - lit).mean(axis=-1) > 40
    # The lamp is at -x, -y: the shadow falls to the right and away from the viewer.
    assert darker[:25, 45:].sum() > 10 and not darker[40:, :30].any()
    normals = shaded._normals(
        np.asarray(hulls.planes), np.array([1, 1, 0]), np.array([[0, 0, 0.15], [0, -0.05, 0.1], [1, 1, 0]])
    )
    np.testing.assert_allclose(normals, [[0, 0, 1], [0, -1, 0], [0, 0, 1]], atol=1e-6)


def test_maps_have_x_to_the_right_and_y_up():
    height = np.zeros((100, 100), np.uint8)
    height[10, 80] = 255  # y = -0.1975, x = 0.1525
    ids = np.zeros((100, 100), np.uint8)
    ids[10, 80], ids[11, 80] = 3, ROBOT_ID
    image = drawing.draw_heightmap(height, size=200)
    np.testing.assert_array_equal(np.argwhere(image[..., 0] > 200)[[0, -1]], [[178, 160], [179, 161]])
    image = drawing.draw_segmentation(ids, target_slot=2, size=200)
    np.testing.assert_array_equal(image[178, 160], drawing.TARGET_COLOR)
    np.testing.assert_array_equal(image[176, 160], drawing.ROBOT_COLOR)
    np.testing.assert_array_equal(image[21, 160], drawing.TABLE_COLOR)


def test_q_map_shows_values_inside_the_mask_only():
    q, mask = np.zeros((100, 100)), np.zeros((100, 100), bool)
    mask[40:60, 50:70] = True
    q[50, 60], q[90, 90] = 1.0, 100.0  # the second is outside: it must neither be seen nor set the scale
    image = drawing.draw_q_map(q, mask, size=200).astype(int)
    assert image[98, 120].sum() > 550 and image[110, 110].sum() < 60
    np.testing.assert_array_equal(image[18, 180], [70, 70, 70])
    np.testing.assert_array_equal(image[80, 105], [240, 240, 240])
    empty = drawing.draw_q_map(q, np.zeros_like(mask), size=200)
    assert (empty == 70).all()


def test_q_map_draws_the_push_where_it_is():
    mask = np.ones((100, 100), bool)
    image = drawing.draw_q_map(np.zeros((100, 100)), mask, push=((-0.20, -0.20), (0.10, 0.20)), size=200)
    rows, columns = np.nonzero((image == (90, 220, 255)).all(axis=-1))
    assert abs(rows.min() - 20) <= 3 and abs(rows.max() - 180) <= 5
    assert abs(columns.max() - 140) <= 3 and abs(columns.min() - 20) <= 5


def test_panel_draws_the_push_on_the_map_of_its_aperture():
    hulls = make_instances([box_cloud((0.0, -0.02, 0), (0.05, 0.02, 0.12))], [1])
    blank = jnp.zeros((100, 100), jnp.uint8)
    obs = Observation(height=blank, instance_ids=blank, hand=hand_at((-0.2, 0.0)))
    mask = np.zeros(ACTIONS.shape, bool)
    mask[40:60, 20:40] = True
    taken = drawing.Taken(OPEN, (-0.2, 0.0), (-0.07, 0.0))
    tiles = functools.partial(drawing.make_tiles, hulls, obs, 0, actions=ACTIONS, mask=mask)
    for q_values in (None, np.random.default_rng(0).normal(size=(100, 100, 2))):
        with_push, without = (
            drawing.make_panel(tiles(q_values=q_values, taken=chosen), title="test") for chosen in (taken, None)
        )
        assert with_push.shape == without.shape
        changed = np.nonzero((with_push != without).any(axis=(0, 2)))[0]
        assert changed.min() > with_push.shape[1] - 320


def test_of_many_choices_the_best_are_drawn_and_the_chosen_one_among_them():
    made = [Choice(name=f"held {k}", z=0.1, yaw=0.0, aperture=float(k)) for k in range(7)]
    actions = ActionSpace(tuple(made), mirrored=tuple(range(7)))
    hulls = make_instances([box_cloud((0.0, -0.02, 0), (0.05, 0.02, 0.12))], [1])
    blank = jnp.zeros((100, 100), jnp.uint8)
    obs = Observation(height=blank, instance_ids=blank, hand=hand_at((-0.2, 0.0)))
    mask = np.ones(actions.shape, bool)
    mask[..., 6] = False
    q_values = np.zeros(actions.shape)
    q_values[50, 50] = [0.3, 0.1, 0.9, 0.2, 0.8, 0.7, 5.0]  # the largest is not allowed
    tiles = functools.partial(drawing.make_tiles, hulls, obs, 0, actions=actions, mask=mask, q_values=q_values)
    worst = drawing.Taken(1, (-0.2, 0.0), (0.05, 0.0))
    shown, chosen = ([caption for caption, _ in tiles(taken=taken)[3:]] for taken in (None, worst))
    names = [[int(caption.split()[2]) for caption in captions] for captions in (shown, chosen)]
    best = [2, 4, 5, 0, 3]
    assert names[0] == sorted(best[: len(names[0])]) and 1 < len(names[0]) < 7
    assert names[1] == sorted([1, *best[: len(names[0]) - 1]])
    assert [caption for caption, _ in tiles(taken=worst, q_values=None)[3:]] == ["push held 1"], "no values, one map"


def test_contact_sheet_shows_every_object():
    bank = select(builtin_bank("seen"), [0, 4])
    sheet = drawing.contact_sheet(bank, np.array([True, False]), columns=1)
    assert sheet.shape[0] == 2 * (sheet.shape[0] // 2)
    for half in np.split(sheet, 2):
        assert color_of(half.astype(float), drawing.OBSTACLE_COLORS[0]).mean() > 0.02


def test_contact_sheet_shows_the_tallest_object_whole():
    """A head that is cut off reaches the upper edge of its picture, where a low object leaves only floor."""
    tall, low = (
        np.asarray(trimesh.creation.box((0.2, 0.2, height)).vertices) + np.array([0, 0, height / 2])
        for height in (0.30, 0.02)
    )
    pictures = [
        drawing.contact_sheet(make_bank([ConvexObject("x", [part])]), np.array([True]))[8:228, 8:228]
        for part in (tall, low)
    ]
    differs = (pictures[0] != pictures[1]).any(axis=2)
    assert differs[60:].any() and not differs[:3].any() and not differs[:, :3].any()
    assert not differs[:100, -3:].any(), "below, its shadow leaves the picture"


def test_files_hold_what_was_drawn(tmp_path):
    frames = [np.full((20, 30, 3), value, np.uint8) for value in (10, 120, 240)]
    drawing.save_image(tmp_path / "a.png", frames[1])
    np.testing.assert_array_equal(np.asarray(Image.open(tmp_path / "a.png")), frames[1])
    drawing.save_film(tmp_path / "a.gif", frames, seconds_per_frame=0.5)
    movie = Image.open(tmp_path / "a.gif")
    assert getattr(movie, "n_frames", 1) == 3 and movie.info["duration"] == 500 and movie.info["loop"] == 0
    for i, frame in enumerate(frames):
        movie.seek(i)
        assert np.abs(np.asarray(movie.convert("RGB")).astype(int) - frame).max() <= 2
    with pytest.raises(ValueError, match="at least one frame"):
        drawing.save_film(tmp_path / "b.gif", [])
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.gif", "a.png"]


def test_too_many_hulls_for_a_picture():
    many = make_instances([pad(box_cloud((0, 0, 0), (0.01, 0.01, 0.01)), 8)] * 255, [1] * 255)
    with pytest.raises(AssertionError, match="255 hulls do not fit"):
        drawing.draw_camera(many, camera=drawing.side_view(SHAPE))
