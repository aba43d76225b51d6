"""The measurement of the structure finds what it counts, by hand or not, and nothing beside it."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

SCRIPT = Path(__file__).parent.parent / "benchmarks" / "structure.py"

SOURCES = {
    "__init__.py": "",
    "spaces/actions.py": """
class ActionSpace:
    def decode(self, action):
        return action // 2, action % 2
""",
    "task/env.py": """
from pregrasp_jax.spaces.actions import ActionSpace

class Env:
    def plan(self, action):
        return self.primitive.actions.decode(action)
""",
    "learning/network.py": '''
import numpy as np

def q_of_action(q, action):
    """One

    two."""
    cell, half = np.unravel_index(action, (100, 2)), action % 2
    return q[..., 1]

def decoys(text, actions, size, data):
    text.decode("utf-8")
    data.decode(text)
    return np.arange(3) % len(actions), size // 2, np.random.choice(3), data[..., 0], 2 * size + 1
''',
    "learning/explore.py": """
from pregrasp_jax.types import OPEN

def draw(cell, key_aperture):
    def inner():
        return (cell * 2 + key_aperture).astype(int)
    return inner() if key_aperture == OPEN else None
""",
    "training/program.py": """
from pregrasp_jax.learning import explore
import pregrasp_jax.learning.network

def make_iterate():
    return explore.draw
""",
    "cli/film.py": """
from pregrasp_jax.training.program import make_iterate

def show(actions, action, reason):
    if reason == "target_in_region":
        return divmod(action, 2)
""",
    "types.py": "CLOSED, OPEN = 0, 1\n",
}


def measure(folder: Path) -> subprocess.CompletedProcess[str]:
    return subprocess.run([sys.executable, SCRIPT, folder], capture_output=True, text=True)


@pytest.fixture(scope="module")
def numbers(tmp_path_factory) -> dict:
    folder = tmp_path_factory.mktemp("checkout")
    for name, text in SOURCES.items():
        path = folder / "pregrasp_jax" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    return json.loads(measure(folder).stdout)


def test_sizes_and_imports(numbers):
    assert numbers["modules"] == 8 and numbers["functions"] == 8
    assert numbers["module_lines_max"] == [14, "learning.network"]
    assert numbers["body_lines_max"] == [3, "learning.network: decoys"], "signature and docstring are not counted"
    assert numbers["imports"] == 5, "env, explore and film import one module each, program two"


def test_a_push_passes_what_an_iteration_imports_and_what_names_it(numbers):
    path = ["learning.explore", "learning.network", "spaces.actions", "task.env"]
    assert numbers["push_path"] == path, "types and program have no word for it, film is not reached"


def test_actions_that_are_taken_apart_are_found_by_hand_or_not(numbers):
    by_hand = ["cli.film: show", "learning.network: q_of_action"]
    assert numbers["decoding"]["on_push_path"] == [by_hand[1], "task.env: Env.plan"]
    assert numbers["decoding"]["elsewhere"] == by_hand[:1]
    assert numbers["decoding"]["by_hand"] == by_hand
    assert numbers["encoding"]["by_hand"] == numbers["encoding"]["on_push_path"] == ["learning.explore: draw.inner"]


def test_two_apertures_and_one_success(numbers):
    assert numbers["two_valued"] == ["learning.network: q_of_action"]
    assert numbers["aperture_comparisons"] == ["learning.explore: draw"]
    assert numbers["success_modules"] == ["cli.film"]


def test_this_checkout_can_be_measured():
    numbers = json.loads(measure(SCRIPT.parent.parent).stdout)
    assert numbers["modules"] > 50 and len(numbers["push_path"]) > 5
    assert numbers["decoding"]["on_push_path"] and numbers["success_modules"]


def test_a_folder_without_the_package_is_refused(tmp_path):
    result = measure(tmp_path)
    assert result.returncode == 2 and result.stdout == ""
    assert result.stderr == f"error: {tmp_path} has no modules in pregrasp_jax/; allowed is a checkout of the project\n"
