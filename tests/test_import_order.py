"""A stage imports only stages before it in the data flow."""

import ast
from pathlib import Path

import pytest

import pregrasp_jax

PACKAGE = Path(pregrasp_jax.__file__).parent
ORDER = [
    ["messages"],
    ["io"],
    ["ranges", "settings", "spaces", "types", "yaml_file"],
    ["config", "geometry", "machine", "sensors", "startup"],
    ["evaluation_config", "presets"],
    ["assets"],
    ["robot"],
    ["scene"],
    ["physics"],
    ["heightmap"],
    ["drawing"],
    ["deploy"],
    ["task"],
    ["learning"],
    ["policies"],
    ["checkpoint"],
    ["planning"],
    ["evaluation", "gymnasium"],
    ["export", "planned_cell", "simulated_cell"],
    ["training"],
    ["report"],
    ["sweep"],
    ["cli"],
    ["__main__"],
]
RANK = {name: rank for rank, names in enumerate(ORDER) for name in names}


def stage(module: str) -> str:
    return module.removeprefix("pregrasp_jax.").split(".")[0]


def imported_stages(path: Path) -> set[str]:
    stages = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom) and node.module == "pregrasp_jax":
            stages |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and (node.module or "").startswith("pregrasp_jax."):
            stages.add(stage(node.module or ""))
        elif isinstance(node, ast.Import):
            stages |= {stage(a.name) for a in node.names if a.name.startswith("pregrasp_jax.")}
    return stages - {"__version__"}


@pytest.mark.parametrize("path", sorted(PACKAGE.rglob("*.py")), ids=lambda p: str(p.relative_to(PACKAGE)))
def test_imports_go_one_way(path: Path):
    own = path.relative_to(PACKAGE).parts[0].removesuffix(".py")
    if own == "__init__":
        assert not imported_stages(path)
        return
    for other in imported_stages(path):
        assert other == own or RANK[other] < RANK[own], f"{own} imports {other}, which comes later"


def test_spaces_import_neither_jax_nor_mujoco():
    for path in (PACKAGE / "spaces").glob("*.py"):
        tree = ast.parse(path.read_text())
        names = [alias.name for node in ast.walk(tree) if isinstance(node, ast.Import) for alias in node.names]
        names += [node.module or "" for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)]
        assert not [name for name in names if name.split(".")[0] in ("jax", "flax", "mujoco")], path
