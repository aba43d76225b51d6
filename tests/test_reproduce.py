"""Every table and figure of the paper is a sweep that this version knows, or says in one line what it lacks."""

import dataclasses
import html
import json
import re
import subprocess
import sys
from typing import Any

import pytest
from test_sweep import CHROMIUM, STUB, Here

from pregrasp_jax.cli.main import main
from pregrasp_jax.cli.reproduce import _open
from pregrasp_jax.sweep import checks, driver, experiments
from pregrasp_jax.sweep.driver import Driver
from pregrasp_jax.sweep.folder import SweepFolder
from pregrasp_jax.sweep.paper_page import write_paper_page
from pregrasp_jax.sweep.spec import Spec, spec_from, to_plain
from pregrasp_jax.sweep.trials import evaluation_files

NAMES = ["confined", "figure4", "table1", "table2", "transfer"]


def test_they_are_all_there_and_read():
    assert experiments.names() == NAMES
    for name in NAMES:
        experiment = experiments.read_experiment(name)
        assert experiment.title and experiment.about and len(experiment.seeds) == 3 and experiment.differs
        assert experiment.reference in experiment.variants
        for test, rows in experiment.paper.items():
            assert test in experiment.tests and set(rows) <= set(experiment.variants), (name, test)
        for size in ("budget", "paper"):
            spec = experiments.make_spec(experiment, size=size)
            assert ("train.minutes" in spec.set) == (size == "budget")


def test_the_ablations_are_those_of_the_paper_and_the_figure_shows_their_trainings():
    table, figure = (experiments.read_experiment(name) for name in ("table2", "figure4"))
    spec = experiments.make_spec(table, minutes=30)
    checks.check(spec)
    assert spec == experiments.make_spec(figure, minutes=30) and figure.runs == "table2"
    changed = {label: dict(variant.settings) for label, variant in spec.variants.items()}
    assert changed == {
        "full method": {},
        "without hindsight": {"replay.hindsight": False},
        "full ring": {"task.full_ring": True},
        "random exploration": {"exploration.guided": False},
    }
    assert spec.set["train.minutes"] == 30
    as_far = experiments.make_spec(table, env_steps=3000)
    checks.check(as_far)
    assert as_far.set == {**spec.set, "train.env_steps": 3000, "train.minutes": 0}


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("table3", "experiment = 'table3' does not exist; allowed: confined, figure4, table1, table2, transfer"),
        ("table2 --budget 3 --env-steps 40", "budget = 3 and env_steps = 40 both say how long; allowed is one of them"),
        ("table2 --env-steps 0", "env_steps = 0 is out of range; allowed is more than 0"),
        ("table2 --budget 0", "budget = 0.0 is out of range; allowed is more than 0"),
        ("table2 --seeds 1 1", "seeds = [1, 1] has a number twice"),
        ("table2 --parallel 900", "900 trials at a time do not fit"),
    ],
)
def test_what_cannot_be_is_one_line(name, said, capsys):
    with pytest.raises(SystemExit) as exit_info:
        main(["reproduce", *name.split(), "--dry-run", "True"])
    assert exit_info.value.code == 2
    error = capsys.readouterr().err
    assert said in error and len(error.splitlines()) == 1


@pytest.mark.parametrize("size", ["budget", "paper"])
@pytest.mark.parametrize("name", NAMES)
def test_a_dry_run_is_a_plan(name, size, capsys, tmp_path):
    """Rows that go on from a policy have its network, or the dry run would refuse them."""
    arguments = ["--dir", str(tmp_path / "new"), "--memory-gb", "0.01", "--dry-run", "True", "--size", size]
    assert main(["reproduce", name, *arguments]) == 0
    assert re.match(r"\d+ settings, \d+ trials", capsys.readouterr().out)
    assert not (tmp_path / "new").exists()


def with_stub(spec: Spec, **settings: Any) -> Spec:
    small = {"train.env_steps": 300, "train.minutes": 0, "train.evaluate_every": 100, **settings}
    tests = {name: {**options, "episodes": 40} for name, options in spec.tests.items()}
    plain = to_plain(spec) | {"preset": "ci", "set": small, "tests": tests, "program": [sys.executable, str(STUB)]}
    return spec_from(plain | {"seeds": [0, 1], "resources": {"memory_gb": 0.01}})


@pytest.fixture(scope="module")
def reproduced(tmp_path_factory) -> tuple[SweepFolder, Spec]:
    experiment = experiments.read_experiment("table2")
    spec = with_stub(experiments.make_spec(experiment))
    folder = SweepFolder.create(tmp_path_factory.mktemp("reproduce") / "table2", spec)
    assert Driver(folder, spec, Here(folder, spec), say=lambda line: None).run() == 0
    return folder, spec


