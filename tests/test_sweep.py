"""Sweeps of a stub that writes what a training writes: whatever is killed, nothing runs twice and nothing is lost."""

import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from pregrasp_jax import yaml_file
from pregrasp_jax.cli.main import main
from pregrasp_jax.sweep import driver, state
from pregrasp_jax.sweep.driver import Driver
from pregrasp_jax.sweep.folder import SweepFolder
from pregrasp_jax.sweep.launchers import Launcher, LocalLauncher, Slot
from pregrasp_jax.sweep.page import write_page
from pregrasp_jax.sweep.spec import Spec, spec_from
from pregrasp_jax.sweep.state import Job, TrialState
from pregrasp_jax.sweep.table import make_table
from pregrasp_jax.sweep.table_files import format_table
from pregrasp_jax.sweep.trials import evaluation_files
from pregrasp_jax.sweep.worker import Worker, environment

STUB = Path(__file__).parent / "stub_trainer.py"
LENGTH, LONG = 400, 1500


def make_spec(**keys: Any) -> Spec:
    values = {
        "preset": "ci",
        "set": {"train.env_steps": LENGTH, "train.minutes": 0, "train.evaluate_every": 100},
        "parameters": {"task.r_out": {"values": [0.15, 0.2]}},
        "resources": {"memory_gb": 0.01},
        "program": [sys.executable, str(STUB)],
    }
    return spec_from({key: value for key, value in {**values, **keys}.items() if value is not None})


def drive(folder: SweepFolder, spec: Spec, launcher: Launcher | None = None, said: list[str] | None = None) -> int:
    launcher = launcher or LocalLauncher(folder, spec, parallel=2)
    return Driver(folder, spec, launcher, say=(said if said is not None else []).append).run()


def sessions(folder: SweepFolder, known: TrialState) -> list[dict[str, Any]]:
    return [json.loads(line) for line in (folder.run(known.trial) / "sessions").read_text().splitlines()]


def assert_whole(folder: SweepFolder, *, length: int = LENGTH) -> list[TrialState]:
    """Assert that all trials are done, each trained once to its end, whatever happened on the way."""
    states = folder.states()
    for known in states:
        run = folder.run(known.trial)
        rows = [json.loads(line) for line in (run / "metrics.jsonl").read_text().splitlines()]
        steps = [row["env_steps"] for row in rows if "train/loss" in row]
        assert known.outcome == "done" and steps == list(range(10, length + 10, 10)), known
        assert not (run / "TWICE").exists()
    return states


class Here:
    """A launcher without processes: a worker of this process for every job, at once."""

    slots = 3

    def __init__(self, folder: SweepFolder, spec: Spec, *, code: Callable[[Job], int | None] = lambda job: None):
        self._folder, self._spec, self._code = folder, spec, code
        self._ended: list[tuple[str, int]] = []
        self.order: list[Job] = []

    def submit(self, job: Job) -> None:
        self.order.append(job)
        code = self._code(job)
        if code is None:
            code = Worker(self._folder, self._spec, job.trial, rung=job.rung).run()
        self._ended.append((job.trial.id, code))

    def ended(self) -> list[tuple[str, int]]:
        ended, self._ended = self._ended, []
        return ended

    def stop(self) -> None: ...

    def close(self) -> None: ...


@pytest.fixture(autouse=True)
def keep_signals() -> Iterator[None]:
    old = {number: signal.getsignal(number) for number in (signal.SIGTERM, signal.SIGINT)}
    yield
    for number, handler in old.items():
        signal.signal(number, handler)


@pytest.fixture(scope="module")
def halved(tmp_path_factory) -> tuple[SweepFolder, Spec, list[str]]:
    """A sweep with all that there is, driven by real processes on this machine."""
    spec = make_spec(
        parameters={"task.r_out": {"values": [0.15, 0.2]}, "learner.learning_rate": {"values": [1e-3, 2e-3]}},
        seeds=[0, 1],
        set={"train.env_steps": LONG, "train.minutes": 0, "train.evaluate_every": 100},
        stop={"method": "halving", "rungs": [100], "keep": 0.25},
        final={"seeds": [10, 11], "episodes": 20},
    )
    folder, said = SweepFolder.create(tmp_path_factory.mktemp("sweeps") / "halved", spec), []
    assert drive(folder, spec, said=said) == 0
    return folder, spec, said


