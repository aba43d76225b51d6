"""The entry points of the package as modules, to be called in the tests' own process."""

import importlib.util
import sys
from pathlib import Path
from types import ModuleType


def load_script(name: str) -> ModuleType:
    """Import a script of the top folder; its dataclasses look themselves up among the modules."""
    spec = importlib.util.spec_from_file_location(f"{name}_script", Path(__file__).parents[1] / f"{name}.py")
    assert spec and spec.loader
    module = sys.modules[spec.name] = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module
