"""What the `mjx` engine refuses, in one line each, before anything compiles."""

import subprocess
import sys
from pathlib import Path

import pytest

from pregrasp_jax.assets.bank import select
from pregrasp_jax.assets.catalogue import builtin_bank
from pregrasp_jax.physics import make_engine, mjx, mjx_version
from pregrasp_jax.robot import get_robot
from pregrasp_jax.spaces.workspace import TABLE

ROBOT = get_robot("ur5e_rg2")
ROOT = Path(__file__).parent.parent


@pytest.fixture(scope="module")
def bank():
    return builtin_bank("seen")


def test_what_does_not_fit_is_refused_in_one_line(bank):
    with pytest.raises(ValueError, match=r"object '.*' has 6 hulls; a slot of the mjx engine holds 1 to 5"):
        mjx.make_engine(bank, ROBOT, TABLE, num_hulls=5)
    with pytest.raises(ValueError, match="num_slots = 9; allowed are 1 to 8"):
        mjx.make_engine(bank, ROBOT, TABLE, num_slots=9)


def test_another_mjx_is_refused_by_name():
    mjx_version.require(mjx_version.installed())
    with pytest.raises(ValueError, match=r"mujoco-mjx 4\.0\.0 is installed; allowed: 3\.17\.0"):
        mjx_version.require("4.0.0")
    with pytest.raises(ValueError, match=r"mujoco-mjx is not installed; allowed: 3\.17\.0"):
        mjx_version.require(None)


def test_the_engine_is_chosen_by_name(bank):
    assert make_engine("mjx", select(bank, [0, 3]), ROBOT, TABLE).name == "mjx"
    with pytest.raises(ValueError, match=r"physics\.engine = 'bullet' does not exist; allowed: native, mjx"):
        make_engine("bullet", bank, ROBOT, TABLE)


def test_nothing_is_printed_about_warp():
    """MJX does when it is imported, which would spoil the JSON of the benchmarks."""
    code = "from pregrasp_jax.physics import mjx_model, mjx"
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=ROOT)
    assert run.stdout == ""
