"""A search before the pushes of `deploy`: what it is told, which object is which, and who decides where it cannot."""

import dataclasses
import itertools
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from bundles import SMALL, small_bundle, small_decider

from pregrasp_jax import planned_cell
from pregrasp_jax.checkpoint import load_policy
from pregrasp_jax.cli.main import main
from pregrasp_jax.deploy.cell import Cell
from pregrasp_jax.deploy.files import masks_of_ids
from pregrasp_jax.deploy.loop import Station
from pregrasp_jax.deploy.masks import ROBOT, TABLE, Masks, Target, instance_image
from pregrasp_jax.deploy.poses import on_table
from pregrasp_jax.deploy.projection import Maps
from pregrasp_jax.deploy.search import Seen
from pregrasp_jax.evaluation_config import PlanningConfig
from pregrasp_jax.planned_cell import CellSearch, joints_as_trained
from pregrasp_jax.planning.memory import NOTHING, Memory, Shape, Sight
from pregrasp_jax.planning.planner import Planned
from pregrasp_jax.planning.tracking import TARGET_SLOT, slots_of
from pregrasp_jax.robot import kinematics
from pregrasp_jax.simulated_cell import make_simulated_station
from pregrasp_jax.spaces import grid
from pregrasp_jax.spaces.workspace import Box
from pregrasp_jax.types import MAX_OBJECTS, ROBOT_ID


def golden_maps() -> Maps:
    return Maps(SMALL.golden["height_m"][0], SMALL.golden["labels"][0], 1.0)


def decide(search: Any = None, **changes: Any) -> Any:
    decider = dataclasses.replace(small_decider(), **changes)
    return decider.decide(golden_maps(), decider.start(), SMALL.golden["joint_pos"][0], search=search)


def test_a_search_chooses_and_the_network_does_where_the_arm_cannot():
    alone = decide()
    other = int(np.argsort(np.where(alone.allowed, alone.q, -np.inf), axis=None)[-400])
    found = decide(lambda: other)
    assert alone.searched is None and found.searched == found.push.action == other != alone.push.action
    assert found.push.value == pytest.approx(float(alone.q.flat[other])) and not found.refused
    x, y = found.push.end.xy
    walls = (Box(center=(float(x), float(y), 0.2), half_size=(0.02, 0.06, 0.2)),)
    fenced = dataclasses.replace(small_decider().workspace, walls=walls)
    instead = decide(lambda: other, workspace=fenced)
    assert instead.refused[0] == (other, "wall") and instead.searched == other
    without = decide(workspace=fenced)
    assert instead.push.action == without.push.action


