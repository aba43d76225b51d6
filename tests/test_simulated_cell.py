"""The cell in simulation meets what an evaluation meets, whatever a policy was trained on."""

import dataclasses
from pathlib import Path
from typing import Any

import pytest
from bundles import SMALL, random_policy

from pregrasp_jax import simulated_cell
from pregrasp_jax.config import AssetsConfig, Config, NetworkConfig, PhysicsConfig, SceneConfig, TaskConfig
from pregrasp_jax.deploy.bundle import read_bundle
from pregrasp_jax.deploy.cell import Cell, RuntimeSettings, SimSettings, TableSettings, TargetSettings
from pregrasp_jax.evaluation_config import EvaluationConfig, TaskOverrides, environment_config
from pregrasp_jax.export.bundle import export_policy


class Asked(Exception):
    """The configuration of an environment that is not built."""


def ask(config: Config, *, split: str) -> None:
    raise Asked(config, split)


@pytest.mark.parametrize("scene", [0, 250])
def test_objects_and_scenes_are_those_of_an_evaluation(scene, tmp_path: Path, monkeypatch):
    trained = Config(
        network=NetworkConfig(architecture="compact", width=1 / 32),
        task=TaskConfig(approach_reward=0.0, workspace="shelf"),
        assets=AssetsConfig(variants=150),
        scene=SceneConfig(bank_seed=41, train_scenes=64, test_scenes=8),
        physics=PhysicsConfig(engine="mjx"),
    )
    policy = random_policy(tmp_path / "policy", trained)
    export_policy(policy, tmp_path / "bundle", formats=["onnx"], golden=2)
    cell = dataclasses.replace(Cell(), sim=SimSettings(scene=scene, object_set="unseen", sensor="d455"))
    monkeypatch.setattr(simulated_cell, "make_env", ask)
    with pytest.raises(Asked) as asked:
        simulated_cell.make_programs(read_bundle(tmp_path / "bundle"), cell)
    (tmp_path / "used").mkdir()
    (tmp_path / "used" / "decision-000.npz").touch()
    with pytest.raises(ValueError, match="decisions of an earlier trial"):  # before anything is built
        simulated_cell.make_simulated_station(read_bundle(tmp_path / "bundle"), cell, log=tmp_path / "used")
    found, split = asked.value.args
    request = EvaluationConfig(
        policy="x",
        assets=AssetsConfig(object_set="unseen"),
        task=TaskOverrides(camera="pinhole", sensor="d455"),
        episodes=scene + 1,
    )
    wanted = environment_config(request, trained)
    assert split == "test"
    for name in ("task", "assets", "scene", "physics"):
        assert getattr(found, name) == getattr(wanted, name), name


def test_what_is_about_real_devices_is_not_used_and_said_to_be(monkeypatch):
    """The simulated table is level with the base: the policy of a cell with a lower one would find it out of reach."""
    said: list[str] = []

    def stop(bundle: Any, cell: Cell) -> None:
        raise Asked(cell)

    monkeypatch.setattr(simulated_cell, "make_decider", stop)
    cell = Cell(table=TableSettings(height_m=0.1), target=TargetSettings(name="44"), runtime=RuntimeSettings(threads=2))
    with pytest.raises(Asked) as asked:
        simulated_cell.make_simulated_station(SMALL.bundle, cell, say=said.append)
    (used,) = asked.value.args
    assert used.table == TableSettings() and used.runtime == cell.runtime
    assert said == ["note: a simulated cell has its own table, target; those of the file are not used"]
    with pytest.raises(Asked):
        simulated_cell.make_simulated_station(SMALL.bundle, Cell(sim=SimSettings(scene=3)), say=said.append)
    assert len(said) == 1
