"""What a training says on the console."""

import os

from pregrasp_jax.training.console import Console, describe, format_time


def test_a_log_on_a_full_disk_and_a_reader_that_is_gone_stop_nothing():
    reader, writer = os.pipe()
    os.close(reader)
    for stream in (open("/dev/full", "w", buffering=1), os.fdopen(writer, "w", buffering=1)):  # noqa: SIM115
        console = Console(stream)
        console.start()
        for _ in range(3):
            console.say("x" * 10_000)
        console.close()
        os.close(stream.fileno())  # its own `close` would try once more


def test_the_console_line():
    row = {
        "env_steps": 3200,
        "episodes": 991,
        "train/success_rate": 0.315,
        "train/epsilon": 0.5,
        "train/loss": None,
        "time/env_steps_per_second": 12.34,
    }
    line = "step 3200 | episode 991 | success 32 % | epsilon 0.50 | loss ? | 12.3 steps/s | left 1:01:01"
    assert describe(row, 3661.2) == line
    assert format_time(None) == "?"
