"""A whole cell by the command line, dry: files in, a push out, a log, its pictures; and the check of a calibration."""

import json
import re
import shutil
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import yaml
from bundles import SMALL, small_bundle, small_decider
from PIL import Image

from pregrasp_jax.cli.main import main
from pregrasp_jax.deploy.cell import read_cell
from pregrasp_jax.deploy.decision import allowed_pushes
from pregrasp_jax.deploy.log import draw_log

ROOT = Path(__file__).parent.parent
INTRINSICS = [[600.0, 0.0, 320.0], [0.0, 600.0, 240.0], [0.0, 0.0, 1.0]]


def write_cell(folder: Path, *, tilt_deg: float = 0.0, **sections: object) -> Path:
    """Write a cell.yaml for the camera of the golden images, and what it names."""
    pose = SMALL.camera.world_from_optical.copy()
    angle = np.deg2rad(tilt_deg)
    turn = np.array([[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]])
    pose[:3, :3] = turn @ pose[:3, :3]
    camera = {
        "intrinsics": SMALL.camera.matrix.tolist(),
        "extrinsics": pose.tolist(),
        "parent": "table",
        "depth": "depth.npy",
    }
    np.save(folder / "depth.npy", SMALL.golden["depth"][0])
    Image.fromarray(SMALL.golden["instances"][0]).save(folder / "ids.png")
    cell = {
        "camera": camera | {"depth_scale": 1e-4},
        "segmenter": {"kind": "file", "file": "ids.png"},
        "target": {"name": str(int(SMALL.golden["target_id"][0]))},
    }
    (folder / "cell.yaml").write_text(yaml.safe_dump(cell | sections))
    return folder / "cell.yaml"


def test_a_dry_trial_is_decided_logged_and_drawn(tmp_path: Path, capsys):
    cell, log = write_cell(tmp_path), tmp_path / "log"
    assert main(["deploy", str(small_bundle()), "--config", str(cell), "--once", "True", "--log", str(log)]) == 0
    said = capsys.readouterr().out
    assert "push 1: hand" in said and "dry: moveL([" in said and "once after 1 pushes" in said
    about = json.loads((log / "decision-000.json").read_text())
    assert about["push"]["action"] == SMALL.golden["action"][0] and about["close"] is False
    assert set(about["times_ms"]) == {
        "segmentation",
        "reading",
        "drawing",
        "projection",
        "region",
        "network",
        "decoding",
    }
    np.testing.assert_allclose(about["push"]["end_table_m"][:2], SMALL.golden["push"][0, :2], atol=1e-6)
    with np.load(log / "decision-000.npz") as held:
        assert np.abs(held["q"] - SMALL.golden["q"][0]).max() < 0.2 and held["depth"].dtype == np.uint16
    assert json.loads((log / "result.json").read_text()) == {"reason": "once", "pushes": 1}
    assert main(["deploy", "--replay", str(log)]) == 0
    with Image.open(log / "decision-000.png") as picture:
        assert picture.size == (1200, 300)
    for change in ({"push": {}}, {"labels": []}, {"choices": ["a"] * 9}, {"push": {"choice": about["push"]["choice"]}}):
        (tmp_path / "bad").mkdir(exist_ok=True)
        shutil.copy(log / "decision-000.npz", tmp_path / "bad")
        (tmp_path / "bad" / "decision-000.json").write_text(json.dumps({**about, **change}))
        with pytest.raises(ValueError, match=r"decision-000\.json is damaged"):
            draw_log(tmp_path / "bad")
    for options, problem in (
        (["deploy", str(small_bundle()), "--config", str(cell), "--log", str(log)], "of an earlier trial"),
        (["deploy", "--replay", str(tmp_path)], "holds no decisions"),
        (["deploy", "--replay", str(log), "--config", str(cell)], "--replay FOLDER alone"),
        (["deploy", str(small_bundle()), "--replay", str(log)], "--replay FOLDER alone"),
    ):
        with pytest.raises(SystemExit) as stopped:
            main(options)
        assert stopped.value.code == 2 and problem in capsys.readouterr().err


