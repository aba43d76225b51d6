"""Bundles: the same values by every file, and a word about anything that is not whole."""

import hashlib
import json
import shutil
from dataclasses import replace
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import onnx
import onnxruntime
import pytest
from bundles import ACTIONS, random_params, random_policy, small_bundle

from pregrasp_jax.checkpoint import checksum, load_policy, state, write_config
from pregrasp_jax.checkpoint.chunks import Ring
from pregrasp_jax.cli.main import main
from pregrasp_jax.config import Config, NetworkConfig, PlaceConfig, TaskConfig
from pregrasp_jax.deploy.bundle import check_contract, read_bundle
from pregrasp_jax.deploy.contract import CONTRACT_KEY, format_contract
from pregrasp_jax.deploy.policy import load_values
from pregrasp_jax.export import describe, onnx_policy
from pregrasp_jax.export.bundle import export_policy
from pregrasp_jax.export.onnx_policy import make_onnx
from pregrasp_jax.export.stablehlo import policy_function
from pregrasp_jax.learning.q_function import make_q_function
from pregrasp_jax.spaces.actions import ActionSpace, Choice
from pregrasp_jax.spaces.workspace import get_workspace
from pregrasp_jax.training.program import POLICY

RNG = np.random.default_rng(0)
PLACES = np.array([[-0.3, 0.0], [-0.2475, 0.1025], [0.0, 0.0], [0.245, -0.245], [0.4, 0.3]], np.float32)
"""The start, two cell centres, a corner of cells, outside of the table."""


@pytest.fixture
def bundle(tmp_path: Path) -> Path:
    """Return a copy of a bundle that a test may alter."""
    return Path(shutil.copytree(small_bundle(), tmp_path / "bundle"))


def states(count: int) -> dict[str, np.ndarray]:
    height = (RNG.random((count, 100, 100)) * 0.4 - 0.03).astype(np.float32)
    labels = RNG.integers(0, 4, (count, 100, 100)).astype(np.uint8)
    return {"height_m": height, "labels": labels, "p1_m": PLACES[:count]}


def run(model: onnx.ModelProto, inputs: dict[str, np.ndarray]) -> np.ndarray:
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1
    session = onnxruntime.InferenceSession(model.SerializeToString(), options, providers=["CPUExecutionProvider"])
    return np.asarray(session.run(None, inputs)[0])


COMPACT = NetworkConfig(architecture="compact", width=1 / 32)
PAPER = NetworkConfig(architecture="paper", width=1 / 32)
CASES = [
    (replace(COMPACT, mirror=True), True),
    (replace(COMPACT, path_channels=2), True),
    (replace(COMPACT, mirror=True, members=2, path_channels=2), False),
    pytest.param(replace(COMPACT, width=0.25, mirror=True), False, marks=pytest.mark.slow),
    (replace(COMPACT, width=1 / 16, members=3), False),
    (replace(PAPER, mirror=True, members=2), False),
    pytest.param(replace(PAPER, width=1 / 16), True, marks=pytest.mark.slow),
]


def in_five_parts(params):
    """Divide what the second readout says by the number of its looks, which add up: values stay as large as without."""
    return jax.tree_util.tree_map_with_path(
        lambda path, leaf: leaf / 5 if "path_readout" in str(path) else leaf, params
    )


@pytest.mark.parametrize(("network", "full_ring"), CASES)
def test_the_graph_says_what_the_network_says(network, full_ring):
    config = Config(network=network, task=TaskConfig(full_ring=full_ring))
    q_function = make_q_function(config.network, config.task, ACTIONS)
    params = in_five_parts(random_params(q_function))
    model = make_onnx(jax.tree.map(np.asarray, params), config, ACTIONS)
    inputs = states(5)
    wanted = np.asarray(jax.jit(policy_function(q_function, params))(**{k: jnp.asarray(v) for k, v in inputs.items()}))
    assert wanted.std() > 1e-3, "a flat map would hide mistakes"
    found = run(model, inputs)
    np.testing.assert_allclose(found, wanted, atol=1e-4)
    np.testing.assert_array_equal(found.reshape(5, -1).argmax(1), wanted.reshape(5, -1).argmax(1))
    alone = run(model, {name: value[2:3] for name, value in inputs.items()})
    np.testing.assert_allclose(alone, wanted[2:3], atol=1e-4)


