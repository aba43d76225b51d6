"""Configurations survive a round trip, and what is wrong in one is said in one line."""

import dataclasses
import functools
import typing

import pytest
import yaml

from pregrasp_jax.checkpoint import read_config, write_config
from pregrasp_jax.config import Config, with_absolute_paths
from pregrasp_jax.presets import PRESETS
from pregrasp_jax.ranges import RANGES
from pregrasp_jax.settings import difference, to_dict


@pytest.mark.parametrize("name", PRESETS)
def test_presets_are_valid_and_survive_yaml(name, tmp_path):
    preset = PRESETS[name].validate()
    assert Config.from_dict(yaml.safe_load(yaml.safe_dump(to_dict(preset)))) == preset
    write_config(tmp_path / "config.yaml", preset)
    assert read_config(tmp_path / "config.yaml") == preset


def numeric_fields(cls: type, prefix: str = "") -> set[str]:
    """Return the keys of all numbers of a config and of the configs in it."""
    found = set()
    for name, hint in typing.get_type_hints(cls).items():
        if dataclasses.is_dataclass(hint):
            found |= numeric_fields(typing.cast(type, hint), f"{prefix}{name}.")
        elif hint in (int, float, int | None, float | None):
            found.add(prefix + name)
    return found


def test_every_number_has_a_range():
    """A new numeric field without a range would be accepted however absurd."""
    assert numeric_fields(Config) == set(RANGES)


@pytest.mark.parametrize("key", sorted(RANGES))
def test_a_value_beyond_its_range_is_refused(key):
    *stage, name = key.split(".")
    low, high = RANGES[key]
    for value in (low - 1, high + 1):
        values = to_dict(Config())
        section = functools.reduce(lambda inner, part: inner[part], stage, values)
        section[name] = value if section[name] is None else type(section[name])(value)
        with pytest.raises(ValueError, match=rf"^{key} = .* is out of range; allowed is ") as error:
            Config.from_dict(values).validate()
        assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("values", "said"),
    [
        ({"sead": 1}, r"unknown config key sead; allowed here: assets, .*seed"),
        ({"replay": {"capasity": 1}}, r"unknown config key replay.capasity; allowed here: capacity"),
        ({"replay": {"capacity": "many"}}, r"replay.capacity = 'many' has the wrong type; allowed: int"),
        ({"replay": {"capacity": True}}, r"replay.capacity = True has the wrong type; allowed: int"),
        ({"replay": {"hindsight": 1}}, r"replay.hindsight = 1 has the wrong type; allowed: bool"),
        ({"replay": 3}, r"replay. must be a mapping, got int"),
        ({"physics": {"engine": "bullet"}}, r"physics.engine = 'bullet' is unknown; allowed: native, mjx"),
        ({"assets": {"object_dir": 3}}, r"assets.object_dir = 3 has the wrong type; allowed: str or null"),
        ([], r"config must be a mapping, got list"),
    ],
)
def test_what_is_wrong_is_named_with_what_is_allowed(values, said):
    with pytest.raises(ValueError, match=said):
        Config.from_dict(values)


def test_settings_that_contradict_each_other():
    with pytest.raises(ValueError, match=r"task.r_in = 0.3 must be below task.r_out = 0.2"):
        Config.from_dict({"task": {"r_in": 0.3}}).validate()
    with pytest.raises(ValueError, match=r"network.path_channels = 8 is about patches.*; allowed is .* compact"):
        Config.from_dict({"network": {"path_channels": 8}}).validate()
    with pytest.raises(ValueError, match=r"learner.siblings = True is about branches.* exploration.branches of 1"):
        Config.from_dict({"learner": {"siblings": True}}).validate()
    with pytest.raises(ValueError, match=r"exploration.branch_spacing = 0.02 is about branches"):
        Config.from_dict({"exploration": {"branch_spacing": 0.02}}).validate()
    Config.from_dict({"learner": {"siblings": True}, "exploration": {"branches": 2, "branch_spacing": 0.02}}).validate()
    with pytest.raises(ValueError, match=r"scene.min_objects = 8 must not exceed scene.max_objects = 5"):
        Config.from_dict({"scene": {"min_objects": 8, "max_objects": 5}}).validate()


def test_an_int_passes_for_a_float_but_not_the_reverse():
    assert Config.from_dict({"network": {"width": 1}}).network.width == 1.0
    with pytest.raises(ValueError, match="wrong type"):
        Config.from_dict({"seed": 1.0})


def test_a_run_finds_its_files_from_any_working_directory(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    values = {"assets": {"object_dir": "meshes"}, "task": {"sensor": "mine.yaml"}, "strokes": {"collection": "run"}}
    config = with_absolute_paths(Config.from_dict(values))
    found = config.assets.object_dir, config.task.sensor, config.strokes.collection
    assert found == tuple(str(tmp_path / name) for name in ("meshes", "mine.yaml", "run"))
    assert with_absolute_paths(config) == config and with_absolute_paths(Config()) == Config()


def test_difference_names_every_change():
    old = Config()
    new = Config.from_dict({"seed": 3, "assets": {"object_dir": "here"}})
    assert difference(old, new) == ["seed: 0 -> 3", "assets.object_dir: None -> here"]
    assert difference(old, Config()) == []


@pytest.mark.parametrize("text", ["{", "seed: 1\nsead: 2", "- 1", "seed: [1]", "\x00"])
def test_a_damaged_config_file_is_one_line_that_names_it(tmp_path, text):
    path = tmp_path / "config.yaml"
    path.write_text(text)
    with pytest.raises(ValueError, match=r"config\.yaml: ") as error:
        read_config(path)
    assert "\n" not in str(error.value)
