"""How far the mjx engine agrees with C MuJoCo on packed scenes; prints one JSON object.

    python benchmarks/mjx_agreement.py [--states 200] [--scenes 50] [--batch 10] [--object-set seen] [--object-dir DIR]
        [--walls]

Contacts: pairs of geoms that touch in random states, packed and pressed together or scattered around the arm, by
distance and normal against C on the same hulls, and against the exact least translation.

Pushes: every packed scene is moved until it lies just before the fingers, then pushed by 0.15 m towards its target, by
mjx, by native with the options and hulls of mjx, by the same from poses that are shifted by a micrometre, and by
native as it is. Compared are final positions, of all objects and of those that native moved by more than 1 mm, and
what the task makes of the push: the reason of an ending, the reward, success. With `--walls` a shelf stands so close
around these scenes that many objects are pushed against it; scenes that do not fit in are left out.
"""

import pregrasp_jax  # noqa: F401  (sets NPROC before jax is imported)

# isort: split
import argparse
import dataclasses
import json
import sys
from importlib import metadata
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from pregrasp_jax.assets.sets import load_bank_for
from pregrasp_jax.config import Config, SceneConfig
from pregrasp_jax.geometry import quat_to_matrix
from pregrasp_jax.physics import mjx, native
from pregrasp_jax.physics.base import Engine
from pregrasp_jax.physics.mjx_model import make_mjx_slot_model, make_reference_model
from pregrasp_jax.robot import get_robot
from pregrasp_jax.scene import bank as scene_bank
from pregrasp_jax.scene.bank import SceneBank
from pregrasp_jax.spaces import grid
from pregrasp_jax.spaces.workspace import TABLE, Workspace, get_workspace
from pregrasp_jax.task.assembly import assemble
from pregrasp_jax.task.env import Env
from pregrasp_jax.task.push import push_actions
from pregrasp_jax.task.rules import TARGET_IN_REGION
from pregrasp_jax.types import REASONS, HullBank, SceneParams

ROBOT = get_robot("ur5e_rg2")

DISTANCE = 0.15
"""m of a push."""

FIRST_X = -0.185
"""m; the nearest point of a scene, 6 mm ahead of the closed fingers at the start pose and beside the open ones."""

SHIFT = 1e-6
"""m; standard deviation by which the start poses of native are shifted to see how sensitive a push is."""

MOVED = 1e-3
"""m; an object that native pushed farther than this counts as moved."""


CLOSE = get_workspace("shelf", {"front": FIRST_X, "half_width": 0.17, "back": 0.13})
"""Walls around scenes that begin at `FIRST_X`, nearer than a task allows, for the hand does not go far here."""


def fitting(bank: HullBank, scenes: SceneBank, workspace: Workspace) -> np.ndarray:
    """Return the indices of the scenes that stand clear of walls once they are moved as `near_scenes` does."""
    near, inside = near_scenes(bank, scenes, len(scenes)), []
    for i, (ids, poses) in enumerate(zip(np.asarray(near.object_ids), np.asarray(near.poses), strict=True)):
        points = [
            np.asarray(bank.full.vertices)[hull] @ quat_to_rotation(poses[slot, 3:]).T + poses[slot, :3]
            for slot in np.flatnonzero(ids >= 0)
            for hull in np.asarray(bank.object_hulls)[ids[slot]]
            if hull >= 0
        ]
        x, y = np.concatenate(points)[:, :2].T
        back, left, _ = workspace.walls
        fits = x.max() < back.corners()[:, 0].min() and np.abs(y).max() < left.corners()[:, 1].min()
        inside += [i] if fits else []
    return np.array(inside, int)


def quat_to_rotation(quat: np.ndarray) -> np.ndarray:
    """Return the rotation [3, 3] of a quaternion."""
    return np.asarray(quat_to_matrix(jnp.asarray(quat)))


def near_scenes(bank: HullBank, scenes: SceneBank, count: int, shift: float = 0.0) -> SceneParams:
    """Return the first scenes of a bank [count], moved along x so that they begin at `FIRST_X`."""
    rng = np.random.default_rng(0)
    poses = scenes.poses[:count].copy()
    for i, ids in enumerate(scenes.object_ids[:count]):
        lows = []
        for slot in np.flatnonzero(ids >= 0):
            hulls = np.asarray(bank.object_hulls)[ids[slot]]
            points = np.asarray(bank.full.vertices)[hulls[hulls >= 0]].reshape(-1, 3)
            w, x, y, z = poses[i, slot, 3:]
            row = np.array([1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)])
            lows.append(poses[i, slot, 0] + (points @ row).min())
        present = ids >= 0
        poses[i, present, 0] += FIRST_X - min(lows)
        poses[i, present, :3] += shift * rng.normal(size=(present.sum(), 3))
    arrays = scenes.object_ids[:count], poses, scenes.target[:count]
    return SceneParams(*(jnp.asarray(x) for x in arrays))