def test_nobody_searches_once_the_target_is_enclosed(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("pregrasp_jax.deploy.decision.Decider.coverage", lambda *_: 1.0)
    assert decide(lambda: pytest.fail("it was asked")).close


def block(row: int, col: int, size: int = 8) -> np.ndarray:
    mask = np.zeros((100, 100), bool)
    mask[row : row + size, col : col + size] = True
    return mask


def remembered(mask: np.ndarray, height: float = 0.1) -> Shape:
    cells = np.nonzero(mask)
    xy = grid.cell_to_world(*cells)
    pose = np.array([*xy.mean(axis=0), 0.0])
    nothing: Any = None
    return Shape(nothing, xy - pose[:2], np.full(len(xy), height), pose, np.flatnonzero(mask))


def memory_of(**slots: Shape) -> Memory:
    return tuple(slots.get(f"s{slot}") for slot in range(MAX_OBJECTS))


HEIGHT = np.full((100, 100), 0.1)


def test_objects_keep_their_slots_whatever_their_masks_are_called():
    small, large, target = block(20, 20, 6), block(20, 60, 14), block(60, 40)
    memory = memory_of(s0=remembered(target), s3=remembered(small), s5=remembered(large))
    assert slots_of([large, target, small], HEIGHT, 1, memory) == [5, TARGET_SLOT, 3]
    # Both are pushed to where the other was nearer: their sizes tell them apart.
    assert slots_of([target, block(24, 42, 14), block(24, 34, 6)], HEIGHT, 0, memory) == [TARGET_SLOT, 5, 3]
    # So do their heights.
    same = memory_of(s1=remembered(block(40, 40), 0.1), s2=remembered(block(40, 50), 0.2))
    height = np.where(block(40, 45), 0.2, 0.1)
    assert slots_of([target, block(40, 45), block(40, 60)], height, 0, same) == [TARGET_SLOT, 2, 1]


def test_the_whole_assignment_is_the_best_one():
    """Against all permutations, by a plain sum."""
    rng = np.random.default_rng(0)
    for _ in range(20):
        sizes, places = rng.integers(4, 12, 4), rng.integers(10, 80, (4, 2))
        memory = memory_of(
            **{f"s{s + 1}": remembered(block(row, col, sizes[s])) for s, (row, col) in enumerate(places)}
        )
        ends = places + rng.integers(-8, 8, (4, 2))
        moved = [block(row, col, size) for (row, col), size in zip(ends, sizes, strict=True)]
        found = slots_of([block(0, 0), *moved], HEIGHT, 0, memory)

        def cost(mask: np.ndarray, slot: int, memory: Memory = memory) -> float:
            shape = memory[slot]
            assert shape is not None
            way = np.hypot(*(grid.cell_to_world(*np.nonzero(mask)).mean(axis=0) - shape.pose[:2]))
            return 10 * way + abs(np.log(mask.sum() / len(shape.xy))) if way <= 0.3 else 1e3

        orders = itertools.permutations(range(1, 5))
        wanted = min(orders, key=lambda order: sum(map(cost, moved, order)))
        total = [sum(map(cost, moved, order)) for order in (wanted, found[1:])]
        assert total[1] == pytest.approx(total[0])


def test_what_is_new_takes_a_free_slot_and_then_that_of_something_unseen():
    target = block(60, 40)
    far = remembered(block(2, 2))
    assert slots_of([target, block(80, 80)], HEIGHT, 0, memory_of(s0=remembered(target), s1=far)) == [TARGET_SLOT, 2]
    full = memory_of(s0=remembered(target), **{f"s{s}": far for s in range(1, MAX_OBJECTS)})
    (_, slot) = slots_of([target, block(80, 80)], HEIGHT, 0, full)
    assert slot != TARGET_SLOT
    assert slots_of([target], HEIGHT, 0, NOTHING) == [TARGET_SLOT]
    many = [block(10 * i, 10 * i, 4) for i in range(9)]
    assert sorted(slots_of(many[:8], HEIGHT, 3, NOTHING)) == list(range(MAX_OBJECTS))
    with pytest.raises(ValueError, match="shows 9 objects; allowed with a search are 8"):
        slots_of(many, HEIGHT, 3, NOTHING)


class Recorder:
    """A planner that says what it was told, and remembers how often."""

    def __init__(self):
        self.told: list[tuple[Sight, Memory]] = []

    def decide(self, sight: Sight, memory: Memory, key: Any) -> Planned:
        self.told.append((sight, memory))
        return Planned(77, memory_of(s0=remembered(block(60, 40)), s4=remembered(block(20, 20))))


def test_a_planner_is_told_what_is_seen_and_forgets_at_the_next_trial():
    planner: Any = Recorder()
    decider = small_decider()
    search = CellSearch(planner, cell=decider.body.arm, trained=decider.body.arm)
    instances = np.full((100, 100), TABLE, np.uint8)
    instances[block(20, 20)], instances[block(60, 40)], instances[block(0, 90)] = 7, 2, ROBOT
    height = np.where(instances == TABLE, 0, 0.1).astype(np.float32)
    joints = np.array(decider.contract.robot.home)
    seen = Seen(height, instances, 2, decider.start(), joints, 0)
    assert [search.choose(s) for s in (seen, seen._replace(pushes=1), seen)] == [77] * 3
    first, second, third = planner.told
    assert first[1] == third[1] == NOTHING and second[1][4] is not None
    for (sight, _), slot in ((first, 1), (second, 4), (third, 1)):
        ids = np.asarray(sight.obs.instance_ids)
        np.testing.assert_array_equal(ids == TARGET_SLOT + 1, instances == 2)
        np.testing.assert_array_equal(ids == slot + 1, instances == 7)
        np.testing.assert_array_equal(ids == ROBOT_ID, instances == ROBOT)
        assert np.isin(ids, [0, 1, slot + 1, ROBOT_ID]).all() and sight.target == TARGET_SLOT
        np.testing.assert_allclose(grid.dequantize_height(np.asarray(sight.obs.height)), height, atol=6e-4)
        np.testing.assert_allclose(sight.joint_pos, joints, atol=1e-6)
        np.testing.assert_allclose(sight.obs.hand.xy, decider.start().xy, atol=1e-6)
    assert [sight.pushes for sight, _ in planner.told] == [0, 1, 0]


@pytest.mark.parametrize("height_m", [0.0, 0.06, -0.04])
def test_a_planner_is_told_joints_that_hold_the_hand_where_it_is(height_m: float):
    body = on_table(small_decider().body, height_m)
    trained, joints = small_decider().body.arm, np.array([*SMALL.golden["joint_pos"][1][:6], 0.3, 0.4], float)
    joints[5] += 2 * np.pi  # the wrist turned once
    found = joints_as_trained(joints, cell=body.arm, trained=trained)
    wanted = kinematics.grasp_pose(body.arm, joints[:6])
    np.testing.assert_allclose(kinematics.grasp_pose(trained, found[:6]), wanted, atol=1e-4)
    np.testing.assert_array_equal(found[6:], [0.3, 0.4])
    assert np.abs(found - joints).max() < 0.4, "the same posture"
    assert (found is joints) == (height_m == 0.0)


def test_a_hand_that_the_arm_of_training_cannot_hold_is_one_line():
    body = on_table(small_decider().body, 2.0)
    with pytest.raises(ValueError, match=r"cannot hold its hand where this one does; check table.height_m"):
        joints_as_trained(SMALL.golden["joint_pos"][1], cell=body.arm, trained=small_decider().body.arm)


def test_instances_are_masks_the_surest_on_top():
    masks = Masks(np.stack([block(20, 20), block(24, 24)]), ("a", "b"), np.array([0.9, 0.8]))
    image = instance_image(masks)
    assert image[25, 25] == 1 and image[30, 30] == 2 and image[0, 0] == TABLE
    with pytest.raises(ValueError, match="found 255 objects; allowed with a search are 254"):
        instance_image(Masks(np.zeros((255, 4, 4), bool), ("",) * 255, np.ones(255)))


class Simple:
    """A camera, masks, an arm and a gripper which show the golden state and do nothing."""

    def __init__(self):
        self.pushed: list[int] = []

    def capture(self) -> Any:
        return SMALL.golden["depth"][0], None, 0.0

    def segment(self, frame: Any) -> Masks:
        return masks_of_ids(SMALL.golden["instances"][0])

    def joints(self) -> np.ndarray:
        return SMALL.golden["joint_pos"][0][:6]

    def push(self, push: Any) -> None:
        self.pushed.append(push.action)

    def opening(self) -> float:
        return 1.0

    def move(self, opening: float) -> None: ...

    def lift(self, height_m: float) -> None: ...


def test_a_station_shows_a_search_what_the_policy_sees():
    cell: Any = Simple()
    seen: list[Seen] = []
    search: Any = SimpleNamespace(choose=lambda now: seen.append(now) or int(SMALL.golden["action"][0]))
    station = Station(
        decider=small_decider(),
        view=SMALL.view,
        source=cell,
        segmenter=cell,
        target=Target(name=str(int(SMALL.golden["target_id"][0]))),
        arm=cell,
        gripper=cell,
        depth_scale=1e-4,
        search=search,
        say=lambda _: None,
    )
    station.run(once=True)
    looked = station.look(small_decider().start(), pushes=3)
    last = station.look(small_decider().start(), pushes=small_decider().contract.action.max_pushes)
    assert cell.pushed == [SMALL.golden["action"][0]] and [now.pushes for now in seen] == [0, 3]
    assert last.decision.searched is None, "there is no push left to search for"
    assert "search" in looked.times_ms and looked.decision.searched == SMALL.golden["action"][0]
    labels, now = looked.maps.labels, seen[1]
    entry = small_decider().contract.grid.labels
    np.testing.assert_array_equal(now.instances == now.target, labels == entry["target"])
    others = (now.instances != TABLE) & (now.instances != ROBOT) & (now.instances != now.target)
    for found, wanted in ((others, "obstacle"), (now.instances == ROBOT, "robot")):
        assert (found == (labels == entry[wanted])).mean() > 0.998, wanted
    np.testing.assert_array_equal(now.height_m, looked.maps.height_m)
    seen_ids = {int(value) for value in np.unique(now.instances)} - {TABLE, ROBOT}
    assert len(seen_ids) == len(np.unique(SMALL.golden["instances"][0])) - 1


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--planning.depth", "1"], "planning.* is set, but plan = False"),
        (["--plan", "True", "--planning.variants", "9"], "planning.variants = 9 is out of range"),
    ],
)
def test_settings_of_a_search_that_cannot_be_are_one_line(options: list[str], said: str, capsys):
    with pytest.raises(SystemExit) as stopped:
        main(["deploy", str(small_bundle()), "--arm", "sim", *options])
    assert stopped.value.code == 2 and said in capsys.readouterr().err


