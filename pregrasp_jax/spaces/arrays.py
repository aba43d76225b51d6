"""Functions that serve numpy and jax alike take the array module from their arguments."""

from typing import Any

import numpy as np


def namespace(*arrays: Any) -> Any:
    """Return the module of the first array that is not numpy's (`jax.numpy`, for tracers too), else numpy."""
    for array in arrays:
        if hasattr(array, "__array_namespace__") and not isinstance(array, np.ndarray | np.generic):
            return array.__array_namespace__()
    return np