def actions_towards_targets(scenes: SceneParams) -> jax.Array:
    """Return for each scene [S] the open push of `DISTANCE` towards its target, at most 75 degrees aside."""
    start = np.asarray(ROBOT.start.xy)
    target = np.take_along_axis(np.asarray(scenes.poses), np.asarray(scenes.target)[:, None, None], axis=1)[:, 0, :2]
    angle = np.clip(np.arctan2(*(target - start).T[::-1]), -np.radians(75), np.radians(75))
    ends = start + DISTANCE * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    row, col = grid.world_to_cell(jnp.asarray(ends, jnp.float32))
    actions = push_actions(ROBOT)
    return actions.encode(row, col, jnp.int32(actions.widest))


def push_all(env: Env, scenes: SceneParams, actions: jax.Array, batch: int) -> dict[str, np.ndarray]:
    """Push once in every scene, `batch` at a time."""

    def push(scene: SceneParams, action: jax.Array) -> tuple[Any, ...]:
        before = env.start(scene)
        after, result = env.step(before, action)
        reward = result.reward
        seen = after.physics_obs
        return before.physics_obs.object_poses, seen.object_poses, result.reason, reward, seen.diverged, seen.overflows

    program = jax.jit(jax.vmap(push))
    count = len(actions)
    parts = []
    for first in range(0, count, batch):
        index = np.minimum(np.arange(first, first + batch), count - 1)
        parts.append(jax.device_get(program(*jax.tree.map(lambda x, i=index: x[i], (scenes, actions)))))
    names = ("before", "after", "reason", "reward", "diverged", "overflows")
    return {name: np.concatenate(values)[:count] for name, values in zip(names, zip(*parts, strict=True), strict=True)}


def compare_pushes(result: dict[str, np.ndarray], reference: dict[str, np.ndarray], present: np.ndarray) -> dict:
    """Return what differs between two engines on the same pushes."""
    error = np.linalg.norm(result["after"][..., :3] - reference["after"][..., :3], axis=-1)
    moved = np.linalg.norm(reference["after"][..., :2] - reference["before"][..., :2], axis=-1)
    chosen = {"all": present, "moved": present & (moved > MOVED)}
    success = [r["reason"] == TARGET_IN_REGION for r in (result, reference)]
    same_reason, same_reward = (result[name] == reference[name] for name in ("reason", "reward"))
    differing = [
        [int(i), REASONS[result["reason"][i]], REASONS[reference["reason"][i]]]
        for i in np.flatnonzero(~(same_reason & same_reward))
    ]
    return {
        **{f"error_mm_{name}": percentiles(1e3 * error[mask]) for name, mask in chosen.items()},
        "objects": {name: int(mask.sum()) for name, mask in chosen.items()},
        "median_way_mm_moved": float(1e3 * np.median(moved[chosen["moved"]])) if chosen["moved"].any() else None,
        "same_success": float((success[0] == success[1]).mean()),
        "same_reason": float(same_reason.mean()),
        "same_reason_and_reward": float((same_reason & same_reward).mean()),
        "successes": [int(s.sum()) for s in success],
        "differing": differing,
        "diverged": [int(r["diverged"].sum()) for r in (result, reference)],
        "overflows": [int((r["overflows"] > 0).sum()) for r in (result, reference)],
    }


def percentiles(values: np.ndarray) -> dict[str, float] | None:
    """Return median, 90th percentile and maximum."""
    return (
        dict(zip(("p50", "p90", "max"), np.percentile(values, [50, 90, 100]).tolist(), strict=True))
        if len(values)
        else None
    )


