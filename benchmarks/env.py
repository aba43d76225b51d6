"""Full environment steps per second, split by stage; prints one JSON object.

    python benchmarks/env.py --scenes 16 [--compare pybullet] [--against shelf]

A step is a push of mean length 0.1 m by every scene: planning, physics, heightmap, judging, and a reset of the
scenes that ended. `--compare pybullet` runs the same hulls and push lengths in two PyBullet processes, each
step with one 640 x 480 TinyRenderer depth and segmentation image (PyBullet must be installed by hand).
`--against NAME` steps another place by turns with the open table, so that both meet the same load.
"""

import pregrasp_jax  # noqa: F401  (sets NPROC before jax is imported)

# isort: split
import argparse
import dataclasses
import functools
import json
import multiprocessing
import os
import tempfile
import time
from collections.abc import Callable
from typing import IO, Any

import jax
import jax.numpy as jnp
import numpy as np
from scipy.spatial import ConvexHull

from pregrasp_jax import heightmap
from pregrasp_jax.policies.exploration import draw_choice
from pregrasp_jax.presets import PRESETS
from pregrasp_jax.spaces import grid
from pregrasp_jax.task.assembly import make_env
from pregrasp_jax.task.env import Env
from pregrasp_jax.task.primitive import Plan
from pregrasp_jax.task.push import SETTLE_TIME
from pregrasp_jax.types import EnvState

LENGTHS = (0.05, 0.15)
"""m; push lengths are uniform in this range, 0.1 m on average."""


def sample_action(env: Env, state: EnvState, key: jax.Array) -> jax.Array:
    """Return a push of random length toward the target, within 0.5 rad, open with probability 0.7."""
    length_key, angle_key, open_key = jax.random.split(key, 3)
    actions, here = env.primitive.actions, state.hand.xy
    offset = state.target_xy - here
    angle = jnp.atan2(offset[1], offset[0]) + 0.5 * jax.random.normal(angle_key)
    length = jax.random.uniform(length_key, minval=LENGTHS[0], maxval=LENGTHS[1])
    end = here + length * jnp.stack([jnp.cos(angle), jnp.sin(angle)])
    row, col = grid.world_to_cell(jnp.clip(end, -0.249, 0.249))
    return actions.encode(row, col, draw_choice(open_key, actions, open_probability=0.7))


def full_step(env: Env, state: EnvState, key: jax.Array) -> tuple[EnvState, jax.Array]:
    """Push, then reset the scenes that ended; what training does between two updates."""
    action_key, reset_key = jax.random.split(key)
    num_scenes = state.num_pushes.shape[0]
    actions = jax.vmap(functools.partial(sample_action, env))(state, jax.random.split(action_key, num_scenes))
    next_state, result = jax.vmap(env.step)(state, actions)
    fresh = jax.vmap(env.reset)(jax.random.split(reset_key, num_scenes))
    ended = result.terminated | result.truncated

    def choose(new: jax.Array, old: jax.Array) -> jax.Array:
        return jnp.where(ended.reshape(-1, *[1] * (new.ndim - 1)), new, old)

    return jax.tree.map(choose, fresh, next_state), jnp.linalg.norm(next_state.hand.xy - state.hand.xy, axis=-1)


def measure(num_scenes: int, num_steps: int) -> dict[str, Any]:
    """Run `num_steps` full steps of `num_scenes` scenes, and each stage alone on states met on the way."""
    config = PRESETS["cpu"]
    config = dataclasses.replace(config, scene=dataclasses.replace(config.scene, validation_scenes=50))
    env = make_env(config, split="validation")
    step = jax.jit(functools.partial(full_step, env))
    key = jax.random.key(0)
    state = jax.jit(jax.vmap(env.reset))(jax.random.split(key, num_scenes))
    state, _ = jax.block_until_ready(step(state, key))  # compiles
    stages = compile_stages(env)
    time_stages(stages, state, key)  # compiles
    times, lengths = [], []
    parts: dict[str, float] = {"plan": 0.0, "physics": 0.0, "heightmap": 0.0}
    for i in range(num_steps):
        step_key = jax.random.fold_in(key, i)
        for name, value in time_stages(stages, state, step_key).items():
            parts[name] += value / num_steps
        start = time.perf_counter()
        state, moved = jax.block_until_ready(step(state, step_key))
        times.append(time.perf_counter() - start)
        lengths.extend(np.asarray(moved))
    total = float(np.sum(times)) / num_steps
    parts["rest"] = total - sum(parts.values())
    return {
        "env_steps_per_second": num_scenes / total,
        "scenes": num_scenes,
        "steps": num_steps,
        "mean_push_m": float(np.mean([x for x in lengths if x > 0])),
        "unreachable_share": float(np.mean([x == 0 for x in lengths])),
        "ms_per_env_step": {name: 1e3 * value / num_scenes for name, value in parts.items()},
        "cores": len(os.sched_getaffinity(0)),
    }


