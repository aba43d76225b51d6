"""Compile seconds and physics steps per second of the mjx engine, and of stock MJX; prints one JSON object.

    python benchmarks/mjx.py [--scenes 2 16 64] [--sizes 8x4 4x1] [--compare 6] [--rows 5] [--workspaces table shelf]

Scenes are rows of objects beside each other with the hand in front of them, so that contacts exist. `--compare N`
also runs N objects of one hull each with our collisions and with `mjx.step` on the same solver options, where every
object has a mesh of its own (stock MJX cannot change it per scene); both get every contact that they can make.
"""

import pregrasp_jax  # noqa: F401  (sets NPROC before jax is imported)
from pregrasp_jax.physics import mjx_version  # noqa: F401  (imports MJX without its print about Warp)

# isort: split
import argparse
import json
import os
import time
from importlib import metadata
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from mujoco import mjx as stock_mjx

from pregrasp_jax.assets.bank import select
from pregrasp_jax.assets.catalogue import builtin_bank
from pregrasp_jax.physics import mjx, mjx_model
from pregrasp_jax.physics.hull_collision import Limits
from pregrasp_jax.robot import get_robot
from pregrasp_jax.scene.model import parking_poses
from pregrasp_jax.scene.spec import compile_spec, scene_spec
from pregrasp_jax.spaces.workspace import TABLE, Workspace, get_workspace
from pregrasp_jax.types import MAX_HULLS, MAX_OBJECTS, HullBank, SceneParams

ROBOT = get_robot("ur5e_rg2")

SUBSTEPS = 5
"""Physics steps of a control row."""


def grid_scene(bank: HullBank, num_objects: int, seed: int) -> SceneParams:
    """Return objects of the bank in two columns, pairs 1 mm apart, ahead of the hand."""
    rng = np.random.default_rng(seed)
    ids = np.full(MAX_OBJECTS, -1)
    ids[:num_objects] = rng.choice(len(bank.names), num_objects, replace=len(bank.names) < num_objects)
    poses = parking_poses().astype(np.float32)
    for slot in range(num_objects):
        hulls = np.asarray(bank.object_hulls)[ids[slot]]
        corners = np.asarray(bank.full.vertices)[hulls[hulls >= 0]].reshape(-1, 3)
        side = 1 if slot % 2 else -1
        reach = corners[:, 1].max() if side < 0 else -corners[:, 1].min()
        poses[slot, :3] = 0.115 * (slot // 2) - 0.16, side * (reach + 0.0005), 0.0
    return SceneParams(jnp.asarray(ids, jnp.int32), jnp.asarray(poses), jnp.int32(0))


def measure(function: Any, arguments: tuple[Any, ...], steps: int, repeats: int = 3) -> dict[str, float]:
    """Lower, compile (without any cache) and time a jitted function that advances every scene by `steps` in all."""
    start = time.perf_counter()
    lowered = function.lower(*arguments)
    lower_seconds = time.perf_counter() - start
    start = time.perf_counter()
    compiled = lowered.compile()
    compile_seconds = time.perf_counter() - start
    times = []
    for _ in range(repeats + 1):
        start = time.perf_counter()
        jax.block_until_ready(compiled(*arguments))
        times.append(time.perf_counter() - start)
    return {
        "lower_seconds": lower_seconds,
        "compile_seconds": compile_seconds,
        "steps_per_second": steps / min(times[1:]),
    }


def measure_ours(
    bank: HullBank,
    num_scenes: int,
    rows: int,
    *,
    objects: int,
    hulls: int,
    limits: Limits,
    workspace: Workspace = TABLE,
) -> dict[str, Any]:
    """Time the engine with `objects` slots of `hulls` geoms, all scenes different."""
    engine = mjx.make_engine(bank, ROBOT, workspace, num_slots=objects, num_hulls=hulls, limits=limits)
    scenes = [grid_scene(bank, objects, seed) for seed in range(num_scenes)]
    batch = jax.tree.map(lambda *x: jnp.stack(x), *scenes)
    state = jax.vmap(lambda scene: engine.reset(engine.init(), scene))(batch)
    ctrl = jnp.broadcast_to(jnp.asarray(ROBOT.home[:7]), (num_scenes, rows, 7))
    num_ctrl = jnp.full(num_scenes, rows)
    run = jax.jit(jax.vmap(engine.run))
    result = measure(run, (state, ctrl, num_ctrl), num_scenes * rows * SUBSTEPS)
    after = run(state, ctrl, num_ctrl)
    overflows = int(jnp.sum(after.overflows))
    return {
        "engine": "mjx",
        "workspace": workspace.name,
        "scenes": num_scenes,
        "objects": objects,
        "hulls": hulls,
        **result,
        "max_contacts": int(after.max_contacts.max()),
        "overflows": overflows,
        "diverged": int(after.diverged.sum()),
    }


def measure_stock(bank: HullBank, num_scenes: int, rows: int, *, objects: int) -> dict[str, Any]:
    """Time `mjx.step` on the same objects, each with a mesh of its own, all scenes the same."""
    scene = grid_scene(bank, objects, 0)
    spec = scene_spec(ROBOT, TABLE)
    mjx_model.set_options(spec, None)
    for slot, object_id in enumerate(np.asarray(scene.object_ids)[:objects]):
        mesh = spec.add_mesh(name=f"hull_{slot}")
        hull = np.asarray(bank.object_hulls)[object_id, 0]
        mesh.uservert = np.unique(np.asarray(bank.coarse.vertices[hull], np.float64), axis=0).ravel()
        mesh.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_CONVEX
        body = spec.worldbody.add_body(name=f"object_{slot}", pos=np.asarray(scene.poses[slot, :3], np.float64))
        body.add_freejoint()
        body.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname=mesh.name, condim=3, mass=float(bank.mass[object_id]))
    mj_model = compile_spec(spec)
    data = mujoco.MjData(mj_model)
    ROBOT.set_home(mj_model, data)
    m = stock_mjx.put_model(mj_model)
    d = stock_mjx.put_data(mj_model, data)
    batch = jax.tree.map(lambda x: jnp.broadcast_to(x, (num_scenes, *jnp.shape(x))), d)
    steps = rows * SUBSTEPS

    def run(d: Any) -> Any:
        return jax.lax.fori_loop(0, steps, lambda _, d: stock_mjx.step(m, d), d)

    with jax.default_matmul_precision("highest"):  # as our engine does
        result = measure(jax.jit(jax.vmap(run)), (batch,), num_scenes * steps)
    return {"engine": "stock", "scenes": num_scenes, "objects": objects, "hulls": 1, **result}


