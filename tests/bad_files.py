"""A folder of files that nobody can use, and why not."""

import dataclasses
import json
import logging
from concurrent.futures import Future
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import jax
import jax.numpy as jnp
import numpy as np
import trimesh
from fake_training import PictureEnv, make_config
from report_files import write_evaluation
from trimesh.exchange.obj import export_obj

from pregrasp_jax import io
from pregrasp_jax.assets.catalogue import builtin_bank
from pregrasp_jax.assets.formats import MAX_BYTES
from pregrasp_jax.checkpoint import Ring, save, save_policy, trees, write_config
from pregrasp_jax.config import ReplayConfig, TaskConfig
from pregrasp_jax.presets import PRESETS
from pregrasp_jax.spaces.workspace import TABLE
from pregrasp_jax.training.dump import make_dump
from pregrasp_jax.training.mishap import no_mishap

FAKE_HASHES = {
    "hull bank": "hulls",
    "training scenes": "scenes",
    "validation scenes": "scenes",
    "workspace": TABLE.content_hash,
}
"""Of the world without physics."""


class InlineExecutor:
    """Decomposes in this process: to start one that imports everything takes longer than all of these tests."""

    def __init__(self, *_: Any, **__: Any):
        pass

    def __enter__(self) -> "InlineExecutor":
        return self

    def __exit__(self, *_: object) -> None:
        logging.disable(logging.NOTSET)  # a worker silences itself for good

    def submit(self, function: Any, *arguments: Any) -> Future:
        future: Future = Future()
        future.set_result(function(*arguments))
        return future


def make_bad_files(folder: Path) -> None:
    """Write them all."""
    (folder / "file").write_text("")
    (folder / "full").mkdir()
    (folder / "full" / "thesis.tex").write_text("")
    make_bad_runs(folder)
    make_bad_policies(folder)
    make_bad_evaluations(folder)
    make_bad_dumps(folder)
    for name, write in BAD_MESHES.items():
        (folder / "meshes" / name).mkdir(parents=True)
        write(folder / "meshes" / name)


def make_bad_runs(folder: Path) -> None:
    write_config(folder / "run" / "config.yaml", PRESETS["ci"])
    for name, text in {"typo": "sead: 1\n", "range": "task: {r_in: 3.0}\n"}.items():
        (folder / name).mkdir()
        (folder / name / "config.yaml").write_text(text)
    manifest = {"hashes": {"hull bank": "of yesterday"}, "sessions": []}
    for name, text in {"other": json.dumps(manifest), "cut": json.dumps(manifest)[:9], "list": "[]"}.items():
        write_config(folder / name / "config.yaml", make_config())
        (folder / name / "manifest.json").write_text(text)
    ring = Ring({"height": np.zeros((2, 2), np.uint8)}, 1)
    large = dataclasses.replace(make_config(), replay=ReplayConfig(capacity=1_000_000))
    for name, config in {"foreign": make_config(), "damaged": make_config(), "large": large}.items():
        write_config(folder / name / "config.yaml", config)
        save(folder / name / "checkpoints", 7, {"colour": np.zeros(3)}, ring, {}, policy="")
        (folder / name / "manifest.json").write_text(json.dumps({"hashes": FAKE_HASHES, "sessions": []}))
    flip_last_byte(folder / "damaged" / "checkpoints" / "000000007" / "state.safetensors")


def make_bad_policies(folder: Path) -> None:
    arrays, config = {"a": np.zeros(3, np.float32)}, '{"seed": 0, "colour": "red"}'
    (folder / "noise").write_bytes(b"not a policy")
    (folder / "foreign.safetensors").write_bytes(trees.encode(arrays))
    newer = {"config": config, "evaluation": "{}", "checksum": trees.checksum(arrays)}
    for name, number in (("newer", 1), ("newest", 3)):
        about = newer | {"format": f"pregrasp_jax policy {number}"}
        (folder / f"{name}.safetensors").write_bytes(trees.encode(arrays, about))
    for name in ("small", "altered", "header"):
        save_policy(folder / name, arrays, PRESETS["ci"], {})
    flip_last_byte(folder / "altered" / "params.safetensors")
    changed = folder / "header" / "params.safetensors"
    changed.write_bytes(changed.read_bytes().replace(b'"r_out\\": 0.2', b'"r_out\\": 0.3'))
    save_policy(folder / "wide", arrays, dataclasses.replace(PRESETS["ci"], task=TaskConfig(r_out=30.0)), {})
    for name, kind in {"bf16": "BF16", "no_metadata": "F16"}.items():
        layout = {"__metadata__": None, "a": {"dtype": kind, "shape": [1], "data_offsets": [0, 2]}}
        header = json.dumps(layout).encode()
        (folder / f"{name}.safetensors").write_bytes(len(header).to_bytes(8, "little") + header + bytes(2))


