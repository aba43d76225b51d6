"""The package as a stranger gets it: built, installed into an environment of its own, used far from the checkout."""

import json
import os
import shutil
import subprocess
import sys
import sysconfig
import tarfile
import venv
import zipfile
from dataclasses import dataclass
from pathlib import Path

import jax
import pytest
import yaml

import pregrasp_jax

ROOT = Path(__file__).parent.parent

SOURCES = ("LICENSE", "CITATION.cff", "CHANGELOG.md", "README.md", "MANIFEST.in", "Makefile", "constraints.txt")
SOURCES += (
    "pyproject.toml",
    "train.py",
    "evaluate.py",
    "pregrasp_jax",
    "mjcf",
    "benchmarks",
    "docs",
    "examples",
    "tests",
    ".ci",
)
"""What a checkout holds; runs, caches and what earlier builds have left do not belong to it."""


@dataclass(frozen=True)
class Built:
    """The two files of a release."""

    sdist: Path
    wheel: Path

    def in_sdist(self) -> set[str]:
        """Return what the sdist holds, without the name of its folder."""
        with tarfile.open(self.sdist) as file:
            return {name.partition("/")[2] for name in file.getnames()}

    def in_wheel(self) -> set[str]:
        with zipfile.ZipFile(self.wheel) as file:
            return set(file.namelist())


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> Built:
    """Build an sdist of the checkout, and the wheel from what the sdist holds."""
    folder = tmp_path_factory.mktemp("built")
    checkout = folder / "checkout"
    for name in SOURCES:
        copy = shutil.copytree if (ROOT / name).is_dir() else shutil.copy
        checkout.mkdir(exist_ok=True)
        copy(ROOT / name, checkout / name)
    sdist = _build("sdist", checkout, folder)
    shutil.unpack_archive(sdist, folder / "unpacked")  # of tarfile, Python 3.11.0 to 3.11.3 know no filter
    (unpacked,) = (folder / "unpacked").iterdir()
    return Built(sdist, _build("wheel", unpacked, folder))


def _build(kind: str, sources: Path, folder: Path) -> Path:
    code = f"from setuptools import build_meta; build_meta.build_{kind}({str(folder)!r})"
    run(sys.executable, "-c", code, cwd=sources)
    (path,) = folder.glob("*.tar.gz" if kind == "sdist" else "*.whl")
    return path


def run(*command: str | Path, cwd: Path, **environment: str) -> str:
    """Return what a command prints; its environment knows no folder of Python's."""
    clean = {name: value for name, value in os.environ.items() if not name.startswith("PYTHON")}
    done = subprocess.run(command, cwd=cwd, env=clean | environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def test_files_of_a_release_are_where_they_belong(built: Built):
    wheel, sdist = built.in_wheel(), built.in_sdist()
    everywhere = {"pregrasp_jax/py.typed", "pregrasp_jax/cli/main.py", "pregrasp_jax/report/style.css"}
    package = ROOT / "pregrasp_jax"
    everywhere |= {str(path.relative_to(ROOT)) for path in package.glob("pretrained*/*")}
    assert len(everywhere) > 10, "three policies"
    assert everywhere <= wheel and everywhere <= sdist
    assert f"pregrasp_jax-{pregrasp_jax.__version__}.dist-info/licenses/LICENSE" in wheel
    assert "pregrasp_jax/mjcf/table.xml" in wheel and "mjcf/table.xml" in sdist
    assert {"LICENSE", "CITATION.cff", "constraints.txt", "train.py", "tests/conftest.py", "docs/task.md"} <= sdist
    assert "examples/own_hand.py" in sdist
    assert not [
        name for name in wheel if name.startswith(("tests", "benchmarks", "docs", "examples", "train", "evaluate"))
    ]
    assert not [name for name in wheel | sdist if "__pycache__" in name]
    modules = {str(path.relative_to(ROOT)) for path in (ROOT / "pregrasp_jax").rglob("*.py")}
    assert modules <= wheel, "every folder of modules is named in pyproject.toml"


def test_the_licence_is_named_and_whole():
    text = (ROOT / "LICENSE").read_text()
    assert "Apache License" in text and "Version 2.0, January 2004" in text and "END OF TERMS AND CONDITIONS" in text
    assert 'license = "Apache-2.0"' in (ROOT / "pyproject.toml").read_text()


def test_the_citation_is_of_this_version_and_names_the_paper():
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text())
    assert citation["cff-version"] == "1.2.0" and citation["title"] == "pregrasp_jax" and citation["authors"]
    assert citation["version"] == pregrasp_jax.__version__ and citation["license"] == "Apache-2.0"
    (paper,) = citation["references"]
    title = "Learning a Pre-Grasp Manipulation Policy to Effectively Retrieve a Target in Dense Clutter"
    assert paper["title"] == title and title in " ".join((ROOT / "README.md").read_text().split())
    assert paper["authors"]


