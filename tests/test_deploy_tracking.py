"""From look to look the target stays the object that it was."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from bundles import SMALL, small_decider

from pregrasp_jax.deploy.devices import DeviceError
from pregrasp_jax.deploy.files import masks_of_ids
from pregrasp_jax.deploy.log import DecisionLog
from pregrasp_jax.deploy.loop import Station
from pregrasp_jax.deploy.masks import Masks, Target
from pregrasp_jax.deploy.tracking import Known, find_target, things_of
from pregrasp_jax.spaces.matching import Things, match


def things(*rows: tuple[float, float, float, float]) -> Things:
    """Return objects from rows of x, y, size and height."""
    values = np.array(rows, float).reshape(-1, 4)
    return Things(values[:, :2], values[:, 2], values[:, 3])


def masks(*names: str) -> Masks:
    """Return masks one below the other, two rows each."""
    images = np.zeros((len(names), 2 * max(len(names), 1), 8), bool)
    for index, image in enumerate(images):
        image[2 * index : 2 * index + 2] = True
    return Masks(images, names, np.ones(len(names)))


MUG, BOX, CAN = (0.0, 0.0, 400.0, 0.10), (-0.08, 0.0, 900.0, 0.20), (0.0, 0.15, 300.0, 0.12)
MOVED_MUG, MOVED_BOX = (0.08, 0.0, 380.0, 0.10), (0.0, 0.0, 910.0, 0.20)
"""A push moves the mug by 8 cm, and a box slides to where it was."""


@pytest.mark.parametrize(
    "wanted", [Target(pixel=(3, 0)), Target(index=0), Target(name="cup")], ids=["pixel", "index", "a name of several"]
)
def test_the_target_is_followed_and_not_what_slides_to_its_place(wanted: Target):
    then, now = masks("cup", "cup", "cup"), masks("cup", "cup", "cup")
    before = things(MUG, BOX, CAN)
    assert find_target(wanted, then, before, None) == 0
    known = Known(then.names, before, 0)
    assert find_target(wanted, now, things(MOVED_BOX, CAN, MOVED_MUG), known) == 2
    assert find_target(wanted, now, things(MOVED_BOX, MOVED_MUG, CAN), known) == 1
    lost = masks("cup", "cup")
    with pytest.raises(ValueError, match=r"last seen at \(0\.000, 0\.000\) m and is none of the 2 masks"):
        find_target(wanted, lost, things(MOVED_BOX, CAN), known)


def test_a_name_that_only_one_mask_has_is_enough():
    known, wanted = Known(("mug", "box"), things(MUG, BOX), 0), Target(name="mug")
    far = things((0.2, 0.2, 90.0, 0.3), MOVED_BOX)
    assert find_target(wanted, masks("mug", "box"), far, known) == 0, "wherever it is"
    assert find_target(wanted, masks("box", "mug"), things(MOVED_MUG, MOVED_BOX), known) == 1
    with pytest.raises(ValueError, match="target name 'mug' was not found; found: box"):
        find_target(wanted, masks("box", "box"), things(BOX, MUG), known)
    two = masks("mug", "box", "mug")
    assert find_target(wanted, two, things(CAN, MOVED_BOX, MOVED_MUG), known) == 2, "among those of the name"
    with pytest.raises(ValueError, match="found no object"):
        find_target(Target(index=0), masks(), things(), known)


def test_what_is_nowhere_is_nothing_that_was_there():
    nowhere = (np.nan, np.nan, 1.0, np.nan)
    assert match(things(MUG, nowhere), things(nowhere, MOVED_MUG)) == [None, 0]
    assert match(things(), things(MUG)) == [None] and match(things(MUG), things()) == []
    assert match(things(MUG), things((0.31, 0.0, 400.0, 0.1))) == [None], "nothing moves that far"


@pytest.mark.parametrize(
    ("before", "now"),
    [
        ([(0.0, 0.0, 400.0, 0.1), (0.2, 0.0, 400.0, 0.1)], [(0.19, 0.0, 400.0, 0.1), (0.05, 0.0, 400.0, 0.1)]),
        ([(0.0, 0.0, 400.0, 0.1), (0.0, 0.0, 900.0, 0.1)], [(0.0, 0.0, 850.0, 0.1), (0.0, 0.0, 450.0, 0.1)]),
        ([(0.0, 0.0, 400.0, 0.1), (0.0, 0.0, 400.0, 0.2)], [(0.0, 0.0, 400.0, 0.19), (0.0, 0.0, 400.0, 0.11)]),
    ],
    ids=["way", "size", "height"],
)
def test_each_of_these_alone_tells_two_objects_apart(before, now):
    assert match(things(*before), things(*now)) == [1, 0]


def test_something_else_is_no_target_that_is_gone():
    known, wanted = Known(("", ""), things(MUG, BOX), 0), Target(index=0)
    for appeared in ((0.2, 0.0, 3000.0, 0.1), (0.05, 0.0, 90.0, 0.1), (0.05, 0.0, 400.0, 0.17)):
        with pytest.raises(ValueError, match=r"allowed is one within 0\.3 m of there and of about its size and height"):
            find_target(wanted, masks("", ""), things(appeared, BOX), known)


def test_things_are_where_the_scene_has_them():
    depth = SMALL.golden["depth"][0] * np.float32(1e-4)
    ids, height = SMALL.golden["instances"][0], SMALL.golden["height_m"][0]
    found = sorted(set(np.unique(ids)) - {0})
    images = Masks(np.stack([ids == value for value in found]), tuple(map(str, found)), np.ones(len(found)))
    images.masks[0] = False
    seen = things_of(images, SMALL.view.cut(depth), SMALL.view)
    assert np.isnan(seen.xy[0]).all() and seen.size[0] == 1
    camera = SMALL.camera.world_from_optical
    for index in range(1, len(found)):
        rows, columns = np.nonzero(images.masks[index])
        middle = np.array([*seen.xy[index], seen.height[index]])
        pixel, _ = SMALL.camera.project(middle[None])
        assert np.abs(pixel[0] - [columns.mean(), rows.mean()]).max() < 15
        assert 0.02 < seen.height[index] < height.max() + 0.01 < camera[2, 3]
        assert seen.size[index] <= len(rows)


class Restless:
    """A golden state that never changes, whose masks come in another order at every look; its second push fails."""

    def __init__(self, *, forgetful: bool = False):
        self.looks, self.pushes, self.forgetful = 0, 0, forgetful

    def capture(self) -> Any:
        return SMALL.golden["depth"][0], None, 0.0

    def segment(self, frame: Any) -> Masks:
        found = masks_of_ids(SMALL.golden["instances"][0])
        order = np.roll(np.arange(len(found.masks)), self.looks)
        self.looks += 1
        if self.forgetful and self.looks == 2:
            order = order[[found.names[i] != str(SMALL.golden["target_id"][0]) for i in order]]
        return Masks(found.masks[order], ("thing",) * len(order), found.scores[order])

    def joints(self) -> np.ndarray:
        return SMALL.golden["joint_pos"][0][:6]

    def push(self, push: Any) -> None:
        self.pushes += 1
        if self.pushes == 2:
            raise DeviceError("the arm has stalled")

    def opening(self) -> float:
        return 1.0

    def move(self, opening: float) -> None: ...


def station_of(cell: Any, log: Path) -> Station:
    decider = small_decider()
    first = masks_of_ids(SMALL.golden["instances"][0]).names.index(str(SMALL.golden["target_id"][0]))
    return Station(
        decider=decider,
        view=SMALL.view,
        source=cell,
        segmenter=cell,
        target=Target(index=first),
        arm=cell,
        gripper=cell,
        depth_scale=1e-4,
        log=DecisionLog(log, decider.contract),
        say=lambda _: None,
    )


def test_a_trial_keeps_its_target_and_logs_what_ended_it(tmp_path: Path):
    with pytest.raises(DeviceError, match="stalled"):
        station_of(Restless(), tmp_path / "log").run()
    assert json.loads((tmp_path / "log" / "result.json").read_text()) == {
        "reason": "error",
        "error": "the arm has stalled",
    }
    first, second = (np.load(tmp_path / "log" / f"decision-00{number}.npz")["labels"] for number in (0, 1))
    np.testing.assert_array_equal(first, second)


def test_a_log_that_cannot_be_written_does_not_hide_why_the_robot_stopped(tmp_path: Path, monkeypatch):
    def full(*_: Any) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(DecisionLog, "conclude", full)
    monkeypatch.setattr(DecisionLog, "keep", full)
    with pytest.raises(DeviceError, match="stalled"):
        station_of(Restless(), tmp_path / "log").run()
    with pytest.raises(ValueError, match="the target was last seen at"):
        station_of(Restless(forgetful=True), tmp_path / "other").run()


def test_an_image_that_cannot_be_used_is_kept(tmp_path: Path):
    log = tmp_path / "log"
    with pytest.raises(ValueError, match="the target was last seen at"):
        station_of(Restless(forgetful=True), log).run()
    with np.load(log / "undecided-001.npz") as kept:
        np.testing.assert_array_equal(kept["depth"], SMALL.golden["depth"][0])
    assert json.loads((log / "result.json").read_text())["error"].startswith("the target was last seen at")
    assert not (log / "decision-001.json").exists()
    with pytest.raises(ValueError, match="of an earlier trial"):
        DecisionLog(log, SMALL.bundle.contract)
