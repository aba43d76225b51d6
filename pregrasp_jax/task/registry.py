"""Kinds of task, chosen by name: a primitive, and the rules by which it is judged."""

from collections.abc import Callable, Mapping
from typing import NamedTuple

from pregrasp_jax import messages
from pregrasp_jax.physics import ENGINES
from pregrasp_jax.physics.base import Engine
from pregrasp_jax.task import push, push_grasp, rules, stroke_rules
from pregrasp_jax.task.primitive import Primitive
from pregrasp_jax.task.rules import Rules


class Kind(NamedTuple):
    """How to make a task of this kind.

    Attributes:
        make_primitive: (robot, workspace, task config, *, max_distance m) -> `Primitive`.
        make_rules: (robot, workspace, primitive, hull bank, task config) -> `Rules`.
        engines: makers of engines by the name that `physics.engine` knows them by, see `physics.ENGINES`.
    """

    make_primitive: Callable[..., Primitive]
    make_rules: Callable[..., Rules]
    engines: Mapping[str, Callable[..., Engine]] = ENGINES


KINDS: dict[str, Kind] = {
    "push": Kind(push.make_push, rules.make_rules),
    "push_grasp": Kind(push_grasp.make_push_grasp, stroke_rules.make_rules, {"native": push_grasp.make_engine}),
}
"""Kinds by the name that `task.primitive` knows them by; add your own before you make an environment."""


def get_kind(name: str) -> Kind:
    """Return the kind of task called `name`.

    Raises:
        ValueError: there is none; the line lists those that exist.
    """
    return messages.lookup(KINDS, name, key="task.primitive")
