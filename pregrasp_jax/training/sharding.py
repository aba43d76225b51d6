"""Several devices: scenes and batches are split over a mesh with the one axis `data`, everything else is copied.

Every device pushes its own scenes without asking the others, and learns from its share of a batch; XLA adds up the
gradients. Parameters, optimizer, counts and the replay are the same on every device: what a push leaves behind is
gathered, so that a batch is drawn exactly as on one device, and the memory of each device must hold the whole replay.
On one device nothing here does anything.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, TypeVar

import jax
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from pregrasp_jax.config import Config

T = TypeVar("T")

AXIS = "data"
"""Name of the mesh axis."""

VmapFn = Callable[[Callable[..., Any]], Callable[..., Any]]
"""`jax.vmap`, or something that returns the same numbers."""


@dataclass(frozen=True)
class Layout:
    """Which device holds what.

    Attributes:
        mesh: of all devices of all processes; None for one device.
    """

    mesh: Mesh | None = None

    @property
    def split(self) -> NamedSharding | None:
        """How arrays [E, ...] or [B, ...] lie: a share of the leading axis on every device."""
        return None if self.mesh is None else NamedSharding(self.mesh, PartitionSpec(AXIS))

    @property
    def copied(self) -> NamedSharding | None:
        """How everything else lies: whole on every device."""
        return None if self.mesh is None else NamedSharding(self.mesh, PartitionSpec())

    @property
    def num_devices(self) -> int:
        """How many devices train."""
        return 1 if self.mesh is None else self.mesh.size

    def vmap(self, function: Callable[..., Any]) -> Callable[..., Any]:
        """Return `jax.vmap(function)`, in which every device runs its own part.

        A loop, such as that of a push, ends with the last scene of the device and not of all devices.
        """
        mapped = jax.vmap(function)
        if self.mesh is None:
            return mapped
        spec = PartitionSpec(AXIS)
        return jax.shard_map(mapped, mesh=self.mesh, in_specs=spec, out_specs=spec, check_vma=False)

    def split_batch(self, batch: T) -> T:
        """Return a batch, of which every leaf is [B, ...], split over the devices; for use under jit."""
        return batch if self.mesh is None else jax.lax.with_sharding_constraint(batch, self.split)

    def place(self, tree: T, shardings: Any) -> T:
        """Return a tree of local arrays, the same in every process, as `shardings`, a prefix of it, say."""

        def put(sharding: NamedSharding, part: Any) -> Any:
            return jax.tree.map(lambda x: jax.make_array_from_callback(x.shape, sharding, x.__getitem__), part)

        return tree if self.mesh is None else jax.tree.map(put, shardings, tree)

    def gather(self, tree: T) -> T:
        """Return a tree whole on every device, so that any process can write it; every process must call this."""
        return tree if self.mesh is None else jax.jit(_identity, out_shardings=self.copied)(tree)

    def one_copy(self, tree: T) -> T:
        """Return a copied tree as arrays of one device of this process."""
        return tree if self.mesh is None else jax.tree.map(lambda leaf: leaf.addressable_data(0), tree)


def make_layout(config: Config) -> Layout:
    """Return the layout for all devices; the `native` engine, whose scenes live on the host, keeps to the first one.

    Raises:
        ValueError: scenes or batches cannot be split evenly, or `native` is to run in several processes.
    """
    if config.physics.engine == "native":
        if jax.process_count() > 1:
            raise ValueError(
                "physics.engine = native keeps its scenes on the cores of one host; allowed with several processes "
                "(--distributed True) is mjx"
            )
        return Layout()
    refuse_uneven(config, jax.device_count())
    return Layout() if jax.device_count() == 1 else Layout(Mesh(np.array(jax.devices()), (AXIS,)))


def refuse_uneven(config: Config, num_devices: int) -> None:
    """Refuse scenes or batches of which not every device gets equally many.

    Raises:
        ValueError: one line names the setting, its value and the multiples that are allowed.
    """
    sizes = {"train.num_envs": config.train.num_envs, "learner.batch_size": config.learner.batch_size}
    for key, size in sizes.items():
        if size % num_devices:
            raise ValueError(
                f"{key} = {size} cannot be split over {num_devices} devices; allowed are multiples of {num_devices}"
            )


def _identity(tree: T) -> T:
    """Return what it gets; one function for all calls, so that it is compiled once."""
    return tree
