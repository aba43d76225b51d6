"""Objects whose mass and friction are not exactly those of their models: a bank with several variants of each.

Variants share the hulls of their object, so a scene chooses among them by its object ids, on every engine.
"""

from statistics import NormalDist

import numpy as np

from pregrasp_jax.types import HullBank

NUM_VARIANTS = 16
"""Of each object; their logarithms lie at the middles of as many equally likely parts of a normal distribution."""


def vary(bank: HullBank, *, mass_spread: float, friction_spread: float, seed: int) -> HullBank:
    """Return a bank with `NUM_VARIANTS` variants of each of N objects; variant v of object i is number i + N v.

    Args:
        bank: host hull bank.
        mass_spread: deviation of the logarithm of the mass; inertia follows.
        friction_spread: the same of the friction.
        seed: of which mass goes with which friction.
    """
    rng, num_objects = np.random.default_rng(seed), len(bank.names)
    normal = np.array([NormalDist().inv_cdf((k + 0.5) / NUM_VARIANTS) for k in range(NUM_VARIANTS)])
    mass, friction = (
        np.exp(spread * rng.permuted(np.tile(normal, (num_objects, 1)), axis=1).T).ravel()
        for spread in (mass_spread, friction_spread)
    )

    def repeated(rows: np.ndarray) -> np.ndarray:
        return np.tile(np.asarray(rows), (NUM_VARIANTS, *[1] * (np.ndim(rows) - 1)))

    names = ("object_hulls", "mass", "com", "inertia", "inertia_quat", "friction", "height", "min_width")
    fields = {name: repeated(getattr(bank, name)) for name in names}
    fields["mass"] = (fields["mass"] * mass).astype(np.float32)
    fields["inertia"] = (fields["inertia"] * mass[:, None]).astype(np.float32)
    fields["friction"] = (fields["friction"] * friction).astype(np.float32)
    return bank.replace(names=bank.names * NUM_VARIANTS, **fields)
