"""How long a deployed decision takes, how big it is, and whether it is that of the training's own pipeline.

Prints one JSON object. `--scenes N` plays N test scenes through the loop of `deploy --arm sim` with the pinhole camera:
in every state the push of the runtime is compared with that of the policy in JAX, which sees the same state through the
JAX pipeline, and ONNX and StableHLO with Flax. Times are the least and the middle of several, ms; `load` says what else
the machine did.
"""

import argparse
import dataclasses
import json
import os
import platform
import subprocess
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np

from pregrasp_jax.deploy.build import make_decider
from pregrasp_jax.deploy.bundle import read_bundle
from pregrasp_jax.deploy.camera import depth_in_metres
from pregrasp_jax.deploy.cell import Cell, SimSettings
from pregrasp_jax.deploy.golden import golden_view
from pregrasp_jax.deploy.masks import label_image
from pregrasp_jax.deploy.projection import draw_robot, to_maps

TIE = 2e-4
"""Values nearer than this are a tie."""

MEMORY = """
import sys
import numpy as np
from pathlib import Path
from pregrasp_jax.deploy import build
from pregrasp_jax.deploy.bundle import read_bundle
from pregrasp_jax.deploy.cell import Cell
from pregrasp_jax.deploy.golden import heightmap_agreement
from pregrasp_jax.deploy.projection import Maps
bundle = read_bundle(sys.argv[1])
golden, decider = bundle.arrays("golden.npz"), build.make_decider(bundle, Cell())
heightmap_agreement(bundle, golden)
for _ in range(3):
    decider.decide(Maps(golden["height_m"][0], golden["labels"][0], 1.0), decider.start(), golden["joint_pos"][0])
print(next(line.split()[1] for line in Path("/proc/self/status").read_text().splitlines() if line.startswith("VmHWM")))
"""


def times_ms(function: Any, repetitions: int) -> dict[str, float]:
    """Return the least and the middle time of a function."""
    function()
    found = []
    for _ in range(repetitions):
        start = time.perf_counter()
        function()
        found.append(1e3 * (time.perf_counter() - start))
    return {"min": round(min(found), 2), "median": round(float(np.median(found)), 2)}


def measure_parts(bundle: Any, *, threads: int, repetitions: int) -> dict[str, Any]:
    """Return what a decision takes on a golden image with the hand among the objects, part by part."""
    golden, entry = bundle.arrays("golden.npz"), bundle.contract.grid
    runtime = dataclasses.replace(Cell().runtime, threads=threads)
    decider = make_decider(bundle, dataclasses.replace(Cell(), runtime=runtime))
    view, joints = golden_view(golden), golden["joint_pos"][-1]
    labels = label_image(golden["instances"][-1], int(golden["target_id"][-1]), entry.labels)
    robot = {"body": decider.body, "joint_pos": joints, "entry": entry}

    def read() -> tuple[np.ndarray, np.ndarray]:
        metres = depth_in_metres(golden["depth"][-1], scale=float(golden["depth_scale"]), shape=view.camera.shape)
        return view.cut(metres).copy(), view.cut(labels).copy()

    def draw() -> tuple[np.ndarray, np.ndarray]:
        depth, cut = read()
        draw_robot(depth, cut, view=view, **robot)
        return depth, cut

    drawn = draw()
    maps, hand = to_maps(*drawn, view=view), decider.start()._replace(xy=golden["p1_m"][-1].astype(float))
    p1 = np.asarray(hand.xy, np.float32)[None]
    push = decider.decide(maps, hand, joints).push
    assert push is not None, "the arm can reach something on a golden image"

    def whole() -> Any:
        return decider.decide(to_maps(*draw(), view=view), hand, joints)

    return {
        "reading": times_ms(read, repetitions),
        "reading_and_drawing": times_ms(draw, repetitions),
        "projection": times_ms(lambda: to_maps(*drawn, view=view), repetitions),
        "network": times_ms(lambda: decider.values(maps.height_m[None], maps.labels[None], p1), repetitions),
        "reachability_of_one_push": times_ms(lambda: decider.plan(push.action, 0.0, hand, joints), repetitions),
        "decision": times_ms(whole, repetitions),
    }


