"""Strokes of the Barrett hand at single objects: how many are held stably; prints one JSON object.

    python benchmarks/strokes.py [--aperture 0.6 0.85 1.1] [--object-set seen] [--threads 0]

Every object of the set stands alone, `AHEAD` of where the hand comes down, turned at random, 20 mm to the left of the
heading, on it, or 20 mm to the right. The hand pushes 0.15 m, closes, lifts 0.3 m and holds for a second. `--packed N`
measures instead how many random strokes per second N packed scenes take side by side, and how they end, `--decide W`
what a decision of untrained networks of width W takes.
"""

import pregrasp_jax  # noqa: F401  (sets NPROC before jax is imported)

# isort: split
import argparse
import json
import time

import jax
import jax.numpy as jnp
import numpy as np

from pregrasp_jax.assets.sets import builtin_bank
from pregrasp_jax.config import Config, StrokesConfig, TaskConfig
from pregrasp_jax.evaluation.clearing import HOLD_TIME, own_protocol
from pregrasp_jax.learning.imitation import StrokeFunction
from pregrasp_jax.physics import make_engine
from pregrasp_jax.policies.ppg import greedy
from pregrasp_jax.robot import get_robot
from pregrasp_jax.scene.model import parking_poses
from pregrasp_jax.spaces.workspace import TABLE
from pregrasp_jax.task import push_grasp, registry, stroke_rules
from pregrasp_jax.task.assembly import make_env
from pregrasp_jax.training.stroke_collection import begin, make_collect
from pregrasp_jax.types import MAX_OBJECTS, SceneParams

AHEAD = 0.17
"""m from where the hand comes down to the middle of an object: clear of the open fingers."""

OFFSETS = (-0.02, 0.0, 0.02)
"""m beside the heading."""


def scenes(num_objects: int) -> SceneParams:
    """Return a batch of scenes of one object each."""
    rng = np.random.default_rng(0)
    cases = [(index, offset) for index in range(num_objects) for offset in OFFSETS]
    ids, poses = np.full((len(cases), MAX_OBJECTS), -1), np.tile(parking_poses(), (len(cases), 1, 1))
    for row, (index, offset) in enumerate(cases):
        yaw = rng.uniform(-np.pi, np.pi)
        ids[row, 0] = index
        poses[row, 0] = [AHEAD - push_grasp.DISTANCE, offset, 0, np.cos(yaw / 2), 0, 0, np.sin(yaw / 2)]
    return SceneParams(jnp.asarray(ids), jnp.asarray(poses, jnp.float32), jnp.zeros(len(cases), jnp.int32))


def packed(num_scenes: int, threads: int, *, rounds: int = 4) -> dict[str, float]:
    """Return rates of the first strokes in packed scenes, drawing and judging included."""
    config = Config(task=TaskConfig(robot="barrett", primitive="push_grasp"))
    env = own_protocol(make_env(config, split="train", threads=threads))
    stages = make_collect(env, 1)
    scenes, key = begin(env, num_scenes, jax.random.key(0)), jax.random.key(1)
    collect = stages.compile(scenes, key)
    counts = np.zeros(4)
    wall, cpu = -time.perf_counter(), -time.process_time()
    for _ in range(rounds):
        scenes, attempt = collect(scenes, key)
        outcome = attempt.result.outcome
        flags = outcome.collided, outcome.held.any(axis=1), outcome.stable.any(axis=1), outcome.diverged
        counts += [float(np.asarray(flag).sum()) for flag in flags]
    total = rounds * num_scenes
    shares = dict(zip(("collided", "lifted", "stable", "diverged"), (counts / total).tolist(), strict=True))
    wall, cpu = wall + time.perf_counter(), cpu + time.process_time()
    return {"strokes": total, "strokes_per_second": total / wall, "strokes_per_cpu_second": total / cpu, **shares}


def decide(width: float, *, rounds: int = 20) -> dict[str, float]:
    """Return the median ms and processor ms of a decision: all 16 maps of one scene, and an aperture."""
    config = Config(task=TaskConfig(robot="barrett", primitive="push_grasp"), strokes=StrokesConfig(width=width))
    env = make_env(config, split="test", threads=1)
    function = StrokeFunction(config.strokes, env.primitive.actions)
    params, state = function.init(jax.random.key(0)), jax.jit(env.reset_to)(0)
    choose = jax.jit(greedy(function))
    jax.block_until_ready(choose(params, state, jax.random.key(0)))
    times = np.zeros((rounds, 2))
    for row in times:
        row -= time.perf_counter(), time.process_time()
        jax.block_until_ready(choose(params, state, jax.random.key(0)))
        row += time.perf_counter(), time.process_time()
    wall, cpu = 1000 * np.median(times, axis=0)
    return {"width": width, "ms": float(wall), "cpu_ms": float(cpu)}


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--aperture", type=float, nargs="+", default=[0.6, 0.85, 1.1], help="drive angles, rad")
    parser.add_argument("--object-set", choices=["seen", "unseen"], default="seen", help="which objects")
    parser.add_argument("--threads", type=int, default=0, help="of physics; 0 takes every core")
    parser.add_argument("--packed", type=int, default=0, help="packed scenes side by side")
    parser.add_argument("--decide", type=float, default=0.0, metavar="WIDTH", help="width of networks that decide")
    arguments = parser.parse_args()
    if arguments.decide:
        print(json.dumps(decide(arguments.decide)))
        return
    if arguments.packed:
        print(json.dumps(packed(arguments.packed, arguments.threads)))
        return
    for aperture in arguments.aperture:
        push_grasp.APERTURE.refuse(aperture)
    bank, robot, task = builtin_bank(arguments.object_set), get_robot("barrett"), TaskConfig(primitive="push_grasp")
    engines = registry.get_kind(task.primitive).engines
    engine = make_engine("native", bank, robot, TABLE, threads=arguments.threads, engines=engines)
    tips = np.isin(robot.links.names, robot.fingertips)

    def attempt(scene: SceneParams, aperture: jax.Array) -> tuple[jax.Array, jax.Array]:
        stroke = push_grasp.push_grasp(jnp.array([-push_grasp.DISTANCE, 0.0]), 0.0, aperture)
        plan = push_grasp.plan_stroke(robot, TABLE, stroke, push_speed=task.push_speed, hold_time=HOLD_TIME)
        physics = engine.run(engine.reset(engine.init(), scene), plan.ctrl, plan.num_ctrl)
        touch = engine.observe(physics).touch
        assert touch is not None
        return stroke_rules.stable(touch, tips)[0] & (touch.poses[2, 0, 2] > push_grasp.LIFTED), touch.collided

    batch = scenes(len(bank.names))
    run = jax.jit(jax.vmap(attempt, (0, None)))
    result = {}
    for aperture in arguments.aperture:
        held, collided = (np.asarray(flags) for flags in run(batch, jnp.float32(aperture)))
        by_object = held.reshape(len(bank.names), len(OFFSETS)).sum(axis=1)
        result[f"{aperture:g}"] = {
            "held": int(held.sum()),
            "of": len(held),
            "collided": int(collided.sum()),
            "failing": {bank.names[i]: int(by_object[i]) for i in np.flatnonzero(by_object < len(OFFSETS))},
        }
    print(json.dumps(result))


if __name__ == "__main__":
    main()
