"""Stands for SLURM: `sbatch` runs an array at once, at most %N tasks at a time, and waits for it.

A task of which `FAKE_LIMIT` is over gets SIGTERM; one that asks `scontrol requeue` for it is started again.
"""

import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

STATE = Path(os.environ["FAKE_SLURM"])


def has_child(pid: int) -> bool:
    """Return whether a task has come so far that it trains: it knows then what to do with a signal."""
    file = Path(f"/proc/{pid}/task/{pid}/children")
    return file.exists() and bool(file.read_text().split())


def sbatch(words: list[str]) -> int:
    script = words[-1]
    text = Path(script).read_text()
    found = re.search(r"--array=(\d+)-(\d+)(?:%(\d+))?", text)
    assert found and "#SBATCH --requeue" in text
    job = str(100 + len(list(STATE.glob("job-*"))))
    (STATE / f"job-{job}").write_text(" ".join(words[:-1]))
    waiting = [(index, 0) for index in range(int(found[1]), int(found[2]) + 1)]
    running: list[tuple[int, int, subprocess.Popen[bytes], float]] = []
    while waiting or running:
        while waiting and len(running) < int(found[3] or 99):
            index, restarts = waiting.pop(0)
            about = {"SLURM_ARRAY_JOB_ID": job, "SLURM_ARRAY_TASK_ID": str(index), "SLURM_RESTART_COUNT": str(restarts)}
            output = (STATE / f"out-{job}_{index}").open("ab")
            task = subprocess.Popen(["bash", script], env=os.environ | about, stdout=output, stderr=output)
            running.append((index, restarts, task, time.monotonic()))
        for entry in list(running):
            index, restarts, task, start = entry
            if task.poll() is not None:
                running.remove(entry)
                if (STATE / f"requeue-{job}_{index}").exists():
                    (STATE / f"requeue-{job}_{index}").unlink()
                    (STATE / f"requeued-{job}_{index}").touch()
                    waiting.append((index, restarts + 1))
            elif restarts == 0 and has_child(task.pid) and time.monotonic() - start > float(os.environ["FAKE_LIMIT"]):
                task.send_signal(signal.SIGTERM)
                running[running.index(entry)] = (index, restarts, task, float("inf"))
        time.sleep(0.02)
    print(job)
    return 0


if __name__ == "__main__":
    if sys.argv[1] == "scontrol":
        (STATE / f"requeue-{sys.argv[3]}").touch()
        sys.exit(0)
    sys.exit(sbatch(sys.argv[2:]))