def make_bundle(policy: Any, folder: Path) -> Any:
    """Export a policy and read it back."""
    from pregrasp_jax.export.bundle import export_policy

    export_policy(policy, folder)
    return read_bundle(folder)


def paper_policy(folder: Path) -> Any:
    """Return a policy of the paper's network at width 1 with fresh parameters."""
    import jax

    from pregrasp_jax.checkpoint import load_policy, save_policy
    from pregrasp_jax.config import Config
    from pregrasp_jax.learning.q_function import make_q_function
    from pregrasp_jax.robot import get_robot
    from pregrasp_jax.task.push import push_actions

    config = Config()
    q_function = make_q_function(config.network, config.task, push_actions(get_robot(config.task.robot)))
    save_policy(folder, q_function.init(jax.random.key(0)), config, {})
    return load_policy(folder)


def play(bundle: Any, *, scenes: range) -> dict[str, Any]:
    """Play scenes through the loop and compare every decision with that of the JAX pipeline in the same state."""
    import jax
    import jax.numpy as jnp
    from jax import export

    from pregrasp_jax.checkpoint import load_policy
    from pregrasp_jax.export.stablehlo import policy_function
    from pregrasp_jax.heightmap import fuse_segmentation
    from pregrasp_jax.learning.q_function import make_q_function
    from pregrasp_jax.simulated_cell import SimulatedCell, make_programs, make_simulated_station
    from pregrasp_jax.spaces import grid

    cell = dataclasses.replace(Cell(), sim=SimSettings(scene=scenes.start))
    programs = make_programs(bundle, cell)
    station = make_simulated_station(bundle, cell, programs=programs, say=lambda _: None)
    env, policy = programs.env, load_policy(bundle.folder)
    q_function = make_q_function(policy.config.network, policy.config.task, env.primitive.actions)
    values = jax.jit(policy_function(q_function, policy.params))
    fuse = jax.jit(fuse_segmentation)
    hlo = export.deserialize(bytearray(bundle.files["policy.stablehlo"]))
    count: Counter[str] = Counter()
    off = {"onnx": 0.0, "stablehlo": 0.0}
    near, alike, outcomes, different = [], [], [], []
    for index in scenes:
        scene = SimulatedCell(programs, index)
        station = dataclasses.replace(
            station, source=scene, segmenter=scene, arm=scene, gripper=scene, target=scene.target
        )
        hand, pushes, reason = station.decider.start(), 0, "max_pushes"
        while True:
            try:
                looked = station.look(hand)
            except ValueError as error:  # the target has gone
                reason = f"refused: {str(error)[:40]}"
                break
            obs, slot = scene.state.obs, scene.state.scene.target
            seen = np.asarray(grid.dequantize_height(np.asarray(obs.height)), np.float32)
            labels = np.asarray(fuse(obs.instance_ids, slot))
            inputs = seen[None], labels[None], np.asarray(hand.xy, np.float32)[None]
            wanted = np.asarray(values(*map(jnp.asarray, inputs)))
            for name, found in (
                ("onnx", station.decider.values(*inputs)),
                ("stablehlo", np.asarray(hlo.call(*inputs))),
            ):
                off[name] = max(off[name], float(np.abs(found - wanted).max()))
                best = found.reshape(-1).argmax()
                count[f"{name}_same"] += int(wanted.max() - wanted.reshape(-1)[best] <= TIE)
            near.append((np.abs(np.clip(looked.maps.height_m, 0, 0.3) - seen) <= 1e-3 + 0.6e-3).mean())
            alike.append((looked.maps.labels == labels).mean())
            allowed = np.where(looked.decision.allowed, wanted[0], -np.inf)
            count["states"] += 1
            decision = looked.decision
            ended = scene.reason == "target_in_region"
            if decision.push is not None and not ended:
                count["decisions"] += 1
                same = decision.push.action == int(allowed.argmax())
                given_up = float(allowed.max() - allowed.reshape(-1)[decision.push.action])
                same = same or given_up <= TIE
                count["same_push"] += int(same)
                if not same:
                    quantized = np.asarray(grid.quantize_height(np.clip(looked.maps.height_m, 0, 0.3)))
                    different.append(
                        {
                            "scene": index,
                            "push": pushes,
                            "q_given_up": round(given_up, 4),
                            "cells": int((quantized != np.asarray(obs.height)).sum()),
                            "labels": int((looked.maps.labels != labels).sum()),
                            "farthest_mm": round(1e3 * float(np.abs(looked.maps.height_m - seen).max()), 1),
                        }
                    )
                count["refused_best"] += int(bool(decision.refused))
            count["close_agrees"] += int(decision.close == ended)
            if decision.close:
                reason = "held" if scene.grasp() else "not_held"
                break
            if (
                decision.push is None
                or pushes >= station.decider.contract.action.max_pushes
                or scene.reason
                not in (
                    "running",
                    "target_in_region",
                )
            ):
                reason = scene.reason if decision.push is not None else "no_push"
                break
            scene.move(station.decider.contract.action.choices[decision.push.choice].opening)
            scene.push(decision.push)
            hand, pushes = decision.push.end, pushes + 1
        outcomes.append(reason)
    states, decisions = count["states"], max(count["decisions"], 1)
    return {
        "scenes": len(scenes),
        "states": states,
        "onnx_max_dq": off["onnx"],
        "onnx_same_best": count["onnx_same"] / states,
        "stablehlo_max_dq": off["stablehlo"],
        "stablehlo_same_best": count["stablehlo_same"] / states,
        "cells_within_1_mm": round(float(np.mean(near)), 5),
        "cells_within_1_mm_worst": round(float(np.min(near)), 5),
        "labels_same": round(float(np.mean(alike)), 5),
        "decisions": count["decisions"],
        "same_push": count["same_push"] / decisions,
        "different_pushes": different,
        "best_was_out_of_reach": count["refused_best"] / decisions,
        "closing_agrees": count["close_agrees"] / states,
        "success": outcomes.count("held") / len(outcomes),
        "outcomes": dict(Counter(outcomes).most_common()),
    }


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--policy", default="pretrained")
    parser.add_argument("--repetitions", type=int, default=30)
    parser.add_argument("--scenes", type=int, default=0, help="test scenes to play; 0 times only")
    parser.add_argument("--first", type=int, default=0, help="the first of them")
    parser.add_argument("--times", type=int, default=1, help="0 leaves the times out")
    options = parser.parse_args()

    import pregrasp_jax  # noqa: F401  (before jax)

    # isort: split
    from pregrasp_jax.checkpoint import load_policy
    from pregrasp_jax.startup import prepare

    prepare()
    document: dict[str, Any] = {"machine": platform.machine(), "cores": os.cpu_count(), "load": os.getloadavg()}
    with tempfile.TemporaryDirectory() as folder:
        bundle = make_bundle(load_policy(options.policy), Path(folder) / "compact")
        sizes = {name: entry.bytes for name, entry in bundle.contract.files.items()}
        document["bundle_mb"] = round(sum(sizes.values()) / 1e6, 3)
        if options.times:
            document["compact_one_thread_ms"] = measure_parts(bundle, threads=1, repetitions=options.repetitions)
            done = subprocess.run(
                [sys.executable, "-c", MEMORY, bundle.folder], capture_output=True, text=True, check=True
            )
            document["deciding_process_mb"] = round(int(done.stdout) / 1024)
            wide = make_bundle(paper_policy(Path(folder) / "paper"), Path(folder) / "wide")
            document["width_1_two_threads_ms"] = measure_parts(
                wide, threads=2, repetitions=max(options.repetitions // 5, 3)
            )
        if options.scenes:
            document["closed_loop"] = play(bundle, scenes=range(options.first, options.first + options.scenes))
    print(json.dumps(document, indent=2))


if __name__ == "__main__":
    main()
