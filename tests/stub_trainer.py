"""Stands for `pregrasp-jax` in tests of sweeps: trains nothing, but writes what a training writes and obeys SIGTERM.

It keeps its word about what must never happen: a run that is used twice at a time, or begun anew, ends with code 9.
"""

import fcntl
import json
import os
import signal
import sys
import time
from pathlib import Path

TICK, STEPS, EVALUATE_EVERY = 0.01, 10, 100


def options_of(words: list[str]) -> dict[str, str]:
    return {key.removeprefix("--"): value for key, value in zip(words[::2], words[1::2], strict=True)}


def success(options: dict[str, str], step: int) -> float:
    """Return a rate that grows, and is best at a step size of 0.001 and a radius of 0.15."""
    rate = float(options.get("learner.learning-rate", 1e-3))
    loss = abs(rate - 1e-3) * 100 + abs(float(options.get("task.r-out", 0.15)) - 0.15)
    return round(max(0.0, min(1.0, 0.9 * step / (step + 50) - loss + 0.01 * (int(options["seed"]) % 2))), 4)


def train(words: list[str]) -> int:
    resumed = words[0] == "resume"
    run = Path(words[1]) if resumed else Path(options_of(words[1:])["run-dir"])
    run.mkdir(parents=True, exist_ok=True)
    lock = (run / "run.lock").open("a+")
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        (run / "TWICE").touch()
        return 9
    config = run / "config.yaml"
    if not resumed:
        if config.exists():
            (run / "TWICE").touch()
            return 9
        config.write_text(json.dumps(options_of(words[1:])))
    options = json.loads(config.read_text())
    (run / "sessions").open("a").write(
        json.dumps(
            {
                "cores": sorted(os.sched_getaffinity(0)),
                "threads": options.get("physics.threads"),
                "gpu": os.environ.get("CUDA_VISIBLE_DEVICES"),
                "share": os.environ.get("XLA_PYTHON_CLIENT_MEM_FRACTION"),
                "cwd": os.getcwd(),
            }
        )
        + "\n"
    )
    if options.get("task.r-in") == "0.05":
        print("error: task.r_in = 0.05 is not liked here")
        return 2
    if options.get("task.r-in") == "0.06" or (options.get("task.r-in") == "0.07" and not resumed):
        print("Segmentation fault")
        return 139
    return loop(run, options)


def loop(run: Path, options: dict[str, str]) -> int:
    checkpoint, metrics, stop = run / "checkpoint.json", run / "metrics.jsonl", []
    signal.signal(signal.SIGTERM, lambda *_: stop.append(1))
    step = json.loads(checkpoint.read_text()) if checkpoint.exists() else 0
    kept = [line for line in metrics.read_text().splitlines() if json.loads(line)["env_steps"] <= step] if step else []
    metrics.write_text("".join(f"{line}\n" for line in kept))
    end = int(options["train.env-steps"])
    while step < end and not stop:
        time.sleep(TICK)
        step += STEPS
        row = {"env_steps": step, "train/loss": 1 / step, "time/seconds": step * TICK / STEPS}
        with metrics.open("a") as file:
            file.write(json.dumps(row) + "\n")
            if step % EVALUATE_EVERY == 0 or step >= end:
                measured = {"eval/success_rate": success(options, step), "eval/mean_motions": 3.0}
                file.write(json.dumps({"env_steps": step, "time/seconds": row["time/seconds"], **measured}) + "\n")
    checkpoint.write_text(json.dumps(step))
    return 143 if step < end else 0


def evaluate(words: list[str]) -> int:
    options = options_of(words)
    policy = Path(options["policy"])
    trained = json.loads((policy / "config.yaml").read_text()) if policy.is_dir() else {"seed": "0"}
    rate = success(trained, 1000) if policy.is_dir() else 0.3
    episodes = int(options.get("episodes", 20))
    rows = [
        {
            "scene": i,
            "target": "mug",
            "success": (i * 7 + int(trained["seed"])) % episodes < rate * episodes,
            "motions": 2,
        }
        for i in range(episodes)
    ]
    good = sum(row["success"] for row in rows)
    document = {
        "format": "pregrasp_jax evaluation 1",
        "policy": options["policy"],
        "physics": "native",
        "object_set": options.get("assets.object-set", "seen"),
        "camera": "orthographic",
        "hull_bank_hash": "b",
        "scene_bank_hash": "s",
        "seed": 0,
        "episodes": episodes,
        "success_rate": good / episodes,
        "success_ci95": [0.0, 1.0],
        "mean_motions": 2.0,
        "std_motions": 0.0,
        "failures": {},
        "rows": rows,
    }
    file = Path(options["json"])
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text(json.dumps(document))
    return 0


if __name__ == "__main__":
    sys.exit({"train": train, "evaluate": evaluate}[sys.argv[1]](sys.argv[2:]))
