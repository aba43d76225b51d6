"""Time the Q-network forward and one update by width, beside a large matmul of the same run.

Prints one JSON object; times are per sample, the best of several repetitions, since only noise makes a run slower.
`forward_ms` is the whole grid. `update_ms` is a whole gradient step: target network, online network forward and
backward at the taken pixels, Adam, polyak average. `fraction_of_matmul_rate` is the forward's GFLOP/s, counted layer
by layer as published (Fig. 3), over the matmul's.
"""

import argparse
import functools
import itertools
import json
import os
import platform

import pregrasp_jax  # noqa: F401  (sets NPROC before jax is imported)

# isort: split
import jax
import jax.numpy as jnp
import optax
from timing import best_ms

from pregrasp_jax.config import LearnerConfig, NetworkConfig, TaskConfig
from pregrasp_jax.learning import learner
from pregrasp_jax.learning.networks import num_parameters
from pregrasp_jax.learning.q_function import make_q_function
from pregrasp_jax.learning.records import UNKNOWN, Batch
from pregrasp_jax.robot import get_robot
from pregrasp_jax.spaces.grid import GRID_SIZE
from pregrasp_jax.spaces.workspace import TABLE
from pregrasp_jax.task.push import make_push
from pregrasp_jax.types import REASONS, HandPose

MATMUL_SIZE = 2048


def forward_gflop(width: float) -> float:
    """Return the multiply-adds x 2 of one forward pass of Fig. 3 at `width`, in 1e9."""

    def channels(at_full_width: int) -> int:
        return max(1, round(width * at_full_width))

    def block(size: int, c_in: int, c_out: int) -> int:
        return size**2 * (9 * c_in * c_out + 9 * c_out**2 + c_in * c_out)

    c = {n: channels(n) for n in (32, 64, 128, 256, 512)}
    full, half, quarter = GRID_SIZE, GRID_SIZE // 2, GRID_SIZE // 4
    multiply_adds = 2 * block(full, 1, c[32]) + full**2 * 9 * 2 * c[32] * c[64] + block(half, c[64], c[128])
    deep = [c[128], c[256], c[512], c[256], c[128]]
    multiply_adds += sum(block(quarter, a, b) for a, b in itertools.pairwise(deep))
    multiply_adds += block(half, c[128], c[64]) + full**2 * c[64] * 2
    return 2 * multiply_adds / 1e9


def random_batch(key: jax.Array, batch_size: int) -> Batch:
    """Return transitions with random images and actions all over the grid."""
    key_inputs, key_next, key_action, key_xy = jax.random.split(key, 4)
    shape = (batch_size, GRID_SIZE, GRID_SIZE, 2)
    return Batch(
        inputs=jax.random.normal(key_inputs, shape),
        next_inputs=jax.random.normal(key_next, shape),
        action=jax.random.randint(key_action, (batch_size, 1), 0, 2 * GRID_SIZE**2),
        reward=jnp.ones((batch_size, 1)),
        terminated=jnp.zeros((batch_size, 1), bool),
        reason=jnp.zeros((batch_size, 1), jnp.int32),
        next_hand=HandPose(
            jax.random.uniform(key_xy, (batch_size, 2), minval=-0.2, maxval=0.1), *jnp.zeros((3, batch_size))
        ),
        importance_weights=jnp.ones(batch_size),
        hindsight=jnp.zeros(batch_size, bool),
        rows=jnp.arange(batch_size)[:, None],
        drawn=jnp.ones((batch_size, 1), bool),
        next_values=jnp.full((batch_size, 1), UNKNOWN),
    )


def measure(width: float, batch: Batch, *, repetitions: int, seconds: float) -> dict[str, float]:
    """Return ms per sample of forward and update, and the number of parameters."""
    task, robot = TaskConfig(), get_robot("ur5e_rg2")
    push = make_push(robot, TABLE, task, max_distance=task.r_out)
    q = make_q_function(NetworkConfig(width=width), task, push.actions)
    params = jax.jit(q.init)(jax.random.key(0))
    forward = jax.jit(q.apply)
    optimizer = optax.adam(1e-4)
    state = learner.init(params, optimizer)
    update = jax.jit(
        functools.partial(
            learner.update,
            q=q,
            mask_fn=push.mask,
            successes=(REASONS.index("target_in_region"),),
            optimizer=optimizer,
            config=LearnerConfig(),
        ),
        donate_argnums=0,
    )

    def step() -> jax.Array:
        nonlocal state
        state, errors, *_ = update(state, batch)
        return errors

    options = {"repetitions": repetitions, "seconds": seconds}
    per_sample = 1 / batch.action.shape[0]
    return {
        "forward_ms": per_sample * best_ms(lambda: forward(params, batch.inputs), **options),
        "update_ms": per_sample * best_ms(step, **options),
        "parameters": num_parameters(params),
    }


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--widths", type=float, nargs="+", default=[1.0, 0.5, 0.25, 0.125])
    parser.add_argument("--batch", type=int, default=16)
    parser.add_argument("--repetitions", type=int, default=10, help="most repetitions of each measurement")
    parser.add_argument("--seconds", type=float, default=5.0, help="time after which a measurement stops repeating")
    args = parser.parse_args()
    options = {"repetitions": args.repetitions, "seconds": args.seconds}
    batch = random_batch(jax.random.key(0), args.batch)
    results = {str(width): measure(width, batch, **options) for width in args.widths}
    matrix = jax.random.normal(jax.random.key(1), (MATMUL_SIZE, MATMUL_SIZE))
    matmul = jax.jit(jnp.matmul)
    matmul_rate = 2 * MATMUL_SIZE**3 / 1e6 / best_ms(lambda: matmul(matrix, matrix), **options)
    rates = {key: forward_gflop(float(key)) / value["forward_ms"] * 1e3 for key, value in results.items()}
    print(
        json.dumps(
            {
                "forward_ms": {key: round(value["forward_ms"], 2) for key, value in results.items()},
                "update_ms": {key: round(value["update_ms"], 2) for key, value in results.items()},
                "fraction_of_matmul_rate": {key: round(rate / matmul_rate, 3) for key, rate in rates.items()},
                "forward_gflop_per_second": {key: round(rate, 1) for key, rate in rates.items()},
                "matmul_gflop_per_second": round(matmul_rate, 1),
                "parameters": {key: value["parameters"] for key, value in results.items()},
                "batch": args.batch,
                "device": jax.devices()[0].device_kind,
                "cores": len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count(),
                "versions": {"jax": jax.__version__, "python": platform.python_version()},
            },
            indent=2,
        )
    )


if __name__ == "__main__":
    main()