def compare_places(name: str, num_scenes: int, num_steps: int) -> dict[str, Any]:
    """Step scenes on the open table and in the place `name` by turns.

    Pushes that a wall forbids cost no physics, so the rates are also given per push that was executed.
    """
    config = PRESETS["cpu"]
    config = dataclasses.replace(config, scene=dataclasses.replace(config.scene, validation_scenes=50))
    key = jax.random.key(0)
    steps, states, places = [], [], (config.task.workspace, name)
    for place in places:
        task = dataclasses.replace(config.task, workspace=place)
        env = make_env(dataclasses.replace(config, task=task), split="validation")
        step = jax.jit(functools.partial(full_step, env))
        state = jax.jit(jax.vmap(env.reset))(jax.random.split(key, num_scenes))
        states.append(jax.block_until_ready(step(state, key))[0])  # compiles
        steps.append(step)
    wall, cpu, executed = np.zeros((3, 2))
    for i in range(num_steps):
        for which in (0, 1) if i % 2 else (1, 0):
            start = time.perf_counter(), time.process_time()
            states[which], moved = jax.block_until_ready(steps[which](states[which], jax.random.fold_in(key, i)))
            wall[which] += time.perf_counter() - start[0]
            cpu[which] += time.process_time() - start[1]
            executed[which] += int((np.asarray(moved) > 0).sum())
    total = num_scenes * num_steps
    return {
        "places": places,
        "env_steps_per_second": (total / wall).tolist(),
        "env_steps_per_cpu_second": (total / cpu).tolist(),
        "executed_share": (executed / total).tolist(),
        "ratio": float(wall[0] / wall[1]),
        "ratio_cpu": float(cpu[0] / cpu[1]),
        "ratio_cpu_of_executed": float(cpu[0] / executed[0] / (cpu[1] / executed[1])),
    }


def compile_stages(env: Env) -> dict[str, Callable[..., Any]]:
    """Return the stages of a step, each vmapped and compiled alone."""

    def physics(state: EnvState, plan: Plan) -> Any:
        return env.engine.run(state.physics, plan.ctrl, plan.num_ctrl)

    def look(state: EnvState) -> Any:
        hulls = heightmap.scene_hulls(env.bank, env.robot, state.scene, state.physics_obs, env.workspace)
        return heightmap.observe(hulls, state.hand)

    stages = {"action": functools.partial(sample_action, env), "plan": env.plan, "physics": physics, "heightmap": look}
    return {name: jax.jit(jax.vmap(function)) for name, function in stages.items()}


def time_stages(stages: dict[str, Callable[..., Any]], state: EnvState, key: jax.Array) -> dict[str, float]:
    """Return the seconds of each stage in the step that `full_step` takes from this state with this key."""
    actions = stages["action"](state, jax.random.split(jax.random.split(key)[0], state.num_pushes.shape[0]))
    plan, plan_seconds = timed(stages["plan"], state, actions)
    _, physics_seconds = timed(stages["physics"], state, plan)
    _, look_seconds = timed(stages["heightmap"], state)
    # A full step looks twice: after the push and after the reset.
    return {"plan": plan_seconds, "physics": physics_seconds, "heightmap": 2 * look_seconds}


def timed(function: Callable[..., Any], *arguments: Any) -> tuple[Any, float]:
    """Return a result and the seconds it took."""
    start = time.perf_counter()
    result = jax.block_until_ready(function(*arguments))
    return result, time.perf_counter() - start


def pybullet_worker(num_steps: int, seed: int, queue: Any) -> None:
    """Push through the same packed scenes with a floating hand in PyBullet; put steps and seconds on the queue."""
    os.dup2(2, 1)  # PyBullet greets on standard output, where only the JSON belongs
    import pybullet as p  # pyright: ignore[reportMissingImports]

    env = make_env(PRESETS["cpu"], split="validation", threads=1)
    rng = np.random.default_rng(seed)
    view = p.computeViewMatrix([0, 0, 1.0], [0, 0, 0], [0, 1, 0])
    projection = p.computeProjectionMatrixFOV(35, 640 / 480, 0.05, 2.0)
    p.connect(p.DIRECT)
    elapsed, done = 0.0, 0
    while done < num_steps:
        index = int(rng.integers(len(env.scenes)))
        hand = pybullet_scene(p, env, index)
        target = env.scenes.poses[index, env.scenes.target[index], :2]
        position = np.array([-0.30, 0.0, 0.1])
        start = time.perf_counter()
        for _ in range(3):
            aim = np.arctan2(*(target - position[:2])[::-1])
            angle, length = rng.normal(aim, 0.5), rng.uniform(*LENGTHS)
            position = pybullet_push(p, hand, position, length * np.array([np.cos(angle), np.sin(angle), 0.0]))
            p.getCameraImage(640, 480, view, projection, renderer=p.ER_TINY_RENDERER)
            done += 1
        elapsed += time.perf_counter() - start
    queue.put((done, elapsed))


