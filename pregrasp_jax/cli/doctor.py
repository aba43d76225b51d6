"""`python -m pregrasp_jax doctor`: what this machine offers, in lines a bug report can carry."""

import importlib.util
import os
import platform
from pathlib import Path

import jax

from pregrasp_jax import io
from pregrasp_jax.machine import versions
from pregrasp_jax.training import resources

_OPTIONAL = {
    "warp": "engine warp",
    "tensorboardX": "train.tensorboard",
    "OpenGL": "not needed: pictures use no GL",
}


def describe() -> list[tuple[str, str]]:
    """Return (name, finding) pairs."""
    found = [(name, version) for name, version in versions().items()]
    found += [
        ("machine", f"{platform.machine()}, {platform.system()} {platform.release()}"),
        ("cores", f"{_num_cores()} usable of {os.cpu_count()}"),
        ("NPROC", _describe_guard()),
        ("jax devices", ", ".join(f"{device.platform} {device.device_kind}" for device in jax.devices())),
        ("engine native", _describe_native()),
        ("engine mjx", _describe_module("mujoco.mjx")),
    ]
    found += [(module, f"{_describe_module(module)} ({use})") for module, use in _OPTIONAL.items()]
    memory = resources.available_memory()
    found += [
        ("free memory", "unknown" if memory is None else _gigabytes(memory)),
        ("free disk here", _gigabytes(resources.available_disk(Path.cwd()))),
        ("cache", _describe_folder(io.cache_dir())),
        ("compiled programs", str(os.environ.get("JAX_COMPILATION_CACHE_DIR") or io.cache_dir() / "jax")),
    ]
    return found


def format_description(found: list[tuple[str, str]]) -> str:
    """Return one line per finding."""
    width = max(len(name) for name, _ in found)
    return "\n".join(f"{name:<{width}}  {finding}" for name, finding in found)


def _num_cores() -> int:
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _describe_guard() -> str:
    """Say whether XLA has the four threads below which MJX programs deadlock."""
    value = os.environ.get("NPROC")
    if max(_num_cores(), int(value or 0)) >= 4:
        return f"{value or 'unset'}: enough threads for XLA"
    return f"{value or 'unset'}: MJX may deadlock; set NPROC=4 before Python starts"


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


def _describe_module(name: str) -> str:
    return "installed" if importlib.util.find_spec(name) else "not installed"


def _describe_folder(path: Path) -> str:
    size = sum(file.stat().st_size for file in path.rglob("*") if file.is_file()) if path.is_dir() else 0
    return f"{path} ({_gigabytes(size)})"


def _gigabytes(size: int) -> str:
    return f"{size / 1e9:.2f} GB"
