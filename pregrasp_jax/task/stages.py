"""A step in parts: decide and plan | physics | measure, judge, draw; with a second motion in between, five.

Where the engine runs on the device they are one program. Where it runs on the host, each of the parts beside it is
compiled for itself: a program with a host callback in it gets no entry in jax's persistent cache, and would be compiled
anew at every start.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import jax

from pregrasp_jax.physics.base import Engine

Part = Callable[..., Any]
"""All parts but the last return (physics, plan) of all scenes, and anything that the next one needs; all but the first
take that, the plan without its controls, and the physics after it. The first takes the arguments, the last returns the
result."""


@dataclass(frozen=True)
class Stages:
    """A function of a batch of scenes, divided wherever physics runs.

    Attributes:
        parts: two or more, with a motion between each of them and the next.
        run: (physics, ctrl, num_ctrl) -> physics, of all scenes, under `jax.jit`.
        advance: `run` on the host, None where `run` stays on the device.
    """

    parts: tuple[Part, ...]
    run: Callable[..., Any]
    advance: Callable[..., Any] | None = None

    def __call__(self, *args: Any) -> Any:
        """Return the result; usable under `jax.jit`."""
        return _chain(self.parts, self.run, args)

    def compile(self, *args: Any, compile_fn: Callable[..., Any] | None = None) -> Callable[..., Any]:
        """Return the function compiled for arguments like these, as one program or as several around the host.

        Args:
            *args: arrays or their shapes.
            compile_fn: (function, args) -> compiled function, for the case of one program.
        """
        if self.advance is None:
            return (compile_fn or _compile)(self.__call__, args)
        compiled, advance = [], self.advance
        for part in self.parts:
            traced = jax.jit(part).trace(*args)
            compiled.append(traced.lower().compile())
            if len(compiled) < len(self.parts):
                physics, plan, kept = traced.out_info
                args = kept, plan.replace(ctrl=None), physics
        return lambda *args: _chain(compiled, advance, args)


def make_stages(engine: Engine, *parts: Part, vmap: Callable[..., Any] = jax.vmap) -> Stages:
    """Return the stages of a batch around the physics of an engine; see `Stages`.

    Args:
        engine: its `run` is mapped over the scenes by `vmap`.
        *parts: of a batch, two or more.
        vmap: maps physics over scenes.
    """
    return Stages(parts=parts, run=vmap(engine.run), advance=engine.advance)


def _chain(parts: Any, run: Callable[..., Any], args: tuple[Any, ...]) -> Any:
    *leading, last = parts
    for part in leading:
        physics, plan, kept = part(*args)
        args = kept, plan.replace(ctrl=None), run(physics, plan.ctrl, plan.num_ctrl)
    return last(*args)


def _compile(function: Callable[..., Any], args: tuple[Any, ...]) -> Any:
    return jax.jit(function).lower(*args).compile()
