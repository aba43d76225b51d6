"""What the suite itself does between tests: it drops compiled programs and watches the memory of a worker."""

import os
import subprocess
import sys
from pathlib import Path

FIRST = """
import conftest, jax, numpy as np

def test_small():
    conftest.double = jax.jit(lambda x: 2 * x)
    conftest.double(1)

def test_still_compiled():
    assert conftest.double._cache_size() == 1

def test_large():
    conftest.MAX_MB = conftest.peak_mb() + 20
    np.ones(40 * 2**17).sum()

def test_not_blamed():
    assert conftest.peak_mb() > conftest.MAX_MB
"""

SECOND = """
import conftest

def test_dropped():
    assert conftest.double._cache_size() == 0
"""


def test_programs_are_dropped_between_modules_and_the_test_that_takes_too_much_memory_fails(tmp_path):
    (tmp_path / "test_a.py").write_text(FIRST)
    (tmp_path / "test_b.py").write_text(SECOND)
    command = [sys.executable, "-m", "pytest", "-p", "conftest", "-p", "no:cacheprovider", "-rE", str(tmp_path)]
    paths = os.pathsep.join([str(Path(__file__).parent), os.environ.get("PYTHONPATH", "")])
    result = subprocess.run(
        command, cwd=tmp_path, env=os.environ | {"PYTHONPATH": paths}, capture_output=True, text=True
    )
    assert "5 passed, 1 error" in result.stdout, result.stdout
    assert "ERROR test_a.py::test_large - Failed: this test took the worker from" in result.stdout