def test_halving_stops_by_signal_and_goes_on_by_resume(halved):
    folder, spec, _ = halved
    states = folder.states()
    words = driver.status(spec, states)
    main = [known for known in states if not known.trial.final]
    assert Counter(words[known.trial.id] for known in main) == {"dropped": 6, "done": 2}
    for known in main:
        kept = words[known.trial.id] == "done"
        assert 100 in known.scores and (known.env_steps == LONG if kept else 100 <= known.env_steps < LONG)
        assert len(sessions(folder, known)) == (2 if kept else 1)
        assert kept == (dict(known.trial.varied) == {"task.r_out": 0.15, "learner.learning_rate": 1e-3})


def test_the_winner_is_trained_again_with_fresh_seeds_and_tested(halved):
    folder, spec, _ = halved
    finals = [known for known in folder.states() if known.trial.final]
    assert [known.trial.seed for known in finals] == [10, 11]
    for known in finals:
        assert known.trial.settings["task.r_out"] == 0.15 and known.outcome == "done"
        file = evaluation_files(spec, known.trial, folder.run(known.trial))["test"]
        document = json.loads(file.read_text())
        assert document["episodes"] == 20


def test_every_trial_gets_a_core_of_its_own_and_as_many_threads(halved):
    folder, _, _ = halved
    for known in folder.states():
        for session in sessions(folder, known):
            assert len(session["cores"]) == 1 and session["threads"] == "1"


def test_the_table_ranks_and_says_what_is_noise(halved):
    folder, spec, said = halved
    table = make_table(folder, spec)
    best, *others = [row for row in table.rows if not row.final]
    assert best.varied == {"task.r_out": 0.15, "learner.learning_rate": 1e-3} and best.word == "done"
    assert [row.word for row in others] == ["dropped"] * 3
    with pytest.raises(ValueError, match=r"reference 'first' is no setting; allowed: 'task\.r_out=0\.15, learner"):
        make_table(folder, spec, reference="first")
    text = format_table(table)
    assert "Differences within" in text and text.splitlines()[0].split()[:2] == ["rank", "setting"]
    assert "final" in text and "test: test" in text
    assert any("2 of 8 trials done" in line or "dropped" in line for line in said)


CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)


@pytest.mark.skipif(CHROMIUM is None, reason="no Chromium is installed")
def test_a_browser_shows_the_page_and_finds_nothing_wrong_with_it(halved, tmp_path):
    assert CHROMIUM
    folder, spec, _ = halved
    page, picture = write_page(folder, spec, tmp_path / "page.html"), tmp_path / "page.png"
    options = ["--headless", "--no-sandbox", "--disable-gpu", "--hide-scrollbars", "--enable-logging=stderr", "--v=0"]
    options += [f"--screenshot={picture}", "--window-size=1200,2600", f"--user-data-dir={tmp_path / 'profile'}"]
    shown = subprocess.run([CHROMIUM, *options, page.as_uri()], capture_output=True, text=True, timeout=60, check=True)
    assert "CONSOLE" not in shown.stderr
    dumped = subprocess.run(
        [CHROMIUM, *options[:3], f"--user-data-dir={tmp_path / 'profile'}", "--dump-dom", page.as_uri()],
        capture_output=True, text=True, timeout=60, check=True,
    ).stdout  # fmt: skip
    assert dumped.count('class="curve s0 wide"') >= 1 and "Differences within" in dumped
    image = np.asarray(Image.open(picture).convert("RGB")).reshape(-1, 3)
    assert len(np.unique(image, axis=0)) > 50, "there is something to see"


