"""Depth images, cameras and masks as they come to a robot, and what is refused of them."""

from pathlib import Path

import numpy as np
import pytest
from bundles import SMALL

from pregrasp_jax.deploy.camera import PinholeCamera, depth_in_metres
from pregrasp_jax.deploy.files import masks_of_ids, read_masks
from pregrasp_jax.deploy.masks import Masks, Target, from_mask_rcnn, fuse, refuse_size
from pregrasp_jax.deploy.tabletop import components
from pregrasp_jax.deploy.view import make_view


def test_depth_is_metres_whatever_it_came_as():
    metres = np.full((48, 64), 1.0, np.float32)
    metres[:4] = np.nan
    steps = np.nan_to_num(metres * 1000).astype(np.uint16)
    for given, scale in ((metres, None), (metres.astype(float), None), (steps, None), (steps, 0.001)):
        np.testing.assert_allclose(depth_in_metres(given, scale=scale, shape=(48, 64)), metres, atol=1e-6)
    zeros = np.where(np.isnan(metres), 0, metres)
    assert np.isnan(depth_in_metres(zeros, scale=None, shape=(48, 64))[:4]).all(), "0 is a hole, not the camera"
    for given, scale, said in (
        (metres * 1000, None, "are these millimetres"),
        (steps, 1.0, "are these millimetres"),
        (metres[1:], None, "shape"),
        (np.full((48, 64), np.nan), None, "0% of it has a depth"),
        (np.ones((48, 64), np.uint8), None, "uint8"),
        (metres.astype(complex), None, "complex"),
    ):
        with pytest.raises(ValueError, match=said):
            depth_in_metres(given, scale=scale, shape=(48, 64))


def camera_at(position=(0.0, 0.0, 1.0), **changes) -> PinholeCamera:
    pose = SMALL.camera.world_from_optical.copy()
    pose[:3, 3] = position
    given = {"matrix": SMALL.camera.matrix, "world_from_optical": pose, "shape": SMALL.camera.shape} | changes
    return PinholeCamera(**given)


def test_cameras_that_cannot_be_are_refused():
    tilted = SMALL.camera.world_from_optical.copy()
    tilted[:3, :3] *= 1.01
    for changes, said in (
        ({"world_from_optical": tilted}, "no rotation"),
        ({"position": (0.0, 0.0, -0.5)}, "below the table"),
        ({"position": (0.0, 0.0, 1000.0)}, "millimetres"),
        ({"matrix": np.eye(3)}, "intrinsics"),
        ({"matrix": SMALL.camera.matrix.T}, "intrinsics"),
        ({"distortion": (0.0,)}, "five numbers"),
        ({"shape": (100, 100)}, "principal point"),
    ):
        with pytest.raises(ValueError, match=said):
            camera_at(**changes)
    for position in ((0.5, 0.0, 1.0), (0.0, 0.0, 0.3)):
        with pytest.raises(ValueError, match="does not see the corner"):
            make_view(camera_at(position))


def test_a_bent_lens_is_straightened():
    bent = camera_at(distortion=(-0.056, 0.060, 0.0004, 0.0007, -0.016))  # a D455's
    rays = bent.rays(slice(0, 480), slice(0, 640))
    turn = SMALL.camera.world_from_optical[:3, :3]
    x, y, _ = np.tensordot(turn.T, rays, axes=1)
    k1, k2, p1, p2, k3 = bent.distortion
    r2 = x**2 + y**2
    radial = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
    u = SMALL.camera.matrix[0, 0] * (x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x**2)) + SMALL.camera.matrix[0, 2]
    v = SMALL.camera.matrix[1, 1] * (y * radial + p1 * (r2 + 2 * y**2) + 2 * p2 * x * y) + SMALL.camera.matrix[1, 2]
    columns, rows = np.meshgrid(np.arange(640), np.arange(480))
    assert max(np.abs(u - columns).max(), np.abs(v - rows).max()) < 1e-2


@pytest.mark.parametrize("distortion", [(-0.056, 0.060, 0.0004, 0.0007, -0.016), (-0.3, 0.1), (0.25, 0.0, 0.001)])
def test_a_bent_lens_sees_points_where_their_rays_are(distortion):
    """The robot is drawn there; what the image does not show, where polynomials fold back, stays outside of it."""
    bent = camera_at(distortion=(*distortion, *[0.0] * (5 - len(distortion))))
    place = bent.world_from_optical[:3, 3]
    rays = bent.rays(slice(0, 480), slice(0, 640)).astype(float)
    pixels, depth = bent.project(place + 0.8 * np.moveaxis(rays, 0, -1))
    columns, rows = np.meshgrid(np.arange(640), np.arange(480))
    np.testing.assert_allclose(pixels, np.stack([columns, rows], axis=-1), atol=0.02)
    np.testing.assert_allclose(depth, 0.8, atol=1e-5)
    axis = bent.world_from_optical[:3, 2]
    border = np.concatenate([rays[:, 0], rays[:, -1], rays[:, :, 0], rays[:, :, -1]], axis=1).T
    for further in (1.02, 1.5, 3.0):
        u, v = np.moveaxis(bent.project(place + axis + further * (border - axis))[0], -1, 0)
        assert not ((u > 0) & (u < 639) & (v > 0) & (v < 479)).any()