def measure_pushes(bank: HullBank, scenes: SceneBank, count: int, batch: int, workspace: Workspace) -> dict[str, Any]:
    """Push the same scenes with all engines and compare.

    The task is that of the open table; only the engines know of walls.
    """
    if workspace.walls:
        chosen = fitting(bank, scenes, workspace)[:count]
        rows = {name: getattr(scenes, name)[chosen] for name in ("object_ids", "poses", "yaw", "target", "seeds")}
        scenes, count = dataclasses.replace(scenes, **rows), len(chosen)
    env = assemble(Config(), bank, scenes)
    near, shifted = (near_scenes(bank, scenes, count, shift) for shift in (0.0, SHIFT))
    actions = actions_towards_targets(near)

    def with_engine(engine: Engine, start: SceneParams, size: int) -> dict[str, np.ndarray]:
        return push_all(dataclasses.replace(env, engine=engine), start, actions, size)

    reference = native.make_engine(bank, ROBOT, workspace, model=make_reference_model(bank, ROBOT, workspace))
    itself = native.make_engine(bank, ROBOT, workspace)
    c, c_shifted, own = (
        with_engine(engine, start, count) for engine, start in ((reference, near), (reference, shifted), (itself, near))
    )
    ours = with_engine(mjx.make_engine(bank, ROBOT, workspace), near, batch)
    present = np.asarray(near.object_ids) >= 0
    return {
        "scenes": count,
        "mjx_against_native_with_its_options": compare_pushes(ours, c, present),
        "native_with_its_options_shifted": compare_pushes(c_shifted, c, present),
        "native_with_its_options_against_native": compare_pushes(c, own, present),
        "mjx_against_native": compare_pushes(ours, own, present),
    }


def measure_contacts(bank: HullBank, scenes: SceneBank, count: int) -> dict[str, Any]:
    """Compare contacts with C and with exact geometry, with what the tests compare."""
    sys.path.append(str(Path(__file__).parent.parent / "tests"))
    from mjx_contacts import AMPLE, EXACT, UNIQUE, make_contacts_of, touching_pairs
    from mjx_oracle import CoarseModel

    model = make_mjx_slot_model(bank, ROBOT, TABLE, limits=AMPLE)
    pairs = touching_pairs(model, CoarseModel(bank), make_contacts_of(model), scenes, count)
    table = {}
    for kind in sorted({pair.kind for pair in pairs}):
        chosen = [pair for pair in pairs if pair.kind == kind]
        both = [pair for pair in chosen if pair.ours and pair.reference]
        cosines = np.array([pair.ours.normal @ pair.reference.normal for pair in both])
        row: dict[str, Any] = {
            "pairs": len(chosen),
            "found_by_one_only": [
                sum(pair.reference is None for pair in chosen),
                sum(pair.ours is None for pair in chosen),
            ],
            "distance_to_c_um": percentiles(np.array([1e6 * abs(p.ours.dist - p.reference.dist) for p in both])),
            "normal_within_1_degree_of_c": float((cosines > np.cos(np.radians(1))).mean()),
        }
        if kind != "table":
            row["distance_to_exact_um"] = percentiles(np.array([1e6 * abs(p.ours.dist + p.least) for p in both]))
            row["c_to_exact_um"] = percentiles(np.array([1e6 * abs(p.reference.dist + p.least) for p in both]))
            row["c_is_exact"] = float(np.mean([pair.reference_is_exact for pair in both]))
        if kind in ("hulls", "box"):
            unique = [pair for pair in both if pair.margin > UNIQUE]
            row["unique"] = len(unique) / len(both)
            row["normal_within_1_degree_of_exact_where_unique"] = float(
                np.mean([pair.ours.normal @ pair.normal > np.cos(np.radians(1)) for pair in unique])
            )
        table[kind] = row
    return {"states": count, "exact_m": EXACT, "unique_m": UNIQUE, **table}


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--states", type=int, default=200, help="random states whose contacts are compared, 0: none")
    parser.add_argument("--scenes", type=int, default=50, help="packed scenes that are pushed, 0: none")
    parser.add_argument("--batch", type=int, default=10, help="scenes that mjx pushes side by side")
    parser.add_argument("--object-set", choices=["seen", "unseen"], default="seen", help="which objects")
    parser.add_argument("--walls", action="store_true", help="push scenes between walls")
    parser.add_argument("--object-dir", help="folder of meshes instead of the built-in catalogue")
    arguments = parser.parse_args()
    bank = load_bank_for(arguments.object_dir, arguments.object_set)
    wanted = max(arguments.scenes, 3) if not arguments.walls else 4 * max(arguments.scenes, 3)
    scenes = scene_bank.load_or_build(bank, ROBOT.eligibility(bank).eligible, SceneConfig(test_scenes=wanted), "test")
    versions = {name: metadata.version(name) for name in ("mujoco", "mujoco-mjx", "jax", "jaxlib")}
    document: dict[str, Any] = {"device": jax.devices()[0].device_kind, "versions": versions}
    if arguments.states:
        document["contacts"] = measure_contacts(bank, scenes, arguments.states)
    if arguments.scenes:
        document["pushes"] = measure_pushes(
            bank, scenes, arguments.scenes, arguments.batch, CLOSE if arguments.walls else TABLE
        )
    print(json.dumps(document))


if __name__ == "__main__":
    main()