def test_the_page_has_minus_signs_before_numbers_only(halved, tmp_path, monkeypatch):
    folder, spec, _ = halved
    note = "seen: no-her, rate=1e-05 minus all-on = -1.5 points, 95 % interval -3.0 to +0.1"
    monkeypatch.setattr("pregrasp_jax.sweep.page.notes", lambda table: [note])
    text = write_page(folder, spec, tmp_path / "page.html").read_text()
    assert note.replace(" -", " \N{MINUS SIGN}") in text


def test_the_page_says_what_to_type_and_draws_every_setting(halved, tmp_path):
    folder, spec, _ = halved
    text = write_page(folder, spec, tmp_path / "page.html").read_text()
    command = "pregrasp-jax train ci --run-dir runs/NAME --seed 0 --train.env-steps 1500 --train.minutes 0"
    assert command in text.replace("<wbr>", "") and "--task.r-out 0.15" in text.replace("<wbr>", "")
    lines = re.findall(r'<path d="M[^"]*" class="curve (s0 wide|faint)"><title>([^<]*)', text)
    assert len(lines) == 4 and [kind for kind, _ in lines].count("s0 wide") == 1
    assert "http" not in re.sub(r"<meta[^>]*>", "", text)


def test_a_killed_worker_stops_its_training_and_the_next_goes_on(tmp_path):
    spec = make_spec(parameters=None)
    folder = SweepFolder.create(tmp_path / "sweep", spec)
    launcher, killed = LocalLauncher(folder, spec, parallel=1), []
    submit = launcher.submit

    def submit_and_kill(job: Job) -> None:
        submit(job)
        metrics = folder.run(job.trial) / "metrics.jsonl"
        if not killed:
            wait_for(metrics.exists)
            killed.append(launcher._running[0].process.pid)
            os.kill(killed[0], signal.SIGKILL)

    launcher.submit = submit_and_kill
    assert drive(folder, spec, launcher) == 0
    (known,) = assert_whole(folder)
    assert len(sessions(folder, known)) == 2
    assert Counter(event["event"] for event in folder.events()) == {"sweep": 1, "planned": 1, "started": 2, "ended": 1}


def start_driver(tmp_path: Path, spec_values: dict[str, Any]) -> subprocess.Popen[bytes]:
    (tmp_path / "spec.yaml").write_bytes(yaml_file.dump(spec_values))
    command = [sys.executable, "-m", "pregrasp_jax", "sweep", "start", str(tmp_path / "spec.yaml"),
               "--dir", str(tmp_path / "sweep"), "--parallel", "1"]  # fmt: skip
    with (tmp_path / "log").open("wb") as log:
        return subprocess.Popen(command, stdout=log, stderr=log, env=os.environ | {"COUNT_IMPORTS": "1"})


def wait_for(condition: Callable[[], bool], seconds: float = 60) -> None:
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.02)


def test_a_killed_driver_is_followed_by_another_that_waits_for_what_still_runs(tmp_path):
    from pregrasp_jax.sweep.spec import to_plain

    spec = make_spec(parameters=None, seeds=[0, 1])
    first = start_driver(tmp_path, to_plain(spec))
    folder = SweepFolder(tmp_path / "sweep")
    wait_for(lambda: any(event["event"] == "started" for event in folder.events()))
    with pytest.raises(ValueError, match=r"is driven by process \d+ on .*; allowed is one at a time"):
        drive(folder, spec)
    modules = Path(f"/proc/{first.pid}/maps").read_text()
    assert "jaxlib" not in modules and "mujoco" not in modules
    status = Path(f"/proc/{first.pid}/status").read_text()
    peak = next(int(line.split()[1]) for line in status.splitlines() if line.startswith("VmHWM")) / 1024
    assert peak < 200, f"the driver takes {peak:.0f} MB"
    first.kill()
    first.wait()
    orphan = next(known for known in folder.states() if known.begun)
    assert folder.is_running(orphan.trial)
    here = Here(folder, spec)
    assert drive(folder, spec, here) == 0
    assert orphan.trial not in [job.trial for job in here.order], "the first worker has finished it"
    states = assert_whole(folder)
    assert [len(sessions(folder, known)) for known in states] == [1, 1]


