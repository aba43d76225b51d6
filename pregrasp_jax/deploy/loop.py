"""Look, decide, push, look again; close when the target is enclosed."""

import contextlib
import functools
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from pregrasp_jax.deploy.camera import depth_in_metres
from pregrasp_jax.deploy.decision import Decider, Decision
from pregrasp_jax.deploy.devices import ArmDriver, DeviceError, Frame, GripperDriver, ImageSource, Segmenter
from pregrasp_jax.deploy.guard import LIFT_HEIGHT
from pregrasp_jax.deploy.log import DecisionLog
from pregrasp_jax.deploy.masks import ROBOT, Target, fuse, instance_image, refuse_size
from pregrasp_jax.deploy.projection import Maps, draw_robot, to_maps
from pregrasp_jax.deploy.search import Search, Seen
from pregrasp_jax.deploy.tracking import Known, find_target, things_of
from pregrasp_jax.deploy.view import View
from pregrasp_jax.messages import one_line
from pregrasp_jax.sensors import PointOfCell
from pregrasp_jax.spaces import motion


class Looked(NamedTuple):
    """One look, and what was decided.

    Attributes:
        frame: what was taken.
        labels: [rows, columns] uint8.
        maps: what the policy read.
        decision: what to do.
        times_ms: what took how long, by name.
        known: the objects, by which the next look finds the target.
    """

    frame: Frame
    labels: np.ndarray
    maps: Maps
    decision: Decision
    times_ms: dict[str, float]
    known: Known


class Result(NamedTuple):
    """How a trial ended.

    Attributes:
        reason: `grasped`, `not_held`, `no_push`, `max_pushes`, or `once`.
        pushes: that were made.
    """

    reason: str
    pushes: int