def size(text: str) -> tuple[int, int]:
    """Return (objects, hulls) of a text like 8x4.

    Raises:
        ArgumentTypeError: it is not like that, or out of range.
    """
    objects, _, hulls = text.partition("x")
    if not (objects.isdecimal() and hulls.isdecimal()) or not (
        1 <= int(objects) <= MAX_OBJECTS and 1 <= int(hulls) <= MAX_HULLS
    ):
        raise argparse.ArgumentTypeError(
            f"{text!r}; allowed are 1x1 to {MAX_OBJECTS}x{MAX_HULLS}, objects first, then hulls"
        )
    return int(objects), int(hulls)


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", type=int, nargs="+", default=[2, 16, 64], help="scenes stepped in parallel")
    parser.add_argument(
        "--sizes",
        type=size,
        nargs="+",
        default=[(8, 4), (4, 1)],
        metavar="OBJECTSxHULLS",
        help="slots of a scene and hulls of a slot; objects with more hulls are left out",
    )
    parser.add_argument("--compare", type=int, help="also compare with stock MJX: this many objects of one hull")
    parser.add_argument("--rows", type=int, default=5, help="control rows (20 ms) of a measurement")
    parser.add_argument("--workspaces", nargs="+", default=[TABLE.name], help="places, by name")
    arguments = parser.parse_args()
    jax.config.update("jax_enable_compilation_cache", False)
    bank = builtin_bank("seen")
    count = (np.asarray(bank.object_hulls) >= 0).sum(axis=1)
    rows = []
    for scenes in arguments.scenes:
        for objects, hulls in arguments.sizes:
            fitting = select(bank, np.flatnonzero(count <= hulls))
            sizes = {"objects": objects, "hulls": hulls}
            for name in arguments.workspaces:
                place = {"workspace": get_workspace(name), "limits": mjx.LIMITS}
                rows.append(measure_ours(fitting, scenes, arguments.rows, **sizes, **place))
        if arguments.compare:
            single = select(bank, np.flatnonzero(count == 1))
            # As many as stock makes: nothing culled, nothing dropped.
            everything = Limits(max_hull_pairs=10**6, max_robot_pairs=10**6, max_contact_points=10**6)
            sizes = {"objects": arguments.compare, "hulls": 1}
            rows.append({**measure_ours(single, scenes, arguments.rows, **sizes, limits=everything), "limits": "none"})
            rows.append(measure_ours(single, scenes, arguments.rows, **sizes, limits=mjx.LIMITS))
            rows.append(measure_stock(single, scenes, arguments.rows, objects=arguments.compare))
    versions = {name: metadata.version(name) for name in ("mujoco", "mujoco-mjx", "jax", "jaxlib")}
    device = jax.devices()[0]
    machine = {"device": device.device_kind, "cores": len(os.sched_getaffinity(0)), "load": os.getloadavg()[0]}
    print(json.dumps({"runs": rows, "versions": versions, **machine}))


if __name__ == "__main__":
    main()