def test_a_bundle_without_parameters_cannot_be_searched_by():
    files = {name: data for name, data in SMALL.bundle.files.items() if name != "policy.safetensors"}
    bundle = dataclasses.replace(SMALL.bundle, files=files)
    with pytest.raises(
        ValueError, match=r"has no policy.safetensors; allowed is a bundle exported with --formats onnx sa"
    ):
        planned_cell.make_search(bundle, PlanningConfig(), decider=small_decider(), camera_m=np.zeros(3))


def test_a_search_needs_no_file_of_the_machine_that_trained(monkeypatch: pytest.MonkeyPatch):
    trained = load_policy(SMALL.bundle.folder)
    task = dataclasses.replace(trained.config.task, camera="pinhole", sensor="/gone/mine.yaml")
    trained = dataclasses.replace(trained, config=dataclasses.replace(trained.config, task=task))

    class BuiltError(Exception):
        pass

    def make_planner(env: Any, *_: Any, **__: Any) -> Any:
        raise BuiltError(env.task.camera)

    monkeypatch.setattr(planned_cell, "load_policy", lambda _: trained)
    monkeypatch.setattr(planned_cell, "make_planner", make_planner)
    with pytest.raises(BuiltError, match="pinhole"):
        planned_cell.make_search(SMALL.bundle, PlanningConfig(), decider=small_decider(), camera_m=np.zeros(3))


@pytest.mark.slow
def test_a_simulated_cell_searches_before_it_pushes(capsys):
    bundle = SMALL.bundle
    station = make_simulated_station(bundle, Cell(), say=lambda _: None)
    search = planned_cell.make_search(
        bundle,
        PlanningConfig(candidates=2, variants=2, depth=1),
        decider=station.decider,
        camera_m=station.view.camera.world_from_optical[:3, 3],
    )
    assert "compiled in" in capsys.readouterr().out
    looked = dataclasses.replace(station, search=search).look(station.decider.start())
    assert looked.decision.searched is not None and looked.decision.push is not None
    again = dataclasses.replace(station, search=search).look(station.decider.start())
    assert again.decision.searched == looked.decision.searched, "a trial that begins anew decides alike"