@dataclass(frozen=True, eq=False, kw_only=True)
class Station:
    """A policy with its devices.

    Attributes:
        decider: the policy.
        view: of its camera.
        source: of images.
        segmenter: of their objects.
        target: which of them is wanted.
        arm: that pushes.
        gripper: that is held open or closed meanwhile.
        depth_scale: m per step of an image; None as in `depth_in_metres`.
        cell: which of the points above a cell counts.
        search: that chooses pushes; None leaves it to the network.
        log: None writes nothing.
        say: told what happens.
    """

    decider: Decider
    view: View
    source: ImageSource
    segmenter: Segmenter
    target: Target
    arm: ArmDriver
    gripper: GripperDriver
    depth_scale: float | None = None
    cell: PointOfCell = "max"
    search: Search | None = None
    log: DecisionLog | None = None
    say: Callable[[str], None] = print

    def run(self, *, once: bool = False) -> Result:
        """Run a trial: at most as many pushes as the contract says, or one.

        Raises:
            DeviceError: a device cannot go on; nothing is retried.
            ValueError: an image, a mask or a joint cannot be used.
        """
        try:
            result = self._trial(once=once)
        except (DeviceError, ValueError) as error:
            with contextlib.suppress(OSError):  # a full disk must not hide why the robot has stopped
                self._conclude({"reason": "error", "error": one_line(error)})
            raise
        self._conclude(result._asdict())
        self.say(f"{result.reason.replace('_', ' ')} after {result.pushes} pushes")
        return result

    def _trial(self, *, once: bool) -> Result:
        entry = self.decider.contract.action
        hand, pushes, known = self.decider.start(), 0, None
        while True:
            looked = self.look(hand, pushes=pushes, known=known)
            self._write(pushes, looked, hand)
            decision = looked.decision
            if decision.close:
                self.say(f"the target is enclosed ({decision.coverage:.0%}): closing")
                held = self.gripper.grasp()
                self.arm.lift(LIFT_HEIGHT)
                return Result("grasped" if held else "not_held", pushes)
            if decision.push is None:
                return Result("no_push", pushes)
            if pushes >= entry.max_pushes:
                return Result("max_pushes", pushes)
            push, choice = decision.push, entry.choices[decision.push.choice]
            x, y, z = push.poses[-1, :3]
            self.say(
                f"push {pushes + 1}: hand {choice.name} to ({x:.4f}, {y:.4f}, {z:.3f}) m, value {push.value:.2f}, "
                f"decided in {sum(looked.times_ms.values()):.0f} ms"
            )
            self.gripper.move(choice.opening)
            self.arm.push(push)
            hand, pushes, known = push.end, pushes + 1, looked.known
            if once:
                return Result("once", pushes)

    def look(self, hand: motion.Held, *, pushes: int = 0, known: Known | None = None) -> Looked:
        """Take an image and decide.

        Args:
            hand: where the last push was commanded to end.
            pushes: made in this trial.
            known: the objects of the look before, among which the target was; None begins a trial.

        Raises:
            DeviceError: a device cannot go on.
            ValueError: an image cannot be read, or what it shows cannot be used; in that case the log keeps it.
        """
        frame = self._capture()
        try:
            return self._decide(frame, hand, pushes, known)
        except ValueError:
            with contextlib.suppress(OSError):
                if self.log is not None:
                    self.log.keep(pushes, frame)
            raise

    def _decide(self, frame: Frame, hand: motion.Held, pushes: int, known: Known | None) -> Looked:
        clock = _Clock()
        masks = self.segmenter.segment(frame)
        clock.lap("segmentation")
        entry, shape = self.decider.contract.grid, self.view.camera.shape
        depth = self.view.cut(depth_in_metres(frame.depth, scale=self.depth_scale, shape=shape)).copy()
        refuse_size(masks, shape)
        things = things_of(masks, depth, self.view)
        target = find_target(self.target, masks, things, known)
        labels = fuse(masks, target, entry.labels)
        cut = self.view.cut(labels).copy()
        clock.lap("reading")
        joints = frame.joint_pos
        draw_robot(depth, cut, view=self.view, body=self.decider.body, joint_pos=joints, entry=entry)
        clock.lap("drawing")
        maps = to_maps(depth, cut, view=self.view, cell=self.cell)
        choose = None
        if self.search is not None and pushes < self.decider.contract.action.max_pushes:
            instances = self.view.cut(instance_image(masks))
            on_grid = self._instances(depth, cut, instances, target=target + 1, maps=maps)
            seen = Seen(maps.height_m, on_grid, target + 1, hand, joints, pushes)
            choose = functools.partial(self.search.choose, seen)
        clock.lap("projection")
        decision = self.decider.decide(maps, hand, joints, search=choose, lap=clock.lap)
        clock.lap("decoding")
        return Looked(frame, labels, maps, decision, clock.times_ms, Known(masks.names, things, target))

    def _capture(self) -> Frame:
        depth, color, taken = self.source.capture()
        entry = self.decider.contract.action
        apertures = [choice.aperture_rad for choice in entry.choices]
        fingers = min(apertures) + self.gripper.opening() * (max(apertures) - min(apertures))
        return Frame(depth, color, np.concatenate([self.arm.joints(), [fingers, fingers]]), taken)

    def _instances(
        self, depth: np.ndarray, labels: np.ndarray, instances: np.ndarray, *, target: int, maps: Maps
    ) -> np.ndarray:
        """Return the instances [H, W] of a cut image, which show robot and target where `labels` and `maps` do."""
        entry = self.decider.contract.grid.labels
        drawn = np.where(labels == entry["robot"], np.uint8(ROBOT), instances)
        on_grid = to_maps(depth, drawn, view=self.view, cell=self.cell).labels
        return np.where(maps.labels == entry["target"], np.uint8(target), on_grid)

    def _write(self, number: int, looked: Looked, hand: motion.Held) -> None:
        if self.log is not None:
            self.log.write(
                number,
                frame=looked.frame,
                labels=looked.labels,
                maps=looked.maps,
                hand=hand,
                decision=looked.decision,
                times_ms=looked.times_ms,
            )

    def _conclude(self, result: Mapping[str, Any]) -> None:
        if self.log is not None:
            self.log.conclude(result)


class _Clock:
    """Says how long the parts of a decision took."""

    def __init__(self):
        self.times_ms: dict[str, float] = {}
        self._last = time.perf_counter()

    def lap(self, name: str) -> None:
        """End a part."""
        now = time.perf_counter()
        self.times_ms[name] = 1e3 * (now - self._last)
        self._last = now