def test_the_page_alone_is_made_alone(tmp_path, capsys):
    for options in (["--dry-run", "True"], ["--seeds", "7", "8"], ["--budget", "3"]):
        with pytest.raises(SystemExit) as exit_info:
            main(["reproduce", "table2", "--dir", str(tmp_path), "--only-page", "True", *options])
        assert exit_info.value.code == 2 and "allowed beside it: --dir and --size" in capsys.readouterr().err


def test_the_page_has_the_papers_numbers_beside_ours(reproduced, tmp_path):
    folder, spec = reproduced
    experiment = experiments.read_experiment("table2")
    page = write_paper_page(folder, spec, experiment, tmp_path / "table2.html")
    text = page.read_text()
    rows = re.findall(r"<tr[^>]*><th scope=\"row\">([^<]*)</th>(.*?)</tr>", text)
    assert [label for label, _ in rows] == [*experiment.variants] * len(experiment.tests)
    cells = {label: re.findall(r"<td>(.*?)</td>", cells) for label, cells in rows[4:]}
    paper = [cells[label][4] for label in experiment.variants]
    assert paper == ["93 %, 2.51", "89 %, 3.04", "85 %, 3.20", "68 %, 3.38"]
    assert cells["full method"][-3:] == ["reference", "", ""]
    difference, p_value, better = cells["full ring"][-3:]
    assert re.fullmatch(r"[+\u2212][\d.]+ \([+\u2212][\d.]+ to [+\u2212][\d.]+\)", difference), difference
    assert 0 <= float(p_value) <= 1 and better.endswith(" %")
    assert "Preset ci, 300 pushes for each training, seeds 0, 1; 8 of 8 trials are done." in text
    assert re.fullmatch(r"[\d.]+ % \(\d+ to \d+\)", cells["full method"][0])
    assert "band s0" in text and "are noise (95 %)" in text
    for sentence in experiment.differs:
        assert html.escape(sentence) in text


@pytest.mark.skipif(CHROMIUM is None, reason="no Chromium is installed")
def test_a_browser_shows_the_page_of_the_figure(reproduced, tmp_path):
    assert CHROMIUM
    folder, spec = reproduced
    page = write_paper_page(folder, spec, experiments.read_experiment("figure4"), tmp_path / "figure4.html")
    options = ["--headless", "--no-sandbox", "--disable-gpu", "--enable-logging=stderr", "--window-size=1200,2400"]
    options += [f"--user-data-dir={tmp_path / 'profile'}", f"--screenshot={tmp_path / 'page.png'}"]
    shown = subprocess.run([CHROMIUM, *options, page.as_uri()], capture_output=True, text=True, timeout=60, check=True)
    assert "CONSOLE" not in shown.stderr and (tmp_path / "page.png").stat().st_size > 20_000


def test_the_same_command_goes_on_and_another_budget_is_refused(reproduced):
    folder, spec = reproduced
    again = _open(folder.path, spec)
    assert Driver(again, spec, Here(again, spec), say=lambda line: None).run() == 0
    assert sum(event["event"] == "started" for event in folder.events()) == 8
    for episodes in (30, 40):  # other options under the same name are measured, too
        more = dataclasses.replace(spec, tests={**spec.tests, "mine": {"episodes": episodes}})
        again = _open(folder.path, more)
        assert Driver(again, again.spec(), Here(again, again.spec()), say=lambda line: None).run() == 0
        files = [evaluation_files(more, k.trial, folder.run(k.trial))["mine"] for k in folder.states()]
        assert [json.loads(file.read_text())["episodes"] for file in files] == [episodes] * len(files)
    assert all(len((folder.run(k.trial) / "sessions").read_text().splitlines()) == 1 for k in folder.states())
    with folder.drive(), pytest.raises(ValueError, match="is driven by"):
        _open(folder.path, dataclasses.replace(spec, tests={}))
    assert folder.spec().tests, "another's sweep is as it was"
    other = with_stub(experiments.make_spec(experiments.read_experiment("table2")), **{"train.env_steps": 400})
    with pytest.raises(ValueError, match=r"began with another set .*; allowed is the same, or another --dir"):
        _open(folder.path, other)


def test_a_policy_that_is_there_is_tested_once_and_not_trained(tmp_path):
    experiment = experiments.read_experiment("table1")
    spec = with_stub(experiments.make_spec(experiment, object_dir=tmp_path / "mine"))
    assert json.loads(json.dumps(dict(spec.tests)))["folder mine"]["assets.object_dir"] == str(tmp_path / "mine")
    folder = SweepFolder.create(tmp_path / "table1", spec)
    driver.plan(folder, spec)
    by_name = {}
    for known in folder.states():
        by_name.setdefault(known.trial.name, []).append(known.trial)
    assert {name: len(trials) for name, trials in by_name.items()} == {
        name: 2 if name == "ours" else 1 for name in experiment.variants
    }
