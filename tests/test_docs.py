"""What the pages state about limits is what the code allows, and the code they show runs."""

import dataclasses
import re
from pathlib import Path

from pregrasp_jax.assets import formats, mesh_file
from pregrasp_jax.evaluation.results import Episode, EvaluationResult
from pregrasp_jax.scene import bank as scene_bank
from pregrasp_jax.training import learn, recorder, tally
from pregrasp_jax.types import OBSTRUCTIONS, REASONS

ROOT = Path(__file__).parent.parent


def test_the_limits_of_a_mesh_are_those_of_the_code() -> None:
    text = " ".join((ROOT / "docs" / "meshes.md").read_text().split())
    height = f"{mesh_file.MIN_OBJECT_HEIGHT:.2f} to {mesh_file.MAX_OBJECT_HEIGHT:.2f} m tall"
    width = f"at most {mesh_file.MAX_OBJECT_WIDTH:g} m wide"
    thickness, size = f"at least {1e3 * mesh_file.MIN_OBJECT_WIDTH:g} mm thick", f"{formats.MAX_BYTES >> 20} MB"
    assert [limit for limit in (height, width, thickness, size) if limit not in text] == []


def test_the_page_of_files_explains_every_reason_column_and_key() -> None:
    text = (ROOT / "docs" / "files.md").read_text()
    named = set(re.findall(r"`([\w/]+)`", text)) | {f"train/share{end}" for end in re.findall(r"`(_\w+)`", text)}
    columns = {*tally.new_tally(2).metrics([]), *learn.METRICS, *(f"time/{phase}" for phase in recorder.PHASES)}
    columns = {name for name in columns if not name.startswith(("reasons/", "unreachable/"))}
    episode = Episode(scene=0, target="", reason="nan", success=False, motions=1, return_=0, seconds=1)
    keys = EvaluationResult((episode,)).summary()
    assert {*REASONS, *OBSTRUCTIONS, *columns, *keys} - named == {"running", "none"}


def test_the_python_of_the_readme_runs(monkeypatch, capsys):
    (code,) = re.findall(r"```python\n(.*?)```", (ROOT / "README.md").read_text(), re.DOTALL)
    pack = scene_bank.load_or_build

    def pack_few(bank, eligible, config, split, **options):
        return pack(bank, eligible, dataclasses.replace(config, test_scenes=4), split, **options)

    monkeypatch.setattr(scene_bank, "load_or_build", pack_few)
    exec(compile(code, "README.md", "exec"), {})
    assert re.match(r"push 1: reward (0\.0|0\.5|2\.0)\n", capsys.readouterr().out)
