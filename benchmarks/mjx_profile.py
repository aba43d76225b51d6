"""Where a physics step of the `mjx` engine spends its time; prints one JSON object.

    python benchmarks/mjx_profile.py [--scenes 2 16] [--size 8x4] [--steps 50]

A program that ends after each stage of the step is timed on the same scenes, objects in rows with the hand before them,
after a tenth of a second; what a stage costs is the difference from the one before, in microseconds per scene and step.
"""

import pregrasp_jax  # noqa: F401  (sets NPROC before jax is imported)
from pregrasp_jax.physics import mjx_version  # noqa: F401  (imports MJX without its print about Warp)

# isort: split
import argparse
import json
import os
import time
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from mjx import grid_scene, size
from mujoco import mjx as stock_mjx
from mujoco.mjx._src import constraint, forward, smooth, solver

from pregrasp_jax.assets.bank import select
from pregrasp_jax.assets.catalogue import builtin_bank
from pregrasp_jax.physics import mjx
from pregrasp_jax.physics.hull_collision import collide
from pregrasp_jax.physics.mjx_model import MjxSlotModel, fill_slots, make_mjx_slot_model
from pregrasp_jax.robot import get_robot
from pregrasp_jax.spaces.workspace import TABLE

ROBOT = get_robot("ur5e_rg2")
NUM_CONTROLS = len(ROBOT.actuators)

Stage = Callable[[Any, Any, jax.Array], Any]
"""(model, data, hull ids) -> data."""


def stages(model: MjxSlotModel) -> dict[str, tuple[Stage, ...]]:
    """Return the parts of `physics.mjx.step`, in its order."""

    def of_mjx(*functions: Callable[[Any, Any], Any]) -> tuple[Stage, ...]:
        return tuple(lambda m, d, ids, f=f: f(m, d) for f in functions)

    def collisions(m: Any, d: Any, ids: jax.Array) -> Any:
        return collide(m, d, model.hulls, ids, model.limits)[0]

    return {
        "kinematics and inertia": of_mjx(mjx.kinematics, smooth.com_pos, smooth.tendon, smooth.crb, smooth.factor_m),
        "collisions": (collisions,),
        "constraints": of_mjx(constraint.make_constraint, smooth.transmission),
        "velocity, actuation, acceleration": of_mjx(
            forward.fwd_velocity, forward.fwd_actuation, forward.fwd_acceleration
        ),
        "solver": of_mjx(solver.solve),
        "integration": of_mjx(forward.implicit),
    }


SETTLE = 5
"""Control rows (20 ms) before the measurement."""

_TINY = 1e-30
"""Times a number of a stage, added to its input: nothing, but XLA cannot take the stage out of the loop."""


def time_prefix(model: MjxSlotModel, parts: list[Stage], batch: tuple[Any, ...], steps: int) -> float:
    """Return seconds of `steps` repetitions of some stages on all scenes (object ids, qpos, qvel, warm start)."""
    template, ctrl = stock_mjx.make_data(model.mjx_model), jnp.asarray(ROBOT.home[:NUM_CONTROLS])

    def run(object_ids: jax.Array, qpos: jax.Array, qvel: jax.Array, warmstart: jax.Array) -> jax.Array:
        m, ids = fill_slots(model, object_ids)

        def once(_: Any, qpos: jax.Array) -> jax.Array:
            d = start = template.replace(qpos=qpos, qvel=qvel, qacc_warmstart=warmstart, ctrl=ctrl)
            for part in parts:
                d = part(m, d, ids)
            pairs = zip(jax.tree.leaves(d), jax.tree.leaves(start), strict=True)
            made = [new for new, old in pairs if new is not old and jnp.issubdtype(new.dtype, jnp.floating)]
            return qpos + _TINY * sum(jnp.sum(jnp.clip(x, -1.0, 1.0)) for x in made)

        return jax.lax.fori_loop(0, steps, once, qpos)

    with jax.numpy_rank_promotion("allow"), jax.default_matmul_precision("highest"):
        compiled = jax.jit(jax.vmap(run)).lower(*batch).compile()
    times = []
    for _ in range(4):
        start = time.perf_counter()
        jax.block_until_ready(compiled(*batch))
        times.append(time.perf_counter() - start)
    return min(times[1:])


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", type=int, nargs="+", default=[2, 16], help="scenes stepped in parallel")
    parser.add_argument("--size", type=size, default=(8, 4), metavar="OBJECTSxHULLS", help="slots, and hulls of each")
    parser.add_argument("--steps", type=int, default=50, help="physics steps of a measurement")
    arguments = parser.parse_args()
    objects, hulls = arguments.size
    bank = builtin_bank("seen")
    bank = select(bank, np.flatnonzero((np.asarray(bank.object_hulls) >= 0).sum(axis=1) <= hulls))
    model = make_mjx_slot_model(bank, ROBOT, TABLE, limits=mjx.LIMITS, num_slots=objects, num_hulls=hulls)
    engine = mjx.make_engine(bank, ROBOT, TABLE, num_slots=objects, num_hulls=hulls)
    rows = {}
    for num_scenes in arguments.scenes:
        scenes = jax.tree.map(lambda *x: jnp.stack(x), *[grid_scene(bank, objects, seed) for seed in range(num_scenes)])
        state = jax.vmap(lambda scene: engine.reset(engine.init(), scene))(scenes)
        hold = jnp.broadcast_to(jnp.asarray(ROBOT.home[:NUM_CONTROLS]), (num_scenes, SETTLE, NUM_CONTROLS))
        state = jax.jit(jax.vmap(engine.run))(state, hold, jnp.full(num_scenes, SETTLE))
        batch = state.object_ids[:, :objects], state.qpos, state.qvel, state.qacc_warmstart
        parts, before, row = [], 0.0, {}
        for name, more in stages(model).items():
            parts.extend(more)
            seconds = time_prefix(model, parts, batch, arguments.steps)
            row[name] = 1e6 * (seconds - before) / (num_scenes * arguments.steps)
            before = seconds
        rows[num_scenes] = {"whole step": 1e6 * before / (num_scenes * arguments.steps), **row}
    machine = {"device": jax.devices()[0].device_kind, "cores": len(os.sched_getaffinity(0)), "load": os.getloadavg()}
    print(json.dumps({"objects": objects, "hulls": hulls, "microseconds": rows, **machine}))


if __name__ == "__main__":
    main()
