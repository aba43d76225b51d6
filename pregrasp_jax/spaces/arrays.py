"""Functions that serve numpy and jax alike take the array module from their arguments."""

from typing import Any

import numpy as np


def namespace(*arrays: Any) -> Any:
    """Return the module of the first array that has one (`jax.numpy` for tracers too), numpy for plain numbers."""
    for array in arrays:
        if hasattr(array, "__array_namespace__"):
            return array.__array_namespace__()
    return np