def test_a_sweep_that_is_asked_to_stop_goes_on_where_it_was(tmp_path):
    spec = make_spec(parameters=None)
    folder = SweepFolder.create(tmp_path / "sweep", spec)
    launcher = LocalLauncher(folder, spec, parallel=1)
    submit = launcher.submit

    def submit_and_stop(job: Job) -> None:
        submit(job)
        wait_for((folder.run(job.trial) / "metrics.jsonl").exists)
        folder.ask_to_stop(True)

    launcher.submit = submit_and_stop
    assert drive(folder, spec, launcher) == 143
    (known,) = folder.states()
    assert known.outcome == "stopped" and known.failures == 0 and 0 < known.env_steps < LENGTH
    with folder.drive(), pytest.raises(SystemExit):
        main(["sweep", "resume", str(folder.path)])
    assert folder.stopping, "what another driver was asked to do is not taken back"
    folder.ask_to_stop(False)
    assert drive(folder, spec, Here(folder, spec)) == 0
    (known,) = assert_whole(folder)
    assert len(sessions(folder, known)) == 2


def test_refused_is_not_tried_again_and_crashed_is_and_the_sweep_goes_on(tmp_path):
    spec = make_spec(parameters={"task.r_in": {"values": [0.04, 0.05, 0.06, 0.07]}})
    folder, said = SweepFolder.create(tmp_path / "sweep", spec), []
    assert drive(folder, spec, Here(folder, spec), said) == 1
    found = {known.trial.settings["task.r_in"]: known for known in folder.states()}
    assert {radius: known.outcome for radius, known in found.items()} == {
        0.04: "done", 0.05: "refused", 0.06: "failed", 0.07: "done"
    }  # fmt: skip
    assert {radius: len(sessions(folder, known)) for radius, known in found.items()} == {
        0.04: 1, 0.05: 1, 0.06: state.TRIES, 0.07: 2
    }  # fmt: skip
    assert found[0.05].message == "error: task.r_in = 0.05 is not liked here"
    assert found[0.06].message == "Segmentation fault" and "1 failed | 1 refused" in said[-1]
    folder.append({"event": "retry", "id": found[0.05].trial.id})
    again = Here(folder, spec)
    assert drive(folder, spec, again) == 1 and [job.trial for job in again.order] == [found[0.05].trial]


def test_a_full_disk_loses_nothing(tmp_path, monkeypatch):
    spec = make_spec(parameters=None)
    folder = SweepFolder.create(tmp_path / "sweep", spec)
    append = SweepFolder.append

    def full(self: SweepFolder, event: Any) -> None:
        if event["event"] == "ended":
            raise OSError(28, "No space left on device")
        append(self, event)

    monkeypatch.setattr("pregrasp_jax.sweep.worker.time.sleep", lambda seconds: None)
    monkeypatch.setattr(SweepFolder, "append", full)
    with pytest.raises(ValueError, match="the disk is full; nothing is lost, `pregrasp-jax sweep resume"):
        drive(folder, spec, Here(folder, spec))
    monkeypatch.setattr(SweepFolder, "append", append)
    assert drive(folder, spec, Here(folder, spec)) == 0
    assert_whole(folder)


def test_several_trials_share_a_gpu(tmp_path):
    spec = make_spec(parameters=None, resources={"gpu": 0.25, "memory_gb": 0.01})
    assert environment({"A": "b"}, spec) == {"A": "b", "XLA_PYTHON_CLIENT_MEM_FRACTION": "0.225"}
    assert environment({"A": "b"}, make_spec()) == {"A": "b"}
    folder = SweepFolder.create(tmp_path / "sweep", spec)
    driver.plan(folder, spec)
    launcher = LocalLauncher(folder, make_spec(), parallel=1)
    launcher._free = [Slot(launcher._free[0].cores, ("1",))]
    launcher.submit(Job(folder.states()[0].trial, None))
    wait_for(lambda: bool(launcher.ended()))
    (session,) = sessions(folder, folder.states()[0])
    assert session["gpu"] == "1" and session["share"] == "0.225"
