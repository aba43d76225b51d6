"""Physics engines behind one contract, `base.Engine`, chosen by name."""

from pregrasp_jax.physics import native
from pregrasp_jax.physics.base import Engine
from pregrasp_jax.types import HullBank


def make_engine(name: str, bank: HullBank, *, threads: int = 0) -> Engine:
    """Return the engine called `name` with the objects of `bank`.

    Raises:
        ValueError: there is no such engine.
    """
    if name != "native":
        raise ValueError(f"physics.engine = {name!r} is not available; allowed: native")
    return native.make_engine(bank, threads=threads)
