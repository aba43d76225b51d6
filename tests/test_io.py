"""Files are whole or absent, and hashes tell apart what differs."""

import errno
import os
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest

from pregrasp_jax import io


def test_a_failed_write_leaves_the_old_file_and_no_litter(tmp_path):
    path = tmp_path / "file"
    io.write_bytes(path, b"old")

    def fail(file) -> None:
        file.write(b"half of the new")
        raise OSError(errno.ENOSPC, "No space left on device")

    with pytest.raises(OSError, match="No space"):
        io.write_atomic(path, fail)
    assert path.read_bytes() == b"old" and os.listdir(tmp_path) == ["file"]


def test_a_folder_is_replaced_whole_or_not_at_all(tmp_path, monkeypatch):
    folder = tmp_path / "bundle"

    def fill(text: str) -> None:
        with io.staged_folder(folder) as staged:
            (staged / text).write_text(text)

    fill("old")
    rename = Path.rename

    def crash(self: Path, to: Path) -> Path:
        if self.name == "new":
            raise KeyboardInterrupt
        return rename(self, to)

    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(Path, "rename", crash)
        fill("new")
    assert (folder / "old").read_text() == "old" and os.listdir(folder) == ["old"]
    with pytest.raises(RuntimeError), io.staged_folder(folder):
        raise RuntimeError
    assert os.listdir(folder) == ["old"] and os.listdir(tmp_path) == ["bundle"]
    fill("new")
    assert os.listdir(folder) == ["new"] and os.listdir(tmp_path) == ["bundle"]


def test_what_killed_writers_leave_is_deleted_but_for_a_folder_that_was_put_aside(tmp_path):
    (tmp_path / "runs").mkdir()
    (tmp_path / "runs" / ".file.abc.partial").write_bytes(b"half")
    for name, inside in ((".bundle.a.partial", "new"), (".bundle.b.partial", "old")):
        (tmp_path / name / inside).mkdir(parents=True)
        (tmp_path / name / inside / ".x.y.partial").write_bytes(b"half")
    io.sweep(tmp_path)
    left = sorted(str(path.relative_to(tmp_path)) for path in tmp_path.rglob("*"))
    assert left == [".bundle.b.partial", ".bundle.b.partial/old", "runs"]


def test_a_name_that_is_too_long_is_refused_before_the_work_and_one_that_fits_can_be_written(tmp_path):
    io.write_bytes(tmp_path / ("n" * 255), b"whole")
    io.refuse_unwritable(tmp_path / ("n" * 255))
    with pytest.raises(ValueError, match="its name has 256 bytes; allowed are 255"):
        io.refuse_unwritable(tmp_path / ("\N{LATIN SMALL LETTER U WITH DIAERESIS}" * 128))


def test_readers_never_see_a_half_written_file(tmp_path):
    path = tmp_path / "deep" / "file"

    def write(file) -> None:
        file.write(b"first")
        file.flush()
        assert not path.exists()
        file.write(b" second")

    io.write_atomic(path, write)
    assert path.read_bytes() == b"first second"


def test_json_and_npz_round_trip(tmp_path):
    io.write_json(tmp_path / "a.json", {"a": [1, 2.5, None]})
    assert (tmp_path / "a.json").read_text().endswith("}\n")
    with pytest.raises(ValueError, match="Out of range float"):
        io.write_json(tmp_path / "b.json", {"a": float("nan")})
    assert not (tmp_path / "b.json").exists()
    io.write_npz(tmp_path / "c.npz", x=np.arange(3), y=np.ones((2, 2), np.float32))
    with np.load(tmp_path / "c.npz", allow_pickle=False) as arrays:
        np.testing.assert_array_equal(arrays["x"], [0, 1, 2])


def test_hash_sees_values_shapes_types_and_order():
    x = np.arange(6, dtype=np.float32)
    parts = [
        (x,),
        (x + 1,),
        (x.reshape(2, 3),),
        (x.astype(np.float64),),
        (x, x),
        ({"a": 1, "b": 2},),
        ({"a": 1, "b": 3},),
        (b"bytes",),
        ("text",),
        (b"bytes", "text"),
        ("text", b"bytes"),
    ]
    digests = [io.content_hash(*part) for part in parts]
    assert len(set(digests)) == len(parts) and all(len(digest) == 16 for digest in digests)


def test_hash_is_the_same_for_equal_content():
    x = np.arange(6, dtype=np.float32).reshape(2, 3)
    assert io.content_hash(x) == io.content_hash(jnp.asarray(x)) == io.content_hash(np.asfortranarray(x))
    assert io.content_hash({"a": 1, "b": 2}) == io.content_hash({"b": 2, "a": 1})


def test_cache_folder_follows_the_environment(tmp_path, monkeypatch):
    monkeypatch.setenv("PREGRASP_JAX_CACHE", str(tmp_path / "mine"))
    assert io.cache_dir() == tmp_path / "mine"
    monkeypatch.delenv("PREGRASP_JAX_CACHE")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert io.cache_dir() == tmp_path / "pregrasp_jax"
    monkeypatch.delenv("XDG_CACHE_HOME")
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    assert io.cache_dir() == tmp_path / "home" / ".cache" / "pregrasp_jax"