@pytest.mark.parametrize(
    "dependencies",
    ["borrowed", pytest.param("installed", marks=pytest.mark.slow)],
    ids=lambda kind: f"{kind}_dependencies",
)
def test_the_wheel_trains_and_evaluates_without_the_checkout(built: Built, tmp_path: Path, dependencies: str):
    """In an empty environment, whose dependencies and caches are those of this one, or new."""
    program = _install(built.wheel, tmp_path / "environment", borrow=dependencies == "borrowed")
    away = tmp_path / "away"
    away.mkdir()
    if dependencies == "borrowed":
        cache = {"JAX_COMPILATION_CACHE_DIR": jax.config.values["jax_compilation_cache_dir"]}
    else:
        cache = {"PREGRASP_JAX_CACHE": str(tmp_path / "cache"), "JAX_DISABLE_MOST_OPTIMIZATIONS": "0"}
    assert run(program, "--version", cwd=away) == f"pregrasp-jax {pregrasp_jax.__version__}\n"
    where = run(program.parent / "python", "-c", "import pregrasp_jax; print(pregrasp_jax.__file__)", cwd=away)
    assert Path(where).is_relative_to(tmp_path / "environment")

    limits = ["--train.minutes", "0", "--train.episodes", "2", "--films", str(dependencies == "installed")]
    run(program, "train", "ci", "--run-dir", "run", *limits, cwd=away, **cache)
    assert (away / "run" / "report.html").is_file() and list((away / "run" / "checkpoints").iterdir())

    episodes = ["--episodes", "2", "--num-envs", "2", "--scene.test-scenes", "2"]
    table = run(program, "evaluate", "--policy", "pretrained", *episodes, "--json", "e.json", cwd=away, **cache)
    assert table.startswith("pretrained on 2 seen scenes")
    assert len(json.loads((away / "e.json").read_text())["rows"]) == 2


def _install(wheel: Path, environment: Path, *, borrow: bool) -> Path:
    """Make an environment with the wheel in it, and return its program.

    Args:
        wheel: to install.
        environment: folder to make.
        borrow: see the packages of this environment instead of installing dependencies. Links that this one has to a
            checkout are not followed: a .pth file adds folders, not what their own .pth files say.
    """
    venv.create(environment)
    python = environment / "bin" / "python"
    pip = [sys.executable, "-m", "pip", "--python", str(python), "install", "--quiet", "--disable-pip-version-check"]
    choice = ["--no-deps"] if borrow else ["--constraint", str(ROOT / "constraints.txt")]
    run(*pip, *choice, wheel, cwd=environment)
    if borrow:
        site = run(python, "-c", "import sysconfig; print(sysconfig.get_path('purelib'))", cwd=environment)
        Path(site.strip(), "borrowed.pth").write_text(sysconfig.get_path("purelib") + "\n")
    return environment / "bin" / "pregrasp-jax"
