"""Disks that are full and files that are damaged: what is lost, what is said, and what is left behind."""

import errno
import io as text_io
import os
import re
import resource
import shutil
import subprocess
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest
from fake_training import make_config, make_trainer, never, rows, run, stop_after, timeless

from pregrasp_jax.checkpoint import Ring, checksum, load_policy, restore, save
from pregrasp_jax.training.run_folder import RunFolder
from pregrasp_jax.training.trainer import Trainer

CONFIG = make_config(episodes=24, checkpoint_minutes=0.0)
STEP = CONFIG.train.num_envs
FULL = "No space left on device"


def listing(folder: Path) -> dict[Path, bytes]:
    return {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def fail_at_file(patch: pytest.MonkeyPatch, number: int) -> list[int]:
    """Let the disk be full when file `number` is flushed; return the files flushed so far."""
    flushed: list[int] = []

    def fsync(handle: int) -> None:
        flushed.append(handle)
        if len(flushed) == number:
            raise OSError(errno.ENOSPC, FULL)

    patch.setattr(os, "fsync", fsync)
    return flushed


@pytest.fixture(scope="module")
def whole(tmp_path_factory) -> Trainer:
    """The run that nothing happens to."""
    return run(tmp_path_factory.mktemp("runs") / "whole", CONFIG)


@pytest.fixture(scope="module")
def stopped(tmp_path_factory) -> Path:
    """The same run after five steps."""
    path = tmp_path_factory.mktemp("runs") / "stopped"
    run(path, CONFIG, stop=stop_after(5))
    return path


@pytest.mark.parametrize("step", [2, 3], ids=["the same step", "a later step"])
def test_whichever_file_of_a_checkpoint_does_not_fit_the_last_one_stays_and_no_half_is_left(
    tmp_path, monkeypatch, step
):
    def write(step: int, written: int, best: float) -> Path:
        slots = np.arange(8, dtype=np.uint8)
        ring = Ring({"height": jnp.asarray(np.where(slots < written, slots, 0))}, written)
        return save(tmp_path, step, {"a": jnp.arange(2) + step}, ring, {"best": best}, policy="a")

    write(1, 3, 0.1)
    write(2, 6, 0.2)
    before = listing(tmp_path)
    number_of_files = 2 if step == 2 else 3
    for number in range(1, number_of_files + 1):
        with monkeypatch.context() as patch:
            fail_at_file(patch, number)
            with pytest.raises(OSError, match=FULL) as error:
                write(step, 2 * step + 2, 0.3)
        assert Path(error.value.filename).is_relative_to(tmp_path), "it says which file"
        assert listing(tmp_path) == before
    with monkeypatch.context() as patch:
        assert len(fail_at_file(patch, -1)) == 0
        write(step, 2 * step + 2, 0.3)
    restored = restore(tmp_path, {"a": jnp.arange(2)}, {"height": jnp.zeros(8, jnp.uint8)})
    assert (restored.step, restored.extra, restored.problems) == (step, {"best": 0.3}, ())


@contextmanager
def small_disk(folder: Path) -> Iterator[Callable[[], AbstractContextManager[None]]]:
    """Mount a disk of 16 MB; the function that it yields fills what is left of it for a while."""
    folder.mkdir()
    mounted = shutil.which("mount") and subprocess.run(["mount", "-t", "tmpfs", "-o", "size=16m", "tmpfs", folder])
    if not mounted or mounted.returncode:
        pytest.skip("only root may mount a small disk")

    @contextmanager
    def full() -> Iterator[None]:
        filler = folder / "filler"
        with pytest.raises(OSError, match=FULL), filler.open("wb", buffering=0) as file:
            while True:
                file.write(bytes(4096))
        yield
        filler.unlink()

    try:
        yield full
    finally:
        subprocess.run(["umount", folder], check=True)


@contextmanager
def pretended_disk(folder: Path) -> Iterator[Callable[[], AbstractContextManager[None]]]:
    """The same without a mount: nothing can be flushed while it is full."""
    folder.mkdir()

    @contextmanager
    def full() -> Iterator[None]:
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(os, "fsync", refuse)
            yield

    def refuse(handle: int) -> None:
        raise OSError(errno.ENOSPC, FULL)

    yield full


@pytest.mark.parametrize("disk", [small_disk, pretended_disk])
def test_a_training_survives_a_full_disk_and_saves_again_when_there_is_room(tmp_path, whole, disk):
    said, path = text_io.StringIO(), tmp_path / "disk" / "run"
    with disk(tmp_path / "disk") as full:
        trainer = make_trainer(path, CONFIG, said=said)
        with trainer.recorder.folder:
            trainer.run(stop_after(1))
            before = listing(path / "checkpoints")
            with full():
                trainer.run(stop_after(2))
                assert not trainer.recorder.saved
                assert listing(path / "checkpoints") == before, "no half is left"
            trainer.run(stop_after(1))
            assert trainer.recorder.saved
        warnings = [line for line in said.getvalue().splitlines() if "no checkpoint" in line]
        assert warnings[:2] == [
            f"warning: no checkpoint written at step {step} ({FULL}: {path}); the last checkpoint is of step {STEP}"
            for step in (2 * STEP, 3 * STEP)
        ]
        assert checksum(run(path, CONFIG, resume=True).state) == checksum(whole.state)


def test_a_run_that_cannot_write_its_first_checkpoint_does_not_begin(tmp_path):
    with pretended_disk(tmp_path / "disk") as full:
        path = tmp_path / "disk" / "run"
        folder = RunFolder.create(path, CONFIG)
        with folder, full(), pytest.raises(ValueError, match=r"no checkpoint can be written to .*run; allowed is a"):
            make_trainer(path, CONFIG, folder=folder)


def test_a_row_of_metrics_that_does_not_fit_leaves_no_half(tmp_path):
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    with RunFolder.create(tmp_path / "run", CONFIG) as folder:
        folder.append_metrics({"env_steps": 3})
        resource.setrlimit(resource.RLIMIT_FSIZE, (25, limits[1]))  # the first row takes 17 bytes
        try:
            with pytest.raises(OSError, match=FULL):
                folder.append_metrics({"env_steps": 6})
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, limits)
        folder.append_metrics({"env_steps": 9})
    assert rows(tmp_path / "run") == [{"env_steps": 3}, {"env_steps": 9}]


