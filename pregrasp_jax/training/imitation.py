"""The run of PPG: collect stable grasps of random strokes, then learn from them.

Both halves are one sequence of steps, attempts first and updates after them; every checkpoint holds the grasps, the
scenes under way and the networks, so that a run that was stopped goes on as if it had not been.
"""

import dataclasses
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from pregrasp_jax.checkpoint import save_policy
from pregrasp_jax.checkpoint.chunks import Ring
from pregrasp_jax.checkpoint.state import restore, save
from pregrasp_jax.config import Config
from pregrasp_jax.learning.imitation import (
    Demonstration,
    Learner,
    Losses,
    StrokeFunction,
    demonstration,
    make_optimizer,
    turned_at_random,
    update,
)
from pregrasp_jax.machine import announced_compilation
from pregrasp_jax.messages import command
from pregrasp_jax.task.env import Env
from pregrasp_jax.training.console import Console, format_time
from pregrasp_jax.training.demonstrations import copy_positives, split
from pregrasp_jax.training.run_folder import RunFolder
from pregrasp_jax.training.stroke_collection import Positives, Scenes, begin, blank_positives, make_collect, make_keep

_LOG_BATCHES = 20
"""Batches of attempts, or of updates, between two rows of metrics."""

StopFn = Callable[[], bool]


@dataclass
class Counters:
    """What the host knows of a run; saved with every checkpoint.

    Attributes:
        attempts: strokes so far.
        collided: strokes that touched something on the way down.
        written: stable grasps that are kept.
        updates: of the networks.
        best: smallest validation loss of either network.
        seconds: of collecting and learning, over all sessions.
    """

    attempts: int = 0
    collided: int = 0
    written: int = 0
    updates: int = 0
    best: dict[str, float] = field(default_factory=dict)
    seconds: dict[str, float] = field(default_factory=lambda: {"collect": 0.0, "learn": 0.0})

    @property
    def step(self) -> int:
        """Return what orders checkpoints."""
        return self.attempts + self.updates


def run(config: Config, env: Env, folder: RunFolder, console: Console, *, resumed: bool, stop: StopFn) -> str:
    """Collect and learn until done, or until `stop` says so.

    Args:
        config: the run.
        env: from `clearing.own_protocol`.
        folder: of the run, locked.
        console: told about progress.
        resumed: go on from the newest checkpoint, if there is one.
        stop: asked before every step.

    Returns:
        One line that says why it ended.
    """
    session = _Session(config, env, folder, console, stop)
    session.start(resumed=resumed and folder.has_checkpoint)
    console.start()
    collected = session.collect()
    session.try_to_save()  # before it is learnt from, which may find too few grasps
    learned = collected and session.learn()
    if collected:
        session.save()
    if learned:
        session.save_best()
    if not learned:
        return f"interrupted at step {session.counters.step}; continue with `{command('train', 'resume', folder.path)}`"
    losses = ", ".join(f"{name} {loss:.3g}" for name, loss in session.counters.best.items())
    return f"done: {session.learnt_from} stable grasps learnt from; validation loss: {losses}"


