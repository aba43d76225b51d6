"""How long a compiled function takes; imported by the benchmarks beside it."""

import math
import time
from collections.abc import Callable

import jax


def best_ms(function: Callable[[], object], *, repetitions: int = 10, seconds: float = math.inf) -> float:
    """Return the shortest of several calls, in ms: on a shared machine only noise makes a call slower.

    Args:
        function: returns arrays; the first call compiles and does not count.
        repetitions: calls at the most, but at least three.
        seconds: time after which no further call begins.
    """
    jax.block_until_ready(function())
    times: list[float] = []
    while len(times) < 3 or (len(times) < repetitions and sum(times) < seconds):
        start = time.perf_counter()
        jax.block_until_ready(function())
        times.append(time.perf_counter() - start)
    return 1e3 * min(times)
