"""Settings that were once ignored without a message: each is honoured, or refused in one line that names it."""

import dataclasses
import io as text_io
import json
import shutil
import unicodedata
from pathlib import Path
from typing import Any

import fake_training
import numpy as np
import pytest
from fake_training import make_config, make_trainer

from pregrasp_jax import yaml_file
from pregrasp_jax.assets import meshes
from pregrasp_jax.assets.meshes import load_object_dir
from pregrasp_jax.assets.settings import ObjectSettings, load_settings
from pregrasp_jax.checkpoint import load_policy, read_config
from pregrasp_jax.checkpoint.run_config import CHANGEABLE
from pregrasp_jax.config import Config
from pregrasp_jax.report import read_run
from pregrasp_jax.settings import to_dict
from pregrasp_jax.training import session
from pregrasp_jax.training.console import Console
from pregrasp_jax.training.run_folder import RunFolder, stored_config

CASES = Path(__file__).parent / "cases"

FOLDERS = {
    "dup2": "{f}/objects.yaml: line 3: 'box.stl' stands here and in line 1; allowed is one entry",
    "silent": "{f}/objects.yml: not read; the allowed name of a file of settings is objects.yaml",
    "rootyaml": "{f}/objects.yaml: not read, since it lies beside seen; allowed is {f}/seen/objects.yaml",
}


@pytest.fixture
def no_work(monkeypatch) -> None:
    """Fail where a mesh is decomposed."""
    monkeypatch.setattr(meshes, "_results", lambda jobs: pytest.fail("decomposes"))


@pytest.mark.parametrize("case", FOLDERS)
def test_settings_of_a_folder_that_would_be_lost_are_refused(no_work, case):
    with pytest.raises(ValueError) as error:
        load_object_dir(CASES / case, "seen")
    assert str(error.value) == FOLDERS[case].format(f=CASES / case)


@pytest.mark.parametrize("name", ["Objects.yaml", "object.yaml", "OBJECTS.YML", "objects.json", "objects.yaml.txt"])
def test_names_like_that_of_the_settings_are_refused(tmp_path, name):
    (tmp_path / name).write_text("")
    with pytest.raises(ValueError, match=rf"{name}: not read; the allowed name .* is objects\.yaml"):
        load_settings(tmp_path)


def test_settings_that_are_no_file_are_refused(tmp_path):
    (tmp_path / "objects.yaml").symlink_to(tmp_path / "gone.yaml")
    with pytest.raises(ValueError, match=r"objects\.yaml: missing or not a file"):
        load_settings(tmp_path)


def test_other_yaml_files_are_a_warning(tmp_path):
    (tmp_path / "mug.yaml").write_text("mass: 1")
    with pytest.warns(UserWarning, match=r"mug\.yaml: not read; settings of meshes stand in objects\.yaml"):
        assert load_settings(tmp_path) == (ObjectSettings(), {})


COMPOSED = "caf\N{LATIN SMALL LETTER E WITH ACUTE}.stl"
DECOMPOSED = unicodedata.normalize("NFD", COMPOSED)


@pytest.mark.parametrize(("written", "on_disk"), [(COMPOSED, DECOMPOSED), (DECOMPOSED, COMPOSED)])
def test_names_match_in_either_unicode_form(tmp_path, written, on_disk):
    shutil.copy(CASES / "silent" / "box.stl", tmp_path / on_disk)
    (tmp_path / "objects.yaml").write_text(f"{written}: {{mass: 0.8}}", encoding="utf-8")
    jobs, refusals, _ = meshes._list_jobs(tmp_path)
    assert [(job.name, job.settings.mass) for job in jobs] == [(Path(COMPOSED).stem, 0.8)] and not refusals


def test_one_name_in_two_unicode_forms_is_refused(tmp_path):
    for name in (COMPOSED, DECOMPOSED):
        shutil.copy(CASES / "silent" / "box.stl", tmp_path / name)
    jobs, refusals, _ = meshes._list_jobs(tmp_path)
    assert (
        not jobs
        and [reason for _, reason in refusals]
        == ["two files have this name, in two Unicode forms; allowed is one of them"] * 2
    )
    (tmp_path / "objects.yaml").write_text(f"{COMPOSED}: {{mass: 0.8}}\n{DECOMPOSED}: {{mass: 0.9}}", encoding="utf-8")
    with pytest.raises(ValueError, match="stands twice, in two Unicode forms; allowed is one entry"):
        load_settings(tmp_path)


