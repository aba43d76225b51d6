"""A step in three parts: decide and plan | physics | measure, judge, draw.

Where the engine runs on the device the three are one program. Where it runs on the host, each of the others is compiled
for itself: a program with a host callback in it gets no entry in jax's persistent cache, and would be compiled anew at
every start.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import jax

from pregrasp_jax.physics.base import Engine
from pregrasp_jax.task.primitive import Plan


@dataclass(frozen=True)
class Stages:
    """A function of a batch of scenes, divided where physics begins and where it ends.

    Attributes:
        before: (*args) -> (physics, plan) of all scenes, and anything that `after` needs.
        run: (physics, ctrl, num_ctrl) -> physics, of all scenes, under `jax.jit`.
        after: (kept, plan without its controls, physics) -> the result.
        advance: `run` on the host, None where `run` stays on the device.
    """

    before: Callable[..., tuple[Any, Plan, Any]]
    run: Callable[..., Any]
    after: Callable[..., Any]
    advance: Callable[..., Any] | None = None

    def __call__(self, *args: Any) -> Any:
        """Return the result; usable under `jax.jit`."""
        physics, plan, kept = self.before(*args)
        return self.after(kept, plan.replace(ctrl=None), self.run(physics, plan.ctrl, plan.num_ctrl))

    def compile(self, *args: Any, compile_fn: Callable[..., Any] | None = None) -> Callable[..., Any]:
        """Return the function compiled for arguments like these, as one program or as two around the host.

        Args:
            *args: arrays or their shapes.
            compile_fn: (function, args) -> compiled function, for the case of one program.
        """
        if self.advance is None:
            return (compile_fn or _compile)(self.__call__, args)
        traced = jax.jit(self.before).trace(*args)
        physics, plan, kept = traced.out_info
        before = traced.lower().compile()
        after = _compile(self.after, (kept, plan.replace(ctrl=None), physics))
        advance = self.advance

        def divided(*args: Any) -> Any:
            physics, plan, kept = before(*args)
            return after(kept, plan.replace(ctrl=None), advance(physics, plan.ctrl, plan.num_ctrl))

        return divided


def make_stages(
    engine: Engine,
    before: Callable[..., tuple[Any, Plan, Any]],
    after: Callable[..., Any],
    *,
    vmap: Callable[..., Any] = jax.vmap,
) -> Stages:
    """Return the stages of a batch around the physics of an engine; see `Stages`.

    Args:
        engine: its `run` is mapped over the scenes by `vmap`.
        before: of a batch.
        after: of a batch.
        vmap: maps physics over scenes.
    """
    return Stages(before=before, run=vmap(engine.run), after=after, advance=engine.advance)


def _compile(function: Callable[..., Any], args: tuple[Any, ...]) -> Any:
    return jax.jit(function).lower(*args).compile()