def test_choices_that_the_mirror_swaps_are_swapped():
    choices = tuple(Choice(name=name, z=0.1, yaw=yaw, aperture=0.0) for name, yaw in (("left", 0.5), ("right", -0.5)))
    actions = ActionSpace(choices, mirrored=(1, 0))
    config = Config(network=replace(COMPACT, mirror=True))
    q_function = make_q_function(config.network, config.task, actions)
    params, inputs = random_params(q_function), states(2)
    wanted = jax.jit(policy_function(q_function, params))(**{k: jnp.asarray(v) for k, v in inputs.items()})
    found = run(make_onnx(jax.tree.map(np.asarray, params), config, actions), inputs)
    np.testing.assert_allclose(found, np.asarray(wanted), atol=1e-4)


def test_the_graph_is_for_old_runtimes_and_carries_its_contract(bundle: Path):
    model = onnx.load(bundle / "policy.onnx")
    assert (model.opset_import[0].version, model.ir_version) == (17, 8)
    assert not [node for node in model.graph.node if node.op_type == "Resize"]
    held = {entry.key: entry.value for entry in model.metadata_props}
    inside = check_contract(json.loads(held[CONTRACT_KEY]), origin="policy.onnx")
    assert inside == replace(read_bundle(bundle).contract, files={})
    assert [given.name for given in model.graph.input] == list(onnx_policy.INPUTS)


def test_a_bundle_is_verified(bundle: Path, capsys):
    assert main(["verify", str(bundle)]) == 0
    said = capsys.readouterr().out
    assert said.count(" ok ") == 5 and "FAILED" not in said, said
    assert "heightmaps" in said and "stablehlo_batch" in said


def test_the_latest_checkpoint_of_a_run_is_exported_as_a_policy(tmp_path: Path):
    """Of a checkpoint only the policy, without the rest of the training, and without a claim of what it can do."""
    config = Config(network=COMPACT)
    params = random_params(make_q_function(config.network, config.task, ACTIONS))
    write_config(tmp_path / "config.yaml", config)
    tree = {"learning": {"learner": {"target_params": params}}, "rest": np.zeros(10_000)}
    state.save(tmp_path / "checkpoints", 7, tree, Ring({"height": np.zeros((1, 2), np.uint8)}, 0), {}, policy=POLICY)
    contract = export_policy(
        load_policy(tmp_path / "checkpoints"), tmp_path / "bundle", formats=["safetensors"], golden=2
    )
    exported = load_policy(tmp_path / "bundle")
    assert checksum(exported.params) == checksum(params) and exported.config == config
    assert (contract.training.origin, contract.evaluation) == ("000000007", {})
    assert main(["verify", str(tmp_path / "bundle")]) == 0


def test_another_policy_in_the_graph_is_found(bundle: Path, tmp_path: Path, capsys):
    config = Config(network=replace(COMPACT, mirror=True))
    other = random_params(make_q_function(config.network, config.task, ACTIONS), seed=7)
    data = make_onnx(jax.tree.map(np.asarray, other), config, ACTIONS).SerializeToString()
    (bundle / "policy.onnx").write_bytes(data)
    contract = json.loads((bundle / "contract.json").read_text())
    contract["files"]["policy.onnx"] = {"sha256": hashlib.sha256(data).hexdigest(), "bytes": len(data)}
    (bundle / "contract.json").write_text(json.dumps(contract))
    assert main(["verify", str(bundle), "--formats", "onnx"]) == 1
    assert "onnx             FAILED" in capsys.readouterr().out


def flip(path: Path) -> None:
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    path.write_bytes(data)


def edit(path: Path, **changes: object) -> None:
    path.write_text(json.dumps(json.loads(path.read_text()) | changes))


DAMAGE = {
    "policy.onnx is altered": lambda b: flip(b / "policy.onnx"),
    "robot.npz cannot be read": lambda b: (b / "robot.npz").unlink(),
    "golden.npz is altered": lambda b: (b / "golden.npz").write_bytes((b / "golden.npz").read_bytes()[:-5]),
    "is not a bundle": lambda b: (b / "contract.json").unlink(),
    "is not JSON": lambda b: (b / "contract.json").write_text("{"),
    "is not the contract": lambda b: (b / "contract.json").write_text("[]"),
    "another version": lambda b: edit(b / "contract.json", format="pregrasp_jax bundle 2"),
    "unknown config key speed": lambda b: edit(b / "contract.json", speed=1),
    "config key created is missing": lambda b: (b / "contract.json").write_text(
        json.dumps({k: v for k, v in json.loads((b / "contract.json").read_text()).items() if k != "created"})
    ),
    "allowed are files of the bundle's folder": lambda b: edit(
        b / "contract.json", files={"../x": {"sha256": "0", "bytes": 1}}
    ),
}


@pytest.mark.parametrize("said", DAMAGE)
def test_what_is_not_whole_is_refused_in_one_line(bundle: Path, said: str, capsys):
    DAMAGE[said](bundle)
    with pytest.raises(SystemExit) as stopped:
        main(["verify", str(bundle)])
    error = capsys.readouterr().err
    assert stopped.value.code == 2 and error.startswith("error: ") and error.count("\n") == 1 and said in error, error