def test_numbers_with_exponents_are_numbers(tmp_path):
    (tmp_path / "objects.yaml").write_text("defaults: {scale: 1e-3, friction: .5}\nm.stl: {density: 1E3}")
    defaults, listed = load_settings(tmp_path)
    assert (defaults.scale, defaults.friction, listed["m.stl"].density) == (1e-3, 0.5, 1e3)
    (tmp_path / "config.yaml").write_text("learner: {learning_rate: 1e-4}")
    assert read_config(tmp_path / "config.yaml").learner.learning_rate == 1e-4


CORE_SCHEMA = [
    *(("1e-3", 1e-3), ("1E5", 1e5), (".5", 0.5), ("-.5e+2", -50.0), ("5.", 5.0), ("-.inf", -np.inf), ("+3", 3)),
    *(("010", 10), ("0o10", 8), ("0x1F", 31), ("~", None), ("", None), ("null", None), ("true", True)),
    *((text, text) for text in ("yes", "off", "1:30", "1_000", "2001-01-01", "1e", "e3", ".")),
    *(("'1e-3'", "1e-3"), ('"true"', "true")),
]


@pytest.mark.parametrize(("text", "value"), CORE_SCHEMA)
def test_scalars_are_read_by_the_core_schema_and_survive_a_round_trip(tmp_path, text, value):
    path = tmp_path / "a.yaml"
    path.write_text(f"a: {text}")
    read = yaml_file.read(path)
    assert read == {"a": value} and type(read["a"]) is type(value)
    for kept in (value, text):
        path.write_bytes(yaml_file.dump({"a": kept}))
        assert yaml_file.read(path) == {"a": kept}


BAD_YAML = [
    ("a: 1\nb: {c: 1,\n  c: 2}", "line 3: 'c' stands here and in line 2; allowed is one entry"),
    ("a: &x 1\nb: *x", "line 2: alias *x; allowed are values written out"),
    ("&x [*x]", "line 1: alias *x; allowed are values written out"),
    ("[" * 5000, "nested too deeply"),
    ("a: " + "9" * 5000, "holds a value that cannot be read"),
    ("a: !!bool maybe", "holds a value that cannot be read"),
    ("a: !!python/object/apply:os.getcwd []", "line 1: could not determine a constructor"),
    ("a: !!timestamp 1", "line 1: could not determine a constructor"),
    ("? [a]\n: 1", "line 1: while constructing a mapping, found unhashable key"),
    ("a: 1\n---\nb: 2", "line 2: expected a single document"),
    ("a: 1\n\tb: 2", "line 2: while scanning"),
    ("\x00", "not valid YAML"),
]


@pytest.mark.parametrize(("text", "said"), BAD_YAML)
def test_what_is_not_plain_data_is_one_line(tmp_path, text, said):
    path = tmp_path / "a.yaml"
    path.write_text(text)
    with pytest.raises(ValueError) as error:
        yaml_file.read(path)
    assert str(error.value).startswith(f"{path}: ") and said in str(error.value) and "\n" not in str(error.value)


def test_a_file_that_cannot_be_read_is_one_line(tmp_path):
    with pytest.raises(ValueError, match=r"a\.yaml: cannot be read \(No such file or directory\)"):
        yaml_file.read(tmp_path / "a.yaml")


@pytest.fixture
def begun(tmp_path) -> tuple[Path, Config]:
    """Return a run that has begun and has a checkpoint, with its configuration."""
    path, config = tmp_path / "run", make_config()
    with RunFolder.create(path, config) as folder:
        folder.begin_session(config, {})
        trainer = make_trainer(path, config, folder=folder)
        trainer.run(fake_training.stop_after(2))
    return path, config