def pybullet_scene(p: Any, env: Env, index: int) -> int:
    """Build scene `index` of the bank with the same hulls; return the constraint that carries the hand."""
    p.resetSimulation()
    p.setGravity(0, 0, -9.81)
    p.setTimeStep(1 / 240)
    plane = p.createMultiBody(0, p.createCollisionShape(p.GEOM_BOX, halfExtents=[2, 2, 0.05]), -1, [0, 0, -0.05])
    p.changeDynamics(plane, -1, lateralFriction=0.1)
    for obj, pose in zip(env.scenes.object_ids[index], env.scenes.poses[index], strict=True):
        if obj < 0:
            continue
        with tempfile.NamedTemporaryFile("w", suffix=".obj") as file:
            write_obj(file, env, obj)
            shape = p.createCollisionShape(p.GEOM_MESH, fileName=file.name)
            seen = p.createVisualShape(p.GEOM_MESH, fileName=file.name)  # without it the renderer draws nothing
        x, y, z, qw, qx, qy, qz = pose.tolist()
        centre = [x, y, z + float(env.bank.com[obj, 2])]
        body = p.createMultiBody(float(env.bank.mass[obj]), shape, seen, centre, [qx, qy, qz, qw])
        p.changeDynamics(body, -1, lateralFriction=0.5)
    box = p.createCollisionShape(p.GEOM_BOX, halfExtents=[0.05, 0.06, 0.02])
    hand = p.createMultiBody(1.0, box, -1, [-0.30, 0, 0.1])
    return p.createConstraint(hand, -1, -1, -1, p.JOINT_FIXED, [0, 0, 0], [0, 0, 0], [-0.30, 0, 0.1])


def write_obj(file: IO[str], env: Env, obj: int) -> None:
    """Write the hulls of an object about its centre of mass; Bullet makes one convex shape of each group."""
    hulls = np.asarray(env.bank.object_hulls[obj])
    offset = 1
    for hull in hulls[hulls >= 0]:
        points = np.unique(np.asarray(env.bank.full.vertices[hull] - env.bank.com[obj]), axis=0)
        faces = ConvexHull(points).simplices + offset
        file.write(f"o hull_{hull}\n" + "".join("v {} {} {}\n".format(*point) for point in points))
        file.writelines("f {} {} {}\n".format(*face) for face in faces)
        offset += len(points)
    file.flush()


def pybullet_push(p: Any, hand: int, start: np.ndarray, offset: np.ndarray) -> np.ndarray:
    """Carry the hand along a minimum-jerk line at 0.1 m/s on average, then wait; return where it is now."""
    duration = np.linalg.norm(offset) / 0.1
    for i in range(int((duration + SETTLE_TIME) * 240)):
        s = min(i / 240 / duration, 1.0)
        p.changeConstraint(hand, (start + (10 * s**3 - 15 * s**4 + 6 * s**5) * offset).tolist(), maxForce=500)
        p.stepSimulation()
    return start + offset


def compare_pybullet(num_steps: int) -> float:
    """Return env steps per second of two PyBullet processes side by side."""
    context = multiprocessing.get_context("spawn")
    queue = context.Queue()
    workers = [context.Process(target=pybullet_worker, args=(num_steps, seed, queue)) for seed in range(2)]
    for worker in workers:
        worker.start()
    for worker in workers:
        worker.join()
        if worker.exitcode:
            raise RuntimeError("a PyBullet process failed; its error is above")
    rates = [done / elapsed for done, elapsed in (queue.get() for _ in workers)]
    return float(sum(rates))


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", type=int, default=16, help="scenes stepped in parallel")
    parser.add_argument("--steps", type=int, default=40, help="parallel steps")
    parser.add_argument("--compare", choices=["pybullet"], help="also run the reference simulator")
    parser.add_argument("--against", help="compare the open table with this place, and nothing else")
    arguments = parser.parse_args()
    if arguments.against:
        print(json.dumps(compare_places(arguments.against, arguments.scenes, arguments.steps)))
        return
    result = measure(arguments.scenes, arguments.steps)
    if arguments.compare:
        reference = compare_pybullet(30)
        result["pybullet_env_steps_per_second"] = reference
        result["ratio_to_pybullet"] = result["env_steps_per_second"] / reference
    print(json.dumps(result))


if __name__ == "__main__":
    main()