class Tensor:
    """What torch gives, without torch."""

    def __init__(self, values):
        self.values = np.asarray(values)

    def detach(self):
        return self

    def cpu(self):
        return self

    def __array__(self, dtype=None, copy=None):
        return self.values if dtype is None else self.values.astype(dtype)


def detections(count: int = 3) -> dict:
    masks = np.zeros((count, 1, 40, 40), np.float32)
    for index in range(count):
        masks[index, 0, 2 + 8 * index : 14 + 8 * index, 5:20] = 0.9
    scores = np.array([0.99, 0.8, 0.3])[:count]
    boxes = np.zeros((count, 4), np.float32)
    return {
        "boxes": Tensor(boxes),
        "labels": Tensor([44, 47, 1][:count]),
        "scores": Tensor(scores),
        "masks": Tensor(masks),
    }


def test_mask_rcnn_as_torchvision_gives_it():
    masks = from_mask_rcnn([detections()], {44: "bottle", 47: "cup"})
    assert masks.names == ("bottle", "cup") and masks.masks.dtype == bool, "the third is not sure enough"
    image = fuse(masks, 1, SMALL.bundle.contract.grid.labels)
    assert image[12, 10] == SMALL.bundle.contract.grid.labels["obstacle"], "where they overlap the surer one counts"
    assert (
        image[15, 10] == SMALL.bundle.contract.grid.labels["target"]
        and image[0, 0] == SMALL.bundle.contract.grid.labels["table"]
    )
    assert Target(name="cup").find(masks) == 1 == Target(pixel=(10, 16)).find(masks) == Target(index=1).find(masks)
    nothing = from_mask_rcnn([detections(0)])
    assert nothing.masks.shape == (0, 40, 40)
    with pytest.raises(ValueError, match="found no object"):
        Target(index=0).find(nothing)
    trained = {"labels": [1, 2], "masks": detections(2)["masks"].values[:, 0] > 0.5}
    np.testing.assert_array_equal(from_mask_rcnn(trained).masks, masks.masks)


def test_targets_and_masks_that_are_not_there_are_refused(tmp_path: Path):
    masks = from_mask_rcnn(detections())
    for target, said in (
        (Target(index=5), "allowed is 0 to 1"),
        (Target(name="mug"), "found: 44, 47"),
        (Target(pixel=(39, 0)), "lies in none"),
        (Target(pixel=(99, 0)), "outside of the image"),
    ):
        with pytest.raises(ValueError, match=said):
            target.find(masks)
    with pytest.raises(ValueError, match="allowed is one of"):
        Target(index=1, name="mug")
    with pytest.raises(ValueError, match="allowed is N x 30 x 40"):
        refuse_size(masks, (30, 40))
    hidden = Masks(np.stack([masks.masks[0], masks.masks[0]]), ("a", "b"), np.array([0.9, 0.8]))
    with pytest.raises(ValueError, match="0 visible pixels"):
        fuse(hidden, 1, SMALL.bundle.contract.grid.labels)
    for output in ([], {"labels": [1]}, {"labels": [1], "masks": np.zeros((2, 3, 4, 5))}):
        with pytest.raises(ValueError, match="Mask R-CNN"):
            from_mask_rcnn(output)
    np.savez(tmp_path / "masks.npz", masks=detections()["masks"].values, labels=[44, 47, 1], scores=[0.9, 0.8, 0.2])
    assert read_masks(tmp_path / "masks.npz").names == ("44", "47")
    held = {"masks": detections()["masks"].values, "labels": [44, 47, 1], "scores": [0.9, 0.8, 0.2]}
    for changed, said in (
        ({"names": "[1]"}, "holds no masks"),
        ({"names": "garbage"}, "holds no masks"),
        ({"labels": ["mug", "cup", "can"]}, "labels or scores are no numbers"),
        ({"scores": [np.nan, 0.8, 0.2]}, "labels or scores are no numbers"),
    ):
        np.savez(tmp_path / "masks.npz", **{**held, **changed})
        with pytest.raises(ValueError, match=rf"masks\.npz.*{said}"):
            read_masks(tmp_path / "masks.npz")
    np.savez_compressed(tmp_path / "whole.npz", **held)
    whole = (tmp_path / "whole.npz").read_bytes()
    for data in (whole[: len(whole) // 2], whole[:200] + bytes(100) + whole[300:], b""):
        (tmp_path / "masks.npz").write_bytes(data)
        with pytest.raises(ValueError, match=r"masks\.npz cannot be read"):
            read_masks(tmp_path / "masks.npz")
    (tmp_path / "masks.png").write_bytes(b"no picture")
    with pytest.raises(ValueError, match="cannot be read as a picture"):
        read_masks(tmp_path / "masks.png")
    assert masks_of_ids(np.array([[0, 3], [3, 7]])).names == ("3", "7")


def test_the_tabletop_segmenter_splits_at_steps():
    height = np.zeros((30, 30))
    height[5:15, 5:15], height[5:15, 15:25], height[20:25, 5:25] = 0.2, 0.15, 0.1
    parts = components(height, height > 0.03)
    assert [int(part.sum()) for part in parts] == [100, 100, 100]
    assert len(components(np.where(height > 0, 0.2, 0), height > 0.03)) == 2, "one height that touches is one object"
