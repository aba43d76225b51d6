"""What a training says on the console."""

from pregrasp_jax.training.console import describe, format_time


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