def test_a_dry_trial_searches_where_it_is_asked_to(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys):
    cell, asked = write_cell(tmp_path), []
    allowed = allowed_pushes(SMALL.bundle.contract.action, small_decider().start())
    other = int(np.argsort(np.where(allowed, SMALL.golden["q"][0], -np.inf), axis=None)[-400])

    def make_search(bundle: Any, planning: Any, **about: Any) -> Any:
        asked.append((bundle.folder, planning.depth, about["camera_m"].shape))
        return SimpleNamespace(choose=lambda seen: other)

    monkeypatch.setattr("pregrasp_jax.planned_cell.make_search", make_search)
    options = ["--config", str(cell), "--once", "True", "--plan", "True", "--planning.depth", "1"]
    assert main(["deploy", str(small_bundle()), *options, "--log", str(tmp_path / "log")]) == 0
    about = json.loads((tmp_path / "log" / "decision-000.json").read_text())
    assert asked == [(small_bundle(), 1, (3,))] and "once after 1 pushes" in capsys.readouterr().out
    assert about["searched"] == other and other in [about["push"]["action"], *(a for a, _ in about["refused"])]
    assert "search" in about["times_ms"]


def test_what_is_simulated_is_found_from_where_the_cell_is_written(tmp_path: Path):
    cell = write_cell(tmp_path, sim={"object_dir": "meshes", "sensor": "mine.yaml"})
    sim = read_cell(cell).sim
    assert (sim.object_dir, sim.sensor) == (str(tmp_path / "meshes"), str(tmp_path / "mine.yaml"))
    assert read_cell(write_cell(tmp_path, sim={"sensor": "d455"})).sim.sensor == "d455"


@pytest.mark.parametrize(
    ("sections", "said"),
    [
        ({"target": {"name": "77"}}, "target name '77' was not found"),
        ({"target": {}}, "allowed is one of index, name and pixel"),
        ({"segmenter": {"kind": "file"}}, "segmenter.file is missing"),
        ({"camera": {"intrinsics": INTRINSICS, "depth": "depth.npy"}}, "camera.extrinsics is missing"),
        (
            {"robot": {"limits": {"high_m": [0.3, 0.3, 0.25]}}},
            "no room to lift what is grasped; allowed is a third number",
        ),
        ({"robot": {"limits": {"step_m": 0.19}}}, "no room to lift what is grasped; allowed is a third number of 0.32"),
    ],
)
def test_what_a_cell_lacks_is_one_line(tmp_path: Path, sections: dict, said: str, capsys):
    cell = write_cell(tmp_path, **sections)
    with pytest.raises(SystemExit) as stopped:
        main(["deploy", str(small_bundle()), "--config", str(cell), "--once", "True"])
    error = capsys.readouterr().err
    assert stopped.value.code == 2 and said in error and error.count("\n") == 1, error


def test_the_tabletop_segmenter_finds_the_target_by_a_pixel(tmp_path: Path, capsys):
    rows, columns = np.nonzero(SMALL.golden["instances"][0] == SMALL.golden["target_id"][0])
    pixel = [int(np.median(columns)), int(np.median(rows))]
    cell = write_cell(tmp_path, segmenter={"kind": "tabletop"}, target={"pixel": pixel})
    assert main(["deploy", str(small_bundle()), "--config", str(cell), "--once", "True"]) == 0
    assert "push 1" in capsys.readouterr().out


@pytest.mark.parametrize(("tilt", "code"), [(0.0, 0), (1.0, 1)])
def test_a_calibration_is_checked_against_the_table(tmp_path: Path, tilt: float, code: int, capsys):
    cell = write_cell(tmp_path, tilt_deg=tilt)
    Image.fromarray(np.full(SMALL.camera.shape, 10_000, np.uint16)).save(tmp_path / "empty.png")
    files = ["--depth", str(tmp_path / "empty.png"), "--png", str(tmp_path / "check.png")]
    assert main(["calibrate-check", str(cell), "--bundle", str(small_bundle()), *files]) == code
    said = capsys.readouterr().out
    found = re.search(r"tilt +([\d.]+) degrees", said)
    assert found and float(found[1]) == pytest.approx(tilt, abs=0.02) and "100% of the pushes" in said
    with Image.open(tmp_path / "check.png") as picture:
        colors = np.asarray(picture.convert("RGB"), int)
    middle, right = colors[250, 250], colors[250, -5]
    assert middle.min() > 200 and bool(right.min() > 240) == (tilt == 0)


def test_the_python_of_the_page_runs(monkeypatch, capsys):
    (code,) = re.findall(r"```python\n(.*?)```", (ROOT / "docs" / "deploy.md").read_text(), re.DOTALL)
    exec(compile(code.replace('"bundle"', repr(str(small_bundle()))), "docs/deploy.md", "exec"), {})
    numbers = [float(x) for x in capsys.readouterr().out.strip(" []\n").split()]
    assert len(numbers) == 7 and numbers[2] == pytest.approx(0.1, abs=1e-3)
