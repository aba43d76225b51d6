"""A sweep of real trainings, halved, resumed, and tested: minutes long."""

import json
from collections import Counter

import pytest

from pregrasp_jax import yaml_file
from pregrasp_jax.cli.main import main
from pregrasp_jax.sweep import driver
from pregrasp_jax.sweep.folder import SweepFolder


@pytest.mark.slow
def test_a_real_sweep_is_halved_goes_on_and_tests_its_winner(tmp_path, capfd):
    spec = {
        "preset": "ci",
        "set": {"train.env_steps": 60, "train.minutes": 0, "train.evaluate_every": 20, "task.max_pushes": 4},
        "parameters": {"learner.learning_rate": {"values": [1e-4, 1e-3]}},
        "stop": {"method": "halving", "rungs": [20], "keep": 0.5},
        "resources": {"memory_gb": 1.5},
        "final": {"seeds": [1], "episodes": 2},
    }
    (tmp_path / "spec.yaml").write_bytes(yaml_file.dump(spec))
    folder = tmp_path / "sweep"
    assert main(["sweep", "start", str(tmp_path / "spec.yaml"), "--dir", str(folder), "--parallel", "1"]) == 0
    opened = SweepFolder.open(folder)
    states = opened.states()
    assert Counter(driver.status(opened.spec(), states).values()) == {"done": 2, "dropped": 1}
    for known in states:
        rows = [json.loads(line) for line in (opened.run(known.trial) / "metrics.jsonl").read_text().splitlines()]
        assert known.env_steps == max(row["env_steps"] for row in rows)
        manifest = json.loads((opened.run(known.trial) / "manifest.json").read_text())
        assert len(manifest["sessions"]) == (2 if known.outcome == "done" and not known.trial.final else 1)
    assert "final" in capfd.readouterr().out and (folder / "report.html").stat().st_size > 10_000