def edit(path: Path, key: str, value: Any) -> None:
    """Edit config.yaml of a run by hand."""
    values, (stage, name) = yaml_file.read(path / "config.yaml"), key.split(".")
    values[stage][name] = value
    (path / "config.yaml").write_bytes(yaml_file.dump(values))


@pytest.mark.parametrize(("key", "old", "new"), [("learner.learning_rate", 1e-4, 1e-3), ("learner.discount", 0.5, 0.9)])
def test_an_edited_configuration_is_refused_like_an_option(begun, key, old, new):
    path, _ = begun
    edit(path, key, new)
    said = [f"{path}/config.yaml is not what the run was made with ({key}: {old} -> {new})", *CHANGEABLE]
    for read in (stored_config, load_policy, lambda path: RunFolder.open(path, make_config())):
        with pytest.raises(ValueError) as error:
            read(path)
        assert all(part in str(error.value) for part in said) and "\n" not in str(error.value)
    stage, name = key.split(".")
    assert read_run(path).setting(stage, name, None) == old, "a report shows what the run was made with"
    edit(path, key, old)
    with RunFolder.open(path, stored_config(path)):
        pass


def test_an_edit_of_what_may_change_counts(begun):
    path, config = begun
    edit(path, "train.episodes", 99)
    longer = dataclasses.replace(config, train=dataclasses.replace(config.train, episodes=99))
    assert stored_config(path) == longer
    with RunFolder.open(path, longer) as folder:
        folder.begin_session(longer, {})
    assert json.loads((path / "manifest.json").read_text())["config"] == to_dict(longer)


def test_a_run_without_a_record_resumes_and_gets_one(begun):
    path, config = begun
    manifest = json.loads((path / "manifest.json").read_text())
    del manifest["config"]
    (path / "manifest.json").write_text(json.dumps(manifest))
    edit(path, "learner.discount", 0.9)
    config = stored_config(path)
    assert config.learner.discount == 0.9
    with RunFolder.open(path, config) as folder:
        folder.begin_session(config, {})
    edit(path, "learner.discount", 0.8)
    with pytest.raises(ValueError, match=r"learner\.discount: 0\.9 -> 0\.8"):
        stored_config(path)


def test_a_record_that_makes_no_sense_is_one_line(begun):
    path, _ = begun
    manifest = json.loads((path / "manifest.json").read_text())
    (path / "manifest.json").write_text(json.dumps(manifest | {"config": {"sead": 1}}))
    with pytest.raises(ValueError, match=r"manifest\.json: unknown config key sead; allowed here: "):
        stored_config(path)


def test_meshes_are_found_from_any_folder_and_may_move(tmp_path, monkeypatch):
    """A training is begun with a relative folder, and resumed elsewhere: by itself, absolutely, and after a move."""
    asked = []

    def make_env(config: Config, **_: Any) -> Any:
        asked.append(config.assets.object_dir)
        return fake_training.PictureEnv()

    monkeypatch.setattr(session, "make_env", make_env)
    monkeypatch.setattr(session, "make_program", lambda env, config, **_: fake_training.make_program(config, env))
    monkeypatch.setattr(session, "make_evaluate", lambda *_: (fake_training.evaluate, lambda params: None))
    for name in ("here", "there"):
        (tmp_path / name).mkdir()
    run, quiet = tmp_path / "run", Console(text_io.StringIO())
    values = to_dict(make_config(episodes=3))

    def config_with(folder: str) -> Config:
        return Config.from_dict(values | {"assets": values["assets"] | {"object_dir": folder}})

    monkeypatch.chdir(tmp_path / "here")
    assert session.train(config_with("meshes"), run, console=quiet) == 0
    first = str(tmp_path / "here" / "meshes")
    assert stored_config(run).assets.object_dir == first
    monkeypatch.chdir(tmp_path / "there")
    assert session.resume(stored_config(run), run, console=quiet) == 0
    assert session.resume(config_with(first), run, console=quiet) == 0
    assert session.resume(config_with("../here/meshes"), run, console=quiet) == 0
    assert set(asked) == {first}
    assert session.resume(config_with("moved"), run, console=quiet) == 0
    assert stored_config(run).assets.object_dir == asked[-1] == str(tmp_path / "there" / "moved")