def make_bad_evaluations(folder: Path) -> None:
    (folder / "list.json").write_text("[]")
    (folder / "header.json").write_text('{"format": "pregrasp_jax evaluation 1"}')
    changes: dict[str, dict[str, Any]] = {
        "a": {},
        "b": {"scene_bank_hash": "t"},
        "no_rows": {"rows": []},
        "odd_rows": {"rows": [{"scene": [0], "target": "can", "success": True}]},
        "no_config": {"config": "unknown"},
    }
    for name, change in changes.items():
        write_evaluation(folder / f"{name}.json", "clear", [1, 0], **change)


def make_bad_dumps(folder: Path) -> None:
    """Write dumps of objects that nobody has, of those that ship, cut short, of another format, of another config."""
    builtin = PictureEnv(bank=SimpleNamespace(content_hash=builtin_bank("seen").content_hash))
    mishap = no_mishap(jax.vmap(PictureEnv().reset_to)(jnp.arange(1)))
    for name, env in {"others": PictureEnv(), "builtin": builtin}.items():
        written: Any = make_dump(cast(Any, env), make_config())(folder / "dumps", mishap)
        written.rename(folder / f"{name}.npz")
    data = (folder / "others.npz").read_bytes()
    (folder / "cut.npz").write_bytes(data[: len(data) // 2])
    with np.load(folder / "others.npz") as file:
        arrays = dict(file)
    about = json.loads(str(arrays.pop("about")))
    for name, change in {
        "newer": {"format": "pregrasp_jax dump 3"},
        "typo": {"config": {"sead": 1}},
        "bullet": {"engine": "bullet", "hull_bank_hash": builtin.bank.content_hash},
    }.items():
        io.write_npz(folder / f"{name}.npz", about=np.array(json.dumps(about | change)), **arrays)
    io.write_npz(folder / "numbers.npz", a=np.zeros(3))


def flip_last_byte(path: Path) -> None:
    data = bytearray(path.read_bytes())
    data[-1] ^= 1
    path.write_bytes(data)


def box(*size: float) -> trimesh.Trimesh:
    return trimesh.creation.box(size)


def slanted() -> trimesh.Trimesh:
    mesh = box(0.03, 0.03, 0.28)
    mesh.vertices[:, 0] += 0.6 * np.asarray(mesh.vertices)[:, 2]
    return mesh


def link_outside(folder: Path) -> None:
    box(0.06, 0.06, 0.15).export(folder.parent / "outside.stl")
    (folder / "link.stl").symlink_to(folder.parent / "outside.stl")


def name_outside(folder: Path) -> None:
    (folder / "objects.yaml").write_text("../outside.stl: {mass: 0.1}\n")
    (folder / "noise.stl").write_bytes(b"")


def name_missing(folder: Path) -> None:
    (folder / "objects.yaml").write_text("gone.stl: {mass: 0.1}\n")
    (folder / "noise.stl").write_bytes(b"")


def too_wide_for_targets(folder: Path) -> None:
    for number in range(5):
        box(0.12, 0.12, 0.15 + 0.01 * number).export(folder / f"{number}.stl")


def too_few(folder: Path) -> None:
    for number, height in enumerate((0.15, 0.16, 0.02)):
        box(0.06, 0.07, height).export(folder / f"{number}.stl")


def too_many_bytes(folder: Path) -> None:
    with (folder / "m.stl").open("wb") as file:
        file.truncate(MAX_BYTES + 2**20)  # sparse: it takes no room


def mesh(shape: trimesh.Trimesh) -> Any:
    return lambda folder: shape.export(folder / "m.stl")


def text(name: str, content: str) -> Any:
    return lambda folder: (folder / name).write_text(content)


BAD_MESHES = {
    "nothing": lambda folder: None,
    "flat": mesh(box(0.05, 0.004, 0.15)),
    "millimetres": mesh(box(60, 70, 150)),
    "kilometres": mesh(box(6e-5, 7e-5, 15e-5)),
    "low": mesh(box(0.06, 0.06, 0.09)),
    "tall": mesh(box(0.08, 0.08, 0.31)),
    "wide": mesh(box(0.21, 0.05, 0.15)),
    "slanted": mesh(slanted()),
    "nan": text("m.obj", export_obj(box(0.06, 0.07, 0.15)).replace("v ", "v nan 0 0\nv ", 1).replace("f 1", "f 9", 1)),
    "empty": text("m.ply", ""),
    "points": text("m.obj", "v 0 0 0\nv 0 0 0.2\nv 0.1 0 0\n"),
    "sheet": text("m.obj", "v 0 0 0\nv 0.1 0.1 0\nv 0.05 0.05 0.2\nf 1 2 3\n"),
    "noise": lambda folder: (folder / "m.stl").write_bytes(bytes(range(256)) * 4),
    "folder": lambda folder: (folder / "m.obj").mkdir(),
    "link": link_outside,
    "dangling": lambda folder: (folder / "m.stl").symlink_to(folder / "nothing.stl"),
    "loop": lambda folder: (folder / "m.stl").symlink_to("m.stl"),
    "outside": name_outside,
    "missing": name_missing,
    "many_bytes": too_many_bytes,
    "no_target": too_wide_for_targets,
    "few": too_few,
    "setting": text("objects.yaml", "m.stl: {colour: red}\n"),
}
"""What is wrong -> writes a folder of meshes of which that is true."""
