"""Whether the convex parts of an object hold together: a file may hold two things, or a lid that floats."""

from collections.abc import Sequence

import numpy as np
from scipy.optimize import linprog
from scipy.sparse.csgraph import connected_components

TOUCHING = 2.0e-3
"""m, widest gap between parts that count as joined; those of real meshes overlap."""


def remark(parts: Sequence[np.ndarray]) -> str:
    """Return one line if parts [V, 3] m are several bodies; empty if they are one."""
    count = count_bodies(parts)
    if count == 1:
        return ""
    return (
        f"holds {count} bodies more than {TOUCHING * 1e3:g} mm apart, which move as one; a file should hold one object"
    )


def count_bodies(parts: Sequence[np.ndarray]) -> int:
    """Return the number of groups of convex parts [V, 3] m that do not touch each other."""
    near = np.eye(len(parts), dtype=bool)
    for i, part in enumerate(parts):
        for j, other in enumerate(parts[:i]):
            near[i, j] = gap(part, other) <= TOUCHING
    return connected_components(near, directed=False, return_labels=False)


def gap(part: np.ndarray, other: np.ndarray) -> float:
    """Return how far apart two convex parts [V, 3] m are along the axis where that is most, m; 0 if they overlap.

    The smallest such distance between a point of one and a point of the other, as a linear program over their weights.
    """
    num, num_other = len(part), len(other)
    goal = np.append(np.zeros(num + num_other), 1.0)
    difference = np.hstack([part.T, -other.T])
    bounds = np.block([[difference, -np.ones((3, 1))], [-difference, -np.ones((3, 1))]])
    sums = np.zeros((2, num + num_other + 1))
    sums[0, :num], sums[1, num:-1] = 1, 1
    found = linprog(goal, A_ub=bounds, b_ub=np.zeros(6), A_eq=sums, b_eq=[1, 1])
    return float(found.fun) if found.success else 0.0
