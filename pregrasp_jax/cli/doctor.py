"""`pregrasp-jax doctor`: what this machine offers, in lines a bug report can carry."""

import contextlib
import importlib.util
import os
import platform
import traceback
from collections.abc import Callable
from functools import partial
from pathlib import Path

import jax

import pregrasp_jax
from pregrasp_jax import io
from pregrasp_jax.machine import versions
from pregrasp_jax.startup import CACHE_SWITCH, check, compilation_cache_dir
from pregrasp_jax.training import resources

_OPTIONAL = {
    "tensorboardX": "train.tensorboard",
    "av": "films as .mp4",
    "OpenGL": "not needed: pictures use no GL",
}


def describe() -> list[tuple[str, str]]:
    """Return (name, finding) pairs; a probe that fails says so, and does not keep the others from being heard."""
    probes: dict[str, Callable[[], str]] = {
        "machine": lambda: f"{platform.machine()}, {platform.system()} {platform.release()}",
        "cores": lambda: f"{_num_cores()} usable of {os.cpu_count()}",
        "NPROC": _describe_guard,
        "JAX_PLATFORMS": lambda: os.environ.get("JAX_PLATFORMS") or "unset",
        "jax devices": lambda: ", ".join(f"{device.platform} {device.device_kind}" for device in jax.devices()),
        "environment": lambda: check() or "usable",
        "engine native": _describe_native,
        "engine mjx": _describe_mjx,
        **{module: partial(_describe_module, module, use) for module, use in _OPTIONAL.items()},
        "free memory": _describe_memory,
        "free disk here": lambda: _gigabytes(resources.available_disk(Path.cwd())),
        "cache": lambda: _describe_folder(io.cache_dir()),
        "compiled programs": _describe_programs,
    }
    return [*versions().items(), *((name, _finding(probe)) for name, probe in probes.items())]


def format_description(found: list[tuple[str, str]]) -> str:
    """Return one line per finding."""
    width = max(len(name) for name, _ in found)
    return "\n".join(f"{name:<{width}}  {finding}" for name, finding in found)


def _finding(probe: Callable[[], str]) -> str:
    try:
        return probe()
    except Exception as error:  # whatever is broken here is what the user wants to know
        where = traceback.extract_tb(error.__traceback__)[-1]
        text = " ".join(str(error).split()) or f"in {Path(where.filename).name}, line {where.lineno}"
        return f"failed ({type(error).__name__}: {text})"


def _num_cores() -> int:
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _describe_guard() -> str:
    """Say whether XLA has the four threads below which MJX programs deadlock."""
    value = os.environ.get("NPROC")
    origin = "pregrasp_jax" if pregrasp_jax.NPROC_BY_GUARD else "the environment"
    said = f"{value}, set by {origin}" if value else "unset"
    if (pregrasp_jax.num_threads_asked() or _num_cores()) >= 4:
        return f"{said}: enough threads for XLA"
    return f"{said}: MJX may deadlock; set NPROC=4 before Python starts"


def _describe_native() -> str:
    """Step a falling body for a moment, in batch, and say whether it fell."""
    import mujoco
    from mujoco.batch import Batch

    model = mujoco.MjModel.from_xml_string(  # pyright: ignore[reportAttributeAccessIssue]
        "<mujoco><worldbody><body pos='0 0 1'><freejoint/><geom size='.1'/></body></worldbody></mujoco>"
    )
    batch = Batch(model, 2)
    batch.step(nstep=10)
    heights = batch.bind("qpos")[:, 2]
    return (
        "works" if (heights < 1).all() and heights[0] == heights[1] else f"broken: heights {heights} of a falling body"
    )


def _describe_mjx() -> str:
    try:
        from pregrasp_jax.physics import mjx_version  # here, since importing it refuses what is not supported

        mjx_version.require(mjx_version.installed())
    except ValueError as error:
        return f"unsupported: {error}"
    return f"mujoco-mjx {mjx_version.installed()}, supported"


def _describe_module(name: str, use: str) -> str:
    return f"{'installed' if importlib.util.find_spec(name) else 'not installed'} ({use})"


def _describe_memory() -> str:
    memory = resources.available_memory()
    return "unknown" if memory is None else _gigabytes(memory)


def _describe_folder(path: Path) -> str:
    return f"{path} ({_gigabytes(_num_bytes(path))}, {_gigabytes(resources.available_disk(path))} free)"


def _describe_programs() -> str:
    if folder := compilation_cache_dir():
        return str(folder)
    return f"not kept ({CACHE_SWITCH}=0)" if os.environ.get(CACHE_SWITCH) == "0" else "not kept (cache not writable)"


def _num_bytes(folder: Path) -> int:
    """Return the bytes of all files in a folder, in which others may be writing meanwhile."""
    size = 0
    for parent, _, names in os.walk(folder):
        for name in names:
            with contextlib.suppress(FileNotFoundError):
                size += os.stat(os.path.join(parent, name)).st_size
    return size


def _gigabytes(size: int) -> str:
    return f"{size / 1e9:.2f} GB"
