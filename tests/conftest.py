"""Settings and fixtures that every test shares, and the memory that a worker may take."""

import pregrasp_jax  # noqa: F401  (sets NPROC before jax is imported)

# isort: split
import ctypes
import gc
import os
import platform
import resource
import sys
from collections.abc import Generator
from pathlib import Path

import jax
import pytest

MAX_MB = 2048
"""Resident memory that a worker may have; compiling the push of `mjx` and remeshing by CoACD take nearly as much."""

PEAK = pytest.StashKey[int]()

# The suite mostly waits for the compiler. It takes half the time if it optimises little and emits loops in the older of
# its two ways; so it does in programs that tests start. By that way two programs only round alike if the processor may
# not multiply and add at once. `JAX_DISABLE_MOST_OPTIMIZATIONS=0 make test` tests the programs that everybody runs.
if "JAX_DISABLE_MOST_OPTIMIZATIONS" not in os.environ:
    os.environ["JAX_DISABLE_MOST_OPTIMIZATIONS"] = "1"
    flags = [os.environ.get("XLA_FLAGS", ""), "--xla_cpu_use_fusion_emitters=false"]
    if platform.machine() in ("x86_64", "AMD64"):
        flags.append("--xla_cpu_max_isa=AVX")
    os.environ["XLA_FLAGS"] = " ".join(flags)
    jax.config.update("jax_disable_most_optimizations", True)

jax.config.update("jax_numpy_rank_promotion", "raise")
jax.config.update(
    "jax_compilation_cache_dir",
    os.environ.get("JAX_COMPILATION_CACHE_DIR") or str(Path(__file__).parent.parent / ".pytest_cache" / "jax"),
)
jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)  # thousands of small programs, too


LONGEST = [
    "test_assets_meshes",
    "test_mjx",
    "test_mjx_contacts",
    "test_examples",
    "test_replay",
    "test_training",
    "test_dump",
    "test_confined",
    "test_gymnasium",
    "test_cli",
    "test_probe_envs",
    "test_collect",
    "test_installed",
    "test_networks",
    "test_exploration",
    "test_policies",
    "test_env",
]
"""Modules to begin with, so that no worker ends the run alone with one of them; those that take most memory first."""


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_auto_num_workers() -> int:
    """Return one worker more than there are cores: some tests wait for processes, signals and devices."""
    cores = os.sched_getaffinity(0) if hasattr(os, "sched_getaffinity") else range(os.cpu_count() or 1)
    return len(cores) + 1


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Put the longest modules first; the others stay in order."""
    places = {name: place for place, name in enumerate(LONGEST)}
    items.sort(key=lambda item: places.get(item.path.stem, len(LONGEST)))


@pytest.hookimpl(wrapper=True)
def pytest_collection() -> Generator[None, object, object]:
    """Collect no garbage while test files are imported, nor what they have imported after each of them has run."""
    gc.disable()
    try:
        return (yield)
    finally:
        gc.collect()
        gc.freeze()
        gc.enable()


@pytest.fixture
def key() -> jax.Array:
    return jax.random.key(0)


@pytest.fixture(scope="module", autouse=True)
def optimise(request: pytest.FixtureRequest) -> Generator[None]:
    """Let a module compile as everybody does: millions of draws take longer than what is saved."""
    if not request.path.name.startswith("test_exploration"):
        yield
        return
    before = jax.config.read("jax_disable_most_optimizations")
    jax.config.update("jax_disable_most_optimizations", False)
    yield
    jax.config.update("jax_disable_most_optimizations", before)


@pytest.hookimpl(wrapper=True, tryfirst=True)
def pytest_runtest_teardown(item: pytest.Item, nextitem: pytest.Item | None) -> Generator[None]:
    """Drop a module's programs once its fixtures are gone, and fail the test with which the worker outgrew its limit.

    Not after every test: modules share compiled functions among their tests, and some count how often these are traced.
    """
    yield
    if nextitem is None or nextitem.path != item.path:
        drop_compiled_programs()
    before, peak = item.config.stash.get(PEAK, 0), peak_mb()
    item.config.stash[PEAK] = peak
    if before <= MAX_MB < peak and not item.get_closest_marker("slow"):
        pytest.fail(
            f"this test took the worker from {before} to {peak} MB of memory; allowed are {MAX_MB}", pytrace=False
        )


def drop_compiled_programs() -> None:
    """Free what jax has compiled, which otherwise lives as long as the worker: more than 4 GB in the end."""
    jax.clear_caches()
    gc.collect()
    if sys.platform == "linux":  # glibc keeps what was freed until it is told
        getattr(ctypes.CDLL(None), "malloc_trim", lambda _: 0)(0)


def peak_mb() -> int:
    """Return the largest resident memory that this process has had, MB."""
    if sys.platform == "linux":  # of this program alone: what getrusage says outlives an exec
        status = Path("/proc/self/status").read_text()
        return int(next(line.split()[1] for line in status.splitlines() if line.startswith("VmHWM"))) // 2**10
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak // (2**20 if sys.platform == "darwin" else 2**10)
