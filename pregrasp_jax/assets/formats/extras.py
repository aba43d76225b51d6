"""Libraries that only some files need: the optional extra `formats`."""

import importlib
from types import ModuleType


def import_extra(module: str, what: str) -> ModuleType:
    """Import a library of the extra `formats`.

    Args:
        module: its name.
        what: what needs it, for the error.

    Raises:
        ValueError: it is not installed.
    """
    try:
        return importlib.import_module(module)
    except ImportError as error:
        raise ValueError(f"{what} requires {module}; install it with pip install 'pregrasp_jax[formats]'") from error
