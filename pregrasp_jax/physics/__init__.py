"""Physics engines behind one contract, `base.Engine`, chosen by name."""

from pregrasp_jax.physics import native
from pregrasp_jax.physics.base import Engine
from pregrasp_jax.types import HullBank


def make_engine(name: str, bank: HullBank, *, threads: int = 0) -> Engine:
    """Return the engine called `name` with the objects of `bank`.

    Args:
        name: `native`, `mjx` or `warp`.
        bank: host hull bank.
        threads: of the native engine; 0 takes every core.

    Raises:
        ValueError: there is no such engine, or it cannot be used here; one line says why.
    """
    if name == "native":
        return native.make_engine(bank, threads=threads)
    if name == "mjx":
        from pregrasp_jax.physics import mjx  # imported late: MJX takes seconds to import

        return mjx.make_engine(bank)
    if name == "warp":
        from pregrasp_jax.physics import warp

        warp.make_engine()
    raise ValueError(f"physics.engine = {name!r} does not exist; allowed: native, mjx, warp")
