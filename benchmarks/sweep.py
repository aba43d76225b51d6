"""What a sweep costs beside its trainings: the driver's memory, and seconds per session; prints one JSON object.

    python benchmarks/sweep.py [--trials 6]

The trainings are a script that measures once and waits to be stopped at the rung, or ends at once: what lies between
the end of one session and the beginning of the next is the sweep's. Every second trial has two sessions.
"""

import argparse
import itertools
import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from pregrasp_jax import yaml_file

TRAINER = """
import json, os, signal, sys, time
begun = time.time()
stop = []
signal.signal(signal.SIGTERM, lambda *_: stop.append(1))
words = sys.argv[1:]
run = words[2] if words[1] == "resume" else words[words.index("--run-dir") + 1]
os.makedirs(run, exist_ok=True)
open(run + "/config.yaml", "w").write("{}")
step = 200 if words[1] == "resume" else 100
row = {"env_steps": step, "eval/success_rate": 0.5, "eval/mean_motions": 2.0}
open(run + "/metrics.jsonl", "a").write(json.dumps(row) + "\\n")
while step == 100 and not stop:
    time.sleep(0.002)
open(run + "/sessions", "a").write(json.dumps([begun, time.time()]) + "\\n")
sys.exit(143 if stop else 0)
"""


def measure(folder: Path, trials: int) -> dict[str, Any]:
    """Drive a sweep of trainings that take no time, one after the other."""
    (folder / "trainer.py").write_text(TRAINER)
    spec = {
        "preset": "ci",
        "set": {"train.env_steps": 200, "train.minutes": 0, "train.evaluate_every": 100},
        "parameters": {"task.max_pushes": {"values": list(range(1, trials + 1))}},
        "stop": {"method": "halving", "rungs": [100], "keep": 0.5},
        "resources": {"memory_gb": 0.05},
        "program": [sys.executable, str(folder / "trainer.py")],
    }
    (folder / "spec.yaml").write_bytes(yaml_file.dump(spec))
    command = [sys.executable, "-m", "pregrasp_jax", "sweep", "start", str(folder / "spec.yaml")]
    start = time.time()
    driver = subprocess.Popen([*command, "--dir", str(folder / "sweep"), "--parallel", "1"], stdout=subprocess.DEVNULL)
    peak = 0.0
    while driver.poll() is None:
        peak = max(peak, peak_mb(driver.pid))
        time.sleep(0.05)
    files = (folder / "sweep" / "runs").glob("*/sessions")
    sessions = sorted(json.loads(line) for file in files for line in file.read_text().splitlines())
    gaps = [after[0] - before[1] for before, after in itertools.pairwise(sessions)]
    return {
        "sessions": len(sessions),
        "seconds_between_sessions": {"median": statistics.median(gaps), "max": max(gaps)},
        "seconds_before_the_first": sessions[0][0] - start,
        "driver_mb": round(peak),
        "cores": len(os.sched_getaffinity(0)),
    }


def peak_mb(pid: int) -> float:
    """Return the largest resident memory of a process, 0 if it is gone."""
    try:
        status = Path(f"/proc/{pid}/status").read_text()
    except OSError:
        return 0.0
    return next((int(line.split()[1]) / 1024 for line in status.splitlines() if line.startswith("VmHWM")), 0.0)


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--trials", type=int, default=6)
    with tempfile.TemporaryDirectory() as folder:
        print(json.dumps(measure(Path(folder), parser.parse_args().trials), indent=2))


if __name__ == "__main__":
    main()