def mean_losses(losses_of: Callable[[np.ndarray], np.ndarray], rows: np.ndarray, size: int) -> np.ndarray:
    """Return the mean losses [L] over rows [N], of which `losses_of` takes `size` at once and gives [L, size].

    The last batch is filled up with the first rows, which count once nevertheless.
    """
    chunks = np.resize(rows, -(-len(rows) // size) * size).reshape(-1, size)
    return np.concatenate([losses_of(chunk) for chunk in chunks], axis=1)[:, : len(rows)].mean(axis=1)


class _Session:
    """A run in memory."""

    def __init__(self, config: Config, env: Env, folder: RunFolder, console: Console, stop: StopFn):
        self.config, self.env, self.folder, self.console, self.stop = config, env, folder, console, stop
        keys = jax.random.split(jax.random.key(config.seed), 4)
        self.key, self._scene_key, self._init_key, self._turn_key = keys
        self.function = StrokeFunction(config.strokes, env.primitive.actions)
        self.counters = Counters()
        self.positives: Positives = blank_positives(config.strokes.positives)
        self._losses_of = jax.jit(
            lambda params, batch: self.function.losses(params, self._shown(batch), train=False)[0]
        )
        self.learnt_from = 0
        self._saved_at = time.monotonic()

    def start(self, *, resumed: bool) -> None:
        """Take up the newest checkpoint, or begin."""
        if not resumed:
            self.state = self._first_state()
            if self.config.strokes.collection:
                self.counters.written = copy_positives(Path(self.config.strokes.collection), self.positives)
            self.save()
            return
        template = jax.eval_shape(self._first_state)
        restored = restore(self.folder.checkpoints, template, self.positives)
        for problem in restored.problems:
            self.console.say(f"warning: {problem}; going on from the checkpoint of step {restored.step}")
        self.state, self.counters = restored.tree, Counters(**restored.extra)
        self.positives = jax.tree.map(np.array, restored.ring)
        self.folder.forget_metrics_after(restored.step, evaluated_at=None)
        self.console.say(
            f"resuming {self.folder.path}: {self.counters.written} stable grasps, {self.counters.updates} updates"
        )

    def try_to_save(self) -> None:
        """Write a checkpoint if the disk has room for it."""
        self._write("checkpoint", self.save)
        self._saved_at = time.monotonic()

    def save(self) -> None:
        """Write a checkpoint.

        Raises:
            OSError: the disk is full.
        """
        ring = Ring(self.positives, self.counters.written)
        extra = dataclasses.asdict(self.counters)
        save(self.folder.checkpoints, self.counters.step, self.state, ring, extra, policy="best/")

    def save_best(self) -> None:
        """Write the best policy.

        Raises:
            OSError: the disk is full.
        """
        losses = {f"{name}_loss": loss for name, loss in self.counters.best.items()}
        save_policy(self.folder.best, self.state["best"], self.config, {"env_steps": self.counters.step, **losses})

    def collect(self) -> bool:
        """Attempt strokes until enough of them were stable; return whether there was time to."""
        counters, wanted = self.counters, self.config.strokes.positives
        if counters.written >= wanted or self.config.strokes.collection:
            return True
        scenes: Scenes = self.state["scenes"]
        with announced_compilation(self.console.say):
            collect = make_collect(self.env, self.config.strokes.attempts).compile(scenes, self.key)
            keep = make_keep(self.env.bank)
        while counters.written < wanted:
            if self.stop():
                return False
            started = time.monotonic()
            self.state["scenes"], attempt = collect(self.state["scenes"], self.key)
            outcome = attempt.result.outcome
            counters.written = keep(self.positives, counters.written, attempt)
            counters.attempts += len(outcome.collided)
            counters.collided += int(outcome.collided.sum())
            counters.seconds["collect"] += time.monotonic() - started
            self._tell_collection()
            self._save_if_due()
        return True

    def learn(self) -> bool:
        """Go through the stable grasps `epochs` times; return whether there was time to."""
        counters, strokes = self.counters, self.config.strokes
        training, validation = split(self.positives, counters.written, self.config)
        self.learnt_from = len(training)
        per_epoch = -(-len(training) // strokes.batch_size)
        optimizer = self._optimizer(per_epoch)
        shown = self._shown

        @jax.jit
        def step(learner: Learner, batch: Any, key: jax.Array) -> tuple[Learner, Losses]:
            keys = jax.random.split(key, len(batch.index))
            return update(self.function, optimizer, learner, jax.vmap(turned_at_random)(keys, shown(batch)))

        while counters.updates < strokes.epochs * per_epoch:
            epoch, place = divmod(counters.updates, per_epoch)
            order = np.random.default_rng([self.config.seed, epoch]).permutation(training)
            if self.stop():
                return False
            started = time.monotonic()
            rows = np.resize(order, per_epoch * strokes.batch_size).reshape(per_epoch, -1)[place]
            batch = jax.tree.map(lambda leaf, rows=rows: leaf[rows], self.positives)
            self.state["learner"], losses = step(
                self.state["learner"], batch, jax.random.fold_in(self._turn_key, counters.updates)
            )
            counters.updates += 1
            losses = jax.device_get(losses)
            counters.seconds["learn"] += time.monotonic() - started
            self._tell_learning(losses, strokes.epochs * per_epoch)
            if counters.updates % per_epoch == 0:
                self._validate(validation if len(validation) else training)
            self._save_if_due()
        return True

    def _validate(self, rows: np.ndarray) -> None:
        """Measure both networks on grasps that they have not learnt from, and keep what is better than before."""
        params = self.state["learner"].params

        def losses_of(chunk: np.ndarray) -> np.ndarray:
            return np.stack(self._losses_of(params, jax.tree.map(lambda leaf: leaf[chunk], self.positives)))

        start, aperture = mean_losses(losses_of, rows, self.config.strokes.batch_size).tolist()
        losses = {"start": start, "aperture": aperture}
        best = self.counters.best
        for name, loss in losses.items():
            if loss < best.get(name, np.inf):
                best[name] = loss
                self.state["best"] = {**self.state["best"], name: params[name]}
        self._write("policy", self.save_best)
        self._append({f"eval/{name}_loss": loss for name, loss in losses.items()})
        self.console.say(f"update {self.counters.updates}: validation loss {_listed(losses)}")

    def _shown(self, batch: Positives) -> Demonstration:
        actions = self.env.primitive.actions
        return jax.vmap(lambda h, i, a: demonstration(h, i, a, actions))(batch.height, batch.index, batch.aperture)

    def _first_state(self) -> dict[str, Any]:
        """Return what a checkpoint holds beside the grasps: scenes under way, the learner, the best parameters."""
        params = self.function.init(self._init_key)
        learner = Learner(params, self._optimizer(1).init(params), jnp.int32(0))
        strokes, num_envs = self.config.strokes, self.config.train.num_envs
        scenes = None if strokes.collection else begin(self.env, num_envs, self._scene_key)
        return {"scenes": scenes, "learner": learner, "best": params}

    def _optimizer(self, per_epoch: int) -> Any:
        return make_optimizer(self.config.strokes, self.config.strokes.epochs * per_epoch)

    def _save_if_due(self) -> None:
        if time.monotonic() - self._saved_at >= 60 * self.config.train.checkpoint_minutes:
            self.try_to_save()

    def _write(self, what: str, write: Callable[[], object]) -> None:
        """Write a file; a full disk costs that, not the run."""
        self.folder.attempt(what, write, step=self.counters.step, say=self.console.say)

    def _tell_collection(self) -> None:
        counters, wanted = self.counters, self.config.strokes.positives
        share = counters.written / wanted
        left = counters.seconds["collect"] * (1 - share) / share if share else None
        rate = counters.attempts / max(counters.seconds["collect"], 1e-9)
        text = (
            f"{counters.written} of {wanted} stable grasps | {counters.attempts} strokes, {rate:.1f} per second | "
            f"left {format_time(left)}, then learning"
        )
        self.console.show(text, share=share)
        if counters.attempts // len(self.state["scenes"].attempts) % _LOG_BATCHES == 0:
            row = {
                "collect/stable": counters.written,
                "collect/collided": counters.collided,
                "collect/strokes_per_second": rate,
            }
            self._append({**row, **self._times})

    def _tell_learning(self, losses: Losses, num_updates: int) -> None:
        counters = self.counters
        share = counters.updates / num_updates
        left = counters.seconds["learn"] * (1 - share) / share
        named = {"start": float(losses.start), "aperture": float(losses.aperture)}
        self.console.show(
            f"update {counters.updates} of {num_updates} | loss {_listed(named)} | left {format_time(left)}",
            share=share,
        )
        if counters.updates % _LOG_BATCHES == 0:
            row = {f"train/{name}_loss": loss for name, loss in named.items()}
            self._append({**row, **self._times})

    def _append(self, row: dict[str, float]) -> None:
        self._write("metrics", lambda: self.folder.append_metrics({"env_steps": self.counters.step, **row}))

    @property
    def _times(self) -> dict[str, float]:
        seconds = self.counters.seconds
        return {"time/seconds": sum(seconds.values()), **{f"time/{part}": spent for part, spent in seconds.items()}}


def _listed(losses: dict[str, float]) -> str:
    return ", ".join(f"{name} {loss:.3g}" for name, loss in losses.items())