def flip_byte(path: Path) -> None:
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    path.write_bytes(data)


def cut_short(path: Path) -> None:
    data = path.read_bytes()
    path.write_bytes(data[: len(data) // 2])


@pytest.mark.parametrize(
    ("victim", "damage", "said"),
    [
        ("000000015/state.safetensors", cut_short, "{file} is cut short or altered (checksum differs)"),
        ("000000015/state.safetensors", flip_byte, "{file} is cut short or altered (checksum differs)"),
        ("000000015/state.safetensors", Path.unlink, "{file} cannot be read (No such file or directory)"),
        ("000000015/manifest.json", cut_short, "{file} is damaged"),
        ("replay/{newest}", flip_byte, "replay chunk {file} is cut short or altered (checksum differs)"),
        ("replay/{newest}", Path.unlink, "replay chunk {file} cannot be read (No such file or directory)"),
    ],
)
def test_damage_costs_one_checkpoint_and_is_said(tmp_path, stopped, victim, damage, said):
    path = tmp_path / "run"
    shutil.copytree(stopped, path)
    newest = max(path.glob("checkpoints/replay/*.npz")).name
    file = path / "checkpoints" / victim.format(newest=newest)
    damage(file)
    console = text_io.StringIO()
    with make_trainer(path, CONFIG, resume=True, said=console).recorder.folder:
        first, second = console.getvalue().splitlines()
    assert first == f"warning: {said.format(file=file)}; going on from the checkpoint of step 12"
    assert second.startswith(f"resuming {path} at step 12, episode ")


@pytest.mark.parametrize("damage", [flip_byte, Path.unlink])
def test_an_old_chunk_that_is_lost_costs_what_refers_to_it_and_the_run_goes_on(tmp_path, stopped, damage):
    path = tmp_path / "run"
    shutil.copytree(stopped, path)
    oldest = min(path.glob("checkpoints/replay/*.npz"))
    damage(oldest)
    console = text_io.StringIO()
    trainer = make_trainer(path, CONFIG, resume=True, said=console)
    damaged, lost, resuming = console.getvalue().splitlines()
    assert damaged.startswith(f"warning: replay chunk {oldest} ") and damaged.endswith("of step 15")
    assert re.fullmatch(
        r"warning: [1-9]\d* observations are lost, and [1-9]\d* transitions with them; the run .*", lost
    )
    assert resuming.startswith(f"resuming {path} at step 15, episode ")
    with trainer.recorder.folder:
        trainer.run(never)
    again = make_trainer(path, CONFIG, resume=True, said=console)
    assert again.recorder.counters.episodes >= CONFIG.train.episodes
    assert console.getvalue().count("observations are lost") == 1


def test_a_policy_that_could_not_be_written_is_not_the_best(tmp_path):
    """0.9 while the disk is full; the 0.5 after it must be kept instead."""
    said, path, scores = text_io.StringIO(), tmp_path / "disk" / "run", iter([0.3, 0.9, 0.5])
    with pretended_disk(tmp_path / "disk") as full:
        trainer = make_trainer(path, CONFIG, said=said)
        trainer.recorder.evaluate_fn = lambda params: {"success_rate": next(scores)}
        program = trainer.program.compile(trainer.state)
        for disk in (nullcontext(), full(), nullcontext()):
            with disk:
                trainer.step(program)
                trainer.recorder.evaluate(trainer.average())
    assert [line.split(": ")[1] for line in said.getvalue().splitlines() if line.startswith("validation")] == [
        "success 30% (best 30%)",
        "success 90% (best 30%)",
        "success 50% (best 50%)",
    ]
    assert load_policy(path).evaluation["success_rate"] == 0.5


def test_a_run_goes_on_from_the_checkpoint_before_the_damaged_one_as_if_nothing_had_happened(tmp_path, stopped, whole):
    shutil.copytree(stopped, tmp_path / "run")
    flip_byte(tmp_path / "run" / "checkpoints" / "000000015" / "state.safetensors")
    assert checksum(run(tmp_path / "run", CONFIG, resume=True).state) == checksum(whole.state)
    assert timeless(tmp_path / "run") == timeless(whole.recorder.folder.path)