def test_a_contract_reads_as_text():
    text = format_contract(read_bundle(small_bundle()).contract)
    for word in ("height_m", "uint8", "table frame", "flat index", "95%", "0.172", "Not guaranteed", "sha256"):
        assert word in text, word
    assert "None" not in text and "nan" not in text


def test_a_folder_with_something_in_it_is_refused(tmp_path: Path, bundle: Path, monkeypatch):
    policy = random_policy(tmp_path / "policy", Config(network=COMPACT))
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "thesis.tex").write_text("years")
    for force in (False, True):
        with pytest.raises(ValueError, match="is not empty; allowed is a new folder"):
            export_policy(policy, tmp_path / "full", force=force)
    with pytest.raises(ValueError, match="is not empty"):
        export_policy(policy, bundle)
    with monkeypatch.context() as inside, pytest.raises(ValueError, match="is where the program runs"):
        (tmp_path / "here").mkdir()
        inside.chdir(tmp_path / "here")
        export_policy(policy, Path())
    with pytest.raises(ValueError, match="has learnt by imitation; allowed are policies of Q-learning"):
        export_policy(load_policy("ppg"), tmp_path / "new")
    with pytest.raises(ValueError, match="golden = 1 is out of range"):
        export_policy(policy, tmp_path / "new", golden=1)
    with pytest.raises(ValueError, match="allowed are some of safetensors, onnx, stablehlo"):
        export_policy(policy, tmp_path / "new", formats=["torch"])
    assert (tmp_path / "full" / "thesis.tex").read_text() == "years" and not (tmp_path / "new").exists()


def test_walls_stand_where_the_policy_was_trained(tmp_path: Path):
    """A robot keeps clear of the walls of the task in its dimensions, not in those that a place has by default."""
    place = PlaceConfig(half_width=0.4, back=0.35, wall_height=0.2)
    policy = random_policy(
        tmp_path / "policy", Config(network=COMPACT, task=TaskConfig(workspace="shelf", place=place))
    )
    entry = export_policy(policy, tmp_path / "bundle", formats=["safetensors"], golden=2).place
    wanted = get_workspace("shelf", {"half_width": 0.4, "back": 0.35, "wall_height": 0.2}).walls
    assert [(wall["center_m"], wall["half_size_m"]) for wall in entry.walls] == [
        (list(wall.center), list(wall.half_size)) for wall in wanted
    ]
    assert wanted != get_workspace("shelf").walls


def refused(inputs: dict[str, np.ndarray]) -> str:
    with pytest.raises(ValueError) as stopped:
        load_values(read_bundle(small_bundle()))(*inputs.values())
    return str(stopped.value)


def test_inputs_that_a_runtime_would_take_are_refused():
    good = states(1)
    holes = good["height_m"].copy()
    holes[0, 5, 5] = np.nan
    assert "holds NaN" in refused(good | {"height_m": holes})
    assert "are these millimetres?" in refused(good | {"height_m": 1000 * np.abs(good["height_m"])})
    assert "float64; allowed is a numpy array of float32" in refused(
        good | {"height_m": good["height_m"].astype(float)}
    )
    assert "shape [1, 99, 100]" in refused(good | {"height_m": good["height_m"][:, 1:]})
    assert "labels reaches from 0 to 9" in refused(good | {"labels": np.clip(good["labels"] * 5, 0, 9)})
    assert "p1_m holds NaN" in refused(good | {"p1_m": np.full((1, 2), np.nan, np.float32)})


@pytest.mark.slow
def test_openvino_agrees():
    openvino = pytest.importorskip("openvino")
    bundle = read_bundle(small_bundle())
    golden = bundle.arrays("golden.npz")
    core = openvino.Core()
    model = core.read_model(model=bundle.files["policy.onnx"])
    program = core.compile_model(model, "CPU", {"INFERENCE_PRECISION_HINT": "f32"})
    q = program({name: golden[name] for name in onnx_policy.INPUTS})[program.output(0)]
    assert np.abs(q - golden["q"]).max() <= 1e-4


def test_the_contract_says_which_point_above_a_cell_counts(tmp_path: Path):
    (tmp_path / "coarse.yaml").write_text("cell: median\n")
    for sensor, cell in (("clean", "max"), (str(tmp_path / "coarse.yaml"), "median")):
        task = TaskConfig(camera="pinhole", sensor=sensor)
        config = Config(network=COMPACT, task=task)
        assert describe._camera(random_policy(tmp_path / cell, config)).cell == cell
    assert read_bundle(small_bundle()).contract.camera.cell == "max"
